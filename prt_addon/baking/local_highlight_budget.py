# SPDX-License-Identifier: GPL-3.0-or-later
"""The error budget of highlights under lamps, measured at random glossy receivers from random views, for a lamp at
places that no light of the cloud has, against independent paths.

What surfaces that the lamp shines on show in the highlight (light that bounced):

compression  decoded rows          - rows as baked, both put together from the cloud's lights around the lamp
baked        rows as baked         - true highlights, in which shiny surfaces spread their own light evenly
bounces      that                  - with the true highlights of all surfaces along every path
total        decoded rows          - that

And what no bake holds: direct, the lamp itself in the highlight as relighting adds it, where nothing hides it.
All are relative RMS over receivers, views, places and channels; every place of the lamp counts alike.
"""

from __future__ import annotations

from collections.abc import Generator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..basis import hemisphere
from ..basis.spherical_harmonics import evaluate, order_of
from ..lighting.lit_surfaces import LocalBasis
from ..linear_algebra import batched_multiply, multiply
from ..relighting.lamp_light import unit_weights
from ..transport.glossy import surface_frames
from ..transport.path_reference import PATHS_AT_ONCE, PointLights
from ..transport.receiver_set import ReceiverSet
from .error_budget import by_object, summary
from .highlight_budget import VIEWS, HighlightSample
from .highlight_reference import ALL_HITS, TrueSurfaces, arriving_radiance
from .highlight_sampling import cosine_directions, lattice, to_local, to_world

Array = NDArray[np.float64]


def local_highlight_budget(surfaces: TrueSurfaces, sample: HighlightSample, cloud: LocalBasis, zone: NDArray[np.int32],
                           positions: Array, bounces: int, paths: int, seed: int,
                           ) -> Generator[float, None, dict[str, Any]]:
    """Yield progress, return an entry (see `error_budget.summary`) of each difference above.

    sample: with the columns of the cloud alone; zone: (k,) of its receivers; positions: (n, 3) of a lamp; bounces: most
    bounces, -1 for all; paths: of each receiver, for all places together.
    """
    scene, tracer = surfaces.scene, surfaces.tracer
    receivers = ReceiverSet.of_keys(scene, tracer, sample.keys)
    receivers = receivers.taken(np.argsort(receivers.key))  # as in the sample
    frames = surface_frames(scene.normals[sample.keys], scene.tangents[sample.keys])
    generator = np.random.Generator(np.random.PCG64([seed, 81]))
    views = cosine_directions(lattice(len(sample.keys), VIEWS, generator)).reshape(-1, VIEWS, 3)
    shown = hemisphere.evaluate(sample.functions, views.reshape(-1, 3)).reshape(*views.shape[:2], -1)
    before = tracer.rays
    even, full = yield from _truth(surfaces, receivers, frames, views, positions, bounces, paths, seed)
    rays = tracer.rays - before
    weights = unit_weights(cloud, tracer, positions)  # (places, zones, lights)
    own = weights[:, zone].transpose(1, 2, 0)  # (k, lights, places)
    baked, drawn = (_seen(shown, values[:, :, ::cloud.emission_order ** 2], own)
                    for values in (sample.rows, sample.compressed))
    alike = _alike(full[0] * full[1])
    power = _sum(full[0] * full[1], alike)
    differences = {"baked": baked - even, "bounces": even - full, "compression": np.stack([drawn - baked] * 2),
                   "total": drawn - full}
    found = {name: summary(_sum(pair[0] * pair[1], alike), power, rays, seed) for name, pair in differences.items()}
    squared = _sum(differences["total"][0] * differences["total"][1], alike)
    found["total"]["objects"] = by_object(squared, power, sample.objects, sample.names, seed)
    mine, true = _direct(surfaces, receivers, frames, views, shown, scene.material[sample.keys], positions)
    alike = _alike(true ** 2)
    found["direct"] = summary(_sum((mine - true) ** 2, alike), _sum(true ** 2, alike), 0, seed)
    return found


def _seen(shown: Array, rows: Array, weights: Array) -> Array:
    """Highlights (k, views, places, 3) of rows (k, functions, lights, channels) under weights (k, lights, places)."""
    count, functions = rows.shape[:2]
    used = rows[:, :, :weights.shape[1]]
    mixed = np.stack([batched_multiply(np.ascontiguousarray(used[..., min(c, rows.shape[3] - 1)]),
                                       np.ascontiguousarray(weights)) for c in range(3)], axis=-1)
    flat = batched_multiply(np.ascontiguousarray(shown), mixed.reshape(count, functions, -1))
    return flat.reshape(count, shown.shape[1], -1, 3)


