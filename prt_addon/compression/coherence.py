# SPDX-License-Identifier: GPL-3.0-or-later
"""How clusters lie on the surface, and how to make them lie better (Sloan et al. 2003, section 5).

The paper draws a triangle once for every cluster that its points are in. Points whose move to a neighbour's cluster
unmixes triangles are moved while a budget of squared error lasts; clusters are joined into superclusters that are drawn
as one as long as their constants fit into the vertex shader's registers.
"""

from __future__ import annotations

import heapq
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ..errors import BadArguments
from ..linear_algebra import multiply, row_squares, small_batched_multiply
from .encoding import Encoding
from .global_frame import metric_roots
from .subspaces import by_cluster
from .workers import Tick, no_tick

# Points whose errors are formed together.
CHUNK = 4096
# Share of the budget spent between two looks at which moves are best now.
STEP = 1.0 / 16.0
# Share of the budget kept back for rounding of the sums that it is spent by.
ROUNDING = 1e-6
# Constants of four values each that a vertex shader could read in 2003, about (section 6).
REGISTERS = 256

Double = NDArray[np.float64]


@dataclass(frozen=True)
class Coherence:
    """What reclassification and superclusters bring; overdraw is the mean number of (super)clusters per triangle.

    before: of the clusters as encoded; reclassified: with points moved; superclustered: with superclusters alone; both.
    squared_error_before, squared_error_after: of all points, in the metric. moved: points with a new cluster.
    superclusters: their number after both.
    """

    before: float
    reclassified: float
    superclustered: float
    both: float
    squared_error_before: float
    squared_error_after: float
    moved: int
    superclusters: int


def overdraw(triangles: NDArray[np.integer], cluster: NDArray[np.integer]) -> float:
    """Mean over triangles of how many different clusters their three points are in: 1 at best, 3 at worst.

    triangles: (t, 3) indices of points; cluster: (p,). No triangles count as 1.
    """
    if len(triangles) == 0:
        return 1.0
    corners = np.sort(cluster[triangles], axis=1)
    return float(1 + (np.diff(corners, axis=1) != 0).sum(axis=1).mean())


def make_coherent(encoding: Encoding, triangles: NDArray[np.integer], signal: NDArray[np.floating], share: float,
                  metric: NDArray | None = None, rows: int = 1, registers: int = REGISTERS,
                  tick: Tick = no_tick) -> tuple[Encoding, Coherence]:
    """The encoding with points reclassified for less overdraw, and what that and superclusters bring.

    triangles: (t, 3) indices of the encoding's points; signal: (p, n) and metric as given to `encode`; share: of the
    squared error that may be added (the paper: 0.05 to 0.1). rows: of a point's matrix; registers: see `superclusters`.
    tick: may raise to cancel. Raises BadArguments for a share that is negative or no number.
    """
    if not (np.isfinite(share) and share >= 0):
        raise BadArguments("coherence", f"{share} is no share of the squared error", "Use 0.05 to 0.1")
    search = _Search.of(triangles, _Distances.of(encoding, signal, metric), tick)
    before = float(search.errors.sum())
    search.run(share * before * (1 - ROUNDING))
    moved = _moved_encoding(encoding, search)
    groups = [superclusters(triangles, e.cluster, cluster_registers(e, rows), registers) for e in (encoding, moved)]
    drawn = [overdraw(triangles, group[e.cluster]) for group, e in zip(groups, (encoding, moved), strict=True)]
    after = before if moved is encoding else moved.squared_error
    return moved, Coherence(
        overdraw(triangles, encoding.cluster), overdraw(triangles, moved.cluster), *drawn, before, after,
        int((search.labels != encoding.cluster).sum()), int(groups[1].max(initial=-1)) + 1)


def subspace_errors(encoding: Encoding, signal: NDArray[np.floating], points: NDArray[np.integer],
                    clusters: NDArray[np.integer], metric: NDArray | None = None) -> Double:
    """Squared errors (k,) that points (k,) would have in clusters (k,), pair by pair: squared distances, in the metric,
    of the signal (p, n) to the clusters' subspaces."""
    return _Distances.of(encoding, signal, metric).project(points, clusters, no_tick)[1]


