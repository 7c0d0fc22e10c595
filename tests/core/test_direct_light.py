# SPDX-License-Identifier: GPL-3.0-or-later
"""Direct light of lamps at receivers: closed forms in the open, quadrature for soft shadows, and what may not break."""

from __future__ import annotations

import itertools
import math
import warnings
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from prt_addon.basis.directions import random_rotation
from prt_addon.lighting.local_lights import LocalLight, spot_pattern, spread_factor, spread_pattern
from prt_addon.relighting.direct_light import LitReceivers, direct_local_light, sample_count
from prt_addon.relighting.lamp_light import DirectLight
from prt_addon.scene.scene_mesh import SceneMesh
from prt_addon.tracing.tracer import Tracer
from prt_addon.transport.receiver_set import ReceiverSet
from tests.core.shapes import box, join, plane, sphere

# Watts of a lamp of 1 W/sr in red, so that E / pi is cos / (pi d^2) there.
POWER = 4 * math.pi * np.array([1.0, 0.5, 2.0])
DOWN = np.eye(3)


@pytest.fixture(autouse=True)
def loud():
    """Every warning and every invalid number is an error."""
    with np.errstate(all="raise", under="ignore"), warnings.catch_warnings():
        warnings.simplefilter("error")
        yield


def lamp(kind, at, turn=DOWN, power=POWER, scale=(1.0, 1.0, 1.0), **options):
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = np.asarray(turn) * np.asarray(scale), at
    return LocalLight(kind, kind, matrix, np.asarray(power, float), **options)


def tracer_of(*meshes, threads=1):
    scene = SceneMesh.assemble(list(meshes))
    return Tracer(scene.points, scene.triangles, threads)


FLOOR = plane(size=8.0, cells=20)


def lit(lights, tracer=None, positions=None, normals=None, **options):
    """Red of E / pi at the floor's vertices, or at other receivers."""
    tracer = tracer or tracer_of(FLOOR)
    positions = FLOOR.positions if positions is None else np.atleast_2d(np.asarray(positions, float))
    normals = np.broadcast_to([0.0, 0, 1] if normals is None else normals, positions.shape)
    result = direct_local_light(tracer, LitReceivers.of_points(tracer, positions, normals),
                                lights if isinstance(lights, list) else [lights], **options)
    np.testing.assert_allclose(result, result[:, :1] * [1.0, 0.5, 2.0], rtol=1e-5)
    return result[:, 0]


def test_a_point_falls_off_with_the_cosine_and_the_square():
    at = np.array([0.7, -0.3, 1.3])
    towards = at - FLOOR.positions
    distance = np.linalg.norm(towards, axis=1)
    found = lit(lamp("point", at, scale=(3.0, 0.1, -2.0)))
    np.testing.assert_allclose(found, towards[:, 2] / distance ** 3 / math.pi, rtol=1e-4)


@pytest.mark.parametrize("blend", [0.0, 0.2, 1.0])
def test_a_spot_is_a_point_within_its_turned_and_stretched_cone(blend):
    at, turn, scale = np.array([0.5, 0.2, 2.0]), random_rotation(5, 0), (1.5, 0.7, 1.0)
    turn = turn if turn[2, 2] > 0.5 else np.array([[0.8, 0, -0.6], [0, 1, 0], [0.6, 0, 0.8]])
    towards = at - FLOOR.positions
    local = -towards @ np.linalg.inv(turn * scale).T
    cosine = -local[:, 2] / np.linalg.norm(local, axis=1)
    share = spot_pattern(cosine, 1.6, blend)
    expected = share * towards[:, 2] / np.linalg.norm(towards, axis=1) ** 3 / math.pi
    found = lit(lamp("spot", at, turn, scale=scale, spot_angle=1.6, spot_blend=blend))
    np.testing.assert_allclose(found, expected, rtol=1e-3, atol=2e-4 * expected.max())
    assert 10 < np.count_nonzero(found) < len(found) - 10


def face_points(light, count):
    """Positions (n, 3) on an Area's face, many and even."""
    return light.points(count)[0]


