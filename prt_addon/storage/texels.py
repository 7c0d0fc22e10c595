# SPDX-License-Identifier: GPL-3.0-or-later
"""How a bake at texels keeps its atlas: numbers in the header (`atlas`), each texel's place and triangle, and one list
of numbers for the surface that they lie on (world space when baked)."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import StorageError
from ..scene.texel_surface import TexelSurface

ENTRY = "atlas"
TEXEL_ATTRIBUTE, TRIANGLE_ATTRIBUTE, ATLAS_PROPERTY = "prt_texel", "prt_texel_triangle", "prt_atlas"
LARGEST = 2 ** 24  # numbers that single precision holds exactly


def atlas_entry(surface: TexelSurface) -> dict[str, Any]:
    """`atlas` of a header."""
    return {**surface.numbers(), "points": len(surface.points), "triangles": len(surface.triangles),
            "holds": "texel row * width + column of each point, row 0 the lowest; coordinate (place + 0.5) / size"}


def texel_numbers(surface: TexelSurface) -> NDArray[np.int32]:
    """(n,) row * width + column of each texel."""
    return (surface.row * np.int32(surface.width) + surface.column).astype(np.int32)


def flatten_surface(surface: TexelSurface) -> NDArray[np.float32]:
    """The surface as one list: points, normals, tangents (v, 3 each), triangles (t, 3), places (t, 3, 2), source (t,).
    """
    return np.concatenate([np.asarray(values, np.float32).ravel() for values in (
        surface.points, surface.normals, surface.tangents, surface.triangles, surface.places, surface.source)])


def read_texels(header: dict[str, Any], flat: NDArray | None, number: NDArray | None, triangle: NDArray | None,
                joined: NDArray[np.integer], subject: str, remedy: str) -> TexelSurface | None:
    """The texels of a header, its list, the texels' numbers and triangles (n,), and the triangles (2 c, 3) that join
    them; None where the header states none. Raises StorageError where they contradict each other."""
    entry = header.get(ENTRY)
    if entry is None:
        return None
    broken = StorageError(subject, "the atlas of its texels is missing or broken", remedy)
    sizes = [entry.get(name) if isinstance(entry, dict) else None
             for name in ("width", "height", "charts", "points", "triangles")]
    if not all(type(size) is int and 0 < size < LARGEST for size in sizes) or not (
            type(entry.get("texel")) in (int, float) and isinstance(entry.get("method"), str)):
        raise broken
    width, height, charts, points, triangles = sizes
    missing = flat is None or number is None or triangle is None
    if missing or flat.size != 9 * points + 10 * triangles or len(joined) % 2:
        raise broken
    numbers, key = np.asarray(flat, np.float64), np.asarray(number, np.int64)
    own = np.asarray(triangle, np.int64)
    if not np.isfinite(numbers).all() or len(key) != len(own) or not len(key) or not len(joined):
        raise broken
    parts = np.split(numbers, np.cumsum([3 * points] * 3 + [3 * triangles, 6 * triangles]))
    corner = parts[3].astype(np.int32).reshape(-1, 3)
    cells = np.stack([joined[0::2, 0], joined[0::2, 1], joined[1::2, 2], joined[0::2, 2]], axis=1).astype(np.int32)
    inside = corner.min() >= 0 and corner.max() < points and own.min() >= 0 and own.max() < triangles
    if not inside or key.min() < 0 or key.max() >= width * height or len(np.unique(key)) != len(key):
        raise broken
    return TexelSurface(*(part.reshape(-1, 3) for part in parts[:3]), corner,
                        parts[4].reshape(-1, 3, 2).astype(np.float32), parts[5].astype(np.int32), cells,
                        (key % width).astype(np.int32), (key // width).astype(np.int32), own.astype(np.int32),
                        width, height, charts, float(entry["texel"]), entry["method"])
