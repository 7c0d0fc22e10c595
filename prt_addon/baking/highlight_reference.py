# SPDX-License-Identifier: GPL-3.0-or-later
"""Independent reference for highlights: radiance along rays, by path tracing over diffuse and glossy surfaces.

Shares with the bake only the tracer, the places where rays start and the materials. How far along a path glossy
surfaces show their true highlights is a choice (elsewhere they send back as much, but evenly), because that is what
tells how much the bounces cost that a bake does not record.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..basis.directions import disc_directions, tangent_frames
from ..scene.scene_mesh import SceneMesh
from ..tracing.tracer import Hits, Tracer
from ..transport.glossy import surface_frames
from ..transport.path_reference import SURE_BOUNCES, DistantSuns, Emission, PointLights, surface_at
from .highlight_sampling import TrueHighlight, above_horizon, cosine_directions, to_local, to_world
from .surfaces import SurfacePlan

Array = NDArray[np.float64]

# Hits along a path that show their true highlights: more than any path has.
ALL_HITS = 1 << 30
# Least and greatest chance of following the highlight of a surface that has a diffuse layer too.
LEAST_CHANCE, GREATEST_CHANCE = 0.1, 0.9


@dataclass(frozen=True)
class TrueSurfaces:
    """What paths meet. even: (p, 3) albedo of surfaces that send everything back evenly; highlights: by material
    number, of materials with baked highlights."""

    tracer: Tracer
    scene: SceneMesh
    plan: SurfacePlan
    even: NDArray[np.float32]
    highlights: dict[int, TrueHighlight]

    @staticmethod
    def of(tracer: Tracer, scene: SceneMesh, plan: SurfacePlan, even: NDArray[np.float32]) -> TrueSurfaces:
        """The surfaces of a scene as its bake has them."""
        highlights = {number: TrueHighlight(part.material) for number, part in enumerate(plan.parts)
                      if part.kernel is not None}
        return TrueSurfaces(tracer, scene, plan, even, highlights)


@dataclass
class _Rays:
    """Rays in flight: the number of the path each belongs to, where it starts, its direction, what it brings."""

    path: NDArray[np.int64]
    origins: NDArray[np.float32]
    directions: NDArray[np.float32]
    throughput: Array

    def subset(self, which: NDArray) -> _Rays:
        return _Rays(self.path[which], self.origins[which], self.directions[which], self.throughput[which])


@dataclass
class _Met:
    """Places that rays have met: origins and faces for going on, frames (n, 3, 3) of the side that was hit, views (n,
    3) in them, even (n, 3) albedo, the material's own diffuse albedo (n, 3) and number; side: 1 front, -1 back."""

    origins: NDArray[np.float32]
    faces: Array
    frames: Array
    views: Array
    even: Array
    albedo: Array
    material: NDArray[np.int64]
    side: Array


def arriving_radiance(surfaces: TrueSurfaces, origins: NDArray[np.float32], directions: NDArray[np.float32],
                      emission: Emission, suns: DistantSuns | PointLights, bounces: int, glossy_hits: tuple[int, ...],
                      seed: list[int]) -> tuple[Array, int]:
    """Radiance (n, len(glossy_hits), values, 3) that arrives along rays (n, 3) against their directions, and the number
    of rays traced.

    emission: of what lies beyond the scene, (n, values, 3); suns light what is hit, in the last value (a ray that meets
    a sun itself does not see it: the receiver adds that), point lights each in its own value. bounces: most, -1 for all
    (Russian roulette). glossy_hits: at how many hits of a path glossy surfaces show their true highlights, 1 on fronts
    alone, as a bake records it.
    """
    hits = surfaces.tracer.nearest(origins, directions)
    escaped = np.flatnonzero(hits.triangle < 0)
    brought = emission(directions[escaped].astype(np.float64))
    total = np.zeros((len(glossy_hits), len(origins), *brought.shape[1:]))
    total[:, escaped] = brought
    rays = len(origins)
    if bounces != 0 and len(escaped) < len(origins):
        first = _Rays(np.arange(len(origins)), origins, directions, np.ones((len(origins), 3)))
        for number, glossy in enumerate(glossy_hits):
            # The same numbers for each: paths that meet no highlight are the same, and so is their noise.
            generator = np.random.Generator(np.random.PCG64([*seed, 1]))
            rays += _follow(surfaces, first, hits, emission, suns, bounces, glossy, total[number], generator)
    return np.moveaxis(total, 0, 1), rays


