# SPDX-License-Identifier: GPL-3.0-or-later
"""Windowing leaves smooth light alone, removes negative light where it rings, and takes no more than that needs."""

from __future__ import annotations

import math

import numpy as np
import pytest

from prt_addon.basis.directions import spherical_fibonacci
from prt_addon.basis.spherical_harmonics import evaluate, expand_bands, rotate, window
from prt_addon.lighting.analytic import constant, sun
from prt_addon.lighting.environment import apply_bands
from prt_addon.lighting.windowing import HIGHLIGHT_TOLERANCE, for_highlights, remove_ringing

DIRECTIONS = spherical_fibonacci(10_000)  # finer than the product's own check


def lowest_over_mean(coefficients: np.ndarray) -> float:
    radiance = evaluate(math.isqrt(len(coefficients)), DIRECTIONS) @ coefficients[:, 0]
    return float(radiance.min() / (coefficients[0, 0] / math.sqrt(4 * math.pi)))


def test_light_that_does_not_ring_is_left_alone() -> None:
    smooth = constant((1, 2, 3), 6)
    smooth[1:4] = 0.4  # a soft gradient, positive everywhere
    for light in (constant((1, 1, 1), 10), smooth, np.zeros((25, 3))):
        result = remove_ringing(light)
        assert not result.rings and result.cost == 0
        np.testing.assert_array_equal(result.factors, 1)


@pytest.mark.parametrize("order", [3, 4, 5, 6, 10])
def test_a_sun_rings_and_the_window_removes_it(order: int) -> None:
    light = sun((1, 2, 3), (1, 1, 1), 0.009, order)
    assert lowest_over_mean(light) < -1
    result = remove_ringing(light)
    windowed = apply_bands(light, result.factors)
    assert result.rings and result.lowest_before < -1 and result.lowest_after >= -0.01
    assert lowest_over_mean(windowed) > -0.015
    np.testing.assert_array_equal(windowed[0], light[0])  # the mean light stays
    assert result.cost == pytest.approx(np.linalg.norm(windowed - light) / np.linalg.norm(light), rel=1e-12)


@pytest.mark.parametrize("order", [4, 6, 10])
def test_the_window_is_minimal_and_loses_less_than_sloans(order: int) -> None:
    light = sun((0, 0, 1), (1, 1, 1), 0.0, order)
    result = remove_ringing(light)
    weaker = apply_bands(light, window(order, "heat", 0.97 * result.strength))
    assert lowest_over_mean(weaker) < -0.01
    enough = next(s for s in np.geomspace(1e-2, 10, 60)
                  if lowest_over_mean(apply_bands(light, window(order, "laplacian", s))) >= -0.01)
    laplacian = apply_bands(light, window(order, "laplacian", enough))
    assert result.cost < np.linalg.norm(laplacian - light) / np.linalg.norm(light)


def test_channels_without_light_take_no_part() -> None:
    light = constant((0, 0, 1), 5)
    assert not remove_ringing(light).rings
    red_sun = sun((0, 0, 1), (1, 0, 0), 0.0, 5)
    assert remove_ringing(red_sun + light).rings


def test_a_brighter_sky_needs_less_window() -> None:
    sun_light = sun((0, 0, 1), (1, 1, 1), 0.0, 6)
    strengths = [remove_ringing(sun_light + constant((sky,) * 3, 6)).strength for sky in (0.0, 0.05, 0.2, 1.0)]
    assert strengths[0] > strengths[1] > strengths[2] > 0 and strengths[3] == 0


def test_factors_fit_the_coefficients() -> None:
    result = remove_ringing(sun((0, 1, 0), (1, 1, 1), 0.0, 7))
    assert result.factors.shape == (7,) and expand_bands(result.factors).shape == (49,)
    with pytest.raises(ValueError, match="bands"):
        remove_ringing(np.ones((7, 3)))


def test_highlights_reflect_a_light_that_rings_less() -> None:
    """No further below black than its tolerance, the mean kept; what does not ring so much comes back to the bit; a
    turned light is windowed as the light is."""
    turn = np.array([[0.36, 0.48, -0.8], [-0.8, 0.6, 0.0], [0.48, 0.64, 0.6]])
    for order in (3, 5, 8):
        light = sun((0, 0.6, 0.8), (3, 2, 1), 0.01, order) + constant((0.2, 0.3, 0.4), order)
        found = for_highlights(light)
        lowest = (evaluate(order, DIRECTIONS) @ found).min(axis=0) / (found[0] / np.sqrt(4 * np.pi))
        assert lowest.min() > -HIGHLIGHT_TOLERANCE - 0.02
        assert np.allclose(found[0], light[0])
        assert np.allclose(for_highlights(rotate(light, turn)), rotate(found, turn), atol=2e-2 * np.abs(found).max())
    light = sun((0, 0.6, 0.8), (3, 2, 1), 0.01, 5) + constant((9.0, 9.0, 9.0), 5)
    assert np.array_equal(for_highlights(light), light)
    assert np.array_equal(for_highlights(np.zeros((25, 3))), np.zeros((25, 3)))
