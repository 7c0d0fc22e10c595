# SPDX-License-Identifier: GPL-3.0-or-later
"""What zones, merging, rays between lights, fading, vectors and density do to a light cloud (Kristensen et al. 2005).
Needs the bpy wheel for the scenes, no Cycles: every error is against our own solution at the very position of a lamp.

    python benchmarks/local_effects.py [zones] [merging] [wall] [door] [vectors] [density] [--docs]

Cornell's box with a cloud of 216 lights at most, lamps at 24 random places: `open`, more than 0.3 m from surfaces and
within the box, where the cloud surrounds a lamp; `all` has those nearer, down to 0.1 m. Errors are relative RMS over
vertices and channels, then a root mean square over lamps. --docs writes the tables and plots into docs/.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from itertools import product

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as in the bake's process; before numpy loads

import bpy
import local_scenes
import numpy as np
from common import ROOT, best_of, drain, markdown_table, save_plot, write_block
from local_lights import POWER, Kept, baked, held_back
from numpy.typing import NDArray

from prt_addon.baking.settings import make_settings
from prt_addon.compression.groups import encode_groups
from prt_addon.compression.settings import EncoderSettings
from prt_addon.lighting.light_cloud import LightCloud, PlacedLights, box_matrix, place_lights
from prt_addon.lighting.light_clustering import (
    default_weights,
    largest_response,
    merge_lights,
    merged_positions,
    merged_response,
    mutual_visibility,
)
from prt_addon.lighting.light_fading import FADE_SECONDS, FadingWeights
from prt_addon.lighting.light_interpolation import CloudInterpolator
from prt_addon.lighting.light_visibility import surroundings
from prt_addon.lighting.local_lights import LocalLight
from prt_addon.lighting.zones import Zones, split_zones
from prt_addon.relighting.exit_radiance import cluster_constants
from prt_addon.relighting.lamp_light import LampLight
from prt_addon.reporting.svg_plots import Curve, curves
from prt_addon.tracing.tracer import Tracer

Array = NDArray[np.floating]
LAMPS, CLUSTERS, VECTORS = 24, 64, 12
FRAME = 1.0 / 30.0


@dataclass
class Scene:
    """A scene with its operator. points: (v, 3) that are seen; lamps: (n, 3) held back; open: (n,) far from surfaces;
    truth: (v, n, 3) their bounced light for 1 W/sr."""

    kept: Kept
    box: Array
    points: Array
    lamps: Array
    open: NDArray[np.bool_]
    truth: Array

    def solve(self, positions: Array) -> NDArray[np.float32]:
        """(v, n, 3) unit-albedo bounced light of isotropic lights of 1 W/sr."""
        return _solve(self.kept, positions)

    def cloud(self, count: int) -> PlacedLights:
        return place_lights(self.kept.solver.tracer, [box_matrix(*self.box)], count=count)

    def errors(self, found: Array) -> list[float]:
        """Per cent: over open lamps, and over all. found: (v, n, 3)."""
        squared = np.sum((found - self.truth) ** 2, axis=(0, 2)) / np.sum(self.truth ** 2, axis=(0, 2))
        return [100.0 * float(np.sqrt(squared[self.open].mean())), 100.0 * float(np.sqrt(squared.mean()))]


def _solve(kept: Kept, positions: Array) -> NDArray[np.float32]:
    receivers = kept.solver.gathered.receivers
    rows = np.full(len(kept.scene.points), -1)
    front = receivers.key < len(rows)
    rows[receivers.key[front]] = np.flatnonzero(front)
    rows = rows[next(o.points for o in kept.scene.objects if o.is_target)][kept.visible]
    result = np.empty((len(rows), len(positions), 3), np.float32)

    def take(part: slice, response: NDArray[np.float32]) -> None:
        result[:, part] = response[rows]

    drain(kept.solver.solve(np.asarray(positions, np.float64), take))
    return result


def prepared(name: str) -> tuple[Kept, Array]:
    """The operator of a scene: a bake of a few lights, kept."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    thing, box = SCENES[name]()
    settings = {"lighting": "local", "lamp_basis": "cloud", "cloud_lights": "8", "cloud_emission": "1",
                "error_receivers": "0", "gather_directions": "2048", "clusters": "8"}
    inside = box.mean(axis=0) + np.array([[-0.5, 0.0, 0.0], [0.5, 0.0, 0.0]])
    return baked(thing, box, make_settings("standard", settings), inside=inside), box


