# SPDX-License-Identifier: GPL-3.0-or-later
"""Local light clouds in the scenes of Kristensen et al. 2005, beside their Table 1 and against Cycles. Needs the bpy
wheel.

    python benchmarks/local_lights.py [--scenes cornell,hole,bunny,maze,dense,densest] [--positions 20]
                                      [--samples 64] [--bases cloud,surfaces] [--docs] [--set NAME=VALUE ...]

A lamp moves to held-back random places, half a spacing of the cloud or more from surfaces; indirect light there is
compared with Cycles' own vertex bake of indirect light (of the glossy bunny: what it sends of it to a camera), as a
relative RMS over vertices and channels, of which the mean square over places is taken. Cycles is baked twice with other
seeds; the mean of (ours - a)(ours - b) is the squared error without Cycles' own noise, which is a column of its own
(of one bake). Columns: `solver`, our solution at the very place (rays of the operator); `cloud`, what interpolation and
merging add to it; `compression`; `all` of it; `open`, of places a spacing from surfaces and half of one within the
cloud's box. `move ms`: weights and constants of the clusters; `frame ms`: with direct light and every vertex on the
processor, one thread, nothing drawn. `dense`, `densest`: the Cornell box under more lights, merging less.
"""

from __future__ import annotations

import argparse
import json
import os
import time
from dataclasses import dataclass, replace
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as in the bake's process; before numpy loads

import bpy
import local_scenes
import numpy as np
from common import ROOT, best_of, drain, markdown_table, write_block
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from prt_addon.baking.recipe import _Bake, transport_settings
from prt_addon.baking.settings import BakeSettings, make_settings
from prt_addon.blender.read_scene import read_objects
from prt_addon.lighting.light_cloud import box_matrix
from prt_addon.lighting.light_visibility import surroundings
from prt_addon.lighting.local_lights import LocalLight
from prt_addon.linear_algebra import multiply
from prt_addon.relighting.exit_radiance import (
    cluster_constants,
    combine_rows,
    exit_radiance,
    hemisphere_values,
    local_views,
)
from prt_addon.relighting.lamp_light import DirectLight, LampLight, SurfaceLamps, lamps_in
from prt_addon.relighting.scene_light import joined_light
from prt_addon.scene.scene_mesh import SceneMesh
from prt_addon.storage.container import BakedTransfer
from prt_addon.tracing.tracer import Tracer
from prt_addon.transport.buried import past_buried
from prt_addon.transport.local_lights import LightSolver
from tests.blender.cycles import use_cycles, vertex_radiance

# Table 1: triangles, zones, lights, merged lights, clusters, vectors, hours of light transport + compression, fps.
PAPER = {"cornell": ["4k", 8, 216, 53, 30, 12, "2 + 1 h", 58], "hole": ["5k", 10, 250, 49, 18, 12, "3 + 2 h", 55],
         "bunny": ["11k", 11, 125, 125, 22, 16, "6 h", 7], "maze": ["43k", 16, 1024, 128, 191, 16, "6 + 3 h", 7]}
# Lights as the paper's; receivers of a zone such that there are about as many zones.
SETTINGS = {"cornell": {"cloud_lights": "216", "zone_receivers": "400"},
            "hole": {"cloud_lights": "250", "zone_receivers": "400"},
            "bunny": {"cloud_lights": "125", "zone_receivers": "1200", "glossy_rows": "16"},
            "maze": {"cloud_lights": "1024", "zone_receivers": "2000", "clusters": "192"},
            "dense": {"cloud_lights": "512", "zone_receivers": "400", "merge_response": "0.02"},
            "densest": {"cloud_lights": "2048", "zone_receivers": "400", "merge_response": "0.01", "vectors": "16"}}
# Spacing by which places are chosen where it is not the cloud's: the Cornell box under more lights keeps its places.
PLACES = {"dense": 1.0 / 3.0, "densest": 1.0 / 3.0}
ALL_SCENES = {"lighting": "local", "cloud_emission": "1", "clusters": "64", "vectors": "12", "encoder": "adaptive",
              "gather_directions": "2048", "error_receivers": "0"}
# Indirect light that a camera sees.
SEEN = {"INDIRECT", "DIFFUSE", "GLOSSY"}
POWER = 4.0 * np.pi  # watts of a Point light of 1 W/sr


@dataclass
class Kept:
    """What a bake keeps for the comparison: its solver, its scene and its transfer before compression."""

    baked: BakedTransfer
    solver: LightSolver
    scene: SceneMesh
    transfer: NDArray[np.float32]  # (points, rows, columns, channels)
    report: dict
    seconds: float
    visible: NDArray[np.int64]  # receivers of the object that do not lie inside bodies


