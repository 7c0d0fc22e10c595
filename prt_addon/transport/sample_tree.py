# SPDX-License-Identifier: GPL-3.0-or-later
"""A balanced binary tree over surface samples, each level built by one sort (Jensen & Buhler 2002, section 3.2, use an
octree; on a surface a median split opens a node into 2 parts instead of about 4, so fewer are opened than needed).

Nodes are numbered as in a heap: root 0, children 2m + 1 and 2m + 2. A node is a contiguous run of samples.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

# Which coordinates the six numbers of a symmetric matrix belong to.
ROWS, COLUMNS = [0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]


@dataclass(frozen=True)
class SampleTree:
    """order: (n,) the samples in the tree's order; points (n, 3), areas (n,): in that order; depth: levels below the
    root, at which every node has at most one sample. Per node: first, count: its run of samples; centre (m, 3):
    area-weighted; reach: largest distance of a sample from the centre; extent: the same to the rim of the samples'
    discs; covariance: (m, 6) of the surface about its
    centre, the discs included, as xx yy zz xy xz yz. Nodes of the last level have only first and count."""

    order: NDArray[np.int64]
    points: NDArray[np.float64]
    areas: NDArray[np.float64]
    depth: int
    first: NDArray[np.int64]
    count: NDArray[np.int64]
    centre: NDArray[np.float64]
    reach: NDArray[np.float64]
    extent: NDArray[np.float64]
    covariance: NDArray[np.float64]

    @staticmethod
    def over(points: NDArray[np.float64], areas: NDArray[np.float64], discs: NDArray[np.float64]) -> SampleTree:
        """The tree over n >= 1 points (n, 3) with areas (n,) >= 0; discs: (n, 6) covariances of the samples' discs."""
        number = len(points)
        depth = max(0, number - 1).bit_length()
        order = np.arange(number)
        for level in range(depth):
            bounds = _bounds(number, level)
            inside = points[order]
            extent = np.maximum.reduceat(inside, bounds[:-1]) - np.minimum.reduceat(inside, bounds[:-1])
            node = np.repeat(np.arange(len(bounds) - 1), np.diff(bounds))
            along = inside[np.arange(number), np.argmax(extent, axis=1)[node]]
            order = order[np.lexsort((along, node))]
        bounds = [_bounds(number, level) for level in range(depth + 1)]
        first = np.concatenate([b[:-1] for b in bounds])
        count = np.concatenate([np.diff(b) for b in bounds])
        figures = [_figures(points[order], areas[order], discs[order], b) for b in bounds[:depth]]
        together = (np.concatenate([np.zeros(_NONE[i]), *(f[i] for f in figures)]) for i in range(4))
        return SampleTree(order, points[order], areas[order], depth, first, count, *together)

    def level(self, largest: int) -> NDArray[np.int64]:
        """The nodes of the first level whose nodes have at most so many samples."""
        level = 0
        while self.count[2**level - 1:2**(level + 1) - 1].max() > largest:
            level += 1
        return np.arange(2**level - 1, 2**(level + 1) - 1)

    def summed(self, values: NDArray[np.floating]) -> NDArray[np.floating]:
        """Values (n, ...) of the samples in the tree's order, followed by their sums over each node but those of the
        last level: (n + 2^depth - 1, ...), in the values' own precision."""
        number = len(values)
        result = np.empty((number + 2**self.depth - 1, *values.shape[1:]), values.dtype)
        result[:number] = values
        for level in range(self.depth - 1, -1, -1):
            nodes = result[number + 2**level - 1:number + 2**(level + 1) - 1]
            if level == self.depth - 1:
                nodes[...] = np.add.reduceat(values, _bounds(number, level)[:-1], axis=0)
            else:
                below = result[number + 2**(level + 1) - 1:number + 2**(level + 2) - 1]
                np.add(below[::2], below[1::2], out=nodes)
        return result


# Shapes of the figures of no node.
_NONE = ((0, 3), (0,), (0,), (0, 6))


def _bounds(number: int, level: int) -> NDArray[np.int64]:
    """Where the runs of a level begin and end: (2^level + 1,). Those of the next level subdivide them."""
    return (np.arange(2**level + 1) * number) >> level


def _figures(points: NDArray[np.float64], areas: NDArray[np.float64], discs: NDArray[np.float64],
             bounds: NDArray[np.int64]) -> tuple[NDArray[np.float64], ...]:
    """Centre, reach, extent and covariance of the nodes of a level."""
    start, size = bounds[:-1], np.diff(bounds)
    # A node whose samples all have no area still needs a centre.
    weights = np.maximum(areas, 1e-12 * areas.mean() if areas.any() else 1.0)[:, None]
    total = np.add.reduceat(weights, start)
    centre = np.add.reduceat(weights * points, start) / total
    apart = points - np.repeat(centre, size, axis=0)
    distance = np.sqrt(np.sum(apart * apart, axis=1))
    reach = np.maximum.reduceat(distance, start)
    extent = np.maximum.reduceat(distance + np.sqrt(areas / np.pi), start)
    covariance = np.add.reduceat(weights * (apart[:, ROWS] * apart[:, COLUMNS] + discs), start) / total
    return centre, reach, extent, covariance
