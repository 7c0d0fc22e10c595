# SPDX-License-Identifier: GPL-3.0-or-later
"""Rays in buckets of like ones, and which cells of triangles each bucket may meet.

Method: the ray cache of Carr, Hall & Hart 2002 (The Ray Engine, section 5.3) after Arvo & Kirk 1987 (Fast ray tracing
by ray classification): rays lie in five dimensions, origin and direction, and a bucket is a box there. The paper grows
a tree ray by ray, steals from neighbours to fill buckets and merges what is left; here all rays of a call are there at
once, so one sort along a space-filling curve in the five dimensions makes buckets that are all full.
Cells are the largest nodes of the tree of boxes that hold at most T triangles. Pure numpy, as bounding_hierarchy.py.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .bounding_hierarchy import BoundingHierarchy

AXIS_BITS = 6  # of each of the five axes in a ray's key
PAIRS_AT_ONCE = 1 << 19  # bounds memory: about 100 bytes for each pair while it is tested
BUCKETS_AT_ONCE = 4096


@dataclass(frozen=True)
class Buckets:
    """Rays in buckets of `size`. order: (n,) int64, the rays bucket by bucket (the last may be short); origins,
    directions: (buckets, 2, 3) float32, least and greatest of what is inside; reach: (buckets,) the longest."""

    size: int
    order: NDArray[np.int64]
    origins: NDArray[np.float32]
    directions: NDArray[np.float32]
    reach: NDArray[np.float32]

    def __len__(self) -> int:
        return len(self.origins)


@dataclass(frozen=True)
class CellPairs:
    """Which cells a bucket may meet, nearest first. first: (buckets + 1,) int64, where its pairs begin; cell: (pairs,)
    int32 nodes of the tree; near: (pairs,) float32, a ray parameter before which no ray of the bucket meets the cell.
    """

    first: NDArray[np.int64]
    cell: NDArray[np.int32]
    near: NDArray[np.float32]


def ray_keys(origins: NDArray[np.float32], directions: NDArray[np.float32]) -> NDArray[np.int64]:
    """(n,) places of rays on a space-filling curve: bits of origin and of direction (on an octahedron, which is two
    numbers) by turns, the coarse ones first."""
    low = origins.min(axis=0)
    extent = float((origins.max(axis=0) - low).max()) or 1.0
    places = np.empty((5, len(origins)))
    places[:3] = ((origins - low) / extent).T
    turned = directions / np.maximum(np.abs(directions).sum(axis=1, keepdims=True), np.finfo(np.float32).tiny)
    sign = np.where(turned[:, :2] < 0.0, -1.0, 1.0)
    folded = np.where(turned[:, 2:] < 0.0, (1.0 - np.abs(turned[:, 1::-1])) * sign, turned[:, :2])
    places[3:] = 0.5 * folded.T + 0.5
    steps = np.clip(places * (1 << AXIS_BITS), 0, (1 << AXIS_BITS) - 1).astype(np.int64)
    key = np.zeros(len(origins), np.int64)
    for bit in range(AXIS_BITS - 1, -1, -1):
        for axis in (3, 4, 0, 1, 2):
            key = 2 * key + ((steps[axis] >> bit) & 1)
    return key


def make_buckets(origins: NDArray[np.float32], directions: NDArray[np.float32], reach: NDArray[np.float32],
                 size: int) -> Buckets:
    """Buckets of `size` rays. origins, directions: (n, 3); reach: (n,), greatest ray parameter."""
    order = np.argsort(ray_keys(origins, directions), kind="stable") if len(origins) else np.empty(0, np.int64)
    starts = np.arange(0, len(order), size)
    if not len(starts):
        empty = np.empty((0, 2, 3), np.float32)
        return Buckets(size, order, empty, empty, np.empty(0, np.float32))
    boxes = [np.stack([np.minimum.reduceat(values[order], starts), np.maximum.reduceat(values[order], starts)], axis=1)
             for values in (origins, directions)]
    return Buckets(size, order, *boxes, np.maximum.reduceat(reach[order], starts))


def pair_with_cells(buckets: Buckets, tree: BoundingHierarchy, most: int) -> CellPairs:
    """All pairs of a bucket and a cell of at most `most` triangles (or a leaf) that a ray of it may meet."""
    counts, cells, nears = [], [], []
    for start in range(0, len(buckets), BUCKETS_AT_ONCE):
        part = slice(start, start + BUCKETS_AT_ONCE)
        found = list(_descend(buckets, tree, most, np.arange(len(buckets))[part]))
        bucket, cell, near = (np.concatenate(column) for column in zip(*found, strict=True))
        by_bucket = np.lexsort((near, bucket))
        counts.append(np.bincount(bucket - start, minlength=min(BUCKETS_AT_ONCE, len(buckets) - start)))
        cells.append(cell[by_bucket].astype(np.int32))
        nears.append(near[by_bucket])
    first = np.concatenate([[0], np.cumsum(np.concatenate(counts) if counts else [])]).astype(np.int64)
    return CellPairs(first, np.concatenate(cells) if cells else np.empty(0, np.int32),
                     np.concatenate(nears) if nears else np.empty(0, np.float32))


def _descend(buckets: Buckets, tree: BoundingHierarchy, most: int, chosen: NDArray[np.int64],
             ) -> Iterator[tuple[NDArray, NDArray, NDArray]]:
    """Pairs (bucket, cell, near) below the root, all buckets of a level at once."""
    waiting = [(chosen, np.zeros(len(chosen), np.int64))]
    yield chosen[:0], chosen[:0], np.empty(0, np.float32)
    while waiting:
        bucket, node = waiting.pop()
        if len(bucket) > PAIRS_AT_ONCE:
            waiting.append((bucket[PAIRS_AT_ONCE:], node[PAIRS_AT_ONCE:]))
            bucket, node = bucket[:PAIRS_AT_ONCE], node[:PAIRS_AT_ONCE]
        near, meets = beam_meets_box(buckets, bucket, tree.low[node], tree.high[node])
        bucket, node, near = bucket[meets], node[meets], near[meets]
        is_cell = (tree.count[node] <= most) | (tree.left[node] < 0)
        filled = is_cell & (tree.count[node] > 0)
        yield bucket[filled], node[filled], near[filled]
        left = tree.left[node[~is_cell]].astype(np.int64)
        if len(left):
            waiting.append((np.tile(bucket[~is_cell], 2), np.concatenate([left, left + 1])))


def beam_meets_box(buckets: Buckets, bucket: NDArray[np.int64], low: NDArray[np.float32], high: NDArray[np.float32],
                   ) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Conservatively, whether rays of buckets may meet boxes, and from which ray parameter on: (pairs,) each.

    At parameter t all points of a bucket's rays lie in the box between origin_low + t direction_low and origin_high +
    t direction_high (t >= 0). It touches the cell while six inequalities, linear in t, hold.
    """
    start, end = np.zeros(len(bucket)), buckets.reach[bucket].astype(np.float64)
    possible = np.ones(len(bucket), bool)
    origin, direction = buckets.origins[bucket].astype(np.float64), buckets.directions[bucket].astype(np.float64)
    for offset, slope in ((origin[:, 0] - high, direction[:, 0]), (low - origin[:, 1], -direction[:, 1])):
        # offset + t slope <= 0 on every axis
        with np.errstate(divide="ignore", invalid="ignore"):
            turn = -offset / slope
        possible &= ~((slope == 0.0) & (offset > 0.0)).any(axis=1)
        start = np.maximum(start, np.where(slope < 0.0, turn, 0.0).max(axis=1))
        end = np.minimum(end, np.where(slope > 0.0, turn, np.inf).min(axis=1))
    # The kernel works in single precision: let it begin a little early.
    near = (start * (1.0 - 1e-6)).astype(np.float32)
    return near, possible & (near <= end * (1.0 + 1e-6))
