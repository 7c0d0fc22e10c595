# SPDX-License-Identifier: GPL-3.0-or-later
"""Shadow rays and nearest hits over Embree.

embreex traces one ray at a time in Embree's robust mode and releases the GIL, so speed comes from coherent rays (one
direction for many receivers in Morton order) and from threads. Embree works in single precision: the scene is moved to
the origin and scaled to unit diagonal, so a mesh of a micrometre, or one a thousand kilometres away from the origin,
is traced as accurately as any other.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from ..errors import PRTError
from ..scene.object_mesh import bounding_diagonal
from ..scene.scene_mesh import SceneMesh
from ..scene.texel_surface import TracedSurface
from .hits import Hits

Result = TypeVar("Result")


class Tracer:
    """Embree over one triangle soup.

    points: (p, 3) float64 world space; triangles: (t, 3) int32; threads: workers of `map_in_order` (0 = one for each
    core that this process may use); surface: what triangles stand for where receivers are texels. `rays` counts every
    ray traced.
    """

    def __init__(self, points: NDArray[np.float64], triangles: NDArray[np.int32], threads: int = 0,
                 surface: TracedSurface | None = None) -> None:
        used = points[np.unique(triangles)] if len(triangles) else points
        self.diagonal = bounding_diagonal([used]) or 1.0
        self._centre = 0.5 * (used.min(axis=0) + used.max(axis=0)) if len(used) else np.zeros(3)
        self._scene = _embree_scene(self.to_tracing_space(points), triangles)
        self.threads = threads or len(os.sched_getaffinity(0) if hasattr(os, "sched_getaffinity") else
                                      range(os.cpu_count() or 1))
        self.rays = 0
        self.surface = surface

    @staticmethod
    def of_scene(scene: SceneMesh, threads: int = 0) -> Tracer:
        """Over a scene's true surface; hits are named by the scene's own triangles, which join its points."""
        return Tracer(*scene.shape, threads, scene.traced)

    @property
    def facts(self) -> dict[str, Any]:
        """Who traced, for the report."""
        return {"name": "Embree", "threads": self.threads}

    def to_tracing_space(self, points: NDArray[np.floating]) -> NDArray[np.float32]:
        """World positions (n, 3) as Embree sees them."""
        return np.ascontiguousarray((points - self._centre) / self.diagonal, np.float32)

    def occluded(self, origins: NDArray[np.float32], directions: NDArray[np.float32],
                 reach: NDArray[np.float32] | None = None) -> NDArray[np.bool_]:
        """Whether rays hit anything. origins: (n, 3) in tracing space; directions: (n, 3) or one for all (1, 3); reach:
        (n,), how far each ray goes, in lengths of its direction (None: for ever)."""
        if self._scene is None or not len(origins):
            return np.zeros(len(origins), bool)
        return self._scene.run(origins, directions, dists=reach, query="OCCLUDED") >= 0

    def nearest(self, origins: NDArray[np.float32], directions: NDArray[np.float32]) -> Hits:
        """Nearest hits of rays; arguments as for `occluded`."""
        count = len(origins)
        if self._scene is None or not count:
            nothing = np.zeros(count, np.float32)
            return Hits(np.full(count, -1, np.int32), nothing, nothing, np.zeros(count, bool), nothing)
        found = self._scene.run(origins, directions, query="INTERSECT", output=1)
        # Embree's geometric normal follows the winding, so a ray against it meets the front.
        front = np.sum(found["Ng"] * directions, axis=1) < 0.0
        return self._named(Hits(found["primID"], found["u"], found["v"], front, found["tfar"]))

    def _named(self, hits: Hits) -> Hits:
        """Hits of the traced surface, by the triangles that join the scene's points."""
        if self.surface is None:
            return hits
        traced = hits.triangle, hits.u, hits.v
        return Hits(*self.surface.named(*traced), hits.front, hits.distance, traced)

    def occluded_where(self, origins: NDArray[np.float32], directions: NDArray[np.float32],
                       asked: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Which of the rays that are asked for among all (directions, origins) hit anything: the same shape, False
        where nothing is asked. One direction after the other: coherent rays."""
        found = np.zeros(asked.shape, bool)
        for index in range(len(directions)):
            chosen = np.flatnonzero(asked[index])
            hit = self.occluded(np.take(origins, chosen, axis=0), directions[index:index + 1])
            found[index, chosen[hit]] = True
        return found

    def nearest_where(self, origins: NDArray[np.float32], directions: NDArray[np.float32], asked: NDArray[np.bool_],
                      ) -> tuple[NDArray[np.int64], NDArray[np.int64], Hits]:
        """Of the rays that are asked for among all (directions, origins), in that order: which direction, which origin,
        and the nearest hits."""
        which, row = np.nonzero(asked)
        return which, row, self.nearest(np.take(origins, row, axis=0), np.take(directions, which, axis=0))

    def map_in_order(self, work: Callable[[Any], Result], items: Iterable[Any]) -> Iterator[tuple[Any, Result]]:
        """Run `work` on items in threads, yielding (item, result) in the items' order.

        At most two items per thread are in flight, so memory stays bounded. Closing the iterator stops the work.
        """
        # One worker more than cores: while one waits for Python's lock, another keeps its core busy.
        with ThreadPoolExecutor(self.threads + (self.threads > 1)) as pool:
            pending: list[tuple[Any, Future[Result]]] = []
            try:
                for item in items:
                    pending.append((item, pool.submit(work, item)))
                    if len(pending) > 2 * self.threads:
                        first, future = pending.pop(0)
                        yield first, future.result()
                while pending:
                    first, future = pending.pop(0)
                    yield first, future.result()
            finally:
                for _, future in pending:
                    future.cancel()


def _embree_scene(points: NDArray[np.float32], triangles: NDArray[np.int32]) -> Any:
    """Embree's scene over the triangles, or None without any. Raises PRTError where embreex is not there."""
    try:
        from embreex import mesh_construction, rtcore_scene
    except ImportError as error:
        raise PRTError("embreex", f"the ray tracer can't be loaded ({error})",
                       "Install the extension's zip for this platform and Blender version") from error
    if not len(triangles):
        return None
    scene = rtcore_scene.EmbreeScene()
    mesh_construction.TriangleMesh(scene, points, np.ascontiguousarray(triangles, np.int32))
    return scene
