# SPDX-License-Identifier: GPL-3.0-or-later
"""Cheap digests of what a bake depends on, so that an edited scene never shows old light unnoticed."""

from __future__ import annotations

import json

import bpy
import numpy as np
from numpy.typing import NDArray

from ..storage.container import HEADER_PROPERTY
from ..storage.digests import digest_arrays, digest_json
from .bake_set import UNKNOWN, pack_place
from .followed import followed_digest
from .materials import material_digest
from .nodes import reachable
from .visibility import render_visible_objects

# Attributes that shape the surface or its shading normals; colours and our own data do not, and UV maps count only
# where a material samples an image through them.
SHAPING = ("position", ".corner_vert", "material_index", "sharp_face", "sharp_edge", "custom_normal")
SHAPES = {"MESH", "CURVE", "SURFACE", "META", "FONT"}  # types of objects that show faces
BUFFERS = {"FLOAT_VECTOR": ("vector", 3, np.float32), "FLOAT": ("value", 1, np.float32), "INT": ("value", 1, np.int32),
           "BOOLEAN": ("value", 1, np.bool_), "INT16_2D": ("value", 2, np.int32)}


RECEIVER_PROPERTY = "prt_receiver"
FOLLOWED = "live_materials"  # the digest of what live editing does not follow
RELIT_ATTRIBUTE = "PRT Light"  # the colour attribute of exit radiance that `prt.relight` writes
ATLAS_UV_MAP = "PRT Atlas"  # the UV map of the images that `prt.light_images` writes, which bear our mark


def geometry_digest(scene_object: bpy.types.Object, depsgraph: bpy.types.Depsgraph,
                    shows_images: bool | None = None) -> str | None:
    """Digest of an object's evaluated geometry in its own space, with all it instances; None if it is not evaluated.

    Changes with vertices, faces, sharpness, custom normals, modifiers and the UV maps that its images are seen through,
    not with the object's place in the world. About 2 ms for 50,000 vertices. shows_images: taken instead of what its
    materials say, where others stand in for them; then through the UV map that renders take.
    """
    evaluated = scene_object.evaluated_get(depsgraph)
    if not evaluated.is_evaluated:
        return None
    parts = [_evaluated_digest(evaluated)] if isinstance(evaluated.data, bpy.types.Mesh) else []
    parts += _uv_digests(scene_object, shows_images)
    if not _instances_nothing(evaluated):
        to_local = np.linalg.pinv(np.array(scene_object.matrix_world, np.float64))  # small
        cache: dict[int, str] = {}
        for instance in depsgraph.object_instances:
            if instance.is_instance and instance.parent.original == scene_object and isinstance(
                    instance.object.data, bpy.types.Mesh) and not instance.object.original.hide_render:
                # Rounded: moving the instancer must not count as an edit of what it instances.
                place = np.round(to_local @ np.array(instance.matrix_world, np.float64), 4) + 0.0  # small
                pointer = instance.object.data.as_pointer()
                if pointer not in cache:
                    cache[pointer] = _mesh_digest(instance.object.data)
                parts += [cache[pointer], digest_arrays(place)]
    return digest_json(parts)


def _instances_nothing(evaluated: bpy.types.Object) -> bool:
    return evaluated.type == "MESH" and not evaluated.is_instancer and not evaluated.particle_systems and not any(
        modifier.type == "NODES" for modifier in evaluated.modifiers)


def _evaluated_digest(evaluated: bpy.types.Object) -> str:
    """Of an evaluated object's mesh; in edit mode of the mesh as it is being edited, which has no arrays of its own."""
    if not evaluated.data.is_editmode:
        return _mesh_digest(evaluated.data)
    try:
        return _mesh_digest(evaluated.to_mesh())
    finally:
        evaluated.to_mesh_clear()


