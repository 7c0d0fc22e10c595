# SPDX-License-Identifier: GPL-3.0-or-later
"""Exact classification of every point to the subspace that approximates it best, with few full distances.

Write a point of cluster k as x = u + t, u its projection onto k's carried vectors and r' = |t|. For any other subspace
dist(x, S_j) >= dist(u, S_j) - r', because the distance to a set changes no faster than the point moves, so j can only
win where dist(u, S_j) < r + r', r being the distance to the own subspace (with the vectors in use; r' <= r with all
carried ones). dist(u, S_j)^2 takes products of the block's size only, and before that
dist(u, S_j) >= dist(mean_k, S_j) - |u - mean_k| rules out whole clusters. Only what survives both meets the
full arithmetic, so labels equal brute force's up to ties within rounding.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..linear_algebra import multiply, row_squares
from .subspaces import Single, Subspaces
from .workers import SERIAL, Workers

# Points classified together: the arrays of one step stay in the cache and memory stays bounded.
ROWS = 256
# Clusters whose products with all bases are formed together.
BLOCK = 16
# Values per carried vector up to which the second bound costs more than it saves.
NARROW = 4
# Relative slack on bounds, so that rounding never prunes a winner.
SLACK = 1e-3


@dataclass(frozen=True)
class _Bases:
    """The vectors in use of all clusters, ordered vector-major: rows i * K + j hold vector i of the j-th cluster."""

    rows: Single
    means: Single
    mean_weights: NDArray[np.float64]

    @staticmethod
    def of(state: Subspaces) -> _Bases:
        rows = state.vector_major()
        own = np.stack([(vector.astype(np.float64) * state.means).sum(axis=1) for vector in rows]) \
            if len(rows) else np.zeros((0, len(state.means)))
        return _Bases(rows, state.means, own)


def reclassify(data: Single, state: Subspaces, workers: Workers = SERIAL) -> int:
    """Give every point of data (p, d) to its nearest subspace, in place; returns how many points changed cluster.

    A point stays where it is unless another subspace is nearer; clusters without points win nothing.
    """
    bases = _Bases.of(state)
    members = state.members()
    labels = state.labels.copy()

    def classify(first: int) -> None:
        block = range(first, min(first + BLOCK, len(members)))
        offsets, apart = _offsets(state, bases, block), _mean_distances(state.means, block)
        for cluster, offset, distances in zip(block, offsets, apart, strict=True):
            if len(members[cluster]):
                _reclassify_cluster(data, state, bases, members[cluster], cluster, offset, distances, labels)

    workers.run(classify, range(0, len(members), BLOCK))
    changed = int((labels != state.labels).sum())
    state.labels = labels
    return changed


def _offsets(state: Subspaces, bases: _Bases, block: range) -> list[Single]:
    """For each cluster k of the block, the weights (q, K) that each subspace j gives to mean_k - mean_j."""
    most, clusters, values = bases.rows.shape
    if most == 0:
        return [np.zeros((0, clusters), np.float32) for _ in block]
    flat = bases.rows.reshape(most * clusters, values)
    products = multiply(flat, state.means[block.start:block.stop].T).reshape(most, clusters, len(block))
    return [(products[:, :, i] - bases.mean_weights).astype(np.float32) for i in range(len(block))]


def _mean_distances(means: Single, block: range) -> Single:
    """Squared distances (block, K) between the means of a block of clusters and all means, from double precision."""
    double = means.astype(np.float64)
    lengths = row_squares(double)
    chosen = double[block.start:block.stop]
    squared = lengths[block.start:block.stop, None] + lengths - 2 * multiply(chosen, double.T)
    return np.maximum(squared, 0.0).astype(np.float32)


def _reclassify_cluster(data: Single, state: Subspaces, bases: _Bases, members: NDArray[np.intp], cluster: int,
                        offset: Single, apart: Single, labels: NDArray[np.int32]) -> None:
    """Classify the points of one cluster, writing into labels. offset: (q, K); apart: (K,)."""
    plane = np.sqrt(np.maximum(apart - np.add.reduce(offset * offset, axis=0), 0.0))
    plane[cluster] = np.inf
    plane[state.counts == 0] = np.inf
    centred = data[members] - state.means[cluster]
    weights = multiply(centred, state.bases[cluster].T)
    lengths, own, rest = _split_lengths(weights, row_squares(centred), int(state.vectors[cluster]))
    reach = (lengths + own + rest) * np.float32(1 + SLACK)
    near = np.flatnonzero(plane < reach.max(initial=0.0))
    if len(near) == 0:
        return
    near = near[np.argsort(plane[near], kind="stable")]
    gathered = np.ascontiguousarray(bases.rows[:, near])
    shift = bases.means[near] - bases.means[cluster]
    candidate = _Candidates(near, gathered, shift, apart[near], offset[:, near], plane[near])
    order = np.argsort(reach, kind="stable")
    if centred.shape[1] <= NARROW * state.bases.shape[1]:
        for start in range(0, len(order), ROWS):
            rows = order[start:start + ROWS]
            within = int(np.searchsorted(candidate.plane, reach[rows[-1]]))
            if within:
                _take(candidate.first(within), members[rows], centred[rows], own[rows], labels)
        return
    inner = candidate.inner(state.bases[cluster])
    for start in range(0, len(order), ROWS):
        rows = order[start:start + ROWS]
        within = int(np.searchsorted(candidate.plane, reach[rows[-1]]))
        if within == 0:
            continue
        possible = candidate.possible(within, inner, weights[rows], (own + rest)[rows] * np.float32(1 + SLACK))
        _full_distances(centred[rows], candidate, possible, members[rows], own[rows], labels)


def _split_lengths(weights: Single, squares: Single, used: int) -> tuple[Single, Single, Single]:
    """Per point |u - mean| of its projection on all carried vectors, its distance to the own subspace with the vectors
    in use, and r' with all carried ones. weights: (m, q); squares: (m,) squared distances to the own mean."""
    inside, spare = row_squares(weights[:, :used]), row_squares(weights[:, used:])
    own = np.maximum(squares - inside, 0.0)
    return np.sqrt(inside + spare), np.sqrt(own), np.sqrt(np.maximum(own - spare, 0.0))


