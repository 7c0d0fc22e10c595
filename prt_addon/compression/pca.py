# SPDX-License-Identifier: GPL-3.0-or-later
"""Exact principal components of the points of one cluster (Sloan et al. 2003, section 4.1)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..linear_algebra import gram, multiply, symmetric_eigenpairs

# Singular values below this share of the largest are rounding of single-precision data, not directions.
NEGLIGIBLE = 1e-7
CHUNK = 4096


def principal_components(points: NDArray[np.floating], count: int) -> tuple[NDArray, NDArray, NDArray]:
    """Mean (n,), the leading vectors (at most count, n), and their squared singular values D_i^2, all float64.

    points: (m, n). The Gram matrix of the smaller side is solved for its largest eigenpairs only, as the paper does
    with dsyevx. Fewer vectors than `count` come back where the points span fewer dimensions.
    """
    mean = points.mean(axis=0, dtype=np.float64)
    members, values = points.shape
    count = min(count, members - 1, values)
    if count <= 0:
        return mean, np.zeros((0, values)), np.zeros(0)
    if members >= values:
        squares, columns = symmetric_eigenpairs(_scatter(points, mean), count)
        vectors = columns.T
    else:
        centred = points - mean
        squares, left = symmetric_eigenpairs(gram(centred.T), count)
        vectors = multiply(left.T, centred) / np.sqrt(np.maximum(squares, np.finfo(float).tiny))[:, None]
    kept = squares > max(squares[0] * NEGLIGIBLE**2, np.finfo(np.float32).tiny)
    return mean, np.ascontiguousarray(vectors[kept]), squares[kept]


def _scatter(points: NDArray[np.floating], mean: NDArray[np.float64]) -> NDArray[np.float64]:
    """Sum over points (m, n) of the outer product of their differences from mean, block by block."""
    scatter = np.zeros((len(mean), len(mean)))
    for start in range(0, len(points), CHUNK):
        scatter += gram(points[start:start + CHUNK] - mean)
    return scatter
