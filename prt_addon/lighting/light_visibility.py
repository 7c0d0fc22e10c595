# SPDX-License-Identifier: GPL-3.0-or-later
"""What lies between two lights, and which places lie inside bodies."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..basis.directions import spherical_fibonacci
from ..tracing.tracer import Tracer

# How far both ends of a ray are moved towards each other, as a fraction of the scene's diagonal: 64 units in the last
# place of single precision, in which Embree holds coordinates. A light on a surface must not be hidden by it.
NUDGE = 4e-6
# A place is inside a body if more than this share of its rays first meet the back of a surface. Below a single-sided
# floor up to half of them do, by chance a few more of the 64.
INSIDE = 0.6
# Rays from a place that tell whether it lies in a body and how far the nearest surface is.
DIRECTIONS = 64
# Places probed at once: their rays take 2 MB.
BLOCK = 1024


def visible_between(tracer: Tracer, starts: NDArray[np.float64], ends: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Whether nothing lies between starts (n, 3) and ends (n, 3), world space, metres: (n,).

    Places nearer to each other than rays can tell apart see each other.
    """
    first, last = tracer.to_tracing_space(starts), tracer.to_tracing_space(ends)
    step = last - first
    length = np.sqrt(np.vecdot(step, step))  # small
    far = np.flatnonzero(length > 2.5 * NUDGE)
    visible = np.ones(len(first), bool)
    if len(far):
        direction = step[far] / length[far, None]
        origin = first[far] + np.float32(NUDGE) * direction
        visible[far] = ~tracer.occluded(origin, direction, length[far] - np.float32(2 * NUDGE))
        tracer.rays += len(far)
    return visible


@dataclass(frozen=True)
class Surroundings:
    """Of places (n,): inside: within a body; clearance: metres to the nearest surface that rays met (inf: none)."""

    inside: NDArray[np.bool_]
    clearance: NDArray[np.float64]


def surroundings(tracer: Tracer, positions: NDArray[np.float64]) -> Surroundings:
    """What rays in DIRECTIONS directions see from positions (n, 3).

    A place is inside a body if most of its rays first meet the back of a surface. So a hole in the body does not
    matter, nor another body that crosses it; a place below a single-sided floor (half of its rays meet it) is outside,
    as is one in a closed room, which shows its front faces.
    """
    directions = spherical_fibonacci(DIRECTIONS).astype(np.float32)
    inside = np.zeros(len(positions), bool)
    clearance = np.full(len(positions), np.inf)
    for start in range(0, len(positions), BLOCK):
        part = slice(start, start + BLOCK)
        origins = tracer.to_tracing_space(positions[part])
        backs = np.zeros(len(origins), np.int32)
        nearest = np.full(len(origins), np.inf, np.float32)
        for direction in directions:  # one direction for all places: coherent rays
            hits = tracer.nearest(origins, direction[None, :])
            met = hits.triangle >= 0
            backs += met & ~hits.front
            np.minimum(nearest, np.where(met, hits.distance, np.float32(np.inf)), out=nearest)
        tracer.rays += len(origins) * DIRECTIONS
        inside[part] = backs > INSIDE * DIRECTIONS
        clearance[part] = nearest.astype(np.float64) * tracer.diagonal
    return Surroundings(inside, clearance)
