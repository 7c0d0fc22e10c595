# SPDX-License-Identifier: GPL-3.0-or-later
"""Lamps near the scene: emission, point clusters, and the closed forms of irradiance, against brute-force sums."""

from __future__ import annotations

import math
import warnings

import numpy as np
import pytest

from prt_addon.basis.directions import random_rotation, spherical_fibonacci
from prt_addon.basis.point_sets import fibonacci_disc, fibonacci_square
from prt_addon.basis.spherical_harmonics import evaluate
from prt_addon.lighting.local_lights import LocalLight, spot_pattern, spread_factor, spread_pattern
from prt_addon.relighting.source_irradiance import cap_irradiance, polygon_irradiance

POWER = np.array([7.0, 3.0, 0.5])
SPHERE = spherical_fibonacci(200_000)
# No bound on negative values: the plain projection.
ANY = 1e9


def lamp(kind, scale=(1.0, 1.0, 1.0), turn=None, at=(0.3, -2.0, 1.0), power=POWER, **options):
    matrix = np.eye(4)
    matrix[:3, :3] = (random_rotation(3, 1) if turn is None else turn) * np.asarray(scale)
    matrix[:3, 3] = at
    return LocalLight(kind, kind, matrix, power, **options)


LAMPS = {
    "point": lamp("point", radius=0.2),
    "hard spot": lamp("spot", spot_angle=1.2, spot_blend=0.0),
    "soft spot": lamp("spot", spot_angle=1.2, spot_blend=0.4),
    "wide spot": lamp("spot", spot_angle=math.pi, spot_blend=1.0),
    "stretched spot": lamp("spot", (2.0, 0.5, 1.5), spot_angle=1.5, spot_blend=1.0),
    "mirrored spot": lamp("spot", (1.0, 1.0, -1.0), spot_angle=1.0, spot_blend=0.5),
    "area": lamp("area", (2.0, 0.5, 3.0), size=(1.5, 0.7)),
    "soft-box": lamp("area", spread=1.4, shape="ellipse"),
}


@pytest.fixture(autouse=True)
def loud():
    """Every warning and every invalid number is an error."""
    with np.errstate(all="raise", under="ignore"), warnings.catch_warnings():
        warnings.simplefilter("error")
        yield


@pytest.mark.parametrize(("angle", "blend"), [(0.1, 0.15), (1.0, 0.5), (math.pi, 1.0), (2.0, 1.0)])
def test_a_spot_goes_from_all_to_nothing_over_its_blend(angle, blend):
    edge = math.cos(angle / 2)
    inner = edge + blend * (1 - edge)
    cosines = np.linspace(edge, inner, 5)
    np.testing.assert_allclose(spot_pattern(cosines, angle, blend), [0, 0.15625, 0.5, 0.84375, 1], atol=1e-9)
    assert np.all(spot_pattern(np.array([-1.0, edge - 1e-9]), angle, blend) == 0.0)
    assert np.all(spot_pattern(np.array([inner + 1e-9, 1.0]), angle, blend) == 1.0)


def test_a_spot_without_blend_ends_at_its_angle():
    angles = np.array([0.0, 0.49, 0.4999, 0.5001, 1.0, 3.0])
    np.testing.assert_array_equal(spot_pattern(np.cos(angles), 1.0, 0.0), [1, 1, 1, 0, 0, 0])
    turned = lamp("spot", turn=np.eye(3), spot_angle=1.0)
    directions = np.stack([np.sin(angles), 0 * angles, -np.cos(angles)], axis=1) * [[3.0]]
    expected = np.outer([1, 1, 1, 0, 0, 0], POWER / (4 * math.pi))
    np.testing.assert_allclose(turned.intensity(directions), expected)


def test_a_stretched_spot_has_an_elliptic_cone():
    """A cone of half angle 45 degrees reaches 1 m aside at 1 m; scaled by 2 along x and 3 along z, 2 m at 3 m."""
    stretched = lamp("spot", (2.0, 1.0, 3.0), np.eye(3), spot_angle=math.pi / 2)
    inside = [[1.99, 0, -3], [0, 0.99, -3], [-1.99, 0, -3]]
    outside = [[2.01, 0, -3], [0, 1.01, -3], [0, 0, 3]]
    np.testing.assert_allclose(stretched.intensity(inside), np.tile(POWER / (4 * math.pi), (3, 1)))
    assert not np.any(stretched.intensity(outside))


