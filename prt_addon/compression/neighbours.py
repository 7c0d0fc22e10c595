# SPDX-License-Identifier: GPL-3.0-or-later
"""Quick classification of points among the subspaces near their own, for all sweeps but the last ones.

From one sweep to the next a point moves to a subspace that passes near its own cluster. Sweeps before the last need not
be exact, as only the state that they lead to counts; `reclassify` is.
"""

from __future__ import annotations

import itertools
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..linear_algebra import multiply, row_squares
from .subspaces import NARROW, Single, Subspaces, by_cluster
from .workers import SERIAL, Workers

# Subspaces of the nearest means among which a point is classified, its own included, and others that take turns.
NEAREST, OTHERS, STRIDE = 12, 6, 6
MEMORY = 0.5
# Clusters whose neighbours' vectors are gathered together.
BLOCK = 16
# Clusters at most that share their lists, points classified in one product, groups that a thread takes at a time.
# Not a power of two: columns that far apart would share the same few lines of the cache.
GROUP, ROWS, TOGETHER = 4, 1000, 4


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


class _Found(NamedTuple):
    """Of every point its nearest subspace, the second nearest, and by how much that is farther (squared): (p,) each."""

    labels: NDArray[np.int32]
    runner_up: NDArray[np.int32]
    rise: Single


def reclassify_near(data: Single, state: Subspaces, lists: NDArray[np.intp], workers: Workers = SERIAL) -> Sweep:
    """Give every point of data (p, d) to the nearest of the subspaces on its cluster's list, in place.

    In few values, clusters whose means are near share the subspaces on all their lists: a few large products instead of
    many small ones go well in threads, and more subspaces are tried. In many values that arithmetic costs too much.
    """
    order, ends = by_cluster(state.labels, len(state.means))
    members = [order[start:end] for start, end in itertools.pairwise(ends)]
    found = _Found(state.labels.copy(), state.labels.copy(), np.zeros(len(order), np.float32))
    classify = _classify_groups if state.means.shape[1] <= NARROW else _classify_alone
    classify(data, state, lists, members, found, workers)
    cost = np.bincount(found.labels, found.rise, len(lists))
    changed = int((found.labels != state.labels).sum())
    state.labels = found.labels
    return Sweep(changed, found.runner_up, cost)


def _classify_groups(data: Single, state: Subspaces, lists: NDArray[np.intp], members: list[NDArray[np.intp]],
                     found: _Found, workers: Workers) -> None:
    """Clusters in groups. members: the points of each cluster."""
    rows = state.vector_major()

    def classify(groups: list[NDArray[np.intp]]) -> None:
        for group in groups:
            points = np.concatenate([members[cluster] for cluster in group])
            tried = np.unique(lists[group])
            for start in range(0, len(points), ROWS):
                part = points[start:start + ROWS]
                best, second, found.rise[part] = _two_nearest(data[part], state.means[tried], rows[:, tried])
                found.labels[part], found.runner_up[part] = tried[best], tried[second]

    groups = _neighbouring(state.means, np.flatnonzero(state.counts))
    workers.run(classify, [groups[first:first + TOGETHER] for first in range(0, len(groups), TOGETHER)])


def _classify_alone(data: Single, state: Subspaces, lists: NDArray[np.intp], members: list[NDArray[np.intp]],
                    found: _Found, workers: Workers) -> None:
    """One cluster after the other. Not in threads: their many small products would pass Python's lock back and forth,
    which costs more than it gains."""
    rows = state.vector_major()
    columns = np.arange(int(state.counts.max()))
    for first in range(0, len(lists), BLOCK):
        planes, offsets, lengths = _planes(state.means, rows, lists[first:first + BLOCK], first)
        for index in range(len(planes)):
            cluster, points = first + index, members[first + index]
            if len(points) == 0:
                continue
            workers.tick()
            squared = _squared(data[points] - state.means[cluster], planes[index], offsets[index], lengths[index])
            least, here = squared.argmin(axis=0), columns[:len(points)]
            found.labels[points] = found.runner_up[points] = lists[cluster, least]
            if lists.shape[1] > 1:
                nearest = squared[least, here]
                squared[least, here] = np.inf
                least = squared.argmin(axis=0)
                found.rise[points] = squared[least, here] - nearest
                found.runner_up[points] = lists[cluster, least]


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