@cache
def cornell() -> Scene:
    """The Cornell box and its lamps."""
    kept, box = prepared("cornell")
    # The box is open in front, where a cloud ends: lamps beyond its last layer of lights are extrapolated.
    inner = np.array([box[0] + [0.0, 0.17, 0.0], box[1]])
    lamps = held_back(kept.solver.tracer, inner, LAMPS, 0.1)
    points = kept.scene.points[next(o.points for o in kept.scene.objects if o.is_target)][kept.visible]
    clear = surroundings(kept.solver.tracer, lamps).clearance
    return Scene(kept, box, points, lamps, clear > 0.3, _solve(kept, lamps).astype(np.float64))


@cache
def dense(count: int = 216) -> tuple[PlacedLights, NDArray[np.float32]]:
    """Cornell's cloud and its responses."""
    lights = cornell().cloud(count)
    return lights, cornell().solve(lights.positions)


# Clouds


@dataclass
class Merged:
    """A cloud merged zone by zone. responses: for each zone (points of the zone, lights, 3)."""

    cloud: LightCloud
    members: list[NDArray[np.int64]]
    responses: list[Array]

    def lit(self, weights: Array) -> Array:
        """(v, n, 3) of lamps with these weights (n, zones, lights)."""
        result = np.empty((sum(map(len, self.members)), len(weights), 3))
        for number, (members, own) in enumerate(zip(self.members, self.responses, strict=True)):
            part = weights[:, number, :own.shape[1]]
            result[members] = np.einsum("nl,vlc->vnc", part, own, optimize=True)
        return result

    def signal(self) -> NDArray[np.float32]:
        """(v, columns * 3) as it is encoded."""
        result = np.zeros((sum(map(len, self.members)), self.cloud.columns, 3), np.float32)
        for members, own in zip(self.members, self.responses, strict=True):
            result[members, :own.shape[1]] = own
        return result.reshape(len(result), -1)


def merge(scene: Scene, lights: PlacedLights, responses: Array, zones: Zones, difference: float = 0.05,
          farthest: float = 0.5, mode: str = "arithmetic") -> Merged:
    """Lights that look alike in each zone, merged. difference, farthest: 0 = none merge."""
    tracer, places, answers = scene.kept.solver.tracer, [], []
    members = zones.members()
    for inside in members:
        own = np.ascontiguousarray(responses[inside])
        if difference == 0.0 or farthest == 0.0:
            places.append(lights.positions)
            answers.append(own)
            continue
        w1, w2 = default_weights(tracer.diagonal, largest_response(own), farthest, difference)
        labels = merge_lights(lights.positions, own, mutual_visibility(tracer, lights.positions), w1, w2)
        places.append(merged_positions(tracer, lights.positions, labels))
        if mode != "solution":
            answers.append(merged_response(own, labels, mode, 3))
            continue
        alone = np.bincount(labels)[labels] == 1  # a light that merged with none keeps its solution
        answer = np.empty((len(inside), len(places[-1]), 3), np.float32)
        answer[:, labels[alone]] = own[:, alone]
        anew = np.setdiff1d(np.arange(len(places[-1])), labels[alone])
        if len(anew):
            answer[:, anew] = scene.solve(places[-1][anew])[inside]
        answers.append(answer)
    cloud = LightCloud.of_zones(places, lights.positions, lights.spacing)
    return Merged(cloud, members, answers)


def zones_of(points: Array, wanted: int) -> Zones:
    """The split whose number of zones is nearest to the wanted one."""
    sizes = np.unique(np.geomspace(len(points) / (4 * wanted), len(points), 60).astype(int))
    splits = [split_zones(points, int(size)) for size in sizes[::-1]]
    return min(splits, key=lambda split: abs(len(split) - wanted))


def weights_of(scene: Scene, cloud: LightCloud, kind: str = "linear") -> Array:
    """(n, zones, lights) of the held-back lamps."""
    return CloudInterpolator(cloud, scene.kept.solver.tracer, interpolation=kind).weights(scene.lamps).weights


def encoder(vectors: int) -> EncoderSettings:
    """As a bake encodes: without random starts."""
    return EncoderSettings(CLUSTERS, vectors, threads=1, restarts=0)