def brute_area(light, position, normal, count=40_000):
    """E / pi of an Area by a sum over its face; peak radiance P / (pi area) times the grid's share."""
    towards = face_points(light, count) - position
    square = np.sum(towards ** 2, axis=1)
    emitted = -(towards @ light.axis) / np.sqrt(square)
    received = np.maximum(towards @ normal, 0.0) / np.sqrt(square)
    shown = np.maximum(emitted, 0.0) * spread_pattern(emitted, light.spread) * spread_factor(light.spread)
    return light.power[0] / math.pi * np.mean(shown * received / square) / math.pi


@pytest.mark.parametrize("shape", ["rectangle", "ellipse"])
@pytest.mark.parametrize("spread", [math.pi, 1.8, 0.5])
def test_an_area_equals_a_sum_over_its_face_near_and_far(shape, spread):
    tilt = np.array([[0.9, 0, math.sqrt(0.19)], [0, 1, 0], [-math.sqrt(0.19), 0, 0.9]])
    light = lamp("area", (0.2, 0.1, 0.8), tilt, shape=shape, size=(1.2, 0.6), spread=spread)
    positions = np.array([[0.2, 0.1, 0.5], [0.0, 0.1, 0.0], [-0.5, 0.4, 0.0], [0.6, 0.0, 0.2], [-2.0, 0.0, -3.0],
                          [1.0, 0.0, 0.8], [0.2, 0.1, -4.0], [-3.0, 2.0, 0.0]])
    normals = np.tile([[0.0, 0, 1]], (len(positions), 1))
    normals[[3, 5]] = [-0.6, 0.0, 0.8]
    expected = np.array([brute_area(light, p, n) for p, n in zip(positions, normals, strict=True)])
    found = lit(light, positions=positions, normals=normals, samples=64, tracer=tracer_of(
        plane(size=0.01, centre=(50, 50))))
    np.testing.assert_allclose(found, expected, rtol=5e-3 if spread == math.pi else 0.03, atol=5e-3 * expected.max())


@pytest.mark.parametrize("shape", ["rectangle", "ellipse"])
def test_where_formula_and_points_meet_no_ring_shows(shape):
    """From 1 to 12 half widths: the closed form near by and four points from 5 on are both within 1e-3."""
    light = lamp("area", (0.0, 0, 0), shape=shape, size=(1.0, 0.6))
    far = np.linspace(1.0, 12.0, 56)[:, None] * light.extent
    positions = far * np.array([[0.5, 0.2, -math.sqrt(0.71)]])
    normals = np.array([[-0.6, 0.0, 0.8]])
    expected = np.array([brute_area(light, p, normals[0]) for p in positions])
    found = lit(light, positions=positions, normals=normals, tracer=tracer_of(plane(size=0.01, centre=(9, 9))))
    bound = np.where(far[:, 0] < 1.5 * light.extent, 5e-3, 1e-3)
    assert np.all(np.abs(found / expected - 1) < bound)
    ratio = found / expected
    assert np.abs(np.diff(ratio))[far[1:, 0] > 3 * light.extent].max() < 1e-3


def test_an_area_lights_one_side_however_it_is_mirrored():
    for scale in ((1, 1, 1), (-1, 1, 1), (1, 1, -1), (-1, -1, -1)):
        found = lit(lamp("area", (0.0, 0, 1), scale=scale))
        assert np.all(found > 0.0) if scale[2] > 0 else not found.any()


def brute_disc(radius, distance, slope, soft, count=200_000):
    """E / pi of a round spot of the sky by a sum over the hemisphere; radiance is I / (pi r^2)."""
    sine = math.sqrt(radius ** 2 / (distance ** 2 + (radius ** 2 if soft else 0.0)))
    cap = 1 - math.sqrt(1 - sine ** 2)
    below = (np.arange(count) + 0.5) / count * cap
    turn = 2 * math.pi * np.modf(np.arange(count) * 0.6180339887498949)[0]
    height = math.cos(slope) * (1 - below) + math.sin(slope) * np.sqrt(below * (2 - below)) * np.cos(turn)
    return 2 * math.pi * cap * np.maximum(height, 0).mean() / (math.pi * radius ** 2) / math.pi