def _follow(surfaces: TrueSurfaces, rays: _Rays, hits: Hits, emission: Emission, suns: DistantSuns | PointLights,
            bounces: int, glossy: int, total: Array, generator: np.random.Generator) -> int:
    """Add to total (n, values, 3) what the rays bring from their first hit on; returns the rays traced."""
    traced, depth = 0, 0
    while depth != bounces:
        met = np.flatnonzero(hits.triangle >= 0)
        if not len(met):
            break
        rays = rays.subset(met)
        place = _met(surfaces, rays, hits, met)
        shiny = _shiny(surfaces, place, depth, glossy)
        if isinstance(suns, PointLights):
            traced += _add_points(surfaces, rays, place, shiny, suns, total)
        else:
            traced += _add_suns(surfaces, rays, place, shiny, suns, total, generator)
        rays = _scattered(surfaces, rays, place, shiny, generator)
        if depth >= SURE_BOUNCES:
            rays = _roulette(rays, generator)
        hits = surfaces.tracer.nearest(rays.origins, rays.directions)
        traced += len(rays.path)
        escaped = np.flatnonzero(hits.triangle < 0)
        brought = emission(rays.directions[escaped].astype(np.float64)) * rays.throughput[escaped, None, :]
        _add(total, rays.path[escaped], brought)
        depth += 1
    return traced


def _add(total: Array, path: NDArray[np.int64], values: Array) -> None:
    """Add values (n, ...) to their paths; a path comes once at most."""
    total[path] += values


def _met(surfaces: TrueSurfaces, rays: _Rays, hits: Hits, met: NDArray[np.int64]) -> _Met:
    scene = surfaces.scene
    found = surface_at(surfaces.tracer, scene, hits, met)
    frames = surface_frames(found.normals, found.mean(scene.tangents))
    seen_from = above_horizon(to_local(-rays.directions.astype(np.float64), frames))
    return _Met(found.origins, found.faces, frames, seen_from, found.mean(surfaces.even), found.mean(scene.albedo),
                scene.material[found.corner[:, 0]].astype(np.int64), found.side)


def _shiny(surfaces: TrueSurfaces, place: _Met, depth: int, glossy: int) -> dict[int, NDArray[np.int64]]:
    """Places (numbers) that show a highlight at this depth, by material number."""
    if depth >= glossy:
        return {}
    seen = np.ones(len(place.side), bool) if glossy == ALL_HITS else place.side > 0.0
    found = {number: np.flatnonzero(seen & (place.material == number)) for number in surfaces.highlights}
    return {number: members for number, members in found.items() if len(members)}


def _diffuse(surfaces: TrueSurfaces, place: _Met, shiny: dict[int, NDArray[np.int64]]) -> Array:
    """Albedo (n, 3) of the diffuse layers, towards the views."""
    albedo = np.array(place.even)
    for number, members in shiny.items():
        part, highlight = surfaces.plan.parts[number], surfaces.highlights[number]
        through = 1.0 - part.material.subsurface_weight if part.translucent else 1.0
        left = through * highlight.diffuse_left(place.views[members])
        albedo[members] = place.albedo[members] * left[:, None]
    return albedo


def _add_suns(surfaces: TrueSurfaces, rays: _Rays, place: _Met, shiny: dict[int, NDArray[np.int64]],
              suns: DistantSuns, total: Array, generator: np.random.Generator) -> int:
    """Add the suns' light that these places send back to the last value; returns the rays traced."""
    traced = 0
    if not len(suns.directions):
        return traced
    diffuse = _diffuse(surfaces, place, shiny)
    frames = tangent_frames(suns.directions)
    for frame, irradiance, angle in zip(frames, suns.irradiance, suns.angles, strict=True):
        towards, scale = disc_directions(frame, float(angle), generator.random((len(rays.path), 2)))
        local = to_local(towards, place.frames)
        facing = (local[:, 2] > 0.0) & (np.sum(place.faces * towards, axis=1) > 0.0)
        which = np.flatnonzero(facing)
        lit = which[~surfaces.tracer.occluded(place.origins[which], towards[which].astype(np.float32))]
        traced += len(which)
        returned = diffuse * (np.maximum(local[:, 2:], 0.0) / np.pi)
        for number, members in shiny.items():
            returned[members] += surfaces.highlights[number].evaluate(place.views[members], local[members])
        total[rays.path[lit], -1] += rays.throughput[lit] * returned[lit] * (scale * irradiance)
    return traced


