# SPDX-License-Identifier: GPL-3.0-or-later
"""The error budget of highlights, measured at random glossy receivers from random views, against independent rays.

The chain from what is drawn to the truth, each step a difference of two pictures of the highlight alone:

compression  decoded rows          - rows as baked
sampling     rows as baked         - the same rows filled with independent rays (the material's matrix applied to
                                     measured incident radiance)
rows         these                 - the true highlight, no basis of views, under the light in the bake's own columns
basis        that                  - under the full light (what order or texels leave out, and a window against ringing)
bounces      that                  - with the true highlights of all surfaces along every path
total        decoded rows          - that

All are relative RMS over receivers, views and channels, views distributed as the pixels of a convex body show them
(by their cosine), in units of the true highlight. Subsurface light and how the highlight dims the diffuse layer are in
the same rows, but not in here: both are added to the rows as they are, and taken out again before anything is compared.
"""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..basis import hemisphere
from ..basis.directions import disc_directions, tangent_frames
from ..basis.hemisphere import Indices
from ..basis.spherical_harmonics import evaluate, order_of
from ..lighting.reference_light import ReferenceLight
from ..linear_algebra import batched_multiply, multiply
from ..transport.glossy import surface_frames
from ..transport.path_reference import PATHS_AT_ONCE, DistantSuns
from ..transport.receiver_set import ReceiverSet
from .distant_basis import DistantBasis
from .error_budget import by_object, summary
from .highlight_reference import ALL_HITS, TrueSurfaces, arriving_radiance
from .highlight_sampling import (
    TrueHighlight,
    cosine_directions,
    even_directions,
    lattice,
    to_local,
    to_world,
)

Array = NDArray[np.float64]

# Views of each receiver. More views share the same number of paths.
VIEWS = 8
# Directions over a sun's disc that each view is lit from.
SUN_DIRECTIONS = 64
# Values along a path: light in the bake's columns, full light. Depths: recorded bounces, all bounces.
BANDED, FULL = 0, 1
RECORDED, ALL = 0, 1


@dataclass(frozen=True)
class HighlightSample:
    """What the bake says at k glossy receivers: rows (k, functions, columns, channels) before and after compression.

    keys: which receivers (points, sorted); objects: (k,) number of the object that each belongs to, names: of objects.
    """

    keys: NDArray[np.int64]
    rows: Array
    compressed: Array
    functions: Indices
    objects: NDArray[np.int64]
    names: tuple[str, ...]


@dataclass(frozen=True)
class Measured:
    """Of k receivers in the two halves: band, recorded, full (2, k, views, 3) true highlights; incident (2, k, n^2, 3)
    integrals of what arrives, in the bake's columns and bounces."""

    band: Array
    recorded: Array
    full: Array
    incident: Array


def highlight_budget(surfaces: TrueSurfaces, sample: HighlightSample, light: ReferenceLight, basis: DistantBasis,
                     bounces: int, recorded: int, paths: int, seed: int, soft: bool = False,
                     ) -> Generator[float, None, dict[str, Any]]:
    """Yield progress, return an entry (see `error_budget.summary`) of each step of the chain above.

    bounces: most bounces, -1 for all. recorded: at how many hits of a path the bake has true highlights (0 or 1).
    paths: of each receiver. soft: whether highlights reflect a light that rings less.
    """
    tracer, scene = surfaces.tracer, surfaces.scene
    receivers = ReceiverSet.of_keys(scene, tracer, sample.keys)
    receivers = receivers.taken(np.argsort(receivers.key))  # as in the sample
    frames = surface_frames(scene.normals[sample.keys], scene.tangents[sample.keys])
    generator = np.random.Generator(np.random.PCG64([seed, 79]))
    views = cosine_directions(lattice(len(sample.keys), VIEWS, generator)).reshape(-1, VIEWS, 3)
    # Its rays meet the environment by chance alone: pixels must not be too small for that.
    light = light.coarse()
    task = Measurement(surfaces, receivers, frames, views, light, basis, bounces, (recorded, ALL_HITS), paths, seed,
                       soft)
    before = tracer.rays
    measured = yield from measure(task, scene.material[sample.keys])
    rays = tracer.rays - before
    shown = hemisphere.evaluate(sample.functions, views.reshape(-1, 3)).reshape(*views.shape[:2], -1)
    coefficients = task.reflected
    baked = _seen(shown, np.sum(sample.rows * coefficients[None, None], axis=2))
    drawn = _seen(shown, np.sum(sample.compressed * coefficients[None, None], axis=2))
    rows = np.stack([_seen(shown, _reflected(surfaces, scene.material[sample.keys], incident))
                     for incident in measured.incident])
    return _entries(sample, measured, baked, drawn, rows, rays, seed)


