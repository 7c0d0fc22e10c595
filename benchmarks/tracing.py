# SPDX-License-Identifier: GPL-3.0-or-later
"""Shadow rays per second of the bake against raw embreex on the same rays, and a bake end to end against its tracing.

    python benchmarks/tracing.py [--mesh buddha_nirj.obj] [--directions 1024] [--threads 2] [--runs 3]

The floors (design/performance.md, issue 2): the bake's tracing reaches 0.8 of raw embreex; a bake of order 5 with one
bounce takes at most 1.5 x its tracing.
"""

from __future__ import annotations

import argparse
import os
import time
from concurrent.futures import ThreadPoolExecutor

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as in the bake's process; before numpy loads

import numpy as np
from common import best_of, drain, load_obj, mesh_path, print_table, smooth_object

from prt_addon.baking.recipe import bake, exhaust
from prt_addon.baking.settings import BakeSettings
from prt_addon.basis.directions import quadrature
from prt_addon.scene.scene_mesh import SceneMesh
from prt_addon.tracing.tracer import Tracer
from prt_addon.transport.direct import CHUNK, cosine_visibility, direct_transfer
from prt_addon.transport.receiver_set import ReceiverSet, blocks


def raw_seconds(tracer: Tracer, receivers: ReceiverSet, directions: np.ndarray, threads: int) -> tuple[float, int]:
    """Seconds and number of the same rays through embreex alone: origins culled and sorted beforehand."""
    scene, single = tracer._scene, directions.astype(np.float32)
    normals = receivers.normals.astype(np.float32)
    rays = 0
    started = 0.0
    seconds = 0.0
    for start in range(0, len(single), 128):  # in parts, to bound memory
        part = single[start:start + 128]
        origins = [np.ascontiguousarray(receivers.origins[normals @ d > 0.0]) for d in part]
        rays += sum(map(len, origins))
        started = time.perf_counter()
        with ThreadPoolExecutor(threads) as pool:
            list(pool.map(lambda i, o=origins, p=part: scene.run(o[i], p[i:i + 1], query="OCCLUDED"), range(len(part))))
        seconds += time.perf_counter() - started
    return seconds, rays


def trace_only(tracer: Tracer, receivers: ReceiverSet, directions: np.ndarray) -> None:
    """The shadow stage's tracing as the bake does it (culling, faces' horizons, occlusion), without the projection."""
    single = directions.astype(np.float32)
    tasks = ((block.receivers, single[start:start + CHUNK]) for block in blocks(len(receivers), 0, 0)
             for start in range(0, len(single), CHUNK))
    for _ in tracer.map_in_order(lambda task: cosine_visibility(tracer, receivers, *task), tasks):
        pass


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--mesh", default="buddha_nirj.obj")
    parser.add_argument("--directions", type=int, default=1024)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--runs", type=int, default=3)
    arguments = parser.parse_args()
    positions, triangles = load_obj(mesh_path(arguments.mesh))
    scene = SceneMesh.assemble([smooth_object("mesh", positions, triangles, (0.7, 0.7, 0.7))])
    tracer = Tracer(scene.points, scene.triangles, arguments.threads)
    receivers = ReceiverSet.of_keys(scene, tracer, np.flatnonzero(~scene.loose))
    directions, weights = quadrature(arguments.directions, 5)
    rows = []
    for _ in range(arguments.runs):  # interleaved: a busy neighbour slows both
        raw, rays = raw_seconds(tracer, receivers, directions, arguments.threads)
        tracing, _ = best_of(1, lambda: trace_only(tracer, receivers, directions))
        ours, _ = best_of(1, lambda: drain(direct_transfer(tracer, receivers, directions, weights, 5)))
        rows.append([len(receivers), rays, rays / raw / 1e6, rays / tracing / 1e6, raw / tracing, rays / ours / 1e6,
                     raw / ours])
    print_table(["receivers", "rays", "raw Mray/s", "tracing Mray/s", "ratio (floor 0.8)", "with projection Mray/s",
                 "ratio"], rows)
    bakes(scene, arguments)


def bakes(scene: SceneMesh, arguments: argparse.Namespace) -> None:
    """Whole bakes: stage seconds, and total over tracing."""
    settings = BakeSettings(order=5, directions=arguments.directions, gather_directions=128, bounces=1, clusters=256,
                            vectors=8, encoder="static", threads=arguments.threads, error_receivers=0, spacing=0.0)
    rows = []
    for encoder in ("static", "iterative"):
        report = exhaust(bake(scene, BakeSettings(**{**settings.as_dict(), "encoder": encoder}))).report
        seconds = {stage["name"]: stage["seconds"] for stage in report["stages"]}
        tracing = seconds["gather"] + seconds["direct"]
        rows.append([encoder, *(seconds[n] for n in ("prepare", "gather", "direct", "interreflection", "encode")),
                     report["seconds"], report["seconds"] / tracing])
    print()
    print_table(["encoder", "prepare s", "gather s", "direct s", "bounce s", "encode s", "total s",
                 "total / tracing (limit 1.5)"], rows)


if __name__ == "__main__":
    main()
