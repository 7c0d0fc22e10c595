# SPDX-License-Identifier: GPL-3.0-or-later
"""The error budget of diffuse light: where the difference from the truth comes from, measured at random receivers.

sampling: finite directions and gather rays, in the bake's own columns of light; basis: light detail finer than these;
compression: clustered PCA; total: what is drawn against the full light. Each is a relative RMS of exit radiance over
receivers and channels, under the scene's light, against independent paths, with a 95 % bootstrap interval.
"""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..lighting.bright_light import bright_pixels
from ..lighting.reference_light import ReferenceLight
from ..scene.scene_mesh import SceneMesh
from ..tracing.tracer import Tracer
from ..transport.path_reference import DistantSuns, reference_radiance
from ..transport.receiver_set import ReceiverSet
from .distant_basis import DistantBasis

RESAMPLES = 400
# Receivers of one object below which its own error is not told: their interval would span everything.
FEWEST_RECEIVERS = 6


@dataclass(frozen=True)
class BakedSample:
    """What the bake says at r random receivers, all float64: transfer (r, columns, channels) before and after
    compression; keys: which receivers; objects: (r,) number of the object that each belongs to, names: of objects."""

    keys: NDArray[np.int64]
    transfer: NDArray[np.float64]
    compressed: NDArray[np.float64]
    objects: NDArray[np.int64] | None = None
    names: tuple[str, ...] = ()


def choose_receivers(candidates: NDArray[np.int64], count: int, seed: int) -> NDArray[np.int64]:
    """`count` of the candidate keys at random, sorted; all where there are fewer."""
    generator = np.random.Generator(np.random.PCG64([seed, 77]))
    if len(candidates) <= count:
        return np.sort(candidates)
    return np.sort(generator.choice(candidates, count, replace=False))


def error_budget(tracer: Tracer, scene: SceneMesh, albedo: NDArray[np.float32], sample: BakedSample,
                 light: ReferenceLight, basis: DistantBasis, bounces: int, paths: int, seed: int,
                 ) -> Generator[float, None, dict[str, Any]]:
    """Yield progress, return {"sampling", "basis", "compression", "total"}: see `_entry` for each value's fields."""
    receivers = ReceiverSet.of_keys(scene, tracer, sample.keys)
    place = np.searchsorted(sample.keys, receivers.key)  # reference receivers are in Morton order
    coefficients = basis.coefficients(light)
    bright_banded, broad = basis.split(coefficients, 0)
    bright_full, image = bright_pixels(light.image, light.rotation, 1)
    bright = [found for found in (bright_banded, bright_full) if found is not None]

    def emission(directions: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.stack([basis.radiance(broad, directions), light.looked_up(image, directions)], axis=1)

    suns = DistantSuns(light.sun_directions, light.sun_irradiance, light.sun_angles)
    before = tracer.rays
    halves = yield from reference_radiance(tracer, scene, receivers, albedo, emission, suns, paths, bounces, seed,
                                           bright)
    rays = tracer.rays - before
    banded, full = halves[:, :, 0], halves[:, :, 1]
    baked = _lit(sample.transfer[place], coefficients)
    drawn = _lit(sample.compressed[place], coefficients)
    pair = (banded[0], banded[1])
    found = {
        "sampling": _entry(baked, baked, pair, rays, seed),
        "basis": _difference_entry(banded, full, rays, seed),
        "compression": _entry(drawn, drawn, (baked, baked), 0, seed),
        "total": _entry(drawn, drawn, (full[0], full[1]), rays, seed),
    }
    if sample.objects is not None:
        squared, power = _squares(drawn, drawn, (full[0], full[1]))
        found["total"]["objects"] = by_object(squared, power, sample.objects[place], sample.names, seed)
    return found


def _lit(transfer: NDArray[np.float64], light: NDArray[np.float64]) -> NDArray[np.float64]:
    """Radiance (r, 3) of transfer (r, columns, channels) under light (columns, 3)."""
    return np.sum(transfer * light[None], axis=1)


def _entry(first: NDArray[np.float64], second: NDArray[np.float64], truth: tuple[NDArray[np.float64], ...], rays: int,
           seed: int) -> dict[str, Any]:
    """Relative RMS of (first - truth) with its interval, from two independent estimates of the truth."""
    return summary(*_squares(first, second, truth), rays, seed)


def _squares(first: NDArray[np.float64], second: NDArray[np.float64], truth: tuple[NDArray[np.float64], ...],
             ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Squared error and power (r,) of each receiver, without the truth's own noise."""
    return np.sum((first - truth[0]) * (second - truth[1]), axis=1), np.sum(truth[0] * truth[1], axis=1)


def _difference_entry(banded: NDArray[np.float64], full: NDArray[np.float64], rays: int, seed: int) -> dict[str, Any]:
    """As `_entry`, for two lightings seen along the same paths, whose noise is largely shared."""
    difference = banded - full
    return summary(np.sum(difference[0] * difference[1], axis=1), np.sum(full[0] * full[1], axis=1), rays, seed)


def summary(squared: NDArray[np.float64], power: NDArray[np.float64], rays: int, seed: int) -> dict[str, Any]:
    """{"relative_rms", "interval" (95 %), "receivers", "reference_rays"} of per-receiver squared errors and powers."""
    generator = np.random.Generator(np.random.PCG64([seed, 78]))
    picks = generator.integers(0, len(squared), (RESAMPLES, len(squared)))
    low, high = np.percentile([_relative(squared[p], power[p]) for p in picks], (2.5, 97.5))
    return {"relative_rms": _relative(squared, power), "interval": [float(low), float(high)],
            "receivers": len(squared), "reference_rays": int(rays)}


def by_object(squared: NDArray[np.float64], power: NDArray[np.float64], objects: NDArray[np.int64],
              names: tuple[str, ...], seed: int) -> dict[str, dict[str, Any]]:
    """{name: {"relative_rms", "interval", "receivers"}} of objects (r,) with enough receivers to say something."""
    found = {}
    for number in np.unique(objects):
        mine = objects == number
        if mine.sum() >= FEWEST_RECEIVERS:
            entry = summary(squared[mine], power[mine], 0, seed)
            del entry["reference_rays"]  # shared by all
            found[names[number]] = entry
    return found


def _relative(squared: NDArray[np.float64], power: NDArray[np.float64]) -> float:
    """sqrt(sum of squares / power). The unbiased estimate of a tiny square may fall below zero: that reads as 0, with
    the interval's upper end saying how little is known. No power at all (black) has no relative error: 0."""
    total = float(power.sum())
    return float(np.sqrt(max(float(squared.sum()), 0.0) / total)) if total > 0.0 else 0.0
