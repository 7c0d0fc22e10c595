# SPDX-License-Identifier: GPL-3.0-or-later
"""Charts: parts of a surface that are laid flat without overlap, so that texels can cover them.

Two triangles belong together where they share an edge whose points they share: `SceneMesh` splits points at sharp
edges and where materials meet, so no chart reaches across such a line, and filtering never blurs one. Within such a
piece triangles are parted by the axis that their normals are nearest to, and each part is projected along its mean
normal: exact for flat faces, which are what texels are for, and at most 1.7 times denser one way than the other on
curved ones. It always ends, needs no library, and depends on nothing but the triangles.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.csgraph import connected_components

Double = NDArray[np.float64]
# Cosine below which a triangle of a chart leans too far from the direction that the chart is projected along.
STEEPEST = 0.5
# Area below which a triangle has none: of the largest extent squared, as in object_mesh.clean.
NO_AREA = 1e-14
JOININGS = 16  # rounds in which small charts join larger ones


@dataclass(frozen=True)
class Charts:
    """chart: (t,) int64 of each triangle, -1 for triangles without area; flat: (t, 3, 2) float64, their corners laid
    flat in metres, wound as in space; each chart has a plane of its own. method: what made them, for the report."""

    chart: NDArray[np.int64]
    flat: Double
    method: str

    @property
    def count(self) -> int:
        """How many charts there are."""
        return int(self.chart.max(initial=-1)) + 1


def face_normals(points: Double, triangles: NDArray[np.integer]) -> tuple[Double, Double]:
    """Unit normals (t, 3), zero where there is no area, and areas (t,) of triangles."""
    corners = points[triangles]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    double_area = np.sqrt(np.sum(normal ** 2, axis=1))
    return normal / np.maximum(double_area, np.finfo(np.float64).tiny)[:, None], 0.5 * double_area


def projected_charts(points: Double, triangles: NDArray[np.integer]) -> Charts:
    """Charts by projection of points (p, 3), triangles (t, 3)."""
    normals, areas = face_normals(points, triangles)
    usable = areas > NO_AREA * float(np.ptp(points[triangles], axis=(0, 1)).max(initial=0.0)) ** 2
    # A little off the axes, so that the corners of a regular solid's faces do not lie between two of them.
    axis = np.argmax(np.concatenate([normals, -normals], axis=1) * (1.0 + 1e-6 * np.arange(6)), axis=1)
    if not usable.any():
        return Charts(np.full(len(triangles), -1, np.int64), np.zeros((len(triangles), 3, 2)), "projection")
    axis = _joined_axes(triangles, axis, normals, usable)
    chart = connected(triangles, axis, usable)
    direction = _mean_direction(normals, areas, chart, axis)
    return Charts(chart, lay_flat(points, triangles, chart, direction), "projection")


def connected(triangles: NDArray[np.integer], label: NDArray[np.integer],
              usable: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Pieces (t,) of usable triangles that hang together by shared edges within one label; -1 for the others.

    Numbered by the first triangle of each.
    """
    first, second = _neighbours(triangles, usable)
    same = label[first] == label[second]
    joined = first[same], second[same]
    size = len(triangles)
    graph = sparse.coo_matrix((np.ones(int(same.sum()), np.int8), joined), shape=(size, size))
    _, piece = connected_components(graph, directed=False)
    result = np.full(size, -1, np.int64)
    _, first, place = np.unique(piece[usable], return_index=True, return_inverse=True)
    rank = np.empty(len(first), np.int64)
    rank[np.argsort(first, kind="stable")] = np.arange(len(first))
    result[usable] = rank[place.ravel()]
    return result


