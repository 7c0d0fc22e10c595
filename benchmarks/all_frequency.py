# SPDX-License-Identifier: GPL-3.0-or-later
"""Light of all frequencies against Cycles: what an error under a hard sun costs in bytes and in seconds. Needs the bpy
wheel.

    python benchmarks/all_frequency.py --folder DIR --part cycles     ground truth: minutes
    python benchmarks/all_frequency.py --folder DIR --part sh         harmonics; then 8, 16 and 32: cubemaps
    python benchmarks/all_frequency.py --folder DIR --part table --plot docs/all_frequency.svg

A mesh on a ground, both grey, under HDRIs of a broad sky and a sun of one degree that brings four times the sky's
light, in several places, and under the sky alone. All bounces. Error: relative RMS of radiance at random vertices of
both against what Cycles shows around them, its own noise taken out by baking twice (tests/blender/cycles.py,
shown_radiance); the mean over the suns. Bake: processor seconds of all threads, which other work hardly changes:
gather, shadows, bounces and encoding, without the error budget; a representation's encodings share the first three.
Change: turning the light, constants of all clusters, radiance at all receivers, on one processor. Bytes: bases, weights
and cluster numbers. Goes on after what the folder holds.

Haar: the largest coefficients of each receiver, as Ng, Ramamoorthi & Hanrahan (2003) keep them: six bytes each. No bake
stores these; they show what a representation of its own for each receiver would reach.
"""

from __future__ import annotations

import argparse
import json
import os
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as in the bake's process; before numpy loads

import bpy
import numpy as np
from against_cycles import load, use_world
from common import ROOT, STYLE, print_table
from numpy.typing import NDArray

from prt_addon.baking.distant_basis import DistantBasis
from prt_addon.baking.recipe import BakeResult, Progress, bake
from prt_addon.baking.settings import PRESETS, BakeSettings
from prt_addon.basis.cubemap import cubemap_solid_angles
from prt_addon.basis.haar import haar_transform, keep_largest
from prt_addon.basis.spherical_harmonics import rotate
from prt_addon.blender.read_scene import read_objects
from prt_addon.lighting.cubemap_light import EnvironmentTexels, Turn, environment_texels
from prt_addon.lighting.environment import direction_of_pixel, project, world_rotation
from prt_addon.linear_algebra import multiply
from prt_addon.relighting.exit_radiance import cluster_constants, exit_radiance
from prt_addon.reporting.svg_plots import Curve, curves
from prt_addon.scene.scene_mesh import SceneMesh
from prt_addon.storage.container import BakedTransfer
from prt_addon.storage.files import intact
from tests.blender.cycles import diffuse_material, shown_radiance, use_cycles

Double = NDArray[np.float64]

# Azimuth and height of the suns in degrees; None: the sky alone.
SUNS = ((30.0, 60.0), (150.0, 40.0), (260.0, 25.0), (320.0, 50.0), None)
SUN_DEGREES, SUN_TO_SKY = 1.0, 4.0
HEIGHT, WIDTH = 512, 1024
TURN = 20.0  # degrees, of the World
TARGETS = (0.1, 0.03, 0.01)
CLUSTERS = ((64, 8), (256, 8), (256, 16), (1024, 8), (1024, 24))
VECTORS = (12, 24, 48, 96, 192)
HAAR = (24, 96, 384)


@dataclass(frozen=True)
class Row:
    """group: the representation; error: mean over the suns; sky: under the sky alone; seconds, change: of the bake and
    of a change of light."""

    group: str
    name: str
    bytes: int
    seconds: float
    change: float
    error: float
    sky: float


