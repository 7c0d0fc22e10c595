# SPDX-License-Identifier: GPL-3.0-or-later
"""Irradiance from unshadowed shining shapes in closed form, the receiver's own horizon included.

A shape of radiance 1 gives a receiver the area of its outline on the unit sphere, projected straight down on the
receiver's plane (Nusselt's analogue), which is what both forms compute.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def cap_irradiance(sine_squared: Array, cosine: Array) -> Array:
    """Irradiance (n,) from a round spot of the sky of radiance 1: pi sin^2(a) cos(b) where it is wholly above the
    horizon.

    sine_squared: (n,) of its angular radius a, at most a right angle; cosine: (n,) of the angle b between its middle
    and the receiver's normal. Lower, the cap's rim projects to an ellipse about cos(a) sin(b) with half-axes
    sin(a) |cos b| and sin(a); it meets the horizon's unit circle at the azimuths +-f, cos f = cos(a) / sin(b). What is
    seen is the circle's segment beyond these two points, f - sin f cos f, and the ellipse's part before them,
    sin^2(a) cos(b) (g - sin g cos g) with cos g = -cot(a) cot(b); behind the horizon (b > 90 degrees) that part is
    negative. tests/core/test_local_lamps.py compares with quadrature.
    """
    result = np.pi * sine_squared * np.maximum(cosine, 0.0)
    crossing = np.flatnonzero((cosine * cosine < sine_squared) & (sine_squared > 0.0))
    if len(crossing):
        below, along = sine_squared[crossing], cosine[crossing]
        cos_a = np.sqrt(np.maximum(1.0 - below, 0.0))
        sin_b = np.sqrt(np.maximum(1.0 - along * along, 1e-30))
        f = np.arccos(np.clip(cos_a / sin_b, -1.0, 1.0))
        g = np.arccos(np.clip(-cos_a * along / (np.sqrt(below) * sin_b), -1.0, 1.0))
        seen = f - np.sin(f) * np.cos(f) + below * along * (g - np.sin(g) * np.cos(g))
        result[crossing] = np.maximum(seen, 0.0)  # rounding of a cap that barely rises
    return result


def polygon_irradiance(corners: Array, normals: Array) -> Array:
    """Irradiance (n,) from a flat convex polygon of radiance 1, of either winding.

    corners: (k, n, 3), from each receiver to the corners in turn; normals: (n, 3). Lambert's formula (Photometria
    (1760); Baum, Rushmeier, Winget, Improving Radiosity Solutions Through the Use of Analytically Determined
    Form-Factors (1989), eq. 7): half the sum over edges of the edge's angle times the height of the unit vector that
    stands on its plane. What is below the horizon is cut off edge by edge; the cut's own edge lies in the horizon.
    """
    heights = np.sum(corners * normals, axis=2)
    total = np.zeros(corners.shape[1])
    leaving, entering = np.zeros_like(normals), np.zeros_like(normals)
    count = len(corners)
    for edge in range(count):
        start, end = corners[edge], corners[(edge + 1) % count]
        low, high = heights[edge], heights[(edge + 1) % count]
        cut = start + (np.clip(low / np.where(low == high, 1.0, low - high), 0.0, 1.0))[:, None] * (end - start)
        falls, rises = (low > 0.0) & (high <= 0.0), (low <= 0.0) & (high > 0.0)
        leaving[falls], entering[rises] = cut[falls], cut[rises]
        total += _edge(np.where(rises[:, None], cut, start), np.where(falls[:, None], cut, end), normals) * (
            (low > 0.0) | (high > 0.0))
    total += _edge(leaving, entering, normals)  # zero where nothing was cut
    return 0.5 * np.abs(total)


def _edge(start: Array, end: Array, normals: Array) -> Array:
    """The angle between two vectors (n, 3) times the height of the unit vector on their plane; 0 where they are one."""
    upright = np.cross(start, end)
    length = np.sqrt(np.sum(upright ** 2, axis=1))
    angle = np.arctan2(length, np.sum(start * end, axis=1))
    height = np.sum(upright * normals, axis=1)
    return np.divide(angle * height, length, out=np.zeros_like(length), where=length > 0.0)
