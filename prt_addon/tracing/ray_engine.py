# SPDX-License-Identifier: GPL-3.0-or-later
"""Rays against triangles on a GPU, in slices: what is sent, what is run, what comes back.

Method: Carr, Hall & Hart 2002 (The Ray Engine). Two kernels give the same answers: `cells`, all pairs of a bucket's
rays and the triangles of the cells that it may meet, as published; `traversal`, a walk through a tree of boxes, which
GPUs could not do then. Both run in slices that a driver never takes for a hang and between which a viewport redraws.

Nothing here knows a graphics library: a RayDevice brings it (gpu_shaders/ray_device.py for Blender). Scenes lie in
Embree's space (Tracer.to_tracing_space: unit diagonal around the origin).
"""

from __future__ import annotations

import time
from collections.abc import Generator, Iterator
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from ..errors import PRTError
from .bounding_hierarchy import build, node_texels, triangle_texels
from .hits import Hits
from .ray_buckets import Buckets, CellPairs, make_buckets, pair_with_cells

TRAVERSAL, PAIRS, MASKED, CELLS = "traversal", "pairs", "masked", "cells"
GROUP = 64  # rays of a work group; ray_answer.glsl packs that many answers
WIDTH, LARGEST = 2048, 16384  # texels of a row, and most rows, of textures (gpu_shaders/render_data.py)
FARTHEST = np.float32(1e37)  # how far a ray goes without a reach
MOST_PAIRS = 1 << 24  # of all directions and origins, for the same reason as
MOST_TRIANGLES = 1 << 23  # whole numbers up to 2^24 are exact in a texture, and three texels each fit into one
# Windows resets a driver whose dispatch takes 2 s, and a redraw has to wait for the one under way.
SLICE_SECONDS = 0.025
SHORTEST = 1e-9  # seconds that a clock tells apart
FIRST_RAYS, LEAST_RAYS, MOST_RAYS = 1 << 13, 1 << 9, 1 << 20
# Of a loop of all pairs, in one dispatch: Mesa's software driver ends loops after 65,536 rounds, and bounded work is
# what keeps slices short.
MOST_STEPS = 1 << 15
MOST_TESTS = 1 << 21  # of a first slice of all pairs; what it takes tells how large the next one may be


class RayDevice(Protocol):
    """A graphics library: textures of RGBA32F texels (rows, WIDTH, 4), and the kernels of gpu_shaders/ray_programs."""

    name: str

    def upload(self, texels: NDArray[np.float32]) -> Any:
        """A texture of these texels."""

    def empty(self, width: int, height: int) -> Any:
        """A texture that a kernel writes."""

    def run(self, kernel: str, occluded: bool, textures: dict[str, Any], answers: Any, constants: dict[str, int],
            groups: int) -> None:
        """Start a kernel with so many groups of GROUP rays."""

    def read(self, texture: Any) -> NDArray[np.float32]:
        """Wait, and give a texture's texels (height, width, 4)."""


@dataclass
class SliceRecord:
    """What slices took: the longest, all together in seconds, and how many."""

    longest: float = 0.0
    seconds: float = 0.0
    count: int = 0

    def note(self, seconds: float) -> None:
        """One more."""
        self.longest, self.seconds, self.count = max(self.longest, seconds), self.seconds + seconds, self.count + 1