def sky_and_sun(place: tuple[float, float] | None) -> NDArray[np.float32]:
    """An equirectangular HDRI: a sky brightest at the horizon over a dark ground, and a small bright disc."""
    steps = (np.arange(4) + 0.5) / 4.0 - 0.5
    rows, columns = (np.arange(HEIGHT)[:, None] + steps).ravel(), (np.arange(WIDTH)[:, None] + steps).ravel()
    directions = direction_of_pixel(rows[:, None], columns[None], HEIGHT, WIDTH)
    up = directions[..., 2]
    values = np.where(up > 0.0, 0.7 - 0.4 * up, 0.15)[..., None] * np.array([0.8, 1.0, 1.3])
    if place is not None:
        azimuth, height = np.radians(place)
        towards = np.array([np.cos(azimuth) * np.cos(height), np.sin(azimuth) * np.cos(height), np.sin(height)])
        half = np.radians(SUN_DEGREES / 2.0)
        inside = np.sum(directions * towards, axis=-1) > np.cos(half)
        sky = np.pi * 0.45  # about what the sky brings to a surface that faces up
        radiance = SUN_TO_SKY * sky / (2.0 * np.pi * (1.0 - np.cos(half)))
        values = values + radiance * inside[..., None] * np.array([1.1, 1.0, 0.8])
    return values.reshape(HEIGHT, 4, WIDTH, 4, 3).mean(axis=(1, 3)).astype(np.float32)


def make_scene(mesh: str, cells: int) -> list[bpy.types.Object]:
    """The mesh, upright, on a ground three times as wide; grey both."""
    thing = load(mesh)
    points = np.empty(3 * len(thing.data.vertices), np.float32)
    thing.data.vertices.foreach_get("co", points)
    points = points.reshape(-1, 3)
    if mesh.endswith("obj"):
        points = points[:, [0, 2, 1]] * np.array([1.0, -1.0, 1.0], np.float32)
    points -= np.array([*points[:, :2].mean(axis=0), points[:, 2].min()], np.float32)
    thing.matrix_world.identity()
    thing.data.vertices.foreach_set("co", points.ravel())
    size = float(np.ptp(points, axis=0).max())
    bpy.ops.mesh.primitive_grid_add(x_subdivisions=cells, y_subdivisions=cells, size=3.0 * size,
                                    location=(0.0, 0.0, -1e-4 * size))
    ground = bpy.context.object
    ground.name = "ground"
    for found, grey in ((thing, 0.7), (ground, 0.5)):
        found.data.update()
        found.data.materials.clear()
        found.data.materials.append(diffuse_material(f"{found.name} grey", (grey, grey, grey, 1.0)))
    bpy.context.view_layer.update()
    return [thing, ground]


def chosen_vertices(things: list[bpy.types.Object], count: int) -> list[NDArray[np.int64]]:
    """Random vertices of each object; of the ground those nearer to the mesh than twice its width, inside its rim."""
    random = np.random.default_rng(0)
    found = []
    for number, thing in enumerate(things):
        points = np.empty(3 * len(thing.data.vertices), np.float32)
        thing.data.vertices.foreach_get("co", points)
        far = np.abs(points.reshape(-1, 3)[:, :2]).max(axis=1)
        candidates = np.flatnonzero(far < (0.66 * far.max() if number else np.inf))
        found.append(np.sort(random.permutation(candidates)[:count]))
    return found


def ground_truth(things: list[bpy.types.Object], options: argparse.Namespace) -> None:
    """Cycles' radiance (2, vertices, 3) of both objects' chosen vertices under every light, kept in the folder."""
    chosen = chosen_vertices(things, options.vertices)
    with tempfile.TemporaryDirectory() as folder:
        use_cycles(options.samples)
        bpy.context.scene.render.threads = 2
        for number, place in enumerate(SUNS):
            path = options.folder / f"cycles{number}.npz"
            if path.exists():
                continue
            started = time.perf_counter()
            use_world(sky_and_sun(place), 0.0, folder)
            seen = [[shown_radiance(thing, {"DIRECT", "INDIRECT"}, which, seed) for thing, which
                     in zip(things, chosen, strict=True)] for seed in (0, 1)]
            halves = np.stack([np.concatenate(half) for half in seen])
            np.savez(path, halves=halves)
            noise = np.sqrt(np.mean((halves[0] - halves[1]) ** 2) / 2.0 / np.mean(halves[0] * halves[1]))
            print(f"sun {place}: {time.perf_counter() - started:.0f} s, Cycles' noise {noise:.2%}", flush=True)


