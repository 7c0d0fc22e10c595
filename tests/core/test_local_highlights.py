# SPDX-License-Identifier: GPL-3.0-or-later
"""Highlights of local lights: of surfaces that the lights of a cloud shine on, and of lamps themselves; against path
tracing, brute-force GGX and rooms whose answer is known."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest

from prt_addon.baking.highlight_sampling import TrueHighlight
from prt_addon.baking.job import read_result, run_job, write_job
from prt_addon.baking.local_lights import LitHighlights
from prt_addon.baking.recipe import _Bake, bake, exhaust, transport_settings
from prt_addon.baking.settings import make_settings
from prt_addon.baking.surfaces import INCIDENT_ORDER
from prt_addon.basis import hemisphere
from prt_addon.basis.spherical_harmonics import evaluate
from prt_addon.errors import StorageError
from prt_addon.lighting.analytic import sun
from prt_addon.lighting.local_lights import LocalLight
from prt_addon.relighting.direct_light import LitReceivers, direct_local_light
from prt_addon.relighting.exit_radiance import hemisphere_values, view_radiance
from prt_addon.relighting.lamp_highlights import LampSurfaces
from prt_addon.relighting.lamp_light import DirectLight
from prt_addon.scene.scene_mesh import SceneMesh
from prt_addon.scene.surface_material import SurfaceMaterial
from prt_addon.scene.tangents import smooth_tangents
from prt_addon.storage.lamp_surfaces import ENTRY, lamp_surfaces_entry, read_lamp_surfaces
from prt_addon.tracing.tracer import Tracer
from prt_addon.transport.brdf import reflection_of_material
from prt_addon.transport.glossy import reflected_light
from prt_addon.transport.incident_light import DiffuseRadiance, IndirectLight
from prt_addon.transport.lamp_kernel import LAMP_ORDER, cosine_product, lamp_kernel
from tests.core.shapes import box, drain, plane, sphere

METAL = SurfaceMaterial("metal", (1.0, 1.0, 1.0), roughness=0.6, metallic=1.0, specular_level=0.5)
WALLS = 0.6


class KeepingBake(_Bake):
    """A bake that keeps what its highlights are made of."""

    def _local(self, gathered, visibility):
        self.gathered, self.visibility = gathered, visibility
        self.kept = yield from super()._local(gathered, visibility)
        return self.kept


def until_encoding(scene, **options):
    """A bake of local lights, run up to its encoding."""
    wanted = {"lighting": "local", "lamp_basis": "cloud",
              "spacing": "0", "threads": "1", "merge_response": "0", "gather_directions": "1024",
              "directions": "1024"}
    settings = make_settings("standard", wanted | {name: str(value) for name, value in options.items()})
    bake = KeepingBake(scene, transport_settings(settings), None, None, {}, np.empty((0, 4, 4)))
    steps = bake.run()
    while next(steps).stage != "encode":
        pass
    steps.close()
    return bake


def room_with_ball(cells=16, material=METAL, albedo=0.0):
    """A grey room 4 m wide, whose walls are finely divided, and a white metal ball near a corner of the floor."""
    room = box("room", (-2, -2, -2), (2, 2, 2), inward=True, albedo=(WALLS,) * 3)
    ball = replace(sphere("ball", 0.5, (0.7, 0.4, -1.0), 3, albedo=(albedo,) * 3), materials=(material,))
    return SceneMesh.assemble([room, ball], 4.0 / cells / np.sqrt(48.0))


@pytest.fixture(scope="module")
def lit_room():
    return until_encoding(room_with_ball(), cloud_lights=8)


def views_of(bake, angle):
    """A view (g, 3) in the world for each highlight, and its coordinates in the receiver's frame."""
    frames = bake._glossy_surfaces(bake.kept.points).frames
    turn = 2.4 * np.arange(len(frames))
    local = np.stack([np.sin(angle) * np.cos(turn), np.sin(angle) * np.sin(turn), np.full(len(frames), np.cos(angle))],
                     axis=1)
    return local, frames


