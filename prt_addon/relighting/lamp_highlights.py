# SPDX-License-Identifier: GPL-3.0-or-later
"""Highlights of lamps: their direct light in the rows of a bake's view-dependent surfaces.

A light cloud holds bounced light only, so what a lamp sends straight to a metal is added when relighting, with the
same few functions of the view as the bake's: each material's kernel (`transport.lamp_kernel`) takes the lamp's
direction in the receiver's frame to rows of exit radiance, for the irradiance that the diffuse row gets.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..basis.spherical_harmonics import evaluate, order_of
from ..lighting.local_lights import LocalLight
from ..linear_algebra import multiply

Single = NDArray[np.float32]

# Receivers whose arrays stay in the cache.
BLOCK = 4096
# An Area is cut into parts no wider than this share of the distance to the nearest receiver of a block, at most so many
# across. On a metal of roughness 0.3 a square as wide as far away is then within 2 %, one twice as wide within 3 %
# (from its middle alone: 27 % and 84 %).
PART, MOST_ACROSS = 0.6, 4


@dataclass(frozen=True)
class LampSurfaces:
    """What lamps meet on one bake.

    material: (p,) int32, of each point into the others; kernels: (m, functions, n^2, 1 or 3) float32, zero for a
    material without a highlight; share: (m,) float32, what the layers above leave of the diffuse one; dimming: (m,
    functions) float32, how that differs over views.
    """

    material: NDArray[np.int32]
    kernels: Single
    share: Single
    dimming: Single

    @property
    def shiny(self) -> NDArray[np.int64]:
        """The materials with a highlight."""
        return np.flatnonzero(self.kernels.any(axis=(1, 2, 3)))


class LampHighlights:
    """The rows of one bake's receivers under lamps.

    positions, normals, tangents, albedo: (p, 3), world space.
    """

    def __init__(self, surfaces: LampSurfaces, positions: Single, normals: Single, tangents: Single,
                 albedo: Single) -> None:
        self._surfaces = surfaces
        self._members = {int(m): np.flatnonzero(surfaces.material == m) for m in surfaces.shiny}
        # By axes, each a run of numbers: loops over three numbers at a time cost ten times as much.
        frames = np.stack([tangents, np.cross(normals, tangents), normals])
        self._frames = np.ascontiguousarray(frames.transpose(0, 2, 1), np.float32)  # (3, 3, p)
        self._positions, self._albedo = (np.ascontiguousarray(v.T, np.float32) for v in (positions, albedo))
        self._order = order_of(surfaces.kernels.shape[2])

    def write(self, rows: Single, lamps: Sequence[tuple[LocalLight, Single]]) -> None:
        """Fill rows 1, 2, ... of rows (p, 1 + functions, 3) zeros, whose row 0 has the sum of all lamps, in place, and
        dim row 0.

        lamps: each with its E / pi (p, 3). An Area shines from several points where it is near, whatever part of it is
        in shadow; a Point or Spot with a radius from its middle.
        """
        surfaces, lit = self._surfaces, rows[:, 0].any(axis=1)
        for material, members in self._members.items():
            kernel = surfaces.kernels[material]  # (functions, n^2, channels), to (functions * channels, n^2)
            flat = np.ascontiguousarray(kernel.transpose(0, 2, 1)).reshape(-1, kernel.shape[1])
            chosen = members[lit[members]]
            for start in range(0, len(chosen), BLOCK):
                block = chosen[start:start + BLOCK]
                reflected = self._albedo[:, block] * rows[block, 0].T
                total = surfaces.dimming[material][:, None, None] * reflected
                for lamp, light in lamps:
                    self._add(total, block, flat, lamp, np.ascontiguousarray(light[block].T))
                rows[block, 1:] = total.transpose(2, 0, 1)
        rows[:, 0] *= surfaces.share[surfaces.material][:, None]

    def _add(self, total: Single, block: NDArray[np.int64], kernel: Single, lamp: LocalLight, light: Single) -> None:
        """Add one lamp's highlight to a block's rows (functions, 3, b). kernel: (functions * channels, n^2); light:
        (3, b)."""
        lit = np.flatnonzero(light.any(axis=0))
        if not len(lit):
            return
        whole = len(lit) == len(block)
        block, light = (block, light) if whole else (block[lit], light[:, lit])
        reflected = np.zeros((total.shape[0], 3, len(lit)), np.float32)
        for direction, share in self._seen(lamp, block):
            values = evaluate(self._order, direction).astype(np.float32)
            reflected += multiply(kernel, values.T).reshape(total.shape[0], -1, len(lit)) * (light * share)
        if whole:
            total += reflected
        else:
            total[:, :, lit] += reflected

    def _seen(self, lamp: LocalLight, block: NDArray[np.int64]) -> list[tuple[Single, Single | float]]:
        """The directions (b, 3) in which receivers see a lamp, and the share (b,) of its light from each."""
        if lamp.kind != "area":
            return [(self._directions(block, lamp.position), 1.0)]
        away = self._positions[:, block] - lamp.position.astype(np.float32)[:, None]
        nearest = float(np.sqrt(np.min(np.sum(away * away, axis=0))))
        across = min(2.0 * lamp.extent / max(PART * nearest, 1e-30), MOST_ACROSS)
        places, _ = lamp.points(max(1, math.ceil(across)) ** 2)
        if len(places) == 1:
            return [(self._directions(block, places[0]), 1.0)]
        axis = lamp.axis.astype(np.float32)
        directions, shares = [], []
        for place in places:
            away = self._positions[:, block] - place.astype(np.float32)[:, None]
            depth = np.maximum(axis[0] * away[0] + axis[1] * away[1] + axis[2] * away[2], 0.0)
            directions.append(self._directions(block, place))
            square = np.maximum(np.sum(away * away, axis=0), np.finfo(np.float32).tiny)
            shares.append(depth * directions[-1][:, 2] / (square * np.sqrt(square)))
        whole = sum(shares)
        even = np.float32(1.0 / len(places))  # none in sight though some light comes: from in between
        return [(direction, np.divide(share, whole, out=np.full_like(share, even), where=whole > 0.0))
                for direction, share in zip(directions, shares, strict=True)]

    def _directions(self, block: NDArray[np.int64], position: NDArray[np.float64]) -> Single:
        """Unit directions (b, 3) to the lamp in the receivers' frames; what lies below the horizon (the middle of a
        lamp whose rim is above) is lifted to it."""
        x, y, z = position.astype(np.float32)[:, None] - self._positions[:, block]
        local = np.stack([f[0] * x + f[1] * y + f[2] * z for f in np.take(self._frames, block, axis=2)])
        np.maximum(local[2], 0.0, out=local[2])
        length = np.sqrt(local[0] * local[0] + local[1] * local[1] + local[2] * local[2])
        local /= np.maximum(length, np.finfo(np.float32).tiny)
        local[2, length == 0.0] = 1.0  # a lamp in the receiver itself: nothing says where it is
        return local.T
