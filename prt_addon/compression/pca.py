# SPDX-License-Identifier: GPL-3.0-or-later
"""Exact principal components of the points of one cluster (Sloan et al. 2003, section 4.1)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..linear_algebra import gram, multiply, row_squares, small_generalized_eigenpairs, symmetric_eigenpairs

# Singular values below this share of the largest are rounding of single-precision data, not directions.
NEGLIGIBLE = 1e-7
CHUNK = 4096
# From near vectors: relative decrease of the squared error below which steps end, most steps, and how many times fewer
# the vectors must be than points and values.
CONVERGED, STEPS, FEW = 1e-5, 12, 6


def principal_components(points: NDArray[np.floating], count: int, near: NDArray[np.floating] | None = None,
                         ) -> tuple[NDArray, NDArray, NDArray]:
    """Mean (n,), the leading vectors (at most count, n), and their squared singular values D_i^2, all float64.

    points: (m, n). The Gram matrix of the smaller side is solved for its largest eigenpairs only, as the paper does
    with dsyevx. Fewer vectors than `count` come back where the points span fewer dimensions.
    near: (k, at most n), vectors of an earlier, similar solution on the leading values; where there are more than
    `count` and the points are many, power steps from them take a fifth of the time, see `_from_near`.
    """
    mean = points.mean(axis=0, dtype=np.float64)
    members, values = points.shape
    count = min(count, members - 1, values)
    if count <= 0:
        return mean, np.zeros((0, values)), np.zeros(0)
    if near is not None and count < len(near) < min(members, values) // FEW:
        found = _from_near(points, mean, count, near)
        if found is not None:
            return found
    if members >= values:
        squares, columns = symmetric_eigenpairs(_scatter(points, mean), count)
        vectors = columns.T
    else:
        centred = points - mean
        squares, left = symmetric_eigenpairs(gram(centred.T), count)
        vectors = multiply(left.T, centred) / np.sqrt(np.maximum(squares, np.finfo(float).tiny))[:, None]
    kept = squares > max(squares[0] * NEGLIGIBLE**2, np.finfo(np.float32).tiny)
    return mean, np.ascontiguousarray(vectors[kept]), squares[kept]


def _from_near(points: NDArray[np.floating], mean: NDArray[np.float64], count: int, near: NDArray[np.floating],
               ) -> tuple[NDArray, NDArray, NDArray] | None:
    """Block power steps with Rayleigh-Ritz (Golub & Van Loan, Matrix Computations (2013), 8.2.4) until a step lowers
    the squared error by less than a share of CONVERGED; None where that takes more than STEPS, or the points have
    hardly any extent in some direction, which single precision would lose."""
    centred = np.ascontiguousarray(points - mean, np.float32)
    scatter = float(row_squares(centred).sum(dtype=np.float64))
    basis = np.zeros((len(near), points.shape[1]), np.float32)
    basis[:, :near.shape[1]] = near
    last = np.inf
    for _ in range(STEPS):
        rows = multiply(multiply(basis, centred.T), centred).astype(np.float64)
        lengths = np.sqrt(row_squares(rows))
        if not lengths.min() > 0.0:
            return None
        rows /= lengths[:, None]
        weights = multiply(centred, rows.astype(np.float32).T).astype(np.float64)
        solved = small_generalized_eigenpairs(gram(weights), gram(rows.T))
        if solved is None or not solved[0][count - 1] > scatter * NEGLIGIBLE:
            return None
        vectors = multiply(np.ascontiguousarray(solved[1].T), rows)
        error = scatter - float(solved[0][:count].sum())
        if last - error <= CONVERGED * error:
            return mean, vectors[:count], solved[0][:count].copy()
        last, basis = error, vectors.astype(np.float32)
    return None


def _scatter(points: NDArray[np.floating], mean: NDArray[np.float64]) -> NDArray[np.float64]:
    """Sum over points (m, n) of the outer product of their differences from mean, block by block."""
    scatter = np.zeros((len(mean), len(mean)))
    for start in range(0, len(points), CHUNK):
        scatter += gram(points[start:start + CHUNK] - mean)
    return scatter
