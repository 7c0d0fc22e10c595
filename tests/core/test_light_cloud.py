# SPDX-License-Identifier: GPL-3.0-or-later
"""Zones, where the lights of a cloud lie, and how lamps are interpolated between them."""

from __future__ import annotations

import numpy as np
import pytest

from prt_addon.errors import BadArguments, BadScene
from prt_addon.lighting import light_interpolation
from prt_addon.lighting.light_cloud import LightCloud, box_matrix, free_space, place_lights
from prt_addon.lighting.light_fading import FadingWeights
from prt_addon.lighting.light_interpolation import OUTSIDE, CloudInterpolator
from prt_addon.lighting.light_visibility import surroundings, visible_between
from prt_addon.lighting.zones import split_zones
from prt_addon.tracing.tracer import Tracer
from tests.core.shapes import box, join, make, plane, sphere

UNIT = box_matrix((0, 0, 0), (1, 1, 1))


def tracer_of(*meshes):
    mesh = join("all", *meshes)
    return Tracer(mesh.positions, mesh.triangles, 1)


def grid(cells, low=0.0, high=1.0):
    line = low + (np.arange(cells) + 0.5) / cells * (high - low)
    return np.stack(np.meshgrid(line, line, line, indexing="ij"), axis=-1).reshape(-1, 3)


def cloud_of(*zones, spacing=0.25, dense=None, **options):
    return LightCloud.of_zones(zones, np.concatenate(zones) if dense is None else dense, spacing, **options)


ROOM = tracer_of(box(inward=True))
OPEN = Tracer(np.zeros((0, 3)), np.zeros((0, 3), np.int32), 1)


# Zones

def test_zones_are_boxes_that_hold_their_receivers_and_no_more_than_allowed():
    positions = np.random.default_rng(1).normal(size=(5000, 3)) * [4, 1, 0.3]
    zones = split_zones(positions, 300)
    members = zones.members()
    assert [len(m) for m in members] == np.bincount(zones.zone, minlength=len(zones)).tolist()
    assert max(map(len, members)) <= 300 and min(map(len, members)) > 0
    for number, own in enumerate(members):
        low, high = zones.boxes[number]
        assert (positions[own] >= low).all() and (positions[own] <= high).all()
        others = np.delete(np.arange(5000), own)
        assert not ((positions[others] > low) & (positions[others] < high)).all(axis=1).any()
    volumes = np.prod(zones.boxes[:, 1] - zones.boxes[:, 0], axis=1)
    ratios = np.log2(np.prod(np.ptp(positions, axis=0)) / volumes)
    assert np.allclose(ratios, ratios.round())


def test_zones_split_the_longest_axis_at_its_middle():
    zones = split_zones(np.array([[0, 0, 0], [1, 0, 0], [2, 0, 0], [4, 1, 1.0]]), 3)
    assert zones.zone.tolist() == [0, 0, 1, 1]  # one on the plane belongs above
    assert zones.boxes.tolist() == [[[0, 0, 0], [2, 1, 1]], [[2, 0, 0], [4, 1, 1]]]


def test_zones_end_where_receivers_coincide_or_boxes_get_small():
    same = np.repeat([[1.0, 2, 3], [1, 2, 3 + 1e-9], [5, 5, 5]], 10, axis=0)
    assert np.bincount(split_zones(same, 2).zone).tolist() == [10, 10, 10]
    assert len(split_zones(same, 2, smallest_extent=1e-3)) == 2
    assert len(split_zones(np.zeros((0, 3)), 5)) == 0 and len(split_zones(same, 30)) == 1
    with pytest.raises(ValueError, match="finite"):
        split_zones(np.array([[np.nan, 0, 0]]), 1)


# What surrounds a place

def test_visibility_between_places():
    tracer = tracer_of(box(low=(0.5, -9, -9), high=(0.51, 9, 9)))
    rng = np.random.default_rng(2)
    starts, ends = rng.uniform(-1, 2, (2, 2000, 3))
    blocked = (np.minimum(starts[:, 0], ends[:, 0]) < 0.51) & (np.maximum(starts[:, 0], ends[:, 0]) > 0.5)
    assert np.array_equal(visible_between(tracer, starts, ends), ~blocked)
    touching = np.array([[0.5, 0.0, 0], [0.5, 0, 0], [0.2, 0, 0], [0.2, 0, 0]])
    seen = visible_between(tracer, touching, np.array([[0.0, 1, 0], [1, 0, 0], [0.5, 0, 0], [0.2, 0, 0]]))
    assert seen.tolist() == [True, False, True, True]


