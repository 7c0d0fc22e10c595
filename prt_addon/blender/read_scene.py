# SPDX-License-Identifier: GPL-3.0-or-later
"""The evaluated scene as ObjectMesh arrays: modifiers, instances, any transform, custom normals, materials.

Modifiers are evaluated as the viewport shows them, because the bake is drawn over the viewport; which objects cast
shadows and bounce light is decided by what a render shows.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import bpy
import numpy as np
from numpy.typing import NDArray

from ..errors import BadScene
from ..scene.scene_mesh import ObjectMesh
from ..scene.surface_material import SurfaceMaterial
from .materials import AlbedoReader
from .surface_tangents import corner_tangents
from .surfaces import Surface, SurfaceReader
from .visibility import find_objects, shown_as_in_render

UNSUPPORTED = {"VOLUME": "volume", "POINTCLOUD": "point cloud", "CURVES": "hair curves",
               "GREASEPENCIL": "grease pencil"}
# Determinant, relative to the largest entry cubed, below which a transform has no way back from world to local space.
FLAT = 1e-9


@dataclass(frozen=True)
class MeshArrays:
    """One evaluated mesh in its own space. corners: (t, 3) index of each triangle corner among the mesh's corners."""

    positions: NDArray[np.float32]
    triangles: NDArray[np.int32]
    corners: NDArray[np.int32]
    corner_normals: NDArray[np.float32]
    material_index: NDArray[np.int32]


@dataclass
class _Part:
    """A mesh placed in the world: the object's own or one of its instances (all that share it)."""

    arrays: MeshArrays
    surfaces: list[Surface]
    slot: NDArray[np.int32]  # (t,) of each triangle into surfaces
    tangents: NDArray[np.float32] | None
    albedo: NDArray[np.float32]
    matrices: list[NDArray[np.float64]] = field(default_factory=list)


@dataclass
class _Gathered:
    """What one object of the outliner contributes."""

    scene_object: bpy.types.Object
    parts: dict[int, _Part] = field(default_factory=dict)

    @property
    def faces(self) -> int:
        """Triangles of all its parts, each counted once."""
        return sum(len(part.arrays.triangles) for part in self.parts.values())


def read_objects(depsgraph: bpy.types.Depsgraph, target_names: Sequence[str] | None = None,
                 warnings: list[str] | None = None, selected: Sequence[str] | None = None) -> list[ObjectMesh]:
    """Every object with geometry that a render shows, in world space (metres), each with all it instances.

    depsgraph: of the viewport (`context.evaluated_depsgraph_get()`). target_names: objects to store transfer for; None
    takes the selected ones with geometry, or all if none is selected or Blender runs in the background, without those
    that have no faces. warnings: gets a line for everything left out. selected: counts in place of what is selected
    (`selected_names` of an earlier time; empty: nothing was). Raises BadScene, naming the object, where a target can't
    be baked.
    """
    warnings = [] if warnings is None else warnings
    with shown_as_in_render(depsgraph) as visible:
        targets = _targets(depsgraph, visible, target_names, selected)
        albedo_reader, surface_reader = AlbedoReader(depsgraph.scene, warnings), SurfaceReader(warnings)
        gathered = _gather(depsgraph, visible, (albedo_reader, surface_reader), warnings)
        everything = target_names is None and not targets
        if target_names is None:
            _leave_out_empty(targets, gathered, warnings)
        _check_targets(targets, gathered, visible)
        albedo_reader.evaluate()
        return [_joined(g, everything or name in targets) for name, g in gathered.items()]


def selected_names(view_layer: bpy.types.ViewLayer) -> list[str]:
    """Full names of the selected objects that have geometry; none in background mode, where nobody selects."""
    if bpy.app.background:
        return []
    return [o.name_full for o in view_layer.objects
            if o.select_get(view_layer=view_layer) and (o.type == "MESH" or o.is_instancer)]