@dataclass(frozen=True)
class _Candidates:
    """Subspaces that may win a point of one cluster, nearest first, relative to that cluster's mean."""

    clusters: NDArray[np.intp]
    rows: Single
    shift: Single
    apart: Single
    offset: Single
    plane: Single

    def inner(self, basis: Single) -> tuple[Single, Single]:
        """The candidates' vectors (q, J, b) and shifts (J, b) in the coordinates of a basis (b, d)."""
        most, count, values = self.rows.shape
        flat = multiply(self.rows.reshape(most * count, values), basis.T)
        return flat.reshape(most, count, len(basis)), multiply(self.shift, basis.T)

    def possible(self, within: int, inner: tuple[Single, Single], weights: Single, reach: Single) -> NDArray[np.bool_]:
        """Which of the first `within` candidates may win which points: (within, m)."""
        rows, shift = inner[0][:, :within], inner[1][:within]
        lengths = row_squares(weights)
        gap = self._squared(rows, shift, within, weights, lengths)
        slack = np.float32(1e-5) * (self.apart[:within, None] + lengths)
        return gap - slack < reach * reach

    def _squared(self, rows: Single, shift: Single, within: int, offsets: Single, lengths: Single) -> Single:
        """Squared distances (within, m) of points to subspaces from rows (q, within, b), shift (within, b), the
        points' offsets from the own mean (m, b) and their squared lengths."""
        gap = multiply(shift, offsets.T)
        gap *= -2
        gap += lengths
        gap += self.apart[:within, None]
        most, _, width = rows.shape
        if most:
            projected = multiply(np.ascontiguousarray(rows).reshape(most * within, width), offsets.T)
            projected = projected.reshape(most, within, len(offsets))
            projected += self.offset[:, :within, None]
            projected *= projected
            gap -= projected.sum(axis=0)
        return gap

    def first(self, within: int) -> _Candidates:
        """The nearest of them."""
        if within == len(self.clusters):
            return self
        return _Candidates(self.clusters[:within], self.rows[:, :within], self.shift[:within], self.apart[:within],
                           self.offset[:, :within], self.plane[:within])

    def subset(self, chosen: NDArray[np.intp]) -> _Candidates:
        """Only the chosen candidates."""
        return _Candidates(self.clusters[chosen], self.rows[:, chosen], self.shift[chosen], self.apart[chosen],
                           self.offset[:, chosen], self.plane[chosen])


def _full_distances(centred: Single, candidate: _Candidates, possible: NDArray[np.bool_], points: NDArray[np.intp],
                    own: Single, labels: NDArray[np.int32]) -> None:
    """Full distances of the points, centred (m, d) on their own mean, that another subspace may win; the nearest takes
    them."""
    columns = np.flatnonzero(possible.any(axis=0))
    if len(columns) == 0:
        return
    chosen = candidate.subset(np.flatnonzero(possible[:, columns].any(axis=1)))
    _take(chosen, points[columns], centred[columns], own[columns], labels)


def _take(chosen: _Candidates, points: NDArray[np.intp], centred: Single, own: Single,
          labels: NDArray[np.int32]) -> None:
    """Full distances of all points, centred (m, d) on their own mean, to the chosen subspaces; where the nearest is
    nearer than `own` it takes the point."""
    squared = chosen._squared(chosen.rows, chosen.shift, len(chosen.clusters), centred, row_squares(centred))
    best = squared.argmin(axis=0)
    wins = squared[best, np.arange(len(points))] < own * own
    labels[points[wins]] = chosen.clusters[best[wins]]
