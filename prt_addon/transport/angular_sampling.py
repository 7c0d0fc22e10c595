# SPDX-License-Identifier: GPL-3.0-or-later
"""Angular sampling of dense vertices in two passes (Huang & Ramamoorthi 2010, section 4.2).

First every second texel of every second row of the cubemap, a quarter of all. Then, of the rest, those in whose 7 x 7
window the samples differ: the features. What is left takes its neighbours' value. Windows go on across the edges of
faces. Smooth indirect light makes do with the first pass.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from ..basis.cubemap import face_points, texel_of
from .elements import Elements

Single = NDArray[np.float32]
Places = NDArray[np.int64]

# Texels to either side of the 7 x 7 window, and samples of the coarse grid that this can reach beyond an edge.
REACH, BORDER = 3, 2
# Vertices at once: their values and masks are 60 MB at 6 x 32 x 32.
VERTICES = 512


@dataclass(frozen=True)
class DenseRows:
    """values (n, columns) float32 of dense vertices in all directions; features (n, columns) bool: sampled in the
    second pass, or in the first where samples around it differ."""

    values: Single
    features: NDArray[np.bool_]


def edge_of(columns: int) -> int:
    """Texels along a face's edge. Raises ValueError where columns are no cubemap's."""
    r = math.isqrt(columns // 6)
    if 6 * r * r != columns or r < 1:
        raise ValueError(f"{columns} columns are no cubemap's 6 r r")
    return r


@lru_cache(maxsize=8)
def quarter_grid(r: int) -> Places:
    """Texels (6 c c,) of the first pass, c = half of r rounded up."""
    face, row, column = np.meshgrid(np.arange(6), np.arange(0, r, 2), np.arange(0, r, 2), indexing="ij")
    return ((face * r + row) * r + column).ravel()


@lru_cache(maxsize=8)
def _bordered_grid(r: int) -> Places:
    """Numbers (6, c + 2 BORDER, c + 2 BORDER) of first-pass samples on faces with a border: beyond an edge the nearest
    sample on the next face, seen from the cube's middle."""
    half = (r + 1) // 2
    steps = 2 * np.arange(-BORDER, half + BORDER)
    middle = -1.0 + 2.0 * (steps + 0.5) / r
    face, v, u = np.meshgrid(np.arange(6), middle, middle, indexing="ij")
    texel = texel_of(face_points(face, u, v), r)
    face, row, column = texel // (r * r), texel // r % r, texel % r
    return (face * half + row // 2) * half + column // 2


def dense_rows(elements: Elements, vertices: Places) -> DenseRows:
    """Sample vertices (n,) as dense ones, in blocks; deterministic, whatever else is sampled before or with them."""
    rows = DenseRows(np.zeros((len(vertices), elements.columns), np.float32),
                     np.zeros((len(vertices), elements.columns), bool))
    for start in range(0, len(vertices), VERTICES):
        sample_rows(elements, vertices[start:start + VERTICES], rows, start)
    return rows


def sample_rows(elements: Elements, vertices: Places, rows: DenseRows, start: int) -> None:
    """Sample at most VERTICES vertices into zeros of rows, from number `start` on."""
    part = slice(start, start + len(vertices))
    sample = _two_passes if elements.angular else _one_pass
    sample(elements, vertices, rows.values[part], rows.features[part])


def _first_pass(elements: Elements, vertices: Places, unknown: NDArray[np.bool_]) -> tuple[Single, NDArray[np.bool_]]:
    """Values (n, 6 c c) of the quarter grid, zero where known to be, and which were computed."""
    grid = quarter_grid(edge_of(elements.columns))
    wanted = unknown[:, grid]
    values = np.zeros(wanted.shape, np.float32)
    column, row = np.nonzero(wanted.T)  # in the order of columns: coherent rays
    values[row, column] = elements.evaluate(vertices[row], grid[column])
    return values, wanted


def _two_passes(elements: Elements, vertices: Places, values: Single, features: NDArray[np.bool_]) -> None:
    """Direct light, into values and features (n, columns)."""
    r = edge_of(elements.columns)
    grid = quarter_grid(r)
    unknown = elements.unknown(vertices)
    coarse, computed = _first_pass(elements, vertices, unknown)
    low, high = window_range(coarse, computed, r)
    varies = unknown & ~(low == high)  # also where the window holds no sample at all
    wanted = varies.copy()
    wanted[:, grid] = False
    values[...] = np.where(np.isfinite(low), low, 0.0)
    values[:, grid] = np.where(computed, coarse, values[:, grid])
    column, row = np.nonzero(wanted.T)
    values[row, column] = elements.evaluate(vertices[row], column)
    features[...] = varies


def _one_pass(elements: Elements, vertices: Places, values: Single, features: NDArray[np.bool_]) -> None:
    """Indirect light: the quarter grid, halfway values between its samples; every sample counts as a feature."""
    r = edge_of(elements.columns)
    coarse, computed = _first_pass(elements, vertices, elements.unknown(vertices))
    values[...] = upsampled(coarse, r)
    features[:, quarter_grid(r)] = computed


def window_range(coarse: Single, computed: NDArray[np.bool_], r: int) -> tuple[Single, Single]:
    """Least and largest first-pass sample (n, 6 r r) in the 7 x 7 window of every texel; inf and -inf without any.

    coarse, computed: (n, 6 c c). A texel in an even row sees the samples of rows -2, 0, +2, one in an odd row those of
    rows -3, -1, +1, +3; columns alike.
    """
    low = _windows(np.where(computed, coarse, np.float32(np.inf)), r, np.minimum)
    high = _windows(np.where(computed, coarse, np.float32(-np.inf)), r, np.maximum)
    return low, high


def _windows(coarse: Single, r: int, pick: np.ufunc) -> Single:
    """The windows' least or largest sample (n, 6 r r)."""
    bordered = coarse[:, _bordered_grid(r)]
    half = (r + 1) // 2
    rows = _along(bordered, 2, half, pick)
    both = [_along(part, 3, half, pick) for part in rows]
    result = np.empty((len(coarse), 6, 2 * half, 2 * half), np.float32)
    for row in range(2):
        for column in range(2):
            result[:, :, row::2, column::2] = both[row][column]
    return np.ascontiguousarray(result[:, :, :r, :r]).reshape(len(coarse), -1)


def _along(values: Single, axis: int, half: int, pick: np.ufunc) -> tuple[Single, Single]:
    """Along an axis the pick of 3 samples about each (even texels) and of the 4 about each gap (odd texels)."""
    def shifted(by: int) -> Single:
        index = [slice(None)] * values.ndim
        index[axis] = slice(BORDER + by, BORDER + by + half)
        return values[tuple(index)]

    inner = pick(shifted(0), shifted(1))
    return pick(inner, shifted(-1)), pick(pick(inner, shifted(-1)), shifted(2))


def upsampled(coarse: Single, r: int) -> Single:
    """First-pass samples (n, 6 c c) on all texels (n, 6 r r): themselves, and the mean of the two or four next to a
    gap."""
    bordered = coarse[:, _bordered_grid(r)]
    half = (r + 1) // 2
    result = np.empty((len(coarse), 6, 2 * half, 2 * half), np.float32)
    here, after = slice(BORDER, BORDER + half), slice(BORDER + 1, BORDER + half + 1)
    corner, right = bordered[:, :, here, here], bordered[:, :, here, after]
    below, across = bordered[:, :, after, here], bordered[:, :, after, after]
    result[:, :, ::2, ::2] = corner
    result[:, :, ::2, 1::2] = 0.5 * (corner + right)
    result[:, :, 1::2, ::2] = 0.5 * (corner + below)
    result[:, :, 1::2, 1::2] = 0.25 * (corner + right + below + across)
    return np.ascontiguousarray(result[:, :, :r, :r]).reshape(len(coarse), -1)