@pytest.mark.parametrize("soft", [True, False])
@pytest.mark.parametrize("radius", [0.05, 0.9])
def test_a_ball_equals_a_sum_over_the_sky_at_any_height(soft, radius):
    slopes = np.radians([0.0, 40.0, 75.0, 88.0, 92.0, 110.0])
    normals = np.stack([np.sin(slopes), 0 * slopes, np.cos(slopes)], axis=1)
    expected = [brute_disc(radius, 1.0, slope, soft) for slope in slopes]
    found = lit(lamp("point", (0.0, 0, 1), radius=radius, soft_falloff=soft), positions=np.zeros((6, 3)),
                normals=normals, tracer=tracer_of(plane(size=0.01, centre=(50, 50))))
    np.testing.assert_allclose(found, expected, rtol=1e-3, atol=2e-5 * max(expected))


def test_inside_a_ball_all_the_sky_shines():
    """E = pi L with L = I / (pi r^2); the half of the sky behind a wall is dark, and the ball's own rim is no edge."""
    ball = lamp("point", (0.0, 0, 0.2), radius=1.0, soft_falloff=False)
    assert lit(ball, positions=[[0.0, 0, 0]]) == pytest.approx(1 / math.pi, rel=1e-5)
    wall = join("wall", plane(size=60.0), plane(size=8.0, height=-1.0))
    upright = np.array([0.0, 1.0, 0.0])
    half = lit(ball, tracer_of(wall), [[0.0, 0, 0.1]], upright, samples=256)
    # up to the ball's surface; the floor at height 0 cuts off what lies below it
    assert 0.5 < half[0] * math.pi < 0.75
    surface = np.nextafter(1.0, [0.0, 2.0])[:, None] * [[0.0, 0, 1.0]] + [0, 0, 0.2]
    around = np.concatenate([surface, [[0, 0, 1.2 + 1e-6], [0, 0, 1.2 - 1e-6], [0, 0, 1.2]]])
    near = lit(ball, positions=around, normals=[0.0, 0, -1], tracer=tracer_of(plane(size=2.0, height=-5.0)))
    np.testing.assert_allclose(near, 1 / math.pi, rtol=2e-3)


def occluded_floor(light, edge, height, cells, count):
    """E / pi along a line of the floor below a half-plane x < edge at some height, by quadrature over the lamp."""
    points, _ = light.points(count) if light.kind == "area" else (None, None)
    expected = []
    for x in cells:
        p = np.array([x, 0.0, 0.0])
        if points is None:  # a disc that faces the receiver
            axis = light.position - p
            far = np.linalg.norm(axis)
            axis /= far
            first = np.cross([0.0, 1, 0], axis)
            first /= np.linalg.norm(first)
            i = np.arange(count)
            r, t = np.sqrt((i + 0.5) / count) * light.radius, 2 * math.pi * np.modf(i * 0.6180339887498949)[0]
            on = light.position + (r * np.cos(t))[:, None] * first + (r * np.sin(t))[:, None] * np.cross(axis, first)
            normal = -axis
        else:
            on, normal = points, light.axis
        towards = on - p
        square = np.sum(towards ** 2, axis=1)
        cross = p[0] + towards[:, 0] * height / towards[:, 2]
        weight = (towards @ -normal) * towards[:, 2] / square ** 2 * (cross > edge)
        area = light.power[0] / math.pi if light.kind == "area" else light.power[0] / (4 * math.pi)
        expected.append(area * weight.mean() / math.pi)
    return np.array(expected)


