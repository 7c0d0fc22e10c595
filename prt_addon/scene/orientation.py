# SPDX-License-Identifier: GPL-3.0-or-later
"""Which side of a closed mesh is outside.

Blender shows both sides of a face, so an artist does not notice a mesh that is wound inwards; a bake that trusts its
normals would find every receiver in the dark.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from .object_mesh import ObjectMesh


def is_closed(positions: NDArray[np.float64], triangles: NDArray[np.int32]) -> bool:
    """Whether every directed edge is met by exactly one in the opposite direction (vertices at equal positions count
    as one)."""
    if not len(triangles):
        return False
    _, place = np.unique(positions, axis=0, return_inverse=True)
    welded = place.reshape(-1)[triangles].astype(np.int64)
    start, end = welded.ravel(), np.roll(welded, -1, axis=1).ravel()
    count = len(positions)
    return bool(np.array_equal(np.sort(start * count + end), np.sort(end * count + start)))


def signed_volume(positions: NDArray[np.float64], triangles: NDArray[np.int32]) -> float:
    """Volume in cubic metres enclosed by a closed mesh, negative where it winds inwards."""
    corners = positions[triangles] - positions[triangles[0, 0]]
    return float(np.sum(corners[:, 0] * np.cross(corners[:, 1], corners[:, 2]))) / 6.0


def outward(mesh: ObjectMesh, others: list[ObjectMesh], warnings: list[str],
            lamps: NDArray[np.float64] | None = None) -> ObjectMesh:
    """The mesh wound outwards, if it is closed, winds inwards, and is no room (neither another mesh nor a lamp, of
    positions (n, 3), lies inside its box)."""
    if not is_closed(mesh.positions, mesh.triangles) or signed_volume(mesh.positions, mesh.triangles) >= 0.0:
        return mesh
    low, high = mesh.positions.min(axis=0), mesh.positions.max(axis=0)
    for positions in [other.positions for other in others] + ([] if lamps is None else [lamps]):
        if len(positions) and np.any(np.all((positions > low) & (positions < high), axis=1)):
            return mesh
    warnings.append(f"{mesh.name}: all faces point inwards; baked as if they pointed outwards (recalculate normals)")
    tangents = None if mesh.corner_tangents is None else mesh.corner_tangents[:, ::-1]
    return replace(mesh, triangles=np.ascontiguousarray(mesh.triangles[:, ::-1]), corner_tangents=tangents,
                   corner_normals=-mesh.corner_normals[:, ::-1], corner_albedo=mesh.corner_albedo[:, ::-1])
