# SPDX-License-Identifier: GPL-3.0-or-later
"""Materials whose diffuse albedo is an image seen through a UV map, read so that drawing can sample it per pixel.

Read are a Principled or Diffuse BSDF, in node groups too, whose colour is an Image Texture, also multiplied by plain
colours (Mix Color in mode Multiply), placed by a UV map and any number of Mapping nodes. Every other material keeps the
albedo of its receivers, which `materials` evaluates.
"""

from __future__ import annotations

from collections.abc import Hashable
from dataclasses import dataclass

import bpy
import numpy as np
from mathutils import Euler, Matrix
from numpy.typing import NDArray

from ..scene.surface_textures import SurfaceTextures, TextureUse, places_on_parts
from ..storage.container import BakedTransfer
from ..storage.digests import digest_arrays
from .fingerprint import geometry_digest
from .nodes import Groups, constant_of, origin_of
from .read_scene import is_flattened, transform_rows

WHITE = (1.0, 1.0, 1.0)
IMAGE_SOURCES = {"FILE", "GENERATED"}  # no tiles, sequences or films
SMOOTH = {"Linear": True, "Closest": False, "Cubic": True, "Smart": True}


@dataclass(frozen=True)
class PlacedTexture:
    """A texture, the UV map that places it (empty: the one that renders), and what (2, 3) takes (u, v, 1) to places."""

    use: TextureUse
    uv_map: str
    turn: tuple[tuple[float, float, float], tuple[float, float, float]]


def texture_of(material: bpy.types.Material | None) -> PlacedTexture | None:
    """The image that is a material's diffuse albedo; None where it is something else, or depends on more than that."""
    output = material.node_tree.get_output_node("CYCLES") if material is not None and material.node_tree else None
    found, _, groups = origin_of(output.inputs["Surface"]) if output is not None else (None, None, ())
    if found is None or found.node.mute:
        return None
    surface = found.node
    if surface.bl_idname == "ShaderNodeBsdfDiffuse":
        return _coloured(surface.inputs["Color"], groups, WHITE)
    if surface.bl_idname != "ShaderNodeBsdfPrincipled":
        return None
    shares = [constant_of(surface.inputs[name], groups) for name in ("Metallic", "Transmission Weight", "Alpha")]
    if any(share is None for share in shares):
        return None
    metallic, transmission, alpha = (min(max(share, 0.0), 1.0) for share in shares)
    share = (1.0 - metallic) * (1.0 - transmission) * alpha
    return _coloured(surface.inputs["Base Color"], groups, (share,) * 3) if share > 0.0 else None


def _coloured(socket: bpy.types.NodeSocket, groups: Groups | None, factor: tuple[float, ...]) -> PlacedTexture | None:
    """The texture behind a colour input, times a factor (3,)."""
    for _ in range(8):  # multiplications in a row
        output, _, groups = origin_of(socket, groups)
        if output is None or output.node.mute:
            return None
        if output.node.bl_idname != "ShaderNodeMix":
            return _image(output, groups, factor)
        multiplied = _multiplied(output.node, groups)
        if multiplied is None:
            return None
        socket, constant = multiplied
        factor = tuple(f * c for f, c in zip(factor, constant, strict=True))
    return None


def _multiplied(node: bpy.types.Node, groups: Groups | None,
                ) -> tuple[bpy.types.NodeSocket, tuple[float, ...]] | None:
    """The varying input of a Mix Color node that multiplies by a plain colour, and the factor (3,) that this makes."""
    if node.data_type != "RGBA" or node.blend_type != "MULTIPLY" or node.clamp_result:
        return None
    share = constant_of(next(s for s in node.inputs if s.identifier == "Factor_Float"), groups)
    first, second = (next(s for s in node.inputs if s.identifier == f"{side}_Color") for side in "AB")
    constants = [constant_of(side, groups) for side in (first, second)]
    if share is None or (constants[0] is None) == (constants[1] is None):
        return None
    share = min(max(share, 0.0), 1.0) if node.clamp_factor else share
    if constants[0] is None:
        return first, tuple(1.0 - share + share * channel for channel in constants[1][:3])
    if share != 1.0:
        return None  # a plain colour mixed with the texture is a sum
    return second, tuple(constants[0][:3])


def _image(output: bpy.types.NodeSocket, groups: Groups | None, factor: tuple[float, ...]) -> PlacedTexture | None:
    """The texture of an Image Texture node's colour."""
    node = output.node
    if node.bl_idname != "ShaderNodeTexImage" or output.name != "Color" or node.projection != "FLAT":
        return None
    image = node.image
    if image is None or image.source not in IMAGE_SOURCES or not min(image.size) or not image.channels:
        return None
    placed = _placed(node.inputs["Vector"], groups)
    if placed is None:
        return None
    library = image.library.filepath if image.library is not None else None
    use = TextureUse((image.name, library), tuple(float(f) for f in factor), SMOOTH.get(node.interpolation, True),
                     node.extension)
    return PlacedTexture(use, *placed)


