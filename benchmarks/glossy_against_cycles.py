# SPDX-License-Identifier: GPL-3.0-or-later
"""Radiance towards a camera of Principled materials against Cycles, per roughness. Needs the bpy wheel.

    python benchmarks/glossy_against_cycles.py [--mesh spot.obj] [--samples 64] [--worlds smooth,sunset]
        [--roughness 0.3,0.5,0.8] [--metallic 0,1] [--preset high] [--set name=value,name=value]

For instance --set distant_basis=cubemap,cubemap_size=16.

Relative RMS over the vertices that face the camera and channels, Cycles' own noise taken out by two bakes with other
seeds. `order` is what light and rows of the bake's order can't hold of the highlight (choose_rows' estimate for small
lights, as a relative RMS); a smooth world asks for less. `furnace`: mean radiance in a white world, minus 1, for white
metal.
"""

from __future__ import annotations

import argparse
import os
import tempfile

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as in the bake's process; before numpy loads

import bpy
import numpy as np
from against_cycles import light_image, load, use_world
from common import print_table
from numpy.typing import NDArray

from prt_addon.baking.recipe import bake, exhaust
from prt_addon.baking.settings import make_settings, parse_overrides
from prt_addon.baking.surfaces import INCIDENT_ORDER, plan_surfaces
from prt_addon.blender.read_scene import read_objects
from prt_addon.lighting.cubemap_light import environment_texels
from prt_addon.lighting.environment import project, world_rotation
from prt_addon.lighting.reference_light import ReferenceLight
from prt_addon.relighting.exit_radiance import view_radiance
from prt_addon.scene.scene_mesh import SceneMesh
from prt_addon.storage.container import BakedTransfer
from prt_addon.transport.brdf import explained
from tests.blender.cycles import ALL_LIGHT, shown_radiance, use_cycles

COLOUR = (0.8, 0.55, 0.3, 1.0)


def principled(roughness: float, metallic: float, colour: tuple[float, ...]) -> bpy.types.Material:
    """A material of one Principled BSDF."""
    material = bpy.data.materials.new("Principled")
    if material.node_tree is None:
        material.use_nodes = True
    node = material.node_tree.nodes["Principled BSDF"]
    node.inputs["Base Color"].default_value = colour
    node.inputs["Roughness"].default_value, node.inputs["Metallic"].default_value = roughness, metallic
    return material


def add_camera(thing: bpy.types.Object) -> NDArray[np.float64]:
    """A camera in front of the object; its place (3,)."""
    corners = np.array([thing.matrix_world @ v.co for v in thing.data.vertices])
    centre, size = corners.mean(axis=0), np.linalg.norm(np.ptp(corners, axis=0))
    place = centre + size * np.array([0.9, -1.4, 0.6])
    camera = bpy.data.objects.new("Camera", bpy.data.cameras.new("Camera"))
    bpy.context.scene.collection.objects.link(camera)
    camera.location = place
    bpy.context.scene.camera = camera
    bpy.context.view_layer.update()
    return place


def baked(thing: bpy.types.Object, preset: str, overrides: str, image: NDArray[np.float32],
          ) -> tuple[BakedTransfer, SceneMesh, dict]:
    """A bake of the object with every highlight."""
    mesh = SceneMesh.assemble(read_objects(bpy.context.evaluated_depsgraph_get(), [thing.name]), 0.0)
    settings = make_settings(preset, {"glossy_albedo": "0", "error_receivers": "0"} | parse_overrides(overrides))
    result = exhaust(bake(mesh, settings, light=ReferenceLight.of(image, None, [], "the world image")))
    return next(iter(result.objects.values())), mesh, result.report


def in_columns(container: BakedTransfer, image: NDArray[np.float32], rotation: NDArray[np.float64],
               ) -> NDArray[np.float64]:
    """The light of an image in the columns of a bake."""
    basis = container.lighting_basis
    if basis.cubemap:
        return environment_texels(image, basis.cubemap, rotation)
    return project(image, basis.order, rotation)


