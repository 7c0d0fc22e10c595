# SPDX-License-Identifier: GPL-3.0-or-later
"""Directions as the texels of a cube's six faces: piecewise constant columns for light of all frequencies.

Faces +X, -X, +Y, -Y, +Z, -Z. On the face of axis a (0, 1, 2) and sign s the point (column u, row v), both in -1..1,
is the direction s e_a + u e_(a+1) + v e_(a+2), axes counted round: the same on every axis, so a turn that maps the
cube on itself permutes texels. Texel index = (face * r + row) * r + column, with r texels along an edge.
"""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

# A step over a face's edge, in units of half the edge: far below a texel, far above rounding.
_STEP = 1e-6


def _check_size(r: int) -> None:
    if r < 1:
        raise ValueError(f"a cubemap needs 1 texel or more along an edge, not {r}")


def texel_count(r: int) -> int:
    """Texels of a cubemap with r along an edge: 6 r r."""
    _check_size(r)
    return 6 * r * r


def face_points(face: ArrayLike, u: ArrayLike, v: ArrayLike) -> Array:
    """Points (..., 3) of the cube's faces 0..5 at (u, v), broadcast; not normalised, u and v may leave -1..1."""
    face, u, v = np.broadcast_arrays(np.asarray(face, np.int64), np.asarray(u, np.float64), np.asarray(v, np.float64))
    axis = face // 2
    points = np.empty((*face.shape, 3))
    for offset, value in ((0, 1.0 - 2.0 * (face % 2)), (1, u), (2, v)):
        np.put_along_axis(points, ((axis + offset) % 3)[..., None], value[..., None], axis=-1)
    return points


def face_coordinates(directions: ArrayLike) -> tuple[Indices, Array, Array]:
    """Face (...), u (...) and v (...) where directions (..., 3) of any length above zero meet the cube."""
    directions = np.asarray(directions, np.float64)
    x, y, z = np.moveaxis(directions, -1, 0)
    ax, ay, az = np.abs(x), np.abs(y), np.abs(z)
    on_x = (ax >= ay) & (ax >= az)
    on_y = ~on_x & (ay >= az)
    height = np.where(on_x, x, np.where(on_y, y, z))
    over = 1.0 / np.abs(height)
    face = np.where(on_x, 0, np.where(on_y, 2, 4)) + (height < 0.0)
    return face, np.where(on_x, y, np.where(on_y, z, x)) * over, np.where(on_x, z, np.where(on_y, x, y)) * over


def texel_edges(r: int) -> Array:
    """Where texels begin and end along a face's edge: (r + 1,) from -1 to 1."""
    _check_size(r)
    return -1.0 + 2.0 * np.arange(r + 1) / r


@lru_cache(maxsize=16)
def cubemap_directions(r: int) -> Array:
    """Unit directions (6 r r, 3) float64 of the texels' centres, read-only. Raises ValueError for r below 1."""
    return _read_only(sample_directions(r, 1).reshape(-1, 3))


def sample_directions(r: int, samples: int) -> Array:
    """Unit directions (6 r r, samples^2, 3): an even grid of samples x samples points of the face in every texel."""
    _check_size(r)
    _check_size(samples)
    middle = -1.0 + 2.0 * (np.arange(r * samples) + 0.5) / (r * samples)
    face, v, u = np.meshgrid(np.arange(6), middle, middle, indexing="ij")
    points = face_points(face, u, v)
    points /= np.sqrt(np.sum(points ** 2, axis=-1, keepdims=True))
    split = points.reshape(6, r, samples, r, samples, 3).transpose(0, 1, 3, 2, 4, 5)
    return np.ascontiguousarray(split).reshape(6 * r * r, samples * samples, 3)


@lru_cache(maxsize=16)
def cubemap_solid_angles(r: int) -> Array:
    """Solid angles (6 r r,) float64 of the texels, sum 4 pi, read-only. Raises ValueError for r below 1.

    The rectangle from the face's middle to (u, v) has the solid angle atan(u v / sqrt(1 + u^2 + v^2)); a texel is
    the alternating sum over its corners. Texels in a face's corner are up to 3 sqrt(3) times smaller than those in its
    middle.
    """
    return _read_only(np.tile(grid_solid_angles(texel_edges(r)).ravel(), 6))


def grid_solid_angles(edges: Array) -> Array:
    """Solid angles (n - 1, n - 1) of the rectangles between edges (n,) along u and v of a face."""
    u, v = edges[None, :], edges[:, None]
    corner = np.arctan2(u * v, np.sqrt(1.0 + u * u + v * v))
    return np.diff(np.diff(corner, axis=0), axis=1)


def texel_of(directions: ArrayLike, r: int) -> Indices:
    """Indices (...) of the texels that directions (..., 3), of any length above zero, fall in."""
    _check_size(r)
    face, u, v = face_coordinates(directions)
    column = np.clip(np.floor((u + 1.0) * (0.5 * r)), 0, r - 1).astype(np.int64)
    row = np.clip(np.floor((v + 1.0) * (0.5 * r)), 0, r - 1).astype(np.int64)
    return (face * r + row) * r + column


@lru_cache(maxsize=16)
def _bordered_texels(r: int) -> Indices:
    """Texel indices (6, r + 2, r + 2) of faces with a border: the texels across the edges; -1 in the corners, where
    three texels meet and there is no fourth."""
    middle = -1.0 + 2.0 * (np.arange(r) + 0.5) / r
    ends = np.concatenate([[-1.0 - _STEP], middle, [1.0 + _STEP]])
    face, v, u = np.meshgrid(np.arange(6), ends, ends, indexing="ij")
    texels = texel_of(face_points(face, u, v), r)
    texels[:, [0, 0, -1, -1], [0, -1, 0, -1]] = -1
    texels.setflags(write=False)
    return texels


def bilinear_texels(directions: ArrayLike, r: int) -> tuple[Indices, Array]:
    """Texels (n, 4) and weights (n, 4), sum 1, that a bilinear look-up in directions (n, 3) blends, across edges too.

    At the cube's corners only three texels meet: the fourth one's weight is shared by the three. Moving a direction
    moves the weights continuously within a face and over its edges.
    """
    _check_size(r)
    face, u, v = face_coordinates(directions)
    x, y = (u + 1.0) * (0.5 * r) + 0.5, (v + 1.0) * (0.5 * r) + 0.5  # in the bordered face, texel centres whole
    column, row = (np.clip(np.floor(t), 0, r).astype(np.int64) for t in (x, y))
    fx, fy = x - column, y - row
    first = (face * (r + 2) + row) * (r + 2) + column
    places = first[:, None] + np.array([0, 1, r + 2, r + 3])
    texels = _bordered_texels(r).ravel()[places]
    weights = np.stack([(1 - fx) * (1 - fy), fx * (1 - fy), (1 - fx) * fy, fx * fy], axis=1)
    cornered = np.flatnonzero((texels < 0).any(axis=1))
    if len(cornered):
        missing = texels[cornered] < 0
        share = np.sum(weights[cornered] * missing, axis=1, keepdims=True) / 3.0
        weights[cornered] = np.where(missing, 0.0, weights[cornered] + share)
        texels[cornered] = np.where(missing, texels[cornered].max(axis=1, keepdims=True), texels[cornered])
    return texels, weights


def angular_size(r: int) -> float:
    """The angle in radians that the widest texel, in a face's middle, is wide."""
    return 2.0 * math.atan(1.0 / r)


def _read_only(values: Array) -> Array:
    values.setflags(write=False)
    return values
