# SPDX-License-Identifier: GPL-3.0-or-later
"""Local light clouds in the scenes of Kristensen et al. 2005, beside their Table 1 and against Cycles. Needs the bpy
wheel.

    python benchmarks/local_lights.py [--scenes cornell,hole,bunny,maze] [--positions 20] [--samples 256] [--set ...]

Light moves to held-back random positions; indirect light there is compared with Cycles' own vertex bake of indirect
light, as a relative RMS over vertices and channels, of which the mean square over positions is taken (so that no
position counts more for being near a surface, where all is brighter). Cycles is baked twice with other seeds; the mean
of (ours - a)(ours - b) is the squared error without Cycles' own noise. Columns: `solver`, our solution at the very
position (rays of the operator); `cloud`, what interpolation and merging add to it; `compression`; all of it.
"""

from __future__ import annotations

import argparse
import os
import time
from dataclasses import dataclass, replace

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as in the bake's process; before numpy loads

import bpy
import local_scenes
import numpy as np
from common import drain, print_table
from numpy.typing import NDArray

from prt_addon.baking.recipe import _Bake, transport_settings
from prt_addon.baking.settings import BakeSettings, make_settings
from prt_addon.blender.read_scene import read_objects
from prt_addon.lighting.light_cloud import box_matrix
from prt_addon.lighting.light_visibility import surroundings
from prt_addon.lighting.local_lights import LocalLight
from prt_addon.relighting.exit_radiance import cluster_constants, exit_radiance
from prt_addon.relighting.lamp_light import LampLight, SurfaceLamps, lamps_in
from prt_addon.relighting.scene_light import joined_light
from prt_addon.scene.scene_mesh import SceneMesh
from prt_addon.storage.container import BakedTransfer
from prt_addon.tracing.tracer import Tracer
from prt_addon.transport.buried import past_buried
from prt_addon.transport.local_lights import LightSolver
from tests.blender.cycles import use_cycles, vertex_radiance

PAPER = {"cornell": "4k, 8 zones, 216 -> 53, 30 clusters x 12, 58 fps", "hole": "5k, 10, 250 -> 49, 18 x 12, 55 fps",
         "bunny": "11k, 11, 125, 22 x 16, 7 fps", "maze": "43k, 16, 1024 -> 128, 191 x 16, 7 fps"}
LIGHTS = {"cornell": 216, "hole": 250, "bunny": 125, "maze": 1024}
POWER = 4.0 * np.pi  # watts of a Point light of 1 W/sr


@dataclass
class Kept:
    """What a bake keeps for the comparison: its solver, its scene and its transfer before compression."""

    baked: BakedTransfer
    solver: LightSolver
    scene: SceneMesh
    transfer: NDArray[np.float32]
    report: dict
    seconds: float
    visible: NDArray[np.int64]  # receivers of the object that do not lie inside bodies


class _KeepingBake(_Bake):
    """A bake that keeps its operator."""

    def _local(self, gathered, visibility):  # noqa: ANN001, ANN202
        matrix = past_buried(gathered.matrix, gathered.receivers.key, self.scene, self.buried)
        self.kept_gather = replace(gathered, matrix=matrix)
        self.kept_local = yield from super()._local(gathered, visibility)
        return self.kept_local


def baked(thing: bpy.types.Object, box: NDArray[np.float64], settings: BakeSettings, spacing: float = 0.0) -> Kept:
    """Bake the object's vertices as they are."""
    scene = SceneMesh.assemble(read_objects(bpy.context.evaluated_depsgraph_get(), [thing.name], []), spacing)
    started = time.perf_counter()
    bake = _KeepingBake(scene, transport_settings(settings), None, None, {}, np.array([box_matrix(*box)]))
    result = drain(bake.run())
    seconds = time.perf_counter() - started
    point = bake.kept_gather.receivers.key % len(scene.points)
    albedo = bake.albedo[point][:, :bake.plan.needs.channels]
    solver = LightSolver(bake.tracer, scene, bake.kept_gather, albedo, 1e-4, -1)
    place = next(o.points for o in scene.objects if o.is_target)
    visible = bake.open_keys[(bake.open_keys >= place.start) & (bake.open_keys < place.stop)] - place.start
    return Kept(next(iter(result.objects.values())), solver, scene, bake.kept_local.transfer[place], result.report,
                seconds, visible)


def held_back(tracer: Tracer, box: NDArray[np.float64], count: int, clearance: float) -> NDArray[np.float64]:
    """Random places of the box, out of bodies and clear of surfaces."""
    generator = np.random.default_rng(5)
    places = generator.uniform(box[0], box[1], (50 * count, 3))
    around = surroundings(tracer, places)
    return places[~around.inside & (around.clearance > clearance)][:count]