class _KeepingBake(_Bake):
    """A bake that keeps its operator."""

    def _local(self, gathered, visibility):  # noqa: ANN001, ANN202
        matrix = past_buried(gathered.matrix, gathered.receivers.key, self.scene, self.buried)
        self.kept_gather = replace(gathered, matrix=matrix)
        return (yield from super()._local(gathered, visibility))

    def _join_local(self, signals, local):  # noqa: ANN001, ANN202
        super()._join_local(signals, local)
        self.kept_signals = {name: signal / np.float32(self.local_scale) for name, signal in signals.items()}


def baked(thing: bpy.types.Object, box: NDArray[np.float64], settings: BakeSettings, spacing: float = 0.0,
          inside: NDArray[np.float64] | None = None) -> Kept:
    """Bake the object's vertices as they are. box: (2, 3), or (b, 2, 3), where the cloud is; inside: places (n, 3) in
    rooms that are closed all round."""
    objects = read_objects(bpy.context.evaluated_depsgraph_get(), [thing.name], [])
    scene = SceneMesh.assemble(objects, spacing, inside)
    started = time.perf_counter()
    regions = np.array([box_matrix(*corners) for corners in box.reshape(-1, 2, 3)])
    bake = _KeepingBake(scene, transport_settings(settings), None, None, {}, regions)
    result = drain(bake.run())
    seconds = time.perf_counter() - started
    point = bake.kept_gather.receivers.key % len(scene.points)
    albedo = bake.albedo[point][:, :bake.plan.needs.channels]
    solver = LightSolver(bake.tracer, scene, bake.kept_gather, albedo, 1e-4, -1)
    place = next(o.points for o in scene.objects if o.is_target)
    visible = bake.open_keys[(bake.open_keys >= place.start) & (bake.open_keys < place.stop)] - place.start
    return Kept(next(iter(result.objects.values())), solver, scene, bake.kept_signals[thing.name], result.report,
                seconds, visible)


def held_back(tracer: Tracer, box: NDArray[np.float64], count: int, clearance: float) -> NDArray[np.float64]:
    """Random places of the box, out of bodies and clear of surfaces."""
    generator = np.random.default_rng(5)
    places = generator.uniform(box[0], box[1], (50 * count, 3))
    around = surroundings(tracer, places)
    return places[~around.inside & (around.clearance > clearance)][:count]


def solved(kept: Kept, position: NDArray[np.float64]) -> NDArray[np.float64]:
    """Indirect radiance (v, 3), unit albedo, solved at the very position."""
    exact = np.zeros((len(kept.baked.cluster), 3))
    rows = np.full(len(kept.scene.points), -1)
    front = kept.solver.gathered.receivers.key < len(rows)
    rows[kept.solver.gathered.receivers.key[front]] = np.flatnonzero(front)
    place = next(o.points for o in kept.scene.objects if o.is_target)

    def take(_: slice, response: NDArray[np.float32]) -> None:
        exact[:] = response[rows[place], 0]

    drain(kept.solver.solve(position[None], take))
    return exact


def solved_towards(thing: bpy.types.Object, places: NDArray[np.float64], settings: BakeSettings,
                   views: NDArray[np.float64]) -> NDArray[np.float64]:
    """Indirect radiance (v, 3, places) towards views (v, 3), solved at the very places: a cloud of just these lights,
    one in each of as many small boxes, of which nothing merges."""
    corners = np.stack([places - 1e-5, places + 1e-5], axis=1)
    settings = replace(settings, lamp_basis="cloud", cloud_lights=len(places), merge_response=0.0, zone_receivers=0,
                       clusters=1, vectors=0)
    exact = baked(thing, corners, settings)
    distance, order = cKDTree(exact.baked.cloud.positions).query(places)
    if distance.max() > 1e-3:
        raise ValueError("a place got no light of its own")
    plain = exact.baked
    values = hemisphere_values(plain.functions, local_views(views, plain.normals, plain.tangents))
    return np.stack([combine_rows(np.broadcast_to(exact.transfer[:, :, light], (*exact.transfer.shape[:2], 3)),
                                  plain.albedo, values) for light in order], axis=2).astype(np.float64)


def point_lamp(position: NDArray[np.float64]) -> LocalLight:
    """An isotropic lamp of 1 W/sr."""
    matrix = np.eye(4)
    matrix[:3, 3] = position
    return LocalLight("lamp", "point", matrix, np.full(3, POWER))


