# SPDX-License-Identifier: GPL-3.0-or-later
"""Measures what ray_cost.py needs of a graphics device, on a scene of its own: a few seconds, once per machine."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .ray_cost import Calibration
from .ray_engine import (
    CELLS,
    FARTHEST,
    GROUP,
    MASKED,
    PAIRS,
    TRAVERSAL,
    WIDTH,
    RayDevice,
    RayEngine,
    code_texels,
    in_rows,
    ray_texels,
    texels_of_bits,
)

# Kernels are measured with as many rays as take this long, so that even a software driver ends within seconds.
KERNEL_SECONDS = 0.02
TRIANGLES_OF_FILL = 1024
TRANSFER_ROWS = 256  # of WIDTH texels: 8 MB
BALLS, BALL_RINGS = 4, 16  # along each axis; quads of a ball from pole to pole
RAYS, DIRECTIONS = 1 << 15, 16  # origins, and directions from each: rays as a bake has them
SECONDS_OF_RATES, MOST_RUNS = 0.5, 20


def calibrate(device: RayDevice, embree: Callable[[NDArray, NDArray, NDArray], Callable[[NDArray, NDArray], Any]],
              threads: int) -> Calibration:
    """Measure a device. embree: given points and triangles in tracing space, what traces shadow rays from all origins
    (n, 3) in all directions (d, 3) on `threads` threads."""
    points, triangles = ball_field()
    origins, directions = field_rays(points)
    engine = RayEngine(device, points, triangles)
    engine.occluded(origins[:GROUP], directions[:1])  # compiles
    engine.nearest(origins[:GROUP], directions[:1])
    latency, readback, upload = transfers(device)
    traversal = RAYS / _steady(lambda count: traversal_seconds(engine, origins[:count], directions[:1], True), RAYS)
    fill = 1.0 / seconds_per_test(engine)
    step = all_pairs_seconds(engine, GROUP, TRIANGLES_OF_FILL, GROUP) / TRIANGLES_OF_FILL
    codes, asked = np.arange(RAYS * DIRECTIONS), np.ones((DIRECTIONS, RAYS), bool)
    occluded = _rate(lambda: engine.occluded_where(origins, directions, asked))
    nearest = _rate(lambda: engine.nearest_pairs(origins, directions, codes))
    trace = embree(points, triangles)
    cpu = _rate(lambda: trace(origins, directions))
    return Calibration(device.name, fill, readback, upload, latency, step, traversal, nearest, occluded, cpu, threads)


def ball_field() -> tuple[NDArray[np.float32], NDArray[np.int32]]:
    """Balls in a row, a column and a pile, of unit diagonal around the origin: points (p, 3), triangles (t, 3)."""
    rings, turns = np.meshgrid(np.arange(BALL_RINGS + 1), np.arange(2 * BALL_RINGS), indexing="ij")
    polar, azimuth = np.pi * rings / BALL_RINGS, np.pi * turns / BALL_RINGS
    ball = np.stack([np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), np.cos(polar)], axis=-1)
    ball = ball.reshape(-1, 3)
    ring, turn = (part.ravel() for part in np.meshgrid(np.arange(BALL_RINGS), np.arange(2 * BALL_RINGS), indexing="ij"))
    a, b = ring * 2 * BALL_RINGS + turn, ring * 2 * BALL_RINGS + (turn + 1) % (2 * BALL_RINGS)
    quad = np.stack([a, a + 2 * BALL_RINGS, b + 2 * BALL_RINGS, b], axis=1)
    faces = np.concatenate([quad[:, [0, 1, 2]], quad[:, [0, 2, 3]]])
    steps = np.arange(BALLS) - 0.5 * (BALLS - 1)
    centres = np.stack(np.meshgrid(steps, steps, steps), axis=-1).reshape(-1, 3)
    points = (0.42 * ball[None] + centres[:, None]).reshape(-1, 3)
    triangles = (faces[None] + len(ball) * np.arange(len(centres))[:, None, None]).reshape(-1, 3)
    return (points / (np.sqrt(3.0) * BALLS)).astype(np.float32), triangles.astype(np.int32)


def field_rays(points: NDArray[np.float32]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Origins (RAYS, 3) between the balls, in the order of a curve through space, and directions (DIRECTIONS, 3)."""
    generator = np.random.default_rng(1)
    origins = generator.uniform(points.min(axis=0), points.max(axis=0), (RAYS, 3)).astype(np.float32)
    directions = generator.normal(size=(DIRECTIONS, 3))
    directions /= np.sqrt((directions ** 2).sum(axis=1, keepdims=True))
    cell = np.clip((origins + 0.5) * 64, 0, 63).astype(np.int64)
    key = np.zeros(RAYS, np.int64)
    for bit in range(5, -1, -1):
        for axis in range(3):
            key = 2 * key + ((cell[:, axis] >> bit) & 1)
    return origins[np.argsort(key, kind="stable")], directions.astype(np.float32)