def nearest_of_all(data: Single, state: Subspaces, workers: Workers = SERIAL) -> NDArray[np.int32]:
    """The nearest of all subspaces with points to every point of data (p, d), up to rounding against the size of the
    whole signal: (p,)."""
    return _all_distances(data, state, workers).labels


def reclassify_all(data: Single, state: Subspaces, workers: Workers = SERIAL) -> Sweep:
    """Give every point of data (p, d) to the nearest of all subspaces with points, in place.

    One large product a block: where the values are few, this costs some five sweeps among neighbours and finds
    what they cannot see.
    """
    found = _all_distances(data, state, workers)
    changed = int((found.labels != state.labels).sum())
    state.labels = found.labels
    return Sweep(changed, found.runner_up, np.bincount(found.labels, found.rise, len(state.means)))


def _all_distances(data: Single, state: Subspaces, workers: Workers) -> _Found:
    filled = np.flatnonzero(state.counts).astype(np.int32)
    means, rows = state.means[filled], state.vector_major()[:, filled]
    found = _Found(np.empty(len(data), np.int32), np.empty(len(data), np.int32), np.empty(len(data), np.float32))

    def classify(start: int) -> None:
        part = slice(start, start + ROWS)
        best, second, found.rise[part] = _two_nearest(data[part], means, rows)
        found.labels[part], found.runner_up[part] = filled[best], filled[second]

    workers.run(classify, range(0, len(data), ROWS))
    return found


def _neighbouring(means: Single, clusters: NDArray[np.intp]) -> list[NDArray[np.intp]]:
    """Clusters in groups of at most GROUP whose means are near: halved again and again at the median of the value
    that varies most."""
    if len(clusters) <= GROUP:
        return [clusters] if len(clusters) else []
    own = means[clusters]
    order = np.argsort(own[:, np.argmax(own.max(axis=0) - own.min(axis=0))], kind="stable")
    half = len(clusters) // 2
    return _neighbouring(means, clusters[order[:half]]) + _neighbouring(means, clusters[order[half:]])


def _two_nearest(points: Single, means: Single, rows: Single) -> tuple[NDArray[np.intp], NDArray[np.intp], Single]:
    """For points (m, d) the nearest and second nearest (m,) of the subspaces with means (J, d) and vectors rows
    (q, J, d), and the difference of their squared distances.

    Differences are taken from the means' centre, so that rounding stays small against the clusters' own size. The
    products with the centre come out of the same product as those with the points, from a last value that is 1.
    """
    most, count, values = rows.shape
    centre = means.mean(axis=0)
    shift = means - centre
    planes = np.empty((most + 1, count, values + 1), np.float32)
    planes[:most, :, :values], planes[most, :, :values] = rows, shift
    planes[:most, :, values] = -(rows * shift).sum(axis=-1)
    planes[most, :, values] = row_squares(shift) * np.float32(-0.5)
    offsets = np.ones((len(points), values + 1), np.float32)
    np.subtract(points, centre, out=offsets[:, :values])
    products = multiply(planes.reshape(-1, values + 1), offsets.T).reshape(most + 1, count, len(points))
    squared = products[most]
    squared *= -2
    squared += row_squares(offsets[:, :values])
    if most:
        inside = products[:most]
        inside *= inside
        squared -= np.add.reduce(inside, axis=0)
    return _two_least(squared)


def _two_least(squared: Single) -> tuple[NDArray[np.intp], NDArray[np.intp], Single]:
    """Rows of the least and second least value in every column (m,), and their difference. squared (J, m) is lost.

    The row's number replaces the last bits of each value, so that a minimum, several times faster than an argmin, tells
    both. That changes values by J / 2^23 of themselves at most, far less than a sweep among neighbours must tell apart.
    """
    count = len(squared)
    low = np.int32((1 << (count - 1).bit_length()) - 1)
    np.maximum(squared, 0, out=squared)  # below zero is rounding, where the order of bits would turn round
    bits = squared.view(np.int32)
    bits &= ~low
    bits |= np.arange(count, dtype=np.int32)[:, None]
    least = np.minimum.reduce(bits, axis=0)
    best = least & low
    if count == 1:
        return best, best, np.zeros(len(best), np.float32)
    bits[best, np.arange(len(best))] = np.iinfo(np.int32).max
    second = np.minimum.reduce(bits, axis=0)
    return best, second & low, (second & ~low).view(np.float32) - (least & ~low).view(np.float32)