def _moved_encoding(encoding: Encoding, search: _Search) -> Encoding:
    """The encoding with a search's labels: bases stay, moved points get new weights, and clusters that have lost all
    points are left out. The same encoding where nothing moved."""
    moved = np.flatnonzero(search.labels != encoding.cluster)
    if len(moved) == 0:
        return encoding
    weights, errors = encoding.weights.copy(), search.errors.copy()
    weights[moved], errors[moved] = search.distances.project(moved, search.labels[moved], search.tick)
    used, labels = np.unique(search.labels, return_inverse=True)
    discarded = np.bincount(labels, errors, len(used))
    total = float(discarded.sum())
    ratio = total / encoding.squared_error if encoding.squared_error > 0 else 1.0
    return replace(encoding, cluster=labels.astype(np.int32), bases=encoding.bases[used], weights=weights,
                   vectors_per_cluster=encoding.vectors_per_cluster[used], squared_error=total,
                   relative_error=encoding.relative_error * ratio, discarded=discarded)


@dataclass(frozen=True)
class _Distances:
    """A signal (p, n) beside the subspaces of its encoding. root: (m, m) square root of the metric, None for none.

    Errors are those of the weights as they are stored, in single precision, so what a search adds up is what a decoder
    would find.
    """

    encoding: Encoding
    signal: NDArray[np.floating]
    root: Double | None

    @staticmethod
    def of(encoding: Encoding, signal: NDArray[np.floating], metric: NDArray | None) -> _Distances:
        if signal.shape != (len(encoding.cluster), encoding.bases.shape[2]):
            raise BadArguments("signal", f"its shape {signal.shape} is not the encoding's", "Pass what was encoded")
        return _Distances(encoding, signal, None if metric is None else metric_roots(metric, len(metric))[0])

    def within(self, rows: NDArray[np.floating]) -> Double:
        """Rows (k, n) of values in the metric, where squared lengths are squared errors."""
        rows = np.asarray(rows, np.float64)
        if self.root is None:
            return rows
        return small_batched_multiply(self.root[None], rows.reshape(len(rows), len(self.root), -1)).reshape(rows.shape)

    def own(self, tick: Tick) -> Double:
        """Squared errors (p,) as encoded."""
        return self.project(np.arange(len(self.signal)), self.encoding.cluster, tick, self.encoding.weights)[1]

    def project(self, points: NDArray[np.integer], clusters: NDArray[np.integer], tick: Tick,
                weights: NDArray[np.float32] | None = None) -> tuple[NDArray[np.float32], Double]:
        """Weights (k, vectors) and squared errors (k,) of points (k,) in clusters (k,), pair by pair.

        The encoder's vectors are orthogonal in the metric, and zero where a cluster has fewer, so each weight is a
        projection on its own. weights: taken instead of projections.
        """
        found = np.zeros((len(points), self.encoding.weights.shape[1]), np.float32) if weights is None else weights
        errors = np.empty(len(points))
        order, ends = by_cluster(clusters, len(self.encoding.bases))
        for cluster in np.flatnonzero(np.diff(ends)):
            tick()
            axes = self.within(self.encoding.bases[cluster, 1:])
            lengths = row_squares(axes)
            duals = axes / np.where(lengths > 0, lengths, 1)[:, None]
            for start in range(ends[cluster], ends[cluster + 1], CHUNK):
                pairs = order[start:min(start + CHUNK, ends[cluster + 1])]
                centred = self.within(self.signal[points[pairs]].astype(float) - self.encoding.bases[cluster, 0])
                if weights is None:
                    found[pairs] = multiply(centred, duals.T)
                centred -= multiply(found[pairs].astype(float), axes)
                errors[pairs] = row_squares(centred)
        return found, errors


