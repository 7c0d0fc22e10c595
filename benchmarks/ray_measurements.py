# SPDX-License-Identifier: GPL-3.0-or-later
"""What is measured of the ray engine, whatever graphics library runs it: shared by ray_engine.py (Blender's GPU module)
and device_ray_engine.py (moderngl, on a machine without Blender)."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from prt_addon.tracing.hits import Hits
from prt_addon.tracing.ray_buckets import make_buckets, pair_with_cells
from prt_addon.tracing.ray_calibration import all_pairs_run, pairs_seconds, traversal_seconds
from prt_addon.tracing.ray_cost import Calibration, gpu_share
from prt_addon.tracing.ray_engine import FARTHEST, MOST_RAYS, RayEngine

# Distances that agree so far are the same place; weights of corners below this lie on an edge; smaller cosines graze.
SAME_PLACE, ON_EDGE, GRAZING = 2e-6, 2e-5, 2e-3
LONGEST = 0.25  # seconds of one dispatch
KINDS = ("parallel", "gather")


@dataclass(frozen=True)
class Scene:
    """points (p, 3) float32 in tracing space, triangles (t, 3) int32; origins, normals: (r, 3), where rays start."""

    name: str
    points: NDArray[np.float32]
    triangles: NDArray[np.int32]
    origins: NDArray[np.float32]
    normals: NDArray[np.float32]


class Embree:
    """embreex with all cores by threads."""

    def __init__(self, points: NDArray[np.float32], triangles: NDArray[np.int32], threads: int = 0) -> None:
        from embreex import mesh_construction, rtcore_scene
        self.scene = rtcore_scene.EmbreeScene()
        mesh_construction.TriangleMesh(self.scene, points, triangles)
        self.threads = threads or len(os.sched_getaffinity(0))
        self._pool = ThreadPoolExecutor(self.threads + (self.threads > 1))

    def _parts(self, work: Callable[[slice], Any], count: int) -> list[Any]:
        step = max(1024, -(-count // (4 * self.threads)))
        return list(self._pool.map(work, [slice(start, start + step) for start in range(0, count, step)]))

    def nearest(self, origins: NDArray[np.float32], directions: NDArray[np.float32]) -> Hits:
        """Nearest hits."""
        def trace(part: slice) -> Any:
            given = directions if len(directions) == 1 else directions[part]
            return self.scene.run(np.ascontiguousarray(origins[part]), np.ascontiguousarray(given), query="INTERSECT",
                                  output=1)
        found = self._parts(trace, len(origins))
        joined = {name: np.concatenate([part[name] for part in found]) for name in ("primID", "u", "v", "tfar", "Ng")}
        front = np.sum(joined["Ng"] * directions, axis=1) < 0.0
        return Hits(joined["primID"], joined["u"], joined["v"], front, joined["tfar"])

    def occluded(self, origins: NDArray[np.float32], directions: NDArray[np.float32]) -> NDArray[np.bool_]:
        """Whether rays hit."""
        def trace(part: slice) -> Any:
            given = directions if len(directions) == 1 else directions[part]
            return self.scene.run(np.ascontiguousarray(origins[part]), np.ascontiguousarray(given),
                                  query="OCCLUDED") >= 0
        return np.concatenate(self._parts(trace, len(origins)))


    def occluded_where(self, origins: NDArray[np.float32], directions: NDArray[np.float32],
                       asked: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """As the bake's shadow rays: one direction after the other, in threads."""
        found = np.zeros(asked.shape, bool)

        def trace(k: int) -> None:
            chosen = np.flatnonzero(asked[k])
            found[k, chosen] = self.scene.run(np.take(origins, chosen, axis=0), directions[k:k + 1],
                                              query="OCCLUDED") >= 0
        list(self._pool.map(trace, range(len(directions))))
        return found

    def nearest_where(self, origins: NDArray[np.float32], directions: NDArray[np.float32],
                      asked: NDArray[np.bool_]) -> Hits:
        """As the bake's gather rays."""
        which, row = np.nonzero(asked)
        return self.nearest(np.take(origins, row, axis=0), np.take(directions, which, axis=0))


