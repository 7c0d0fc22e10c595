# SPDX-License-Identifier: GPL-3.0-or-later
"""The relit colours on an object's own mesh where its bake is on a hidden receiver mesh, so that renders show them.

As fine as the own mesh is: each of its face corners takes the colour of the nearest receiver that faces its way.
"""

from __future__ import annotations

import bpy
import numpy as np
from numpy.typing import NDArray

from ..relighting.corner_colours import receivers_of_corners
from ..storage.container import BakedTransfer
from .fingerprint import RELIT_ATTRIBUTE
from .read_scene import normal_matrix, transform_rows
from .stored import baked_mesh

KIND = ("FLOAT_COLOR", "CORNER")


def can_show(scene_object: bpy.types.Object) -> bool:
    """Whether an object has a mesh of its own, beside the one that carries its bake, that can take the colours.

    Not one that several objects share, that is linked or edited, or where something else has the attribute's name.
    """
    mesh = scene_object.data
    if not isinstance(mesh, bpy.types.Mesh) or baked_mesh(scene_object) in (None, mesh):
        return False
    attribute = mesh.attributes.get(RELIT_ATTRIBUTE)
    free = attribute is None or (attribute.data_type, attribute.domain) == KIND
    return free and mesh.library is None and not mesh.is_editmode and mesh.users == 1 and len(mesh.loops) > 0


def own_corners(scene_object: bpy.types.Object, baked: BakedTransfer) -> NDArray[np.intp]:
    """(corners,) of the own mesh into the receivers of its bake."""
    mesh = scene_object.data
    points, normals = np.empty((len(mesh.vertices), 3), np.float32), np.empty((len(mesh.loops), 3), np.float32)
    vertex = np.empty(len(mesh.loops), np.int32)
    mesh.vertices.foreach_get("co", points.ravel())
    mesh.corner_normals.foreach_get("vector", normals.ravel())
    mesh.loops.foreach_get("vertex_index", vertex)
    matrix = np.array(baked.header["matrix"], np.float64).reshape(4, 4)
    world = transform_rows(points, matrix[:3, :3]) + matrix[:3, 3]
    return receivers_of_corners(world, vertex, transform_rows(normals, normal_matrix(matrix)), baked.positions,
                                baked.normals)


def write_own_colours(mesh: bpy.types.Mesh, colours: NDArray[np.floating]) -> None:
    """Put colours (corners, 3) into the attribute, which is made where it is missing."""
    attribute = mesh.attributes.get(RELIT_ATTRIBUTE) or mesh.color_attributes.new(RELIT_ATTRIBUTE, *KIND)
    values = np.ones((len(colours), 4), np.float32)
    values[:, :3] = colours
    attribute.data.foreach_set("color", values.ravel())
    mesh.update_tag()


def drop_own_colours(scene_object: bpy.types.Object) -> None:
    """Remove them again: the object is baked anew or its bake is cleared."""
    mesh = scene_object.data
    attribute = mesh.attributes.get(RELIT_ATTRIBUTE) if isinstance(mesh, bpy.types.Mesh) else None
    if attribute is not None and (attribute.data_type, attribute.domain) == KIND and mesh.library is None:
        mesh.attributes.remove(attribute)