@pytest.mark.parametrize("name", LAMPS)
def test_the_constant_of_the_emission_is_the_emitted_power(name):
    emitted = 4 * math.pi * LAMPS[name].intensity(SPHERE).mean(axis=0)
    for order in range(1, 5):
        for negative in (ANY, 0.05, 0.0):
            np.testing.assert_allclose(LAMPS[name].emission(order, negative)[0], emitted / (4 * math.pi), rtol=1e-3)


def test_point_and_area_emit_their_power():
    for name in ("point", "area", "soft-box"):
        np.testing.assert_allclose(LAMPS[name].emission(1)[0] * 4 * math.pi, POWER, rtol=1e-6)


@pytest.mark.parametrize("name", LAMPS)
def test_emission_is_the_projection_of_the_intensity(name):
    order = 5
    values = math.sqrt(4 * math.pi) * evaluate(order, SPHERE)
    expected = values.T @ LAMPS[name].intensity(SPHERE) / len(SPHERE)
    np.testing.assert_allclose(LAMPS[name].emission(order, ANY), expected, atol=1e-3 * expected.max())


def test_an_area_emits_a_cosine_lobe():
    """Funk-Hecke: coefficient k is 2 pi (integral of x P_l) y_k(axis) / sqrt(4 pi), with integrals 1/2, 1/3, 1/8, 0."""
    light = LAMPS["area"]
    bands = np.repeat([1 / 2, 1 / 3, 1 / 8, 0.0], [1, 3, 5, 7])
    lobe = math.sqrt(math.pi) * bands * evaluate(4, light.axis[None])[0]
    np.testing.assert_allclose(light.emission(4, ANY), np.outer(lobe, POWER / math.pi), atol=1e-6)


@pytest.mark.parametrize("name", LAMPS)
@pytest.mark.parametrize("negative", [0.05, 0.005])
def test_the_window_holds_the_pattern_above_its_bound(name, negative):
    light = LAMPS[name]
    values = math.sqrt(4 * math.pi) * evaluate(4, SPHERE[::10]) @ light.emission(4, negative)[:, 0]
    assert values.min() >= -1.05 * negative * light.peak_intensity[0]


@pytest.mark.parametrize("name", LAMPS)
def test_explained_energy_is_that_of_the_truncated_pattern(name):
    light = LAMPS[name]
    exact = light.intensity(SPHERE)[:, 0]
    for order, negative in ((1, 0.05), (4, ANY), (4, 0.02)):
        shown = math.sqrt(4 * math.pi) * evaluate(order, SPHERE) @ light.emission(order, negative)[:, 0]
        expected = 1 - np.sum((shown - exact) ** 2) / np.sum(exact ** 2)
        assert light.explained(order, negative) == pytest.approx(expected, abs=2e-3)


@pytest.mark.parametrize("degrees", [1.0, 30.0, 100.0, 179.0, 180.0])
def test_a_spread_keeps_the_power_of_an_area(degrees):
    spread = math.radians(degrees)
    angle = (np.arange(20_000) + 0.5) / 20_000 * spread / 2
    lobe = spread_pattern(np.cos(angle), spread) * np.cos(angle) * np.sin(angle)
    power = 2 * math.pi * lobe.sum() * spread / 2 / 20_000 * spread_factor(spread)
    assert power == pytest.approx(math.pi, rel=1e-4)


