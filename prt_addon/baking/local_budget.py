# SPDX-License-Identifier: GPL-3.0-or-later
"""The error budget of local lights: bounced light of a lamp at places that no light of the cloud has, at random
receivers, against independent paths.

sampling: our solution at the very place (rays of the gather operator, vertices); basis: what the cloud as a basis of
light adds, interpolation between its lights and merging; compression: clustered PCA; total: what is drawn.
"""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..lighting.light_visibility import surroundings
from ..lighting.lit_surfaces import LocalBasis
from ..linear_algebra import batched_multiply
from ..relighting.lamp_light import unit_weights
from ..scene.scene_mesh import SceneMesh
from ..tracing.tracer import Tracer
from ..transport.path_reference import PointLights, reference_radiance
from ..transport.receiver_set import ReceiverSet
from .error_budget import by_object, summary

# Places of a lamp that the budget looks at, and how near to a surface they may be, in spacings of the cloud: nearer,
# all light comes from one small bright spot, which no cloud and few rays can follow.
PLACES, CLEARANCE = 12, 0.5


@dataclass(frozen=True)
class Probes:
    """positions: (n, 3) of a lamp; responses: (points, n, channels) float32 solved there, of 1 W/sr."""

    positions: NDArray[np.float64]
    responses: NDArray[np.float32]


def probe_positions(tracer: Tracer, dense: NDArray[np.float64], spacing: float, seed: int) -> NDArray[np.float64]:
    """Random places between places (n, 3) that lie so many metres apart, clear of surfaces, at most PLACES."""
    generator = np.random.Generator(np.random.PCG64([seed, 79]))
    dense = dense[generator.integers(0, len(dense), 32 * PLACES)]
    places = dense + spacing * generator.uniform(-0.5, 0.5, dense.shape)
    around = surroundings(tracer, places)
    return places[~around.inside & (around.clearance > CLEARANCE * spacing)][:PLACES]


def local_budget(tracer: Tracer, scene: SceneMesh, albedo: NDArray[np.float32], keys: NDArray[np.int64],
                 cloud: LocalBasis, zone: NDArray[np.int32], probes: Probes, transfer: NDArray[np.float64],
                 compressed: NDArray[np.float64], bounces: int, paths: int, seed: int,
                 objects: NDArray[np.int64] | None = None, names: tuple[str, ...] = (),
                 ) -> Generator[float, None, dict[str, Any]]:
    """Yield progress, return {"sampling", "basis", "compression", "total"}: each as in `error_budget`, over receivers,
    places and channels.

    keys: (k,) of receivers; zone: (k,) theirs; objects: (k,) number of the object that each belongs to, names: of
    objects, where the total is to be told of each; transfer, compressed: (k, columns, channels) before and after.
    """
    receivers = ReceiverSet.of_keys(scene, tracer, keys)
    place = np.searchsorted(keys, receivers.key)
    before = tracer.rays

    def nothing(directions: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.zeros((len(directions), len(probes.positions), 1))

    truth = yield from reference_radiance(tracer, scene, receivers, albedo, nothing, PointLights(probes.positions),
                                          paths, bounces, seed)
    rays = tracer.rays - before
    shape = truth.shape[1:]  # (k, places, 3)
    solved = np.broadcast_to(probes.responses[keys[place]].astype(np.float64), shape)
    weights = unit_weights(cloud, tracer, probes.positions)  # (places, zones, lights)
    own = weights[:, zone[place]].transpose(1, 0, 2)  # (k, places, lights)
    step = cloud.emission_order ** 2
    interpolated, drawn = (np.broadcast_to(batched_multiply(own, np.ascontiguousarray(
        values[place][:, ::step][:, :own.shape[2]])), shape) for values in (transfer, compressed))
    first, second = truth
    # Every place counts alike, whether it is near to a surface, where all is brighter, or far.
    power = first * second
    alike = 1.0 / np.maximum(power.sum(axis=(0, 2), keepdims=True), np.finfo(np.float64).tiny)
    power = np.sum(power * alike, axis=(1, 2))

    def entry(squared: NDArray[np.float64], reference_rays: int) -> dict[str, Any]:
        return summary(np.sum(squared * alike, axis=(1, 2)), power, reference_rays, seed)

    found = {"sampling": entry((solved - first) * (solved - second), rays),
            "basis": entry((interpolated - solved) ** 2, 0),
            "compression": entry((drawn - interpolated) ** 2, 0),
            "total": entry((drawn - first) * (drawn - second), rays)}
    if objects is not None:
        squared = np.sum((drawn - first) * (drawn - second) * alike, axis=(1, 2))
        found["total"]["objects"] = by_object(squared, power, objects[place], names, seed)
    return found
