# SPDX-License-Identifier: GPL-3.0-or-later
"""A tree of boxes over triangles, flat enough for textures: what a ray engine on the GPU walks through.

Built level by level with whole arrays: every node of a level is split where a surface area heuristic over BINS bins of
the triangles' middles is least (MacDonald & Booth 1990, Heuristics for ray tracing using space subdivision; Wald 2007,
On fast Construction of SAH-based Bounding Volume Hierarchies), or in halves where that finds nothing or the tree would
become deeper than the kernels' stack. Pure numpy: benchmarks copy this file to machines without the extension.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

BINS = 16
LEAF = 4  # triangles of a leaf at most
HALVED_LEVEL = 24  # from here on nodes are halved: with at most 2^24 triangles the tree ends before level STACK
STACK = 48
# Boxes grow by this much of the scene's unit diagonal, so that walls along the axes are no boxes without a volume.
PADDING = np.float32(2.0 ** -22)
FAR = np.float32(1e30)  # where an empty box lies
NODE_TEXELS, TRIANGLE_TEXELS = 4, 3


@dataclass(frozen=True)
class BoundingHierarchy:
    """Nodes in the order of their levels, the root first.

    low, high: (n, 3) float32 corners of their boxes, padded; first, count: (n,) int32, their triangles
    order[first:first + count]; left: (n,) int32, their left child, -1 for a leaf (the right child follows it); order:
    (t,) int32 triangles in the order of the leaves; levels: of the deepest leaf.
    """

    low: NDArray[np.float32]
    high: NDArray[np.float32]
    first: NDArray[np.int32]
    count: NDArray[np.int32]
    left: NDArray[np.int32]
    order: NDArray[np.int32]
    levels: int


def build(points: NDArray[np.float32], triangles: NDArray[np.int32], leaf: int = LEAF) -> BoundingHierarchy:
    """The tree over triangles (t, 3) of points (p, 3). Triangles with a corner that is not finite are left out."""
    corners = points[triangles].astype(np.float32)
    order = np.flatnonzero(np.isfinite(corners).all(axis=(1, 2)))
    low, high = corners.min(axis=1), corners.max(axis=1)
    middle = 0.5 * (low + high)
    starts, ends = np.array([0]), np.array([len(order)])
    parts: list[tuple[NDArray, ...]] = []
    made, levels = 1, 0
    while len(starts):
        counts = ends - starts
        split = np.flatnonzero(counts > leaf)
        left = np.full(len(starts), -1, np.int32)
        left[split] = made + 2 * np.arange(len(split), dtype=np.int32)
        parts.append((*_boxes(low[order], high[order], starts, ends), starts, counts, left))
        made += 2 * len(split)
        if not len(split):
            break
        cuts = _split(order, low, high, middle, starts[split], ends[split], levels >= HALVED_LEVEL)
        starts, ends = (np.stack(pair, axis=1).ravel() for pair in ((starts[split], cuts), (cuts, ends[split])))
        levels += 1
    low, high, first, count, left = (np.concatenate(part) for part in zip(*parts, strict=True))
    return BoundingHierarchy(low, high, first.astype(np.int32), count.astype(np.int32), left, order.astype(np.int32),
                             levels)


def _boxes(low: NDArray[np.float32], high: NDArray[np.float32], starts: NDArray[np.int64], ends: NDArray[np.int64],
           ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Padded boxes around elements [start, end) of a list; empty ones lie far away, inside out."""
    if not len(low):
        return np.full((len(starts), 3), FAR), np.full((len(starts), 3), -FAR)
    # Segments of one level leave gaps (leaves of levels before): every second result is a gap's.
    edges = np.stack([starts, np.minimum(ends, len(low) - 1)], axis=1).ravel()
    lows, highs = np.minimum.reduceat(low, edges)[::2], np.maximum.reduceat(high, edges)[::2]
    last = (ends == len(low))[:, None]  # whose last element the clamped edge cut off
    return (np.where(last, np.minimum(lows, low[-1]), lows) - PADDING,
            np.where(last, np.maximum(highs, high[-1]), highs) + PADDING)


