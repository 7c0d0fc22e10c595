# SPDX-License-Identifier: GPL-3.0-or-later
"""Shared by the tests that need Blender: small scenes, a digest of all the user's data."""

from __future__ import annotations

import hashlib
from collections.abc import Callable

import bpy
import numpy as np

PLAIN = {"BOOLEAN", "INT", "FLOAT", "STRING", "ENUM"}
# Counters and caches of Blender itself that any evaluation moves.
VOLATILE = {"session_uid", "is_evaluated", "is_updated", "is_updated_data", "tag", "pixels", "channels", "has_data",
            "bindcode", "depth", "is_float", "size", "frame_duration", "resolution", "generated_type", "storage_type",
            "depsgraph"}
# The window, not the artist's data.
INTERFACE = {"all_ids", "workspaces", "screens", "window_managers", "brushes"}


def depsgraph() -> bpy.types.Depsgraph:
    """The evaluated depsgraph, up to date."""
    bpy.context.view_layer.update()
    return bpy.context.evaluated_depsgraph_get()


def add_mesh(name: str, vertices: object, faces: object, collection: bpy.types.Collection | None = None,
             ) -> bpy.types.Object:
    """A mesh object in the scene, or in a collection."""
    mesh = bpy.data.meshes.new(name)
    mesh.from_pydata([tuple(v) for v in vertices], [], [tuple(f) for f in faces])
    scene_object = bpy.data.objects.new(name, mesh)
    (collection or bpy.context.scene.collection).objects.link(scene_object)
    return scene_object


def add_cube(name: str = "Cube", collection: bpy.types.Collection | None = None) -> bpy.types.Object:
    """A cube from -1 to 1, 8 vertices, 6 quads facing outwards."""
    corners = [(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]
    faces = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    return add_mesh(name, corners, faces, collection)


def add_material(name: str, build: Callable[[bpy.types.NodeTree, bpy.types.Node], None]) -> bpy.types.Material:
    """A material with a tree of its own: `build` gets the tree and the output node."""
    material = bpy.data.materials.new(name)
    material.node_tree.nodes.clear()
    build(material.node_tree, material.node_tree.nodes.new("ShaderNodeOutputMaterial"))
    return material


def user_data_digest() -> str:
    """Digest of every data-block, every plain property in it, and the context the user sees."""
    state = hashlib.blake2b(digest_size=16)
    for line in user_data_lines():
        state.update(line.encode())
    return state.hexdigest()


def user_data_lines() -> list[str]:
    """One line per property of every data-block, so that two states can be compared and their difference shown."""
    lines = [f"context {bpy.context.mode} {bpy.context.scene.name} {bpy.context.view_layer.name}"]
    active = bpy.context.view_layer.objects.active
    lines.append(f"active {active and active.name} selected {[o.name for o in bpy.context.selected_objects]}")
    for group in dir(bpy.data):
        blocks = getattr(bpy.data, group)
        if type(blocks).__name__ != "bpy_prop_collection" or group in INTERFACE:
            continue
        for block in blocks:
            lines.append(f"{group} {block.name_full} users {block.users}")
            _describe(block, f"{group}.{block.name_full}", lines, 0)
    return lines


def _describe(struct: bpy.types.bpy_struct, path: str, lines: list[str], depth: int) -> None:
    for item in struct.bl_rna.properties:
        name = item.identifier
        if name in VOLATILE or name == "rna_type":
            continue
        try:
            value = getattr(struct, name)
        except (AttributeError, ValueError, RuntimeError):
            continue
        if item.type in PLAIN:
            lines.append(f"{path}.{name}={value[:] if hasattr(value, '__getitem__') else value!r}"[:2000])
        elif item.type == "POINTER":
            if isinstance(value, bpy.types.ID) and not value.is_embedded_data:
                lines.append(f"{path}.{name}->{value.name_full}")
            elif value is not None and depth < 4:
                _describe(value, f"{path}.{name}", lines, depth + 1)
        elif item.type == "COLLECTION" and depth < 4:
            lines.append(f"{path}.{name} count {len(value)}")
            for index, element in enumerate(value):
                if element is None or (isinstance(element, bpy.types.ID) and not element.is_embedded_data):
                    lines.append(f"{path}.{name}[{index}]->{element and element.name_full}")
                else:
                    _describe(element, f"{path}.{name}[{index}]", lines, depth + 1)


def place(scene_object: bpy.types.Object, matrix: object) -> None:
    """Give an object any transform. Its own channels can't hold shear, a parent's inverse can."""
    parent = bpy.data.objects.new("Parent of " + scene_object.name, None)
    bpy.context.scene.collection.objects.link(parent)
    scene_object.parent = parent
    scene_object.matrix_parent_inverse = matrix


def unit(vectors: np.ndarray) -> np.ndarray:
    """Rows scaled to length one."""
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)
