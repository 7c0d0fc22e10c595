# SPDX-License-Identifier: GPL-3.0-or-later
"""Materials as live editing reads them: albedo and emission of an object's receivers, as its materials are now.

Form factors of a bake lie in custom properties of the mesh of one of its objects (`write_live`, `read_live`).
"""

from __future__ import annotations

from dataclasses import dataclass, field

import bpy
import numpy as np
from numpy.typing import NDArray

from ..errors import StorageError
from ..storage.container import REBAKE, BakedTransfer
from ..transport.live_operator import LiveOperator
from .fingerprint import follows_edits, shows_relit, used_materials
from .materials import DARKEST, constant_albedo
from .nodes import constant_of, origin_of
from .surfaces import stand_in_of

PROPERTIES = {name: f"prt_live_{name}" for name in ("counts", "indices", "values", "surfaces")}
Colour = tuple[float, float, float]
NOTHING: Colour = (0.0, 0.0, 0.0)


def write_live(mesh: bpy.types.Mesh, live: LiveOperator | None) -> None:
    """Put a bake's form factors on a mesh; None for none."""
    if live is not None:
        for name, values in live.arrays().items():
            mesh[PROPERTIES[name]] = np.ascontiguousarray(values)


def clear_live(mesh: bpy.types.Mesh) -> None:
    """Remove them."""
    for key in PROPERTIES.values():
        if key in mesh:
            del mesh[key]


def read_live(mesh: bpy.types.Mesh, subject: str) -> LiveOperator | None:
    """The form factors on a mesh; None without. Raises StorageError where they are broken."""
    if PROPERTIES["counts"] not in mesh:
        return None
    try:
        return LiveOperator.of_arrays({name: np.array(mesh[key]) for name, key in PROPERTIES.items()})
    except (KeyError, TypeError, ValueError) as error:
        raise StorageError(subject, f"what its bake kept for live editing can't be read ({error})",
                           REBAKE) from error


@dataclass(frozen=True)
class EditedSurfaces:
    """Of an object's receivers now: albedo, emission (p, 3) float32, radiance of the latter; changed: whether either is
    not as baked; glows: by slot, the radiance of what glows."""

    albedo: NDArray[np.float32]
    emission: NDArray[np.float32]
    changed: bool
    glows: dict[int, Colour] = field(default_factory=dict)


def edited_surfaces(scene_object: bpy.types.Object, baked: BakedTransfer, slots: NDArray[np.int32]) -> EditedSurfaces:
    """What an object's materials are now. slots: (p,) of its receivers (`slots_of_receivers`)."""
    albedo, emission = baked.albedo, np.zeros_like(baked.albedo)
    if shows_relit(scene_object):
        return EditedSurfaces(albedo, emission, False)
    materials = used_materials(scene_object) or [None]
    found = [albedo_of(material) for material in materials]
    known = np.array([colour is not None for colour in found])
    table = np.array([NOTHING if colour is None else colour for colour in found], np.float32)
    glow = np.array([emission_of(material) for material in materials], np.float32)
    slot = np.clip(slots, 0, len(materials) - 1)
    now = np.where(known[slot, None], table[slot], albedo)
    differs = np.abs(now - albedo).max(axis=1) > 1e-6
    if not differs.any() and not glow.any():
        return EditedSurfaces(albedo, emission, False)
    albedo = np.where(differs[:, None], now, albedo)
    glows = {number: tuple(float(c) for c in glow[number]) for number in np.flatnonzero(glow.any(axis=1))}
    return EditedSurfaces(np.ascontiguousarray(albedo), np.ascontiguousarray(glow[slot]), True, glows)


def slots_of_receivers(scene_object: bpy.types.Object, baked: BakedTransfer,
                       depsgraph: bpy.types.Depsgraph) -> NDArray[np.int32] | None:
    """(p,) the material slot of each receiver; None where the bake's triangles are not those of the object's mesh."""
    evaluated = scene_object.evaluated_get(depsgraph)
    if baked.source is None or not follows_edits(scene_object, depsgraph):
        return None
    mesh = evaluated.to_mesh()
    try:
        mesh.calc_loop_triangles()
        slot = np.empty(len(mesh.loop_triangles), np.int32)
        mesh.loop_triangles.foreach_get("material_index", slot)
    finally:
        evaluated.to_mesh_clear()
    if len(baked.source) and int(baked.source.max()) >= len(slot):
        return None
    result = np.zeros(len(baked.positions), np.int32)
    result[baked.triangles.ravel()] = np.repeat(slot[baked.source], 3)
    return result


def albedo_of(material: bpy.types.Material | None) -> Colour | None:
    """The albedo that a bake would read of a material that is the same everywhere; None of another."""
    albedo = constant_albedo(material)
    if albedo is None or max(albedo) > DARKEST:
        return albedo
    found = stand_in_of(material)
    return albedo if found is None else found[0]


def emission_of(material: bpy.types.Material | None) -> Colour:
    """The radiance that a surface sends out by itself, of a Principled BSDF or an Emission node with plain values; no
    other is read."""
    output = material.node_tree.get_output_node("CYCLES") if material is not None and material.node_tree else None
    found, _, groups = origin_of(output.inputs["Surface"]) if output is not None else (None, None, ())
    if found is None or found.node.mute:
        return NOTHING
    names = {"ShaderNodeBsdfPrincipled": ("Emission Color", "Emission Strength"),
             "ShaderNodeEmission": ("Color", "Strength")}.get(found.node.bl_idname)
    if names is None:
        return NOTHING
    colour, strength = (constant_of(found.node.inputs[name], groups) for name in names)
    if colour is None or strength is None:
        return NOTHING
    return tuple(max(float(channel) * float(strength), 0.0) for channel in colour[:3])