def _placed(socket: bpy.types.NodeSocket, groups: Groups | None,
            ) -> tuple[str, tuple[tuple[float, float, float], ...]] | None:
    """The UV map that a vector comes from and what it is turned by; None where it comes from something else."""
    turn = Matrix.Identity(4)
    while True:
        output, place, groups = origin_of(socket, groups)
        if output is None:
            # Without a link anywhere Cycles takes the UV map that renders; at a group's wall the group's own value.
            return ("", _flat(turn)) if place.node.bl_idname == "ShaderNodeTexImage" else None
        node = output.node
        if node.mute:
            return None
        if node.bl_idname == "ShaderNodeMapping":
            own = _mapping(node, groups)
            if own is None:
                return None
            turn, socket = turn @ own, node.inputs["Vector"]  # small
        elif node.bl_idname == "ShaderNodeUVMap" and not node.from_instancer:
            return node.uv_map, _flat(turn)
        elif node.bl_idname == "ShaderNodeTexCoord" and output.name == "UV" and not node.from_instancer:
            return "", _flat(turn)
        elif node.bl_idname == "ShaderNodeAttribute" and output.name == "Vector" and node.attribute_type == "GEOMETRY":
            return node.attribute_name, _flat(turn)
        else:
            return None


def _mapping(node: bpy.types.Node, groups: Groups | None) -> Matrix | None:
    """(4, 4) of a Mapping node with plain values."""
    values = {name: constant_of(node.inputs[name], groups) for name in ("Location", "Rotation", "Scale")
              if name in node.inputs and node.inputs[name].enabled}
    if any(value is None for value in values.values()) or node.vector_type == "NORMAL":
        return None
    turn = Euler(values["Rotation"]).to_matrix().to_4x4()
    scale = Matrix.Diagonal((*values["Scale"], 1.0))
    moved = Matrix.Translation(values["Location"]) if "Location" in values else Matrix.Identity(4)
    if node.vector_type == "TEXTURE":
        return (moved @ turn @ scale).inverted_safe()  # small
    return (moved if node.vector_type == "POINT" else Matrix.Identity(4)) @ turn @ scale  # small


def _flat(turn: Matrix) -> tuple[tuple[float, float, float], ...]:
    """What a transform of (u, v, 0) does to (u, v, 1)."""
    return tuple((turn[row][0], turn[row][1], turn[row][3]) for row in range(2))


def surface_textures(scene_object: bpy.types.Object, baked: BakedTransfer, depsgraph: bpy.types.Depsgraph,
                     ) -> SurfaceTextures | None:
    """Textures of an object's baked triangles; None where no material shows an image through a UV map, or where the
    bake does not know its source triangles or these are no more those of the object."""
    placed_now = np.array(scene_object.matrix_world, np.float64)
    positions, triangles, of_triangle = baked.drawn
    if of_triangle is None or is_flattened(placed_now) or not any(
            texture_of(slot.material) for slot in scene_object.material_slots):
        return None
    parts = _placed_parts(scene_object, depsgraph)
    source = [np.concatenate(arrays) for arrays in zip(*[part[:3] for part in parts], strict=True)] if parts else None
    if source is None or len(of_triangle) == 0 or int(of_triangle.max()) >= len(source[0]):
        return None
    corners, places, number = source
    uses, number = _joined_uses([part[3] for part in parts], [len(part[0]) for part in parts], number)
    use = number[of_triangle]
    if not (use >= 0).any():
        return None
    matrix = np.array(baked.header["matrix"], np.float64).reshape(4, 4)
    inverse = np.linalg.inv(matrix)  # small
    local = transform_rows(positions, inverse[:3, :3]) + inverse[:3, 3]
    found = places_on_parts(local[triangles], of_triangle, corners, places)
    return SurfaceTextures(uses, use, found, (uses, digest_arrays(use, found)))


def textures_key(scene_object: bpy.types.Object, depsgraph: bpy.types.Depsgraph) -> Hashable:
    """Changes when `surface_textures` of the same bake may; None where it finds none. Costs a digest of the mesh."""
    textures = tuple(texture_of(slot.material) for slot in scene_object.material_slots)
    return (textures, geometry_digest(scene_object, depsgraph)) if any(textures) else None


_Part = tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.int32], tuple[TextureUse, ...]]


