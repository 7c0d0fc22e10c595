# SPDX-License-Identifier: GPL-3.0-or-later
"""Textures on receivers: which part of which image each baked triangle shows, so that drawing can sample it per pixel.

Baked triangles are those of the source mesh or flat parts of them, so that places in a texture follow from a source
triangle's corners exactly, whatever was split or refined in between.
"""

from __future__ import annotations

from collections.abc import Hashable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

ROUNDING = 4e-7  # of single precision, in which bakes hold positions, relative to the largest


@dataclass(frozen=True)
class TextureUse:
    """An image as the albedo of a surface: factor (3,) times its linear colour.

    image: name and library (None: this file) of the data-block. smooth: interpolated between pixels, else the nearest.
    extension: REPEAT, EXTEND, CLIP or MIRROR, what lies beyond the image's edges.
    """

    image: tuple[str, str | None]
    factor: tuple[float, float, float]
    smooth: bool
    extension: str


@dataclass(frozen=True, eq=False)
class SurfaceTextures:
    """use: (t,) int32, the place in `uses` of each baked triangle's texture, -1 for none; places: (t, 3, 2) float32 of
    its corners in the texture, (0, 0) the lower left of the image, (1, 1) the upper right; key: equal for equal
    content."""

    uses: tuple[TextureUse, ...]
    use: NDArray[np.int32]
    places: NDArray[np.float32]
    key: Hashable


def shares_of_corners(points: NDArray[np.floating], corners: NDArray[np.floating]) -> NDArray[np.float64]:
    """Shares (n, k, 3), of sum 1, of the corners (n, 3, 3) of flat triangles at points (n, k, 3) in their planes.

    At a corner's own place its share is exactly 1. A triangle without area gives everything to its first corner.
    """
    corners, points = np.asarray(corners, np.float64), np.asarray(points, np.float64)
    first, second = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    offset = points - corners[:, :1]
    a, b, c = (np.sum(x * y, axis=1)[:, None] for x, y in ((first, first), (first, second), (second, second)))
    along, across = np.sum(offset * first[:, None], axis=2), np.sum(offset * second[:, None], axis=2)
    determinant = a * c - b * b
    usable = determinant > 1e-20 * (a * c)
    determinant = np.where(usable, determinant, 1.0)
    u = np.where(usable, (c * along - b * across) / determinant, 0.0)
    v = np.where(usable, (a * across - b * along) / determinant, 0.0)
    shares = np.stack([1.0 - u - v, u, v], axis=2)
    for corner in range(3):
        same = (points == corners[:, corner:corner + 1]).all(axis=2)
        shares[same] = np.eye(3)[corner]
    return shares


def places_on_parts(points: NDArray[np.floating], source: NDArray[np.int32], source_corners: NDArray[np.floating],
                    source_places: NDArray[np.floating]) -> NDArray[np.float32]:
    """Places (t, 3, 2) in textures at the corners (t, 3, 3) of triangles that are parts of source triangles.

    source: (t,) into source_corners (s, 3, 3), in the same space as points, and source_places (s, 3, 2).
    """
    own = source_corners[source]
    if float(np.abs(points - own).max(initial=0.0)) <= ROUNDING * float(np.abs(own).max(initial=0.0)):
        return source_places[source].astype(np.float32)  # whole triangles, their corners in order
    shares = shares_of_corners(points, own)
    return np.sum(shares[..., None] * source_places[source][:, None], axis=2).astype(np.float32)
