# SPDX-License-Identifier: GPL-3.0-or-later
"""Make the scene of the test of lamps through bodies: a ball of wax, a lamp behind it, a camera before it."""

from __future__ import annotations

import math
import sys

import bpy


def principled(name: str, values: dict[str, object]) -> bpy.types.Material:
    made = bpy.data.materials.new(name)
    for key, value in values.items():
        made.node_tree.nodes["Principled BSDF"].inputs[key].default_value = value
    return made


def main(path: str) -> None:
    bpy.ops.wm.read_homefile(use_empty=True)
    scene = bpy.context.scene
    bpy.ops.mesh.primitive_ico_sphere_add(subdivisions=5, radius=0.6, location=(0.0, 0.0, 0.7))
    bpy.context.object.name = "Ball"
    bpy.ops.object.shade_smooth()
    bpy.context.object.data.materials.append(principled("Wax", {
        "Base Color": (0.95, 0.7, 0.5, 1.0), "Subsurface Weight": 1.0, "Subsurface Scale": 3.0,
        "Subsurface Radius": (0.5, 0.25, 0.12), "Specular IOR Level": 0.0, "Roughness": 1.0}))
    bpy.ops.mesh.primitive_grid_add(x_subdivisions=20, y_subdivisions=20, size=4.0)
    bpy.context.object.name = "Floor"
    bpy.context.object.data.materials.append(principled("Grey", {
        "Base Color": (0.4, 0.4, 0.4, 1.0), "Specular IOR Level": 0.0, "Roughness": 1.0}))
    lamp = bpy.data.objects.new("Lamp", bpy.data.lights.new("Lamp", "POINT"))
    lamp.data.energy, lamp.data.shadow_soft_size, lamp.location = 120.0, 0.05, (0.0, 1.3, 1.0)
    scene.collection.objects.link(lamp)
    scene.world = bpy.data.worlds.new("World")
    scene.world.node_tree.nodes["Background"].inputs["Color"].default_value = (0.0, 0.0, 0.0, 1.0)
    bpy.ops.object.camera_add(location=(0.0, -3.6, 0.9), rotation=(math.radians(88.0), 0.0, 0.0))
    scene.camera = bpy.context.object
    scene.camera.data.show_passepartout = False  # it would darken what is compared
    scene.view_settings.view_transform = "Standard"
    bpy.ops.object.select_all(action="DESELECT")
    bpy.ops.wm.save_as_mainfile(filepath=path)


main(sys.argv[sys.argv.index("--") + 1])