def zone_rows() -> Iterator[list[object]]:
    """Zones: lights kept, error, and what a light move costs."""
    scene, (lights, responses) = cornell(), dense()
    for wanted in (1, 2, 4, 8, 16):
        zones = zones_of(scene.points, wanted)
        merged = merge(scene, lights, responses, zones)
        weights = weights_of(scene, merged.cloud)
        plain = merged.lit(weights)
        zone = np.empty(len(scene.points), np.int32)
        for number, inside in enumerate(merged.members):
            zone[inside] = number
        started = time.perf_counter()
        encoding, cluster_zone = encode_groups(merged.signal(), zone, encoder(VECTORS))
        seconds = time.perf_counter() - started
        coded = Merged(merged.cloud, merged.members, _split(encoding.decode(), merged))
        shown = coded.lit(weights)
        bases = encoding.bases.reshape(*encoding.bases.shape[:2], 1, -1, 3)
        light = _light(merged, weights)
        constants = best_of(20, lambda b=bases, z=cluster_zone, light=light: cluster_constants(b, light, z))[0]
        mover = LampLight(merged.cloud, scene.kept.solver.tracer)
        moves = best_of(20, lambda m=mover: m.step([_lamp(scene.lamps[0])]))
        added = np.sqrt(np.mean(np.sum((shown - plain) ** 2, axis=(0, 2)) / np.sum(plain ** 2, axis=(0, 2))))
        kept = np.diff(merged.cloud.zone_starts)
        yield [len(zones), len(lights), float(kept.mean()), int(kept.max()), len(encoding.bases),
               float(np.mean(encoding.vectors_per_cluster[encoding.cluster])), encoding.bases.nbytes / 1e6,
               *scene.errors(plain), 100.0 * float(added), *scene.errors(shown), seconds, 1e3 * moves[0],
               1e3 * constants]


def _split(decoded: Array, merged: Merged) -> list[Array]:
    """A decoded signal by zones."""
    decoded = decoded.reshape(len(decoded), -1, 3)
    return [decoded[inside, :own.shape[1]] for inside, own in zip(merged.members, merged.responses, strict=True)]


def _light(merged: Merged, weights: Array) -> NDArray[np.float32]:
    """(zones, columns, 3) of the first lamp."""
    return np.repeat(weights[0][:, :merged.cloud.columns, None], 3, axis=2).astype(np.float32)


def _lamp(position: Array) -> LocalLight:
    matrix = np.eye(4)
    matrix[:3, 3] = position
    return LocalLight("lamp", "point", matrix, np.full(3, POWER))


def merging_rows() -> Iterator[list[object]]:
    """Lights kept in 8 zones, and error, for differences that merge, distances, and what merged lights answer with."""
    scene, (lights, responses) = cornell(), dense()
    zones = zones_of(scene.points, 8)
    cases = [(difference, 0.5) for difference in (0.0, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5)]
    cases += [(0.2, farthest) for farthest in (0.1, 0.15, 0.2, 0.3, 1.0, 1e6)]
    for difference, farthest in cases:
        found, kept = [], 0.0
        for mode in ("arithmetic", "harmonic", "solution"):
            merged = merge(scene, lights, responses, zones, difference, farthest, mode)
            kept = float(np.diff(merged.cloud.zone_starts).mean())
            found += scene.errors(merged.lit(weights_of(scene, merged.cloud)))
        yield [difference, farthest, len(lights), kept, *found]


# Walls


def parted(door: bool) -> tuple[bpy.types.Object, Array]:
    """Two closed rooms a metre wide, red and green, with a wall of 2 cm between them, with a door or without."""
    half, cells = 0.01, (12, 12)
    colours = {"back": local_scenes.WHITE, "front": local_scenes.WHITE, "floor": local_scenes.WHITE,
               "ceiling": local_scenes.WHITE}
    holes = frozenset((i, j) for i in range(4, 8) for j in range(8)) if door else frozenset()
    left = local_scenes.room((-1, 0, 0), (-half, 1, 1), 12, {**colours, "-x": local_scenes.RED})
    right = local_scenes.room((half, 0, 0), (1, 1, 1), 12, {**colours, "+x": local_scenes.GREEN})
    white, panel = local_scenes.WHITE, local_scenes.Panel
    wall = [panel((-half, 0, 0), (0, 0, 1), (0, 1, 0), cells, white, frozenset((j, i) for i, j in holes)),
            panel((half, 0, 0), (0, 1, 0), (0, 0, 1), cells, white, holes)]
    if door:  # the sides, the lintel and the threshold of its frame
        low, high, top = 4 / 12, 8 / 12, 8 / 12
        across = (2 * half, 0, 0)
        wall += [panel((-half, low, 0), (0, 0, top), across, (8, 1), white),
                 panel((-half, high, 0), across, (0, 0, top), (1, 8), white),
                 panel((-half, low, top), (0, high - low, 0), across, (4, 1), white),
                 panel((-half, low, 0), across, (0, high - low, 0), (1, 4), white)]
    return local_scenes.build("Parted", left + right + wall), np.array([[-1, 0, 0], [1, 1, 1]], float)


