# SPDX-License-Identifier: GPL-3.0-or-later
"""Directions of anisotropic highlights on a mesh, as Cycles finds them: around an axis, or along a texture map."""

from __future__ import annotations

from typing import TYPE_CHECKING

import bpy
import numpy as np
from numpy.typing import NDArray

from .surfaces import Tangent

if TYPE_CHECKING:
    from .read_scene import MeshArrays


def corner_tangents(mesh: bpy.types.Mesh, arrays: MeshArrays, slot: NDArray[np.int32], sources: list[Tangent | None],
                    name: str, warnings: list[str], original: bpy.types.Mesh | None) -> NDArray[np.float32] | None:
    """Directions (t, 3, 3) in the mesh's space, of any length, not yet along the surface; zero where none is wanted.

    slot: (t,) material of each triangle; sources: where each material's tangent comes from; original: the mesh before
    its modifiers. Cycles takes these directions to the world like normals (`normal_matrix`). None
    where no face wants any.
    """
    wanted = [source for source in dict.fromkeys(sources) if source is not None]
    result = np.zeros((len(slot), 3, 3), np.float32)
    for source in wanted:
        chosen = np.array([s == source for s in sources])[slot]
        if chosen.any():
            kind, detail = source
            result[chosen] = (_around_axis(mesh, original, detail, arrays.triangles[chosen]) if kind == "RADIAL" else
                              _along_map(mesh, detail, arrays, chosen, name, warnings))
    return result if result.any() else None


def _around_axis(mesh: bpy.types.Mesh, original: bpy.types.Mesh | None, axis: str,
                 triangles: NDArray[np.int32]) -> NDArray[np.float32]:
    """Around an axis through the middle of the mesh's texture space, in which the generated coordinates are 0.5.

    Cycles takes the coordinates from before deformation, which Blender keeps for renders only: here the original's
    where modifiers keep the number of vertices, else the evaluated ones (exact without deformation).
    """
    source = original if original is not None and len(original.vertices) == len(mesh.vertices) else mesh
    coordinates = np.empty((len(mesh.vertices), 3), np.float32)
    source.vertices.foreach_get("co", coordinates.ravel())
    size = np.array(mesh.texspace_size, np.float64)
    half = np.divide(0.5, size, out=np.zeros(3), where=size != 0.0)
    x, y, z = ((coordinates - np.array(mesh.texspace_location)) * half).T
    nothing = np.zeros_like(x)
    around = {"X": (nothing, -z, y), "Y": (-z, nothing, x), "Z": (-y, x, nothing)}[axis]
    return np.stack(around, axis=1).astype(np.float32)[triangles]


def _along_map(mesh: bpy.types.Mesh, uv_map: str, arrays: MeshArrays, chosen: NDArray[np.bool_], name: str,
               warnings: list[str]) -> NDArray[np.float32]:
    """Where u of a texture map grows, at the corners of the chosen triangles.

    As the MikkTSpace tangents that Cycles uses: the faces' directions along the shading normal's plane, averaged by
    angle over the corners that share a vertex, a place on the map and a normal.
    """
    layer = mesh.uv_layers.get(uv_map) if uv_map else next((u for u in mesh.uv_layers if u.active_render), None)
    triangles, normals = arrays.triangles[chosen], arrays.corner_normals[chosen].reshape(-1, 3).astype(np.float64)
    if layer is None:
        warnings.append(f"{name}: it has no texture map {uv_map!r} for the tangents of its highlights")
        return np.zeros((len(triangles), 3, 3), np.float32)
    uv = np.empty((len(mesh.loops), 2), np.float32)
    layer.uv.foreach_get("vector", uv.ravel())
    uv = uv[arrays.corners[chosen]]
    points = arrays.positions[triangles].astype(np.float64)
    along, turn = _along_u(points, uv.astype(np.float64))
    along = np.repeat(along, 3, axis=0)
    along = _unit(along - np.sum(along * normals, axis=1, keepdims=True) * normals) * _angles(points).reshape(-1, 1)
    shared = np.concatenate([triangles.reshape(-1, 1), uv.reshape(-1, 2), normals, np.repeat(turn, 3)[:, None]], axis=1)
    _, group = np.unique(np.round(shared, 5), axis=0, return_inverse=True)
    group = group.reshape(-1)
    total = np.stack([np.bincount(group, weights=along[:, axis]) for axis in range(3)], axis=1)
    return _unit(total)[group].reshape(-1, 3, 3).astype(np.float32)


def _along_u(points: NDArray[np.float64], uv: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Direction (t, 3) in which u grows on triangles (t, 3, 3) with places uv (t, 3, 2), and the map's sense (t,)."""
    edge, step = points[:, 1:] - points[:, :1], uv[:, 1:] - uv[:, :1]
    sense = np.sign(step[:, 0, 0] * step[:, 1, 1] - step[:, 0, 1] * step[:, 1, 0])
    return _unit(sense[:, None] * (edge[:, 0] * step[:, 1, 1:] - edge[:, 1] * step[:, 0, 1:])), sense


def _unit(vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    """Rows of length one; zero stays zero."""
    length = np.sqrt(np.sum(vectors ** 2, axis=-1, keepdims=True))
    return np.divide(vectors, length, out=np.zeros_like(vectors), where=length > 0.0)


def _angles(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Angles (t, 3) at the corners of triangles (t, 3, 3)."""
    edges = _unit(np.roll(points, -1, axis=1) - points)
    return np.arccos(np.clip(-np.sum(edges * np.roll(edges, 1, axis=1), axis=2), -1.0, 1.0))
