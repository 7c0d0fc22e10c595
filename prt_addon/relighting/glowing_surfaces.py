# SPDX-License-Identifier: GPL-3.0-or-later
"""Direct light of surfaces that glow, by shadow rays to points on them: form factors of a bake are too coarse for it.

A small bright surface is met by a few of a receiver's gather rays or by none, which shows as blotches. How much of the
light of a surface of radiance 1 arrives depends on nothing that an artist edits live, so that it is traced once.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..scene.receivers import ray_origins
from ..tracing.tracer import Tracer

Single = NDArray[np.float32]
SAMPLES = 128  # points on a glowing surface
# Rays end just before the point that they aim at, which lies on a surface itself.
REACH = 1.0 - 1e-3
# Steps of the two-dimensional golden ratio's sequence, for places within triangles (Roberts 2018).
STEPS = 0.7548776662466927, 0.5698402909980532


def glow_of(tracer: Tracer, positions: NDArray[np.floating], normals: NDArray[np.floating],
            triangles: NDArray[np.int32], corners: NDArray[np.floating], faces: NDArray[np.floating] | None = None,
            samples: int = SAMPLES) -> Single:
    """E / pi (p,) float32 that receivers get from triangles of radiance 1, which shine on both sides as in Cycles.

    positions, normals: (p, 3), world space of the tracer; triangles: (t, 3) of the receivers; corners: (e, 3, 3) of
    what glows; faces: see `scene.receivers.ray_origins`. Each sample is a disc of its share of the area a, whose light
    cos cos' a / (pi d^2 + a) stays finite however near it is.
    """
    arriving = np.zeros(len(positions), np.float32)
    points, upright, area = _samples(corners, samples)
    if area <= 0.0:
        return arriving
    upward = np.asarray(normals, np.float64)
    starts = ray_origins(np.asarray(positions, np.float64), upward, triangles, tracer.diagonal, **(
        {} if faces is None else {"faces": faces}))
    origins, targets = tracer.to_tracing_space(starts), tracer.to_tracing_space(points)
    facing, share = upward.astype(np.float32), np.float32(area / tracer.diagonal ** 2)
    for target, normal in zip(targets, upright.astype(np.float32), strict=True):
        away = target - origins
        square = np.sum(away * away, axis=1)
        height = np.sum(away * facing, axis=1)
        seen = np.flatnonzero((height > 0.0) & (square > 0.0))
        away, square = away[seen], square[seen]
        weight = height[seen] * np.abs(np.sum(away * normal, axis=1)) / square * share / (np.pi * square + share)
        hidden = tracer.occluded(origins[seen], away, np.full(len(seen), REACH, np.float32))
        arriving[seen] += np.where(hidden, np.float32(0.0), weight.astype(np.float32))
    return arriving


def _samples(corners: NDArray[np.floating], count: int) -> tuple[NDArray[np.float64], NDArray[np.float64], float]:
    """Points (count, 3) spread evenly over triangles (e, 3, 3), the unit normals there, and the area of each point."""
    corners = np.asarray(corners, np.float64)
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    double = np.sqrt(np.sum(across ** 2, axis=1))
    total = float(double.sum())
    if total <= 0.0:
        return np.zeros((0, 3)), np.zeros((0, 3)), 0.0
    steps = (np.arange(count) + 0.5) / count
    chosen = np.minimum(np.searchsorted(np.cumsum(double) / total, steps), len(corners) - 1)
    u, v = ((0.5 + np.arange(count) * step) % 1.0 for step in STEPS)
    folded = u + v > 1.0
    u, v = np.where(folded, 1.0 - u, u), np.where(folded, 1.0 - v, v)
    a, b, c = (corners[chosen, corner] for corner in range(3))
    points = a + u[:, None] * (b - a) + v[:, None] * (c - a)
    return points, across[chosen] / double[chosen, None], 0.5 * total / count