SCENES = {**local_scenes.SCENES, "wall": lambda: parted(False), "door": lambda: parted(True)}


def wall_rows() -> Iterator[list[object]]:
    """Share of the bounced light (sum over vertices) that a lamp on one side of a wall of 2 cm sends to the other."""
    kept, box = prepared("wall")
    points = kept.scene.points[next(o.points for o in kept.scene.objects if o.is_target)][kept.visible]
    scene = Scene(kept, box, points, np.empty((0, 3)), np.empty(0, bool), np.empty(0))
    tracer = kept.solver.tracer
    blind = Tracer(kept.scene.points, kept.scene.triangles[:0], 1)
    lights = scene.cloud(216)
    merged = merge(scene, lights, scene.solve(lights.positions), zones_of(points, 8))
    for distance in (0.02, 0.05, 0.1, 0.2, 0.4):
        lamp, beyond = np.array([[-0.01 - distance, 0.45, 0.55]]), points[:, 0] > 0.0
        exact = scene.solve(lamp)
        found = [exact]
        for rays in (tracer, blind):
            found.append(merged.lit(CloudInterpolator(merged.cloud, rays).weights(lamp).weights))
        leak = [100.0 * float(light[beyond].sum() / light.sum()) for light in found]
        error = [100.0 * float(np.sqrt(np.sum((light - exact) ** 2) / np.sum(exact ** 2, dtype=np.float64)))
                 for light in found[1:]]
        yield [distance, *leak, *error]


def door_rows() -> Iterator[list[object]]:
    """Largest change of the picture between two frames (30 a second) of a lamp that crosses a door, or passes by it."""
    kept, box = prepared("door")
    points = kept.scene.points[next(o.points for o in kept.scene.objects if o.is_target)][kept.visible]
    scene = Scene(kept, box, points, np.empty((0, 3)), np.empty(0, bool), np.empty(0))
    lights = scene.cloud(216)
    merged = merge(scene, lights, scene.solve(lights.positions), zones_of(points, 8))
    paths = {"through the door": ((-0.15, 0.47, 0.4), (0.15, 0.52, 0.4)),
             "past the door, 5 cm before it": ((-0.06, 0.2, 0.4), (-0.06, 0.6, 0.4)),
             "past the door, 20 cm before it": ((-0.21, 0.2, 0.4), (-0.21, 0.6, 0.4))}
    for (name, (start, end)), speed in product(paths.items(), (0.1, 1.0)):
        start, step = np.asarray(start), np.subtract(end, start)
        count = round(float(np.linalg.norm(step)) / (speed * FRAME))
        path = start + np.linspace(0.0, 1.0, count + 1)[:, None] * step
        truth = scene.solve(path).astype(np.float64)
        for kind, fade in (("exact solution", None), ("published", 0.0), ("published", FADE_SECONDS), ("linear", 0.0),
                           ("linear", FADE_SECONDS)):
            if fade is None:
                yield [name, speed, kind, "", *_jumps(truth), ""]
                continue
            interpolator = CloudInterpolator(merged.cloud, kept.solver.tracer, interpolation=kind)
            fading = FadingWeights(interpolator, fade)
            weights = np.concatenate([fading.step(FRAME, ["lamp"], place[None]).weights for place in path])
            frames = merged.lit(weights)
            error = np.sqrt(np.mean(np.sum((frames - truth) ** 2, axis=(0, 2)) / np.sum(truth ** 2, axis=(0, 2))))
            yield [name, speed, kind, f"{fade:g} s" if fade else "none", *_jumps(frames), 100.0 * float(error)]


def _jumps(frames: Array) -> list[float]:
    """Largest relative RMS change (per cent) between neighbouring frames (v, n, 3), and largest change of one vertex
    over the mean picture (per cent of its RMS)."""
    size = np.sqrt(np.mean(frames ** 2, axis=(0, 2)))
    change = np.diff(frames, axis=1)
    rms = np.sqrt(np.mean(change ** 2, axis=(0, 2))) / np.minimum(size[1:], size[:-1])
    return [100.0 * float(rms.max()), 100.0 * float(np.abs(change).max() / size.mean())]


# Plots


