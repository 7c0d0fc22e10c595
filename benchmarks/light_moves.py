# SPDX-License-Identifier: GPL-3.0-or-later
"""Milliseconds per move of 1, 4 and 16 lamps in a baked Cornell box of about 50,000 vertices. Needs the bpy wheel and a
graphics driver (Mesa's software driver serves).

    python benchmarks/light_moves.py [--spacing 0.0125] [--lights 216]

cloud: kd-tree, shadow rays between lamp and lights, weights; direct: exact direct light, one ray per receiver and hard
lamp; constants: the light meets the clusters' bases; upload and light: constants to the GPU, exit radiance of every
point, direct light to the GPU; draw: a frame of 1280x720, read back.
"""

from __future__ import annotations

import argparse
import os
import sys
import types

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as in Blender's process; before numpy loads

import bpy
import local_scenes
import numpy as np
from common import ROOT, best_of, drain, print_table

from prt_addon.baking.recipe import bake
from prt_addon.baking.settings import make_settings
from prt_addon.blender.read_scene import read_objects
from prt_addon.lighting.light_cloud import box_matrix
from prt_addon.lighting.local_lights import LocalLight
from prt_addon.relighting.exit_radiance import cluster_constants
from prt_addon.relighting.lamp_light import DirectLight, lamps_in
from prt_addon.relighting.scene_light import joined_light
from prt_addon.scene.scene_mesh import SceneMesh
from prt_addon.tracing.tracer import Tracer

SIZE = (1280, 720)


def lamps(count: int, box: np.ndarray, seed: int) -> list[LocalLight]:
    """Hard Point lights at random places of a box."""
    generator = np.random.default_rng(seed)
    made = []
    for number in range(count):
        matrix = np.eye(4)
        matrix[:3, 3] = generator.uniform(box[0] + 0.1, box[1] - 0.1)
        made.append(LocalLight(f"lamp {number}", "point", matrix, np.full(3, 10.0), key=str(number)))
    return made


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--spacing", type=float, default=0.0125)
    parser.add_argument("--lights", type=int, default=216)
    parser.add_argument("--basis", choices=("surfaces", "cloud"), default="surfaces")
    arguments = parser.parse_args()
    bpy.ops.wm.read_factory_settings(use_empty=True)
    thing, box = local_scenes.cornell()
    scene = SceneMesh.assemble(read_objects(bpy.context.evaluated_depsgraph_get(), [thing.name], []), arguments.spacing)
    settings = make_settings("standard", {"lighting": "local", "cloud_lights": str(arguments.lights),
                                          "cloud_emission": "1", "lamp_basis": arguments.basis,
                                          "gather_directions": "64", "error_receivers": "0"})
    baked = drain(bake(scene, settings, regions=np.array([box_matrix(*box)]))).objects[thing.name]
    tracer = Tracer(scene.points, scene.triangles, threads=1)  # as in Blender's own process
    package = types.ModuleType("prt")  # gpu_shaders imports the core relatively, as in the installed extension
    package.__path__ = [str(ROOT)]
    sys.modules["prt"] = package
    from prt.gpu_shaders import draw, offscreen, render_data

    offscreen.prepare_gpu()
    print(f"{len(baked.cluster)} receivers, {baked.bases.shape[0]} clusters of at most {baked.bases.shape[1] - 1} "
          f"vectors, {baked.cloud.zones} zones, at most {baked.cloud.columns} columns in each")
    cloud, direct = lamps_in(baked.cloud, tracer), DirectLight(tracer, baked)
    transform = np.diag([0.4, 0.4, -0.4, 1.0])
    rows = []
    with offscreen._offscreen(*SIZE) as target:
        drawing = draw.ObjectDrawing(render_data.make_render_data(baked))
        for count in (1, 4, 16):
            some = lamps(count, box, count)


            def moved(of, some=some):  # noqa: ANN001, ANN202
                of([])  # forgets what it knows of lamps that stay
                return of(some)

            step, found = best_of(5, lambda: moved(cloud.step))
            straight, values = best_of(5, lambda: moved(direct.of))
            light = joined_light(baked.lighting_basis, None, found.values)
            product, constants = best_of(5, lambda light=light: cluster_constants(baked.bases, light,
                                                                                   baked.cluster_zone))

            def upload(constants=constants, values=values):  # noqa: ANN001, ANN202
                drawing.relight(constants)
                drawing.add_direct(values.copy())
                drawing.exit_radiances()  # waits for the GPU

            def frame():  # noqa: ANN202
                drawing.draw(transform)
                draw.read_texture(target.texture_color)

            uploaded, _ = best_of(5, upload)
            drawn, _ = best_of(5, frame)
            parts = [step, straight, product, uploaded, drawn]
            rows.append([count, *(1e3 * part for part in parts), 1e3 * sum(parts)])
    print_table(["lamps", "cloud ms", "direct ms", "constants ms", "upload and light ms", "draw ms", "all ms"], rows)


if __name__ == "__main__":
    main()