@pytest.mark.parametrize("kind", ["rectangle", "ellipse", "ball"])
def test_soft_shadows_of_an_edge_equal_quadrature(kind):
    options = {"radius": 0.3} if kind == "ball" else {"shape": kind, "size": (0.6, 0.4)}
    light = lamp("point" if kind == "ball" else "area", (0.1, 0.0, 2.0), **options)
    edge, height = 0.0, 1.0
    half_plane = plane(size=40.0, height=height, centre=(-20.0 + edge, 0.0))
    tracer = tracer_of(half_plane, plane(size=4.0))
    x = np.linspace(-1.0, 1.0, 81)
    positions = np.stack([x, 0 * x, 0 * x], axis=1)
    expected = occluded_floor(light, edge, height, x, 20_000)
    assert expected[0] == 0.0  # wholly dark, half-lit and lit places among them
    peak = expected.max()
    for samples, bound in ((16, 0.09), (64, 0.03), (256, 0.015)):
        found = lit(light, tracer, positions, samples=samples)
        assert np.abs(found - expected).max() < bound * peak
        assert np.abs(found - expected).mean() < 0.3 * bound * peak
    open_air = (expected > 0.0) & (np.abs(x - 0.75) < 0.25)
    np.testing.assert_allclose(lit(light, tracer, positions, samples=16)[open_air], expected[open_air], rtol=2e-3)


def test_a_wide_spot_has_a_soft_cone():
    """The cone's edge across a disc of radius 0.3, by quadrature; everything within and without it is untouched."""
    light = lamp("spot", (0.0, 0.0, 2.0), radius=0.3, spot_angle=0.9, spot_blend=0.1)
    x = np.linspace(0.0, 2.0, 60)
    positions = np.stack([x, 0 * x, 0 * x], axis=1)
    expected = []
    i = np.arange(20_000)
    r, t = np.sqrt((i + 0.5) / len(i)) * 0.3, 2 * math.pi * np.modf(i * 0.6180339887498949)[0]
    for p in positions:
        axis = (light.position - p) / np.linalg.norm(light.position - p)
        first = np.cross([0.0, 1, 0], axis) / np.linalg.norm(np.cross([0.0, 1, 0], axis))
        on = light.position + (r * np.cos(t))[:, None] * first + (r * np.sin(t))[:, None] * np.cross(axis, first)
        towards = on - p
        distance = np.linalg.norm(towards, axis=1)
        share = spot_pattern(towards[:, 2] / distance, 0.9, 0.1)
        expected.append(np.mean(share * (towards @ axis) * towards[:, 2] / distance ** 4) / math.pi)
    expected = np.array(expected)
    found = lit(light, positions=positions, tracer=tracer_of(plane(size=8.0)), samples=16)
    assert np.abs(found - expected).max() < 0.01 * expected.max()
    assert found[-1] == 0.0


def test_walls_hide_and_lamps_without_shadow_shine_through():
    roof = plane(size=8.0, height=1.0)
    tracer = tracer_of(roof, FLOOR)
    for kind, options in (("point", {}), ("point", {"radius": 0.3}), ("spot", {"spot_angle": 2.0}),
                          ("area", {"size": (0.5, 0.5)})):
        above = lamp(kind, (0.0, 0, 2), **options)
        assert not lit(above, tracer, FLOOR.positions * 0.5).any()
        through = lit(lamp(kind, (0.0, 0, 2), shadow=False, **options), tracer, FLOOR.positions * 0.5)
        np.testing.assert_allclose(through, lit(above, positions=FLOOR.positions * 0.5), rtol=1e-5)


def test_lamps_add_up_and_subtract():
    lights = [lamp("point", (1.0, 0, 1)), lamp("spot", (0.0, 1, 2), spot_angle=1.0), lamp("area", (0.0, 0, 3))]
    np.testing.assert_allclose(lit(lights), sum(lit(light) for light in lights), rtol=1e-4)
    dark = lamp("point", (1.0, 0, 1), power=-POWER)
    np.testing.assert_allclose(lit([lights[0], lights[1], dark]), lit(lights[1]), atol=1e-6)
    assert not lit([lamp("point", (1.0, 0, 1), power=0 * POWER)]).any()
    assert lit([]).shape == (len(FLOOR.positions),)


