# SPDX-License-Identifier: GPL-3.0-or-later
"""Responses to the lights of a local cloud: what reaches every receiver by at least one bounce.

Kristensen et al. 2005 (section 4) solve global illumination for each light by photon mapping. The transport between
receivers is the same for all lights, so here the gather operator of distant light carries the direct fields of many
lights at once: exact up to the operator's rays, seconds for a thousand lights.
"""

from __future__ import annotations

from collections.abc import Callable, Generator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..basis.directions import spherical_fibonacci
from ..basis.spherical_harmonics import evaluate
from ..scene.scene_mesh import SceneMesh
from ..tracing.tracer import Tracer
from .gather import Gather
from .interreflection import interreflect
from .receiver_set import BLOCK, ReceiverSet

Single = NDArray[np.float32]
# What takes the lights of a slice and their responses (r, lights * functions, channels), in the receivers' order.
Consumer = Callable[[slice, Single], None]

# Columns carried through the operator at once: 64 of 50,000 receivers and three channels are 38 MB a copy.
COLUMNS = 64
# Rays to a light end this far before it, as a fraction of the scene's diagonal: a light on a surface is not hidden.
NUDGE = 4e-6
# Points of a light with a radius that stand for its sphere.
SPHERE_POINTS = 12
# A light nearer to a triangle than this many of its longest edges is too sharp a field for the triangle's corners.
NEAR = 4.0
# Most that the flux correction may change a corner: a light that sits on a vertex has no finite field there.
MOST_CORRECTION = 1e3


def unit_light_direct(tracer: Tracer, receivers: ReceiverSet, positions: NDArray[np.float64], emission_order: int = 1,
                      radius: float = 0.0) -> Generator[float, None, Single]:
    """Yield progress, return direct transfer (r, lights * emission_order^2) float32, for unit albedo (E / pi, 1/m^2).

    positions: (l, 3) metres; column (j, k) is light j emitting sqrt(4 pi) y_k(direction) W/sr, so k = 0 is isotropic;
    radius: metres, a mean over points of a sphere that emits the same from each. Shadows and the receivers' own faces'
    horizons are in it. Independent of threads.
    """
    functions = emission_order ** 2
    spots = positions[:, None] + radius * _sphere(radius)[None]
    result = np.zeros((len(receivers), len(positions) * functions), np.float32)
    tasks = [(slice(start, min(start + BLOCK, len(receivers))), light) for start in range(0, len(receivers), BLOCK)
             for light in range(len(positions))]

    def work(task: tuple[slice, int]) -> tuple[Single, int]:
        return _lit(tracer, receivers, task[0], spots[task[1]], emission_order)

    for number, ((place, light), (values, rays)) in enumerate(tracer.map_in_order(work, tasks)):
        result[place, light * functions:(light + 1) * functions] = values
        tracer.rays += rays
        yield (number + 1) / len(tasks)
    return result


def _sphere(radius: float) -> NDArray[np.float64]:
    """Points of the unit sphere, or its centre where the light has no extent."""
    return spherical_fibonacci(SPHERE_POINTS) if radius > 0.0 else np.zeros((1, 3))


def _lit(tracer: Tracer, receivers: ReceiverSet, place: slice, spots: NDArray[np.float64], emission_order: int,
         ) -> tuple[Single, int]:
    """One light's direct transfer (b, functions) at a block of receivers, and the number of rays."""
    origins, normals = receivers.origins[place], receivers.normals[place].astype(np.float32)
    total, rays = np.zeros((len(origins), emission_order ** 2), np.float32), 0
    for spot in tracer.to_tracing_space(spots):
        towards = spot - origins
        square = np.sum(towards * towards, axis=1)
        height = np.sum(towards * normals, axis=1)
        lit = np.flatnonzero(height > 0.0)
        towards, square, height = towards[lit], square[lit], height[lit]
        distance = np.sqrt(np.maximum(square, np.float32(NUDGE ** 2)))
        reach = np.maximum(1.0 - np.float32(NUDGE) / distance, 0.0).astype(np.float32)
        hidden = tracer.occluded(origins[lit], towards, reach)
        rays += len(lit)
        value = np.where(hidden, np.float32(0.0), height / (np.float32(np.pi) * distance ** 3))
        low = np.flatnonzero((height < receivers.grazing[place][lit] * distance) & ~hidden)
        value[low] *= receivers.above_faces(lit[low] + place.start, towards[low])
        if emission_order == 1:
            total[lit, 0] += value
        else:
            basis = evaluate(emission_order, -towards.astype(np.float64) / distance[:, None])
            total[lit] += value[:, None] * (np.sqrt(4.0 * np.pi) * basis).astype(np.float32)
    # From tracing space, where the scene's diagonal is 1, to metres.
    return total / np.float32(len(spots) * tracer.diagonal ** 2), rays


