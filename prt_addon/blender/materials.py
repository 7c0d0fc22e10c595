# SPDX-License-Identifier: GPL-3.0-or-later
"""Diffuse albedo of any material: plain colours are read, every other node tree is evaluated by Cycles.

Albedo here means what Cycles' diffuse colour pass reports once dielectric reflection, coat and sheen are switched off:
base colour x (1 - metallic) x (1 - transmission) x alpha of a Principled BSDF. With reflection on, that pass drops by
the few percent that go into the highlight, by an amount that depends on the view; transfer has no view, and the light
is not lost but reflected.
"""

from __future__ import annotations

import hashlib
import os
from dataclasses import dataclass
from typing import TYPE_CHECKING

import bpy
import numpy as np
from numpy.typing import NDArray

from .cycles_bake import evaluate_corners, scratch_scene
from .nodes import constant_of, copy_groups, origin_of, path_of, reachable, shown_images, signature
from .surfaces import stand_in_of

if TYPE_CHECKING:
    from .read_scene import MeshArrays

NO_MATERIAL = (0.8, 0.8, 0.8)  # Cycles' default surface
BLACK = (0.0, 0.0, 0.0)
WITHOUT_DIFFUSE = {"ShaderNodeEmission", "ShaderNodeBsdfTransparent", "ShaderNodeBsdfGlass", "ShaderNodeHoldout",
                   "ShaderNodeBsdfAnisotropic", "ShaderNodeBsdfRefraction", "ShaderNodeBsdfMetallic"}
DARKEST = 1e-3  # a diffuse albedo below it shows as black
VIEW_DEPENDENT_INPUTS = ("Specular IOR Level", "Coat Weight", "Sheen Weight")


def constant_albedo(material: bpy.types.Material | None) -> tuple[float, float, float] | None:
    """The albedo of a material that is the same everywhere, from its values alone; None where Cycles has to say."""
    if material is None:
        return NO_MATERIAL
    if material.node_tree is None:
        return _clipped(material.diffuse_color)
    output = material.node_tree.get_output_node("CYCLES")
    found, _, groups = origin_of(output.inputs["Surface"]) if output is not None else (None, None, ())
    if found is None:
        return BLACK
    surface = found.node
    if surface.mute:
        return None
    if surface.bl_idname in WITHOUT_DIFFUSE:
        return BLACK
    if surface.bl_idname == "ShaderNodeBsdfDiffuse":
        colour = constant_of(surface.inputs["Color"], groups)
        return None if colour is None else _clipped(colour)
    if surface.bl_idname != "ShaderNodeBsdfPrincipled":
        return None
    values = [constant_of(surface.inputs[name], groups)
              for name in ("Base Color", "Metallic", "Transmission Weight", "Alpha")]
    if any(value is None for value in values):
        return None
    colour, metallic, transmission, alpha = values
    if max(colour[:3]) > 1.0:  # where Cycles clamps it depends on the other inputs
        return None
    share = (1.0 - _unit(metallic)) * (1.0 - _unit(transmission)) * _unit(alpha)
    return _clipped(tuple(share * max(channel, 0.0) for channel in colour[:3]))


def _unit(value: float) -> float:
    return min(max(value, 0.0), 1.0)


def _clipped(colour: tuple[float, ...]) -> tuple[float, float, float]:
    return tuple(_unit(float(channel)) for channel in colour[:3])


def material_digest(materials: list[bpy.types.Material | None]) -> str:
    """Text that changes when a material of the list, or a value or link in one, changes. Pixels of images do not."""
    trees = [None if m is None else (signature(m.node_tree, edits=False) if m.node_tree else tuple(m.diffuse_color))
             for m in materials]
    return hashlib.blake2b(repr(trees).encode(), digest_size=16).hexdigest()


@dataclass
class _Request:
    """A mesh whose albedo Cycles has to evaluate, and where the result goes."""

    name: str
    evaluated: bpy.types.Object
    generated_mesh: bpy.types.Mesh | None
    depsgraph: bpy.types.Depsgraph
    corners: NDArray[np.int32]
    by_cycles: NDArray[np.bool_]
    materials: list[bpy.types.Material | None]
    matrix: NDArray[np.float64]
    result: NDArray[np.float32]
    slot: NDArray[np.int32]


def missing_images(material: bpy.types.Material) -> list[str]:
    """A line for each image of a material that Cycles can't find: it shows magenta there, and bakes magenta."""
    output = material.node_tree.get_output_node("CYCLES") if material.node_tree is not None else None
    if output is None:
        return []
    empty = [f"Material {material.name}: an image texture node has no image, which shows black"
             for node in reachable(output)
             if node.bl_idname == "ShaderNodeTexImage" and not node.mute and node.image is None]
    lost = [path_of(image) or image.name for image in shown_images(output)
            if image.source == "FILE" and image.packed_file is None and not os.path.isfile(path_of(image))]
    return empty + [f"Material {material.name}: its image {path} does not exist and shows magenta" for path in lost]


