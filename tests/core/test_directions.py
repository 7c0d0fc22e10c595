# SPDX-License-Identifier: GPL-3.0-or-later
"""Direction sets against closed-form integrals; quadrature against the orthonormality of spherical harmonics."""

from __future__ import annotations

import numpy as np
import pytest

from prt_addon.basis import directions as sets
from prt_addon.basis.spherical_harmonics import evaluate


@pytest.mark.parametrize("count", [1, 2, 7, 600, 4096])
def test_fibonacci_directions_are_unit_and_even(count: int) -> None:
    directions = sets.spherical_fibonacci(count)
    assert directions.shape == (count, 3)
    np.testing.assert_allclose(np.linalg.norm(directions, axis=1), 1, atol=1e-14)
    if count >= 600:
        from scipy.spatial import cKDTree
        nearest = cKDTree(directions).query(directions, 2)[0][:, 1] * np.sqrt(count / (4 * np.pi))
        assert nearest.min() > 0.75  # of the ideal spacing; random directions come near 0


@pytest.mark.parametrize("order", range(1, 11))
def test_quadrature_makes_every_product_of_the_order_exact(order: int) -> None:
    directions, weights = sets.quadrature(6 * order * order, order)
    assert weights.min() > 0
    assert weights.sum() == pytest.approx(4 * np.pi, abs=1e-12)
    assert sets.exact_order(directions, weights, 2 * order) == 2 * order
    values = evaluate(order, directions)
    np.testing.assert_allclose(values.T @ (weights[:, None] * values), np.eye(order * order), atol=1e-12)


@pytest.mark.parametrize("count", [1, 2, 3, 5, 16, 50, 100, 150, 333])
def test_few_directions_still_get_positive_weights(count: int) -> None:
    directions, weights = sets.quadrature(count, 10)
    assert len(directions) == len(weights) == count
    assert weights.min() > 0 and weights.sum() == pytest.approx(4 * np.pi, abs=1e-12)
    if count >= 50:  # then at least half as many functions as directions are exact
        assert sets.exact_order(directions, weights, 20) ** 2 >= count / 4


def test_quadrature_beats_even_weights_and_is_repeatable() -> None:
    directions, weights = sets.quadrature(1000, 10)
    again = sets.quadrature(1000, 10)
    np.testing.assert_array_equal(directions, again[0])
    np.testing.assert_array_equal(weights, again[1])
    even = np.full(1000, 4 * np.pi / 1000)
    assert sets.exact_order(directions, even, 20) <= 2


def test_random_rotations_are_rotations_uniform_and_repeatable() -> None:
    matrices = np.array([sets.random_rotation(7, index) for index in range(4000)])
    np.testing.assert_allclose(matrices @ matrices.transpose(0, 2, 1), np.tile(np.eye(3), (4000, 1, 1)), atol=1e-14)
    np.testing.assert_allclose(np.linalg.det(matrices), 1, atol=1e-13)
    # Under the uniform distribution every entry has mean 0 and variance 1/3, the trace mean 0: 5 standard errors.
    assert np.abs(matrices.mean(axis=0)).max() < 5 * np.sqrt(1 / 3 / 4000)
    assert np.abs((matrices**2).mean(axis=0) - 1 / 3).max() < 5 * np.sqrt(4 / 45 / 4000)
    np.testing.assert_array_equal(sets.random_rotation(7, 3), matrices[3])
    assert np.abs(sets.random_rotation(8, 3) - matrices[3]).max() > 0.01


def test_cosine_hemisphere_integrates_with_the_cosine() -> None:
    directions = sets.cosine_hemisphere(2000)
    np.testing.assert_allclose(np.linalg.norm(directions, axis=1), 1, atol=1e-14)
    assert directions[:, 2].min() > 0
    # Means of z, z^2, x, x^2 under cos / pi are 2/3, 1/2, 0, 1/4.
    x, _, z = directions.T
    means = [z.mean(), (z * z).mean(), x.mean(), (x * x).mean()]
    np.testing.assert_allclose(means, [2 / 3, 1 / 2, 0, 1 / 4], atol=1e-3)


def test_tangent_frames_are_right_handed_for_every_normal() -> None:
    normals = np.random.default_rng(0).normal(size=(1000, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    special = np.array([[0, 0, 1.0], [0, 0, -1], [1, 0, 0], [-1, 0, -0.0], [0, 1, 0], [1e-9, 0, -1]])
    normals = np.concatenate([normals, special])
    frames = sets.tangent_frames(normals)
    wrong = np.abs(frames @ frames.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2))
    assert wrong[:-1].max() < 1e-14 and wrong[-1] < 1e-8  # the last normal is itself unit to 1e-9 only
    np.testing.assert_array_equal(frames[:, 2], normals)
    np.testing.assert_allclose(np.cross(frames[:, 0], frames[:, 1]), normals, atol=1e-8)


@pytest.mark.parametrize("call", [lambda: sets.spherical_fibonacci(0), lambda: sets.quadrature(0, 3),
                                  lambda: sets.quadrature(10, 0), lambda: sets.cosine_hemisphere(0)])
def test_nothing_asked_for_is_refused(call: object) -> None:
    with pytest.raises(ValueError, match="1 "):
        call()