@dataclass(frozen=True)
class LightSolver:
    """Solves for lights in one scene. albedo: (r, channels) of the gather's receivers; tolerance, bounces: as for
    `interreflect`."""

    tracer: Tracer
    scene: SceneMesh
    gathered: Gather
    albedo: Single
    tolerance: float
    bounces: int
    emission_order: int = 1
    radius: float = 0.0

    def solve(self, positions: NDArray[np.float64], take: Consumer) -> Generator[float]:
        """Yield progress; give the indirect responses to lights at positions (l, 3) to `take`, block by block."""
        functions = self.emission_order ** 2
        size = max(1, COLUMNS // functions)
        for start in range(0, len(positions), size):
            part = slice(start, min(start + size, len(positions)))
            share = (part.stop - start) / max(1, len(positions))
            first = start / max(1, len(positions))
            direct = yield from _scaled(unit_light_direct(self.tracer, self.gathered.receivers, positions[part],
                                                          self.emission_order, self.radius), first, 0.5 * share)
            source = conserve_flux(direct, self.scene, self.gathered.receivers, positions[part], functions, self.radius)
            steps = interreflect(self.gathered.matrix, self.albedo, source, self.tolerance, self.bounces)
            bounced = yield from _scaled(steps, first + 0.5 * share, 0.5 * share)
            response = bounced.transfer
            response -= source[:, :, None]
            take(part, response)


def _scaled(steps: Generator[float, None, object], first: float, share: float) -> Generator[float, None, object]:
    """The progress of a part of the work; its result."""
    while True:
        try:
            yield first + share * next(steps)
        except StopIteration as end:
            return end.value


def conserve_flux(direct: Single, scene: SceneMesh, receivers: ReceiverSet, positions: NDArray[np.float64],
                  functions: int, radius: float = 0.0) -> Single:
    """The direct field (r, lights * functions) as the operator's source: with the flux that near triangles really get.

    The operator interpolates between corners. Where a light is nearer to a triangle than a few of its edges that misses
    the peak between them, or takes a corner's peak for the whole triangle. The flux of a unit light through a triangle
    is its solid angle (Van Oosterom and Strackee 1983); a corner's value is scaled by the ratio of that to what
    interpolation gives, over the triangles around it.
    """
    result = direct
    count = len(scene.points)
    row = np.full(2 * count, -1, np.int64)
    row[receivers.key] = np.arange(len(receivers))
    corners = scene.points[scene.triangles]
    edges = np.roll(corners, -1, axis=1) - corners
    longest = np.sqrt(np.max(np.sum(edges ** 2, axis=2), axis=1))
    centre = corners.mean(axis=1)
    normal = np.cross(edges[:, 0], edges[:, 1])
    double_area = np.sqrt(np.sum(normal ** 2, axis=1))
    normal /= np.maximum(double_area, np.finfo(np.float64).tiny)[:, None]
    for light, position in enumerate(positions):
        offset = position - centre
        reach = NEAR * longest + radius
        near = np.flatnonzero(np.sum(offset ** 2, axis=1) < reach ** 2)
        if not len(near):
            continue
        for side in (0, 1):
            facing = near[(np.sum(offset[near] * normal[near], axis=1) > 0.0) == (side == 0)]
            rows = row[scene.triangles[facing] + side * count]
            known = (rows >= 0).all(axis=1)
            facing, rows = facing[known], rows[known]
            if not len(facing):
                continue
            normals = (1.0 - 2.0 * side) * scene.normals[scene.triangles[facing]]
            factor = _corrections(corners[facing] - position, normals, 0.5 * double_area[facing], rows, len(receivers))
            touched = np.unique(rows)
            if result is direct:
                result = direct.copy()
            result[touched, light * functions:(light + 1) * functions] *= factor[touched, None].astype(np.float32)
    return result


def _corrections(corners: NDArray[np.float64], normals: NDArray[np.float64], area: NDArray[np.float64],
                 rows: NDArray[np.int64], count: int) -> NDArray[np.float64]:
    """Factors (count,) for receivers `rows` (t, 3) at the corners (t, 3, 3) of triangles, seen from the light."""
    length = np.maximum(np.sqrt(np.sum(corners ** 2, axis=2)), 1e-30)
    cosine = np.maximum(-np.sum(corners * normals, axis=2) / length, 0.0)
    sampled = cosine / length ** 2 * (area / 3.0)[:, None]
    true = solid_angles(corners, length)
    interpolated = np.bincount(rows.ravel(), sampled.ravel(), count)
    # Of each triangle's flux a corner gets the share that interpolation would give it.
    share = np.divide(sampled, sampled.sum(axis=1, keepdims=True), out=np.full_like(sampled, 1.0 / 3.0),
                      where=sampled.sum(axis=1, keepdims=True) > 0.0)
    got = np.bincount(rows.ravel(), (share * true[:, None]).ravel(), count)
    ratio = np.divide(got, interpolated, out=np.ones(count), where=interpolated > 0.0)
    return np.clip(ratio, 1.0 / MOST_CORRECTION, MOST_CORRECTION)


def solid_angles(corners: NDArray[np.float64], length: NDArray[np.float64]) -> NDArray[np.float64]:
    """Solid angles (t,) of triangles (t, 3, 3) seen from the origin; length: (t, 3) of their corners' vectors."""
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    volume = np.abs(np.sum(a * np.cross(b, c), axis=1))
    below = (length.prod(axis=1) + np.sum(a * b, axis=1) * length[:, 2] + np.sum(b * c, axis=1) * length[:, 0]
             + np.sum(c * a, axis=1) * length[:, 1])
    return 2.0 * np.arctan2(volume, below)