LIGHTS = [("point", {}), ("point", {"radius": 0.1}), ("point", {"radius": 0.1, "soft_falloff": False}),
          ("spot", {"spot_angle": 1.0, "spot_blend": 0.2}), ("spot", {"spot_angle": 1.0, "radius": 0.1}),
          ("area", {"size": (0.2, 0.3)}), ("area", {"size": (0.2, 0.3), "spread": 1.0, "shape": "ellipse"}),
          ("area", {"size": (1e-7, 1e-7)}), ("point", {"radius": 1e-9})]


@pytest.mark.parametrize(("kind", "options"), LIGHTS)
@pytest.mark.parametrize("watts", [1e-6, 1e9])
def test_stiff_places_give_finite_light(kind, options, watts):
    """On a surface, on a receiver, a hair above and below, behind everything, far away, in a corner."""
    room = join("room", box("room", (-1, -1, 0), (1, 1, 2), inward=True), plane(size=0.5, height=0.5, cells=4))
    places = [(0, 0, 2.0), (0, 0, 0.0), (1, 1, 2.0), (0, 0, -3.0), (0, 0, 1.9999999), (1e6, 0, 0), (0, 3e14, 0),
              (0, 3e15, 0), (0, 0, 1e30), (0, 1e300, 0)]
    places += list(room.positions[12] + np.array([[0, 0, 0], [0, 0, 1e-9], [0, 0, -1e-9], [1e-7, 0, 1e-6]]))
    tracer = tracer_of(room)
    normals = np.zeros_like(room.positions)
    normals[:, 2] = 1.0
    for at in places:
        found = lit(lamp(kind, at, power=POWER * watts, **options), tracer, room.positions, normals)
        assert np.all(np.isfinite(found))
        assert np.all(found >= 0.0)


def test_a_lamp_in_the_ceiling_lights_the_floor():
    room = box("room", (-1, -1, 0), (1, 1, 2), inward=True)
    tracer = tracer_of(room)
    floor = np.array([[0.0, 0, 0], [0.5, -0.3, 0], [-0.9, 0.9, 0]])
    for kind, options in (("point", {}), ("area", {"size": (0.5, 0.5)}), ("spot", {"spot_angle": 2.5})):
        light = lamp(kind, (0.0, 0, 2), **options)
        np.testing.assert_allclose(lit(light, tracer, floor), lit(light, positions=floor), rtol=1e-4)
        assert np.all(lit(light, tracer, floor) > 0.0)
        # a hair inside the ceiling (2e-7 of 3.5 m): rounding may not switch it off
        near = lamp(kind, (0.0, 0, 2 + 1e-6), **options)
        assert np.all(lit(near, tracer, floor) > 0.0)


@pytest.mark.parametrize("size", [1e-6, 1e6])
def test_scenes_of_any_size(size):
    """E / pi scales with 1 / size^2, and the scene may lie far from the origin for its size."""
    far = 1e3 * size * np.array([1.0, -2.0, 3.0])
    floor = FLOOR.positions * size + far
    scene = Tracer(floor, FLOOR.triangles, 1)
    for kind, options in LIGHTS[:7]:
        light = lamp(kind, far + size * np.array([0.5, 0.2, 1.5]), scale=(size,) * 3, **{
            **options, "radius": options.get("radius", 0.0) * size})
        one = lit(lamp(kind, (0.5, 0.2, 1.5), **options), tracer_of(FLOOR))
        np.testing.assert_allclose(lit(light, scene, floor) * size ** 2, one, rtol=2e-3, atol=1e-3 * one.max())


