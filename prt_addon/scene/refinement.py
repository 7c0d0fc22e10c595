# SPDX-License-Identifier: GPL-3.0-or-later
"""Refinement of triangles too coarse to carry transfer at their points (a floor of two triangles under a statue)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..errors import BadScene
from .tangents import tangent_frame

# Halvings of an edge: enough for a landscape of a thousand kilometres under a teapot.
MAXIMUM_ROUNDS = 24
# Of one object after refining. A mesh that comes with more keeps them.
MOST_POINTS = 4_000_000


@dataclass(frozen=True)
class EdgeLimit:
    """How long edges may be: `longest` metres at the objects that are baked, and in proportion to the distance from
    them beyond their own size (a ground plane to the horizon looks equally fine everywhere as they see it).

    low, high: (3,) corners of the box around the baked objects.
    """

    longest: float
    low: NDArray[np.float64]
    high: NDArray[np.float64]

    def exceeded(self, start: NDArray[np.float64], end: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Whether edges between points (..., 3) are too long; the same from either end."""
        length = np.sqrt(np.sum((start - end) ** 2, axis=-1))
        too_long = length > self.longest
        middle = 0.5 * (start + end)[too_long]
        outside = np.maximum(np.maximum(self.low - middle, middle - self.high), 0.0)
        # No point of the edge is nearer than this.
        distance = np.sqrt(np.sum(outside ** 2, axis=-1)) - 0.5 * length[too_long]
        size = max(float(np.sqrt(np.sum((self.high - self.low) ** 2))), np.finfo(np.float64).tiny)
        too_long[too_long] = length[too_long] > self.longest * np.maximum(1.0, distance / size)
        return too_long


@dataclass
class Beside:
    """What points carry besides position, normal and albedo, and triangles besides corners.

    material: (p,) int32; an edge whose ends differ (they can't on a split surface) gives its middle the lower number.
    tangents: (p, 3) float64, unit and orthogonal to the normal, or None to leave them out.
    source: (t,) int32, a number of each triangle's that its parts inherit, or None to leave it out.
    """

    material: NDArray[np.int32]
    tangents: NDArray[np.float64] | None
    source: NDArray[np.int32] | None = None

    def grow(self, ends: NDArray[np.int64], normals: NDArray[np.float64]) -> None:
        """Append the middles of edges (e, 2), whose normals (e, 3) are known."""
        self.material = np.concatenate([self.material, self.material[ends].min(axis=1)])
        if self.tangents is not None:
            between = tangent_frame(self.tangents[ends].sum(axis=1), normals)
            self.tangents = np.concatenate([self.tangents, between])


def refine(points: NDArray[np.float64], normals: NDArray[np.float64], albedo: NDArray[np.float64],
           triangles: NDArray[np.int32], limit: EdgeLimit, name: str, beside: Beside | None = None,
           ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64], NDArray[np.int32]]:
    """Split edges longer than the limit at their middle until none is left. Raises BadScene, naming the object `name`,
    where that asks for more points than any machine has memory for. beside: grows along with the points.

    An edge is split for both its triangles or for neither, so no T-junction appears between triangles that share
    points. New points stay on the flat triangle (shadows fall on what is drawn); normals and albedo are interpolated.
    """
    for _ in range(MAXIMUM_ROUNDS):
        edges = np.stack([triangles, np.roll(triangles, -1, axis=1)], axis=2).astype(np.int64)
        low, high = edges.min(axis=2), edges.max(axis=2)
        too_long = limit.exceeded(points[low], points[high])
        if not too_long.any():
            break
        key = low * len(points) + high
        split_keys, middle_of = np.unique(key[too_long], return_inverse=True)
        if len(points) + len(split_keys) > MOST_POINTS:
            raise BadScene(name, f"the spacing asks for more than {MOST_POINTS:,} receivers on it",
                           "Raise the setting spacing, or set it to 0 to bake at the mesh's own vertices")
        middle = np.full(triangles.shape, -1, np.int64)
        middle[too_long] = len(points) + middle_of
        ends = np.stack([split_keys // len(points), split_keys % len(points)], axis=1)
        points = np.concatenate([points, points[ends].mean(axis=1)])
        between = normals[ends].sum(axis=1)
        length = np.sqrt(np.sum(between ** 2, axis=1, keepdims=True))
        between = np.where(length > 1e-6, between / np.maximum(length, 1e-6), normals[ends[:, 0]])
        normals = np.concatenate([normals, between])
        albedo = np.concatenate([albedo, albedo[ends].mean(axis=1)])
        if beside is not None:
            beside.grow(ends, between)
        triangles, parent = _cut(points, triangles, middle)
        if beside is not None and beside.source is not None:
            beside.source = beside.source[parent]
    return points, normals, albedo, triangles


def _cut(points: NDArray[np.float64], triangles: NDArray[np.int32], middle: NDArray[np.int64],
         ) -> tuple[NDArray[np.int32], NDArray[np.int64]]:
    """Triangles cut at the middles (t, 3) of their edges (corner k to k + 1), -1 leaves an edge whole; and which
    triangle each one is a part of."""
    split = middle >= 0
    count = split.sum(axis=1)
    parts = [triangles[count == 0]]
    whole, one, two, three = (np.flatnonzero(count == number) for number in range(4))
    # Three middles: four similar triangles.
    (a, b, c), (ab, bc, ca) = triangles[count == 3].T, middle[count == 3].T
    parts += [np.stack(t, axis=1) for t in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))]
    # One middle: turn the triangle so that it lies on the first edge.
    a, b, c, ab, _ = _turned(triangles[count == 1], middle[count == 1], split[count == 1].argmax(axis=1))
    parts += [np.stack(t, axis=1) for t in ((a, ab, c), (ab, b, c))]
    # Two middles: turn so that the whole edge is the last, then cut the quad along its shorter diagonal.
    a, b, c, ab, bc = _turned(triangles[count == 2], middle[count == 2], ((~split[count == 2]).argmax(axis=1) + 1) % 3)
    short = np.sum((points[a] - points[bc]) ** 2, axis=1) < np.sum((points[ab] - points[c]) ** 2, axis=1)
    parts += [np.stack((ab, b, bc), axis=1),
              np.stack((a, ab, bc), axis=1)[short], np.stack((a, bc, c), axis=1)[short],
              np.stack((a, ab, c), axis=1)[~short], np.stack((ab, bc, c), axis=1)[~short]]
    parents = [whole, *[three] * 4, *[one] * 2, two, *[two[short]] * 2, *[two[~short]] * 2]
    return np.concatenate(parts).astype(np.int32), np.concatenate(parents)


def _turned(triangles: NDArray[np.int32], middle: NDArray[np.int64], start: NDArray[np.int64],
            ) -> tuple[NDArray, NDArray, NDArray, NDArray, NDArray]:
    """Corners and the middles of the first two edges, counted from corner `start` of each triangle."""
    order = (start[:, None] + np.arange(3)) % 3
    corners = np.take_along_axis(triangles, order, axis=1)
    middles = np.take_along_axis(middle, order, axis=1)
    return corners[:, 0], corners[:, 1], corners[:, 2], middles[:, 0], middles[:, 1]
