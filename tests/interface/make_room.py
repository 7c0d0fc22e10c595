# SPDX-License-Identifier: GPL-3.0-or-later
"""Make the room of the local lights' interface tests: open in front, red at its left, a box in it, two soft lamps, a
region for them, and a camera that looks in. Its world is black until a test asks for a sky."""

from __future__ import annotations

import math
import sys
from pathlib import Path

import bpy

sys.path.insert(0, str(Path(__file__).parent))  # Blender runs this file by its path

from room import WHITE, add_room, material

CELLS = 14
LAMP = (0.45, -0.1, 1.35)


def add_lamp(name: str, kind: str, energy: float, place: tuple, turn: tuple = (0.0, 0.0, 0.0)) -> None:
    data = bpy.data.lights.new(name, kind)
    data.energy, data.shadow_soft_size = energy, 0.08
    lamp = bpy.data.objects.new(name, data)
    lamp.location, lamp.rotation_euler = place, turn
    bpy.context.scene.collection.objects.link(lamp)


def main(path: str) -> None:
    bpy.ops.wm.read_homefile(use_empty=True)
    scene = bpy.context.scene
    add_room(CELLS, specular=0.0)
    bpy.ops.mesh.primitive_cube_add(size=0.6, location=(0.25, 0.25, 0.3), rotation=(0.0, 0.0, 0.4))
    bpy.context.object.name = "Box"
    bpy.context.object.data.materials.append(material("Box", WHITE, specular=0.0))
    add_lamp("Lamp", "POINT", 12.0, LAMP)
    add_lamp("Spot", "SPOT", 6.0, (-0.3, -0.2, 1.8))
    bpy.data.lights["Spot"].spot_size = math.radians(50.0)
    region = bpy.data.objects.new("Region", None)
    region.empty_display_type, region.empty_display_size = "CUBE", 0.95
    region.location = (0.0, 0.0, 1.0)
    scene.collection.objects.link(region)
    scene.world = bpy.data.worlds.new("World")
    scene.world.node_tree.nodes["Background"].inputs["Color"].default_value = (0.0, 0.0, 0.0, 1.0)
    bpy.ops.object.camera_add(location=(0.0, -4.4, 1.0), rotation=(math.radians(90.0), 0.0, 0.0))
    scene.camera = bpy.context.object
    scene.camera.data.show_passepartout = False  # it would darken what is compared
    # Plain sRGB, so that a picture's levels say what its radiance is.
    scene.view_settings.view_transform = "Standard"
    scene.prt.cloud_region = region
    bpy.ops.object.select_all(action="DESELECT")
    bpy.ops.wm.save_as_mainfile(filepath=path)


main(sys.argv[sys.argv.index("--") + 1])
