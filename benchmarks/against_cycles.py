# SPDX-License-Identifier: GPL-3.0-or-later
"""Per-vertex radiance against Cycles on real meshes under Blender's own world images, and 100 relightings against 100
Cycles bakes. Needs the bpy wheel.

    python benchmarks/against_cycles.py accuracy [--mesh spot.obj] [--samples 64] [--worlds forest,city] [--preset high]
    python benchmarks/against_cycles.py speed [--mesh spot.obj] [--lights 100]

accuracy: relative RMS over (at most --vertices random) vertices and channels, direct and with bounces, at two
rotations, against what Cycles shows around them (tests/blender/cycles.shown_radiance says why not its bake of the
vertices). Cycles is baked twice with other seeds; the mean of (ours - a)(ours - b) is the squared error without Cycles'
own noise. `truncation` is what the order of the lighting leaves out, measured by the bake's own error budget under the
same light.
"""

from __future__ import annotations

import argparse
import os
import tempfile
import time
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as in the bake's process; before numpy loads

import bpy
import numpy as np
from common import mesh_path, print_table
from numpy.typing import NDArray

from prt_addon.baking.recipe import BakeResult, bake, exhaust
from prt_addon.baking.settings import make_settings
from prt_addon.blender.read_scene import read_objects
from prt_addon.lighting.environment import load_equirectangular, project, world_rotation
from prt_addon.lighting.reference_light import ReferenceLight
from prt_addon.relighting.exit_radiance import cluster_constants, exit_radiance
from prt_addon.scene.scene_mesh import SceneMesh
from tests.blender.cycles import (
    diffuse_material,
    environment_world,
    shown_radiance,
    smooth_environment,
    use_cycles,
    vertex_radiance,
)

ALBEDO = (0.7, 0.5, 0.3, 1.0)


def load(name: str) -> bpy.types.Object:
    """The only object of an empty file: the smooth-shaded mesh with one coloured diffuse material."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    importer = bpy.ops.wm.obj_import if name.endswith("obj") else bpy.ops.wm.ply_import
    importer(filepath=str(mesh_path(name)))
    thing = bpy.context.selected_objects[0]
    bpy.context.view_layer.objects.active = thing
    bpy.ops.object.mode_set(mode="EDIT")  # the horse is wound inwards, and Cycles takes it at its word
    bpy.ops.mesh.select_all(action="SELECT")
    bpy.ops.mesh.normals_make_consistent(inside=False)
    bpy.ops.object.mode_set(mode="OBJECT")
    bpy.ops.object.shade_smooth()
    thing.data.materials.clear()
    thing.data.materials.append(diffuse_material("Diffuse", ALBEDO))
    return thing


def light_image(world: str) -> NDArray[np.float32]:
    """The smooth environment of the tests, or one of Blender's world images by name."""
    if world == "smooth":
        return smooth_environment()
    folder = Path(bpy.utils.resource_path("LOCAL")) / "datafiles" / "studiolights" / "world"
    return load_equirectangular(folder / f"{world}.exr")


def use_world(image: NDArray[np.float32], degrees: float, folder: str) -> None:
    """Light the scene; a fixed sampling map saves Cycles seconds per bake. It must be finer than the image: else
    the rim of a sun is hit by chance alone, hardly ever; with a map as wide as the image three pixels lost a tenth.

    A light without a sun needs none: see `shown_radiance`.
    """
    world = environment_world(image, degrees, folder)
    world.cycles.sampling_method, world.cycles.sample_map_resolution = "MANUAL", 2 * image.shape[1]
    if image.max() < 100.0 * image.mean():
        world.cycles.sampling_method = "NONE"


def baked(thing: bpy.types.Object, preset: str, bounces: int, image: NDArray[np.float32], **settings: str,
          ) -> BakeResult:
    """A bake of the object's vertices as they are."""
    mesh = SceneMesh.assemble(read_objects(bpy.context.evaluated_depsgraph_get(), [thing.name]), 0.0)
    made = make_settings(preset, {"bounces": str(bounces), **settings})
    return exhaust(bake(mesh, made, light=ReferenceLight.of(image, None, [], "the world image")))


def relit(result: BakeResult, image: NDArray[np.float32], degrees: float, count: int) -> NDArray[np.float64]:
    """Unit-albedo radiance (count, 3) of the first receivers (the mesh's vertices)."""
    container = next(iter(result.objects.values()))
    light = project(image, container.header["columns"]["order"], world_rotation(degrees))
    constants = cluster_constants(container.bases, light)
    return exit_radiance(container.cluster, container.weights, constants)[:count, 0].astype(np.float64)


