# SPDX-License-Identifier: GPL-3.0-or-later
"""Make the scene of the views' interface tests: a floor, a wall and a ball of metal to bake, a post that is not baked,
an HDRI with a bright side, a Sun, a lamp, and a camera."""

from __future__ import annotations

import math
import sys
from pathlib import Path

import bpy
import numpy as np

sys.path.insert(0, str(Path(__file__).parent))  # Blender runs this file by its path

from make_scene import world

BAKED = ("Floor", "Wall", "Ball")


def paint(made: bpy.types.Object, colour: tuple[float, float, float], metallic: float = 0.0) -> None:
    material = bpy.data.materials.new(made.name)
    shader = material.node_tree.nodes["Principled BSDF"].inputs
    shader["Base Color"].default_value, shader["Metallic"].default_value = (*colour, 1.0), metallic
    shader["Roughness"].default_value, shader["Specular IOR Level"].default_value = 0.6, 0.0
    made.data.materials.append(material)


def add_grid(name: str, cells: int, corner: tuple, side_u: tuple, side_v: tuple) -> bpy.types.Object:
    """A grid of cells x cells whose face looks towards side_u x side_v."""
    u, v = np.meshgrid(*(np.linspace(0.0, 1.0, cells + 1),) * 2, indexing="ij")
    points = np.asarray(corner) + u[..., None] * np.asarray(side_u) + v[..., None] * np.asarray(side_v)
    row = cells + 1
    faces = [(i * row + j, (i + 1) * row + j, (i + 1) * row + j + 1, i * row + j + 1)
             for i in range(cells) for j in range(cells)]
    mesh = bpy.data.meshes.new(name)
    mesh.from_pydata(points.reshape(-1, 3).tolist(), [], faces)
    made = bpy.data.objects.new(name, mesh)
    bpy.context.scene.collection.objects.link(made)
    return made


def main(path: str) -> None:
    bpy.ops.wm.read_homefile(use_empty=True)
    scene = bpy.context.scene
    scene.world = world()
    paint(add_grid("Floor", 28, (-2.0, -2.0, 0.0), (4.0, 0.0, 0.0), (0.0, 4.0, 0.0)), (0.7, 0.7, 0.7))
    paint(add_grid("Wall", 16, (-1.2, -1.5, 0.0), (0.0, 3.0, 0.0), (0.0, 0.0, 1.6)), (0.8, 0.1, 0.08))
    bpy.ops.mesh.primitive_uv_sphere_add(segments=40, ring_count=20, radius=0.6, location=(0.3, 0.4, 0.7))
    ball = bpy.context.object
    ball.name = "Ball"
    bpy.ops.object.shade_smooth()
    paint(ball, (0.9, 0.7, 0.3), metallic=1.0)
    bpy.ops.mesh.primitive_cube_add(size=0.3, location=(0.5, -0.9, 0.4))
    post = bpy.context.object
    post.name, post.scale = "Post", (1.0, 1.0, 2.6)
    paint(post, (0.1, 0.3, 0.8))
    bpy.ops.object.light_add(type="SUN", rotation=(math.radians(35), 0.0, math.radians(30)))
    bpy.context.object.name, bpy.context.object.data.energy = "Sun", 1.5
    bpy.ops.object.light_add(type="POINT", location=(-0.4, -0.6, 1.3))
    bpy.context.object.name, bpy.context.object.data.energy = "Lamp", 15.0
    bpy.context.object.data.shadow_soft_size = 0.05
    bpy.ops.object.camera_add(location=(3.6, -4.2, 3.2), rotation=(math.radians(61), 0.0, math.radians(41)))
    scene.camera = bpy.context.object
    scene.view_settings.view_transform = "AgX"
    bpy.ops.object.select_all(action="DESELECT")
    bpy.ops.wm.save_as_mainfile(filepath=path)


if __name__ == "__main__":
    main(sys.argv[sys.argv.index("--") + 1])