def ours(kept: Kept, lamp: LampLight | SurfaceLamps, position: NDArray[np.float64]) -> tuple[NDArray[np.float64], ...]:
    """Indirect radiance (v, 3), unit albedo: solved at the very position, by the columns, and by these compressed."""
    return solved(kept, position), *of_columns(kept, lamp, position)


def of_columns(kept: Kept, lamp: LampLight | SurfaceLamps, position: NDArray[np.float64],
               views: NDArray[np.float64] | None = None) -> tuple[NDArray[np.float64], ...]:
    """Indirect radiance (v, 3) by the columns and by these compressed: for unit albedo, or towards views (v, 3)."""
    baked = kept.baked
    light = joined_light(baked.lighting_basis, None, lamp.step([point_lamp(position)]).values)
    zone = baked.cluster_zone[baked.cluster]
    channels = range(3) if kept.transfer.shape[3] == 3 else [0, 0, 0]
    before = np.empty((*kept.transfer.shape[:2], 3), np.float32)
    for number in np.unique(zone):
        inside = np.flatnonzero(zone == number)
        own = kept.transfer[inside]
        for to, channel in enumerate(channels):
            part = np.ascontiguousarray(own[..., channel]).reshape(-1, own.shape[2])
            before[inside, :, to] = multiply(part, light[number][:, to:to + 1]).reshape(len(inside), -1)
    after = exit_radiance(baked.cluster, baked.weights, cluster_constants(baked.bases, light, baked.cluster_zone))
    if views is None:
        return before[:, 0].astype(np.float64), after[:, 0].astype(np.float64)
    values = hemisphere_values(baked.functions, local_views(views, baked.normals, baked.tangents))
    return tuple(combine_rows(rows, baked.albedo, values).astype(np.float64) for rows in (before, after))


def add_camera(kept: Kept) -> NDArray[np.float64]:
    """A camera in front; views (v, 3) from the vertices, and which vertices face it is for the caller."""
    place = np.array([0.9, -3.5, 1.4])
    camera = bpy.data.objects.new("Camera", bpy.data.cameras.new("Camera"))
    bpy.context.scene.collection.objects.link(camera)
    camera.location = place
    bpy.context.scene.camera = camera
    bpy.context.view_layer.update()
    return place - kept.baked.positions


def milliseconds(kept: Kept, lamp: LampLight | SurfaceLamps, places: NDArray[np.float64]) -> list[float]:
    """Of a move of one lamp, and of a frame's light on the processor: the least of some runs, the mean over places."""
    baked, direct = kept.baked, DirectLight(kept.solver.tracer, kept.baked)

    def move(light: LocalLight) -> NDArray[np.float32]:
        lamp.step([])  # forgets what it knows of a lamp that stays
        values = joined_light(baked.lighting_basis, None, lamp.step([light]).values)
        return cluster_constants(baked.bases, values, baked.cluster_zone)

    lamps = [point_lamp(place) for place in places[:5]]
    moved = [best_of(5, lambda light=light: move(light)) for light in lamps]
    drawn = [best_of(3, lambda c=constants: exit_radiance(baked.cluster, baked.weights, c))[0]
             for _, constants in moved]
    lit = [best_of(3, lambda light=light: (direct.of([]), direct.of([light])))[0] for light in lamps]
    move_ms = 1e3 * float(np.mean([seconds for seconds, _ in moved]))
    return [move_ms, move_ms + 1e3 * float(np.mean(drawn) + np.mean(lit))]