def _entries(sample: HighlightSample, measured: Measured, baked: Array, drawn: Array, rows: Array, rays: int,
             seed: int) -> dict[str, Any]:
    """Each step's entry; all in units of the truth, so that the squares of independent steps add up to the total's."""
    power = _product(measured.full)
    differences = {
        "sampling": baked - rows,
        "rows": rows - measured.band,
        "basis": measured.band - measured.recorded,
        "bounces": measured.recorded - measured.full,
        "compression": np.stack([drawn - baked] * 2),
        "total": drawn - measured.full,
    }
    found = {name: summary(_product(difference), power, rays, seed) for name, difference in differences.items()}
    found["total"]["objects"] = by_object(_product(differences["total"]), power, sample.objects, sample.names, seed)
    return found


def _product(halves: Array) -> Array:
    """Sum over views and channels of the product of two halves (2, k, views, 3): squares without their noise, (k,)."""
    return np.sum(halves[0] * halves[1], axis=(1, 2))


def _seen(shown: Array, rows: Array) -> Array:
    """Radiance (k, views, 3) of rows (k, functions, 3) at views with values (k, views, functions)."""
    return batched_multiply(np.ascontiguousarray(shown), np.ascontiguousarray(rows))


def _reflected(surfaces: TrueSurfaces, material: NDArray[np.int32], incident: Array) -> Array:
    """Rows (k, functions, 3) that the materials' matrices make of incident radiance's integrals (k, n^2, 3)."""
    kernels = {int(number): surfaces.plan.parts[number].kernel for number in np.unique(material)}
    result = np.empty((len(material), next(iter(kernels.values())).shape[0], 3))
    for number, kernel in kernels.items():
        members = np.flatnonzero(material == number)
        for channel in range(3):
            matrix = np.ascontiguousarray(kernel[:, :, min(channel, kernel.shape[2] - 1)])
            result[members, :, channel] = multiply(incident[members, :, channel], np.ascontiguousarray(matrix.T))
    return result