def ours(kept: Kept, lamp: LampLight | SurfaceLamps, position: NDArray[np.float64]) -> tuple[NDArray[np.float64], ...]:
    """Indirect radiance (v, 3), unit albedo: solved at the very position, by the cloud, and by the compressed cloud."""
    exact = np.zeros((len(kept.baked.cluster), 3))
    rows = np.full(len(kept.scene.points), -1)
    front = kept.solver.gathered.receivers.key < len(rows)
    rows[kept.solver.gathered.receivers.key[front]] = np.flatnonzero(front)
    place = next(o.points for o in kept.scene.objects if o.is_target)

    def take(_: slice, response: NDArray[np.float32]) -> None:
        exact[:] = response[rows[place], 0]

    drain(kept.solver.solve(position[None], take))
    matrix = np.eye(4)
    matrix[:3, 3] = position
    light = lamp.step([LocalLight("lamp", "point", matrix, np.full(3, POWER))]).values
    zone = kept.baked.cluster_zone[kept.baked.cluster]
    cloud = np.einsum("pjc,pjc->pc", *np.broadcast_arrays(kept.transfer, light[zone].astype(np.float64)))
    constants = cluster_constants(kept.baked.bases, joined_light(kept.baked.lighting_basis, None, light),
                                  kept.baked.cluster_zone)
    drawn = exit_radiance(kept.baked.cluster, kept.baked.weights, constants)[:, 0]
    return exact, cloud, drawn.astype(np.float64)


def run(name: str, arguments: argparse.Namespace) -> list:
    """One scene's line of the table."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    thing, box = local_scenes.SCENES[name]()
    use_cycles(arguments.samples)
    bpy.context.scene.render.threads = 2
    overrides = {"lighting": "local", "cloud_lights": str(LIGHTS[name]), "cloud_emission": "1"}
    settings = make_settings(arguments.preset, overrides | dict(s.split("=", 1) for s in arguments.set))
    kept = baked(thing, box, settings)
    lamp = lamps_in(kept.baked.cloud, kept.solver.tracer)
    volume = np.prod(box[1] - box[0])
    spacing = (volume / int(settings.cloud_lights)) ** (1.0 / 3.0)
    places = held_back(kept.solver.tracer, box, arguments.positions, arguments.clearance * spacing)
    data = bpy.data.lights.new("Lamp", "POINT")
    data.energy, data.shadow_soft_size = POWER, 0.0
    source = bpy.data.objects.new("Lamp", data)
    bpy.context.scene.collection.objects.link(source)
    sums = np.zeros((4, 2))
    clear = surroundings(kept.solver.tracer, places).clearance
    for position, distance in zip(places, clear, strict=True):
        source.location = position
        solved, cloud, drawn = (light[kept.visible] for light in ours(kept, lamp, position))
        first, second = (vertex_radiance(thing, {"INDIRECT"}, seed)[kept.visible] for seed in (0, 1))
        power = np.sum(first * second)
        found = np.array([np.sum((solved - first) * (solved - second)), np.sum((cloud - solved) ** 2),
                          np.sum((drawn - cloud) ** 2), np.sum((drawn - first) * (drawn - second))]) / power
        print(position.round(2), f"clear by {distance:.2f} m:", *(100.0 * np.sqrt(np.maximum(found, 0.0))).round(1),
              flush=True)
        sums += np.stack([found, np.ones(4)], axis=1)
    errors = 100.0 * np.sqrt(np.maximum(sums[:, 0], 0.0) / sums[:, 1])
    local, clusters = kept.report["local"], kept.report["clusters"]
    lights = [1, local["patches"], local["columns"]] if settings.lamp_basis == "surfaces" else [
        local["zones"], local["lights"], float(np.mean(local["merged"]))]
    return [name, settings.lamp_basis, len(thing.data.polygons) * 2, *lights,
            clusters["count"], clusters["vectors_mean"], kept.seconds, *errors, PAPER[name]]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", default="cornell,hole,bunny,maze")
    parser.add_argument("--positions", type=int, default=20)
    parser.add_argument("--samples", type=int, default=256)
    parser.add_argument("--clearance", type=float, default=0.5,
                        help="least distance of lights from surfaces, in spacings of the cloud")
    parser.add_argument("--preset", default="standard")
    parser.add_argument("--set", action="append", default=[], metavar="NAME=VALUE")
    arguments = parser.parse_args()
    rows = []
    for name in arguments.scenes.split(","):
        rows.append(run(name, arguments))
        print(rows[-1], flush=True)
    print_table(["scene", "columns of", "triangles", "zones", "lights / patches", "merged / columns",
                 "clusters", "vectors, mean", "bake s",
                 "solver %", "cloud %", "compression %", "all %", "paper: triangles, zones, lights, clusters, fps"],
                rows)


if __name__ == "__main__":
    main()
