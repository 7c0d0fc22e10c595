# SPDX-License-Identifier: GPL-3.0-or-later
"""Where local lights will move: box empties, or meshes by their bounds, named by the artist."""

from __future__ import annotations

import bpy
import numpy as np
from numpy.typing import NDArray

from ..errors import BadScene
from .visibility import render_visible_objects


def light_regions(depsgraph: bpy.types.Depsgraph, name: str) -> NDArray[np.float64]:
    """(b, 4, 4): what takes the cube [-1, 1]^3 to each region, world space in metres; none for an empty name.

    name: of a box empty, of a mesh, or of a collection of these. Raises BadScene where there is no such thing, where it
    holds no region, or where a mesh is part of the rendered scene itself.
    """
    if not name:
        return np.empty((0, 4, 4))
    collection = bpy.data.collections.get(name)
    found = depsgraph.scene.objects.get(name)
    if found is None and collection is None:
        raise BadScene(name, "there is no object or collection of this name for the region of lights",
                       "Name a box empty, a mesh or a collection of these, or leave the region empty")
    members = [found] if found is not None else list(collection.all_objects)
    visible = render_visible_objects(depsgraph.view_layer)
    boxes = [_box(member, member.name_full in visible) for member in members if member.type in ("EMPTY", "MESH")]
    if not boxes:
        raise BadScene(name, "it holds no box empty and no mesh", "Add an empty that shows as a cube where lights move")
    return np.stack(boxes)


def _box(region: bpy.types.Object, rendered: bool) -> NDArray[np.float64]:
    """The transform of one region's cube."""
    if region.type == "MESH" and rendered:
        raise BadScene(region.name, "it is a region of lights and also part of the rendered scene",
                       "Disable it in renders (camera icon of the outliner), or use a box empty")
    if region.type == "EMPTY" and region.empty_display_type != "CUBE":
        raise BadScene(region.name, "an empty that is no cube bounds no region", "Set its display to Cube")
    matrix = np.array(region.matrix_world, np.float64)
    local = np.eye(4)
    if region.type == "EMPTY":
        local[:3, :3] *= region.empty_display_size
    else:
        corners = np.array(region.bound_box, np.float64)
        low, high = corners.min(axis=0), corners.max(axis=0)
        local[:3, :3], local[:3, 3] = np.diag(0.5 * (high - low)), 0.5 * (low + high)
    box = matrix @ local  # small
    if not np.isfinite(box).all() or abs(np.linalg.det(box[:3, :3])) < 1e-30:  # small
        raise BadScene(region.name, "the region of lights is flat", "Give it a size along all three axes")
    return box
