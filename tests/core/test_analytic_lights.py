# SPDX-License-Identifier: GPL-3.0-or-later
"""Sun and constant light against closed-form integrals (Blender's units: tests/blender/test_sun_units.py)."""

from __future__ import annotations

import math

import numpy as np
import pytest

from prt_addon.basis.spherical_harmonics import evaluate, order_of
from prt_addon.lighting.analytic import constant, sun
from prt_addon.lighting.environment import direction_of_pixel, project


def test_constant_light_is_its_colour_everywhere() -> None:
    light = constant((0.5, 1.0, 2.0), 6)
    directions = direction_of_pixel(np.arange(9), 3, 9, 9)
    np.testing.assert_allclose(evaluate(6, directions) @ light, np.tile([0.5, 1, 2], (9, 1)), atol=1e-14)


def test_a_point_sun_is_a_delta_of_its_strength() -> None:
    light = sun((0, 3, 4), (1, 2, 3), 0.0, 10)
    np.testing.assert_allclose(light, evaluate(10, np.array([[0, 0.6, 0.8]])).T * [1, 2, 3], atol=1e-13)


@pytest.mark.parametrize("angle", [0.009, 0.5, 2.0, math.pi])
@pytest.mark.parametrize("normalize", [True, False])
def test_a_disc_equals_the_integral_over_its_cap(angle: float, normalize: bool) -> None:
    order, half = 8, angle / 2
    nodes, weights = np.polynomial.legendre.leggauss(20)
    z = 1 - (1 - nodes) * (1 - math.cos(half)) / 2
    radiance = 1 / (math.pi * math.sin(half) ** 2) if normalize else 1
    light = sun((0, 0, 1), (1, 1, 1), angle, order, normalize)
    for band in range(order):
        zonal = math.sqrt((2 * band + 1) / (4 * math.pi)) * np.polynomial.legendre.Legendre.basis(band)(z)
        cap = 2 * math.pi * radiance * (1 - math.cos(half)) / 2 * np.sum(weights * zonal)
        assert light[band * (band + 1), 0] == pytest.approx(cap, abs=1e-11)
    others = np.delete(light[:, 0], [band * (band + 1) for band in range(order)])
    assert np.abs(others).max() < 1e-14


def test_a_normalized_disc_gives_its_strength_as_irradiance() -> None:
    """Integral of L cos over the cap is L pi sin^2: of the coefficients, through band 0..n of the clamped cosine."""
    from prt_addon.basis.spherical_harmonics import zonal_cosine
    for angle in (0.0, 0.01, 1.0, 2.5, math.pi):
        light = sun((1, 1, 0), (2, 2, 2), angle, 40)
        normal = np.array([[1.0, 1, 0]]) / math.sqrt(2)
        factors = np.repeat(zonal_cosine(40), 2 * np.arange(40) + 1)
        irradiance = math.pi * (evaluate(40, normal) * factors @ light)[0, 0]
        assert irradiance == pytest.approx(2, rel=2e-3)


def test_an_image_of_a_disc_agrees_with_the_formula() -> None:
    height, width, angle = 400, 800, 1.2
    toward = np.array([0.48, -0.6, 0.64])
    rows, columns = np.mgrid[:height, :width]
    inside = direction_of_pixel(rows, columns, height, width) @ toward > math.cos(angle / 2)
    image = np.where(inside, 1.0, 0.0)[..., None].repeat(3, axis=2)
    formula = sun(toward, (1, 1, 1), angle, 6, normalize=False)
    np.testing.assert_allclose(project(image, 6), formula, atol=4e-3 * np.abs(formula).max())


def test_bad_suns_are_refused() -> None:
    with pytest.raises(ValueError, match="direction"):
        sun((0, 0, 0), (1, 1, 1), 0.0, 4)
    with pytest.raises(ValueError, match="direction"):
        sun((0, 0, math.nan), (1, 1, 1), 0.0, 4)
    with pytest.raises(ValueError, match="angle"):
        sun((0, 0, 1), (1, 1, 1), 4.0, 4)
    assert order_of(len(sun((0, 0, 1), (1, 1, 1), float(np.float32(math.pi)), 4))) == 4