def _mesh_digest(mesh: bpy.types.Mesh) -> str:
    arrays = []
    for name in SHAPING:
        attribute = mesh.attributes.get(name)
        if attribute is None or attribute.data_type not in BUFFERS:
            arrays.append(np.zeros(0))
            continue
        member, width, kind = BUFFERS[attribute.data_type]
        values = np.empty(len(attribute.data) * width, kind)
        attribute.data.foreach_get(member, values)
        arrays.append(values)
    starts = np.empty(len(mesh.polygons), np.int32)
    mesh.polygons.foreach_get("loop_start", starts)
    return digest_arrays(*arrays, starts)


def _uv_digests(scene_object: bpy.types.Object, shows_images: bool | None) -> list[str]:
    """Digests of the UV maps through which the object's materials may show images; none without images.

    Of the object's own mesh: the evaluated one keeps UV maps only while something that is drawn asks for them.
    """
    mesh = scene_object.data
    if not isinstance(mesh, bpy.types.Mesh) or not mesh.uv_layers:
        return []
    nodes = [node for material in dict.fromkeys(used_materials(scene_object)) for node in _nodes_of(material)]
    if shows_images is None:
        shows_images = any(getattr(node, "image", None) is not None for node in nodes)
    if not shows_images:
        return []
    shown = {node.uv_map for node in nodes if hasattr(node, "uv_map")} | {
        node.attribute_name for node in nodes if node.bl_idname == "ShaderNodeAttribute"}
    digests = []
    for layer in mesh.uv_layers:
        if layer.name != ATLAS_UV_MAP and (layer.active_render or layer.name in shown):
            values = np.empty(len(mesh.loops) * 2, np.float32)
            if len(layer.uv) == len(mesh.loops):  # in edit mode the mesh's own data is not there
                layer.uv.foreach_get("vector", values)
                digests.append(digest_arrays(values))
    return digests


def _nodes_of(material: bpy.types.Material | None) -> list[bpy.types.Node]:
    output = material.node_tree.get_output_node("CYCLES") if material is not None and material.node_tree else None
    return [] if output is None else list(reachable(output))


def shows_relit(scene_object: bpy.types.Object) -> bool:
    """Whether one of an object's materials shows the light that its bake gave, as attribute or image: it stands in for
    one that was baked."""
    return any(RELIT_ATTRIBUTE in (getattr(node, "layer_name", None), getattr(node, "attribute_name", None))
               or HEADER_PROPERTY in (getattr(node, "image", None) or ())
               for material in dict.fromkeys(used_materials(scene_object)) for node in _nodes_of(material))


def used_materials(scene_object: bpy.types.Object) -> list[bpy.types.Material | None]:
    """The materials in an object's slots."""
    return [slot.material for slot in scene_object.material_slots]


def fingerprint(scene_object: bpy.types.Object, depsgraph: bpy.types.Depsgraph,
                live: bool = False) -> dict[str, str | None]:
    """Digests of an object's geometry and materials, to take when it is read and to hand to `write_baked`. live: also
    of what live editing does not follow of its materials."""
    digests = {"geometry": geometry_digest(scene_object, depsgraph), "materials": materials_as_baked(scene_object)}
    if live and follows_edits(scene_object, depsgraph) and not shows_relit(scene_object):
        digests[FOLLOWED] = followed_digest(used_materials(scene_object))
    return digests


def follows_edits(scene_object: bpy.types.Object, depsgraph: bpy.types.Depsgraph) -> bool:
    """Whether live editing can tell the object's faces and their materials: it is one mesh of its own."""
    evaluated = scene_object.evaluated_get(depsgraph)
    return evaluated.is_evaluated and _instances_nothing(evaluated)


def materials_as_baked(scene_object: bpy.types.Object, follow: bool = False) -> str:
    """Digest of an object's materials; where they only show what its bake gave, of those that it was baked with.

    follow: also where all that changed is what live editing follows.
    """
    then = _digest_at_bake(scene_object, "materials") if shows_relit(scene_object) else None
    if then is None and follow:
        fixed = _digest_at_bake(scene_object, FOLLOWED)
        if fixed is not None and fixed == followed_digest(used_materials(scene_object)):
            then = _digest_at_bake(scene_object, "materials")
    return then or material_digest(used_materials(scene_object))