def _neighbours(triangles: NDArray[np.integer], usable: NDArray[np.bool_],
                ) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Pairs (e,) of usable triangles that share an edge; at one of several triangles, each with the next."""
    start, end = triangles.ravel().astype(np.int64), np.roll(triangles, -1, axis=1).ravel().astype(np.int64)
    owner = np.repeat(np.arange(len(triangles)), 3)
    kept = usable[owner]
    start, end, owner = start[kept], end[kept], owner[kept]
    count = int(triangles.max(initial=0)) + 1
    key = np.minimum(start, end) * count + np.maximum(start, end)
    order = np.lexsort((owner, key))
    key, owner = key[order], owner[order]
    same = np.flatnonzero(key[1:] == key[:-1])
    return owner[same], owner[same + 1]


def _joined_axes(triangles: NDArray[np.integer], axis: NDArray[np.integer], normals: Double,
                 usable: NDArray[np.bool_]) -> NDArray[np.integer]:
    """The axes (t,), of which pieces that lean little enough take a larger neighbour's, the one they share most edges
    with: fewer charts and rims."""
    first, second = _neighbours(triangles, usable)
    first, second = np.concatenate([first, second]), np.concatenate([second, first])
    lean = np.stack([np.sum(normals * direction, axis=1) for direction in (*np.eye(3), *-np.eye(3))], axis=1)
    axis = axis.copy()
    for _ in range(JOININGS):
        chart = connected(triangles, axis, usable)
        count = np.bincount(chart[usable])
        least = np.full((len(count), 6), 1.0)
        np.minimum.at(least, chart[usable], lean[usable])
        own, other, wanted = chart[first], chart[second], axis[second]
        larger = (count[other] > count[own]) | ((count[other] == count[own]) & (other < own))
        good = (own != other) & larger & (least[own, wanted] > STEEPEST)
        votes = np.bincount(own[good] * 6 + wanted[good], minlength=6 * len(count)).reshape(-1, 6)
        moved = usable & (votes.max(axis=1, initial=0) > 0)[np.maximum(chart, 0)]
        if not moved.any():
            break
        axis[moved] = votes.argmax(axis=1)[chart[moved]]
    return axis


def _mean_direction(normals: Double, areas: Double, chart: NDArray[np.int64], axis: NDArray[np.integer]) -> Double:
    """The direction (charts, 3) that each chart is projected along: its mean normal, or the axis that all its normals
    are near to where some lean too far from the mean."""
    inside = chart >= 0
    count = int(chart.max(initial=-1)) + 1
    of, weighted = chart[inside], (normals * areas[:, None])[inside]
    mean = np.zeros((count, 3))
    np.add.at(mean, of, weighted)
    mean /= np.maximum(np.sqrt(np.sum(mean ** 2, axis=1, keepdims=True)), np.finfo(np.float64).tiny)
    least = np.full(count, 1.0)
    np.minimum.at(least, of, np.sum(normals[inside] * mean[of], axis=1))
    near = np.zeros(count, np.int64)
    near[of] = axis[inside]
    axes = np.concatenate([np.eye(3), -np.eye(3)])
    return np.where((least < STEEPEST)[:, None], axes[near], mean)


def lay_flat(points: Double, triangles: NDArray[np.integer], chart: NDArray[np.int64], direction: Double) -> Double:
    """Corners (t, 3, 2) projected along their charts' directions (charts, 3), in metres, turned so that each chart's
    longest rim lies along an axis."""
    helper = np.eye(3)[np.abs(direction).argmin(axis=1)]
    across = np.cross(helper, direction)
    across /= np.maximum(np.sqrt(np.sum(across ** 2, axis=1, keepdims=True)), np.finfo(np.float64).tiny)
    up = np.cross(direction, across)
    of = np.maximum(chart, 0)
    corners = points[triangles]
    flat = np.stack([np.sum(corners * axis[of][:, None], axis=2) for axis in (across, up)], axis=2)
    return upright(flat, triangles, chart)


def upright(flat: Double, triangles: NDArray[np.integer], chart: NDArray[np.int64]) -> Double:
    """Flat corners (t, 3, 2) turned so that each chart's longest rim edge lies along the first axis, and the chart is
    at least as wide as high. A rectangle then fills its box."""
    count = int(chart.max(initial=-1)) + 1
    if not count:
        return flat
    edge = np.roll(flat, -1, axis=1) - flat
    start, end = triangles.ravel().astype(np.int64), np.roll(triangles, -1, axis=1).ravel().astype(np.int64)
    most = int(triangles.max(initial=0)) + 1
    key = (np.repeat(chart, 3) * most + np.minimum(start, end)) * most + np.maximum(start, end)
    _, place, uses = np.unique(key, return_inverse=True, return_counts=True)
    rim = (uses[place.ravel()] == 1) & (np.repeat(chart, 3) >= 0)
    length = np.sum(edge ** 2, axis=2).ravel() * rim
    # Rounding must not choose among equal edges: the first of those that are longest to six digits.
    order = np.lexsort((np.arange(len(length)), -np.float32(length), np.repeat(chart, 3)))
    owner = np.repeat(chart, 3)[order]
    first = np.flatnonzero(np.concatenate([[True], owner[1:] != owner[:-1]]) & (owner >= 0))
    longest = edge.reshape(-1, 2)[order[first]]
    size = np.maximum(np.sqrt(np.sum(longest ** 2, axis=1)), np.finfo(np.float64).tiny)
    cosine, sine = (longest / size[:, None]).T
    turned = _turned(flat, cosine[np.maximum(chart, 0)], sine[np.maximum(chart, 0)])
    low, high = extents(turned, chart)
    tall = (high - low)[:, 1] > (high - low)[:, 0] * (1.0 + 1e-9)
    quarter = tall[np.maximum(chart, 0)].astype(np.float64)
    return _turned(turned, 1.0 - quarter, quarter)


def _turned(flat: Double, cosine: Double, sine: Double) -> Double:
    """Corners (t, 3, 2) turned backwards by each triangle's angle."""
    x, y = flat[..., 0], flat[..., 1]
    cosine, sine = cosine[:, None], sine[:, None]
    return np.stack([cosine * x + sine * y, cosine * y - sine * x], axis=2)


def extents(flat: Double, chart: NDArray[np.int64]) -> tuple[Double, Double]:
    """Lowest and highest place (charts, 2) of each chart."""
    count = int(chart.max(initial=-1)) + 1
    low, high = np.full((count, 2), np.inf), np.full((count, 2), -np.inf)
    inside = chart >= 0
    np.minimum.at(low, chart[inside], flat[inside].min(axis=1))
    np.maximum.at(high, chart[inside], flat[inside].max(axis=1))
    return low, high


def parted(charts: Charts, which: NDArray[np.bool_]) -> Charts:
    """The charts, of which some (charts,) fall apart into their triangles: they would lie over themselves."""
    apart = (charts.chart >= 0) & which[np.maximum(charts.chart, 0)]
    chart = charts.chart.copy()
    chart[apart] = charts.count + np.arange(int(apart.sum()))
    used = chart >= 0
    chart[used] = np.unique(chart[used], return_inverse=True)[1].ravel()
    return Charts(chart, charts.flat, charts.method)