def _placed_parts(scene_object: bpy.types.Object, depsgraph: bpy.types.Depsgraph) -> list[_Part]:
    """Meshes of an object in the order in which a bake reads them, instance by instance: corners (t, 3, 3) in the
    object's space, places (t, 3, 2), the place of each triangle's texture (-1: none) in the last entry."""
    to_local = np.linalg.inv(np.array(scene_object.matrix_world, np.float64))  # small
    meshes: dict[int, _Part] = {}
    matrices: dict[int, list[NDArray[np.float64]]] = {}
    elsewhere: list[_Part] = []  # where it is shown by instances of its collection alone
    for instance in depsgraph.object_instances:
        source, owner = instance.object.original, (instance.parent or instance.object).original
        if source == scene_object != owner and isinstance(instance.object.data, bpy.types.Mesh) and not elsewhere:
            elsewhere.append(_read_part(instance.object, False, depsgraph))
        if owner != scene_object or not isinstance(instance.object.data, bpy.types.Mesh) or (
                source != owner and source.hide_render):
            continue
        if not instance.is_instance and owner.is_instancer and not owner.show_instancer_for_render:
            continue
        key = instance.object.data.as_pointer()
        if key not in meshes:
            generated = instance.is_instance and source == owner
            meshes[key] = _read_part(instance.object, generated, depsgraph)
        matrices.setdefault(key, []).append(to_local @ np.array(instance.matrix_world, np.float64))  # small
    return [(transform_rows(part[0], matrix[:3, :3]) + matrix[:3, 3], *part[1:])
            for key, part in meshes.items() for matrix in matrices[key]] or elsewhere


def _read_part(evaluated: bpy.types.Object, generated: bool, depsgraph: bpy.types.Depsgraph) -> _Part:
    """Corners, places in textures, and textures of an evaluated mesh, in its own space."""
    materials = list(evaluated.data.materials) if generated else [slot.material for slot in evaluated.material_slots]
    placed = [texture_of(m and m.original) for m in materials or [None]]
    mesh = evaluated.data if generated else evaluated.to_mesh(preserve_all_data_layers=True, depsgraph=depsgraph)
    try:
        mesh.calc_loop_triangles()
        count = len(mesh.loop_triangles)
        vertices, corners = np.empty((count, 3), np.int32), np.empty((count, 3), np.int32)
        slot, positions = np.empty(count, np.int32), np.empty((len(mesh.vertices), 3), np.float32)
        mesh.loop_triangles.foreach_get("vertices", vertices.ravel())
        mesh.loop_triangles.foreach_get("loops", corners.ravel())
        mesh.loop_triangles.foreach_get("material_index", slot)
        mesh.vertices.foreach_get("co", positions.ravel())
        slot = np.clip(slot, 0, len(placed) - 1)
        places, number = np.zeros((count, 3, 2)), np.full(count, -1, np.int32)
        for index, texture in enumerate(placed):
            mine = slot == index
            uv = _uv_of(mesh, texture.uv_map) if texture is not None and mine.any() else None
            if uv is not None:
                turn = np.array(texture.turn)
                places[mine] = (uv[corners[mine]][..., None, :] * turn[:, :2]).sum(axis=-1) + turn[:, 2]
                number[mine] = index
    finally:
        if not generated:
            evaluated.to_mesh_clear()
    nothing = TextureUse(("", None), WHITE, True, "REPEAT")
    return (positions[vertices].astype(np.float64), places, number,
            tuple(nothing if texture is None else texture.use for texture in placed))


def _uv_of(mesh: bpy.types.Mesh, name: str) -> NDArray[np.float32] | None:
    """(corners, 2) of a UV map by name, or of the one that renders; None where there is none."""
    layer = mesh.uv_layers.get(name) if name else next((one for one in mesh.uv_layers if one.active_render), None)
    if layer is None or len(layer.uv) != len(mesh.loops):
        return None
    uv = np.empty((len(mesh.loops), 2), np.float32)
    layer.uv.foreach_get("vector", uv.ravel())
    return uv if np.isfinite(uv).all() else None


def _joined_uses(lists: list[tuple[TextureUse, ...]], lengths: list[int], number: NDArray[np.int32],
                 ) -> tuple[tuple[TextureUse, ...], NDArray[np.int32]]:
    """Textures of several meshes as one list without repetition, and the places in it of all triangles."""
    uses = list(dict.fromkeys(use for part in lists for use in part if use.image[0]))
    starts = np.concatenate([[0], np.cumsum(lengths)])
    joined = number.copy()
    for start, end, part in zip(starts[:-1], starts[1:], lists, strict=True):
        table = np.array([uses.index(use) if use.image[0] else -1 for use in part], np.int32)
        own = number[start:end]
        joined[start:end] = np.where(own >= 0, table[own], -1)
    return tuple(uses), joined