def unit(vectors):
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def traced_radiance(bake, origins, directions, light, generator, bounces=24):
    """Radiance (n, ) that arrives along rays (n, 3) from diffuse surfaces lit by a point of 1 W/sr, by path tracing
    with rays to the light at each hit. The ball counts as white and diffuse, as the first bounce of a bake has it."""
    scene, tracer = bake.scene, bake.tracer
    total, throughput, alive = np.zeros(len(origins)), np.ones(len(origins)), np.arange(len(origins))
    for _ in range(bounces):
        hits = tracer.nearest(origins, directions.astype(np.float32))
        assert (hits.triangle >= 0).mean() > 0.999
        met = np.flatnonzero(hits.triangle >= 0)
        corners = scene.points[scene.triangles[hits.triangle[met]]]
        weights = np.stack([1 - hits.u[met] - hits.v[met], hits.u[met], hits.v[met]], axis=1)[:, :, None]
        place = np.sum(weights * corners, axis=1)
        normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        normal = unit(normal)
        alive, throughput = alive[met], throughput[met]
        albedo = bake.albedo[scene.triangles[hits.triangle[met], 0], 0]
        origins = tracer.to_tracing_space(place + 1e-5 * normal)
        towards = tracer.to_tracing_space(light[None]) - origins
        metres = np.linalg.norm(light - place, axis=1)
        cosine = np.sum((light - place) * normal, axis=1) / metres
        hidden = tracer.occluded(origins, towards, np.full(len(towards), 0.9999, np.float32))
        throughput = throughput * albedo
        total[alive] += np.where(hidden, 0.0, throughput * np.maximum(cosine, 0.0) / (np.pi * metres ** 2))
        directions = unit(normal + unit(generator.normal(size=normal.shape)))  # cosine about the normal
    return total