def _targets(depsgraph: bpy.types.Depsgraph, visible: dict[str, bpy.types.Object],
             target_names: Sequence[str] | None, selected: Sequence[str] | None) -> dict[str, bpy.types.Object]:
    """Target objects by full name; empty means all."""
    if selected is None:
        selected = selected_names(depsgraph.view_layer)
    if target_names is not None:
        if not target_names:
            raise BadScene("scene", "no object was named", "Name at least one mesh object to bake")
        chosen = find_objects(list(target_names), depsgraph.scene)
    else:
        chosen = find_objects(list(selected), depsgraph.scene)
    for target in chosen:
        if target.name_full not in visible:
            raise BadScene(target.name, "it is hidden in renders, so it takes no part in the light",
                           "Enable it (and its collection) for renders with the camera icon of the outliner")
    return {o.name_full: o for o in chosen}


def _gather(depsgraph: bpy.types.Depsgraph, visible: dict[str, bpy.types.Object],
            readers: tuple[AlbedoReader, SurfaceReader], warnings: list[str]) -> dict[str, _Gathered]:
    """Evaluated meshes per object of the outliner, in the order of the depsgraph."""
    gathered: dict[str, _Gathered] = {}
    for instance in depsgraph.object_instances:
        owner = (instance.parent if instance.is_instance else instance.object).original
        source = instance.object.original
        if owner.name_full not in visible or (source != owner and source.hide_render):
            continue
        if not instance.is_instance and owner.type in UNSUPPORTED:
            warnings.append(f"{owner.name}: a {UNSUPPORTED[owner.type]} neither casts shadows nor bounces light")
        if not isinstance(instance.object.data, bpy.types.Mesh) or not _casts(instance, owner):
            continue
        entry = gathered.setdefault(owner.name_full, _Gathered(owner))
        key = instance.object.data.as_pointer()
        if key not in entry.parts:
            entry.parts[key] = _read_part(instance, depsgraph, readers, warnings)
        entry.parts[key].matrices.append(np.array(instance.matrix_world, np.float64))
    return gathered


def _casts(instance: bpy.types.DepsgraphObjectInstance, owner: bpy.types.Object) -> bool:
    """Whether a render shows this geometry and lets it cast shadows or bounce light."""
    if not instance.is_instance and owner.is_instancer and not owner.show_instancer_for_render:
        return False
    return instance.object.visible_shadow or instance.object.visible_diffuse


def _read_part(instance: bpy.types.DepsgraphObjectInstance, depsgraph: bpy.types.Depsgraph,
               readers: tuple[AlbedoReader, SurfaceReader], warnings: list[str]) -> _Part:
    """Arrays and materials of an instance's mesh; registers its albedo with the reader."""
    evaluated, (albedo_reader, surface_reader) = instance.object, readers
    generated = instance.is_instance and evaluated.original == instance.parent.original
    owner = (instance.parent if instance.is_instance else evaluated).name
    # Geometry that nodes made: the object stands in for it and only its data is the instance's.
    slots = ([m and m.original for m in evaluated.data.materials] if generated else
             [slot.material and slot.material.original for slot in evaluated.material_slots])
    surfaces = [surface_reader.of(m) for m in slots or [None]]
    sources = [surface.tangent for surface in surfaces]
    # to_mesh also gives the faces of a subdivision that otherwise happens on the graphics card only. Texture maps and
    # places before deformation come along only if asked for.
    mesh = evaluated.data if generated else evaluated.to_mesh(preserve_all_data_layers=any(sources),
                                                              depsgraph=depsgraph)
    arrays = read_mesh(mesh)
    _check_finite(arrays.positions, owner)
    # A face whose index exceeds the slots shows the last one, as in Cycles.
    slot = np.clip(arrays.material_index, 0, len(surfaces) - 1)
    original = None if generated or not isinstance(evaluated.original.data, bpy.types.Mesh) else evaluated.original.data
    tangents = corner_tangents(mesh, arrays, slot, sources, owner, warnings, original)
    if not generated:
        evaluated.to_mesh_clear()
    part = _Part(arrays, surfaces, slot, tangents, np.empty((len(arrays.triangles), 3, 3), np.float32))
    albedo_reader.add(evaluated, evaluated.data if generated else None, depsgraph, arrays, slots,
                      np.array(instance.matrix_world, np.float64), part.albedo)
    return part


