# SPDX-License-Identifier: GPL-3.0-or-later
"""Where the rays of a receiver start, and in which order receivers are traced."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

# A receiver moves this fraction of the way to the middle of its own faces, so that a point on a concave edge or on a
# touching object does not lie exactly in the other surface. At 1 % of an edge the transfer is still the vertex's.
PULL = 0.01
# Least height above the own faces, as a fraction of the scene's diagonal: 16 units in the last place of single
# precision, in which Embree holds coordinates up to half the diagonal.
LIFT = 1e-6
# Faces steeper than this against the shading normal can't be cleared by moving along it.
STEEPEST = 0.1
# Faces at a point that are told apart; the pole of a fine sphere has hundreds that hardly differ.
MOST_FACES = 8
# The lift may not carry a receiver further than this fraction of the distance to its faces' middle.
HIGHEST = 0.25


def ray_origins(points: NDArray[np.float64], normals: NDArray[np.float64], triangles: NDArray[np.int32],
                diagonal: float, side: int = 1, faces: NDArray[np.floating] | None = None) -> NDArray[np.float64]:
    """Ray origins (p, 3) float64 of all points: pulled into their faces and lifted above them.

    side: 1 for the front of the surface, -1 for its back. diagonal: of the whole scene, metres. Loose points only
    get the lift. faces: (p, 3) unit normal of the one face that a texel lies on, zero for vertices; None: all are.
    """
    count = len(points)
    corners = points[triangles]
    face = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    twice_area = np.sqrt(np.sum(face ** 2, axis=1))
    unit = side * face / np.maximum(twice_area, np.finfo(np.float64).tiny)[:, None]
    owner = triangles.ravel()
    total = np.bincount(owner, weights=np.repeat(twice_area, 3), minlength=count)
    middle = corners.mean(axis=1)
    weighted = np.repeat(middle * twice_area[:, None], 3, axis=0)
    centre = np.stack([np.bincount(owner, weights=weighted[:, axis], minlength=count) for axis in range(3)], axis=1)
    has_face = total > 0.0
    shift = np.zeros_like(points)
    shift[has_face] = PULL * (centre[has_face] / total[has_face, None] - points[has_face])
    upward = side * normals
    slope = np.sum(np.repeat(unit, 3, axis=0) * upward[owner], axis=1)
    depth = -np.sum(np.repeat(unit, 3, axis=0) * shift[owner], axis=1)
    lift = LIFT * diagonal
    needed = np.where(slope > STEEPEST, (lift + depth) / np.maximum(slope, STEEPEST), lift)
    height = np.full(count, lift)
    np.maximum.at(height, owner, needed)
    # Where a spike's faces ask for more, the shading normal says nothing about the surface: stay near the vertex.
    reach = np.sqrt(np.sum(shift ** 2, axis=1)) * (HIGHEST / PULL)
    height = np.minimum(height, np.maximum(reach, lift))
    if faces is not None:
        # A texel's triangles join it to others, not always along its face: only what they say along it counts.
        texel = faces.any(axis=1)
        own = side * faces[texel]
        shift[texel] -= np.sum(shift[texel] * own, axis=1, keepdims=True) * own
        height[texel] = lift / np.maximum(np.sum(own * upward[texel], axis=1), STEEPEST)
    return points + shift + height[:, None] * upward


def adjacent_faces(points: NDArray[np.float64], triangles: NDArray[np.int32],
                   own: NDArray[np.floating] | None = None) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Unit normals (p, k, 3) of each point's faces and their weights (p, k) by angle, of sum 1 (0: no face).

    own: as `faces` of `ray_origins`: a texel has this one alone. k is the largest number of faces at a point, at most
    MOST_FACES; of more, evenly spaced ones stand for all. By angle, because a quad must count the same whichever way it
    was cut.
    """
    corners = points[triangles]
    edges = np.roll(corners, -1, axis=1) - corners
    edges /= np.maximum(np.sqrt(np.sum(edges ** 2, axis=2, keepdims=True)), np.finfo(np.float64).tiny)
    face = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    face /= np.maximum(np.sqrt(np.sum(face ** 2, axis=1, keepdims=True)), np.finfo(np.float64).tiny)
    angle = np.arccos(np.clip(-np.sum(edges * np.roll(edges, 1, axis=1), axis=2), -1.0, 1.0)).ravel()
    owner = triangles.ravel()
    order = np.argsort(owner, kind="stable")
    degree = np.bincount(owner, minlength=len(points))
    rank = np.arange(len(owner)) - np.repeat(np.cumsum(degree) - degree, degree)
    number = np.minimum(degree, MOST_FACES)[owner[order]]
    slot = rank * number // np.maximum(degree[owner[order]], 1)
    first = (rank == 0) | (slot != (rank - 1) * number // np.maximum(degree[owner[order]], 1))
    width = int(min(degree.max(initial=1), MOST_FACES))
    normals = np.zeros((len(points), width, 3), np.float32)
    weights = np.zeros((len(points), width), np.float32)
    place = owner[order][first], slot[first]
    normals[place] = face[order[first] // 3]
    weights[place] = angle[order[first]]
    if own is not None:
        texel = own.any(axis=1)
        normals[texel], weights[texel] = 0.0, 0.0
        normals[texel, 0], weights[texel, 0] = own[texel], 1.0
    weights /= np.maximum(weights.sum(axis=1, keepdims=True), np.finfo(np.float32).tiny)
    return normals, weights


def morton_order(points: NDArray[np.floating]) -> NDArray[np.int64]:
    """Indices that sort points along a Morton curve of 21 bits per axis: neighbours in memory are neighbours in space.

    Rays in one direction from such neighbours visit the same nodes of Embree's tree.
    """
    if not len(points):
        return np.zeros(0, np.int64)
    low = points.min(axis=0)
    extent = float((points.max(axis=0) - low).max())
    cells = ((points - low) * ((2 ** 21 - 1) / extent if extent > 0.0 else 0.0)).astype(np.uint64)
    code = np.zeros(len(points), np.uint64)
    for axis in range(3):
        code |= _spread(cells[:, axis]) << np.uint64(axis)
    return np.argsort(code, kind="stable")


def _spread(value: NDArray[np.uint64]) -> NDArray[np.uint64]:
    """Insert two zero bits between the lowest 21 bits of each number."""
    spread = value & np.uint64(0x1FFFFF)
    for shift, mask in ((32, 0x1F00000000FFFF), (16, 0x1F0000FF0000FF), (8, 0x100F00F00F00F00F),
                        (4, 0x10C30C30C30C30C3), (2, 0x1249249249249249)):
        spread = (spread | (spread << np.uint64(shift))) & np.uint64(mask)
    return spread