@pytest.mark.parametrize("count", [1, 4, 16, 100])
@pytest.mark.parametrize("seed", [0, 5])
def test_points_cover_a_face_evenly(count, seed):
    for shape, moment in (("rectangle", 1 / 3), ("ellipse", 1 / 4)):
        light = lamp("area", (2.0, 0.5, 3.0), size=(1.5, 0.7), shape=shape)
        positions, weights = light.points(count, seed)
        assert positions.shape == (count, 3)
        assert np.all(weights > 0.0)
        assert weights.sum() == pytest.approx(1.0)
        local = (positions - light.position) @ np.linalg.inv(np.column_stack([*light.half_axes, light.axis])).T
        assert np.abs(local[:, 2]).max() < 1e-12
        assert np.abs(local).max() <= 1.0
        if count >= 16:
            assert np.abs(local.mean(axis=0)).max() < 1.2 / count ** 0.5 * 0.5
            np.testing.assert_allclose((local[:, :2] ** 2).mean(axis=0), moment, atol=0.6 / count ** 0.5)
        np.testing.assert_array_equal(positions, light.points(count, seed)[0])
    for kind in ("point", "spot"):
        positions, weights = lamp(kind, radius=0.3).points(count, seed)
        np.testing.assert_array_equal(positions, [[0.3, -2.0, 1.0]])
        np.testing.assert_array_equal(weights, [1.0])


def test_point_sets_are_spread_evenly():
    """Discrepancy: the share of points in any corner box, or disc about the middle, is its share of the area."""
    square = fibonacci_square(256, 3)
    for a, b in np.random.Generator(np.random.PCG64(0)).uniform(-1, 1, (50, 2)):
        share = np.mean((square[:, 0] < a) & (square[:, 1] < b))
        assert share == pytest.approx((a + 1) * (b + 1) / 4, abs=0.025)
    disc = fibonacci_disc(256, 3)
    radius = np.sqrt(np.sum(disc ** 2, axis=1))
    for r in (0.2, 0.5, 0.9, 1.0):
        assert np.mean(radius <= r) == pytest.approx(r * r, abs=0.005)
    half = np.mean(disc @ [0.6, 0.8] > 0.0)
    assert half == pytest.approx(0.5, abs=0.02)
    with pytest.raises(ValueError, match="1 point"):
        fibonacci_square(0)
    with pytest.raises(ValueError, match="1 point"):
        fibonacci_disc(0)


@pytest.mark.parametrize("sine_squared", [1e-6, 0.01, 0.3, 0.9, 1.0])
def test_cap_irradiance_equals_a_sum_over_the_cap(sine_squared):
    """A round spot of the sky at any height, above, across and below the horizon."""
    slopes = np.radians([0.0, 30.0, 60.0, 80.0, 89.9, 90.0, 95.0, 120.0, 150.0, 179.0])
    if sine_squared < 0.01:
        slopes = np.array([0.0, 1.0, math.pi / 2 - 5e-4, math.pi / 2, math.pi / 2 + 5e-4, 2.0])
    # Even areas of the cap, from its middle (z) out to its rim: z from 1 to cos a, written without cancellation.
    cap = sine_squared / (1 + math.sqrt(1 - sine_squared))
    rings, turns = 1500, 600
    below = (np.arange(rings) + 0.5) / rings * cap
    sine = np.sqrt(below * (2 - below))
    around = np.cos(2 * math.pi * (np.arange(turns) + 0.5) / turns)
    expected = [2 * math.pi * cap * np.maximum(
        math.cos(b) * (1 - below)[:, None] + math.sin(b) * sine[:, None] * around, 0.0).mean() for b in slopes]
    found = cap_irradiance(np.full(len(slopes), sine_squared), np.cos(slopes))
    np.testing.assert_allclose(found, expected, atol=1e-4 * math.pi * sine_squared)


def test_cap_irradiance_knows_its_limits():
    one, zero = np.ones(1), np.zeros(1)
    assert cap_irradiance(one, one) == pytest.approx(math.pi)
    assert cap_irradiance(one, zero) == pytest.approx(math.pi / 2)
    assert cap_irradiance(one, -one) == pytest.approx(0.0, abs=1e-12)
    assert cap_irradiance(zero, one) == 0.0
    assert cap_irradiance(zero, zero) == 0.0
    # a spot of half the irradiance at the horizon: 2/3 sin^3 a for small a
    assert cap_irradiance(np.array([1e-8]), zero)[0] == pytest.approx(2 / 3 * 1e-12, rel=1e-3)


