# SPDX-License-Identifier: GPL-3.0-or-later
"""Affine subspaces, one per cluster, and their warm update by one block power step and a Rayleigh-Ritz problem.

Kambhatla and Leen's local PCA needs the leading eigenvectors of each cluster's covariance after every classification.
As clusters change little between classifications, one step of block power iteration from the last vectors (W = C B^T,
Z = C^T W) follows them without ever forming an n x n matrix; a Rayleigh-Ritz problem of the block's size orders them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..linear_algebra import multiply, row_squares, small_generalized_eigenpairs, small_symmetric_eigenpairs

# Trailing vectors carried beyond those in use: they speed up the power iteration, are ready when a vector is added, and
# sharpen the bounds of the reclassification.
SPARE = 2

Single = NDArray[np.float32]


class Fit(NamedTuple):
    """One cluster's subspace: mean (d,), orthonormal rows or zeros basis (q, d), squared singular values spread (q,),
    weights (m, q) and squared distances to the mean (m,) of its points."""

    mean: Single
    basis: Single
    spread: NDArray[np.float64]
    weights: Single
    squares: Single


@dataclass
class Subspaces:
    """State of an encode: K affine subspaces and each point's place in its own.

    means (K, d); bases (K, q, d), rows orthonormal or zero; spread (K, q) float64, D_i^2; vectors (K,) how many of
    the q are in use; counts (K,); scatter (K,) float64, summed squared distance to the mean; labels (p,) int32;
    weights (p, q) in the own subspace; squares (p,) squared distance to the own mean.
    """

    means: Single
    bases: Single
    spread: NDArray[np.float64]
    vectors: NDArray[np.int64]
    counts: NDArray[np.int64]
    scatter: NDArray[np.float64]
    labels: NDArray[np.int32]
    weights: Single
    squares: Single

    @property
    def errors(self) -> NDArray[np.float64]:
        """Squared error of each cluster: its scatter less the D_i^2 of the vectors in use (section 4.1)."""
        used = np.arange(self.spread.shape[1]) < self.vectors[:, None]
        return np.maximum(self.scatter - np.where(used, self.spread, 0.0).sum(axis=1), 0.0)

    @property
    def error(self) -> float:
        """Squared error over all points, in the values worked on."""
        return float(self.errors.sum())

    def members(self) -> list[NDArray[np.intp]]:
        """The points of each cluster, in ascending order."""
        order = np.argsort(self.labels, kind="stable")
        return np.split(order, np.cumsum(np.bincount(self.labels, minlength=len(self.means)))[:-1])

    def resize(self, values: int, block: int) -> None:
        """Work on `values` leading values with `block` vectors per cluster: zeros are added or the last ones cut."""
        def fitted(array: NDArray, axis: int, size: int) -> NDArray:
            cut = np.take(array, np.arange(min(size, array.shape[axis])), axis=axis)
            return np.pad(cut, [(0, size - cut.shape[axis]) if i == axis else (0, 0) for i in range(array.ndim)])
        self.means = fitted(self.means, 1, values)
        self.bases = fitted(fitted(self.bases, 2, values), 1, block)
        self.spread = fitted(self.spread, 1, block)
        self.weights = fitted(self.weights, 1, block)


def orthonormal_rows(rows: Single) -> Single:
    """An orthonormal basis (q, d) of the span of rows (q, d); rows beyond the rank are zero and come last.

    Cholesky-QR twice in its form for dependent rows: the Gram matrix's eigenvectors instead of its Cholesky factor,
    and a second pass only where the first met an ill-conditioned Gram matrix.
    """
    for _ in range(2):
        lengths = np.sqrt(row_squares(rows))
        rows = rows / np.where(lengths > 0, lengths, 1)[:, None]
        values, vectors = small_symmetric_eigenpairs(multiply(rows, rows.T).astype(np.float64))
        kept = values > 1e-5 * max(values[0], 1e-30)
        factors = np.where(kept, 1 / np.sqrt(np.where(kept, values, 1)), 0.0)
        rows = multiply((vectors * factors).T.astype(np.float32), rows)
        if values[-1] > 0.1 * values[0]:
            break
    return rows


def fit_subspace(points: Single, start: Single) -> Fit:
    """Fit an affine subspace to points (m, d) by one power step and Rayleigh-Ritz from the rows of start (q, d).

    The rows Z of one power step are scaled to unit length; the subspace's best vectors then solve
    (C Z^T)^T (C Z^T) v = D^2 (Z Z^T) v, C the centred points: orthonormalization and Rayleigh-Ritz in one problem.
    Rows of start that are zero are first replaced by differences of the points farthest from the subspace, so that a
    block grows into directions that it has not seen.
    """
    mean = np.add.reduce(points, axis=0)
    mean /= len(points)
    centred = points - mean
    squares = row_squares(centred)
    if start.shape[0] == 0:
        return Fit(mean, start, np.zeros(0), np.zeros((len(points), 0), np.float32), squares)
    start = _fill(centred, squares, start)
    rows = multiply(multiply(start, centred.T), centred)
    rows /= np.maximum(np.sqrt(row_squares(rows)), np.float32(1e-30))[:, None]
    overlaps = multiply(rows, rows.T).astype(np.float64)
    solved = None
    if np.abs(overlaps).sum(axis=1).max() < 1.9:  # diagonally dominant: rounding cannot spoil orthonormality
        weights = multiply(centred, rows.T)
        solved = small_generalized_eigenpairs(multiply(weights.T, weights).astype(np.float64), overlaps)
    if solved is None:
        rows = orthonormal_rows(rows)
        weights = multiply(centred, rows.T)
        solved = small_symmetric_eigenpairs(multiply(weights.T, weights).astype(np.float64))
    rotation = solved[1].astype(np.float32)
    return Fit(mean, multiply(rotation.T, rows), np.maximum(solved[0], 0.0), multiply(weights, rotation), squares)


def _fill(centred: Single, squares: Single, start: Single) -> Single:
    """Replace zero rows of start by the residuals of the points that start approximates worst."""
    lengths = row_squares(start)
    if len(centred) < 2 or lengths.min() > 0:
        return start
    empty = np.flatnonzero(lengths == 0)
    start = start.copy()
    weights = multiply(centred, start.T)
    worst = np.argsort(-(squares - row_squares(weights)), kind="stable")[:len(empty)]
    start[empty[:len(worst)]] = centred[worst] - multiply(weights[worst], start)
    return start


def squared_distances(points: Single, fit: Fit, vectors: int) -> Single:
    """Squared distances of points (m, d) to a subspace spanned by its leading vectors (section 4.2)."""
    centred = points - fit.mean
    return np.maximum(row_squares(centred) - row_squares(multiply(centred, fit.basis[:vectors].T)), 0.0)


def from_labels(labels: NDArray[np.int32], clusters: int, values: int, vectors: int) -> Subspaces:
    """Unfitted subspaces for a given classification of points; call `update` next."""
    block = vectors + SPARE if vectors else 0
    points = len(labels)
    return Subspaces(
        means=np.zeros((clusters, values), np.float32), bases=np.zeros((clusters, block, values), np.float32),
        spread=np.zeros((clusters, block)), vectors=np.full(clusters, vectors, np.int64),
        counts=np.zeros(clusters, np.int64), scatter=np.zeros(clusters), labels=labels.astype(np.int32),
        weights=np.zeros((points, block), np.float32), squares=np.zeros(points, np.float32))


def update(data: Single, state: Subspaces) -> float:
    """Fit every subspace to its points of data (p, d), in place; returns the squared error in these values.

    A cluster without points keeps its subspace and counts nothing.
    """
    for cluster, members in enumerate(state.members()):
        state.counts[cluster] = len(members)
        if len(members) == 0:
            state.spread[cluster] = 0.0
            state.scatter[cluster] = 0.0
            continue
        fit = fit_subspace(data[members], state.bases[cluster])
        state.means[cluster], state.bases[cluster], state.spread[cluster] = fit.mean, fit.basis, fit.spread
        state.scatter[cluster] = fit.squares.sum(dtype=np.float64)
        state.weights[members], state.squares[members] = fit.weights, fit.squares
    return state.error