def test_threads_blocks_and_the_order_of_receivers_change_nothing():
    ball = sphere(radius=0.5, centre=(0, 0, 1), subdivisions=4)
    ground = plane(size=8.0, cells=70)
    meshes = (ball, ground)
    positions = np.concatenate([ball.positions, ground.positions])
    normals = np.concatenate([(ball.positions - [0, 0, 1]) / 0.5, np.tile([0.0, 0, 1], (len(ground.positions), 1))])
    lights = [lamp("point", (1.0, 0, 2), radius=0.2), lamp("area", (0, 0, 3), size=(1, 2), spread=2.0),
              lamp("spot", (0, 1, 2), spot_angle=1.0), lamp("point", (-1, -1, 0.5))]
    one, three = tracer_of(*meshes), tracer_of(*meshes, threads=3)
    expected = direct_local_light(one, LitReceivers.of_points(one, positions, normals), lights)
    assert len(positions) > 4096  # more than a block
    found = direct_local_light(three, LitReceivers.of_points(three, positions, normals), lights)
    np.testing.assert_array_equal(found, expected)
    assert three.rays == one.rays > 4 * 4096
    shuffled = np.random.Generator(np.random.PCG64(1)).permutation(len(positions))
    again = direct_local_light(one, LitReceivers.of_points(one, positions[shuffled], normals[shuffled]), lights)
    np.testing.assert_allclose(again, expected[shuffled], rtol=1e-6, atol=1e-7)


def test_the_preview_gets_its_receivers_order_and_rows():
    scene = sphere(subdivisions=3)
    tracer = tracer_of(scene, FLOOR)
    baked = SimpleNamespace(positions=scene.positions, normals=scene.positions, bases=np.zeros((1, 2, 4, 9, 1)),
                            triangles=scene.triangles, lamp_surfaces=None, faces=None)
    lights = [lamp("point", (1.0, 2.0, 3.0)), lamp("point", (-2.0, 0, 1), radius=0.2)]
    found = DirectLight(tracer, baked, samples=8).of(lights)
    receivers = LitReceivers.of_mesh(tracer, scene.positions, scene.positions, scene.triangles)
    plain = direct_local_light(tracer, receivers, lights, 8)
    assert found.shape == (len(scene.positions), 4, 3)
    np.testing.assert_allclose(found[:, 0], plain, rtol=1e-6)
    assert not found[:, 1:].any()
    assert plain.any()


def test_lamps_that_stay_cost_no_rays_and_power_only_scales():
    """A lamp's light is kept until it moves; forgotten where it is no longer among the lamps."""
    scene = sphere(subdivisions=3)
    tracer = tracer_of(scene, FLOOR)
    baked = SimpleNamespace(positions=scene.positions, normals=scene.positions, bases=np.zeros((1, 2, 1, 9, 1)),
                            triangles=scene.triangles, lamp_surfaces=None, faces=None)
    direct, near, far = DirectLight(tracer, baked), (1.0, 2.0, 3.0), (-2.0, 0, 1)
    first = direct.of([lamp("point", near, radius=0.2), lamp("area", far, size=(1, 2))])
    assert tracer.rays > 0
    rays = tracer.rays
    dim = direct.of([lamp("point", near, power=(0.5, -2.0, 0.0), radius=0.2), lamp("area", far, size=(1, 2))])
    assert tracer.rays == rays
    fresh = DirectLight(tracer, baked).of([lamp("point", near, power=(0.5, -2.0, 0.0), radius=0.2)])
    other = DirectLight(tracer, baked).of([lamp("area", far, size=(1, 2))])
    np.testing.assert_array_equal(dim, fresh + other)
    rays = tracer.rays
    direct.of([lamp("point", (1.1, 2.0, 3.0), radius=0.2), lamp("area", far, size=(1, 2))])
    moved = tracer.rays - rays
    assert 0 < moved <= 16 * len(scene.positions)
    np.testing.assert_array_equal(
        direct.of([lamp("point", near, radius=0.2), lamp("area", far, size=(1, 2))]), first)
    assert tracer.rays > rays + moved