def towards(container: BakedTransfer, light: NDArray[np.float64], place: NDArray[np.float64], count: int,
            ) -> NDArray[np.float64]:
    """Radiance (count, 3) of the mesh's vertices towards the camera."""
    return view_radiance(container, light, place - container.positions)[:count].astype(np.float64)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--mesh", default="spot.obj")
    parser.add_argument("--samples", type=int, default=64)
    parser.add_argument("--worlds", default="smooth,sunset")
    parser.add_argument("--roughness", default="0.3,0.5,0.8")
    parser.add_argument("--metallic", default="0,1")
    parser.add_argument("--preset", default="high")
    parser.add_argument("--set", default="", dest="overrides")
    arguments = parser.parse_args()
    thing = load(arguments.mesh)
    place = add_camera(thing)
    use_cycles(arguments.samples)
    bpy.context.scene.render.threads = 2
    count, rows = len(thing.data.vertices), []
    images = {world: light_image(world) for world in arguments.worlds.split(",")}
    with tempfile.TemporaryDirectory() as folder:
        for metallic in map(float, arguments.metallic.split(",")):
            for roughness in map(float, arguments.roughness.split(",")):
                thing.data.materials[0] = principled(roughness, metallic, COLOUR)
                container, mesh, report = baked(thing, arguments.preset, arguments.overrides,
                                                 next(iter(images.values())))
                seconds = report["seconds"]
                facing = np.flatnonzero(np.sum(container.normals * (place - container.positions), axis=1)[:count] > 0.0)
                order = container.lighting_basis.order or INCIDENT_ORDER
                held = explained(mesh.materials[-1], np.array(container.functions), order) if container.functions else 0
                for world, image in images.items():
                    use_world(image, 0.0, folder)
                    first, second = (shown_radiance(thing, ALL_LIGHT, facing, seed) for seed in (0, 1))
                    light = in_columns(container, image, world_rotation(0.0))
                    ours = towards(container, light, place, count)[facing]
                    power = np.sum(first * second)
                    error = np.sqrt(max(np.sum((ours - first) * (ours - second)) / power, 0.0))
                    rows.append([metallic, roughness, world, len(container.functions), 100 * error,
                                 100 * (ours.sum() / (0.5 * (first + second)).sum() - 1), 100 * (1 - held) ** 0.5,
                                 100 * np.sqrt(np.sum((first - second) ** 2) / 2 / power), seconds,
                                 container.bases.nbytes / 1e6])
                    print(rows[-1], flush=True)
    print_table(["metallic", "roughness", "world", "functions", "error %", "mean difference %",
                 "order (small lights) %", "Cycles' noise (removed) %", "bake s", "bases MB"],
                rows)
    furnace(thing, arguments, place)


def furnace(thing: bpy.types.Object, arguments: argparse.Namespace, place: NDArray[np.float64]) -> None:
    """A white metal ball in a white world."""
    bpy.ops.mesh.primitive_uv_sphere_add(segments=64, ring_count=32)
    ball = bpy.context.object
    bpy.ops.object.shade_smooth()
    bpy.data.objects.remove(thing)
    ball.data.materials.append(None)
    rows = []
    for roughness in map(float, arguments.roughness.split(",")):
        ball.data.materials[0] = principled(roughness, 1.0, (1.0, 1.0, 1.0, 1.0))
        white = np.ones((8, 16, 3), np.float32)
        container, mesh, _ = baked(ball, arguments.preset, arguments.overrides, white)
        light = in_columns(container, white, np.eye(3))
        shown = []
        for angle in np.radians([0.0, 30.0, 60.0, 80.0]):
            views = np.cos(angle) * container.normals + np.sin(angle) * container.tangents
            shown.append(100 * (float(view_radiance(container, light, views).mean()) - 1.0))
        rows.append([roughness, plan_surfaces(mesh, make_settings(arguments.preset)).hints, *shown])
    print_table(["roughness", "rows", "furnace at 0 degrees %", "30", "60", "80"], rows)


if __name__ == "__main__":
    main()
