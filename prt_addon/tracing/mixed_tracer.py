# SPDX-License-Identifier: GPL-3.0-or-later
"""Embree on threads and a GPU on the main thread, side by side behind the Tracer's interface.

As the paper's engine (Carr, Hall & Hart 2002, section 5.1) the CPU keeps organising the work. Tasks of `map_in_order`
go to whoever is free: threads trace theirs by Embree, the main thread, which alone may use the graphics driver, takes
one after the other and traces it on the GPU, so that each gets the share that it is fast enough for.

Only rays that go in many directions from many origins are worth sending (`occluded_where`, `nearest_where`: the bulk of
a bake's): on an H200 those were traced 2 to 4 times as fast as by 16 threads of Embree, transfers included, while rays
sent one by one, with an origin and a direction each, reached 0.17 to 0.55 of it. So those stay with Embree everywhere.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..scene.texel_surface import TracedSurface
from .hits import Hits
from .ray_engine import MOST_PAIRS, RayDevice, RayEngine
from .tracer import Result, Tracer

LEAST_RAYS = 2048  # fewer are traced by Embree before a dispatch has begun


class MixedTracer(Tracer):
    """A Tracer whose maker's thread uses a graphics device for blocks of rays. device: see ray_engine.RayDevice;
    gpu_rays: traced on it.

    Raises PRTError for a scene that the device can't hold.
    """

    def __init__(self, points: NDArray[np.float64], triangles: NDArray[np.int32], threads: int,
                 device: RayDevice, surface: TracedSurface | None = None) -> None:
        super().__init__(points, triangles, threads, surface)
        self.device_name = device.name
        self.gpu_rays = 0
        self._engine = RayEngine(device, self.to_tracing_space(points), np.asarray(triangles, np.int32))
        self._device_thread = threading.get_ident()

    @property
    def engine(self) -> RayEngine:
        """What traces on the device."""
        return self._engine

    @property
    def facts(self) -> dict[str, Any]:
        """See `Tracer.facts`."""
        return {"name": f"Embree and {self.device_name}", "threads": self.threads, "gpu_rays": self.gpu_rays,
                "longest_slice": self._engine.record.longest}

    def on_device(self, rays: int) -> bool:
        """Whether so many rays, asked for on this thread, are traced by the device."""
        return rays >= LEAST_RAYS and threading.get_ident() == self._device_thread

    def occluded_where(self, origins: NDArray[np.float32], directions: NDArray[np.float32],
                       asked: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """See `Tracer.occluded_where`."""
        if not self._where_on_device(asked):
            return super().occluded_where(origins, directions, asked)
        return self._engine.occluded_where(origins, directions, asked)

    def nearest_where(self, origins: NDArray[np.float32], directions: NDArray[np.float32], asked: NDArray[np.bool_],
                      ) -> tuple[NDArray[np.int64], NDArray[np.int64], Hits]:
        """See `Tracer.nearest_where`."""
        if not self._where_on_device(asked):
            return super().nearest_where(origins, directions, asked)
        codes = np.flatnonzero(asked)
        which, row = np.divmod(codes, len(origins))
        return which, row, self._named(self._engine.nearest_pairs(origins, directions, codes))

    def _where_on_device(self, asked: NDArray[np.bool_]) -> bool:
        """Whether the device traces what is asked for, which is counted then."""
        if asked.size > MOST_PAIRS or not self.on_device(asked.size):
            return False
        rays = int(np.count_nonzero(asked))
        if not self.on_device(rays):
            return False
        self.gpu_rays += rays
        return True

    def map_in_order(self, work: Callable[[Any], Result], items: Iterable[Any]) -> Iterator[tuple[Any, Result]]:
        """See `Tracer.map_in_order`; while tasks are left, this thread does some itself."""
        if threading.get_ident() != self._device_thread:
            yield from super().map_in_order(work, items)
            return
        source, waiting = iter(items), deque[tuple[Any, Future[Result]]]()
        nothing, most = object(), 4 * self.threads  # which bounds memory
        with ThreadPoolExecutor(self.threads) as pool:
            try:
                item = next(source, nothing)
                while waiting or item is not nothing:
                    while item is not nothing and len(waiting) < most and _under_way(waiting) < 2 * self.threads:
                        waiting.append((item, pool.submit(work, item)))
                        item = next(source, nothing)
                    if item is not nothing and not waiting[0][1].done() and len(waiting) < most:
                        waiting.append((item, _done(work(item))))
                        item = next(source, nothing)
                        continue
                    first, future = waiting.popleft()
                    yield first, future.result()
            finally:
                for _, future in waiting:
                    future.cancel()


def _under_way(waiting: Iterable[tuple[Any, Future[Any]]]) -> int:
    """How many tasks have not ended."""
    return sum(not future.done() for _, future in waiting)


def _done(result: Result) -> Future[Result]:
    """A task that has ended."""
    future: Future[Result] = Future()
    future.set_result(result)
    return future
