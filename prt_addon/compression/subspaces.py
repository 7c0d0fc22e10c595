# SPDX-License-Identifier: GPL-3.0-or-later
"""Affine subspaces, one per cluster, and their update from the points classified to them.

Kambhatla and Leen's local PCA needs the leading eigenvectors of each cluster's covariance after every classification.
In few values the covariance is small and solved outright. In many, clusters change little between classifications, so
one step of block power iteration from the last vectors (W = C B^T, Z = C^T W) follows them without ever forming an
n x n matrix; a Rayleigh-Ritz problem of the block's size orders them.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..linear_algebra import (
    many_symmetric_eigenpairs,
    multiply,
    row_squares,
    small_generalized_eigenpairs,
    small_symmetric_eigenpairs,
)
from .workers import SERIAL, Workers

# Trailing vectors carried beyond those in use: they speed up the power iteration, are ready when a vector is added, and
# sharpen the bounds of the reclassification.
SPARE = 2
# Values up to which a cluster's whole eigenproblem costs less than a power step.
NARROW = 32
# Clusters that one thread fits at a time. Constant, so that results never depend on the threads.
BLOCK = 16
# Eigenvalues below this share of the largest are rounding of single-precision data.
NEGLIGIBLE = 1e-13

Single = NDArray[np.float32]


class Fit(NamedTuple):
    """One cluster's subspace: mean (d,), orthonormal rows or zeros basis (q, d), squared singular values spread (q,),
    and the summed squared distance of its points to the mean."""

    mean: Single
    basis: Single
    spread: NDArray[np.float64]
    scatter: float


@dataclass
class Subspaces:
    """State of an encode: K affine subspaces and each point's cluster.

    means (K, d); bases (K, q, d), rows orthonormal or zero; spread (K, q) float64, D_i^2; vectors (K,) how many of
    the q are in use; counts (K,); scatter (K,) float64, summed squared distance to the mean; labels (p,) int32.
    """

    means: Single
    bases: Single
    spread: NDArray[np.float64]
    vectors: NDArray[np.int64]
    counts: NDArray[np.int64]
    scatter: NDArray[np.float64]
    labels: NDArray[np.int32]
    price: float = 0.0

    @property
    def errors(self) -> NDArray[np.float64]:
        """Squared error of each cluster: its scatter less the D_i^2 of the vectors in use (section 4.1)."""
        used = np.arange(self.spread.shape[1]) < self.vectors[:, None]
        return np.maximum(self.scatter - np.where(used, self.spread, 0.0).sum(axis=1), 0.0)

    @property
    def error(self) -> float:
        """Squared error over all points, in the values worked on."""
        return float(self.errors.sum())

    def copy(self) -> Subspaces:
        """An independent copy."""
        return replace(self, **{name: np.copy(value) if isinstance(value, np.ndarray) else value
                                for name, value in vars(self).items()})

    def assign(self, other: Subspaces) -> None:
        """Take over another state's arrays."""
        vars(self).update(vars(other))

    def members(self) -> list[NDArray[np.intp]]:
        """The points of each cluster, in ascending order."""
        order, ends = by_cluster(self.labels, len(self.means))
        return [order[start:end] for start, end in itertools.pairwise(ends)]

    def resize(self, values: int, block: int) -> None:
        """Work on `values` leading values with `block` vectors per cluster: zeros are added or the last ones cut."""
        self.means = _fitted(self.means, 1, values)
        self.bases = _fitted(_fitted(self.bases, 2, values), 1, block)
        self.spread = _fitted(self.spread, 1, block)

    def vector_major(self) -> Single:
        """The vectors in use (q, K, d), zero where a cluster has fewer."""
        most = int(self.vectors.max(initial=0))
        used = np.arange(most)[:, None, None] < self.vectors[None, :, None]
        return np.where(used, self.bases[:, :most].transpose(1, 0, 2), np.float32(0))


def _fitted(array: NDArray, axis: int, size: int) -> NDArray:
    """An axis of an array brought to a size: zeros are added or the last entries cut."""
    if array.shape[axis] == size:
        return array
    cut = np.take(array, np.arange(min(size, array.shape[axis])), axis=axis)
    return np.pad(cut, [(0, size - cut.shape[axis]) if i == axis else (0, 0) for i in range(array.ndim)])