@pytest.mark.parametrize("scale", [1e-5, 1.0, 1e5])
def test_inside_and_clearance(scale):
    ball = sphere(radius=0.2 * scale, centre=(0.5 * scale,) * 3, subdivisions=3)
    tracer = tracer_of(box(high=(scale,) * 3, inward=True), ball)
    places = grid(9) * scale
    found = surroundings(tracer, places)
    distance = np.sqrt(np.sum((places - 0.5 * scale) ** 2, axis=1))
    sure = np.abs(distance - 0.2 * scale) > 0.01 * scale
    assert np.array_equal(found.inside[sure], distance[sure] < 0.2 * scale)
    wall = np.minimum(places, scale - places).min(axis=1)
    true = np.minimum(wall, np.abs(distance - 0.2 * scale))
    assert np.all(found.clearance > 0.85 * true) and np.all(found.clearance < 1.25 * true)


def test_open_meshes_have_an_inside_only_where_they_nearly_close():
    ball = sphere(subdivisions=3)
    centres = ball.positions[ball.triangles].mean(axis=1)
    holed = make("holed", ball.positions, ball.triangles[centres[:, 2] < 0.7])
    assert surroundings(tracer_of(holed), np.array([[0, 0, -0.2], [0, 0, 1.5]])).inside.tolist() == [True, False]
    floor = tracer_of(plane(size=100))
    tilt = np.array([[0.8, 0, 0.6], [0, 1, 0], [-0.6, 0, 0.8]])
    tilted = plane(size=100)
    tilted = Tracer(tilted.positions @ tilt.T, tilted.triangles, 1)
    below = np.random.default_rng(0).uniform(-1, 1, (200, 3))
    below[:, 2] = -np.abs(below[:, 2]) - 0.01
    assert not surroundings(floor, below).inside.any()
    assert not surroundings(tilted, below @ tilt.T).inside.any()


def test_bodies_that_cross_are_solid():
    tracer = tracer_of(box(high=(2, 1, 1)), box(low=(0.9, -1, 0.2), high=(1.1, 2, 0.8)))
    places = np.random.default_rng(3).uniform((-1, -2, -1), (3, 3, 2), (500, 3))
    first = ((places > (0, 0, 0)) & (places < (2, 1, 1))).all(axis=1)
    second = ((places > (0.9, -1, 0.2)) & (places < (1.1, 2, 0.8))).all(axis=1)
    assert np.mean(surroundings(tracer, places).inside != (first | second)) < 0.01


# Where lights lie

@pytest.mark.parametrize("count", [1, 8, 64, 216, 1000, 4096])
def test_a_cube_takes_its_cubic_numbers_of_lights(count):
    placed = place_lights(ROOM, [UNIT], count=count)
    side = round(count ** (1 / 3))
    assert np.allclose(np.unique(placed.positions.round(9)), (np.arange(side) + 0.5) / side)
    assert len(placed) == count and placed.spacing == pytest.approx(1 / side)


@pytest.mark.parametrize("count", [2, 5, 7, 50, 200, 700, 3000])
def test_other_counts_are_met_from_below(count):
    tracer = tracer_of(box(high=(3, 2, 1), inward=True), sphere(radius=0.3, centre=(1, 1, 0.5), subdivisions=2))
    placed = place_lights(tracer, [box_matrix((0, 0, 0), (3, 2, 1))], count=count)
    assert 0.5 * count <= len(placed) <= count
    assert len(np.unique(placed.positions, axis=0)) == len(placed)


