# SPDX-License-Identifier: GPL-3.0-or-later
"""The room of two scenes of the interface tests: open in front, red at its left, and finely divided."""

from __future__ import annotations

import bpy
import numpy as np

WHITE = (0.7, 0.7, 0.7)


def material(name: str, colour: tuple[float, float, float], specular: float = 0.5) -> bpy.types.Material:
    made = bpy.data.materials.new(name)
    shader = made.node_tree.nodes["Principled BSDF"]
    shader.inputs["Base Color"].default_value = (*colour, 1.0)
    shader.inputs["Specular IOR Level"].default_value = specular
    return made


def add_wall(name: str, corner: tuple, side_u: tuple, side_v: tuple, surface: bpy.types.Material, cells: int) -> None:
    """A grid whose face looks towards side_u x side_v."""
    u, v = np.meshgrid(*(np.linspace(0.0, 1.0, cells + 1),) * 2, indexing="ij")
    points = np.asarray(corner) + u[..., None] * np.asarray(side_u) + v[..., None] * np.asarray(side_v)
    row = cells + 1
    faces = [(i * row + j, (i + 1) * row + j, (i + 1) * row + j + 1, i * row + j + 1)
             for i in range(cells) for j in range(cells)]
    mesh = bpy.data.meshes.new(name)
    mesh.from_pydata(points.reshape(-1, 3).tolist(), [], faces)
    mesh.materials.append(surface)
    bpy.context.scene.collection.objects.link(bpy.data.objects.new(name, mesh))


def add_room(cells: int, specular: float = 0.5) -> None:
    """Floor, ceiling and three walls, each of a material of its own name."""
    for name, corner, side_u, side_v, colour in (
            ("Floor", (-1, -1, 0), (2, 0, 0), (0, 2, 0), WHITE), ("Ceiling", (-1, 1, 2), (2, 0, 0), (0, -2, 0), WHITE),
            ("Back", (-1, 1, 0), (2, 0, 0), (0, 0, 2), WHITE),
            ("Left", (-1, -1, 0), (0, 2, 0), (0, 0, 2), (0.7, 0.05, 0.05)),
            ("Right", (1, -1, 0), (0, 0, 2), (0, 2, 0), WHITE)):
        add_wall(name, corner, side_u, side_v, material(name, colour, specular), cells)