def test_fewer_samples_change_penumbrae_only_and_by_their_steps():
    """While a lamp is dragged: what is wholly lit or wholly dark is the same, the rest within two points of four."""
    blocker = plane(size=1.0, height=1.0, cells=1)
    ground = plane(size=6.0, cells=60)
    tracer = tracer_of(blocker, ground)
    normals = np.tile([0.0, 0.0, 1.0], (len(ground.positions), 1))
    baked = SimpleNamespace(positions=ground.positions, normals=normals, bases=np.zeros((1, 2, 1, 9, 1)),
                            triangles=ground.triangles, lamp_surfaces=None, faces=None)
    direct, open_air = DirectLight(tracer, baked), DirectLight(tracer_of(ground), baked)
    ball = lamp("point", (0.3, 0.0, 2.0), radius=0.3)
    quick, fine, unshadowed = direct.of([ball], [4]), direct.of([ball]), open_air.of([ball])
    penumbra = (fine > 0.0) & (fine < unshadowed * (1 - 1e-6))
    assert 0.02 < penumbra.mean() < 0.5
    difference = np.abs(quick - fine) / unshadowed
    assert np.mean(difference[~penumbra] > 1e-6) < 0.02  # at its rim, where a quarter of the lamp is all or nothing
    assert difference.max() <= 0.5
    assert 0.01 < np.sqrt(np.mean(difference[penumbra] ** 2)) < 0.15

    def largest_step(samples):
        """From one place of the lamp to the next one, 2 cm on: what could be seen as flicker."""
        shares = [direct.of([replace(ball, matrix=lamp("point", (0.3 + 0.02 * k, 0.0, 2.0)).matrix)], [samples])
                  / unshadowed for k in range(9)]
        return max(float(np.sqrt(np.mean((b - a) ** 2))) for a, b in itertools.pairwise(shares))

    assert largest_step(4) < 2.0 * largest_step(16), largest_step(4) / largest_step(16)


def test_a_cutoff_costs_no_more_than_itself():
    lights = [lamp("point", (3.0, 0, 1)), lamp("area", (0, 3, 1), size=(0.3, 0.3)),
              lamp("point", (0, 0, 1), radius=0.1)]
    tracer = tracer_of(FLOOR)
    exact = lit(lights, tracer)
    before, cutoff = tracer.rays, 0.02
    rough = lit(lights, tracer, cutoff=cutoff)  # red; blue is twice as bright and decides
    assert tracer.rays - before < before
    assert np.abs(rough - exact).max() <= len(lights) * cutoff
    assert np.any(rough != exact)


def test_faces_of_the_bake_count_as_there():
    """A receiver on the edge of a box sees a lamp with the share of its faces that look at it. (The bake pulls it by
    1 % of an edge into its faces.)"""
    cube = box("cube", (-1, -1, -1), (1, 1, 1))
    scene = SceneMesh.assemble([cube])
    tracer = Tracer(scene.points, scene.triangles, 1)
    receivers = ReceiverSet.of_keys(scene, tracer, np.arange(len(scene.points)))
    light = lamp("point", (0.0, 0.0, 4.0))
    found = direct_local_light(tracer, receivers, [light])[:, 0]
    points = scene.points[receivers.key]
    towards = light.position - points
    cosine = np.sum(towards * receivers.normals, axis=1)
    expected = np.maximum(cosine, 0.0) / np.linalg.norm(towards, axis=1) ** 3 / math.pi
    share = np.sum((np.sum(receivers.faces * towards[:, None, :], axis=2) > 0) * receivers.face_weights, axis=1)
    np.testing.assert_allclose(found, expected * share, rtol=0.01, atol=1e-6)
    assert np.any(found > 0)


def test_the_number_of_samples_goes_with_the_size():
    assert sample_count(0.0, 1.0, 16) == 1
    assert sample_count(1.0, 1.0, 1) == 1
    assert sample_count(1.0, 1.0, 16) == 16
    assert sample_count(1e-6, 1.0, 16) == 4
    assert sample_count(0.05, 1.0, 16) == 8
    assert sample_count(0.06, 1.0, 16) == 16
    assert sample_count(1e-6, 1.0, 3) == 3
    assert sample_count(1.0, 0.0, 16) == 16


def test_nothing_to_light_and_nothing_in_the_way():
    empty = Tracer(np.zeros((0, 3)), np.zeros((0, 3), np.int32), 2)
    assert lit(lamp("area", (0, 0, 1)), empty, np.zeros((0, 3))).shape == (0,)
    assert lit(lamp("point", (0, 0, 1)), empty, [[0.0, 0, 0]])[0] == pytest.approx(1 / math.pi, rel=1e-5)
