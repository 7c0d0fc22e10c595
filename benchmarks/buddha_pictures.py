# SPDX-License-Identifier: GPL-3.0-or-later
"""Pictures to look at: Buddhas of gold, brushed metal and jade, baked once and drawn under a turned environment.

    python benchmarks/buddha_pictures.py [--preset standard] [--turns 0,140] [--out build/buddhas]

Needs the bpy wheel, a graphics driver and the shared Buddha. Writes buddhas_<turn>.png by the product's own commands
(`prt bake`, `prt preview`), so that what is seen is what an artist gets.
"""

from __future__ import annotations

import argparse
import math
import subprocess
import sys
from pathlib import Path

import bpy
import numpy as np
from common import ROOT, mesh_path

MATERIALS = {
    "Gold": {"Base Color": (1.0, 0.72, 0.32, 1.0), "Metallic": 1.0, "Roughness": 0.4},
    "Brushed metal": {"Base Color": (0.8, 0.8, 0.85, 1.0), "Metallic": 1.0, "Roughness": 0.45, "Anisotropic": 0.8},
    "Jade": {"Base Color": (0.35, 0.75, 0.45, 1.0), "Subsurface Weight": 1.0, "Subsurface Radius": (0.6, 1.0, 0.7),
             "Subsurface Scale": 0.05, "Roughness": 0.4},
}
HEIGHT = 2.2


def build(path: Path, world: str) -> None:
    """Three Buddhas on a floor under one of Blender's own studio HDRIs, saved as a .blend."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    for number, (name, values) in enumerate(MATERIALS.items()):
        bpy.ops.wm.obj_import(filepath=str(mesh_path("buddha_nirj.obj")), forward_axis="Y", up_axis="Z")
        statue = bpy.context.selected_objects[0]
        statue.name = name
        vertices = np.array([v.co for v in statue.data.vertices])
        low, high = vertices.min(axis=0), vertices.max(axis=0)
        scale = HEIGHT / (high - low)[2]
        statue.scale = (scale,) * 3
        centre = 0.5 * (low + high) * scale
        statue.location = (1.7 * (number - 1) - centre[0], -centre[1], -low[2] * scale)
        statue.data.materials.clear()
        statue.data.materials.append(_material(name, values))
        bpy.context.view_layer.objects.active = statue
        bpy.ops.object.shade_smooth()
    bpy.ops.mesh.primitive_plane_add(size=12)
    floor = bpy.context.object
    floor.name = "Floor"
    floor.data.materials.append(_material("Floor", {"Base Color": (0.6, 0.6, 0.6, 1.0), "Roughness": 0.9,
                                                    "Specular IOR Level": 0.0}))
    _add_camera()
    _add_world(world)
    bpy.ops.wm.save_as_mainfile(filepath=str(path))


def _material(name: str, values: dict[str, object]) -> bpy.types.Material:
    material = bpy.data.materials.new(name)
    if material.node_tree is None:
        material.use_nodes = True
    for socket, value in values.items():
        material.node_tree.nodes["Principled BSDF"].inputs[socket].default_value = value
    return material


def _add_camera() -> None:
    scene = bpy.context.scene
    camera = bpy.data.objects.new("Camera", bpy.data.cameras.new("Camera"))
    scene.collection.objects.link(camera)
    camera.location, camera.rotation_euler = (0.0, -7.2, 2.0), (math.radians(82.0), 0.0, 0.0)
    scene.camera = camera
    scene.render.resolution_x, scene.render.resolution_y = 960, 540


def _add_world(name: str) -> None:
    world = bpy.data.worlds.new("World")
    bpy.context.scene.world = world
    if world.node_tree is None:
        world.use_nodes = True
    picture = world.node_tree.nodes.new("ShaderNodeTexEnvironment")
    folder = Path(bpy.utils.resource_path("LOCAL")) / "datafiles" / "studiolights" / "world"
    picture.image = bpy.data.images.load(str(folder / f"{name}.exr"))
    world.node_tree.links.new(picture.outputs[0], world.node_tree.nodes["Background"].inputs[0])


def command(*arguments: object) -> None:
    """One `prt` command; the end of the program where it fails."""
    if subprocess.run([sys.executable, ROOT / "tools" / "prt.py", *map(str, arguments)], check=False).returncode:
        sys.exit(1)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--preset", default="standard")
    parser.add_argument("--world", default="forest")
    parser.add_argument("--turns", default="0,140", help="degrees, one picture each")
    parser.add_argument("--out", type=Path, default=ROOT / "build" / "buddhas")
    arguments = parser.parse_args()
    folder = arguments.out.absolute()
    folder.mkdir(parents=True, exist_ok=True)
    scene, baked = folder / "buddhas.blend", folder / "buddhas_baked.blend"
    build(scene, arguments.world)
    command("bake", "--input", scene, "--output", baked, "--preset", arguments.preset, "--report",
            folder / "buddhas.json")
    for turn in arguments.turns.split(","):
        command("preview", "--input", baked, "--output", folder / f"buddhas_{turn}.png", "--rotate", turn)


if __name__ == "__main__":
    main()
