# SPDX-License-Identifier: GPL-3.0-or-later
"""Texels spread evenly over a mesh without unwrapping it: the paper's meshed atlas (Carr & Hart 2002) at texel size.

Triangles are packed one by one, in an order in which neighbours in space are neighbours in the atlas, and each gets
texels in proportion to its area. No mesh fails, no texel is empty, and every texel stands for the same area.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .surface_pyramid import quadtree_order

# The plastic number's powers: the additive recurrence that covers a square most evenly in two dimensions.
TURNS = np.array([0.7548776662466927, 0.5698402909980532])


class SurfaceTexels(NamedTuple):
    """n texels. points, normals: (n, 3), areas: (n,); triangle: (n,) that each lies on; weights: (n, 3) barycentric."""

    points: NDArray[np.float64]
    normals: NDArray[np.float64]
    areas: NDArray[np.float64]
    triangle: NDArray[np.int64]
    weights: NDArray[np.float64]


def texels_on_mesh(positions: NDArray[np.floating], normals: NDArray[np.floating], triangles: NDArray[np.integer],
                   count: int) -> SurfaceTexels:
    """count texels of equal area on triangles (t, 3) of vertices (v, 3) with unit normals (v, 3)."""
    corners = np.asarray(positions, np.float64)[triangles]
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = 0.5 * np.sqrt(np.sum(across**2, axis=1))
    order = quadtree_order(corners.mean(axis=1))
    along = np.cumsum(area[order])
    place = np.searchsorted(along, (np.arange(count) + 0.5) / count * along[-1], side="right")
    triangle = order[np.minimum(place, len(order) - 1)]
    square = (np.arange(count)[:, None] * TURNS + 0.5) % 1.0
    # Folds the square onto the triangle, evenly.
    outside = square.sum(axis=1) > 1.0
    square[outside] = 1.0 - square[outside]
    weights = np.concatenate([1.0 - square.sum(axis=1, keepdims=True), square], axis=1)
    points = np.sum(weights[:, :, None] * corners[triangle], axis=1)
    towards = np.sum(weights[:, :, None] * np.asarray(normals, np.float64)[triangles[triangle]], axis=1)
    length = np.maximum(np.sqrt(np.sum(towards**2, axis=1, keepdims=True)), 1e-300)
    return SurfaceTexels(points, towards / length, np.full(count, along[-1] / count), triangle, weights)