def read_mesh(mesh: bpy.types.Mesh) -> MeshArrays:
    """Positions, triangles and shading normals (smooth, flat, sharp or custom) of a mesh, in its own space."""
    mesh.calc_loop_triangles()
    count = len(mesh.loop_triangles)
    positions = np.empty((len(mesh.vertices), 3), np.float32)
    triangles, corners = np.empty((count, 3), np.int32), np.empty((count, 3), np.int32)
    material_index = np.empty(count, np.int32)
    normals = np.empty((len(mesh.loops), 3), np.float32)
    mesh.vertices.foreach_get("co", positions.ravel())
    mesh.loop_triangles.foreach_get("vertices", triangles.ravel())
    mesh.loop_triangles.foreach_get("loops", corners.ravel())
    mesh.loop_triangles.foreach_get("material_index", material_index)
    if count:
        mesh.corner_normals.foreach_get("vector", normals.ravel())
    return MeshArrays(positions, triangles, corners, normals[corners], material_index)


def read_object_triangles(evaluated: bpy.types.Object) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
    """`read_triangles` of an evaluated object, as it is edited and subdivided."""
    try:
        return read_triangles(evaluated.to_mesh())
    finally:
        evaluated.to_mesh_clear()


def read_triangles(mesh: bpy.types.Mesh) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
    """Positions (v, 3) of a mesh in its own space, and triangles (t, 3)."""
    mesh.calc_loop_triangles()
    positions = np.empty((len(mesh.vertices), 3), np.float32)
    triangles = np.empty((len(mesh.loop_triangles), 3), np.int32)
    mesh.vertices.foreach_get("co", positions.ravel())
    mesh.loop_triangles.foreach_get("vertices", triangles.ravel())
    return positions, triangles


def _check_finite(positions: NDArray[np.float32], name: str) -> None:
    """Raise BadScene before anything is traced or shaded at coordinates that are no numbers."""
    bad = int((~np.isfinite(positions).all(axis=1)).sum())
    if bad:
        raise BadScene(name, f"{bad} vertices have no finite coordinates",
                       "Delete them, or mend the modifier that makes them")


def _leave_out_empty(targets: dict[str, bpy.types.Object], gathered: dict[str, _Gathered],
                     warnings: list[str]) -> None:
    """Drop objects without faces, each with a warning, where others are left to bake: nobody asked for them by name,
    and one forgotten point cloud must not stop the bake of a scene."""
    candidates = [name for name in (targets or gathered) if name in gathered]
    empty = [name for name in candidates if not gathered[name].faces]
    if len(empty) == len(candidates):
        return
    for name in empty:
        warnings.append(f"{gathered.pop(name).scene_object.name}: the mesh has no faces, so it is not baked")
        targets.pop(name, None)


def _check_targets(targets: dict[str, bpy.types.Object], gathered: dict[str, _Gathered],
                   visible: dict[str, bpy.types.Object]) -> None:
    """Raise BadScene for a target without faces or with a transform that flattens it, or where there is no mesh."""
    if not gathered:
        cause = "no mesh is visible in renders" if visible else "no object is visible in renders"
        raise BadScene("scene", cause, "Add a mesh object, or enable one for renders in the outliner")
    for name, target in (targets or {n: g.scene_object for n, g in gathered.items()}).items():
        if name not in gathered or not gathered[name].faces:
            raise BadScene(target.name, "the mesh has no faces" if name in gathered else "it has no mesh to bake",
                           "Add faces, or bake another object")
        if is_flattened(np.array(target.matrix_world, np.float64)):
            raise BadScene(target.name, "its scale is zero along an axis", "Give it a scale, or apply the scale")