def transfers(device: RayDevice) -> tuple[float, float, float]:
    """Latency in seconds (the smallest texture sent and read), readback and upload in bytes per second."""
    small, large = np.zeros((1, WIDTH, 4), np.float32), np.ones((TRANSFER_ROWS, WIDTH, 4), np.float32)
    latency = _best(lambda: device.read(device.upload(small)), 5)
    texture = device.upload(large)
    device.read(texture)
    readback = large.nbytes / max(_best(lambda: device.read(texture), 5) - latency, 1e-9)
    both = _best(lambda: device.read(device.upload(large)), 5)  # a lone upload returns before it is done
    return latency, readback, large.nbytes / max(both - large.nbytes / readback - latency, 1e-9)


def seconds_per_test(engine: RayEngine, bucket_rays: int = GROUP, triangles: int = TRIANGLES_OF_FILL) -> float:
    """Seconds of a test of a ray against a triangle when all pairs are made, without transfers."""
    def measure(tests: int) -> float:
        rays = max(GROUP, tests // triangles // bucket_rays * bucket_rays)
        return all_pairs_seconds(engine, rays, triangles, bucket_rays) / rays * max(tests // triangles, 1)
    tests = 1 << 30
    return _steady(measure, tests) / tests


def all_pairs_seconds(engine: RayEngine, rays: int, triangles: int, bucket_rays: int) -> float:
    """Seconds of the kernel alone for all pairs of so many rays and triangles, every bucket against the same ones."""
    device = engine.device
    run, answers = all_pairs_run(engine, rays, triangles, bucket_rays)
    return _kernel_seconds(device, run, answers)


def all_pairs_run(engine: RayEngine, rays: int, triangles: int, bucket_rays: int) -> tuple[Callable[[], None], Any]:
    """What starts that kernel, and its answers' texture."""
    device = engine.device
    generator = np.random.default_rng(2)
    origins = generator.uniform(-0.5, 0.5, (rays, 3)).astype(np.float32)
    directions = generator.normal(size=(rays, 3)).astype(np.float32)
    buckets = -(-rays // bucket_rays)
    pairs = np.zeros((buckets, 4), np.float32)
    pairs[:, 0], pairs[:, 1] = np.arange(buckets), 1
    cells = np.zeros((buckets, 4), np.float32)
    cells[:, 1] = triangles
    textures = {"ray_origins": device.upload(ray_texels(origins, FARTHEST)),
                "ray_directions": device.upload(ray_texels(directions, np.float32(0.0))),
                "triangle_values": engine.triangle_texture, "bucket_values": device.upload(in_rows(pairs)),
                "pair_values": device.upload(in_rows(cells))}
    answers = device.empty(WIDTH, -(-rays // WIDTH))
    constants = {"rays": rays, "direction_step": 1, "bucket_rays": bucket_rays}
    return lambda: device.run(CELLS, False, textures, answers, constants, -(-rays // GROUP)), answers


def traversal_seconds(engine: RayEngine, origins: NDArray[np.float32], directions: NDArray[np.float32],
                      occluded: bool) -> float:
    """Seconds of the kernel that walks the tree alone, rays and answers staying on the device; in one dispatch."""
    device = engine.device
    textures = {"ray_origins": device.upload(ray_texels(origins, FARTHEST)),
                "ray_directions": device.upload(ray_texels(directions, np.float32(0.0))),
                "node_values": engine.node_texture, "triangle_values": engine.triangle_texture}
    groups = -(-len(origins) // GROUP)
    answers = device.empty(WIDTH, -(-(groups if occluded else groups * GROUP) // WIDTH))
    constants = {"rays": len(origins), "direction_step": int(len(directions) > 1)}
    return _kernel_seconds(device, lambda: device.run(TRAVERSAL, occluded, textures, answers, constants, groups),
                           answers)


def pairs_seconds(engine: RayEngine, origins: NDArray[np.float32], directions: NDArray[np.float32],
                  asked: NDArray[np.bool_], occluded: bool) -> float:
    """As `traversal_seconds`, of the pairs that are asked for (`RayEngine.nearest_pairs`, `occluded_where`)."""
    device, codes = engine.device, np.flatnonzero(asked)
    rays, constants = len(codes), {"origins": len(origins)}
    textures = {"ray_origins": device.upload(ray_texels(origins, FARTHEST)),
                "ray_directions": device.upload(ray_texels(directions, np.float32(0.0))),
                "node_values": engine.node_texture, "triangle_values": engine.triangle_texture}
    if occluded:
        rays, constants["first"] = asked.size // GROUP * GROUP, 0
        textures["asked_bits"] = device.upload(in_rows(texels_of_bits(asked.ravel()[:rays])))
    else:
        textures["pair_codes"] = device.upload(code_texels(codes))
    groups = -(-rays // GROUP)
    answers = device.empty(WIDTH, -(-(groups if occluded else groups * GROUP) // WIDTH))
    kernel = MASKED if occluded else PAIRS
    return _kernel_seconds(device, lambda: device.run(kernel, occluded, textures, answers,
                                                      {"rays": rays, **constants}, groups), answers)


def _kernel_seconds(device: RayDevice, run: Callable[[], None], answers: Any) -> float:
    """Of a kernel alone: what it takes to run it a few times more before the answers are read."""
    def several(times: int) -> None:
        for _ in range(times):
            run()
        device.read(answers)
    several(1)
    once, thrice = _best(lambda: several(1), 3), _best(lambda: several(3), 3)
    return max(0.5 * (thrice - once), 1e-7)


def _steady(measure: Callable[[int], float], wanted: int) -> float:
    """Seconds for `wanted` units, measured with as many as take KERNEL_SECONDS."""
    units = max(GROUP, wanted >> 12)
    for _ in range(12):
        took = measure(units)
        if took >= 0.5 * KERNEL_SECONDS or units >= wanted:
            break
        units = int(min(wanted, units * min(8.0, max(1.5, KERNEL_SECONDS / took))))
    return took * wanted / units


def _rate(trace: Callable[[], Any]) -> float:
    """Rays per second of a call that traces all directions from all origins: the best of as many as fit the time."""
    best, began = 0.0, time.perf_counter()
    for _ in range(MOST_RUNS):
        started = time.perf_counter()
        trace()
        best = max(best, RAYS * DIRECTIONS / (time.perf_counter() - started))
        if time.perf_counter() - began > SECONDS_OF_RATES:
            break
    return best


def _best(work: Callable[[], Any], runs: int) -> float:
    least = float("inf")
    for _ in range(runs):
        started = time.perf_counter()
        work()
        least = min(least, time.perf_counter() - started)
    return least
