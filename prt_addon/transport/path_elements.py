# SPDX-License-Identifier: GPL-3.0-or-later
"""Indirect light, element by element by path tracing: the paper's baseline, and the cost of what no operator carries.

The gather operator carries all columns at once in seconds where this takes minutes to hours; it serves to show
that, and as the pattern for transport that only paths can carry.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ..basis.cubemap import cubemap_directions, cubemap_solid_angles
from ..basis.directions import cosine_hemisphere, tangent_frames
from ..scene.scene_mesh import SceneMesh
from ..tracing.tracer import Tracer
from .elements import PathTracedElements, Places, Single
from .path_reference import surface_at
from .receiver_set import ReceiverSet


@dataclass
class PathElements(PathTracedElements):
    """What light of one texel does at one receiver after one and more bounces, per element `paths` paths of `bounces`
    hits, each with a shadow ray towards the texel's middle. value: mean over paths of the throughput times the cosine
    at the hits; factor: solid angle / pi.

    Every element is traced for itself. All use the same local directions, so that near receivers keep alike rows, and
    an element is the same whenever it is asked for. albedo: (points,) that surfaces bounce with.
    """

    tracer: Tracer
    scene: SceneMesh
    receivers: ReceiverSet
    albedo: NDArray[np.floating]
    r: int
    paths: int = 16
    bounces: int = 2
    seed: int = 0
    asked: int = 0
    angular: bool = False
    highest: float = np.inf
    _directions: Single = field(init=False)
    _local: NDArray[np.float64] = field(init=False)

    def __post_init__(self) -> None:
        self._directions = np.ascontiguousarray(cubemap_directions(self.r), np.float32)
        generator = np.random.default_rng(self.seed)
        even = cosine_hemisphere(self.paths)
        self._local = np.stack([even] + [generator.permutation(even) for _ in range(self.bounces - 1)])

    @property
    def columns(self) -> int:
        """See `Elements`."""
        return len(self._directions)

    def factor(self, receivers: Places) -> Single:
        """Solid angle / pi."""
        weights = (cubemap_solid_angles(self.r) / np.pi).astype(np.float32)
        return np.broadcast_to(weights, (len(receivers), self.columns))

    def _trace(self, receivers: Places, columns: Places) -> tuple[NDArray[np.float64], int]:
        """Values (m,) of elements and the rays traced for them."""
        owner = np.repeat(np.arange(len(receivers)), self.paths)
        path = np.tile(np.arange(self.paths), len(receivers))
        place = receivers[owner]
        origins, normals = self.receivers.origins[place], self.receivers.normals[place]
        throughput, faces = np.ones(len(owner)), None
        total, rays = np.zeros(len(receivers)), 0
        for local in self._local:
            towards = np.sum(local[path][:, :, None] * tangent_frames(normals), axis=1).astype(np.float32)
            throughput *= self.receivers.above_faces(place, towards) if faces is None else \
                np.sum(faces * towards, axis=1) > 0.0
            hits = self.tracer.nearest(origins, towards)
            rays += len(towards)
            met = np.flatnonzero((hits.triangle >= 0) & (throughput > 0.0))
            found = surface_at(self.tracer, self.scene, hits, met)
            owner, path = owner[met], path[met]
            throughput = throughput[met] * found.mean(self.albedo[:, None])[:, 0]
            origins, normals, faces = found.origins, found.normals, found.faces
            lit = self._directions[columns[owner]]
            cosine = np.sum(normals * lit, axis=1) * (np.sum(faces * lit, axis=1) > 0.0)
            facing = np.flatnonzero(cosine > 0.0)
            seen = facing[~self.tracer.occluded(origins[facing], lit[facing])]
            rays += len(facing)
            total += np.bincount(owner[seen], throughput[seen] * cosine[seen], len(total))
        return total / self.paths, rays