class Truth:
    """Errors against what `ground_truth` kept."""

    def __init__(self, folder: Path, chosen: list[NDArray[np.int64]]) -> None:
        self.chosen = chosen
        self.halves = [np.load(folder / f"cycles{number}.npz")["halves"] for number in range(len(SUNS))]

    def errors(self, radiance: list[list[Double]]) -> tuple[float, float]:
        """Mean relative RMS over the suns, and that under the sky, of radiance (vertices, 3) per light and object."""
        found = []
        for (first, second), ours in zip(self.halves, radiance, strict=True):
            ours = np.concatenate([part[which] for part, which in zip(ours, self.chosen, strict=True)])
            squared = np.sum((ours - first) * (ours - second)) / np.sum(first * second)
            found.append(float(np.sqrt(max(squared, 0.0))))
        return float(np.mean(found[:-1])), found[-1]


def timed(steps: Iterator[Progress]) -> tuple[BakeResult, dict[str, float]]:
    """Exhaust a bake; processor seconds of all its threads by stage."""
    seconds: dict[str, float] = {}
    iterator, before = iter(steps), time.process_time()
    stage = "prepare"
    while True:
        try:
            stage = next(iterator).stage
        except StopIteration as end:
            return end.value, seconds
        now = time.process_time()
        seconds[stage] = seconds.get(stage, 0.0) + now - before
        before = now


def relit(container: BakedTransfer, light: Double) -> Double:
    """Unit-albedo radiance (receivers, 3)."""
    constants = cluster_constants(container.bases, light)
    return exit_radiance(container.cluster, container.weights, constants)[:, 0].astype(np.float64)


def bytes_of(containers: list[BakedTransfer]) -> int:
    """What is stored for the transfer."""
    return sum(c.bases.nbytes + c.weights.nbytes + 2 * len(c.cluster) for c in containers)


def change_seconds(containers: list[BakedTransfer], light: Double, basis: DistantBasis) -> float:
    """Least seconds of one turn of the light, seen by all receivers."""
    def change() -> None:
        turn = world_rotation(33.0)
        turned = Turn(basis.cubemap, turn)(light) if basis.cubemap else rotate(light, turn)
        for container in containers:
            relit(container, turned)
    return least_seconds(5, change)


def least_seconds(runs: int, work: Callable[[], object]) -> float:
    """Least processor seconds of some runs."""
    found = []
    for _ in range(runs):
        before = time.process_time()
        work()
        found.append(time.process_time() - before)
    return min(found)


def lights_of(basis: DistantBasis) -> list[Double]:
    """Every light in the columns of a basis."""
    images = [sky_and_sun(place) for place in SUNS]
    return [environment_texels(image, basis.cubemap) if basis.cubemap else project(image, basis.order)
            for image in images]


def measured(group: str, name: str, result: BakeResult, seconds: float, truth: Truth, lights: list[Double],
             basis: DistantBasis, names: list[str]) -> Row:
    """The row of one bake."""
    containers = [result.objects[key] for key in names]
    error, sky = truth.errors([[relit(container, light) for container in containers] for light in lights])
    row = Row(group, name, bytes_of(containers), seconds, change_seconds(containers, lights[0], basis), error, sky)
    print(row, flush=True)
    return row


def settings_of(**changes: object) -> BakeSettings:
    """The preset High without what is measured elsewhere."""
    return replace(PRESETS["high"], spacing=0.0, error_receivers=0, compression_error=0.0, encoder="static",
                   memory_budget=4.0, bounce_error=1e-3, gather_directions=512, **changes)


def kept_rows(path: Path) -> list[Row]:
    """What an earlier run measured."""
    return [Row(**row) for row in json.loads(path.read_text())] if path.exists() else []


def harmonics(scene: SceneMesh, truth: Truth, names: list[str], options: argparse.Namespace) -> list[Row]:
    """Orders 3 to 10, encoded to two thousandths. Goes on after what is kept."""
    path = options.folder / "sh.json"
    rows = kept_rows(path)
    for order in range(3 + len(rows), 11):
        settings = replace(settings_of(order=order, directions=2048, clusters=256, vectors=16),
                           compression_error=2e-3)
        result, stages = timed(bake(scene, settings))
        basis, seconds = DistantBasis(order), sum(stages.values())
        rows.append(measured("harmonics", f"order {order}", result, seconds, truth, lights_of(basis), basis, names))
        path.write_text(json.dumps([asdict(row) for row in rows]))
    return rows