@dataclass(frozen=True)
class Measurement:
    """What is measured; frames (k, 3, 3), views (k, views, 3) in them; glossy_hits: recorded and all."""

    surfaces: TrueSurfaces
    receivers: ReceiverSet
    frames: Array
    views: Array
    light: ReferenceLight
    basis: DistantBasis
    bounces: int
    glossy_hits: tuple[int, int]
    paths: int
    seed: int
    soft: bool = False

    @property
    def reflected(self) -> Array:
        """The light in the bake's columns as its highlights reflect it, (columns, 3)."""
        coefficients = self.basis.coefficients(self.light)
        return self.basis.for_highlights(coefficients) if self.soft else coefficients

    @property
    def of_view(self) -> int:
        """Paths of one view in one half: half of all follow views, half measure the incident radiance."""
        return max(2, self.paths // (4 * VIEWS))

    @property
    def even(self) -> int:
        """Paths of one receiver in one half that measure the incident radiance."""
        return max(16, self.paths // 4)


def measure(task: Measurement, material: NDArray[np.int32]) -> Generator[float, None, Measured]:
    """Trace both halves, material by material, in parts that fit the cache."""
    size = max(1, PATHS_AT_ONCE // (VIEWS * task.of_view + task.even))
    parts = [(half, number, members[start:start + size])
             for half in range(2) for number in np.unique(material)
             for members in [np.flatnonzero(material == number)] for start in range(0, len(members), size)]
    count = len(material)
    columns = {part.kernel.shape[1] for part in task.surfaces.plan.parts if part.kernel is not None}.pop()
    measured = Measured(*(np.zeros((2, count, VIEWS, 3)) for _ in range(3)), np.zeros((2, count, columns, 3)))
    tracer = task.surfaces.tracer

    def trace(part: tuple[int, int, NDArray[np.int64]]) -> tuple[Array, Array, int]:
        half, number, members = part
        # Random numbers of the part's own, so that the result is the same for any number of threads.
        seed = [task.seed, 80, half, int(members[0])]
        return _trace(task, int(number), members, order_of(columns), seed)

    for done, ((half, _, members), (seen, incident, rays)) in enumerate(tracer.map_in_order(trace, parts), 1):
        measured.band[half, members] = seen[:, :, RECORDED, BANDED]
        measured.recorded[half, members] = seen[:, :, RECORDED, FULL]
        measured.full[half, members] = seen[:, :, ALL, FULL]
        measured.incident[half, members] = incident
        tracer.rays += rays
        yield done / len(parts)
    return measured


def _trace(task: Measurement, number: int, members: NDArray[np.int64], incident_order: int, seed: list[int],
           ) -> tuple[Array, Array, int]:
    """Of some receivers of one material: highlights (k, views, depths, values, 3), incident integrals (k, n^2, 3) and
    rays traced."""
    generator = np.random.Generator(np.random.PCG64(seed))
    highlight = task.surfaces.highlights[number]
    window = task.surfaces.plan.parts[number].window
    coefficients = task.reflected if window is None else task.reflected * window[:task.basis.columns, None]

    def emission(directions: Array) -> Array:
        banded = task.basis.radiance(coefficients, directions)
        return np.stack([banded, task.light.radiance(directions)], axis=1)

    lights = task.light
    suns = DistantSuns(lights.sun_directions, lights.sun_irradiance, lights.sun_angles)
    seen, rays = _seen_by_views(task, members, highlight, emission, suns, generator, seed)
    rays += _add_suns(task, members, highlight, suns, seen, generator)
    incident, more = _incident(task, members, incident_order, emission, suns, generator, seed)
    return seen, incident, rays + more


def _seen_by_views(task: Measurement, members: NDArray[np.int64], highlight: TrueHighlight, emission, suns: DistantSuns,  # noqa: ANN001
                   generator: np.random.Generator, seed: list[int]) -> tuple[Array, int]:
    """Highlights (k, views, depths, values, 3), paths distributed as the material reflects each view."""
    of_view, count = task.of_view, len(members) * VIEWS
    views = np.repeat(task.views[members].reshape(-1, 3), of_view, axis=0)
    owner = np.repeat(members, VIEWS * of_view)
    local, weights = highlight.sample(views, lattice(count, of_view, generator))
    arrived, rays = _arriving(task, owner, local, weights, emission, suns, task.glossy_hits, [*seed, 0])
    return arrived.reshape(len(members), VIEWS, of_view, *arrived.shape[1:]).mean(axis=2), rays


def _incident(task: Measurement, members: NDArray[np.int64], order: int, emission, suns: DistantSuns,  # noqa: ANN001
              generator: np.random.Generator, seed: list[int]) -> tuple[Array, int]:
    """Integrals (k, order^2, 3) of the functions of `order` and what arrives at the bake's own order and bounces."""
    owner = np.repeat(members, task.even)
    local = even_directions(lattice(len(members), task.even, generator))
    weights = np.full((len(owner), 3), 2.0 * np.pi / task.even)
    arrived, rays = _arriving(task, owner, local, weights, emission, suns, task.glossy_hits[:1], [*seed, 1])
    functions = evaluate(order, local).reshape(len(members), task.even, -1).transpose(0, 2, 1)
    banded = arrived[:, RECORDED, BANDED].reshape(len(members), task.even, 3)
    return batched_multiply(np.ascontiguousarray(functions), np.ascontiguousarray(banded)), rays


def _arriving(task: Measurement, owner: NDArray[np.int64], local: Array, weights: Array, emission, suns: DistantSuns,  # noqa: ANN001
              glossy_hits: tuple[int, ...], seed: list[int]) -> tuple[Array, int]:
    """Weighted radiance (n, depths, values, 3) that arrives at receivers from local directions (n, 3)."""
    directions = to_world(local, task.frames[owner]).astype(np.float32)
    weights = weights * task.receivers.above_faces(owner, directions)[:, None]
    useful = np.flatnonzero(weights.max(axis=1) > 0.0)
    found, rays = arriving_radiance(task.surfaces, task.receivers.origins[owner[useful]], directions[useful], emission,
                                    suns, task.bounces, glossy_hits, seed)
    arrived = np.zeros((len(owner), *found.shape[1:]))
    arrived[useful] = found * weights[useful][:, None, None, :]
    return arrived, rays


def _add_suns(task: Measurement, members: NDArray[np.int64], highlight: TrueHighlight, suns: DistantSuns, seen: Array,
              generator: np.random.Generator) -> int:
    """Add the suns that shine on the receivers themselves to the full light; returns the rays traced."""
    owner, rays = np.repeat(members, SUN_DIRECTIONS), 0
    for direction, irradiance, angle in zip(suns.directions, suns.irradiance, suns.angles, strict=True):
        numbers = lattice(len(members), SUN_DIRECTIONS, generator)
        towards, scale = disc_directions(tangent_frames(direction[None, :])[0], float(angle), numbers)
        local = to_local(towards, task.frames[owner])
        share = task.receivers.above_faces(owner, towards) * (local[:, 2] > 0.0)
        facing = np.flatnonzero(share > 0.0)
        shadowed = task.surfaces.tracer.occluded(task.receivers.origins[owner[facing]],
                                                 towards[facing].astype(np.float32))
        share[facing[shadowed]] = 0.0
        rays += len(facing)
        for view in range(VIEWS):
            views = np.repeat(task.views[members, view], SUN_DIRECTIONS, axis=0)
            returned = highlight.evaluate(views, local) * share[:, None]
            mean = returned.reshape(len(members), SUN_DIRECTIONS, 3).mean(axis=1)
            seen[:, view, :, FULL] += (mean * (scale * irradiance))[:, None]
    return rays