@dataclass
class _Search:
    """Which point may move where, kept up to date while points move.

    A triangle with corners p, q, r is in as many clusters as q and r are, and in one more if p's is neither of theirs.
    So a move of p gains, in clusters summed over triangles, N(new) - N(old), N(c) being the number of p's triangles in
    which another corner is in c.

    corners: points p, ordered; first, second: the other two corners; ends: where each point's corners start.
    labels (p,), errors (p,): now. target, gain, cost, (p,): each point's best move, gain 0 for none.
    """

    triangles: NDArray[np.integer]
    distances: _Distances
    tick: Tick
    corners: NDArray[np.integer]
    first: NDArray[np.integer]
    second: NDArray[np.integer]
    ends: NDArray[np.integer]
    labels: NDArray[np.int64]
    errors: Double
    target: NDArray[np.int64]
    gain: NDArray[np.int64]
    cost: Double

    @staticmethod
    def of(triangles: NDArray[np.integer], distances: _Distances, tick: Tick) -> _Search:
        """Nothing moved yet, and no move looked at."""
        points = len(distances.signal)
        corners, first, second = _corners(np.asarray(triangles, np.int64).reshape(-1, 3))
        ends = np.append(0, np.cumsum(np.bincount(corners, minlength=points)))
        return _Search(triangles, distances, tick, corners, first, second, ends,
                       distances.encoding.cluster.astype(np.int64), distances.own(tick), np.zeros(points, np.int64),
                       np.zeros(points, np.int64), np.zeros(points))

    def run(self, budget: float) -> None:
        """Move points in order of overdraw gained per error added, until no move or no budget for one is left."""
        left = budget
        self.look(np.arange(len(self.labels)))
        while True:
            movers = self.choose(left, budget * STEP)
            if len(movers) == 0:
                return
            left -= float(self.cost[movers].sum())
            self.errors[movers] += self.cost[movers]
            self.labels[movers] = self.target[movers]
            self.look(self.around(movers))

    def choose(self, left: float, step: float) -> NDArray[np.intp]:
        """The best moves that cost at most a step together and do not touch the same triangle, so that their gains add
        up as if made one after the other."""
        possible = np.flatnonzero((self.gain > 0) & (self.cost <= left))
        possible = possible[np.argsort(-_rates(self.gain[possible], self.cost[possible]), kind="stable")]
        # Without what other moves gain back: those may be beaten below.
        spent = np.cumsum(np.maximum(self.cost[possible], 0.0)) > min(step, left)
        possible = possible[:max(1, int(spent.argmax()))] if spent.any() else possible
        rank = np.full(len(self.labels), len(possible))
        rank[possible] = np.arange(len(possible))
        ranks = rank[self.triangles]
        beaten = np.zeros(len(self.labels), bool)
        beaten[self.triangles[ranks > ranks.min(axis=1, keepdims=True)]] = True
        return possible[~beaten[possible]]

    def around(self, points: NDArray[np.intp]) -> NDArray[np.intp]:
        """The points and all that share a triangle with one, ascending."""
        rows = self.rows(points)
        near = np.zeros(len(self.labels), bool)
        near[points] = near[self.first[rows]] = near[self.second[rows]] = True
        return np.flatnonzero(near)

    def rows(self, points: NDArray[np.intp]) -> NDArray[np.intp]:
        """Where the corners of some points lie."""
        counts = self.ends[points + 1] - self.ends[points]
        return np.repeat(self.ends[points] - np.append(0, np.cumsum(counts)[:-1]), counts) + np.arange(counts.sum())

    def look(self, points: NDArray[np.intp]) -> None:
        """Find the best move of each of these points, given the labels as they are."""
        clusters, rows = len(self.distances.encoding.bases), self.rows(points)
        one, other = self.labels[self.first[rows]], self.labels[self.second[rows]]
        base = self.corners[rows] * clusters
        keys, seen = np.unique(np.concatenate([base + one, (base + other)[other != one]]), return_counts=True)
        owner, cluster = np.divmod(keys, clusters)
        at_home = self.labels[owner] == cluster
        home = np.zeros(len(self.labels), np.int64)
        home[owner[at_home]] = seen[at_home]
        gain = seen - home[owner]
        kept = np.flatnonzero((gain > 0) & ~at_home)
        owner, cluster, gain = owner[kept], cluster[kept], gain[kept]
        cost = self.distances.project(owner, cluster, self.tick)[1] - self.errors[owner]
        order = np.lexsort((cluster, -_rates(gain, cost), owner))
        best = order[np.diff(owner[order], prepend=-1) != 0]
        self.gain[points] = 0
        self.target[owner[best]], self.gain[owner[best]], self.cost[owner[best]] = cluster[best], gain[best], cost[best]


def _rates(gain: NDArray[np.int64], cost: Double) -> Double:
    """Overdraw gained per squared error added; moves that add none come before all others, by their gain."""
    return gain / np.maximum(cost, 1e-200)


