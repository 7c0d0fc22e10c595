# SPDX-License-Identifier: GPL-3.0-or-later
"""Quick classification of points among the subspaces near their own, for all sweeps but the last ones.

From one sweep to the next a point moves to a subspace that passes near its own cluster. Sweeps before the last need not
be exact, as only the state that they lead to counts; `reclassify` is.

Points go where the squared error falls most after the subspaces have followed them, not where it is least as they are
(Hartigan's rule; Telgarsky & Vattani 2010, "Hartigan's Method: k-means Clustering without Voronoi"). With 200 points to
a cluster of 8 vectors a subspace bends towards each of its points by a few percent, and a point stays for that alone. A
point at squared distance d^2 of another subspace adds d^2 / (1 + l) there and takes d^2 / (1 - l) away from its own, l
its leverage (see `_Rule`). Measured (24 x 25 values, 8 vectors): 6 % less squared error on the horse, 3 % on the
Buddha. Whatever the nearest subspace would gain, this gains too, so exact sweeps afterwards undo nothing.
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
# Share of D_(q+1)^2, the energy along the first vector not in use, that is taken from the D_i^2 of those in use: by
# perturbation theory a leverage divides by differences to the unused eigenvalues, which lie between that and zero.
UNUSED = 0.5
# Largest leverage that counts. Many points that would each turn a subspace far their own way can't all have it: without
# this some sweeps raise the error by 5 %.
MOST_LEVERAGE = 0.5


class Sweep(NamedTuple):
    """changed: points that changed cluster; runner_up: (p,) the second best subspace; cost: (K,) by how much the
    squared error would rise if all of a cluster's points went to their second best; unseen: share of all points that
    went to a subspace on no list."""

    changed: int
    runner_up: NDArray[np.int32]
    cost: NDArray[np.float64]
    unseen: float = 0.0


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
    """Of every point its best subspace, the second best, the squared error it would add there, and by how much more it
    would add to the second best: (p,) each."""

    labels: NDArray[np.int32]
    runner_up: NDArray[np.int32]
    squared: Single
    rise: Single

    @staticmethod
    def of(state: Subspaces) -> _Found:
        """To be filled; clusters without neighbours keep their points."""
        points = len(state.labels)
        return _Found(state.labels.copy(), state.labels.copy(), np.zeros(points, np.float32),
                      np.zeros(points, np.float32))

    def applied(self, state: Subspaces, unseen: float = 0.0) -> Sweep:
        """The state takes over the labels."""
        changed = int((self.labels != state.labels).sum())
        state.labels = self.labels
        return Sweep(changed, self.runner_up, np.bincount(self.labels, self.rise, len(state.means)), unseen)


class _Rule(NamedTuple):
    """What decides between K subspaces beside squared distances.

    scales (q, K), shares (K,): a point's leverage in a subspace is sum_i scales_ik w_i^2 + shares_k, w_i its weights
    there: how far the best subspace follows a point, to first order (Jolliffe, Principal Component Analysis (2002),
    10.2). scales: 1 / (D_i^2 - UNUSED D_(q+1)^2); shares: 1 / number of points, for the mean. prices (K,): what the
    weights cost that a point needs there, see `Subspaces.price`.
    """

    scales: Single
    shares: Single
    prices: Single

    def of(self, clusters: NDArray[np.intp]) -> _Rule:
        """For some of them."""
        return _Rule(self.scales[:, clusters], self.shares[clusters], self.prices[clusters])


def _rule(state: Subspaces) -> _Rule:
    """See `_Rule`."""
    most = int(state.vectors.max(initial=0))
    spread = state.spread[:, :most]
    used = (np.arange(most) < state.vectors[:, None]) & (spread > 0.0)
    padded = np.pad(state.spread, ((0, 0), (0, 1)))
    unused = np.take_along_axis(padded, np.minimum(state.vectors, padded.shape[1] - 1)[:, None], axis=1)
    # Whatever the order of the eigenvalues, which a power step may leave a little wrong: half is left at least.
    differences = np.maximum(spread - UNUSED * unused, 0.5 * spread)
    scales = np.divide(1.0, differences, out=np.zeros_like(spread), where=used)
    return _Rule(np.ascontiguousarray(scales.T, np.float32), (1.0 / np.maximum(state.counts, 1)).astype(np.float32),
                 (state.price * state.vectors).astype(np.float32))


def reclassify_near(data: Single, state: Subspaces, lists: NDArray[np.intp], workers: Workers = SERIAL,
                    surveyed: float = 0.0) -> Sweep:
    """Give every point of data (p, d) to the best of the subspaces on its cluster's list, in place.

    In few values, clusters whose means are near share the subspaces on all their lists: a few large products instead of
    many small ones go well in threads, and more subspaces are tried. In many values that arithmetic costs too much.
    surveyed: the points that add most to the squared error, which add this share of it together, are tried with all
    subspaces: a tenth of the points may hold half of it, and the others have little to gain.
    """
    order, ends = by_cluster(state.labels, len(state.means))
    members = [order[start:end] for start, end in itertools.pairwise(ends)]
    found = _Found.of(state)
    classify = _classify_groups if state.means.shape[1] <= NARROW else _classify_alone
    classify(data, state, lists, members, found, workers)
    if surveyed <= 0.0:
        return found.applied(state)
    worst = np.argsort(-found.squared, kind="stable")
    held = np.cumsum(found.squared[worst], dtype=np.float64)
    worst = np.sort(worst[:1 + int(np.searchsorted(held, surveyed * held[-1]))])
    near = found.labels[worst]
    _classify_by_all(data, state, worst, found, True, workers)
    return found.applied(state, float(np.count_nonzero(found.labels[worst] != near)) / len(order))


def _classify_groups(data: Single, state: Subspaces, lists: NDArray[np.intp], members: list[NDArray[np.intp]],
                     found: _Found, workers: Workers) -> None:
    """Clusters in groups. members: the points of each cluster."""
    rows, rule = state.vector_major(), _rule(state)

    def classify(groups: list[NDArray[np.intp]]) -> None:
        for group in groups:
            points = np.concatenate([members[cluster] for cluster in group])
            tried = np.unique(lists[group])
            planes = _Planes.of(state.means[tried], rows[:, tried], rule.of(tried))
            for start in range(0, len(points), ROWS):
                part = points[start:start + ROWS]
                own = np.searchsorted(tried, state.labels[part])
                best, second, found.squared[part], found.rise[part] = planes.two_best(data[part], own)
                found.labels[part], found.runner_up[part] = tried[best], tried[second]

    groups = _neighbouring(state.means, np.flatnonzero(state.counts))
    workers.run(classify, [groups[first:first + TOGETHER] for first in range(0, len(groups), TOGETHER)])


def _classify_alone(data: Single, state: Subspaces, lists: NDArray[np.intp], members: list[NDArray[np.intp]],
                    found: _Found, workers: Workers) -> None:
    """One cluster after the other. Not in threads: their many small products would pass Python's lock back and forth,
    which costs more than it gains."""
    rows, rule = state.vector_major(), _rule(state)
    columns = np.arange(int(state.counts.max()))
    for first in range(0, len(lists), BLOCK):
        planes, offsets, lengths = _planes(state.means, rows, lists[first:first + BLOCK], first)
        for index in range(len(planes)):
            cluster, points = first + index, members[first + index]
            if len(points) == 0:
                continue
            workers.tick()
            near = lists[cluster]
            squared = _added(data[points] - state.means[cluster], planes[index], offsets[index], lengths[index],
                             rule.of(near))
            least, here = squared.argmin(axis=0), columns[:len(points)]
            found.labels[points] = found.runner_up[points] = near[least]
            found.squared[points] = squared[least, here]
            if lists.shape[1] > 1:
                squared[least, here] = np.inf
                least = squared.argmin(axis=0)
                found.rise[points] = squared[least, here] - found.squared[points]
                found.runner_up[points] = near[least]


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


def _added(centred: Single, planes: Single, offsets: Single, lengths: Single, rule: _Rule) -> Single:
    """The squared error (J, m) that points centred (m, d) add to subspaces that `_planes` prepared, of which the first
    is their own, and the price of their weights there."""
    near = len(lengths)
    products = multiply(planes, centred.T)
    squared = products[len(offsets):] * np.float32(-2)
    squared += lengths
    squared += row_squares(centred)
    if len(offsets) == 0:
        return squared
    inside = products[:len(offsets)]
    inside -= offsets
    inside *= inside
    inside = inside.reshape(-1, near, len(centred))
    squared -= np.add.reduce(inside, axis=0)
    inside *= rule.scales[:, :, None]
    leverage = np.add.reduce(inside, axis=0)
    leverage += rule.shares[:, None]
    np.minimum(leverage, MOST_LEVERAGE, out=leverage)
    np.negative(leverage[0], out=leverage[0])
    leverage += 1
    np.maximum(squared, 0, out=squared)  # below zero is rounding
    squared /= leverage
    squared += rule.prices[:, None]
    return squared


def nearest_of_all(data: Single, state: Subspaces, workers: Workers = SERIAL) -> NDArray[np.int32]:
    """The nearest of all subspaces with points to every point of data (p, d), up to rounding against the size of the
    whole signal: (p,)."""
    found = _Found.of(state) if len(state.labels) == len(data) else _Found(
        *(np.zeros(len(data), kind) for kind in (np.int32, np.int32, np.float32, np.float32)))
    _classify_by_all(data, state, np.arange(len(data)), found, False, workers)
    return found.labels


def reclassify_all(data: Single, state: Subspaces, workers: Workers = SERIAL) -> Sweep:
    """Give every point of data (p, d) to the best of all subspaces with points, in place.

    One large product a block: where the values are few, this costs some five sweeps among neighbours and finds
    what they cannot see.
    """
    found = _Found.of(state)
    _classify_by_all(data, state, np.arange(len(data)), found, True, workers)
    return found.applied(state)


def _classify_by_all(data: Single, state: Subspaces, points: NDArray[np.intp], found: _Found, follow: bool,
                     workers: Workers) -> None:
    """Try these points with all subspaces that have any. follow: count how these would follow the points."""
    filled = np.flatnonzero(state.counts).astype(np.int32)
    planes = _Planes.of(state.means[filled], state.vector_major()[:, filled], _rule(state).of(filled))

    def classify(start: int) -> None:
        part = points[start:start + ROWS]
        own = np.searchsorted(filled, state.labels[part]) if follow else None
        best, second, found.squared[part], found.rise[part] = planes.two_best(data[part], own)
        found.labels[part], found.runner_up[part] = filled[best], filled[second]

    workers.run(classify, range(0, len(points), ROWS))


def _neighbouring(means: Single, clusters: NDArray[np.intp]) -> list[NDArray[np.intp]]:
    """Clusters in groups of at most GROUP whose means are near: halved again and again at the median of the value
    that varies most."""
    if len(clusters) <= GROUP:
        return [clusters] if len(clusters) else []
    own = means[clusters]
    order = np.argsort(own[:, np.argmax(own.max(axis=0) - own.min(axis=0))], kind="stable")
    half = len(clusters) // 2
    return _neighbouring(means, clusters[order[:half]]) + _neighbouring(means, clusters[order[half:]])


class _Planes(NamedTuple):
    """Subspaces for large products with points.

    Differences are taken from the means' centre (d,), so that rounding stays small against the clusters' own size. The
    products with the centre come out of the same product as those with the points, from a last value that is 1.
    planes: (q + 1, J, d + 1).
    """

    centre: Single
    planes: Single
    rule: _Rule

    @staticmethod
    def of(means: Single, rows: Single, rule: _Rule) -> _Planes:
        """means (J, d), vectors rows (q, J, d)."""
        most, count, values = rows.shape
        centre = means.mean(axis=0)
        shift = means - centre
        planes = np.empty((most + 1, count, values + 1), np.float32)
        planes[:most, :, :values], planes[most, :, :values] = rows, shift
        planes[:most, :, values] = -(rows * shift).sum(axis=-1)
        planes[most, :, values] = row_squares(shift) * np.float32(-0.5)
        return _Planes(centre, planes, rule)

    def two_best(self, points: Single, own: NDArray[np.intp] | None,
                 ) -> tuple[NDArray[np.intp], NDArray[np.intp], Single, Single]:
        """For points (m, d) the best and second best (m,) of the subspaces, the squared error added to the best, and by
        how much more to the second. own: (m,) the points' own; None compares plain squared distances."""
        most, count, width = self.planes.shape
        offsets = np.ones((len(points), width), np.float32)
        np.subtract(points, self.centre, out=offsets[:, :-1])
        products = multiply(self.planes.reshape(-1, width), offsets.T).reshape(most, count, len(points))
        squared = products[-1]
        squared *= -2
        squared += row_squares(offsets[:, :-1])
        if most > 1:
            inside = products[:-1]
            inside *= inside
            squared -= np.add.reduce(inside, axis=0)
            if own is not None:
                self._follow(squared, inside, own)
        return _two_least(squared)

    def _follow(self, squared: Single, inside: Single, own: NDArray[np.intp]) -> None:
        """From squared distances to what a point adds, in place; inside: (q, J, m) squared weights, lost."""
        inside *= self.rule.scales[:, :, None]
        leverage = np.add.reduce(inside, axis=0)
        leverage += self.rule.shares[:, None]
        np.minimum(leverage, MOST_LEVERAGE, out=leverage)
        here = np.arange(len(own))
        leverage[own, here] *= -1
        leverage += 1
        np.maximum(squared, 0, out=squared)  # below zero is rounding
        squared /= leverage
        squared += self.rule.prices[:, None]


def _two_least(squared: Single) -> tuple[NDArray[np.intp], NDArray[np.intp], Single, Single]:
    """Rows of the least and second least value in every column (m,), the least, and their difference. squared (J, m) is
    lost.

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
        return best, best, (least & ~low).view(np.float32), np.zeros(len(best), np.float32)
    bits[best, np.arange(len(best))] = np.iinfo(np.int32).max
    second = np.minimum.reduce(bits, axis=0)
    values = (least & ~low).view(np.float32)
    return best, second & low, values, (second & ~low).view(np.float32) - values