def vector_rows() -> Iterator[list[object]]:
    """Error against vectors of a cluster: 8 zones, 64 clusters, merged lights, and 504 lights that hardly merge."""
    scene = cornell()
    clouds = [(dense(216), 0.05), (dense(512), 0.02)]
    prepared_clouds = []
    for (lights, responses), difference in clouds:
        merged = merge(scene, lights, responses, zones_of(scene.points, 8), difference)
        zone = np.empty(len(scene.points), np.int32)
        for number, inside in enumerate(merged.members):
            zone[inside] = number
        weights = weights_of(scene, merged.cloud)
        prepared_clouds.append((merged, zone, weights, merged.lit(weights)))
    for vectors in (1, 2, 3, 4, 6, 8, 10, 12, 16, 20, 24):
        row: list[object] = [vectors]
        for merged, zone, weights, plain in prepared_clouds:
            encoding, _ = encode_groups(merged.signal(), zone, encoder(vectors))
            shown = Merged(merged.cloud, merged.members, _split(encoding.decode(), merged)).lit(weights)
            added = np.mean(np.sum((shown - plain) ** 2, axis=(0, 2)) / np.sum(plain ** 2, axis=(0, 2)))
            row += [100.0 * float(np.sqrt(encoding.relative_error)), 100.0 * float(np.sqrt(added)),
                    *scene.errors(shown)]
        yield row


def density_rows() -> Iterator[list[object]]:
    """Error against lights of the dense cloud, before merging, for both kernels, and with 8 zones merged."""
    scene = cornell()
    whole, eight = split_zones(scene.points, len(scene.points)), zones_of(scene.points, 8)
    for count in (32, 64, 125, 216, 343, 512, 729, 1024):
        lights, responses = dense(count)
        plain = merge(scene, lights, responses, whole, 0.0)
        merged = merge(scene, lights, responses, eight, 0.02)
        errors = [x for kind in ("published", "linear") for x in scene.errors(plain.lit(weights_of(scene, plain.cloud,
                                                                                                    kind)))]
        yield [len(lights), lights.spacing, *errors, float(np.diff(merged.cloud.zone_starts).mean()),
               *scene.errors(merged.lit(weights_of(scene, merged.cloud)))]


ERRORS = ["open %", "all %"]
TABLES = {
    "zones": (zone_rows, ["zones", "lights", "kept, mean", "kept, most", "clusters", "vectors", "bases MB",
                          "cloud, open %", "all %", "compression adds %", "total, open %", "all %", "encode s",
                          "weights ms", "constants ms"]),
    "merging": (merging_rows, ["merge_response", "merge_distance", "lights", "kept, mean", "arithmetic: open %",
                               "all %", "harmonic: open %", "all %", "solution: open %", "all %"]),
    "wall": (wall_rows, ["m from wall", "exact %", "rays %", "no rays %", "error with rays %", "without %"]),
    "door": (door_rows, ["path", "m/s", "kernel", "fading", "largest jump, RMS %", "of a vertex %", "error %"]),
    "vectors": (vector_rows, ["vectors", "216 lights: signal %", "compression adds %", "open %", "all %",
                              "512 lights: signal %", "compression adds %", "open %", "all %"]),
    "density": (density_rows, ["lights", "spacing m", "published: open %", "all %", "linear: open %", "all %",
                               "merged, mean", "merged: open %", "all %"]),
}
PLOTS = {
    "vectors": ("vectors of a cluster", "Cornell: error against vectors", False,
                (("216 lights: all", 4), ("216: compression", 2), ("512 lights: all", 8), ("512: compression", 6))),
    "density": ("lights of the cloud", "Cornell: error against density of the cloud", True,
                (("published, open", 2), ("published, all", 3), ("linear, open", 4), ("linear, all", 5))),
}


def main() -> None:
    """Parse the command line and print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("parts", nargs="*", default=list(TABLES))
    parser.add_argument("--docs", action="store_true")
    arguments = parser.parse_args()
    for name in arguments.parts:
        work, header = TABLES[name]
        rows = list(work())
        table = markdown_table(header, rows)
        print(f"\n{name}\n{table}", flush=True)
        if arguments.docs:
            write_block(ROOT / "docs" / "local_lights.md", f"local {name}", table)
            if name in PLOTS:
                x_name, title, logarithmic, series = PLOTS[name]
                lines = [Curve(label, [(float(row[0]), row[column] / 100.0) for row in rows])
                         for label, column in series]
                save_plot(ROOT / "docs" / f"local_{name}.svg", curves(lines, x_name, "relative RMS of bounced light",
                                                                      title, log_x=logarithmic))


if __name__ == "__main__":
    main()