def _alike(power: Array) -> Array:
    """(places, 1): what makes every place count alike, near to surfaces, where all is brighter, or far."""
    return 1.0 / np.maximum(power.sum(axis=(0, 1, 3)), np.finfo(np.float64).tiny)[:, None]


def _sum(values: Array, alike: Array) -> Array:
    """(k,) of values (k, views, places, 3)."""
    return np.sum(values * alike, axis=(1, 2, 3))


def _truth(surfaces: TrueSurfaces, receivers: ReceiverSet, frames: Array, views: Array, positions: Array, bounces: int,
           paths: int, seed: int) -> Generator[float, None, tuple[Array, Array]]:
    """True highlights of light that bounced, (2, k, views, places, 3) from two halves: with shiny surfaces that spread
    their light evenly, and with their own highlights."""
    material = surfaces.scene.material[receivers.key]
    of_view = max(2, paths // (2 * VIEWS))
    size = max(1, PATHS_AT_ONCE // (VIEWS * of_view))
    parts = [(half, int(number), members[start:start + size]) for half in range(2) for number in np.unique(material)
             for members in [np.flatnonzero(material == number)] for start in range(0, len(members), size)]
    result = np.zeros((2, 2, len(material), VIEWS, len(positions), 3))

    def nothing(directions: Array) -> Array:
        return np.zeros((len(directions), len(positions), 3))

    def trace(part: tuple[int, int, NDArray[np.int64]]) -> tuple[Array, int]:
        half, number, members = part
        # Random numbers of the part's own, so that the result is the same for any number of threads.
        own = [seed, 82, half, int(members[0])]
        generator = np.random.Generator(np.random.PCG64(own))
        owner = np.repeat(members, VIEWS * of_view)
        seen_from = np.repeat(views[members].reshape(-1, 3), of_view, axis=0)
        numbers = lattice(len(members) * VIEWS, of_view, generator)
        local, weights = surfaces.highlights[number].sample(seen_from, numbers)
        directions = to_world(local, frames[owner]).astype(np.float32)
        weights = weights * receivers.above_faces(owner, directions)[:, None]
        useful = np.flatnonzero(weights.max(axis=1) > 0.0)
        found, rays = arriving_radiance(surfaces, receivers.origins[owner[useful]], directions[useful], nothing,
                                        PointLights(positions), bounces, (0, ALL_HITS), own)
        arrived = np.zeros((len(owner), *found.shape[1:]))
        arrived[useful] = found * weights[useful][:, None, None, :]
        return arrived.reshape(len(members), VIEWS, of_view, *found.shape[1:]).mean(axis=2), rays

    for done, ((half, _, members), (seen, rays)) in enumerate(surfaces.tracer.map_in_order(trace, parts), 1):
        result[0, half, members], result[1, half, members] = seen[:, :, 0], seen[:, :, 1]
        surfaces.tracer.rays += rays
        yield done / len(parts)
    return result[0], result[1]


def _direct(surfaces: TrueSurfaces, receivers: ReceiverSet, frames: Array, views: Array, shown: Array,
            material: NDArray[np.int32], positions: Array) -> tuple[Array, Array]:
    """The lamp itself in the highlights, (k, views, places, 3): by the materials' lamp kernels, and as it is; nothing
    where something hides it."""
    tracer, count = surfaces.tracer, len(material)
    mine, true = np.zeros((2, count, VIEWS, len(positions), 3))
    for place, position in enumerate(tracer.to_tracing_space(positions)):
        towards = position - receivers.origins
        square = np.sum(towards.astype(np.float64) ** 2, axis=1)
        direction = towards / np.sqrt(square)[:, None]
        local = to_local(direction, frames)
        open_sky = (local[:, 2] > 0.0) & ~tracer.occluded(receivers.origins, towards,
                                                          np.full(count, 1.0 - 1e-5, np.float32))
        tracer.rays += count
        strength = open_sky / (square * tracer.diagonal ** 2)
        for number in np.unique(material):
            members = np.flatnonzero((material == number) & open_sky)
            kernel = surfaces.plan.parts[number].lamp_kernel
            if not len(members) or kernel is None:
                continue
            values = evaluate(order_of(kernel.shape[1]), local[members]).T
            rows = np.stack([multiply(np.ascontiguousarray(kernel[:, :, min(c, kernel.shape[2] - 1)]), values).T
                             for c in range(3)], axis=-1)
            rows *= (local[members, 2] * strength[members] / np.pi)[:, None, None]
            mine[members, :, place] = batched_multiply(np.ascontiguousarray(shown[members]), rows)
            for view in range(VIEWS):
                returned = surfaces.highlights[number].evaluate(views[members, view], local[members])
                true[members, view, place] = returned * strength[members, None]
    return mine, true
