# SPDX-License-Identifier: GPL-3.0-or-later
"""One object's triangles as a reader delivers them, and what is dropped from them before anything else."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from ..errors import BadScene
from .surface_material import DIFFUSE, SurfaceMaterial

# Metres; beyond, squares and cubes of lengths leave single precision, and Blender clamps coordinates at 3e38.
FARTHEST = 1e18


@dataclass(frozen=True)
class ObjectMesh:
    """One object's evaluated triangles in world space, as the reader delivers them.

    positions: (v, 3) float64, metres. triangles: (t, 3) int32 into positions, counter-clockwise seen from outside.
    corner_normals, corner_albedo: (t, 3, 3) float32; unit shading normals, linear Rec.709 reflectance in [0, 1].
    is_target: transfer is stored for it (every object casts shadows and bounces light).
    matrix: (4, 4) float64, object to world. winding_flipped: the reader turned the triangles of a mirrored object.
    materials: what they do beyond diffuse reflection. material_index: (t,) int32 into materials; None is all 0.
    corner_tangents: (t, 3, 3) float32 directions of any length along the surface, zero where any direction serves
    (isotropic materials); None is zero everywhere.
    source: (t,) int32, which of the triangles that were read each one is; None while they are all there, in order.
    """

    name: str
    positions: NDArray[np.float64]
    triangles: NDArray[np.int32]
    corner_normals: NDArray[np.float32]
    corner_albedo: NDArray[np.float32]
    is_target: bool
    matrix: NDArray[np.float64] = field(default_factory=lambda: np.eye(4))
    winding_flipped: bool = False
    materials: tuple[SurfaceMaterial, ...] = (DIFFUSE,)
    material_index: NDArray[np.int32] | None = None
    corner_tangents: NDArray[np.float32] | None = None
    source: NDArray[np.int32] | None = None

    @property
    def sources(self) -> NDArray[np.int32]:
        """`source`, spelt out where it is None."""
        return np.arange(len(self.triangles), dtype=np.int32) if self.source is None else self.source

    def with_triangles(self, kept: NDArray[np.bool_]) -> ObjectMesh:
        """The mesh with only some of its triangles, (t,) bool."""
        return replace(self, triangles=self.triangles[kept], source=self.sources[kept],
                       corner_normals=self.corner_normals[kept],
                       corner_albedo=self.corner_albedo[kept],
                       material_index=None if self.material_index is None else self.material_index[kept],
                       corner_tangents=None if self.corner_tangents is None else self.corner_tangents[kept])


def bounding_diagonal(point_sets: list[NDArray[np.float64]]) -> float:
    """Diagonal of the box around all points; 0.0 without points."""
    filled = [p for p in point_sets if len(p)]
    if not filled:
        return 0.0
    low = np.min([p.min(axis=0) for p in filled], axis=0)
    high = np.max([p.max(axis=0) for p in filled], axis=0)
    return float(np.sqrt(np.sum((high - low) ** 2)))


def clean(mesh: ObjectMesh, warnings: list[str]) -> ObjectMesh:
    """Without zero-area and duplicate triangles. Raises BadScene where a target has nothing left or is not finite."""
    bad = ~np.isfinite(mesh.positions).all(axis=1)
    if bad.any():
        raise BadScene(mesh.name, f"{int(bad.sum())} vertices have no finite coordinates",
                       "Delete them, or mend the modifier that makes them")
    far = np.abs(mesh.positions).max(axis=1, initial=0.0) > FARTHEST
    if far.any():
        raise BadScene(mesh.name, f"{int(far.sum())} vertices lie more than {FARTHEST:.0e} m away",
                       "Delete them, or mend the modifier or the scale that puts them there")
    uncoloured = int((~np.isfinite(mesh.corner_albedo).all(axis=(1, 2))).sum())
    if uncoloured:
        raise BadScene(mesh.name, f"the colour of {uncoloured} triangles is not a number",
                       "Mend the colours of its materials")
    _check_materials(mesh)
    if not len(mesh.triangles):
        if mesh.is_target:
            raise BadScene(mesh.name, "the mesh has no faces", "Add faces, or bake another object")
        return mesh
    corners = mesh.positions[mesh.triangles]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    longest = max(float(np.abs(corners - corners[:, :1]).max()), float(np.finfo(np.float64).tiny))
    # Relative to the object, so that a scene of 1e-6 metres keeps its triangles: area below 1e-14 of the largest
    # extent squared can't be told from rounding in the single precision that Embree traces in.
    area_kept = np.sqrt(np.sum((normal / longest) ** 2, axis=1)) > 1e-14 * longest
    key = np.sort(mesh.triangles, axis=1)
    first = np.zeros(len(key), bool)
    first[np.unique(key, axis=0, return_index=True)[1]] = True
    kept = area_kept & first
    if not kept.all():
        count, twins = int((~area_kept).sum()), int((area_kept & ~first).sum())
        warnings.append(f"{mesh.name}: dropped {count} zero-area and {twins} duplicate triangles")
    if not kept.any():
        if mesh.is_target:
            raise BadScene(mesh.name, "all faces have zero area", "Give the faces an area, or bake another object")
        warnings.append(f"{mesh.name}: casts nothing, all faces have zero area")
    return mesh.with_triangles(kept)


def _check_materials(mesh: ObjectMesh) -> None:
    """Raise ValueError where a reader's material numbers or tangents do not fit its triangles: a bug, not bad input."""
    count, index = len(mesh.triangles), mesh.material_index
    if index is not None and (index.shape != (count,) or (count and not 0 <= index.min() <= index.max()
                                                          < len(mesh.materials))):
        raise ValueError(f"{mesh.name}: material numbers do not fit {count} triangles, {len(mesh.materials)} materials")
    if mesh.corner_tangents is not None and mesh.corner_tangents.shape != (count, 3, 3):
        raise ValueError(f"{mesh.name}: tangents {mesh.corner_tangents.shape} do not fit {count} triangles")
