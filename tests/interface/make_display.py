# SPDX-License-Identifier: GPL-3.0-or-later
"""Make the scene of the display tests: a floor of four vertices with a checker texture, a textured ball with a seam, a
plain statue and a red wall under a grey World, and a lamp."""

from __future__ import annotations

import math
import sys

import bpy
import numpy as np

CELLS, TEXELS = 8, 16  # of the checker, and of a cell


def checker(name: str, first: tuple[float, float, float], second: tuple[float, float, float]) -> bpy.types.Image:
    """A checker with a green corner at the image's origin, packed into the file."""
    side = CELLS * TEXELS
    rows, columns = np.indices((side, side)) // TEXELS
    pixels = np.ones((side, side, 4), np.float32)
    pixels[..., :3] = np.where(((rows + columns) % 2 == 0)[..., None], first, second)
    pixels[:TEXELS, :TEXELS, :3] = (0.1, 0.8, 0.2)
    image = bpy.data.images.new(name, side, side)
    image.pixels.foreach_set(pixels.ravel())
    image.pack()
    return image


def material(name: str, colour: tuple[float, float, float], image: bpy.types.Image | None = None,
             ) -> bpy.types.Material:
    made = bpy.data.materials.new(name)
    shader = made.node_tree.nodes["Principled BSDF"]
    shader.inputs["Base Color"].default_value = (*colour, 1.0)
    shader.inputs["Specular IOR Level"].default_value = 0.0
    if image is not None:
        node = made.node_tree.nodes.new("ShaderNodeTexImage")
        node.image = image
        made.node_tree.links.new(node.outputs["Color"], shader.inputs["Base Color"])
    return made


def named(name: str, made: bpy.types.Material) -> bpy.types.Object:
    """The object that an operator just added, with a name and a material."""
    added = bpy.context.object
    added.name = added.data.name = name
    added.data.materials.append(made)
    return added


def main(path: str) -> None:
    bpy.ops.wm.read_homefile(use_empty=True)
    scene = bpy.context.scene
    bpy.ops.mesh.primitive_plane_add(size=4.0)
    named("Floor", material("Tiles", (1, 1, 1), checker("tiles", (0.85, 0.8, 0.7), (0.15, 0.2, 0.35))))
    bpy.ops.mesh.primitive_uv_sphere_add(radius=0.6, location=(0.9, -0.5, 0.6), segments=32, ring_count=16)
    bpy.ops.object.shade_smooth()
    named("Ball", material("Ball", (1, 1, 1), checker("ball", (0.9, 0.35, 0.1), (0.9, 0.9, 0.85))))
    bpy.ops.mesh.primitive_monkey_add(size=1.3, location=(-0.7, 0.0, 0.8), rotation=(-0.5, 0.0, 0.3))
    bpy.ops.object.shade_smooth()
    named("Statue", material("Clay", (0.8, 0.75, 0.7)))
    bpy.ops.mesh.primitive_cube_add(size=1.0, location=(0.0, 1.9, 0.9))
    bpy.context.object.scale = (3.6, 0.1, 1.8)
    named("Wall", material("Red", (0.8, 0.05, 0.05)))
    lamp = bpy.data.objects.new("Lamp", bpy.data.lights.new("Lamp", "POINT"))
    lamp.data.energy, lamp.location = 30.0, (0.2, -0.6, 2.0)
    scene.collection.objects.link(lamp)
    scene.world = bpy.data.worlds.new("World")
    scene.world.node_tree.nodes["Background"].inputs["Color"].default_value = (0.8, 0.8, 0.8, 1.0)
    bpy.ops.object.camera_add(location=(2.2, -5.2, 3.4), rotation=(math.radians(62.0), 0.0, math.radians(22.0)))
    scene.camera = bpy.context.object
    scene.camera.data.show_passepartout = False
    bpy.ops.object.select_all(action="DESELECT")
    bpy.ops.wm.save_as_mainfile(filepath=path)


main(sys.argv[sys.argv.index("--") + 1])