def by_cluster(labels: NDArray[np.int32], clusters: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """The points ordered by label, ascending within one, and where each label's points start and the last's end."""
    order = np.argsort(labels.astype(np.uint16) if clusters <= 1 << 16 else labels, kind="stable")
    return order, np.append(0, np.cumsum(np.bincount(labels, minlength=clusters)))


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
    """Fit an affine subspace to points (m, d): exactly where they have few values or vectors are many, else by one
    power step from the rows of start (q, d)."""
    mean = np.add.reduce(points, axis=0)
    mean /= len(points)
    centred = points - mean
    block, values = start.shape
    if block == 0:
        return Fit(mean, start, np.zeros(0), float(row_squares(centred).sum(dtype=np.float64)))
    if values <= max(NARROW, block):
        return _solve(mean, centred, block)
    return _power_step(mean, centred, start)


def _solve(mean: Single, centred: Single, block: int) -> Fit:
    """The leading eigenvectors of the covariance of centred points (m, d)."""
    double = centred.astype(np.float64)
    covariance = multiply(double.T, double)
    squares, columns = small_symmetric_eigenpairs(covariance)
    block, most = min(block, len(squares)), block
    basis = np.zeros((most, len(mean)), np.float32)
    spread = np.zeros(most)
    spread[:block] = squares[:block]
    spread[spread < NEGLIGIBLE * spread[0]] = 0.0
    basis[:block] = columns[:, :block].T
    basis[spread <= 0.0] = 0.0
    return Fit(mean, basis, np.maximum(spread, 0.0), float(covariance.trace()))


def _power_step(mean: Single, centred: Single, start: Single) -> Fit:
    """One power step and Rayleigh-Ritz on centred points (m, d) from the rows of start (q, d).

    The rows Z of one power step are scaled to unit length; the subspace's best vectors then solve
    (C Z^T)^T (C Z^T) v = D^2 (Z Z^T) v, C the centred points: orthonormalization and Rayleigh-Ritz in one problem.
    Rows of start that are zero are first replaced by differences of the points farthest from the subspace, so that a
    block grows into directions that it has not seen.
    """
    squares = row_squares(centred)
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
    return Fit(mean, multiply(solved[1].astype(np.float32).T, rows), np.maximum(solved[0], 0.0),
               float(squares.sum(dtype=np.float64)))


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
    squared = row_squares(centred)
    if vectors:
        squared -= row_squares(multiply(centred, fit.basis[:vectors].T))
    return np.maximum(squared, 0.0, out=squared)


def from_labels(labels: NDArray[np.int32], clusters: int, values: int, vectors: int) -> Subspaces:
    """Unfitted subspaces for a given classification of points; call `update` next."""
    block = vectors + SPARE
    return Subspaces(
        means=np.zeros((clusters, values), np.float32), bases=np.zeros((clusters, block, values), np.float32),
        spread=np.zeros((clusters, block)), vectors=np.full(clusters, vectors, np.int64),
        counts=np.zeros(clusters, np.int64), scatter=np.zeros(clusters), labels=labels.astype(np.int32))


def update(data: Single, state: Subspaces, workers: Workers = SERIAL) -> float:
    """Fit every subspace to its points of data (p, d), in place; returns the squared error in these values.

    A cluster without points keeps its subspace and counts nothing.
    """
    order, ends = by_cluster(state.labels, len(state.means))
    state.counts = np.diff(ends)
    block, values = state.bases.shape[1:]
    if block > 0 and values <= max(NARROW, block):
        _solve_all(data, order, ends, state, workers)
        return state.error
    state.spread[state.counts == 0] = 0.0
    state.scatter[state.counts == 0] = 0.0
    # Not in threads: these products are so small that passing Python's lock back and forth costs more than it gains.
    for cluster in np.flatnonzero(state.counts):
        workers.tick()
        fit = fit_subspace(data[order[ends[cluster]:ends[cluster + 1]]], state.bases[cluster])
        state.means[cluster], state.bases[cluster], state.spread[cluster], state.scatter[cluster] = fit
    return state.error


def _solve_all(data: Single, order: NDArray[np.intp], ends: NDArray[np.intp], state: Subspaces,
               workers: Workers) -> None:
    """Exact subspaces of all clusters from their second moments about the means in double precision."""
    block, values = state.bases.shape[1:]
    used = min(block, values)
    empty = state.counts == 0
    state.spread[:], state.scatter[empty] = 0.0, 0.0

    def solve(clusters: NDArray[np.intp]) -> None:
        first = ends[clusters[0]]
        counts, starts = state.counts[clusters], ends[clusters] - first
        grouped = data[order[first:ends[clusters[-1] + 1]]].astype(np.float64)
        means = np.add.reduceat(grouped, starts, axis=0) / counts[:, None]
        grouped -= np.repeat(means, counts, axis=0)
        covariances = np.empty((len(clusters), values, values))
        for row, (start, count) in enumerate(zip(starts, counts, strict=True)):
            points = grouped[start:start + count]
            multiply(points.T, points, out=covariances[row])
        squares, rows = many_symmetric_eigenpairs(covariances)
        spread = np.maximum(squares[:, :used], 0.0)
        spread[spread < NEGLIGIBLE * spread[:, :1]] = 0.0
        state.means[clusters] = means
        state.scatter[clusters] = covariances.trace(axis1=1, axis2=2)
        state.spread[clusters, :used] = spread
        state.bases[clusters, :used] = rows[:, :used] * (spread > 0)[:, :, None]
        state.bases[clusters, used:] = 0.0

    filled = np.flatnonzero(state.counts)
    workers.run(solve, [filled[first:first + BLOCK] for first in range(0, len(filled), BLOCK)])