@pytest.mark.parametrize("degrees", [10.0, 50.0])
def test_a_metal_ball_in_a_lit_room_reflects_what_path_tracing_finds(lit_room, degrees):
    bake, generator = lit_room, np.random.default_rng(4)
    local, frames = views_of(bake, np.radians(degrees))
    some = np.arange(0, len(local), len(local) // 24)
    values = hemisphere_values(tuple(bake.surfaces.functions), local)
    truth = TrueHighlight(METAL)
    count, errors, whole = 1024, [], []
    number = np.argmin(np.linalg.norm(bake.kept.cloud.positions - (-1, -1, 1), axis=1))
    light = bake.kept.cloud.positions[number]
    found = np.sum(values[some] * bake.kept.rows[some, :, number, 0], axis=1)
    receivers = bake.gathered.receivers.origins[bake.visibility.rows[some]]
    for index, (place, origin) in enumerate(zip(some, receivers, strict=True)):
        directions, weight = truth.sample(np.repeat(local[place][None], count, 0), generator.random((count, 2)))
        up = directions[:, 2] > 0
        world = directions[up] @ frames[place]
        arriving = traced_radiance(bake, np.repeat(origin[None], len(world), 0), world, light, generator)
        expected = np.sum(weight[up, 0] * arriving) / count
        errors.append(found[index] - expected)
        whole.append(expected)
    errors, whole = np.array(errors), np.array(whole)
    # Measured 2.6 % and 3.2 %, half of it the noise of 1,024 paths.
    assert np.sqrt(np.mean(errors ** 2)) < 0.05 * np.sqrt(np.mean(whole ** 2))
    assert abs(errors.mean()) < 0.02 * whole.mean()


def test_bounced_highlights_hardly_ring(lit_room):
    """No bound keeps them above black as in a white world: light from walls all around is smooth enough."""
    rows = lit_room.kept.rows[..., 0]
    angle = np.radians([0.0, 30.0, 60.0, 80.0, 89.0])[:, None]
    turn = np.arange(8) * np.pi / 4
    views = np.stack([np.sin(angle) * np.cos(turn), np.sin(angle) * np.sin(turn), np.cos(angle) + 0 * turn],
                     axis=-1).reshape(-1, 3)
    seen = np.einsum("vf,gfc->vgc", hemisphere_values(tuple(lit_room.surfaces.functions), views), rows)
    assert seen.mean() > 0.0
    assert seen.min() > 0.0


def rows_of_even_light(bake, radiances):
    """Rows of the highlights where all surfaces send out the same."""
    points = bake.kept.points
    highlights = LitHighlights(points, bake.visibility.rows, bake._glossy_surfaces(points), bake.visibility.blocked)
    even = np.tile(np.float32(radiances)[None, :, None], (len(bake.gathered.receivers), 1, 1))
    source = DiffuseRadiance(bake.gathered.hits, bake.scene, bake.gathered.receivers, even)
    light = IndirectLight(bake.gathered.hits, source, highlights.places, highlights.blocked)
    return drain(reflected_light(bake.tracer, highlights.surfaces, len(radiances), light))


@pytest.mark.parametrize("lighting", ["local", "environment,local"])
def test_white_plastic_keeps_the_energy_of_local_light(lighting):
    """In even light the diffuse row, dimmed by the layer above, and the highlight's rows make up a white surface."""
    plastic = SurfaceMaterial("plastic", (1.0, 1.0, 1.0), roughness=0.5, specular_level=0.5)
    bake = until_encoding(room_with_ball(4, plastic, 1.0), cloud_lights=2, glossy_albedo=0, lighting=lighting, order=2,
                          error_receivers=0)
    target = next(o for o in bake.scene.objects if o.name == "ball")
    local = replace(bake.kept, transfer=np.ones((len(bake.scene.points), 2, 1), np.float32),
                    rows=rows_of_even_light(bake, [1.0, 1.0]))
    count, functions = target.points.stop - target.points.start, tuple(bake.surfaces.functions)
    signal = np.zeros((count, 1 + len(functions), 2, 1), np.float32)
    bake._write_local(signal, target, local)
    assert 0.8 < signal[0, 0, 0, 0] < 0.98
    for degrees in (0.0, 30.0, 60.0):
        view = np.array([[np.sin(np.radians(degrees)), 0.0, np.cos(np.radians(degrees))]])
        seen = signal[:, 0, :, 0] + np.sum(hemisphere_values(functions, view)[:, :, None] * signal[:, 1:, :, 0], axis=1)
        np.testing.assert_allclose(seen, 1.0, atol=0.02)


def test_a_white_metal_ball_vanishes_in_a_room_of_even_light(lit_room):
    """Three columns, no square of an order: of radiance 1, 2 and 3 on all surfaces."""
    bake = lit_room
    points = bake.kept.points
    rows = rows_of_even_light(bake, [1.0, 2.0, 3.0])
    assert rows.shape == (len(points), len(bake.surfaces.functions), 3, 1)
    for degrees in (0.0, 40.0, 60.0):
        local, _ = views_of(bake, np.radians(degrees))
        seen = np.sum(hemisphere_values(tuple(bake.surfaces.functions), local)[:, :, None] * rows[..., 0], axis=1)
        np.testing.assert_allclose(seen, np.tile([1.0, 2.0, 3.0], (len(seen), 1)), rtol=0.02)


def test_zones_see_their_own_lights():
    """A zone's rows and diffuse row are those of one zone with the same lights, wherever lights did not merge."""
    one = until_encoding(room_with_ball(8), cloud_lights=8, zone_receivers=0, gather_directions=64)
    many = until_encoding(room_with_ball(8), cloud_lights=8, zone_receivers=300, gather_directions=64)
    assert many.kept.cloud.zones > 2 > one.kept.cloud.zones
    np.testing.assert_allclose(many.kept.rows, one.kept.rows, atol=1e-6 * np.abs(one.kept.rows).max())
    merged = until_encoding(room_with_ball(8), cloud_lights=8, zone_receivers=300, gather_directions=64,
                            merge_response=0.5, merge_distance=10)
    cloud = merged.kept.cloud
    assert len(cloud.positions) < len(many.kept.cloud.positions)
    zone = merged.kept.zone[merged.kept.points]
    fewest = int(zone[np.argmin(np.diff(cloud.zone_starts)[zone])])
    mine, lights = np.flatnonzero(zone == fewest), len(cloud.lights_of(fewest))
    assert np.abs(merged.kept.rows[mine][:, :, :lights]).max(axis=(0, 1, 3)).min() > 0.0
    assert not merged.kept.rows[mine][:, :, lights:].any()
    # Merged lights are solved where they are, for both kinds of rows.
    assert (merged.kept.transfer[merged.kept.points[mine]][:, :lights] > 0.0).any(axis=(0, 2)).all()


def test_directed_emission_has_the_isotropic_part_first():
    plain = until_encoding(room_with_ball(4), cloud_lights=2, gather_directions=64, directions=256, cloud_emission=1)
    directed = until_encoding(room_with_ball(4), cloud_lights=2, gather_directions=64, directions=256, cloud_emission=2)
    assert directed.kept.rows.shape[2] == 4 * plain.kept.rows.shape[2]
    largest = np.abs(plain.kept.rows).max()
    # The series of bounces stops at bounce_error of the energy of all columns together.
    np.testing.assert_allclose(directed.kept.rows[:, :, ::4], plain.kept.rows, atol=1e-3 * largest)
    assert all(np.abs(directed.kept.rows[:, :, k::4]).max() > 0.01 * largest for k in (1, 2, 3))


def test_a_bake_ends_with_both_kinds_of_rows_and_a_joined_one_too():
    scene = room_with_ball(4)
    wanted = {"spacing": "0", "threads": "1", "gather_directions": "128", "directions": "256", "cloud_lights": "8",
              "error_receivers": "0", "compression_error": "0", "vectors": "16", "order": "3", "encoder": "static"}
    for lighting in ("local", "environment,local"):
        settings = make_settings("standard", wanted | {"lighting": lighting})
        ball = exhaust(bake(scene, settings)).objects["ball"]
        assert ball.bases.shape[2] == 1 + len(ball.functions) > 1
        columns = ball.lighting_basis
        assert columns.order == (0 if lighting == "local" else 3) and columns.cloud
        light = np.ones((ball.cloud.zones, columns.total, 3))
        light[:, :columns.distant] = 0.0
        seen = view_radiance(ball, light, ball.normals)
        assert seen.min() > 0.0  # black, where highlights get nothing from lamps


def test_highlights_are_measured_beside_columns_of_lamps():
    """Their error under distant light is that of a bake without lamps: the same rays, the same rows."""
    scene = room_with_ball(4)
    wanted = {"spacing": "0", "threads": "1", "gather_directions": "128", "directions": "256", "surface_columns": "16",
              "surface_patches": "64", "cloud_lights": "8", "error_receivers": "16", "error_paths": "1024",
              "compression_error": "0", "vectors": "16", "order": "3", "encoder": "static"}
    found = {}
    for lighting in ("environment", "environment,local"):
        settings = make_settings("standard", wanted | {"lighting": lighting})
        found[lighting] = exhaust(bake(scene, settings)).report["highlight_errors"]
    for name in ("sampling", "rows", "basis"):
        alone, beside = (found[lighting][name]["relative_rms"] for lighting in found)
        assert beside == pytest.approx(alone, rel=0.02, abs=1e-3), name


@pytest.mark.parametrize(("material", "rows", "limit"), [
    (replace(METAL, roughness=0.5), 16, 0.04), (replace(METAL, roughness=0.8), 9, 0.03),
    (replace(METAL, roughness=0.5, anisotropic=0.5, anisotropic_rotation=0.1), 16, 0.06),
    (replace(METAL, roughness=0.3), 16, 0.1)])
def test_a_lamps_kernel_is_the_best_fit_of_ggx(material, rows, limit):
    """Against least squares over views of the true highlight of each of many lamps: relative RMS over lamps and views,
    and the energy of all lamps together."""
    functions = hemisphere.functions_of(rows)
    views, of_view = rule(24, 40)
    lights, of_light = rule(12, 16)
    true = TrueHighlight(material).evaluate(np.repeat(views, len(lights), 0), np.tile(lights, (len(views), 1)))
    true = true[:, 0].reshape(len(views), len(lights))
    values = hemisphere.evaluate(functions, views)
    root = np.sqrt(of_view)[:, None]
    best = values @ np.linalg.lstsq(values * root, true * root, rcond=1e-4)[0]
    kernel = lamp_kernel(reflection_of_material(material, INCIDENT_ORDER), functions, window=False)[:, :, 0]
    found = values @ kernel @ (evaluate(LAMP_ORDER, lights) * lights[:, 2:] / np.pi).T
    weight = of_view[:, None] * views[:, 2:] * of_light
    assert np.sqrt(np.sum((found - best) ** 2 * weight)) < limit * np.sqrt(np.sum(true ** 2 * weight))
    assert np.sum(found * weight) == pytest.approx(np.sum(true * weight), rel=0.03)


def test_only_a_lobe_that_rings_is_windowed():
    """The rows' fit of a lamp's highlight, as it is drawn: no dark rings deeper than a twentieth of its peak."""
    functions = hemisphere.functions_of(16)
    lamps, _ = rule(20, 24)
    values = evaluate(LAMP_ORDER, lamps) * lamps[:, 2:]
    views = np.array([[np.sin(a), 0.0, np.cos(a)] for a in np.radians([0.0, 30.0])])

    def deepest(roughness, window):
        reflection = reflection_of_material(replace(METAL, roughness=roughness), INCIDENT_ORDER)
        seen = hemisphere.evaluate(functions, views) @ lamp_kernel(reflection, functions, window)[:, :, 0] @ values.T
        return np.min(seen.min(axis=1) / seen.max(axis=1)), seen

    assert deepest(0.3, False)[0] < -0.1
    assert deepest(0.3, True)[0] > -0.06
    np.testing.assert_array_equal(deepest(0.5, True)[1], deepest(0.5, False)[1])


def rule(heights, azimuths):
    """Directions over the upper hemisphere and their solid angles."""
    z, weights = hemisphere.heights(heights)
    turn = 2 * np.pi * (np.arange(azimuths) + 0.5) / azimuths
    radius = np.sqrt(1 - z * z)
    directions = np.stack([np.outer(radius, np.cos(turn)), np.outer(radius, np.sin(turn)),
                           np.repeat(z[:, None], azimuths, axis=1)], axis=-1).reshape(-1, 3)
    return directions, np.repeat(weights * 2 * np.pi / azimuths, azimuths)


def test_the_cosines_product_with_harmonics():
    directions, _ = rule(6, 7)
    expected = directions[:, 2:] * evaluate(5, directions)
    np.testing.assert_allclose(evaluate(6, directions) @ cosine_product(5).T, expected, atol=1e-12)


@dataclass
class Ball:
    """What direct light reads of a bake: a metal sphere with given frames."""

    lamp_surfaces: LampSurfaces
    positions: np.ndarray
    normals: np.ndarray
    tangents: np.ndarray
    albedo: np.ndarray
    bases: np.ndarray
    triangles: np.ndarray
    faces: None = None


def ball_of(material, functions, albedo=0.0):
    mesh = sphere(subdivisions=3)
    normals = (mesh.positions / np.linalg.norm(mesh.positions, axis=1, keepdims=True)).astype(np.float32)
    kernel = lamp_kernel(reflection_of_material(material, INCIDENT_ORDER), functions)
    surfaces = LampSurfaces(np.zeros(len(normals), np.int32), kernel[None].astype(np.float32),
                            np.float32([0.75]), np.float32([np.linspace(0.0, 0.1, len(functions))]))
    tangents = smooth_tangents(normals.astype(np.float64)).astype(np.float32)
    return mesh, Ball(surfaces, mesh.positions.astype(np.float32), normals, tangents,
                      np.full((len(normals), 3), albedo, np.float32), np.zeros((1, 1, 1 + len(functions), 1, 1)),
                      mesh.triangles)


def lamp_at(position, power=(400.0, 200.0, 100.0), **options):
    matrix = np.eye(4)
    matrix[:3, 3] = position
    return LocalLight("lamp", "point", matrix, np.array(power), **options)


def test_a_far_lamp_is_a_sun_in_its_direction():
    """Its rows against the distant transfer of the same ball under `analytic.sun`: what both draw agrees up to the
    order of the sun's light."""
    mesh = replace(sphere("ball", subdivisions=3, albedo=(0, 0, 0)), materials=(replace(METAL, roughness=0.7),))
    scene = SceneMesh.assemble([mesh])
    options = {"spacing": "0", "threads": "1", "order": "7", "directions": "1024", "error_receivers": "0",
               "vectors": "24", "compression_error": "0", "clusters": "32", "encoder": "static",
               "lighting": "environment,local", "glossy_window": "false", "cloud_lights": "1"}
    ball = exhaust(bake(scene, make_settings("standard", options))).objects["ball"]
    towards, distance = np.array([0.3, -0.5, 0.8]) / np.linalg.norm([0.3, -0.5, 0.8]), 300.0
    lamp = lamp_at(distance * towards)
    irradiance = lamp.peak_intensity / distance ** 2
    light = np.zeros((ball.cloud.zones, ball.lighting_basis.total, 3))
    light[:, :49] = sun(towards, irradiance, 0.0, 7)
    tracer = Tracer(scene.points, scene.triangles, 1)
    direct = DirectLight(tracer, ball).of([lamp])
    views = ball.normals + 0.5 * ball.tangents
    expected = view_radiance(ball, light, views)
    found = view_radiance(ball, 0 * light, views, direct)
    lit = ball.normals @ towards > 0.1  # the sun of seven bands shines a little around the edge
    assert expected[lit].mean() > 0.0
    assert np.sqrt(np.mean((found - expected)[lit] ** 2)) < 0.03 * np.sqrt(np.mean(expected[lit] ** 2))


@pytest.mark.parametrize("kind", ["point", "wide"])
def test_direct_rows_against_ggx(kind):
    """A near lamp with a shadow, coloured, in all rows: radiance against the true highlight fitted over views."""
    material, functions = replace(METAL, roughness=0.6), hemisphere.functions_of(16)
    mesh, ball = ball_of(material, functions, albedo=0.5)
    screen = plane("screen", size=1.0, height=1.5, centre=(0.9, 0.0))
    scene = SceneMesh.assemble([mesh, screen])
    lamp = lamp_at((0.4, 0.6, 2.5), radius=0.2 if kind == "wide" else 0.0)
    tracer = Tracer(scene.points, scene.triangles, 1)
    rows = DirectLight(tracer, ball).of([lamp])
    receivers = LitReceivers.of_mesh(tracer, ball.positions, ball.normals, ball.triangles)
    light = direct_local_light(tracer, receivers, [lamp])
    np.testing.assert_allclose(rows[:, 0], 0.75 * light, rtol=1e-6)
    assert 0.1 < (light[:, 0] > 0.0).mean() < 0.6
    dimmed = ball.lamp_surfaces.dimming[0][None, :, None] * (0.5 * light)[:, None, :]
    highlight = rows[:, 1:] - dimmed
    assert not highlight[~light.any(axis=1)].any()
    frames = np.stack([ball.tangents, np.cross(ball.normals, ball.tangents), ball.normals], axis=1)
    lit = np.flatnonzero(light[:, 0] > 0.1 * light.max())
    local = unit(np.einsum("pij,pj->pi", frames[lit], lamp.position - ball.positions[lit]))
    views, of_view = rule(16, 24)
    true = TrueHighlight(material).evaluate(np.repeat(views, len(lit), 0), np.tile(local, (len(views), 1)))
    true = true[:, 0].reshape(len(views), len(lit)) * np.pi / local[:, 2]
    values, root = hemisphere.evaluate(functions, views), np.sqrt(of_view)[:, None]
    best = values @ np.linalg.lstsq(values * root, true * root, rcond=1e-4)[0]
    for channel in range(3):
        found = values @ highlight[lit, :, channel].T
        expected = best * light[lit, channel]
        weight = of_view[:, None] * views[:, 2:]
        error = np.sqrt(np.sum((found - expected) ** 2 * weight) / np.sum(expected ** 2 * weight))
        assert error < 0.05


@pytest.mark.parametrize(("size", "limit"), [(0.3, 0.04), (1.5, 0.08)])
def test_a_near_area_light_shines_from_all_of_its_face(size, limit):
    """A square 1 m above a metal floor, against many small lamps in its place; turned by 29 degrees, so that the floor
    sees it from the side, too, and the larger one comes as near as 0.64 m."""
    functions = hemisphere.functions_of(16)
    floor = plane(size=4.0, cells=40)
    kernel = lamp_kernel(reflection_of_material(replace(METAL, roughness=0.4), INCIDENT_ORDER), functions)
    count = len(floor.positions)
    surfaces = LampSurfaces(np.zeros(count, np.int32), kernel[None].astype(np.float32), np.ones(1, np.float32),
                            np.zeros((1, 16), np.float32))
    up, along = np.tile(np.float32([0, 0, 1]), (count, 1)), np.tile(np.float32([1, 0, 0]), (count, 1))
    ball = Ball(surfaces, floor.positions.astype(np.float32), up, along, np.zeros((count, 3), np.float32),
                np.zeros((1, 1, 17, 1, 1)), floor.triangles)
    matrix = np.eye(4)
    matrix[:3, :3] = [[np.cos(0.5), 0, np.sin(0.5)], [0, 1, 0], [-np.sin(0.5), 0, np.cos(0.5)]]
    matrix[:3, 3] = (0, 0, 1.0)
    whole = LocalLight("area", "area", matrix, np.full(3, 10.0), size=(size, size))
    scene = SceneMesh.assemble([floor])
    direct = DirectLight(Tracer(scene.points, scene.triangles, 1), ball)
    found = direct.of([whole])
    parts, line = [], ((np.arange(12) + 0.5) / 12 - 0.5) * size
    for x in line:
        for y in line:
            moved = matrix.copy()
            moved[:3, 3] += matrix[:3, :3] @ (x, y, 0)
            parts.append(LocalLight("part", "area", moved, np.full(3, 10.0 / 144), size=(1e-3, 1e-3)))
    expected = direct.of(parts)
    root = np.linalg.cholesky(hemisphere.gram_matrix(functions)).T
    error, size_of = (np.sqrt(np.mean((root @ rows[:, 1:, 0].T) ** 2)) for rows in (found - expected, expected))
    assert error < limit * size_of


def test_two_lamps_add_up_and_a_broken_store_is_refused():
    _, ball = ball_of(METAL, hemisphere.functions_of(9))
    tracer = Tracer(*(lambda s: (s.points, s.triangles))(SceneMesh.assemble([sphere(subdivisions=3)])), 1)
    direct = DirectLight(tracer, ball)
    first, second = lamp_at((0.0, 0.0, 3.0)), lamp_at((2.0, 0.0, 1.0), (10.0, 20.0, 40.0))
    np.testing.assert_allclose(direct.of([first, second]), direct.of([first]) + direct.of([second]), atol=1e-5)
    surfaces = ball.lamp_surfaces
    header = {"shape": [1, 1, 10, 1, 1], ENTRY: lamp_surfaces_entry(surfaces)}
    stored = header, surfaces.material, surfaces.kernels.ravel()
    read = read_lamp_surfaces(*stored, len(surfaces.material), "ball", "bake again")
    for name, value in vars(surfaces).items():
        np.testing.assert_array_equal(getattr(read, name), value)
    assert read_lamp_surfaces({"shape": header["shape"]}, None, None, 5, "ball", "bake again") is None
    broken = [(header, None, stored[2]), (header, stored[1], stored[2][:-1]), (header, stored[1] + 1, stored[2]),
              (header, stored[1], np.full_like(stored[2], np.nan)), (header, stored[1], None),
              ({**header, ENTRY: "?"}, *stored[1:]), ({**header, "shape": [1, 1, 5, 1, 1]}, *stored[1:])]
    for parts in broken:
        with pytest.raises(StorageError, match="lamps"):
            read_lamp_surfaces(*parts, len(surfaces.material), "ball", "bake again")


def test_the_job_folder_carries_what_lamps_need(tmp_path):
    scene = room_with_ball(2)
    options = {"lighting": "local", "spacing": "0", "threads": "1", "gather_directions": "64", "directions": "64",
               "cloud_lights": "2", "vectors": "2", "encoder": "static"}
    folder = write_job(tmp_path, scene, make_settings("draft", options))
    drain(run_job(folder))
    result = read_result(folder)
    ball, room = result.objects["ball"], result.objects["room"]
    assert room.lamp_surfaces is None and ball.lamp_surfaces.kernels.any()
    assert ball.material.shape == ball.cluster.shape and ball.kernels.shape[1] == len(ball.functions)
    assert ball.header[ENTRY]["shape"] == list(ball.kernels.shape)