class RayEngine:
    """One triangle soup on a device. points: (p, 3) float32 in tracing space; triangles: (t, 3). Main thread only.

    Raises PRTError for a scene that textures can't hold. `record` tells how long slices were.
    """

    def __init__(self, device: RayDevice, points: NDArray[np.float32], triangles: NDArray[np.int32]) -> None:
        if len(triangles) > MOST_TRIANGLES:
            raise PRTError("ray tracing on the GPU", f"{len(triangles)} triangles are more than its textures hold",
                           "The scene is traced by Embree instead")
        self.device = device
        self.tree = build(points, triangles)
        self.node_texture = device.upload(in_rows(node_texels(self.tree)))
        self.triangle_texture = device.upload(in_rows(triangle_texels(self.tree, points, triangles)))
        self.record = SliceRecord()
        self._rays_per_second = FIRST_RAYS / SLICE_SECONDS
        self._tests_per_second = MOST_TESTS / SLICE_SECONDS

    def nearest(self, origins: NDArray[np.float32], directions: NDArray[np.float32]) -> Hits:
        """Nearest hits; arguments as of `Tracer.nearest`."""
        return _finish(self.nearest_steps(origins, directions))

    def occluded(self, origins: NDArray[np.float32], directions: NDArray[np.float32],
                 reach: NDArray[np.float32] | None = None) -> NDArray[np.bool_]:
        """Whether rays hit anything; arguments as of `Tracer.occluded`."""
        return _finish(self.occluded_steps(origins, directions, reach))

    def nearest_steps(self, origins: NDArray[np.float32], directions: NDArray[np.float32],
                      ) -> Generator[int, None, Hits]:
        """As `nearest`, a slice at a time; yields how many rays are done."""
        answers = np.empty((len(origins), 4), np.float32)
        for start, end, texels in self._walk(origins, directions, None, False):
            answers[start:end] = texels[:end - start]
            yield end
        return hits_of(answers)

    def occluded_steps(self, origins: NDArray[np.float32], directions: NDArray[np.float32],
                       reach: NDArray[np.float32] | None = None) -> Generator[int, None, NDArray[np.bool_]]:
        """As `occluded`, a slice at a time; yields how many rays are done."""
        answers = np.empty(len(origins), bool)
        for start, end, texels in self._walk(origins, directions, reach, True):
            answers[start:end] = bits_of(texels)[:end - start]
            yield end
        return answers

    def _walk(self, origins: NDArray[np.float32], directions: NDArray[np.float32],
              reach: NDArray[np.float32] | None, occluded: bool) -> Generator[tuple[int, int, NDArray]]:
        """Slices of the traversal: (first ray, last ray + 1, texels of the answers)."""
        check_rays(origins, directions)
        shared = len(directions) == 1
        for part in self._slices(len(origins), 1):
            texels = self._dispatch(TRAVERSAL, occluded, origins[part], directions if shared else directions[part],
                                    None if reach is None else reach[part], {"node_values": self.node_texture}, {})
            yield part.start, part.stop, texels

    def nearest_pairs(self, origins: NDArray[np.float32], directions: NDArray[np.float32], codes: NDArray[np.int64],
                      ) -> Hits:
        """Nearest hits of some pairs of an origin and a direction. codes: (n,) direction * len(origins) + origin.

        A bake has few of both and asks for most pairs: so a ray costs four bytes to send, not 32."""
        sent, answers = self._send_pairs(origins, directions), np.empty((len(codes), 4), np.float32)
        for part in self._slices(len(codes), 1):
            sent["pair_codes"] = self.device.upload(code_texels(codes[part]))
            count = part.stop - part.start
            answers[part] = self._run(PAIRS, False, sent, count, {"origins": len(origins)})[:count]
        return hits_of(answers)

    def occluded_where(self, origins: NDArray[np.float32], directions: NDArray[np.float32],
                       asked: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Which of the pairs (directions, origins) that are asked for hit anything: a bit for each is sent, and one
        comes back."""
        sent, count = self._send_pairs(origins, directions), asked.size
        bits = np.zeros(-(-count // GROUP) * GROUP, bool)
        bits[:count] = asked.ravel()
        for part in self._slices(count, GROUP):
            whole = slice(part.start, -(-part.stop // GROUP) * GROUP)
            sent["asked_bits"] = self.device.upload(in_rows(texels_of_bits(bits[whole])))
            texels = self._run(MASKED, True, sent, part.stop - part.start,
                               {"origins": len(origins), "first": part.start})
            bits[whole] = bits_of(texels[:(whole.stop - whole.start) // GROUP])
        return bits[:count].reshape(asked.shape)

    def _send_pairs(self, origins: NDArray[np.float32], directions: NDArray[np.float32]) -> dict[str, Any]:
        """What all slices of pairs need on the device."""
        check_rays(origins, directions)
        if len(origins) * len(directions) > MOST_PAIRS:
            raise ValueError(f"{len(directions)} directions from {len(origins)} origins are too many at once")
        upload = self.device.upload
        return {"ray_origins": upload(ray_texels(origins, FARTHEST)), "node_values": self.node_texture,
                "ray_directions": upload(ray_texels(directions, np.float32(0.0))),
                "triangle_values": self.triangle_texture}

    def _slices(self, rays: int, multiple: int) -> Iterator[slice]:
        """Parts of so many rays, each to be traced before the next is asked for, as which it is timed. multiple: of
        which every part but the last has a number of rays."""
        start = 0
        while start < rays:
            count = int(np.clip(self._rays_per_second * SLICE_SECONDS, LEAST_RAYS, MOST_RAYS)) // multiple * multiple
            end, began = min(rays, start + count), time.perf_counter()
            yield slice(start, end)
            took = max(time.perf_counter() - began, SHORTEST)
            self.record.note(took)
            self._rays_per_second = _next_rate(self._rays_per_second, (end - start) / took, end - start == count)
            start = end

    def _run(self, kernel: str, occluded: bool, textures: dict[str, Any], rays: int, constants: dict[str, int],
             ) -> NDArray[np.float32]:
        """Run a kernel on so many rays and read its answers, (texels, 4)."""
        groups = -(-rays // GROUP)
        answers = self.device.empty(WIDTH, -(-(groups if occluded else groups * GROUP) // WIDTH))
        self.device.run(kernel, occluded, textures, answers, {"rays": rays, **constants}, groups)
        return self.device.read(answers).reshape(-1, 4)

    def _dispatch(self, kernel: str, occluded: bool, origins: NDArray[np.float32], directions: NDArray[np.float32],
                  reach: NDArray[np.float32] | None, textures: dict[str, Any], constants: dict[str, int],
                  ) -> NDArray[np.float32]:
        """Send rays, run a kernel on them and read its answers, (texels, 4)."""
        upload = self.device.upload
        sent = {"ray_origins": upload(ray_texels(origins, FARTHEST if reach is None else reach)),
                "ray_directions": upload(ray_texels(directions, np.float32(0.0))),
                "triangle_values": self.triangle_texture, **textures}
        return self._run(kernel, occluded, sent, len(origins),
                         {"direction_step": int(len(directions) > 1), **constants})

    def cells_nearest(self, origins: NDArray[np.float32], directions: NDArray[np.float32], bucket_rays: int,
                      most_triangles: int) -> Hits:
        """Nearest hits by all pairs of buckets of `bucket_rays` (a multiple of GROUP) and cells of `most_triangles`."""
        return _finish(self.cells_steps(origins, directions, None, bucket_rays, most_triangles))

    def cells_steps(self, origins: NDArray[np.float32], directions: NDArray[np.float32],
                    reach: NDArray[np.float32] | None, bucket_rays: int, most_triangles: int,
                    ) -> Generator[int, None, Hits]:
        """As `cells_nearest`, a slice at a time; yields how many rays are done."""
        check_rays(origins, directions)
        directions = np.ascontiguousarray(np.broadcast_to(directions, origins.shape))
        reach = np.full(len(origins), FARTHEST) if reach is None else reach
        buckets = make_buckets(origins, directions, reach, bucket_rays)
        pairs = pair_with_cells(buckets, self.tree, most_triangles)
        return (yield from self.pairs_steps(origins, directions, reach, buckets, pairs))

    def pairs_steps(self, origins: NDArray[np.float32], directions: NDArray[np.float32], reach: NDArray[np.float32],
                    buckets: Buckets, pairs: CellPairs) -> Generator[int, None, Hits]:
        """The same for buckets and pairs that are there already. Where a bucket meets many triangles it takes several
        passes: the distance reached in one is the reach of the next, as the paper's z-buffer held it."""
        answers = np.zeros((len(origins), 4), np.float32)
        answers[:, 0] = reach
        passes = make_passes(pairs, self.tree.count[pairs.cell])
        tests = np.concatenate([[0], np.cumsum(passes.triangles)]) * float(buckets.size)
        start = 0
        while start < len(passes.bucket):
            end = int(np.searchsorted(tests, tests[start] + self._tests_per_second * SLICE_SECONDS, "right")) - 1
            end = min(max(end, start + 1), start + MOST_RAYS // buckets.size, passes.last_of_round[start])
            part = slice(start, end)
            rays = passes.bucket[part, None] * buckets.size + np.arange(buckets.size)
            place = buckets.order[np.minimum(rays, len(origins) - 1).ravel()]
            began = time.perf_counter()
            texels = self._dispatch(CELLS, False, origins[place], directions[place], answers[place, 0],
                                    self._pair_textures(pairs, passes.first[part], passes.end[part]),
                                    {"bucket_rays": buckets.size})[:len(place)]
            took = max(time.perf_counter() - began, SHORTEST)
            self.record.note(took)
            done = tests[end] - tests[start]
            self._tests_per_second = _next_rate(self._tests_per_second, done / took,
                                                done > 0.5 * self._tests_per_second * SLICE_SECONDS)
            hit = texels[:, 1] != 0.0
            answers[place[hit]] = texels[hit]
            yield int(len(origins) * tests[end] / max(tests[-1], 1.0))
            start = end
        return hits_of(answers)

    def _pair_textures(self, pairs: CellPairs, first: NDArray[np.int64], end: NDArray[np.int64]) -> dict[str, Any]:
        """The pairs [first, end) of some buckets as textures."""
        counts = end - first
        begins = np.cumsum(counts) - counts
        bucket = np.zeros((len(first), 4), np.float32)
        bucket[:, 0], bucket[:, 1] = begins, counts
        chosen = np.arange(int(counts.sum())) + np.repeat(first - begins, counts)
        cell = pairs.cell[chosen]
        values = np.zeros((len(cell), 4), np.float32)
        values[:, 0], values[:, 1], values[:, 2] = self.tree.first[cell], self.tree.count[cell], pairs.near[chosen]
        upload = self.device.upload
        return {"bucket_values": upload(in_rows(bucket)), "pair_values": upload(in_rows(values))}


@dataclass(frozen=True)
class Passes:
    """Pairs [first, end) of a bucket that one dispatch takes, and how many triangles they hold; the first of all
    buckets come before the second of any. last_of_round: where the passes of one's own round end."""

    bucket: NDArray[np.int64]
    first: NDArray[np.int64]
    end: NDArray[np.int64]
    triangles: NDArray[np.int64]
    last_of_round: NDArray[np.int64]


def make_passes(pairs: CellPairs, triangles: NDArray[np.integer]) -> Passes:
    """The pairs of each bucket in passes. triangles: (pairs,), of each pair's cell."""
    counts = np.diff(pairs.first)
    bucket = np.repeat(np.arange(len(counts)), counts)
    before = np.concatenate([[0], np.cumsum(triangles + 1, dtype=np.int64)])
    number = (before[:-1] - before[pairs.first[bucket]]) // MOST_STEPS
    first = np.flatnonzero(np.diff(bucket, prepend=-1) | np.diff(number, prepend=-1))
    end = np.append(first[1:], len(bucket))
    order = np.argsort(number[first], kind="stable")
    first, end = first[order], end[order]
    rounds = number[first]
    return Passes(bucket[first], first, end, before[end] - before[first] - (end - first),
                  np.searchsorted(rounds, rounds, "right"))


def check_rays(origins: NDArray[np.float32], directions: NDArray[np.float32]) -> None:
    """Raise PRTError for rays that lead nowhere: a kernel would answer them one way on this driver, another on that."""
    bad = int((~np.isfinite(origins).all(axis=1)).sum())
    bad_directions = int((~np.isfinite(directions).all(axis=1) | ~directions.any(axis=1)).sum())
    if bad or bad_directions:
        raise PRTError("ray tracing", f"{bad} rays start nowhere and {bad_directions} directions have no length or no "
                       "end", "Remove points that are not numbers from the meshes")


def in_rows(texels: NDArray[np.float32]) -> NDArray[np.float32]:
    """(n, 4) texels as the rows of a texture: (rows, WIDTH, 4), the last row filled up."""
    rows = max(1, -(-len(texels) // WIDTH))
    if rows > LARGEST:
        raise PRTError("ray tracing on the GPU", f"{len(texels)} values are more than a texture holds",
                       "The scene is traced by Embree instead")
    laid = np.zeros((rows * WIDTH, 4), np.float32)
    laid[:len(texels)] = texels
    return laid.reshape(rows, WIDTH, 4)


def ray_texels(vectors: NDArray[np.float32], fourth: NDArray[np.float32] | np.float32) -> NDArray[np.float32]:
    """(n, 3) vectors with a fourth number as rows of a texture. What fills the last row is never read."""
    rows = max(1, -(-len(vectors) // WIDTH))
    laid = np.empty((rows * WIDTH, 4), np.float32)
    laid[:len(vectors), :3] = vectors
    laid[:len(vectors), 3] = fourth
    return laid.reshape(rows, WIDTH, 4)


def code_texels(codes: NDArray[np.int64]) -> NDArray[np.float32]:
    """(n,) whole numbers, four to a texel, as rows of a texture. What fills the last row is never read."""
    rows = max(1, -(-len(codes) // (4 * WIDTH)))
    laid = np.empty(rows * WIDTH * 4, np.float32)
    laid[:len(codes)] = codes
    return laid.reshape(rows, WIDTH, 4)


def hits_of(answers: NDArray[np.float32]) -> Hits:
    """Hits from answers (n, 4): distance, number, u, v. The distance of a miss is its reach."""
    number = answers[:, 1].astype(np.int32)
    return Hits(np.abs(number) - np.int32(1), answers[:, 2].copy(), answers[:, 3].copy(), number > 0,
                answers[:, 0].copy())


def bits_of(texels: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Answers of whole groups from their texels: 16 to a number, the lowest bit first."""
    return np.unpackbits(texels.astype("<u2").reshape(-1).view(np.uint8), bitorder="little").astype(bool)


def texels_of_bits(bits: NDArray[np.bool_]) -> NDArray[np.float32]:
    """The reverse of `bits_of`: (n,) of whole groups as (n / GROUP, 4) texels."""
    return np.packbits(bits, bitorder="little").view("<u2").astype(np.float32).reshape(-1, 4)


def _next_rate(known: float, measured: float, full: bool) -> float:
    """The rate that the next slice is sized by: grows at most twofold, and only by full slices."""
    return min(measured, 2.0 * known) if full or measured < known else known


def _finish(steps: Generator[int, None, Any]) -> Any:
    """Exhaust a generator and return its result."""
    while True:
        try:
            next(steps)
        except StopIteration as end:
            return end.value