def run(name: str, basis: str, arguments: argparse.Namespace) -> list:
    """A line of the table: one scene, one basis of lamps."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    thing, box = local_scenes.SCENES["cornell" if name in PLACES else name]()
    use_cycles(arguments.samples)
    bpy.context.scene.render.threads = 2
    overrides = ALL_SCENES | SETTINGS[name] | {"lamp_basis": basis} | dict(s.split("=", 1) for s in arguments.set)
    settings = make_settings(arguments.preset, overrides)
    kept = baked(thing, box, settings)
    lamp = lamps_in(kept.baked.cloud, kept.solver.tracer)
    # The cloud's, whatever the basis: the same places for both.
    spacing = PLACES.get(name, float(np.prod(box[1] - box[0]) / settings.cloud_lights) ** (1.0 / 3.0))
    places = held_back(kept.solver.tracer, box, arguments.positions, arguments.clearance * spacing)
    views, passes, chosen = None, {"INDIRECT"}, kept.visible
    if kept.baked.functions:
        views, passes = add_camera(kept), SEEN
        facing = np.sum(views * kept.baked.normals, axis=1) > 0.2 * np.sqrt(np.sum(views ** 2, axis=1))
        chosen = kept.visible[facing[kept.visible]]
    costs = milliseconds(kept, lamp, places)
    if views is not None:
        towards = solved_towards(thing, places, settings, views)[chosen]
    data = bpy.data.lights.new("Lamp", "POINT")
    data.energy, data.shadow_soft_size = POWER, 0.0
    source = bpy.data.objects.new("Lamp", data)
    bpy.context.scene.collection.objects.link(source)
    clear, found, started = surroundings(kept.solver.tracer, places).clearance, [], time.perf_counter()
    for number, (position, distance) in enumerate(zip(places, clear, strict=True)):
        source.location = position
        cloud, drawn = (light[chosen] for light in of_columns(kept, lamp, position, views))
        exact = towards[:, :, number] if views is not None else solved(kept, position)[chosen]
        first, second = (vertex_radiance(thing, passes, seed)[chosen] for seed in (0, 1))
        power = np.sum(first * second)
        found.append(np.array([np.sum((exact - first) * (exact - second)), np.sum((cloud - exact) ** 2),
                               np.sum((drawn - cloud) ** 2), np.sum((drawn - first) * (drawn - second)),
                               0.5 * np.sum((first - second) ** 2)]) / power)
        print(position.round(2), f"clear by {distance:.2f} m:", *_percent(found[-1]), flush=True)
    errors = _percent(np.mean(found, axis=0))
    far = (clear > spacing) & (np.minimum(places - box[0], box[1] - places).min(axis=1) > 0.5 * spacing)
    open_error = float(_percent(np.mean(np.array(found)[far], axis=0))[3]) if far.any() else ""
    print(f"{name}: Cycles took {time.perf_counter() - started:.0f} s; {far.sum()} of {len(far)} places in the open")
    local, clusters = kept.report["local"], kept.report["clusters"]
    triangles = sum(len(polygon.vertices) - 2 for thing in bpy.data.meshes for polygon in thing.polygons)
    lights = [1, local["patches"], local["columns"]] if basis == "surfaces" else [
        local["zones"], local["lights"], float(np.mean(local["merged"]))]
    return [name, basis, triangles, *lights, clusters["count"], clusters["vectors_mean"],
            f"{kept.seconds:.0f} s", *costs, *errors[:4], open_error, errors[4]]


def _percent(squares: NDArray[np.float64]) -> list[float]:
    """Relative errors of their squares, which noise can make negative."""
    return [round(100.0 * float(np.sqrt(max(square, 0.0))), 2) for square in squares]


HEADER = ["scene", "basis", "triangles", "zones", "lights or patches", "merged or columns", "clusters",
          "vectors, mean", "bake", "move ms", "frame ms", "solver %", "basis %", "compression %", "all %", "open %",
          "Cycles' noise %"]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", default="cornell,hole,bunny,maze,dense,densest")
    parser.add_argument("--bases", default="cloud,surfaces")
    parser.add_argument("--positions", type=int, default=20)
    parser.add_argument("--samples", type=int, default=64)
    parser.add_argument("--clearance", type=float, default=0.5,
                        help="least distance of lights from surfaces, in spacings of the cloud")
    parser.add_argument("--preset", default="standard")
    parser.add_argument("--docs", action="store_true")
    parser.add_argument("--rows", type=Path, help="file of rows: those found here are added, all are printed")
    parser.add_argument("--set", action="append", default=[], metavar="NAME=VALUE")
    arguments = parser.parse_args()
    known = json.loads(arguments.rows.read_text()) if arguments.rows and arguments.rows.exists() else {}
    for name in filter(None, arguments.scenes.split(",")):
        for basis in arguments.bases.split(","):
            known[f"{name} {basis}"] = run(name, basis, arguments)
            if arguments.rows:
                arguments.rows.write_text(json.dumps(known))
    rows = []
    for name in SETTINGS:
        rows += [known[key] for key in known if key.split()[0] == name]
        if name in PAPER and any(key.split()[0] == name for key in known):
            *sizes, hours, rate = PAPER[name]
            rows.append(["", "the paper", *sizes, hours, "", f"{1000 / rate:.0f}", *[""] * 6])
    table = markdown_table(HEADER, rows)
    print(table)
    if arguments.docs:
        write_block(ROOT / "docs" / "local_lights.md", "local scenes", table)


if __name__ == "__main__":
    main()
