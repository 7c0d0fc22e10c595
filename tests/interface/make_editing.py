# SPDX-License-Identifier: GPL-3.0-or-later
"""Make the room of the test of live materials: open in front, red at its left, a box and a panel in it, a sky and a sun
that look in; some 10,000 receivers."""

from __future__ import annotations

import math
import sys

import bpy
import numpy as np

CELLS = 44


def material(name: str, colour: tuple[float, float, float]) -> bpy.types.Material:
    made = bpy.data.materials.new(name)
    made.node_tree.nodes["Principled BSDF"].inputs["Base Color"].default_value = (*colour, 1.0)
    return made


def add_wall(name: str, corner: tuple, side_u: tuple, side_v: tuple, colour: tuple, cells: int = CELLS) -> None:
    """A grid whose face looks towards side_u x side_v."""
    u, v = np.meshgrid(*(np.linspace(0.0, 1.0, cells + 1),) * 2, indexing="ij")
    points = np.asarray(corner) + u[..., None] * np.asarray(side_u) + v[..., None] * np.asarray(side_v)
    row = cells + 1
    faces = [(i * row + j, (i + 1) * row + j, (i + 1) * row + j + 1, i * row + j + 1)
             for i in range(cells) for j in range(cells)]
    mesh = bpy.data.meshes.new(name)
    mesh.from_pydata(points.reshape(-1, 3).tolist(), [], faces)
    mesh.materials.append(material(name, colour))
    bpy.context.scene.collection.objects.link(bpy.data.objects.new(name, mesh))


def main(path: str) -> None:
    bpy.ops.wm.read_homefile(use_empty=True)
    scene, white = bpy.context.scene, (0.7, 0.7, 0.7)
    add_wall("Floor", (-1, -1, 0), (2, 0, 0), (0, 2, 0), white)
    add_wall("Ceiling", (-1, 1, 2), (2, 0, 0), (0, -2, 0), white)
    add_wall("Back", (-1, 1, 0), (2, 0, 0), (0, 0, 2), white)
    add_wall("Left", (-1, -1, 0), (0, 2, 0), (0, 0, 2), (0.7, 0.05, 0.05))
    add_wall("Right", (1, -1, 0), (0, 0, 2), (0, 2, 0), white)
    add_wall("Panel", (-0.3, 0.2, 1.9), (0.6, 0, 0), (0, -0.6, 0), (0.5, 0.5, 0.5), 10)
    bpy.ops.mesh.primitive_cube_add(size=0.6, location=(0.25, 0.25, 0.35), rotation=(0.0, 0.0, 0.4))
    bpy.context.object.name = "Box"
    bpy.context.object.data.materials.append(material("Box", white))
    sun = bpy.data.objects.new("Sun", bpy.data.lights.new("Sun", "SUN"))
    sun.data.energy, sun.rotation_euler = 3.0, (math.radians(70.0), 0.0, math.radians(25.0))
    scene.collection.objects.link(sun)
    scene.world = bpy.data.worlds.new("World")
    scene.world.node_tree.nodes["Background"].inputs["Color"].default_value = (0.5, 0.5, 0.5, 1.0)
    bpy.ops.object.camera_add(location=(0.0, -4.4, 1.0), rotation=(math.radians(90.0), 0.0, 0.0))
    scene.camera = bpy.context.object
    scene.camera.data.show_passepartout = False  # it would darken what is compared
    scene.view_settings.view_transform = "Standard"
    bpy.ops.object.select_all(action="DESELECT")
    bpy.ops.wm.save_as_mainfile(filepath=path)


main(sys.argv[sys.argv.index("--") + 1])
