# SPDX-License-Identifier: GPL-3.0-or-later
"""Light clouds: seconds to cluster lights, error of interpolated lamps, milliseconds for each move of lamps.

    python benchmarks/light_cloud.py [clustering] [error] [merging] [moves]

The field is the indirect light in a box with walls of albedo 0.5 (Cornell's without blocks): walls in patches, the
light of an isotropic point on each in closed form (its solid angle), all further bounces by a direct solution. Errors
are relative RMS over the patches, the mean and the largest over lamps held back: `inside`, between the lights of a
cloud, and `near walls`, beyond its outermost ones, 2 cm from a wall of 1 m at least.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Iterator

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as in the bake's process; before numpy loads

import numpy as np
from common import best_of, print_table
from numpy.typing import NDArray
from scipy.spatial.distance import pdist

from prt_addon.lighting.light_cloud import LightCloud, box_matrix, place_lights
from prt_addon.lighting.light_clustering import (
    default_weights,
    largest_response,
    light_distances,
    merge_lights,
    merged_positions,
    merged_response,
)
from prt_addon.lighting.light_interpolation import CloudInterpolator
from prt_addon.lighting.zones import split_zones
from prt_addon.tracing.tracer import Tracer

Array = NDArray[np.float64]
PATCHES, ALBEDO, LAMPS = 10, 0.5, 200
CUBE = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], float)
FACES = np.array([t for a, b, c, d in ((0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4),
                                       (1, 5, 7, 3)) for t in ((a, c, b), (a, d, c))], np.int32)


class BoxField:
    """Indirect light in the unit box."""

    def __init__(self) -> None:
        line = (np.arange(PATCHES) + 0.5) / PATCHES
        a, b = (v.ravel() for v in np.meshgrid(line, line, indexing="ij"))
        places, normals = [], []
        for axis in range(3):
            for side in (0.0, 1.0):
                places.append(np.insert(np.stack([a, b], axis=1), axis, side, axis=1))
                normals.append(np.tile((1.0 - 2.0 * side) * np.eye(3)[axis], (len(a), 1)))
        self.places, self.normals = np.concatenate(places), np.concatenate(normals)
        step = self.places - self.places[:, None]
        squared = (step ** 2).sum(axis=2) + 1e-12
        leaving, arriving = (step * self.normals[:, None]).sum(axis=2), -(step * self.normals).sum(axis=2)
        factors = np.maximum(leaving, 0.0) * np.maximum(arriving, 0.0) / (np.pi * PATCHES ** 2 * squared ** 2)
        factors *= ALBEDO / np.maximum(factors.sum(axis=1, keepdims=True), 1.0)
        self.bounces = np.linalg.solve(np.eye(len(factors)) - factors, factors) / np.pi

    def direct(self, lights: Array) -> Array:
        """Mean irradiance (lights, patches) of 1 W/sr: a patch's solid angle over its area."""
        angles = np.empty((len(lights), len(self.places)))
        for axis in range(3):
            on = np.abs(self.normals[:, axis]) > 0.5
            u, v = (self.places[None, on, k] - lights[:, k, None] for k in range(3) if k != axis)
            depth = np.abs(self.places[None, on, axis] - lights[:, axis, None])
            total, half = np.zeros_like(depth), 0.5 / PATCHES
            for s in (-1, 1):
                for t in (-1, 1):
                    x, y = u + s * half, v + t * half
                    total += s * t * np.arctan2(x * y, depth * np.sqrt(x * x + y * y + depth * depth))
            angles[:, on] = total
        return angles * PATCHES ** 2

    def response(self, lights: Array) -> Array:
        """Exit radiance for unit albedo after one bounce or more, (lights, patches)."""
        return self.direct(lights) @ self.bounces.T


def held_back(spacing: float) -> tuple[Array, Array]:
    """Lamps (LAMPS, 3) inside the outermost lights of a cloud, and near walls beyond them."""
    generator = np.random.default_rng(1)
    inside = generator.uniform(spacing / 2, 1 - spacing / 2, (LAMPS, 3))
    anywhere = generator.uniform(0.02, 0.98, (50 * LAMPS, 3))
    return inside, anywhere[np.minimum(anywhere, 1 - anywhere).min(axis=1) < spacing / 2][:LAMPS]


def errors(field: BoxField, interpolator: CloudInterpolator, responses: list[Array], zones: list[NDArray[np.int64]],
           lamps: Array) -> list[float]:
    """Mean and largest error in per cent. responses: of each zone's lights at the zone's patches."""
    truth, weights = field.response(lamps), interpolator.weights(lamps).weights
    found = np.empty_like(truth)
    for number, (own, members) in enumerate(zip(responses, zones, strict=True)):
        found[:, members] = weights[:, number, :len(own)] @ own
    error = 100.0 * np.sqrt(((found - truth) ** 2).mean(axis=1) / (truth ** 2).mean(axis=1))
    return [float(error.mean()), float(error.max())]


def error_table(field: BoxField, tracer: Tracer) -> None:
    """Error against kernel, number of nearest lights, and spacing."""
    rows, everywhere = [], [np.arange(len(field.places))]
    for side in (4, 6, 8, 10):
        placed = place_lights(tracer, [box_matrix((0, 0, 0), (1, 1, 1))], count=side ** 3)
        cloud = LightCloud.of_zones([placed.positions], placed.positions, placed.spacing)
        inside, near = held_back(placed.spacing)
        for kind, nearest in (("published", 8), ("published", 12), ("published", 16), ("linear", 8), ("linear", 12),
                              ("linear", 16)):
            interpolator = CloudInterpolator(cloud, tracer, nearest, kind)
            known = [field.response(placed.positions)]
            rows.append([side ** 3, kind, nearest, *errors(field, interpolator, known, everywhere, inside),
                         *errors(field, interpolator, known, everywhere, near)])
    print_table(["lights", "kernel", "nearest", "inside %", "largest", "near walls %", "largest"], rows)