def brute_polygon(corners, normal, cells=500):
    """Irradiance from a parallelogram of radiance 1 by a sum over its cells."""
    line = (np.arange(cells) + 0.5) / cells
    a, b = corners[1] - corners[0], corners[3] - corners[0]
    towards = corners[0] + line[:, None, None] * a + line[None, :, None] * b
    upright = np.cross(a, b)
    square = np.sum(towards ** 2, axis=2)
    return np.mean(np.maximum(towards @ normal, 0.0) * np.abs(towards @ upright) / square ** 2)


def test_polygon_irradiance_equals_a_sum_above_and_across_the_horizon():
    random = np.random.Generator(np.random.PCG64(8))
    for case in range(40):
        a, b = random.normal(size=(2, 3))
        middle = random.normal(size=3) * 1.5
        normal = random.normal(size=3)
        normal /= np.linalg.norm(normal)
        corners = middle + np.array([-a - b, a - b, a + b, b - a])
        upright = np.cross(a, b) / np.linalg.norm(np.cross(a, b))
        if abs(middle @ upright) < 0.3:  # the sum needs a finer grid there
            corners += (0.5 * math.copysign(1.0, middle @ upright) * upright)
        if case % 2:
            corners = corners[::-1]
        found = polygon_irradiance(corners[:, None], normal[None])[0]
        expected = brute_polygon(corners, normal)
        assert found == pytest.approx(expected, rel=2e-3, abs=2e-4)


def test_polygon_irradiance_knows_its_limits():
    """A huge square overhead fills the hemisphere; one below the horizon or seen edge-on gives nothing."""
    square = np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
    up = np.array([[0.0, 0, 1]])
    assert polygon_irradiance((1e6 * square + [0, 0, 1])[:, None], up)[0] == pytest.approx(math.pi, rel=1e-5)
    assert polygon_irradiance((square - [0, 0, 1])[:, None], up)[0] == 0.0
    assert polygon_irradiance(square[:, None], up)[0] == pytest.approx(0.0, abs=1e-12)
    assert polygon_irradiance((square * [1, 1, 0] + [0, 0, 1e-9])[:, None], up)[0] == pytest.approx(math.pi, rel=1e-6)
    # upright at the horizon: half of it is cut off
    upright = square[:, [0, 2, 1]] + [0.0, 1.0, 0.0]
    half = np.array([[-1.0, 1, 0], [1, 1, 0], [1, 1, 1], [-1, 1, 1]])
    both = polygon_irradiance(upright[:, None] + 0.0, up), polygon_irradiance(half[:, None], up)
    assert both[0] == pytest.approx(both[1], rel=1e-12)


FLAT = [(0.0, 0.0, 0.0), (1.0, 1.0, 0.0), (0.0, 0.0, 1.0), (0.0, 1.0, 1.0), (1e-8, 1e-8, 1e-8), (1e-150,) * 3,
        (1e8, 1e8, 1e8), (1.0, 1.0, 1e-12)]


@pytest.mark.parametrize("scale", FLAT)
@pytest.mark.parametrize("kind", ["point", "spot", "area"])
def test_flattened_lamps_are_finite(kind, scale):
    for options in ({}, {"spot_angle": 0.02, "spot_blend": 0.0, "spread": 0.02, "radius": 1e-9, "size": (0.0, 1.0)}):
        light = lamp(kind, scale, **options)
        results = [light.emission(1), light.emission(4), light.intensity(SPHERE[:100]), light.axis, light.area,
                   light.intensity(np.zeros((1, 3))), light.extent, light.explained(3), *light.points(8)]
        assert all(np.all(np.isfinite(result)) for result in results)


@pytest.mark.parametrize("power", [0.0, 1e-6, 1e9, -5.0])
@pytest.mark.parametrize("kind", ["point", "spot", "area"])
def test_any_power_scales_the_emission(kind, power):
    options = {"spot_angle": 1.0, "spot_blend": 0.3}
    one = lamp(kind, power=np.ones(3), **options).emission(4)
    np.testing.assert_allclose(lamp(kind, power=np.full(3, power), **options).emission(4), power * one, rtol=1e-12)