def is_flattened(matrix: NDArray[np.float64]) -> bool:
    """Whether a (4, 4) transform has no inverse in practice: a scale of zero along an axis."""
    columns = matrix[:3, :3]
    largest = np.abs(columns).max()
    return bool(largest == 0.0 or abs(_determinant(columns / largest)) < FLAT)


def _determinant(m: NDArray[np.float64]) -> float:
    """Determinant of a 3 x 3 matrix."""
    return float(np.sum(m[:, 0] * np.cross(m[:, 1], m[:, 2])))


def normal_matrix(matrix: NDArray[np.float64]) -> NDArray[np.float64]:
    """(3, 3) that takes normals along with a (4, 4) transform, up to length; defined for flattening transforms too.

    The inverse transpose is the matrix of cofactors over the determinant; of the latter only the sign matters.
    """
    m = matrix[:3, :3] / max(float(np.abs(matrix[:3, :3]).max()), np.finfo(np.float64).tiny)
    cofactors = np.stack([np.cross(m[:, 1], m[:, 2]), np.cross(m[:, 2], m[:, 0]), np.cross(m[:, 0], m[:, 1])], axis=1)
    return cofactors if _determinant(m) >= 0.0 else -cofactors


def transform_rows(vectors: NDArray[np.floating], matrix: NDArray[np.float64]) -> NDArray[np.float64]:
    """Row vectors (..., 3) times the transpose of a (3, 3) matrix, in double precision, the same on every machine."""
    return (vectors[..., 0:1] * matrix[:, 0] + vectors[..., 1:2] * matrix[:, 1]) + vectors[..., 2:3] * matrix[:, 2]


def _joined(gathered: _Gathered, is_target: bool) -> ObjectMesh:
    """All parts and instances of one object as one mesh in world space."""
    positions, triangles, normals, albedo, tangents, material_index = [], [], [], [], [], []
    materials: list[SurfaceMaterial] = []
    first, directed = 0, any(part.tangents is not None for part in gathered.parts.values())
    for part in gathered.parts.values():
        slot = part.slot + len(materials)
        materials += [surface.material for surface in part.surfaces]
        for matrix in part.matrices:
            positions.append(transform_rows(part.arrays.positions, matrix[:3, :3]) + matrix[:3, 3])
            mirrored = _determinant(matrix[:3, :3] / max(np.abs(matrix[:3, :3]).max(), 1e-300)) < 0.0
            order = [0, 2, 1] if mirrored else [0, 1, 2]
            triangles.append(part.arrays.triangles[:, order] + first)
            normals.append(_turned(part.arrays.corner_normals, matrix)[:, order])
            albedo.append(part.albedo[:, order])
            material_index.append(slot)
            if directed:
                tangents.append(np.zeros_like(normals[-1]) if part.tangents is None else
                                _turned(part.tangents, matrix, keep_length=True)[:, order])
            first += len(part.arrays.positions)
    matrix = np.array(gathered.scene_object.matrix_world, np.float64)
    return ObjectMesh(gathered.scene_object.name_full, np.concatenate(positions),
                      np.concatenate(triangles).astype(np.int32), np.concatenate(normals), np.concatenate(albedo),
                      is_target, matrix, _determinant(matrix[:3, :3]) < 0.0, tuple(materials),
                      np.concatenate(material_index).astype(np.int32), np.concatenate(tangents) if directed else None)


def _turned(vectors: NDArray[np.float32], matrix: NDArray[np.float64], keep_length: bool = False,
            ) -> NDArray[np.float32]:
    """Vectors (t, 3, 3) taken to the world like normals, of length one or of the length that they had."""
    world = transform_rows(vectors, normal_matrix(matrix))
    length = np.sqrt(np.sum(world ** 2, axis=2, keepdims=True))
    world /= np.maximum(length, 1e-300)
    if keep_length:
        world *= np.sqrt(np.sum(vectors.astype(np.float64) ** 2, axis=2, keepdims=True))
    return world.astype(np.float32)