def accuracy(arguments: argparse.Namespace) -> None:
    thing = load(arguments.mesh)
    use_cycles(arguments.samples)
    bpy.context.scene.render.threads = 2
    count = len(thing.data.vertices)
    chosen = np.sort(np.random.default_rng(0).permutation(count)[:arguments.vertices])
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        for world in arguments.worlds.split(","):
            image = light_image(world)
            for passes, bounces in (({"DIRECT"}, 0), ({"DIRECT", "INDIRECT"}, -1)):
                result = baked(thing, arguments.preset, bounces, image)
                errors = {name: entry["relative_rms"] for name, entry in result.report["errors"].items()}
                for degrees in (0.0, 130.0):
                    use_world(image, degrees, folder)
                    first, second = (shown_radiance(thing, passes, chosen, seed) for seed in (0, 1))
                    ours = relit(result, image, degrees, count)[chosen]
                    power = np.sum(first * second)
                    error = np.sqrt(max(np.sum((ours - first) * (ours - second)) / power, 0.0))
                    noise = np.sqrt(np.sum((first - second) ** 2) / 2.0 / power)
                    rows.append([world, "+".join(sorted(passes)).lower(), degrees, 100 * error, 100 * errors["basis"],
                                 100 * errors["sampling"], 100 * errors["compression"], 100 * noise])
                    print(rows[-1], flush=True)
    print_table(["world", "light", "turned", "error against Cycles %", "truncation %", "sampling %", "compression %",
                 "Cycles' noise (removed) %"], rows)


def speed(arguments: argparse.Namespace) -> None:
    """Our bake and `lights` relightings against as many Cycles bakes. Their noise falls with the root of their time, so
    the time that they would take to our error follows from the time and noise measured. Our error is against what
    Cycles shows around the vertices; the bake doesn't measure it once more itself."""
    thing = load(arguments.mesh)
    image = smooth_environment()
    count = len(thing.data.vertices)
    chosen = np.sort(np.random.default_rng(0).permutation(count)[:arguments.vertices])
    with tempfile.TemporaryDirectory() as folder:
        use_cycles(arguments.samples)
        bpy.context.scene.render.threads = 2
        use_world(image, 0.0, folder)
        started = time.perf_counter()
        first = vertex_radiance(thing, {"DIRECT", "INDIRECT"}, 0)
        cycles = time.perf_counter() - started
        second = vertex_radiance(thing, {"DIRECT", "INDIRECT"}, 1)
        shown = [shown_radiance(thing, {"DIRECT", "INDIRECT"}, chosen, seed) for seed in (0, 1)]
    noise = np.sqrt(np.sum((first - second) ** 2) / 2.0 / np.sum(first * second))
    started = time.perf_counter()
    result = baked(thing, arguments.preset, -1, image, error_receivers="0")
    ours_bake = time.perf_counter() - started
    started = time.perf_counter()
    for index in range(arguments.lights):
        ours = relit(result, image, 3.6 * index, count)
    relights = time.perf_counter() - started
    ours = relit(result, image, 0.0, count)[chosen]
    error = np.sqrt(max(np.sum((ours - shown[0]) * (ours - shown[1])) / np.sum(shown[0] * shown[1]), 0.0))
    theirs = cycles * arguments.lights
    equal = theirs * (noise / error) ** 2
    print_table(["vertices", "our error %", "Cycles' error %", "our bake s", f"{arguments.lights} relightings s",
                 "Cycles, one light s", "Cycles, all s", "Cycles, all, at our error s", "times faster (floor 100)"],
                [[count, 100 * error, 100 * noise, ours_bake, relights, cycles, theirs, equal,
                  equal / (ours_bake + relights)]])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("accuracy", "speed"))
    parser.add_argument("--mesh", default="spot.obj")
    parser.add_argument("--samples", type=int, default=256)
    parser.add_argument("--worlds", default="smooth,forest,city,sunset")
    parser.add_argument("--preset", default="high")
    parser.add_argument("--vertices", type=int, default=3000)
    parser.add_argument("--lights", type=int, default=100)
    arguments = parser.parse_args()
    {"accuracy": accuracy, "speed": speed}[arguments.what](arguments)


if __name__ == "__main__":
    main()
