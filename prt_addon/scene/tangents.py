# SPDX-License-Identifier: GPL-3.0-or-later
"""Tangents: the x axis of the frame that holds a receiver's exit radiance (y = normal x tangent, z = normal)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..linear_algebra import multiply

# A wanted direction whose part along the surface is shorter than this fraction of it says nothing.
STEEPEST = 1e-3
UP = np.array([0.0, 0.0, 1.0])
POLES = 256  # among which the quietest is chosen


def smooth_tangents(normals: NDArray[np.float64], pole: NDArray[np.float64] = UP) -> NDArray[np.float64]:
    """Unit tangents (p, 3) of unit normals (p, 3) that change as little as possible from point to point.

    A direction across the pole, taken along by the smallest rotation from the pole to the normal. Exit radiance is
    interpolated between neighbours as if they shared one frame, so a smooth field matters. None is smooth on all of a
    closed surface: this one spins where the normal is opposite to the pole.
    """
    across = _unit(np.cross(pole, np.eye(3)[np.abs(pole).argmin()])[None])[0]
    height = 1.0 + np.sum(normals * pole, axis=1)
    share = np.sum(normals * across, axis=1) / np.maximum(height, 1e-12)
    tangents = across - share[:, None] * (normals + pole)
    tangents[height < 1e-9] = across  # the formula cancels there
    return _unit(tangents - np.sum(tangents * normals, axis=1, keepdims=True) * normals)


def quiet_pole(normals: NDArray[np.float64]) -> NDArray[np.float64]:
    """The pole (3,) for `smooth_tangents` whose opposite is farthest from most of the unit normals (p, 3): off the
    walls, floor and ceiling of a room, and on a small or strongly curved part of anything else."""
    index = np.arange(POLES) + 0.5
    height, turn = 1.0 - 2.0 * index / POLES, index * np.pi * (3.0 - np.sqrt(5.0))
    radius = np.sqrt(1.0 - height ** 2)
    poles = np.stack([radius * np.cos(turn), radius * np.sin(turn), height], axis=1)
    some = normals[:: max(1, len(normals) // 4096)]
    # The frame spins at a rate of 1 over the angle to the opposite of the pole, whose square is 2 (1 + cosine).
    spin = np.sum(1.0 / (0.02 + 1.0 + multiply(some, poles.T)), axis=0)
    return poles[spin.argmin()]


def tangent_frame(wanted: NDArray[np.float64], normals: NDArray[np.float64], pole: NDArray[np.float64] = UP,
                  ) -> NDArray[np.float64]:
    """Unit tangents (p, 3): the part of the wanted directions (p, 3) along the surface, `smooth_tangents` where there
    is none (zero, not finite, or along the normal)."""
    along = wanted - np.sum(wanted * normals, axis=1, keepdims=True) * normals
    length = np.sqrt(np.sum(along ** 2, axis=1))
    usable = length > STEEPEST * np.sqrt(np.sum(wanted ** 2, axis=1))  # False for zero and NaN
    result = np.empty_like(along)
    result[usable] = along[usable] / length[usable, None]
    # Once more, because a direction near the normal loses digits in the first difference.
    result[usable] -= np.sum(result[usable] * normals[usable], axis=1, keepdims=True) * normals[usable]
    result[usable] = _unit(result[usable])
    result[~usable] = smooth_tangents(normals[~usable], pole)
    return result


def _unit(vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    return vectors / np.sqrt(np.sum(vectors ** 2, axis=1, keepdims=True))