def _add_points(surfaces: TrueSurfaces, rays: _Rays, place: _Met, shiny: dict[int, NDArray[np.int64]],
                lights: PointLights, total: Array) -> int:
    """Add the point lights' light that these places send back, each to its own value; returns the rays traced."""
    traced, diffuse = 0, _diffuse(surfaces, place, shiny)
    for value, position in enumerate(surfaces.tracer.to_tracing_space(lights.positions)):
        way = position - place.origins
        square = np.sum(way.astype(np.float64) ** 2, axis=1)
        towards = way / np.sqrt(square)[:, None]
        local = to_local(towards, place.frames)
        which = np.flatnonzero((local[:, 2] > 0.0) & (np.sum(place.faces * towards, axis=1) > 0.0))
        reach = np.full(len(which), 1.0 - 1e-5, np.float32)
        lit = which[~surfaces.tracer.occluded(place.origins[which], way[which], reach)]
        traced += len(which)
        returned = diffuse * (np.maximum(local[:, 2:], 0.0) / np.pi)
        for number, members in shiny.items():
            returned[members] += surfaces.highlights[number].evaluate(place.views[members], local[members])
        strength = 1.0 / (square[lit] * surfaces.tracer.diagonal ** 2)
        total[rays.path[lit], value] += rays.throughput[lit] * returned[lit] * strength[:, None]
    return traced


def _scattered(surfaces: TrueSurfaces, rays: _Rays, place: _Met, shiny: dict[int, NDArray[np.int64]],
               generator: np.random.Generator) -> _Rays:
    """The rays that go on from these places, diffusely or by the highlight; those under the face that they are on, or
    that bring nothing, end."""
    count = len(rays.path)
    numbers, chosen = generator.random((count, 2)), generator.random(count)
    weight = _diffuse(surfaces, place, shiny)
    local = cosine_directions(numbers)
    for number, members in shiny.items():
        chance = _chance(surfaces, number, weight[members])
        mirrored = chosen[members] < chance
        weight[members] /= np.where(mirrored, 1.0, np.maximum(1.0 - chance, 1e-12))[:, None]
        members, chance = members[mirrored], chance[mirrored]
        local[members], factor = surfaces.highlights[number].sample(place.views[members], numbers[members])
        weight[members] = factor / chance[:, None]
    directions = to_world(local, place.frames)
    goes_on = (weight.max(axis=1) > 0.0) & (np.sum(place.faces * directions, axis=1) > 0.0)
    which = np.flatnonzero(goes_on)
    return _Rays(rays.path[which], place.origins[which], directions[which].astype(np.float32),
                 rays.throughput[which] * weight[which])


def _chance(surfaces: TrueSurfaces, number: int, diffuse: Array) -> Array:
    """With which probability a path follows the highlight, by how much each layer sends back."""
    highlight, rest = float(surfaces.plan.parts[number].highlight.max()), diffuse.max(axis=1)
    share = highlight / np.maximum(highlight + rest, 1e-12)
    return np.where(rest > 0.0, np.clip(share, LEAST_CHANCE, GREATEST_CHANCE), 1.0)


def _roulette(rays: _Rays, generator: np.random.Generator) -> _Rays:
    """End paths at random by what they still carry; survivors carry more, so that the mean is unchanged."""
    chance = np.minimum(1.0, np.maximum(rays.throughput.max(axis=1), 1e-3))
    survives = generator.random(len(chance)) < chance
    rays = rays.subset(survives)
    rays.throughput /= chance[survives, None]
    return rays
