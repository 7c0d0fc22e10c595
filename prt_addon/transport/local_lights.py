# SPDX-License-Identifier: GPL-3.0-or-later
"""Responses to the lights of a local cloud: what reaches every receiver by at least one bounce.

Kristensen et al. 2005 (section 4) solve global illumination for each light by photon mapping. The transport between
receivers is the same for all lights, so here the gather operator of distant light carries the direct fields of many
lights at once: exact up to the operator's rays, seconds for a thousand lights.
"""

from __future__ import annotations

from collections.abc import Callable, Generator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ..basis.directions import spherical_fibonacci
from ..basis.spherical_harmonics import evaluate
from ..linear_algebra import multiply, small_symmetric_eigenpairs, sparse_multiply
from ..scene.scene_mesh import SceneMesh
from ..tracing.tracer import Tracer
from .gather import Gather
from .interreflection import interreflect
from .near_light import NearTriangles
from .receiver_set import BLOCK, ReceiverSet

Single = NDArray[np.float32]
# What takes the lights of a slice and their responses (r, lights * functions, channels), in the receivers' order.
Consumer = Callable[[slice, Single], None]
# What takes the lights of a slice and what all surfaces send back of them (r, lights * functions, channels), yielding
# progress.
Viewer = Callable[[slice, Single], Generator[float]]

# Columns carried through the operator at once: 256 of 50,000 receivers and three channels are 154 MB. The more there
# are, the more of what they do after their first bounce is alike.
COLUMNS = 256
# Bounces after the first that are compressed anew before the rest goes on as it is.
COMPRESSED_BOUNCES = 3
# Rays to a light end this far before it, as a fraction of the scene's diagonal: a light on a surface is not hidden.
NUDGE = 4e-6
# Points of a light with a radius that stand for its sphere.
SPHERE_POINTS = 12


