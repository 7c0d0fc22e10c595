# SPDX-License-Identifier: GPL-3.0-or-later
"""The hemispherical basis against every number of Sloan et al. 2003's appendix, and where single precision fails."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from prt_addon.basis import hemisphere
from prt_addon.basis import spherical_harmonics as sh

# Condition of A per order, recomputed in double precision before (design/transfer.md).
CONDITIONS = {2: 1.4e1, 3: 2.5e2, 4: 5.9e3, 5: 1.5e5, 6: 4.2e6, 7: 1.2e8, 8: 3.5e9, 9: 1.0e11, 10: 3.1e12}


def full_basis(order: int, smallest: float = hemisphere.SINGLE_PRECISION) -> hemisphere.HemisphereBasis:
    return hemisphere.hemisphere_basis(hemisphere.functions_of(order * order), smallest)


def hemisphere_quadrature(order: int) -> tuple[np.ndarray, np.ndarray]:
    """Directions and weights (sum 2 pi) exact for products of two functions of `order`, written for this test alone."""
    z, weights = np.polynomial.legendre.leggauss(2 * order)
    z, weights = (z[:, None] + 1) / 2, weights[:, None] / 2
    phi = 2 * np.pi * (np.arange(4 * order) + 0.5)[None, :] / (4 * order)
    radius = np.sqrt(1 - z * z)
    directions = np.stack([radius * np.cos(phi), radius * np.sin(phi), z + 0 * phi], axis=-1).reshape(-1, 3)
    return directions, np.repeat(2 * np.pi * weights[:, 0] / (4 * order), 4 * order)


def worst_and_mean(error: np.ndarray, count: int = 25) -> tuple[float, float]:
    """Over unit coefficient vectors of `count` functions: the paper's largest and average singular value."""
    values = np.linalg.eigvalsh(error[:count, :count])
    return values[-1], values.mean()


def reflection_error(order: int, parity: int) -> np.ndarray:
    """The paper's Q_2: functions of this parity in z doubled, the others dropped."""
    matrix = hemisphere.gram_matrix(hemisphere.functions_of(order * order))
    bands, azimuths = hemisphere.bands_of(np.arange(order * order))
    factor = np.where((bands + azimuths) % 2 == parity, 2.0, 0.0)
    difference = factor[:, None] * matrix - np.eye(order * order)
    return difference.T @ matrix @ difference


def test_functions_of_row_counts() -> None:
    for order in (1, 2, 3, 4, 5, 10):
        np.testing.assert_array_equal(hemisphere.functions_of(order * order), np.arange(order * order))
    reduced = hemisphere.functions_of(24)
    assert len(reduced) == 24 and 2 not in reduced and hemisphere.order_of(reduced) == 5
    with pytest.raises(ValueError, match="bands"):
        hemisphere.functions_of(23)
    with pytest.raises(ValueError, match="distinct"):
        hemisphere.order_of(np.array([1, 1]))


@pytest.mark.parametrize("rows", [1, 4, 24, 100])
def test_gram_matrix_is_the_integral_of_products(rows: int) -> None:
    functions = hemisphere.functions_of(rows)
    directions, weights = hemisphere_quadrature(10)
    values = hemisphere.evaluate(functions, directions)
    np.testing.assert_allclose(values, sh.evaluate(10, directions)[:, functions], rtol=0, atol=1e-14)
    np.testing.assert_allclose(hemisphere.gram_matrix(functions), (values * weights[:, None]).T @ values, atol=3e-14)
    # The functions are orthonormal over the sphere, and even ones have the same integrals over either half.
    np.testing.assert_allclose(np.diag(hemisphere.gram_matrix(functions)), 0.5, atol=1e-14)


def test_published_singular_values_of_order_5() -> None:
    values = full_basis(5).eigenvalues
    assert values[0] == pytest.approx(1, abs=1e-5)
    assert values[-2] == pytest.approx(3.10e-4, rel=2e-3)
    assert values[-1] == pytest.approx(6.59e-6, rel=1e-3)


def test_published_best_function_to_drop() -> None:
    """The squared error of y_i from all others is 1 / (A^-1)_ii: least for l = 1, m = 0."""
    errors = 1 / np.diag(np.linalg.inv(hemisphere.gram_matrix(np.arange(25))))
    assert errors.argmin() == 2
    assert errors[2] == pytest.approx(1.48e-5, rel=3e-3)
    # The same from the 24 functions' own fit.
    basis = hemisphere.hemisphere_basis(hemisphere.functions_of(24))
    everything = hemisphere.gram_matrix(np.arange(25))
    integrals = everything[basis.functions, 2]
    assert 0.5 - integrals @ basis.fit(integrals) == pytest.approx(1.48e-5, rel=3e-3)


def test_published_error_of_the_zero_hemisphere_projection() -> None:
    matrix = hemisphere.gram_matrix(np.arange(25))
    difference = matrix - np.eye(25)
    worst, mean = worst_and_mean(difference.T @ matrix @ difference)
    assert worst == pytest.approx(0.125, abs=5e-4) and mean == pytest.approx(0.0402, abs=5e-5)