def test_lights_keep_out_of_bodies_and_clear_of_surfaces():
    tracer = tracer_of(box(inward=True), box(low=(0.3, 0.3, 0), high=(0.7, 0.7, 0.6)))
    placed = place_lights(tracer, [UNIT], spacing=0.0625)
    within = ((placed.positions > (0.3, 0.3, 0)) & (placed.positions < (0.7, 0.7, 0.6))).all(axis=1)
    assert not within.any() and placed.inside == 6 * 6 * 10 and len(placed) == 4096 - placed.inside - placed.near
    clear = place_lights(tracer, [UNIT], spacing=0.0625, clearance=0.12)
    assert clear.near > 0 and clear.positions.min() >= 0.12 and clear.positions.max() <= 0.88
    assert len(place_lights(tracer, [UNIT], spacing=0.0625, radius=0.12)) == len(clear)


def test_regions_are_turned_boxes_and_meshes_and_do_not_double_lights():
    turned = np.eye(4)
    turned[:3, :3] = np.array([[0.6, -0.8, 0], [0.8, 0.6, 0], [0, 0, -1]]) * (1.0, 0.5, 0.25)
    turned[:3, 3] = (5, 6, 7)
    placed = place_lights(OPEN, [turned], spacing=0.25)
    local = (placed.positions - (5, 6, 7)) @ np.linalg.inv(turned[:3, :3]).T
    assert len(placed) == 8 * 4 * 2 and np.abs(local).max() < 1.0 and placed.spacing == pytest.approx(0.25)
    twice = place_lights(OPEN, [UNIT, [[0.5, 0, 0], [1.5, 1, 1]]], spacing=0.25)
    assert len(twice) == 64 + 32 and len(np.unique(twice.positions.round(6), axis=0)) == 96
    ball = sphere(radius=1.0, subdivisions=3)
    inside = place_lights(OPEN, [], spacing=0.2, volumes=[(ball.positions, ball.triangles)])
    radii = np.sqrt(np.sum(inside.positions ** 2, axis=1))
    assert radii.max() < 1.0 and len(inside) == pytest.approx(4 / 3 * np.pi / 0.2 ** 3, rel=0.1)
    flat = place_lights(OPEN, [[[0, 0, 1], [1, 1, 1]]], count=25)
    assert len(flat) == 25 and set(flat.positions[:, 2]) == {1.0}


def test_a_room_wound_outwards_is_no_solid():
    placed = place_lights(tracer_of(box()), [UNIT], count=27)
    assert len(placed) == 27 and "outwards" in placed.warnings[0]
    assert not place_lights(ROOM, [UNIT], count=27).warnings


def test_free_space_of_a_floor_lies_about_it():
    floor = plane(size=10)
    placed = place_lights(tracer_of(floor), [free_space(floor.positions)], count=100)
    assert len(placed) > 50 and placed.positions[:, 2].max() > 0.1
    assert np.allclose(free_space(box().positions), UNIT)


def test_what_can_not_be_placed():
    solid = tracer_of(box(low=(-1, -1, -1), high=(2, 2, 2)), box(low=(-9, -9, -9), high=(9, 9, 9), inward=True))
    with pytest.raises(BadScene, match="no light fits"):
        place_lights(tracer_of(box(inward=True)), [UNIT], spacing=1.0, clearance=0.6)
    with pytest.raises(BadArguments, match="spacing of"):
        place_lights(ROOM, [UNIT], spacing=0.05)
    with pytest.raises(BadArguments, match="spacing of"):
        place_lights(ROOM, [UNIT], spacing=1e-30)
    for arguments in ({"count": 0}, {"count": 5000}, {"spacing": -1.0}, {"spacing": np.nan}):
        with pytest.raises(BadArguments):
            place_lights(ROOM, [UNIT], **arguments)
    with pytest.raises(BadArguments, match="no region"):
        place_lights(ROOM, [], count=5)
    with pytest.raises(BadArguments, match="finite"):
        place_lights(ROOM, [np.full((4, 4), np.inf)], count=5)
    assert place_lights(solid, [UNIT, [[3, 3, 3], [4, 4, 4]]], spacing=0.5).inside == 8


def test_columns_of_a_cloud():
    cloud = cloud_of(grid(2), grid(3), np.zeros((0, 3)), emission_order=2)
    assert cloud.zones == 3 and cloud.columns == 27 * 4 and cloud.columns_of(1, 26) == slice(104, 108)
    assert np.array_equal(cloud.lights_of(1), grid(3)) and len(cloud.lights_of(2)) == 0
    with pytest.raises(IndexError):
        cloud.columns_of(0, 8)


