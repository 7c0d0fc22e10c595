# SPDX-License-Identifier: GPL-3.0-or-later
"""Weights of dense neighbours that explain a few samples of a sparse vertex (Huang & Ramamoorthi 2010, section 5.1).

For every vertex: min over w of |A w - b|^2 + strength |w|_1, A (samples, k) the neighbours' transport in the sampled
directions, b the vertex's own. The paper solves this by the interior-point method l1_ls (Kim et al. 2007), one vertex
after the other. Here all vertices of a batch are solved together on their k x k Gram matrices by ADMM (Boyd et al.
2011, Distributed Optimization and Statistical Learning via the ADMM, 6.4), with one inverse per vertex.

Every vertex's result depends on its own numbers alone, never on the batch that it is in.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from ..linear_algebra import many_symmetric_eigenpairs, small_batched_multiply

Array = NDArray[np.float64]
Method = Literal["l1", "least_squares", "radius"]

# ADMM steps, over-relaxation, and the penalty relative to the mean eigenvalue of the Gram matrix, to which so many
# times the strength is added: within 1 % of the interior-point method's objective for neighbours that hardly differ, at
# strengths from 0.001 to 0.3 (tests/core/test_sparse_weights.py).
STEPS, RELAXATION, PENALTY, PENALTY_BY_STRENGTH = 60, 1.7, 0.05, 1.5
# Of the mean eigenvalue, added to the diagonal where a Gram matrix is inverted as it is: it decides between equal
# neighbours without changing what they add up to.
RIDGE = 1e-5
# Of the sparsest strength, at which every weight is zero: the default of `solve`.
STRENGTH = 1e-3
# The part of the radius below which distances count as equal.
NEAREST = 1e-3


@dataclass(frozen=True)
class Normal:
    """Normal equations of a batch of n vertices: gram (n, k, k) = A^T A, right (n, k) = A^T b, both float64; a slot
    that holds no neighbour is a row and column of zeros, and its weight comes out as zero."""

    gram: Array
    right: Array

    @staticmethod
    def of(features: NDArray[np.floating], samples: NDArray[np.floating]) -> Normal:
        """From features A^T (n, k, m) and samples b (n, m)."""
        right = small_batched_multiply(features, samples[:, :, None])[:, :, 0]
        gram = small_batched_multiply(features, features.transpose(0, 2, 1))
        return Normal(gram.astype(np.float64), right.astype(np.float64))

    def adding_up(self, samples: float) -> Normal:
        """With one more sample that weighs so many times the neighbours' own: where all neighbours have one value,
        so has the vertex. Without it the penalty on |w|_1 makes weights add up to less than 1 and vertices too dark. A
        slot without neighbour stays empty."""
        there = (np.diagonal(self.gram, axis1=1, axis2=2) > 0.0) * (samples * self.size)[:, None]
        return Normal(self.gram + there[:, :, None] * (there[:, None, :] > 0.0), self.right + there)

    @property
    def size(self) -> Array:
        """Mean eigenvalue (n,) over the neighbours that say anything; 1 where none does."""
        diagonal = np.diagonal(self.gram, axis1=1, axis2=2)
        mean = diagonal.sum(axis=1) / np.maximum(np.count_nonzero(diagonal > 0.0, axis=1), 1)
        return np.where(mean > 0.0, mean, 1.0)


def solve(normal: Normal, strength: float = STRENGTH, steps: int = STEPS) -> Array:
    """Weights (n, k) with the least |A w - b|^2 + s |w|_1, s = strength times the least s at which all are zero
    (|2 A^T b|_inf, as in l1_ls). All zeros where nothing is known of a vertex."""
    limit = strength * 2.0 * np.abs(normal.right).max(axis=1, initial=0.0)
    penalty = 2.0 * (PENALTY + PENALTY_BY_STRENGTH * strength) * normal.size
    inverse = inverted(2.0 * normal.gram, penalty)
    right = 2.0 * normal.right
    threshold = (limit / penalty)[:, None]
    kept = np.zeros_like(right)
    dual = np.zeros_like(right)
    scale = penalty[:, None]
    for _ in range(steps):
        smooth = small_batched_multiply(inverse, (right + scale * (kept - dual))[:, :, None])[:, :, 0]
        relaxed = RELAXATION * smooth + (1.0 - RELAXATION) * kept
        relaxed += dual
        kept = np.sign(relaxed) * np.maximum(np.abs(relaxed) - threshold, 0.0)
        dual = relaxed - kept
    return kept


def least_squares(normal: Normal) -> Array:
    """Weights (n, k) with the least |A w - b|^2, of rank-deficient systems (nearly) the shortest: the paper's
    comparison, which over-fits where neighbours are many."""
    return small_batched_multiply(inverted(normal.gram, RIDGE * normal.size), normal.right[:, :, None])[:, :, 0]


def by_distance(distances: Array, radius: float) -> Array:
    """Weights (n, k) proportional to 1 / distance, sum 1, without any samples; distances (n, k), inf for no
    neighbour."""
    closeness = 1.0 / np.maximum(distances, NEAREST * radius)
    return closeness / np.maximum(closeness.sum(axis=1, keepdims=True), np.finfo(np.float64).tiny)


def objective(normal: Normal, samples_squared: Array, weights: Array, strength: float) -> Array:
    """|A w - b|^2 + s |w|_1 (n,), s as in `solve`; samples_squared: |b|^2 (n,)."""
    limit = strength * 2.0 * np.abs(normal.right).max(axis=1, initial=0.0)
    bent = small_batched_multiply(normal.gram, weights[:, :, None])[:, :, 0]
    fit = np.sum(weights * (bent - 2.0 * normal.right), axis=1) + samples_squared
    return fit + limit * np.abs(weights).sum(axis=1)


def inverted(matrices: Array, ridge: Array) -> Array:
    """(matrices + ridge I)^-1 of symmetric matrices (n, k, k) without negative eigenvalues, ridge (n,) above zero.

    Gauss-Jordan elimination without exchanges, which positive matrices do not need, for all of them at once.
    """
    count = matrices.shape[1]
    result = np.array(matrices, np.float64)
    diagonal = np.arange(count)
    result[:, diagonal, diagonal] += ridge[:, None]
    floor = ridge[:, None] * 0.5
    for pivot in range(count):
        # What is eliminated exactly leaves the ridge; rounding may leave less.
        over = 1.0 / np.maximum(result[:, pivot, pivot, None], floor)
        row = result[:, pivot] * over
        column = result[:, :, pivot].copy()
        column[:, pivot] = 0.0
        result -= column[:, :, None] * row[:, None, :]
        result[:, :, pivot] = -column * over
        row[:, pivot] = over[:, 0]
        result[:, pivot] = row
    return result


def eigenvalues(matrices: Array) -> Array:
    """Eigenvalues, descending (n, k), of symmetric matrices (n, k, k)."""
    return many_symmetric_eigenpairs(matrices)[0]
