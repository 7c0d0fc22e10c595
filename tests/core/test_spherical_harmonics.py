# SPDX-License-Identifier: GPL-3.0-or-later
"""Spherical harmonics against scipy's own, rotation against evaluating at rotated directions."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.special import sph_harm_y

from prt_addon.basis import spherical_harmonics as sh


def random_directions(count: int, seed: int = 0) -> np.ndarray:
    directions = np.random.default_rng(seed).normal(size=(count, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    axes = np.concatenate([np.eye(3), -np.eye(3)])  # the poles are where formulas in angles break
    return np.concatenate([directions, axes])


def scipy_values(order: int, directions: np.ndarray) -> np.ndarray:
    """The conventions of design/transfer.md from scipy's complex functions."""
    x, y, z = directions.T
    theta, phi = np.arctan2(np.hypot(x, y), z), np.arctan2(y, x)
    columns = []
    for band in range(order):
        for m in range(-band, band + 1):
            value = sph_harm_y(band, abs(m), theta, phi) * (-1) ** m
            columns.append(value.real if m == 0 else math.sqrt(2) * (value.real if m > 0 else value.imag))
    return np.stack(columns, axis=1)


@pytest.mark.parametrize("order", range(1, 13))
def test_values_equal_scipy(order: int) -> None:
    directions = random_directions(500)
    values = sh.evaluate(order, directions)
    assert values.shape == (len(directions), order * order)
    assert values.dtype == np.float64 and values.flags.c_contiguous
    np.testing.assert_allclose(values, scipy_values(order, directions), rtol=0, atol=1e-12)


def test_band_one_is_y_z_x_without_condon_shortley_phase() -> None:
    directions = random_directions(20)
    expected = math.sqrt(3 / (4 * math.pi)) * directions[:, [1, 2, 0]]
    np.testing.assert_allclose(sh.evaluate(2, directions)[:, 1:], expected, atol=1e-15)


@pytest.mark.parametrize("order", range(1, 13))
def test_rotation_equals_evaluating_rotated_directions(order: int) -> None:
    directions = random_directions(50)
    coefficients = np.random.default_rng(order).normal(size=(order * order, 3))
    for matrix in Rotation.random(5, rng=order).as_matrix():
        block = sh.rotation(order, matrix)
        np.testing.assert_allclose(block @ block.T, np.eye(order * order), atol=1e-12)
        # f(R^-1 s) has the value of f at the direction turned back.
        expected = sh.evaluate(order, directions @ matrix) @ coefficients
        rotated = sh.evaluate(order, directions) @ sh.rotate(coefficients, matrix)
        np.testing.assert_allclose(rotated, expected, atol=1e-12 * order * order)
        np.testing.assert_allclose(sh.evaluate(order, directions @ matrix), sh.evaluate(order, directions) @ block,
                                   atol=1e-12)


def test_rotations_compose_and_reflections_work() -> None:
    first, second = Rotation.random(2, rng=4).as_matrix()
    np.testing.assert_allclose(sh.rotation(10, first @ second), sh.rotation(10, first) @ sh.rotation(10, second),
                               atol=1e-12)
    np.testing.assert_allclose(sh.rotation(10, np.eye(3)), np.eye(100), atol=1e-14)
    mirror = first @ np.diag([1.0, -1.0, 1.0])
    directions = random_directions(30)
    np.testing.assert_allclose(sh.evaluate(8, directions @ mirror), sh.evaluate(8, directions) @ sh.rotation(8, mirror),
                               atol=1e-12)


def test_a_light_turned_about_z_moves_the_way_the_matrix_says() -> None:
    light = sh.evaluate(6, np.array([[1.0, 0, 0]]))[0]  # brightest towards +X
    quarter_turn = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])  # takes +X to +Y
    np.testing.assert_allclose(sh.rotate(light, quarter_turn), sh.evaluate(6, np.array([[0, 1.0, 0]]))[0], atol=1e-13)


@pytest.mark.parametrize("matrix", [np.diag([2.0, 1, 1]), np.zeros((3, 3)), np.eye(4), np.full((3, 3), np.nan)])
def test_a_matrix_that_is_no_rotation_is_refused(matrix: np.ndarray) -> None:
    with pytest.raises(ValueError, match="orthonormal"):
        sh.rotation(3, matrix)


def test_order_of() -> None:
    assert [sh.order_of(n * n) for n in range(1, 13)] == list(range(1, 13))
    for count in (-1, 0, 2, 24, 99):
        with pytest.raises(ValueError, match="bands"):
            sh.order_of(count)


def test_bad_input_is_refused() -> None:
    with pytest.raises(ValueError, match="order 1"):
        sh.evaluate(0, np.zeros((1, 3)))
    with pytest.raises(ValueError, match=r"\(n, 3\)"):
        sh.evaluate(2, np.zeros(3))
    assert sh.evaluate(4, np.zeros((0, 3))).shape == (0, 16)


def test_zonal_cosine_is_the_integral_of_the_clamped_cosine() -> None:
    order = 12
    z, weights = np.polynomial.legendre.leggauss(40)
    z, weights = (z + 1) / 2, weights / 2  # the hemisphere z in 0..1, where the integrand is a polynomial
    for band in range(order):
        legendre = np.polynomial.legendre.Legendre.basis(band)(z)
        assert sh.zonal_cosine(order)[band] == pytest.approx(2 * np.sum(weights * z * legendre), abs=1e-14)
    np.testing.assert_allclose(sh.zonal_cosine(5), [1, 2 / 3, 1 / 4, 0, -1 / 24], atol=1e-15)
    assert len(sh.zonal_cosine(1)) == 1


def test_windows() -> None:
    for kind in ("hanning", "lanczos", "laplacian", "heat"):
        factors = sh.window(8, kind, 0.01)
        assert factors[0] == 1 and np.all(np.diff(factors) < 0) and factors[-1] > 0
    assert np.all(sh.window(8, "none") == 1) and np.all(sh.window(8, "laplacian", 0.0) == 1)
    np.testing.assert_allclose(sh.window(4, "hanning"), [1, (1 + math.sqrt(0.5)) / 2, 0.5, (1 - math.sqrt(0.5)) / 2])
    with pytest.raises(ValueError, match="unknown window"):
        sh.window(4, "kaiser")
    with pytest.raises(ValueError, match="strength"):
        sh.window(4, "laplacian", -1.0)


def test_laplacian_window_minimises_its_functional() -> None:
    """Error plus strength times squared Laplacian (-l (l + 1) per band) is larger for any other factor."""
    strength, bands = 0.003, np.arange(6)
    best = sh.window(6, "laplacian", strength)

    def cost(factors: np.ndarray) -> np.ndarray:
        return (factors - 1) ** 2 + strength * (bands * (bands + 1) * factors) ** 2

    assert np.all(cost(best + 1e-3) > cost(best)) or cost(best)[0] == 0
    assert np.all((cost(best + 1e-3) > cost(best))[1:]) and np.all((cost(best - 1e-3) > cost(best))[1:])


def test_expand_bands() -> None:
    np.testing.assert_array_equal(sh.expand_bands([1.0, 2.0, 3.0]), [1, 2, 2, 2, 3, 3, 3, 3, 3])