def _corners(triangles: NDArray[np.int64]) -> tuple[NDArray[np.int64], ...]:
    """Every point of every triangle once, in the points' order, and the triangle's other two corners.

    In a triangle that names a point twice the other corner stands for both, so that a point's own cluster never
    counts as a neighbour's.
    """
    a, b, c = triangles.T
    once = np.concatenate([(a != b) | (a != c), (b != a), (c != a) & (c != b)])
    point, first, second = (np.concatenate(x)[once] for x in ((a, b, c), (b, c, a), (c, a, b)))
    first, second = np.where(first == point, second, first), np.where(second == point, first, second)
    order = np.argsort(point, kind="stable")
    return point[order], first[order], second[order]


def cluster_registers(encoding: Encoding, rows: int) -> NDArray[np.int64]:
    """Registers (clusters,) of four values that a cluster's constants take in a pass, section 6.

    Diffuse transfer (one row) takes one per representative, the colour; glossy transfer a pass per colour channel and
    rows / 4 per representative.
    """
    return (encoding.vectors_per_cluster.astype(np.int64) + 1) * (1 if rows == 1 else -(-rows // 4))


def superclusters(triangles: NDArray[np.integer], cluster: NDArray[np.integer], sizes: NDArray[np.integer],
                  registers: int = REGISTERS) -> NDArray[np.int64]:
    """The supercluster (clusters,) of each cluster, numbered from 0 in the order of their first clusters.

    Neighbours, which share a triangle, are merged in order of overdraw saved, a draw for every triangle that is in
    both, as long as their sizes, sizes (clusters,) in registers, sum up to `registers` at most. cluster: (p,).
    """
    mixed = _Mixed.of(triangles, cluster, len(sizes))
    total = [int(size) for size in sizes]
    parent = np.arange(len(sizes))
    heap = [(-count, one, other) for one in range(len(sizes)) for other, count in mixed.shared[one].items()
            if one < other]
    heapq.heapify(heap)
    while heap:
        count, one, other = heapq.heappop(heap)
        # An entry made before one of the two was merged is stale. Sums of sizes only grow, so what fails once is over.
        if mixed.shared[one].get(other) != -count or total[one] + total[other] > registers:
            continue
        total[one] += total[other]
        parent[other] = one
        for near, saved in mixed.merge(one, other).items():
            heapq.heappush(heap, (-saved, min(one, near), max(one, near)))
    for child in range(len(parent)):  # parents come before their children
        parent[child] = parent[parent[child]]
    return np.unique(parent, return_inverse=True)[1]


@dataclass
class _Mixed:
    """Triangles in more than one supercluster. corners: (t, 3) superclusters; inside: the triangles of each
    supercluster; shared: for each, how many triangles it has in common with each other."""

    corners: NDArray[np.int64]
    inside: list[NDArray[np.intp]]
    shared: list[dict[int, int]]

    @staticmethod
    def of(triangles: NDArray[np.integer], cluster: NDArray[np.integer], clusters: int) -> _Mixed:
        corners = cluster[np.asarray(triangles).reshape(-1, 3)].astype(np.int64)
        corners = corners[(corners != corners[:, :1]).any(axis=1)]
        order, ends = by_cluster(corners.ravel(), clusters)
        inside = [np.unique(order[ends[k]:ends[k + 1]] // 3) for k in range(clusters)]
        mixed = _Mixed(corners, inside, [])
        mixed.shared = [mixed.neighbours(k) for k in range(clusters)]
        return mixed

    def neighbours(self, one: int) -> dict[int, int]:
        """How many triangles of a supercluster each other one shares."""
        found = np.sort(self.corners[self.inside[one]], axis=1)
        new = np.diff(found, axis=1, prepend=-1) != 0
        others, counts = np.unique(found[new & (found != one)], return_counts=True)
        return dict(zip(others.tolist(), counts.tolist(), strict=True))

    def merge(self, one: int, other: int) -> dict[int, int]:
        """Make the two one; returns the neighbours of the result."""
        inside = np.union1d(self.inside[one], self.inside[other])
        corners = self.corners[inside]
        corners[corners == other] = one
        self.corners[inside] = corners
        self.inside[one], self.inside[other] = inside[(corners != one).any(axis=1)], inside[:0]
        for near in self.shared[other]:
            del self.shared[near][other]
        self.shared[other] = {}
        self.shared[one] = self.neighbours(one)
        for near, count in self.shared[one].items():
            self.shared[near][one] = count
        return self.shared[one]
