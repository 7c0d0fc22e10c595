# SPDX-License-Identifier: GPL-3.0-or-later
"""Independent reference: path tracing of unit-albedo exit radiance at a few receivers.

Shares with the bake only the tracer and the places where rays start: directions are random and cosine-distributed,
bounces are followed path by path, albedo and normal are interpolated where a path hits. Two independent halves let
the error be estimated without bias by the reference's own noise: E[(x - a)(x - b)] = (x - truth)^2.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from ..basis.directions import disc_directions, tangent_frames
from ..scene.receivers import LIFT
from ..scene.scene_mesh import SceneMesh
from ..tracing.tracer import Hits, Tracer
from .receiver_set import ReceiverSet

# After this many bounces a path goes on with the probability of its albedo (Russian roulette).
SURE_BOUNCES = 4
# Paths of one task: their numbers stay in the processor's cache, and a few receivers already fill every core.
PATHS_AT_ONCE = 1 << 15
# Rays leave a hit this far above it, as a multiple of LIFT: a hit's own position is known to a few units in the last
# place, not exactly as a vertex's.
HIT_LIFT = 4.0

# What a path that leaves the scene in directions (n, 3) brings: (n, values, 3 or 1).
Emission = Callable[[NDArray[np.float64]], NDArray[np.float64]]


@dataclass(frozen=True)
class DistantSuns:
    """Directions to suns (s, 3), their irradiance (s, 3) on a facing surface and full angles (s,) in radians.

    They are sampled, not hit by chance.
    """

    directions: NDArray[np.float64]
    irradiance: NDArray[np.float64]
    angles: NDArray[np.float64]


@dataclass(frozen=True)
class PointLights:
    """Places (s, 3), metres, of points of 1 W/sr; each brings its own value. Only light that bounced is counted."""

    positions: NDArray[np.float64]


class DirectLight(Protocol):
    """Parts of the distant light that the emission leaves out, because paths would seldom hit them: shadow rays find
    them instead, from every surface of a path, for one of the emission's values."""

    value: int

    def sample(self, numbers: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Directions (n, 3) by numbers (n, 3) in [0, 1), and what each brings: (n, 3) radiance over its density."""
        ...


@dataclass
class _Paths:
    """Paths in flight: owner among the receivers, place and normal of their last surface, throughput (n, 3).

    faces: (n, 3) normal of the face they are on; None at the receivers, which lie on several.
    """

    owner: NDArray[np.int64]
    origins: NDArray[np.float32]
    normals: NDArray[np.float64]
    throughput: NDArray[np.float64]
    faces: NDArray[np.float64] | None = None

    def subset(self, which: NDArray) -> _Paths:
        faces = None if self.faces is None else self.faces[which]
        return _Paths(self.owner[which], self.origins[which], self.normals[which], self.throughput[which], faces)


def reference_radiance(tracer: Tracer, scene: SceneMesh, receivers: ReceiverSet, albedo: NDArray[np.float32],
                       emission: Emission, suns: DistantSuns | PointLights, paths: int, bounces: int, seed: int,
                       bright: Sequence[DirectLight] = ()) -> Generator[float, None, NDArray[np.float64]]:
    """Yield progress, return (2, r, values, 3): unit-albedo exit radiance per emission value, from two halves.

    albedo: (points, 3) that surfaces bounce with. emission may return several values per direction; sun light is added
    to the last one, of point lights each to its own. paths: per receiver, both halves together. bounces: most bounces,
    -1 for all (Russian roulette). bright: what emission leaves out of the distant light.
    """
    half = max(1, paths // 2)
    at_once = max(1, PATHS_AT_ONCE // half)
    parts = [(which, slice(start, min(start + at_once, len(receivers))))
             for which in range(2) for start in range(0, len(receivers), at_once)]
    result: list[list[NDArray[np.float64]]] = [[], []]

    def trace(task: tuple[int, slice]) -> tuple[NDArray[np.float64], int]:
        # Random numbers of the part's own, so that the result is the same for any number of threads.
        generator = np.random.Generator(np.random.PCG64([seed, task[0], task[1].start]))
        return _half(tracer, scene, receivers, task[1], albedo, emission, suns, half, bounces, generator,
                     bright)

    for (which, part), (found, rays) in tracer.map_in_order(trace, parts):
        result[which].append(found)
        tracer.rays += rays
        yield (which + part.stop / len(receivers)) / 2
    return np.stack([np.concatenate(half_result) for half_result in result])


def _half(tracer: Tracer, scene: SceneMesh, receivers: ReceiverSet, part: slice, albedo: NDArray[np.float32],
          emission: Emission, suns: DistantSuns | PointLights, count: int, bounces: int, generator: np.random.Generator,
          bright: Sequence[DirectLight]) -> tuple[NDArray[np.float64], int]:
    """Mean over `count` paths from each receiver of the part, (receivers, values, 3), and the rays traced."""
    number, rays = part.stop - part.start, 0
    values = emission(np.array([[0.0, 0.0, 1.0]])).shape[1]
    total = np.zeros((number, values, 3))
    paths = _Paths(np.repeat(np.arange(number), count), np.repeat(receivers.origins[part], count, axis=0),
                   np.repeat(receivers.normals[part], count, axis=0), np.ones((number * count, 3)))
    first = _stratified(number, count, generator)
    depth = 0
    while len(paths.owner):
        if isinstance(suns, DistantSuns):
            rays += _add_suns(tracer, receivers, part, paths, suns, total, generator)
        elif depth > 0:
            rays += _add_points(tracer, paths, suns, total)
        for light in bright:
            towards, brought = light.sample(generator.random((len(paths.owner), 3)))
            rays += _add_distant(tracer, receivers, part, paths, towards, brought, total[:, light.value])
        directions = _cosine_directions(paths.normals, first if depth == 0 else generator.random((len(paths.owner), 2)))
        paths, directions = _above_surface(receivers, part, paths, directions, depth)
        hits = tracer.nearest(paths.origins, directions)
        rays += len(directions)
        escaped = hits.triangle < 0
        brought = emission(directions[escaped].astype(np.float64)) * paths.throughput[escaped, None, :]
        np.add.at(total, paths.owner[escaped], brought)
        if depth == bounces:
            break
        paths = _next(tracer, scene, paths, directions, hits, albedo)
        paths = _roulette(paths, generator) if depth >= SURE_BOUNCES else paths
        depth += 1
    return total / count, rays


def _above_surface(receivers: ReceiverSet, part: slice, paths: _Paths, directions: NDArray[np.float32], depth: int,
                   ) -> tuple[_Paths, NDArray[np.float32]]:
    """Paths weighted by (at receivers) or ended by (at hits) whether they go on above the face they are on."""
    if depth == 0:
        share = receivers.above_faces(paths.owner + part.start, directions)
        paths.throughput *= share[:, None]
        return paths, directions
    above = np.sum(paths.faces * directions, axis=1) > 0.0
    return paths.subset(above), directions[above]


def _stratified(number: int, count: int, generator: np.random.Generator) -> NDArray[np.float64]:
    """A randomly shifted rank-1 lattice (golden ratio) per receiver: (number * count, 2) in [0, 1)."""
    index = np.arange(count)
    lattice = np.stack([(index + 0.5) / count, np.modf(index * ((np.sqrt(5.0) - 1.0) / 2.0))[0]], axis=1)
    return ((lattice[None] + generator.random((number, 1, 2))) % 1.0).reshape(-1, 2)


def _cosine_directions(normals: NDArray[np.float64], numbers: NDArray[np.float64]) -> NDArray[np.float32]:
    """Directions (n, 3) about the normals with density cos / pi, by Malley's method."""
    radius, angle = np.sqrt(numbers[:, 0]), 2.0 * np.pi * numbers[:, 1]
    local = np.stack([radius * np.cos(angle), radius * np.sin(angle), np.sqrt(1.0 - numbers[:, 0])], axis=1)
    return np.sum(local[:, :, None] * tangent_frames(normals), axis=1).astype(np.float32)


def _add_suns(tracer: Tracer, receivers: ReceiverSet, part: slice, paths: _Paths, suns: DistantSuns,
              total: NDArray[np.float64], generator: np.random.Generator) -> int:
    """Add each sun's reflected light at the paths' surfaces to the last emission value; return the rays traced."""
    rays = 0
    for direction, irradiance, angle in zip(suns.directions, suns.irradiance, suns.angles, strict=True):
        frame = tangent_frames(direction[None, :])[0]
        towards, scale = disc_directions(frame, float(angle), generator.random((len(paths.owner), 2)))
        rays += _add_distant(tracer, receivers, part, paths, towards, scale * irradiance, total[:, -1])
    return rays


def _add_distant(tracer: Tracer, receivers: ReceiverSet, part: slice, paths: _Paths, towards: NDArray[np.float64],
                 brought: NDArray[np.float64], total: NDArray[np.float64]) -> int:
    """Add to a value (receivers, 3) what the paths' surfaces reflect of light from directions (n, 3) that brings (n, 3)
    or (3,) to a facing surface; return the rays traced."""
    cosine = np.sum(paths.normals * towards, axis=1)
    if paths.faces is None:
        cosine *= receivers.above_faces(paths.owner + part.start, towards)
    else:
        cosine *= np.sum(paths.faces * towards, axis=1) > 0.0
    facing = np.flatnonzero(cosine > 0.0)
    seen = facing[~tracer.occluded(paths.origins[facing], towards[facing].astype(np.float32))]
    reflected = paths.throughput[seen] * (cosine[seen, None] / np.pi)
    np.add.at(total, paths.owner[seen], reflected * (brought if brought.ndim == 1 else brought[seen]))
    return len(facing)


def _add_points(tracer: Tracer, paths: _Paths, lights: PointLights, total: NDArray[np.float64]) -> int:
    """Add each point light's reflected light at hits to its own value; return the rays traced."""
    rays = 0
    for value, position in enumerate(tracer.to_tracing_space(lights.positions)):
        towards = position - paths.origins
        square = np.sum(towards.astype(np.float64) ** 2, axis=1)
        height = np.sum(paths.normals * towards, axis=1) * (np.sum(paths.faces * towards, axis=1) > 0.0)
        facing = np.flatnonzero(height > 0.0)
        reach = np.full(len(facing), 1.0 - 1e-5, np.float32)
        seen = facing[~tracer.occluded(paths.origins[facing], towards[facing], reach)]
        rays += len(facing)
        brought = height[seen] / (np.pi * square[seen] ** 1.5 * tracer.diagonal ** 2)
        np.add.at(total[:, value], paths.owner[seen], paths.throughput[seen] * brought[:, None])
    return rays


@dataclass(frozen=True)
class HitSurface:
    """The surface at n hits, on the side that was hit. corner: (n, 3) points of the scene; weights: (n, 3, 1)
    barycentric; origins: (n, 3) in tracing space, from which rays go on; normals: (n, 3) shading normals; faces: (n, 3)
    normals of the faces; side: (n,) 1 for the front, -1 for the back."""

    corner: NDArray[np.int32]
    weights: NDArray[np.float64]
    origins: NDArray[np.float32]
    normals: NDArray[np.float64]
    faces: NDArray[np.float64]
    side: NDArray[np.float64]

    def mean(self, values: NDArray[np.floating]) -> NDArray[np.float64]:
        """Values of the scene's points (points, k) at the hits."""
        return np.sum(self.weights * values[self.corner].astype(np.float64), axis=1)


def surface_at(tracer: Tracer, scene: SceneMesh, hits: Hits, met: NDArray[np.int64]) -> HitSurface:
    """The surface at the hits numbered `met`."""
    corner = scene.triangles[hits.triangle[met]]
    u, v = hits.u[met].astype(np.float64), hits.v[met].astype(np.float64)
    weights = np.stack([1.0 - u - v, u, v], axis=1)[:, :, None]
    if hits.traced is not None:
        place, face = tracer.surface.places(*(values[met] for values in hits.traced))
    else:
        places = scene.points[corner]
        face = np.cross(places[:, 1] - places[:, 0], places[:, 2] - places[:, 0])
        face /= np.maximum(np.sqrt(np.sum(face ** 2, axis=1, keepdims=True)), np.finfo(np.float64).tiny)
        place = np.sum(weights * places, axis=1)
    side = np.where(hits.front[met], 1.0, -1.0)[:, None]
    normal = np.sum(weights * scene.normals[corner], axis=1)
    normal /= np.maximum(np.sqrt(np.sum(normal ** 2, axis=1, keepdims=True)), 1e-12)
    origin = place + side * face * (HIT_LIFT * LIFT * tracer.diagonal)
    return HitSurface(corner, weights, tracer.to_tracing_space(origin), side * normal, side * face, side[:, 0])


def _next(tracer: Tracer, scene: SceneMesh, paths: _Paths, directions: NDArray[np.float32], hits: Hits,
          albedo: NDArray[np.float32]) -> _Paths:
    """The paths that hit something, reflected: at the hit, on the side that was hit, dimmed by its albedo."""
    met = np.flatnonzero(hits.triangle >= 0)
    found = surface_at(tracer, scene, hits, met)
    return _Paths(paths.owner[met], found.origins, found.normals, paths.throughput[met] * found.mean(albedo),
                  found.faces)


def _roulette(paths: _Paths, generator: np.random.Generator) -> _Paths:
    """End paths at random in proportion to what they still carry; survivors carry more, so the mean is unchanged."""
    chance = np.minimum(1.0, np.maximum(paths.throughput.max(axis=1), 1e-3))
    survives = generator.random(len(chance)) < chance
    paths = paths.subset(survives)
    paths.throughput /= chance[survives, None]
    return paths
