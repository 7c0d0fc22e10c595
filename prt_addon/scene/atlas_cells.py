# SPDX-License-Identifier: GPL-3.0-or-later
"""Where a place on a surface lies among the texels of its atlas: bilinear filtering, and as triangles of texels."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Double = NDArray[np.float64]
INWARD = 1e-3  # texels


@dataclass(frozen=True)
class AtlasCells:
    """width: of the atlas, in texels; places: (t, 3, 2) float64 of triangles' corners in it, texel (column, row) with
    its centre there; cells: (c, 4) texels around each square between texels that a triangle touches: lower left, lower
    right, upper left, upper right; cell_key: (c,) int64 row * width + column of their lower left, ascending; fallback:
    (t,) int64, a cell that each triangle touches (-1: none, it has no area)."""

    width: int
    places: Double
    cells: NDArray[np.integer]
    cell_key: NDArray[np.int64]
    fallback: NDArray[np.int64]

    @staticmethod
    def of_texels(width: int, places: Double, cells: NDArray[np.integer], column: NDArray[np.integer],
                  row: NDArray[np.integer]) -> AtlasCells:
        """The same from the column and row of each texel; cells in the order of their keys."""
        key = row[cells[:, 0]].astype(np.int64) * width + column[cells[:, 0]]
        made = AtlasCells(width, places, cells, key, np.full(len(places), -1, np.int64))
        return AtlasCells(width, places, cells, key, made._found(places.mean(axis=1))[0])

    def cells_at(self, triangle: NDArray[np.integer], u: NDArray[np.floating], v: NDArray[np.floating],
                 ) -> tuple[NDArray[np.int64], Double]:
        """The cell (k,) of places on triangles, and where in it (k, 2), 0..1. u, v: weights of corners 1 and 2."""
        corners = self.places[triangle]
        at = corners[:, 0] + u[:, None] * (corners[:, 1] - corners[:, 0]) + v[:, None] * (corners[:, 2] - corners[:, 0])
        cell, part = self._found(at)
        missing = np.flatnonzero(cell < 0)
        if len(missing):  # on a rim, by rounding: whose square lies a little towards the triangle's middle
            inward = corners[missing].mean(axis=1) - at[missing]
            inward *= INWARD / np.maximum(np.abs(inward).max(axis=1, keepdims=True), INWARD)
            found, _ = self._found(at[missing] + inward)
            cell[missing] = np.where(found < 0, self.fallback[triangle[missing]], found)
            key = self.cell_key[cell[missing]]
            part[missing] = np.clip(at[missing] - np.stack([key % self.width, key // self.width], axis=1), 0.0, 1.0)
        return cell, part

    def _found(self, at: Double) -> tuple[NDArray[np.int64], Double]:
        low = np.floor(at).astype(np.int64)
        key = low[:, 1] * self.width + low[:, 0]
        place = np.minimum(np.searchsorted(self.cell_key, key), len(self.cell_key) - 1)
        return np.where(self.cell_key[place] == key, place, -1), at - low

    def sample(self, values: NDArray[np.floating], triangle: NDArray[np.integer], u: NDArray[np.floating],
               v: NDArray[np.floating]) -> NDArray[np.float64]:
        """Values (n, k) of texels at places on triangles, filtered bilinearly: (m, k). u, v: (m,) weights of corners
        1 and 2."""
        cell, part = self.cells_at(triangle, u, v)
        x, y = part[:, 0], part[:, 1]
        shares = np.stack([(1 - x) * (1 - y), x * (1 - y), (1 - x) * y, x * y], axis=1)
        return np.sum(values[self.cells[cell]] * shares[:, :, None], axis=1)

    def cell_triangles(self) -> NDArray[np.int64]:
        """(2 c, 3) texels of each cell's two triangles, one after the other: right of its diagonal, left of it."""
        a, b, c, d = self.cells.T
        return np.stack([np.stack([a, b, d], axis=1), np.stack([a, d, c], axis=1)], axis=1).reshape(-1, 3)

    def on_cell_triangles(self, triangle: NDArray[np.integer], u: NDArray[np.floating], v: NDArray[np.floating],
                          ) -> tuple[NDArray[np.int64], Double, Double]:
        """The same places (k,) on `cell_triangles`: which one, and the weights of its corners 1 and 2."""
        cell, part = self.cells_at(triangle, u, v)
        x, y = part[:, 0], part[:, 1]
        right = x >= y
        return 2 * cell + ~right, np.where(right, x - y, x), np.where(right, y, y - x)