# Interpolation

def test_linear_responses_are_nearly_exact_between_lights(monkeypatch):
    lights = grid(5)
    lights = lights + np.random.default_rng(4).uniform(-0.03, 0.03, lights.shape)
    positions = np.random.default_rng(5).uniform(0.2, 0.8, (300, 3))

    def error(*options):
        found = CloudInterpolator(cloud_of(lights), ROOM, *options).weights(positions)
        assert np.allclose(found.weights.sum(axis=2), 1.0) and not found.outside.any() and not found.unlit.any()
        return np.sqrt(np.mean((found.weights[:, 0] @ lights - positions) ** 2))

    assert error() < 0.2 * error(8, "published")
    monkeypatch.setattr(light_interpolation, "RIDGE", 1e-7)
    assert error() < 1e-6


def test_published_weights_are_the_papers():
    lights = np.random.default_rng(6).uniform(0, 1, (60, 3))
    positions = np.random.default_rng(7).uniform(0, 1, (40, 3))
    weights = CloudInterpolator(cloud_of(lights), ROOM, 8, "published").weights(positions).weights[:, 0]
    for position, own in zip(positions, weights, strict=True):
        distance = np.sqrt(np.sum((lights - position) ** 2, axis=1))
        nearest = np.argsort(distance)[:8]
        expected = np.zeros(60)
        expected[nearest] = (1 - distance[nearest] / distance[nearest[-1]]) ** 4
        assert np.allclose(own, expected / expected.sum(), atol=1e-12)


@pytest.mark.parametrize("interpolation", ["linear", "published"])
def test_zones_answer_as_each_alone(interpolation):
    rng = np.random.default_rng(8)
    zones = [rng.uniform(0, 1, (n, 3)) for n in (1, 2, 7, 100, 33)]
    positions = rng.uniform(0, 1, (9, 3))
    found = CloudInterpolator(cloud_of(*zones), ROOM, 12, interpolation).weights(positions)
    for number, zone in enumerate(zones):
        alone = CloudInterpolator(cloud_of(zone), ROOM, 12, interpolation).weights(positions)
        assert np.allclose(found.weights[:, number, :len(zone)], alone.weights[:, 0], atol=1e-9)
        assert not found.weights[:, number, len(zone):].any()


@pytest.mark.parametrize("interpolation", ["linear", "published"])
@pytest.mark.parametrize("lights", [
    grid(1), np.repeat(grid(1), 2, axis=0), grid(2), grid(3), np.array([[0.2, 0.5, 0.5], [0.8, 0.5, 0.5]]),
    np.array([[0.2, 0.5, 0.5], [0.2, 0.5, 0.5], [0.8, 0.5, 0.5]]), grid(3)[grid(3)[:, 2] < 0.3],
])
def test_degenerate_clouds_give_sound_weights(interpolation, lights):
    rng = np.random.default_rng(9)
    positions = np.concatenate([lights, [[0.5, 0.5, 0.5], [0, 0, 0]], rng.uniform(0, 1, (50, 3)),
                                rng.uniform(-1e18, 1e18, (5, 3))])
    found = CloudInterpolator(cloud_of(lights), OPEN, 12, interpolation).weights(positions)
    assert np.isfinite(found.weights).all() and np.allclose(found.weights.sum(axis=2), 1.0)
    assert np.minimum(found.weights, 0).sum(axis=2).min() >= -0.5 - 1e-9
    equal = found.weights[len(lights)]  # at the centre
    if len(lights) in (1, 8) or (len(lights) == 2 and interpolation == "linear"):
        assert np.allclose(equal, 1 / len(lights))
    assert found.outside[-5:].all()


def test_a_lamp_at_a_light_is_that_light_and_between_two_their_mixture():
    lights = np.array([[0.2, 0.5, 0.5], [0.8, 0.5, 0.5]])
    weights = CloudInterpolator(cloud_of(lights, spacing=0.6), ROOM).weights(
        [[0.2, 0.5, 0.5], [0.5, 0.5, 0.5], [0.35, 0.5, 0.5]]).weights[:, 0]
    assert np.allclose(weights, [[1, 0], [0.5, 0.5], [0.75, 0.25]], atol=0.07)


