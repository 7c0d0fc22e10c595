# SPDX-License-Identifier: GPL-3.0-or-later
"""Make the scene of the interface tests: a statue-like mesh and a coloured wall on a floor, an HDRI and a Sun."""

from __future__ import annotations

import math
import sys

import bpy
import numpy as np


def material(name: str, colour: tuple[float, float, float]) -> bpy.types.Material:
    made = bpy.data.materials.new(name)
    made.node_tree.nodes["Principled BSDF"].inputs["Base Color"].default_value = (*colour, 1.0)
    return made


def environment() -> bpy.types.Image:
    """A blue sky with a warm bright side, packed into the file."""
    height, width = 32, 64
    rows, columns = np.mgrid[0:height, 0:width]
    elevation, azimuth = (rows + 0.5) / height - 0.5, (columns + 0.5) / width * 2.0 * np.pi
    pixels = np.ones((height, width, 4), np.float32)
    pixels[..., :3] = np.where(elevation > 0, 1.0, 0.15)[..., None] * (0.25, 0.4, 0.7)
    warm = np.exp(4.0 * (np.cos(azimuth) - 1.0)) * (np.abs(elevation) < 0.3)
    pixels[..., :3] += warm[..., None] * np.array((4.0, 2.0, 0.8))
    image = bpy.data.images.new("sky", width, height, float_buffer=True)
    image.colorspace_settings.name = "Linear Rec.709"
    image.pixels.foreach_set(pixels.ravel())
    image.pack()
    return image


def world() -> bpy.types.World:
    made = bpy.data.worlds.new("Sky")
    nodes, links = made.node_tree.nodes, made.node_tree.links
    texture, mapping = nodes.new("ShaderNodeTexEnvironment"), nodes.new("ShaderNodeMapping")
    coordinates = nodes.new("ShaderNodeTexCoord")
    texture.image = environment()
    links.new(coordinates.outputs["Generated"], mapping.inputs["Vector"])
    links.new(mapping.outputs["Vector"], texture.inputs["Vector"])
    links.new(texture.outputs["Color"], nodes["Background"].inputs["Color"])
    return made


def main(path: str) -> None:
    bpy.ops.wm.read_homefile(use_empty=True)
    scene = bpy.context.scene
    scene.world = world()
    bpy.ops.mesh.primitive_plane_add(size=6.0)
    floor = bpy.context.object
    floor.name = "Floor"
    floor.data.materials.append(material("Grey", (0.7, 0.7, 0.7)))
    bpy.ops.mesh.primitive_monkey_add(location=(0.0, 0.0, 1.0), rotation=(-0.6, 0.0, 0.4))
    statue = bpy.context.object
    statue.name = "Statue"
    bpy.ops.object.shade_smooth()
    statue.data.materials.append(material("Clay", (0.8, 0.75, 0.7)))
    bpy.ops.mesh.primitive_cube_add(location=(-2.0, 0.6, 1.0))
    wall = bpy.context.object
    wall.name, wall.scale = "Wall", (0.1, 1.5, 1.0)
    wall.data.materials.append(material("Red", (0.8, 0.05, 0.05)))
    bpy.ops.object.light_add(type="SUN", rotation=(math.radians(40), 0.0, math.radians(30)))
    bpy.context.object.name, bpy.context.object.data.energy = "Sun", 2.0
    bpy.ops.object.camera_add(location=(5.0, -6.0, 4.0), rotation=(math.radians(65), 0.0, math.radians(40)))
    scene.camera = bpy.context.object
    bpy.ops.object.select_all(action="DESELECT")
    bpy.ops.wm.save_as_mainfile(filepath=path)


if __name__ == "__main__":
    main(sys.argv[sys.argv.index("--") + 1])
