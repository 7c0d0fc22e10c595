# SPDX-License-Identifier: GPL-3.0-or-later
"""Texels as receivers: an object's points are the texels of its atlas, its triangles join neighbouring ones.

So no later stage knows of texels: transfer belongs to points, and what a ray meets is blended from the three points
around it. Rays themselves meet the true surface (`traced`), whose hits are then named by the texels' triangles: a
wall of two triangles stays one to the tracer, however many texels lie on it.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .atlas import Atlas
from .atlas_cells import AtlasCells
from .charts import face_normals

Double = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class TexelSurface:
    """The surface that texels lie on, in world space, and its layout.

    points, normals, tangents: (v, 3) of its vertices (tangents along the surface, unit); triangles: (t, 3) int32;
    places: (t, 3, 2) float32 of corners in the atlas (see `Atlas`); source: (t,) int32 as in SceneMesh; cells: (c, 4)
    int32 into texels; column, row, triangle: (n,) int32 of the texels, the triangle that each lies on. width, height,
    charts: of the atlas; texel: metres; method: of its charts.
    """

    points: Double
    normals: Double
    tangents: Double
    triangles: NDArray[np.int32]
    places: NDArray[np.float32]
    source: NDArray[np.int32]
    cells: NDArray[np.int32]
    column: NDArray[np.int32]
    row: NDArray[np.int32]
    triangle: NDArray[np.int32]
    width: int
    height: int
    charts: int
    texel: float
    method: str

    @staticmethod
    def of_atlas(atlas: Atlas, points: Double, normals: Double, tangents: Double, triangles: NDArray[np.int32],
                 source: NDArray[np.int32]) -> TexelSurface:
        """The surface whose atlas was made."""
        texels = atlas.texels
        return TexelSurface(points, normals, tangents, triangles, atlas.places.astype(np.float32), source,
                            *(np.asarray(v, np.int32) for v in (atlas.cells, texels.column, texels.row,
                                                                texels.triangle)),
                            atlas.width, atlas.height, atlas.charts, atlas.texel, atlas.method)

    @cached_property
    def layout(self) -> AtlasCells:
        """Where places on the surface lie among its texels."""
        return AtlasCells.of_texels(self.width, self.places.astype(np.float64), self.cells, self.column, self.row)

    @property
    def faces(self) -> Double:
        """(n, 3) unit normals of the triangles that texels lie on."""
        return face_normals(self.points, self.triangles)[0][self.triangle]

    def numbers(self) -> dict[str, Any]:
        """What it holds beside arrays, JSON-able."""
        return {f.name: getattr(self, f.name) for f in fields(self) if f.name in NUMBERS}

    def arrays(self) -> dict[str, NDArray]:
        """Its arrays by name."""
        return {f.name: getattr(self, f.name) for f in fields(self) if f.name not in NUMBERS}


NUMBERS = ("width", "height", "charts", "texel", "method")


@dataclass(frozen=True, eq=False)
class TracedSurface:
    """What rays meet where some objects have texels: points (p, 3), triangles (t, 3), and how hits are renamed.

    starts: (objects + 1,) first triangle of each object here, scene_starts likewise in the scene; surfaces: of each
    object, None for one whose points are vertices.
    """

    points: Double
    triangles: NDArray[np.int32]
    starts: NDArray[np.int64]
    scene_starts: NDArray[np.int64]
    surfaces: tuple[TexelSurface | None, ...]

    def named(self, triangle: NDArray[np.int32], u: NDArray[np.float32], v: NDArray[np.float32],
              ) -> tuple[NDArray[np.int32], NDArray[np.float32], NDArray[np.float32]]:
        """Hits (n,), -1 for misses, as the scene's own triangles and the weights of their corners 1 and 2."""
        owner = np.searchsorted(self.starts, triangle, side="right") - 1
        renamed = np.where(triangle >= 0, triangle - (self.starts - self.scene_starts)[owner], -1).astype(np.int32)
        u, v = np.array(u, np.float32), np.array(v, np.float32)
        for number, surface in enumerate(self.surfaces):
            if surface is not None and (mine := np.flatnonzero((owner == number) & (triangle >= 0))).size:
                found, u[mine], v[mine] = surface.layout.on_cell_triangles(
                    triangle[mine] - self.starts[number], u[mine].astype(np.float64), v[mine].astype(np.float64))
                renamed[mine] = found + self.scene_starts[number]
        return renamed, u, v

    def places(self, triangle: NDArray[np.int32], u: NDArray[np.float32], v: NDArray[np.float32],
               ) -> tuple[Double, Double]:
        """Positions (n, 3) and unit face normals (n, 3) of hits on the traced triangles."""
        corners = self.points[self.triangles[triangle]]
        first, second = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
        face = np.cross(first, second)
        face /= np.maximum(np.sqrt(np.sum(face ** 2, axis=1, keepdims=True)), np.finfo(np.float64).tiny)
        return corners[:, 0] + u[:, None].astype(np.float64) * first + v[:, None].astype(np.float64) * second, face