@pytest.mark.parametrize(("order", "parity", "functions", "worst", "mean"), [
    (8, 1, 28, 0.145, 0.044),  # odd reflection
    (7, 0, 28, 0.022, 0.0036),  # even reflection
    (5, 0, 15, 0.193, 0.030),
])
def test_published_errors_of_reflections(order: int, parity: int, functions: int, worst: float, mean: float) -> None:
    bands, azimuths = hemisphere.bands_of(np.arange(order * order))
    assert np.count_nonzero((bands + azimuths) % 2 == parity) == functions
    found_worst, found_mean = worst_and_mean(reflection_error(order, parity))
    assert found_worst == pytest.approx(worst, abs=6e-4)
    assert found_mean == pytest.approx(mean, abs=10 ** -len(str(mean).split(".")[1]) * 0.6)


@pytest.mark.parametrize(("order", "condition"), CONDITIONS.items())
def test_condition_per_order(order: int, condition: float) -> None:
    assert full_basis(order).condition == pytest.approx(condition, rel=0.04)


@pytest.mark.parametrize("order", range(2, 11))
def test_fit_is_stable_where_a_single_precision_inverse_is_not(order: int) -> None:
    """Band-limited functions, the relative error over the hemisphere (the worst of 200)."""
    basis, precise = full_basis(order), full_basis(order, hemisphere.DOUBLE_PRECISION)
    wanted = np.random.default_rng(order).normal(size=(order * order, 200))
    integrals = basis.gram @ wanted

    def worst(found: np.ndarray) -> float:
        return math.sqrt(np.max(np.abs(basis.squared_norm(found - wanted)) / basis.squared_norm(wanted)))

    assert precise.kept == order * order and worst(precise.fit(integrals)) < 1e-8
    assert worst(basis.fit(integrals)) < 3e-4
    # What is stored and drawn is single precision, and so may be the integrals that come in.
    assert worst(basis.fit(integrals.astype(np.float32)).astype(np.float32)) < 3e-4
    if order >= 6:
        plain = np.linalg.inv(basis.gram.astype(np.float32))
        assert worst(plain.astype(np.float64) @ integrals) > 0.01
        assert worst((plain @ integrals.astype(np.float32)).astype(np.float64)) > 0.02


def test_what_is_kept_is_reported() -> None:
    assert [full_basis(order).kept for order in range(2, 11)] == [4, 9, 16, 25, 36, 48, 61, 75, 92]
    assert hemisphere.hemisphere_basis(hemisphere.functions_of(24)).kept == 24
    assert full_basis(7).describe().startswith("48 of 49 directions of the hemispherical basis kept, condition 1.7e+06")
    with pytest.raises(ValueError, match="smallest eigenvalue"):
        full_basis(5, 2.0)
    with pytest.raises(ValueError, match="smallest eigenvalue"):
        full_basis(5, 0.0)


@pytest.mark.parametrize("rows", [9, 16, 24, 25, 64])
def test_fit_is_the_least_squares_solution(rows: int) -> None:
    """Against numpy's solution of the overdetermined system, for a function outside the space."""
    basis = hemisphere.hemisphere_basis(hemisphere.functions_of(rows))
    directions, weights = hemisphere_quadrature(24)
    wanted = np.exp(directions @ np.array([1.0, 0.5, 0.7]))
    values = basis.evaluate(directions)
    found = values @ basis.fit(values.T @ (weights * wanted))
    root = np.sqrt(weights)
    solution = np.linalg.lstsq(values * root[:, None], wanted * root, rcond=1e-12)[0]
    norm = math.sqrt(weights @ wanted ** 2)
    # What truncation leaves out at order 8 is below 1e-4 of the function; up to order 5 nothing is left out.
    assert math.sqrt(weights @ (found - values @ solution) ** 2) < (1e-4 if rows == 64 else 1e-10) * norm
    assert math.sqrt(weights @ (found - wanted) ** 2) < {9: 0.2, 16: 0.05, 24: 0.01, 25: 0.01, 64: 1e-3}[rows] * norm


def test_truncated_fit_commutes_with_turns_about_the_normal() -> None:
    basis = full_basis(8)
    turn = sh.rotation(8, Rotation.from_rotvec([0, 0, 0.7]).as_matrix())
    integrals = np.random.default_rng(3).normal(size=(64, 4))
    scale = np.abs(basis.fit(integrals)).max()
    np.testing.assert_allclose(basis.fit(turn @ integrals), turn @ basis.fit(integrals), atol=1e-9 * scale)


def test_root_measures_the_norm_over_the_hemisphere() -> None:
    basis = full_basis(5)
    coefficients = np.random.default_rng(1).normal(size=(25, 6))
    np.testing.assert_allclose(np.sum((basis.root() @ coefficients) ** 2, axis=0), basis.squared_norm(coefficients),
                               rtol=1e-12)