def _split(order: NDArray[np.int64], low: NDArray[np.float32], high: NDArray[np.float32], middle: NDArray[np.float32],
           starts: NDArray[np.int64], ends: NDArray[np.int64], halve: bool) -> NDArray[np.int64]:
    """Sort each segment of `order` (in place) into two parts; returns where the second ones begin."""
    counts = ends - starts
    segment = np.repeat(np.arange(len(starts)), counts)
    inside = np.arange(len(segment)) - np.repeat(np.cumsum(counts) - counts, counts)
    place = np.repeat(starts, counts) + inside
    members = order[place]
    begins = np.cumsum(counts) - counts
    least = np.minimum.reduceat(middle[members], begins)
    extent = np.maximum.reduceat(middle[members], begins) - least
    best = np.full(len(starts), np.inf)
    axis_of, bin_of = np.zeros(len(starts), np.int64), np.zeros(len(starts), np.int64)
    bins = []
    for axis in range(3):
        scale = BINS / np.maximum(extent[:, axis], 1e-30)
        offset = (middle[members, axis] - least[segment, axis]) * scale[segment]
        bins.append(np.clip(offset, 0, BINS - 1).astype(np.int64))
        cost = _costs(segment, bins[-1], low[members], high[members], len(starts))
        cheapest = cost.argmin(axis=1)
        value = cost[np.arange(len(starts)), cheapest]
        better = value < best
        best[better], axis_of[better], bin_of[better] = value[better], axis, cheapest[better]
    chosen = np.choose(axis_of[segment], bins)
    right = chosen > bin_of[segment]
    halved = np.flatnonzero(~np.isfinite(best) | halve)
    if len(halved):  # in halves along the longest side
        axis = extent.argmax(axis=1)
        by_place = np.lexsort((middle[members, axis[segment]], segment))
        rank = np.empty(len(segment), np.int64)
        rank[by_place] = inside
        is_halved = np.isin(segment, halved)
        right[is_halved] = (rank >= counts[segment] // 2)[is_halved]
    order[place] = members[np.argsort(2 * segment + right, kind="stable")]
    return ends - np.bincount(segment, right, len(starts)).astype(np.int64)


def _costs(segment: NDArray[np.int64], bins: NDArray[np.int64], low: NDArray[np.float32], high: NDArray[np.float32],
           count: int) -> NDArray[np.float64]:
    """(segments, BINS - 1) area times number of triangles, both sides of each plane between bins added; infinite where
    a side is empty."""
    key = segment * BINS + bins
    by_key = np.argsort(key, kind="stable")
    numbers = np.bincount(key, minlength=count * BINS)
    filled = np.flatnonzero(numbers)
    begins = (np.cumsum(numbers) - numbers)[filled]
    lows, highs = np.full((count * BINS, 3), np.inf, np.float32), np.full((count * BINS, 3), -np.inf, np.float32)
    lows[filled] = np.minimum.reduceat(low[by_key], begins)
    highs[filled] = np.maximum.reduceat(high[by_key], begins)
    lows, highs, numbers = lows.reshape(count, BINS, 3), highs.reshape(count, BINS, 3), numbers.reshape(count, BINS)

    def sides(step: int) -> tuple[NDArray, NDArray]:
        """Areas and numbers of everything up to each bin, seen from one end."""
        size = (np.maximum.accumulate(highs[:, ::step], axis=1) - np.minimum.accumulate(lows[:, ::step], axis=1))
        size = np.maximum(size.astype(np.float64), 0.0)
        area = size[..., 0] * size[..., 1] + size[..., 1] * size[..., 2] + size[..., 2] * size[..., 0]
        return area, np.cumsum(numbers[:, ::step], axis=1)
    (left_area, left), (right_area, right) = sides(1), sides(-1)
    left_area, left = left_area[:, :-1], left[:, :-1]
    right_area, right = right_area[:, -2::-1], right[:, -2::-1]
    return np.where((left > 0) & (right > 0), left_area * left + right_area * right, np.inf)


def node_texels(tree: BoundingHierarchy) -> NDArray[np.float32]:
    """(4 inner nodes, 4): per inner node the boxes of both children, and where they are.

    Texels: (low, number) and (high, count) of the left child, then of the right one. count 0: an inner node, its number
    in this list; else a leaf, the number of its first triangle. A root that is a leaf stands as the left child of a
    node whose right child is empty.
    """
    inner = np.flatnonzero(tree.left >= 0)
    if not len(inner):
        alone = np.zeros((4, 4), np.float32)
        alone[0, :3], alone[1, :3], alone[1, 3] = tree.low[0], tree.high[0], tree.count[0]
        alone[2, :3], alone[3, :3] = FAR, -FAR
        return alone
    number = np.zeros(len(tree.left), np.int64)
    number[inner] = np.arange(len(inner))
    texels = np.empty((len(inner), 4, 4), np.float32)
    for side in range(2):
        child = tree.left[inner] + side
        leaf = tree.left[child] < 0
        texels[:, 2 * side, :3], texels[:, 2 * side + 1, :3] = tree.low[child], tree.high[child]
        texels[:, 2 * side, 3] = np.where(leaf, tree.first[child], number[child])
        texels[:, 2 * side + 1, 3] = np.where(leaf, tree.count[child], 0)
    return texels.reshape(-1, 4)


def triangle_texels(tree: BoundingHierarchy, points: NDArray[np.float32], triangles: NDArray[np.int32],
                    ) -> NDArray[np.float32]:
    """(3 triangles, 4): corners in the order of the leaves; the first one's fourth number is the triangle's own."""
    texels = np.zeros((len(tree.order), 3, 4), np.float32)
    texels[:, :, :3] = points[triangles[tree.order]]
    texels[:, 0, 3] = tree.order
    return texels.reshape(-1, 4)
