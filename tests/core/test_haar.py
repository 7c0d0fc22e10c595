# SPDX-License-Identifier: GPL-3.0-or-later
"""Haar wavelets on cube faces: orthonormal, invertible, constants in one coefficient a face."""

import numpy as np
import pytest

from prt_addon.basis.cubemap import cubemap_directions, cubemap_solid_angles
from prt_addon.basis.haar import haar_transform, inverse_haar_transform, keep_largest


@pytest.mark.parametrize("r", (1, 2, 8, 32))
def test_parseval_and_inverse(r):
    values = np.random.default_rng(1).normal(size=(5, 6 * r * r))
    coefficients = haar_transform(values, r)
    assert np.allclose(np.square(coefficients).sum(axis=1), np.square(values).sum(axis=1), rtol=1e-13)
    assert np.allclose(inverse_haar_transform(coefficients, r), values, atol=1e-13)


def test_the_transform_is_an_orthonormal_matrix():
    matrix = haar_transform(np.eye(6 * 16), 4)
    assert np.allclose(matrix @ matrix.T, np.eye(6 * 16), atol=1e-14)


def test_inner_products_are_integrals_over_the_sphere():
    r = 16
    directions, root = cubemap_directions(r), np.sqrt(cubemap_solid_angles(r))
    first = haar_transform((directions[:, 2] * root)[None], r)
    second = haar_transform((directions @ [0.6, 0.0, 0.8] * root)[None], r)
    assert (first * second).sum() == pytest.approx(0.8 * 4 * np.pi / 3, rel=2e-3)


def test_a_constant_has_one_coefficient_for_each_face():
    r = 16
    coefficients = haar_transform(np.sqrt(cubemap_solid_angles(r))[None], r).reshape(6, r, r)
    assert np.allclose(coefficients[:, 0, 0], np.sqrt(4 * np.pi / 6), rtol=1e-13)
    coefficients[:, 0, 0] = 0
    assert np.abs(coefficients).max() < 1e-14


def test_a_half_sphere_is_sparse():
    r = 32
    directions, root = cubemap_directions(r), np.sqrt(cubemap_solid_angles(r))
    values = (np.where(directions[:, 2] > 0, 1.0, 0.0) * root)[None]
    # one mean on top, a mean and a difference on each of four sides
    kept = keep_largest(haar_transform(values, r), 9)
    assert np.square(inverse_haar_transform(kept, r) - values).sum() < 1e-12 * np.square(values).sum()
    assert np.square(keep_largest(kept, 8) - kept).sum() > 0.01


def test_largest_coefficients_are_kept():
    kept = keep_largest(np.array([[1.0, -5.0, 2.0, 0.5], [4.0, 3.0, -1.0, 0.0]]), 2)
    assert np.array_equal(kept, [[0, -5, 2, 0], [4, 3, 0, 0]])
    assert np.array_equal(keep_largest(np.ones((1, 3)), 9), np.ones((1, 3)))


def test_other_sizes_are_refused():
    with pytest.raises(ValueError, match="power of two"):
        haar_transform(np.zeros((1, 6 * 9)), 3)
    with pytest.raises(ValueError, match="values for each"):
        haar_transform(np.zeros((1, 7)), 2)