def texels(scene: SceneMesh, truth: Truth, names: list[str], size: int, options: argparse.Namespace) -> list[Row]:
    """A cubemap's columns in every encoding, from one filling."""
    basis, lights = DistantBasis(0, size), lights_of(DistantBasis(0, size))
    before, path = 0.0, options.folder / f"{size}.json"
    rows = kept_rows(path)
    job = options.folder / f"job{size}"
    job.mkdir(exist_ok=True)
    wanted = [(f"clusters, {size}", f"{c} x {v}", {"encoder": "static", "clusters": c, "vectors": v})
              for c, v in CLUSTERS]
    wanted += [(f"eigentransport, {size}", f"d = {d}", {"encoder": "eigentransport", "vectors": d}) for d in VECTORS]
    for group, name, changes in wanted[len(rows):]:
        base = settings_of(distant_basis="cubemap", cubemap_size=size, directions=4096)
        result, stages = timed(bake(scene, replace(base, **changes), job))
        filled = job / "seconds.json"
        if not result.report["resumed"]:
            before = sum(spent for stage, spent in stages.items() if stage != "encode")
            filled.write_text(json.dumps(before))
        before = json.loads(filled.read_text())
        seconds = before + stages["encode"]
        rows.append(measured(group, name, result, seconds, truth, lights, basis, names))
        path.write_text(json.dumps([asdict(row) for row in rows]))
    before = json.loads((job / "seconds.json").read_text())
    return rows[:len(wanted)] + whole_columns(scene, truth, size, options.folder, before, lights)


def whole_columns(scene: SceneMesh, truth: Truth, size: int, folder: Path, before: float, lights: list[Double],
                  ) -> list[Row]:
    """Without compression, and each receiver's largest Haar coefficients."""
    job = folder / f"job{size}"
    key = intact(job / "gather.npz")[0]["key"]
    stored = intact(job / "interreflection.npz")[0]["transfer"][:, :, 0]
    front = np.flatnonzero(key < len(scene.points))
    transfer = np.zeros((len(scene.points), stored.shape[1]), np.float32)
    transfer[key[front]] = stored[front]
    del stored
    parts = [found.points for found in scene.objects]

    def radiance(values: NDArray[np.float32], seen: list[Double]) -> list[list[Double]]:
        lit = multiply(values, np.concatenate(seen, axis=1).astype(np.float32)).astype(np.float64)
        return [[lit[part, 3 * n:3 * n + 3] for part in parts] for n in range(len(seen))]

    turn, one = Turn(size, world_rotation(33.0)), lights[0]
    change = least_seconds(3, lambda: multiply(transfer, turn(one).astype(np.float32)))
    rows = [Row(f"columns, {size}", "uncompressed", transfer.nbytes, before, change,
                *truth.errors(radiance(transfer, lights)))]
    # The same suns by a World that is turned to them, as it is drawn, and by a turn of its texels.
    back = [EnvironmentTexels.of(sky_and_sun(place and (place[0] - TURN, place[1])), size) for place in SUNS]
    rotation = world_rotation(-TURN)
    for name, seen in (("World turned", [kept.turned(rotation) for kept in back]),
                       ("texels turned", [Turn(size, rotation)(kept.turned()) for kept in back])):
        rows.append(Row(f"columns, {size}", name, transfer.nbytes, before, change,
                        *truth.errors(radiance(transfer, seen))))
    root = np.sqrt(cubemap_solid_angles(size))
    seen = [haar_transform(np.ascontiguousarray((light * root[:, None]).T), size).T for light in lights]
    started = time.process_time()
    transformed = haar_transform(transfer / root.astype(np.float32), size)
    seconds = before + time.process_time() - started
    for count in HAAR:
        if count < transformed.shape[1]:
            kept = keep_largest(transformed, count)
            rows.append(Row(f"Haar, {size}", f"{count} of each", 6 * count * len(kept), seconds, float("nan"),
                            *truth.errors(radiance(kept, seen))))
    for row in rows:
        print(row, flush=True)
    return rows