def test_nothing_leaks_through_a_thin_wall():
    tracer = tracer_of(box(inward=True), box(low=(0.499, 0, 0), high=(0.501, 1, 1)))
    lights = grid(6)
    for interpolation in ("linear", "published"):
        interpolator = CloudInterpolator(cloud_of(lights, spacing=1 / 6), tracer, 12, interpolation)
        found = interpolator.weights([[0.49, 0.4, 0.6], [0.51, 0.4, 0.6], [0.5, 0.4, 0.6]])
        left = lights[:, 0] < 0.5
        assert not found.weights[0, 0, ~left].any() and not found.weights[1, 0, left].any()
        assert np.allclose(found.weights[:2].sum(axis=2), 1.0) and not found.unlit[:2].any()
        assert found.unlit[2].all() and found.outside[2] and not found.weights[2].any()  # inside the wall


def test_lamps_outside_the_cloud_are_flagged():
    interpolator = CloudInterpolator(cloud_of(grid(4), spacing=0.25), OPEN)
    positions = np.array([[0.875 + far * 0.25, 0.875, 0.875] for far in (0, 0.9 * OUTSIDE, 1.1 * OUTSIDE, 1e9)])
    assert interpolator.weights(positions).outside.tolist() == [False, False, True, True]
    assert not interpolator.weights(np.random.default_rng(1).uniform(0, 1, (500, 3))).outside.any()
    for bad in (np.nan, np.inf):
        with pytest.raises(ValueError, match="finite"):
            interpolator.weights([bad, 0, 0])


def test_an_empty_cloud_and_no_lamps():
    found = CloudInterpolator(cloud_of(np.zeros((0, 3)), np.zeros((0, 3))), OPEN).weights([[0, 0, 0]])
    assert found.weights.shape == (1, 2, 0) and found.unlit.all() and found.outside.all()
    interpolator = CloudInterpolator(cloud_of(grid(2), grid(3)), OPEN)
    none = interpolator.weights(np.zeros((0, 3)))
    assert none.weights.shape == (0, 2, 27) and none.light(np.zeros((0, 1, 3))).shape == (2, 27, 3)
    stepped = FadingWeights(interpolator).step(0.1, [], np.zeros((0, 3)))
    assert stepped.weights.shape == (0, 2, 27)


@pytest.mark.parametrize("lights", [grid(5), np.random.default_rng(11).uniform(0, 1, (60, 3))])
def test_weights_move_without_jumps(lights):
    interpolator = CloudInterpolator(cloud_of(lights), OPEN)
    start, end = np.array([0.02, 0.11, 0.5]), np.array([0.97, 0.83, 0.5])

    def largest_change(steps):
        path = start + np.linspace(0, 1, steps)[:, None] * (end - start)
        return np.abs(np.diff(interpolator.weights(path).weights, axis=0)).max()

    coarse, fine = largest_change(2001), largest_change(20001)
    assert fine < 0.15 * coarse  # a tenth of the step, about a tenth of the change; a jump would stay


def test_light_adds_lamps_in_the_order_of_columns():
    cloud = cloud_of(grid(2), grid(3), emission_order=2)
    rng = np.random.default_rng(12)
    found = CloudInterpolator(cloud, ROOM).weights(rng.uniform(0, 1, (3, 3)))
    emission = rng.normal(size=(3, 4, 3))
    light = found.light(emission)
    assert light.shape == (2, cloud.columns, 3) and light.dtype == np.float32
    for zone, number in ((0, 5), (1, 20)):
        expected = np.einsum("n,nkc->kc", found.weights[:, zone, number], emission)
        assert np.allclose(light[zone, cloud.columns_of(zone, number)], expected, atol=1e-6)
    for power in (1e-6, 1e9):
        assert np.allclose(found.light(power * emission), power * light, rtol=1e-5, atol=1e-6 * power)


# Fading