class AlbedoReader:
    """Fills corner albedos: at once where colours are plain, the rest in one go at the end with Cycles.

    In one go, because evaluating adds data to the file, which is not allowed while the depsgraph is being iterated.
    """

    def __init__(self, scene: bpy.types.Scene, warnings: list[str]) -> None:
        self._scene = scene
        self._warnings = warnings
        self._requests: list[_Request] = []
        self._constants: dict[bpy.types.Material | None, tuple[float, float, float] | None] = {}

    def add(self, evaluated: bpy.types.Object, generated_mesh: bpy.types.Mesh | None,
            depsgraph: bpy.types.Depsgraph, arrays: MeshArrays, materials: list[bpy.types.Material | None],
            matrix: NDArray[np.float64], result: NDArray[np.float32]) -> None:
        """Fill result (t, 3, 3) float32 now or in `evaluate`. generated_mesh: made by nodes, not the object's own."""
        slots: list[bpy.types.Material | None] = list(materials) or [None]
        # A face whose index exceeds the slots shows the last one, as in Cycles.
        slot = np.clip(arrays.material_index, 0, len(slots) - 1)
        constants = [self._constant(m) for m in slots]
        by_cycles = np.array([c is None for c in constants])
        table = np.array([BLACK if c is None else c for c in constants], np.float32)
        result[:] = table[slot][:, None, :]
        if by_cycles[slot].any():
            self._requests.append(_Request(evaluated.name, evaluated, generated_mesh, depsgraph, arrays.corners,
                                           by_cycles[slot], slots, matrix, result, slot))
        self._stand_in(evaluated.name, slots, slot, ~by_cycles[slot], result)

    def _stand_in(self, name: str, slots: list[bpy.types.Material | None], slot: NDArray[np.int32],
                  known: NDArray[np.bool_], result: NDArray[np.float32]) -> None:
        """A colour, and a warning, for materials that came out black because their highlight is not baked."""
        for number, material in enumerate(slots):
            chosen = known & (slot == number)
            if not chosen.any() or result[chosen].max() > DARKEST:
                continue
            found = stand_in_of(material)
            if found is not None:
                result[chosen] = np.asarray(found[0], np.float32)
                self._warnings.append(f"{name}: material {material.name} is drawn as diffuse with colour "
                                      f"{', '.join(f'{c:.2f}' for c in found[0])}: {found[1]}")

    def _constant(self, material: bpy.types.Material | None) -> tuple[float, float, float] | None:
        if material not in self._constants:
            self._constants[material] = constant_albedo(material)
            if material is not None and self._constants[material] is None:
                self._warnings += missing_images(material)
        return self._constants[material]

    def evaluate(self) -> None:
        """Evaluate with Cycles what `add` could not read. Raises PRTError where Cycles is missing or fails."""
        if not self._requests:
            return
        meshes: list[bpy.types.Mesh] = []
        neutral = _NeutralMaterials()
        try:
            with scratch_scene(self._scene) as scratch:
                # All copies first: evaluated meshes live only until something makes Blender evaluate again.
                for request in self._requests:
                    meshes.append(_own_copy(request))
                for request, mesh in zip(self._requests, meshes, strict=True):
                    _set_materials(mesh, [neutral.of(m) for m in request.materials])
                    colours = evaluate_corners(scratch, mesh, request.matrix, "DIFFUSE")
                    chosen = request.by_cycles
                    request.result[chosen] = np.clip(colours, 0.0, 1.0)[request.corners[chosen]]
                    self._stand_in(request.name, request.materials, request.slot, chosen, request.result)
        finally:
            for mesh in meshes:
                bpy.data.meshes.remove(mesh)
            neutral.remove()
            self._requests.clear()


def _own_copy(request: _Request) -> bpy.types.Mesh:
    """The evaluated mesh as a data-block of ours, with every attribute that a node tree may read."""
    if request.generated_mesh is not None:
        return request.generated_mesh.copy()
    return bpy.data.meshes.new_from_object(request.evaluated, preserve_all_data_layers=True,
                                           depsgraph=request.depsgraph)


def _set_materials(mesh: bpy.types.Mesh, materials: list[bpy.types.Material | None]) -> None:
    indices = np.empty(len(mesh.polygons), np.int32)
    mesh.polygons.foreach_get("material_index", indices)
    mesh.materials.clear()
    for material in materials:
        mesh.materials.append(material)
    mesh.polygons.foreach_set("material_index", np.clip(indices, 0, len(materials) - 1))


class _NeutralMaterials:
    """Copies of materials without view-dependent layers, made once each and removed together."""

    def __init__(self) -> None:
        self._copies: dict[bpy.types.Material, bpy.types.Material] = {}
        self._groups: list[bpy.types.NodeTree] = []

    def of(self, material: bpy.types.Material | None) -> bpy.types.Material | None:
        if material is None or material.node_tree is None:
            return None
        if material not in self._copies:
            self._copies[material] = material.copy()
            copy_groups(self._copies[material].node_tree, _switch_off_highlights, self._groups)
        return self._copies[material]

    def remove(self) -> None:
        for material in self._copies.values():
            bpy.data.materials.remove(material)
        for group in self._groups:
            bpy.data.node_groups.remove(group)
        self._copies.clear()
        self._groups.clear()


def _switch_off_highlights(tree: bpy.types.NodeTree) -> None:
    """Set what reflects without diffusing to zero in every Principled BSDF of a tree of ours."""
    for node in tree.nodes:
        if node.bl_idname == "ShaderNodeBsdfPrincipled":
            for name in VIEW_DEPENDENT_INPUTS:
                for link in list(node.inputs[name].links):
                    tree.links.remove(link)
                node.inputs[name].default_value = 0.0