def unit_light_direct(tracer: Tracer, receivers: ReceiverSet, positions: NDArray[np.float64], emission_order: int = 1,
                      radius: float = 0.0) -> Generator[float, None, Single]:
    """Yield progress, return direct transfer (r, lights * emission_order^2) float32, for unit albedo (E / pi, 1/m^2).

    positions: (l, 3) metres; column (j, k) is light j emitting sqrt(4 pi) y_k(direction) W/sr, so k = 0 is isotropic;
    radius: metres, a mean over points of a sphere that emits the same from each. Shadows and the receivers' own faces'
    horizons are in it. Independent of threads.
    """
    functions = emission_order ** 2
    spots = positions[:, None] + radius * _sphere(radius)[None]
    # Columns first: each task then writes whole lines of the cache.
    result = np.zeros((len(positions) * functions, len(receivers)), np.float32)
    tasks = [(slice(start, min(start + BLOCK, len(receivers))), light) for start in range(0, len(receivers), BLOCK)
             for light in range(len(positions))]

    def work(task: tuple[slice, int]) -> tuple[Single, int]:
        return _lit(tracer, receivers, task[0], spots[task[1]], emission_order)

    for number, ((place, light), (values, rays)) in enumerate(tracer.map_in_order(work, tasks)):
        result[light * functions:(light + 1) * functions, place] = values.T
        tracer.rays += rays
        yield (number + 1) / len(tasks)
    return np.ascontiguousarray(result.T)


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

    def solve(self, positions: NDArray[np.float64], take: Consumer, view: Viewer | None = None) -> Generator[float]:
        """Yield progress; give the indirect responses to lights at positions (l, 3) to `take`, block by block.

        view: gets the radiance that leaves all surfaces, direct light's part included: the first bounce of whoever
        sees them. (The direct light is the operator's source, whose flux is right on coarse triangles, too.)
        """
        functions = self.emission_order ** 2
        size = max(1, COLUMNS // functions)
        for start in range(0, len(positions), size):
            part = slice(start, min(start + size, len(positions)))
            share = (part.stop - start) / max(1, len(positions))
            first = start / max(1, len(positions))
            half = (0.5 if view is None else 0.3) * share
            direct = yield from _scaled(unit_light_direct(self.tracer, self.gathered.receivers, positions[part],
                                                          self.emission_order, self.radius), first, half)
            self._conserve_flux(self._near, direct, positions[part])
            yield first + half
            yield from _scaled(self._carried(part, direct, take, view), first + half, share - half)

    def solve_fields(self, fields: Single, take: Consumer, view: Viewer | None = None) -> Generator[float]:
        """The same for direct fields (r, n), E / pi at the gather's receivers, in place of lights."""
        for start in range(0, fields.shape[1], COLUMNS):
            part = slice(start, min(start + COLUMNS, fields.shape[1]))
            yield from _scaled(self._carried(part, np.ascontiguousarray(fields[:, part]), take, view),
                               start / fields.shape[1], (part.stop - start) / fields.shape[1])

    def _carried(self, part: slice, direct: Single, take: Consumer, view: Viewer | None) -> Generator[float]:
        """Carry the direct fields of a block through the operator and hand them on."""
        solving = 1.0 if view is None else 0.5
        response = yield from _scaled(self._bounced(direct), 0.0, solving)
        take(part, response)
        if view is not None:
            response += direct[:, :, None]
            response *= self.albedo[:, None, :]
            yield from _scaled(view(part, response), solving, 1.0 - solving)

    @cached_property
    def _near(self) -> NearTriangles:
        return NearTriangles(self.tracer, self.scene, self.gathered.receivers)

    def _conserve_flux(self, near: NearTriangles, direct: Single, positions: NDArray[np.float64]) -> None:
        """Make the direct field (r, lights * functions), in place, the operator's source: see `NearTriangles`."""
        functions = self.emission_order ** 2
        spots = positions[:, None] + self.radius * _sphere(self.radius)[None]

        def work(task: tuple[int, NDArray[np.int64]]) -> int:
            light, triangles = task
            columns = slice(light * functions, (light + 1) * functions)
            return near.replace(direct[:, columns], triangles, spots[light], self.emission_order)

        tasks = enumerate(near.near(positions, self.radius))
        self.tracer.rays += sum(rays for _, rays in self.tracer.map_in_order(work, tasks))

    def _bounced(self, source: Single) -> Generator[float, None, Single]:
        """What arrives after one bounce or more, (r, columns, channels).

        The series starts at the first bounce: a source may be a million times what a light on a surface sends on, and
        taking it from the sum of both would leave nothing of single precision.
        """
        channels = self.albedo.shape[1]
        result = np.zeros((*source.shape, channels), np.float32)
        for channel in range(channels if self.bounces != 0 else 0):
            albedo = np.ascontiguousarray(self.albedo[:, channel:channel + 1])
            first = sparse_multiply(self.gathered.matrix, source * albedo)
            result[:, :, channel] = first
            if self.bounces != 1:
                result[:, :, channel] += yield from _scaled(self._later(first, albedo), channel / channels,
                                                            1.0 / channels)
        return result

    def _later(self, first: Single, albedo: Single) -> Generator[float, None, Single]:
        """What arrives after two bounces or more (r, columns), of one channel.

        Each bounce blurs: after the first, and more so after the second, many lights differ by a few fields only. So
        these bounce on, the leading axes of the columns (of equal length, so that a faint light counts as much), as
        many as leave out less than the tolerance of the first bounce's energy.
        """
        length = np.sqrt(np.sum(np.square(first, dtype=np.float64), axis=0))
        scale = np.divide(1.0, length, out=np.zeros_like(length), where=length > 0.0)
        term, shares = first * scale.astype(np.float32), np.eye(first.shape[1], dtype=np.float32)
        energy = float(np.count_nonzero(scale))  # of columns of unit length
        total = np.zeros_like(first)
        left = np.inf if self.bounces < 0 else self.bounces - 1
        for step in range(int(min(COMPRESSED_BOUNCES, left))):
            term, shares = _leading(term, shares, self.tolerance ** 2 * energy)
            term = sparse_multiply(self.gathered.matrix, term * albedo)
            multiply(term, shares, out=total, accumulate=True)
            yield (step + 1) / (COMPRESSED_BOUNCES + 1)
        term, shares = _leading(term, shares, self.tolerance ** 2 * energy)
        if left > COMPRESSED_BOUNCES and shares.shape[0]:
            now = float(np.sum(np.square(term, dtype=np.float64)))
            tolerance = min(1.0, self.tolerance * np.sqrt(energy / now)) if now > 0.0 else 1.0
            bounces = -1 if self.bounces < 0 else int(left) - COMPRESSED_BOUNCES
            bounced = yield from interreflect(self.gathered.matrix, albedo, term, tolerance, bounces)
            multiply(bounced.transfer[:, :, 0] - term, shares, out=total, accumulate=True)
        return total * length.astype(np.float32)


def _leading(term: Single, shares: Single, least: float) -> tuple[Single, Single]:
    """Axes (r, k) and shares (k, columns) of the fields term (r, m) times shares (m, columns), without the axes that
    together hold less energy than `least`."""
    gram = multiply(multiply(shares.T, multiply(term.T, term)), shares).astype(np.float64)
    energies, axes = small_symmetric_eigenpairs(0.5 * (gram + gram.T))
    order = np.argsort(energies)
    kept = order[np.cumsum(np.maximum(energies[order], 0.0)) > least]
    axes = np.ascontiguousarray(axes[:, kept], np.float32)
    return multiply(term, multiply(shares, axes)), np.ascontiguousarray(axes.T)


def _scaled(steps: Generator[float, None, object], first: float, share: float) -> Generator[float, None, object]:
    """The progress of a part of the work; its result."""
    while True:
        try:
            yield first + share * next(steps)
        except StopIteration as end:
            return end.value