def block_of_rays(scene: Scene, count: int, seed: int) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Directions (d, 3) over the sphere, and which origins face each (d, r): about `count` rays, as a bake has them."""
    directions = np.random.default_rng(seed).normal(size=(max(1, 2 * count // len(scene.origins)), 3))
    directions = (directions / np.linalg.norm(directions, axis=1, keepdims=True)).astype(np.float32)
    return directions, np.stack([(scene.normals * direction).sum(axis=1) > 0.0 for direction in directions])


def gpu_where(engine: RayEngine, query: str, scene: Scene, directions: NDArray[np.float32],
              asked: NDArray[np.bool_]) -> Any:
    """What MixedTracer.occluded_where and nearest_where do."""
    if query == "nearest":
        return engine.nearest_pairs(scene.origins, directions, np.flatnonzero(asked))
    return engine.occluded_where(scene.origins, directions, asked)


def make_rays(scene: Scene, kind: str, count: int, seed: int) -> list[tuple[NDArray[np.float32], NDArray[np.float32]]]:
    """Batches (origins, directions) of `count` rays in all. "parallel": one direction for all origins that face it, as
    shadow rays of a bake; "gather": from each origin a random direction of its hemisphere, as rays for bounces."""
    generator, batches, made = np.random.default_rng(seed), [], 0
    while made < count:
        if kind == "parallel":
            direction = generator.normal(size=(1, 3))
            direction = (direction / np.linalg.norm(direction)).astype(np.float32)
            origins = np.ascontiguousarray(scene.origins[(scene.normals * direction).sum(axis=1) > 0.0])
            batches.append((origins[:count - made], direction))
        else:
            turned = generator.normal(size=(8 * len(scene.origins), 3))
            turned /= np.linalg.norm(turned, axis=1, keepdims=True)
            normals, origins = np.repeat(scene.normals, 8, axis=0), np.repeat(scene.origins, 8, axis=0)
            lobe = normals + turned
            keep = np.linalg.norm(lobe, axis=1) > 1e-3
            directions = lobe[keep] / np.linalg.norm(lobe[keep], axis=1, keepdims=True)
            batches.append((origins[keep][:count - made], directions.astype(np.float32)[:count - made]))
        made += len(batches[-1][0])
    return batches


@dataclass
class Agreement:
    """Of rays traced twice. `same` triangle; `edge`: the ray passes within rounding of an edge of the triangle that one
    of the two chose (a neighbour was chosen, or beside a silhouette none); `place`: another triangle at the same
    distance; `grazing`: the triangle is seen edge-on; `other`: everything else, which must be none. Misses of both
    (leaks in a closed room). Largest differences in distance and weights where the triangle is the same, and the
    number beyond 1e-5 in distance."""

    rays: int = 0
    same: int = 0
    edge: int = 0
    place: int = 0
    grazing: int = 0
    other: int = 0
    embree_misses: int = 0
    gpu_misses: int = 0
    distance: float = 0.0
    weights: float = 0.0
    far: int = 0
    side: int = 0
    occlusion: int = 0


def edge_and_cosine(scene: Scene, triangle: NDArray[np.integer], origins: NDArray[np.float32],
                    directions: NDArray[np.float32]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """In double precision: the distance of a ray's point in the triangle's plane from its nearest edge (weights of
    corners), and the cosine to its normal."""
    a, b, c = (scene.points[scene.triangles[triangle, k]].astype(np.float64) - origins for k in range(3))
    d = directions.astype(np.float64)
    weights = np.stack([np.sum(np.cross(q - p, q + p) * d, axis=1) for p, q in ((c, b), (a, c), (b, a))], axis=1)
    normal = np.cross(b - a, c - a)
    with np.errstate(divide="ignore", invalid="ignore"):
        shares = weights / weights.sum(axis=1, keepdims=True)
        cosine = np.abs(np.sum(normal * d, axis=1)) / np.linalg.norm(normal, axis=1)
    return np.nan_to_num(np.abs(shares).min(axis=1), nan=0.0), np.nan_to_num(cosine, nan=0.0)


def add_agreement(total: Agreement, scene: Scene, engine: RayEngine, embree: Embree, origins: NDArray[np.float32],
                  directions: NDArray[np.float32], trace: Callable[..., Hits] | None = None) -> None:
    """Trace a batch by both and add what agrees."""
    if trace is None and len(directions) == 1:  # rays of one direction go as pairs
        codes = np.arange(len(origins))
        ours = engine.nearest_pairs(origins, directions, codes)
        occluded = engine.occluded_where(origins, directions, np.ones((1, len(origins)), bool))[0]
    else:
        ours = (trace or engine.nearest)(origins, directions)
        occluded = ours.triangle >= 0 if trace else engine.occluded(origins, directions)
    theirs = embree.nearest(origins, directions)
    total.rays += len(origins)
    total.embree_misses += int((theirs.triangle < 0).sum())
    total.gpu_misses += int((ours.triangle < 0).sum())
    same = ours.triangle == theirs.triangle
    total.same += int(same.sum())
    both = same & (ours.triangle >= 0)
    difference = np.abs(ours.distance[both] - theirs.distance[both])
    total.distance = max(total.distance, float(difference.max(initial=0.0)))
    total.far += int((difference > 1e-5).sum())
    total.weights = max(total.weights, float(np.abs(ours.u[both] - theirs.u[both]).max(initial=0.0)),
                        float(np.abs(ours.v[both] - theirs.v[both]).max(initial=0.0)))
    total.side += int((ours.front[both] != theirs.front[both]).sum())
    odd = np.flatnonzero(~same)
    if len(odd):
        given = np.broadcast_to(directions, origins.shape)[odd]
        edge, grazing = np.zeros(len(odd), bool), np.zeros(len(odd), bool)
        for found in (ours, theirs):
            hit = np.flatnonzero(found.triangle[odd] >= 0)
            least, cosine = edge_and_cosine(scene, found.triangle[odd[hit]], origins[odd[hit]], given[hit])
            edge[hit] |= least < ON_EDGE
            grazing[hit] |= cosine < GRAZING
        hits = (ours.triangle[odd] >= 0) & (theirs.triangle[odd] >= 0)
        place = hits & (np.abs(ours.distance[odd] - theirs.distance[odd]) < SAME_PLACE)
        total.edge += int(edge.sum())
        total.place += int((place & ~edge).sum())
        total.grazing += int((grazing & ~edge & ~place).sum())
        total.other += int((~grazing & ~edge & ~place).sum())
    total.occlusion += int((occluded != (ours.triangle >= 0)).sum())


def agreement(scene: Scene, engine: RayEngine, embree: Embree, count: int, seconds: float = 1e9) -> Agreement:
    """Of `count` rays, half parallel and half gathering, or as many as fit the time."""
    total, began = Agreement(), time.perf_counter()
    for seed, kind in enumerate(KINDS):
        for origins, directions in make_rays(scene, kind, count // 2, seed):
            if time.perf_counter() - began > seconds * (seed + 1) / 2:
                break
            add_agreement(total, scene, engine, embree, origins, directions)
    return total


def rates(scene: Scene, engine: RayEngine, embree: Embree | None, count: int) -> list[list[Any]]:
    """Rows as RATES_HEADER says. "block": rays as a bake has them, many directions from each origin; "single": every
    ray sent with an origin and a direction of its own."""
    rows = []
    directions, asked = block_of_rays(scene, count, 5)
    rays = int(np.count_nonzero(asked))
    for query in ("occluded", "nearest"):
        alone = rays / pairs_seconds(engine, scene.origins, directions, asked, query == "occluded")
        gpu = rays / best_seconds(lambda q=query: gpu_where(engine, q, scene, directions, asked))
        cpu = np.nan if embree is None else rays / best_seconds(
            lambda q=query: getattr(embree, f"{q}_where")(scene.origins, directions, asked))
        rows.append([scene.name, "block", query, rays, alone / 1e6, gpu / 1e6, cpu / 1e6, gpu / cpu])
    batches = make_rays(scene, "gather", count, 7)
    rays = sum(len(origins) for origins, _ in batches)
    origins, given = batches[0][0][:MOST_RAYS], batches[0][1][:MOST_RAYS]
    for query in ("occluded", "nearest"):
        alone = len(origins) / traversal_seconds(engine, origins, given, query == "occluded")
        gpu = rays / best_seconds(lambda q=query: [getattr(engine, q)(*batch) for batch in batches])
        cpu = np.nan if embree is None else rays / best_seconds(
            lambda q=query: [getattr(embree, q)(*batch) for batch in batches])
        rows.append([scene.name, "single", query, rays, alone / 1e6, gpu / 1e6, cpu / 1e6, gpu / cpu])
    return rows


RATES_HEADER = ["scene", "rays", "query", "number", "GPU kernel alone, Mray/s", "GPU with transfers, Mray/s",
                "Embree Mray/s", "factor with transfers"]


def best_seconds(work: Callable[[], Any], runs: int = 2) -> float:
    """The least of some runs after one to warm up."""
    work()
    least = float("inf")
    for _ in range(runs):
        started = time.perf_counter()
        work()
        least = min(least, time.perf_counter() - started)
    return least


def model_rows(engine: RayEngine, known: Calibration, bucket_rays: list[int], triangles: list[int],
               ) -> list[list[Any]]:
    """Rows as MODEL_HEADER says, of all pairs of R rays and T triangles in one dispatch, rays sent before, answers read
    back (the paper's Figure 7).
    What would take longer than LONGEST is left out: a driver may take it for a hang."""
    rows = []
    for rays in bucket_rays:
        for count in triangles:
            if known.published(rays, count) > LONGEST:
                continue
            run, answers = all_pairs_run(engine, rays, count, min(rays, 256))

            def work(run: Callable[[], None] = run, answers: Any = answers) -> None:
                run()
                engine.device.read(answers)
            took = best_seconds(work, 5)
            published, ours, tests = known.published(rays, count), known.on_device(rays, count), rays * count
            rows.append([rays, count, 1e3 * took, 1e3 * published, 1e3 * ours, tests / took / 1e6,
                         tests / published / 1e6, tests / ours / 1e6])
    return rows


MODEL_HEADER = ["R", "T", "measured ms", "eq. 11 ms", "with latency and step, ms", "measured Mtests/s",
                "eq. 11 Mtests/s", "with latency and step, Mtests/s"]


def sweep(scene: Scene, engine: RayEngine, known: Calibration, kind: str, count: int, bucket_rays: list[int],
          triangles: list[int], cpu_rate: float) -> list[list[Any]]:
    """Rows of the published way for buckets of R rays and cells of T triangles: pairs per bucket, tests per ray,
    seconds of bucketing and pairing on the CPU, of the GPU as modelled and as measured, rays per second of all, share
    of buckets that the model gives the GPU beside a CPU of cpu_rate."""
    batches = make_rays(scene, kind, count, 11)
    origins = np.concatenate([origins for origins, _ in batches])[:count]
    directions = np.concatenate([np.broadcast_to(given, start.shape) for start, given in batches])[:count]
    directions = np.ascontiguousarray(directions)
    reach = np.full(len(origins), FARTHEST)
    rows = []
    for size in bucket_rays:
        for most in triangles:
            began = time.perf_counter()
            buckets = make_buckets(origins, directions, reach, size)
            pairs = pair_with_cells(buckets, engine.tree, most)
            paired = time.perf_counter() - began
            tests = np.add.reduceat(np.append(engine.tree.count[pairs.cell], 0).astype(float), pairs.first[:-1])
            tests[np.diff(pairs.first) == 0] = 0.0
            began = time.perf_counter()
            for _ in engine.pairs_steps(origins, directions, reach, buckets, pairs):
                if time.perf_counter() - began > 20.0:
                    break
            gpu = time.perf_counter() - began
            modelled = np.array([known.published(size, t) for t in tests])
            share = gpu_share(modelled, np.full(len(tests), size / cpu_rate)).mean()
            rows.append([scene.name, kind, size, most, len(pairs.cell) / len(buckets), tests.mean(), paired,
                         modelled.sum(), gpu, len(origins) / (paired + gpu) / 1e6, len(origins) / gpu / 1e6,
                         100.0 * share])
    return rows


SWEEP_HEADER = ["scene", "rays", "R", "T", "cells per bucket", "triangles per ray (all pairs)", "CPU pairing s",
                "eq. 11 s (no early end)", "GPU s", "Mray/s, pairing included", "Mray/s, GPU part",
                "% of buckets for the GPU"]