def reached(rows: list[Row]) -> list[list[object]]:
    """For every representation the fewest bytes and seconds of an error of each of TARGETS."""
    table = []
    for group in dict.fromkeys(row.group for row in rows):
        mine, line = [row for row in rows if row.group == group], [group]
        for target in TARGETS:
            enough = [row for row in mine if row.error <= target]
            if enough:
                small, quick = min(enough, key=lambda r: r.bytes), min(enough, key=lambda r: r.seconds)
                line.append(f"{small.bytes / 1e6:.1f} MB ({small.name}), {quick.seconds:.1f} s ({quick.name})")
            else:
                line.append("not reached")
        best = min(mine, key=lambda r: r.error)
        table.append([*line, f"{best.error:.1%} ({best.name})", f"{best.sky:.2%}"])
    return table


def tell(rows: list[Row], plot: Path | None) -> None:
    """Both tables, and the plot."""
    print_table(["representation", "which", "MB", "bake, processor s", "change ms", "error under suns %",
                 "under the sky %"],
                [[r.group, r.name, r.bytes / 1e6, r.seconds, "" if np.isnan(r.change) else 1e3 * r.change,
                  100.0 * r.error, 100.0 * r.sky] for r in rows])
    print()
    print_table(["representation", *(f"{target:.0%}" for target in TARGETS), "best", "there, under the sky"],
                reached(rows))
    if plot is None:
        return
    groups = ("harmonics", "clusters, 16", "clusters, 32", "eigentransport, 16", "Haar, 32")
    pictures = []
    for name, value in (("bytes", lambda r: float(r.bytes)), ("processor seconds of the bake", lambda r: r.seconds)):
        drawn = [Curve(group, front([(value(r), r.error) for r in rows if r.group == group])) for group in groups]
        pictures.append(curves(drawn, name, "relative RMS error under suns", f"Error against {name}", log_x=True))
    save_both(ROOT / plot, pictures)


def front(points: list[tuple[float, float]]) -> list[tuple[float, float]]:
    """Points (cost, error) than which none is both cheaper and better, with a step to the right's end of the others, so
    that a single one is seen too."""
    kept: list[tuple[float, float]] = []
    for cost, error in sorted(points):
        if not kept or error < kept[-1][1]:
            kept.append((cost, error))
    most = max((cost for cost, _ in points), default=0.0)
    return kept if len(kept) != 1 else [*kept, (most, kept[0][1])]


def save_both(path: Path, pictures: list[str]) -> None:
    """Plots under each other as one SVG file."""
    height, inner = 264, ""
    for number, picture in enumerate(pictures):
        inner += picture.replace("<svg ", f'<svg x="0" y="{number * height}" width="760" height="250" ', 1)
    path.write_text(f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 760 {height * len(pictures)}">'
                    f"{STYLE}{inner}</svg>")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--mesh", default="spot.obj")
    parser.add_argument("--cells", type=int, default=96, help="along the ground's edge")
    parser.add_argument("--vertices", type=int, default=600, help="of each object, compared with Cycles")
    parser.add_argument("--samples", type=int, default=128)
    parser.add_argument("--folder", type=Path, default=Path(tempfile.gettempdir()) / "prt-all-frequency")
    parser.add_argument("--part", choices=("all", "cycles", "sh", "8", "16", "32", "table"), default="all")
    parser.add_argument("--plot", type=Path)
    options = parser.parse_args()
    options.folder.mkdir(parents=True, exist_ok=True)
    parts = ("cycles", "sh", "8", "16", "32", "table") if options.part == "all" else (options.part,)
    things = make_scene(options.mesh, options.cells)
    names, chosen = [thing.name for thing in things], chosen_vertices(things, options.vertices)
    scene = SceneMesh.assemble(read_objects(bpy.context.evaluated_depsgraph_get(), names), 0.0)
    print(f"{len(scene.points):,} receivers")
    for part in parts:
        if part == "cycles":
            ground_truth(things, options)
        elif part == "table":
            rows = [Row(**row) for name in ("sh", "8", "16", "32") if (options.folder / f"{name}.json").exists()
                    for row in json.loads((options.folder / f"{name}.json").read_text())]
            tell(rows, options.plot)
        else:
            truth = Truth(options.folder, chosen)
            rows = harmonics(scene, truth, names, options) if part == "sh" else \
                texels(scene, truth, names, int(part), options)
            (options.folder / f"{part}.json").write_text(json.dumps([asdict(row) for row in rows]))


if __name__ == "__main__":
    main()
