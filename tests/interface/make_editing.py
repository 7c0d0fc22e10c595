# SPDX-License-Identifier: GPL-3.0-or-later
"""Make the room of the test of live materials: open in front, red at its left, a box and a panel in it, a sky and a sun
that look in; some 10,000 receivers."""

from __future__ import annotations

import math
import sys
from pathlib import Path

import bpy

sys.path.insert(0, str(Path(__file__).parent))  # Blender runs this file by its path

from room import WHITE, add_room, add_wall, material

CELLS = 44


def main(path: str) -> None:
    bpy.ops.wm.read_homefile(use_empty=True)
    scene = bpy.context.scene
    add_room(CELLS)
    add_wall("Panel", (-0.3, 0.2, 1.9), (0.6, 0, 0), (0, -0.6, 0), material("Panel", (0.5, 0.5, 0.5)), 10)
    bpy.ops.mesh.primitive_cube_add(size=0.6, location=(0.25, 0.25, 0.35), rotation=(0.0, 0.0, 0.4))
    bpy.context.object.name = "Box"
    bpy.context.object.data.materials.append(material("Box", WHITE))
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