def _digest_at_bake(scene_object: bpy.types.Object, name: str) -> str | None:
    """As its bake's header tells; None without a bake that can be read, or where it has none of that name."""
    for mesh in (scene_object.original.get(RECEIVER_PROPERTY), scene_object.original.data):
        header = mesh.get(HEADER_PROPERTY) if isinstance(mesh, bpy.types.Mesh) else None
        if header is not None:
            try:
                return json.loads(header)["digests"].get(name)
            except (TypeError, ValueError, KeyError, AttributeError):
                return None
    return None


def surroundings(depsgraph: bpy.types.Depsgraph, follow: bool = False) -> dict[str, str]:
    """What each render-visible piece of geometry is and where it stands: all that can shadow or light another.

    By name of the object, or of instancer and instanced object: a digest of shape and materials, then the place
    (`bake_set.pack_place`), so that it can be told whether everything moved together. What only the viewport hides is
    UNKNOWN: Blender does not evaluate it, and taking it for gone would be wrong. follow: as for `materials_as_baked`.
    One pass over all meshes; call it once for all baked objects, not per object and redraw.
    """
    visible = render_visible_objects(depsgraph.view_layer)
    shapes: dict[str, str] = {}
    places: dict[str, list[NDArray[np.float64]]] = {}
    meshes: dict[int, str] = {}
    reached: set[str] = set()
    for instance in depsgraph.object_instances:
        owner, source = (instance.parent if instance.is_instance else instance.object).original, instance.object
        mesh = source.data
        reached.add(owner.name_full)
        if owner.name_full not in visible or not isinstance(mesh, bpy.types.Mesh) or (
                source.original != owner and source.original.hide_render):
            continue
        pointer = mesh.as_pointer()
        if pointer not in meshes:
            meshes[pointer] = _evaluated_digest(source)
        place = np.array(instance.matrix_world, np.float64)
        # Geometry that nodes made has its instancer for a source, and many meshes.
        name = owner.name_full if source.original == owner else f"{owner.name_full}/{source.original.name_full}"
        key = f"{name}/{mesh.name_full}" if instance.is_instance and source.original == owner else name
        if key not in places:
            shapes[key] = _shape_digest(meshes[pointer], source, place, follow)
        places.setdefault(key, []).append(place)
    hidden = {name: UNKNOWN for name, found in visible.items()
              if name not in reached and (found.type in SHAPES or found.instance_type != "NONE")}
    return hidden | {key: _with_place(shapes[key], found) for key, found in places.items()}


def _shape_digest(mesh: str, source: bpy.types.Object, place: NDArray[np.float64], follow: bool) -> str:
    """Of a mesh with the materials of the object that shows it; with its size where that counts: light travels through
    bodies by a length of its own."""
    materials = used_materials(source)
    parts = [mesh, materials_as_baked(source, follow), source.visible_shadow, source.visible_diffuse]
    if any(_is_translucent(node) for material in dict.fromkeys(materials) for node in _nodes_of(material)):
        volume = np.linalg.det(place[:3, :3])  # small
        parts.append(f"{abs(volume) ** (1.0 / 3.0):.4g}")
    return digest_json(parts)


def _is_translucent(node: bpy.types.Node) -> bool:
    if node.bl_idname != "ShaderNodeBsdfPrincipled":
        return node.bl_idname == "ShaderNodeSubsurfaceScattering"
    weight = node.inputs["Subsurface Weight"]
    return weight.is_linked or weight.default_value > 0.0


def _with_place(shape: str, places: list[NDArray[np.float64]]) -> str:
    """One entry: of several places the first, and how the others stand to it (rounded, as it survives moves)."""
    if len(places) > 1:
        to_first = np.linalg.pinv(places[0])  # small
        others = sorted((np.round(to_first @ place, 4) + 0.0).tolist() for place in places[1:])  # small
        shape = digest_json([shape, others])
    return shape + pack_place(places[0])
