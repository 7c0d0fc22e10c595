# SPDX-License-Identifier: GPL-3.0-or-later
"""Milliseconds for direct light of lamps at a mesh's vertices, as the preview computes it while a lamp moves.

    python benchmarks/direct_light.py [--mesh buddha_nirj.obj] [--threads 2] [--runs 7]

`aim`: what each receiver could get and where to look; `rays`: shadow rays and adding up; both on one thread. The rest
of the table is the whole call. Floor: 12 ms for one hard lamp at 50k receivers on two free threads.
"""

from __future__ import annotations

import argparse
import math
import os
import time

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as in the bake's process; before numpy loads

import numpy as np
from common import MESHES, best_of, load_obj, print_table, smooth_object

from prt_addon.lighting.local_lights import LocalLight
from prt_addon.relighting import direct_light
from prt_addon.relighting.direct_light import LitReceivers, direct_local_light
from prt_addon.scene.receivers import morton_order
from prt_addon.scene.scene_mesh import SceneMesh
from prt_addon.tracing.tracer import Tracer


def wavy_ball(vertices: int) -> tuple[np.ndarray, np.ndarray]:
    """A bumpy ball of about so many vertices, for machines without the shared meshes."""
    rows = int(math.sqrt(vertices / 2))
    latitude, longitude = np.meshgrid(np.linspace(0, math.pi, rows), 2 * math.pi * np.arange(2 * rows) / (2 * rows),
                                      indexing="ij")
    radius = 1 + 0.1 * np.sin(9 * latitude) * np.sin(8 * longitude)
    positions = radius[..., None] * np.stack([np.sin(latitude) * np.cos(longitude),
                                              np.sin(latitude) * np.sin(longitude), np.cos(latitude)], axis=-1)
    first = np.arange((rows - 1) * 2 * rows)
    right = first // (2 * rows) * (2 * rows) + (first + 1) % (2 * rows)
    down = first + 2 * rows
    triangles = np.concatenate([np.stack([first, down, right], axis=1),
                                np.stack([right, down, right + 2 * rows], axis=1)])
    return positions.reshape(-1, 3), triangles.astype(np.int32)


def lamps(kind: str, number: int, middle: np.ndarray, reach: float, **options: object) -> list[LocalLight]:
    """Lamps on a ring about the mesh that shine at it, as far from its middle as it is wide."""
    found = []
    for turn in 2 * math.pi * np.arange(number) / number + 0.3:
        away = np.array([math.cos(turn), 0.4, math.sin(turn)])
        away /= math.sqrt(float(np.sum(away * away)))
        side = np.cross([0.0, 1.0, 0.0], away)
        side /= math.sqrt(float(np.sum(side * side)))
        matrix = np.eye(4)
        matrix[:3, :3] = np.stack([side, np.cross(away, side), away], axis=1)
        matrix[:3, 3] = middle + reach * away
        found.append(LocalLight(f"{kind} {turn:.2f}", kind, matrix, np.full(3, 10.0 * reach * reach), **options))
    return found


def parts(tracer: Tracer, receivers: LitReceivers, lights: list[LocalLight], runs: int) -> tuple[float, float]:
    """Seconds of aiming and of tracing on one thread."""
    sources = [direct_light._Source.of(light, tracer, receivers, 16, 0, 0.0) for light in lights]
    places = [slice(start, min(start + direct_light.BLOCK, len(receivers)))
              for start in range(0, len(receivers), direct_light.BLOCK)]
    least = [float("inf")] * 2
    for _ in range(runs):
        spent = [0.0, 0.0]
        for place in places:
            for source in sources:
                started = time.perf_counter()
                aimed = direct_light._aim(source, receivers.places[:, place], receivers.normals[:, place])
                middle = time.perf_counter()
                direct_light._seen(tracer, receivers, place, aimed, True)
                spent[0] += middle - started
                spent[1] += time.perf_counter() - middle
        least = [min(a, b) for a, b in zip(least, spent, strict=True)]
    return least[0], least[1]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--mesh", default="buddha_nirj.obj")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--runs", type=int, default=7)
    arguments = parser.parse_args()
    path = MESHES / arguments.mesh
    positions, triangles = load_obj(path) if path.exists() else wavy_ball(50_000)
    scene = SceneMesh.assemble([smooth_object("mesh", positions, triangles, (0.7, 0.7, 0.7))])
    tracer = Tracer(scene.points, scene.triangles, arguments.threads)
    in_order = LitReceivers.of_points(tracer, scene.points, scene.normals)
    order = morton_order(scene.points)
    seconds, _ = best_of(arguments.runs, lambda: morton_order(scene.points))
    print(f"{len(scene.points)} receivers, {arguments.threads} threads; Morton order in {1000 * seconds:.1f} ms\n")
    sorted_ones = LitReceivers.of_points(tracer, scene.points[order], scene.normals[order])
    middle, size = scene.points.mean(axis=0), tracer.diagonal
    cases = [("1 hard point", lamps("point", 1, middle, size)), ("4 hard points", lamps("point", 4, middle, size)),
             ("16 hard points", lamps("point", 16, middle, size)),
             ("1 hard spot", lamps("spot", 1, middle, size, spot_angle=0.7, spot_blend=0.15)),
             ("1 soft point", lamps("point", 1, middle, size, radius=0.1 * size)),
             ("1 soft spot", lamps("spot", 1, middle, size, spot_angle=0.7, spot_blend=0.15, radius=0.1 * size)),
             ("1 wide-blend soft spot", lamps("spot", 1, middle, size, spot_angle=0.9, spot_blend=1.0,
                                              radius=0.02 * size)),
             ("1 rectangle", lamps("area", 1, middle, size, size=(0.2 * size, 0.2 * size))),
             ("1 disc", lamps("area", 1, middle, size, size=(0.2 * size, 0.2 * size), shape="ellipse")),
             ("1 rectangle of spread 90 degrees", lamps("area", 1, middle, size, size=(0.2 * size, 0.2 * size),
                                                        spread=0.5 * math.pi))]
    rows = []
    for name, lights in cases:
        before = tracer.rays
        direct_local_light(tracer, sorted_ones, lights)
        rays = tracer.rays - before
        sorted_time, _ = best_of(arguments.runs, lambda lights=lights: direct_local_light(tracer, sorted_ones, lights))
        time_in_order, _ = best_of(arguments.runs, lambda lights=lights: direct_local_light(tracer, in_order, lights))
        aim, trace = parts(tracer, sorted_ones, lights, max(arguments.runs // 2, 1))
        rows.append([name, rays, 1000 * aim, 1000 * trace, 1000 * sorted_time, 1000 * time_in_order])
    print_table(["lamps", "rays", "aim ms", "rays ms", "Morton order ms", "mesh order ms"], rows)


if __name__ == "__main__":
    main()