def door_scene():
    """A wall across the room with a door, and a cloud on both sides."""
    wall = join("wall", box(low=(0.49, 0, 0), high=(0.51, 0.35, 1)), box(low=(0.49, 0.65, 0), high=(0.51, 1, 1)))
    tracer = tracer_of(box(inward=True), wall)
    lights = grid(6)
    return CloudInterpolator(cloud_of(lights, lights[::3], spacing=1 / 6, dense=lights), tracer)


def test_fading_takes_the_jumps_out_of_a_walk_through_a_door():
    interpolator = door_scene()
    path = np.stack([np.full(121, 0.47), np.linspace(0.1, 0.6, 121), np.full(121, 0.5)], axis=1)  # 2 s at 60 Hz
    plain = interpolator.weights(path)
    fading = FadingWeights(interpolator, 0.5)
    faded = np.stack([fading.step(1 / 60, ["lamp"], place[None]).weights[0] for place in path])
    jump, faded_jump = (np.abs(np.diff(w, axis=0)).sum(axis=2).max() for w in (plain.weights, faded))
    assert jump > 0.5 and faded_jump < 0.2 * jump
    assert np.allclose(faded.sum(axis=2), 1.0)
    for _ in range(31):
        last = fading.step(1 / 60, ["lamp"], path[-1:])
    assert fading.settled and np.allclose(last.weights[0], plain.weights[-1], atol=1e-6)


def test_fading_ends_in_the_dark_and_starts_without_delay():
    tracer = tracer_of(box(inward=True), box(low=(0.4, 0.4, 0.4), high=(0.6, 0.6, 0.6)))
    lights = grid(6)[::2]
    lights = lights[(np.abs(lights - 0.5) > 0.1).any(axis=1)]
    interpolator = CloudInterpolator(cloud_of(lights, dense=grid(6), spacing=1 / 6), tracer, 100)
    fading = FadingWeights(interpolator, 1.0)
    outside, inside = np.array([[0.39, 0.5, 0.5]]), np.array([[0.41, 0.5, 0.5]])
    first = fading.step(0.0, ["a"], outside)
    assert np.allclose(first.weights, interpolator.weights(outside).weights, atol=1e-6) and fading.settled
    sums = [fading.step(0.125, ["a"], inside).weights.sum() for _ in range(9)]
    assert np.abs(np.diff([1.0, *sums])).max() < 0.13 and sums[-1] == 0.0 and fading.settled
    assert fading.step(0.1, ["b"], outside).weights.sum() == pytest.approx(1.0)


def test_lamps_fade_for_themselves_and_are_forgotten():
    interpolator = door_scene()
    places = np.array([[0.45, 0.41, 0.5], [0.55, 0.41, 0.5]])
    both, alone = FadingWeights(interpolator), FadingWeights(interpolator)
    both.step(0.0, ["a", "b"], places)
    alone.step(0.0, ["b"], places[1:])
    moved = both.step(0.05, ["b", "a"], places)  # they change places
    single = alone.step(0.05, ["b"], places[:1])
    assert np.allclose(moved.weights[0], single.weights[0]) and not both.settled
    both.step(0.0, ["a"], places[1:])
    fresh = both.step(0.0, ["b", "a"], places)
    assert np.allclose(fresh.weights[0], interpolator.weights(places[0]).weights[0], atol=1e-6)
    instant = FadingWeights(interpolator, 0.0)
    for place in places:
        step = instant.step(0.01, ["a"], place[None])
        assert np.allclose(step.weights, interpolator.weights(place).weights, atol=1e-6)


def test_the_default_region_reaches_beyond_the_lamps():
    points = np.array([[0.0, 0.0, 0.0], [2.0, 2.0, 1.0]])
    plain, above = free_space(points), free_space(points, np.array([[1.0, 1.0, 1.4], [1.0, 1.0, 0.5], [900.0, 0, 0]]))
    assert np.allclose(plain[:3, 3] + plain[:3, :3].sum(axis=1), (2.0, 2.0, 1.0))
    assert np.allclose(above[:3, 3] + above[:3, :3].sum(axis=1), (2.0, 2.0, 1.4 + 0.05 * 3.0))
    assert np.allclose(above[:3, 3] - above[:3, :3].sum(axis=1), 0.0)