def merging_table(field: BoxField, tracer: Tracer) -> None:
    """Lights kept in 8 zones of 216, and error, against the largest difference that merges and what merged lights
    answer with."""
    placed = place_lights(tracer, [box_matrix((0, 0, 0), (1, 1, 1))], count=216)
    inside, near = held_back(placed.spacing)
    split = split_zones(field.places, len(field.places) // 8 + 1)
    zones, rows = split.members(), []
    known = field.response(placed.positions)
    for difference in (0.0, 0.01, 0.02, 0.05, 0.1, 0.2):
        for mode in ("solution", "arithmetic", "harmonic"):
            places, answers = [], []
            for members in zones:
                own = np.ascontiguousarray(known[:, members].T[:, :, None], np.float32)
                largest = largest_response(own)
                w1, w2 = default_weights(3 ** 0.5, largest, largest_difference=difference or 1e-12)
                labels = merge_lights(placed.positions, own, None, w1, w2)
                places.append(merged_positions(tracer, placed.positions, labels))
                answers.append(field.response(places[-1])[:, members] if mode == "solution"
                               else merged_response(own, labels, mode)[:, :, 0].T)
            cloud = LightCloud.of_zones(places, placed.positions, placed.spacing)
            interpolator = CloudInterpolator(cloud, tracer)
            rows.append([difference, mode, len(zones), float(np.diff(cloud.zone_starts).mean()), cloud.most_lights,
                         *errors(field, interpolator, answers, zones, inside),
                         *errors(field, interpolator, answers, zones, near)])
    print_table(["difference", "response", "zones", "lights kept", "most", "inside %", "largest", "near walls %",
                 "largest"], rows)


def clustering_rows(lights: int, receivers: int, values: int, with_pdist: bool) -> Iterator[list[object]]:
    """Seconds for the distances of lights on a grid, in fields of mirrored lights, and of scipy's for the same."""
    side = round(lights ** (1 / 3))
    line = (np.arange(side) + 0.5) / side
    positions = np.stack(np.meshgrid(line, line, line, indexing="ij"), axis=-1).reshape(-1, 3)
    generator = np.random.default_rng(0)
    places = generator.uniform(0, 1, (receivers, 3))
    places[np.arange(receivers), generator.integers(0, 3, receivers)] = generator.integers(0, 2, receivers)
    responses = np.zeros((receivers, len(positions), values), np.float32)
    for value in range(values):
        for axis in range(3):
            for wall in (0.0, 1.0):
                mirrored = positions.copy()
                mirrored[:, axis] = 2 * wall - mirrored[:, axis]
                squared = sum(np.subtract.outer(places[:, k], mirrored[:, k]).astype(np.float32) ** 2 for k in range(3))
                responses[:, :, value] += 0.2 / np.maximum(squared + np.float32(0.02 * value), np.float32(0.05))
    peer = ""
    if with_pdist:
        by_light = np.ascontiguousarray(responses[:, :, 0].T)
        peer = best_of(1, lambda: pdist(by_light, "chebyshev"))[0]
    for difference in (0.05, 0.2):
        w1, w2 = default_weights(3 ** 0.5, largest_response(responses), largest_difference=difference)
        seconds, delta = best_of(2, lambda w1=w1, w2=w2: light_distances(positions, responses, w1, w2))
        started = time.perf_counter()
        labels = merge_lights(positions, responses, None, w1, w2)
        yield [len(positions), receivers, values, difference, seconds, peer, time.perf_counter() - started,
               int((delta < 1.0).sum()), int(labels.max()) + 1]


def move_table(tracer: Tracer) -> None:
    """Milliseconds to weigh lamps in zones of 100 merged lights each."""
    generator, rows = np.random.default_rng(2), []
    for zones in (1, 8, 16, 64):
        places = [generator.uniform(0, 1, (100, 3)) for _ in range(zones)]
        interpolator = CloudInterpolator(LightCloud.of_zones(places, places[0], 0.2), tracer)
        for lamps in (1, 4, 16):
            positions = generator.uniform(0, 1, (lamps, 3))
            tree = best_of(20, lambda i=interpolator, p=positions: i._nearest(p))[0]
            rays, near = best_of(20, lambda i=interpolator, p=positions: i.neighbours(p))
            weigh = best_of(20, lambda i=interpolator, n=near: i.weigh(n))[0]
            rows.append([zones, lamps, 1e3 * tree, 1e3 * (rays - tree), 1e3 * weigh, 1e3 * (rays + weigh)])
    print_table(["zones", "lamps", "kd-tree ms", "rays ms", "weights ms", "all ms"], rows)


def main() -> None:
    """Parse the command line and print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("parts", nargs="*", default=["clustering", "error", "merging", "moves"])
    parts, tracer = parser.parse_args().parts, Tracer(CUBE, FACES, 1)
    if "error" in parts or "merging" in parts:
        field = BoxField()
    if "error" in parts:
        error_table(field, tracer)
    if "merging" in parts:
        merging_table(field, tracer)
    if "moves" in parts:
        move_table(tracer)
    if "clustering" in parts:
        print_table(["lights", "receivers", "values", "difference", "delta s", "pdist s", "with linkage s", "pairs < 1",
                     "clusters"], [row for case in ((1000, 50820, 1, True), (1000, 20000, 3, False),
                                                    (4096, 20000, 1, False)) for row in clustering_rows(*case)])


if __name__ == "__main__":
    main()
