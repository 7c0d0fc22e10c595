# SPDX-License-Identifier: GPL-3.0-or-later
"""Tangents: the x axis of the frame that holds a receiver's exit radiance (y = normal x tangent, z = normal)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

# A wanted direction whose part along the surface is shorter than this fraction of it says nothing.
STEEPEST = 1e-3


def smooth_tangents(normals: NDArray[np.float64]) -> NDArray[np.float64]:
    """Unit tangents (p, 3) of unit normals (p, 3) that change as little as possible from point to point.

    The x axis, taken along by the smallest rotation from z to the normal. Exit radiance is interpolated between
    neighbours as if they shared one frame, so a smooth field matters; none is smooth on all of a sphere, and this one
    has its only singular place at the normal straight down, where it is seen least.
    """
    x, y, z = normals[:, 0], normals[:, 1], normals[:, 2]
    share = 1.0 / np.maximum(1.0 + z, 1e-12)
    tangents = np.stack([1.0 - x * x * share, -x * y * share, -x], axis=1)
    down = 1.0 + z < 1e-9  # the formula cancels there
    tangents[down] = (1.0, 0.0, 0.0)
    return _unit(tangents - np.sum(tangents * normals, axis=1, keepdims=True) * normals)


def tangent_frame(wanted: NDArray[np.float64], normals: NDArray[np.float64]) -> NDArray[np.float64]:
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
    result[~usable] = smooth_tangents(normals[~usable])
    return result


def _unit(vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    return vectors / np.sqrt(np.sum(vectors ** 2, axis=1, keepdims=True))
