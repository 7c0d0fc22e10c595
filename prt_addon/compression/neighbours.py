# SPDX-License-Identifier: GPL-3.0-or-later
"""Quick classification of points among the subspaces near their own, for all sweeps but the last ones.

From one sweep to the next a point moves to a subspace that passes near its own cluster. Sweeps before the last need not
be exact, as only the state that they lead to counts; `reclassify` is.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..linear_algebra import multiply, row_squares
from .monitor import Tick, no_tick
from .subspaces import Single, Subspaces, by_cluster

# Subspaces of the nearest means among which a point is classified, its own included, and others that take turns.
NEAREST, OTHERS, STRIDE = 12, 6, 6
MEMORY = 0.5
# Clusters whose neighbours' vectors are gathered together.
BLOCK = 16


class Sweep(NamedTuple):
    """changed: points that changed cluster; runner_up: (p,) the second nearest subspace; cost: (K,) by how much the
    squared error would rise if all of a cluster's points went to their second nearest."""

    changed: int
    runner_up: NDArray[np.int32]
    cost: NDArray[np.float64]


class Neighbours:
    """Which subspaces to try for the points of each cluster, learnt from where points went and would go next."""

    def __init__(self, clusters: int) -> None:
        self.hits = np.zeros((clusters, clusters))
        self.turn = 0

    def lists(self, state: Subspaces) -> NDArray[np.intp]:
        """Subspaces to try for each cluster's points: (K, NEAREST + OTHERS or K if fewer), the cluster itself first.

        First those seen to be near, most often seen first, then those whose means are near; of all beyond the first
        NEAREST every STRIDE-th, different ones each turn, so that in STRIDE turns many have their chance.
        """
        means = state.means.astype(np.float64)
        lengths = row_squares(means)
        apart = np.maximum(lengths[:, None] + lengths - 2 * multiply(means, means.T), 0.0)
        apart = np.where(self.hits >= 1, -self.hits, apart)
        apart[:, state.counts == 0] = np.inf
        np.fill_diagonal(apart, -np.inf)
        order = np.argsort(apart, axis=1)[:, :NEAREST + STRIDE * OTHERS]
        self.turn += 1
        return np.concatenate([order[:, :NEAREST], order[:, NEAREST + self.turn % STRIDE::STRIDE]], axis=1)

    def learn(self, before: NDArray[np.int32], after: NDArray[np.int32], runner_up: NDArray[np.int32]) -> None:
        """Remember a classification: labels before and after it and the second nearest subspaces."""
        clusters = len(self.hits)
        self.hits *= MEMORY
        for start, end in ((before, after), (after, runner_up)):
            self.hits += np.bincount(start.astype(np.intp) * clusters + end, minlength=clusters**2).reshape(
                clusters, clusters)


def reclassify_near(data: Single, state: Subspaces, lists: NDArray[np.intp], tick: Tick = no_tick) -> Sweep:
    """Give every point of data (p, d) to the nearest of the subspaces on its cluster's list, in place."""
    order, ends = by_cluster(state.labels, len(state.means))
    rows = state.vector_major()
    near = lists.shape[1]
    best, second = np.empty(len(order), np.intp), np.empty(len(order), np.intp)
    rise = np.zeros(len(order), np.float32)
    columns = np.arange(int(state.counts.max()))
    for first in range(0, len(lists), BLOCK):
        block = slice(first, first + BLOCK)
        planes, offsets, lengths = _planes(state.means, rows, lists[block], first)
        for index in range(len(planes)):
            start, end = ends[first + index:first + index + 2]
            if start == end:
                continue
            tick()
            squared = _squared(data[order[start:end]] - state.means[first + index], planes[index], offsets[index],
                               lengths[index])
            least = best[start:end] = squared.argmin(axis=0)
            here = columns[:end - start]
            rise[start:end] = squared[least, here]
            if near > 1:
                squared[least, here] = np.inf
                least = second[start:end] = squared.argmin(axis=0)
                rise[start:end] = squared[least, here] - rise[start:end]
    own = np.repeat(np.arange(len(lists)), np.diff(ends))
    labels, runner_up = np.empty_like(state.labels), np.empty_like(state.labels)
    labels[order] = lists[own, best]
    runner_up[order] = lists[own, second if near > 1 else best]
    cost = np.bincount(labels[order], rise, len(lists))
    changed = int((labels != state.labels).sum())
    state.labels = labels
    return Sweep(changed, runner_up, cost)


def _planes(means: Single, rows: Single, lists: NDArray[np.intp], first: int) -> tuple[Single, Single, Single]:
    """For a block of clusters from `first`, of the subspaces j on their lists (b, J): per cluster the rows of all
    vectors of the j and at last mean_j - mean ((q + 1) J, d); the vectors' products with that (q J, 1); its squared
    length (J, 1)."""
    block, _near = lists.shape
    shift = means[lists] - means[first:first + block, None]
    planes = np.concatenate([rows[:, lists], shift[None]]).transpose(1, 0, 2, 3)
    planes = np.ascontiguousarray(planes)
    offsets = (planes[:, :-1] * shift[:, None]).sum(axis=-1)
    return planes.reshape(block, -1, means.shape[1]), offsets.reshape(block, -1, 1), row_squares(shift)[:, :, None]


def _squared(centred: Single, planes: Single, offsets: Single, lengths: Single) -> Single:
    """Squared distances (J, m), less the points' own squared lengths, of points centred (m, d) to subspaces that
    `_planes` prepared."""
    near = len(lengths)
    products = multiply(planes, centred.T)
    squared = products[len(offsets):] * np.float32(-2)
    squared += lengths
    if len(offsets):
        inside = products[:len(offsets)]
        inside -= offsets
        inside *= inside
        squared -= np.add.reduce(inside.reshape(-1, near, len(centred)), axis=0)
    return squared
