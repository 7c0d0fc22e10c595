# SPDX-License-Identifier: GPL-3.0-or-later
"""Highlights of lamps: their direct light in the rows of a bake's view-dependent surfaces.

A light cloud holds bounced light only, so what a lamp sends straight to a metal is added when relighting, with the
same few functions of the view as the bake's: each material's kernel (`transport.lamp_kernel`) takes the lamp's
direction in the receiver's frame to rows of exit radiance, for the irradiance that the diffuse row gets.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..basis.spherical_harmonics import evaluate, order_of
from ..linear_algebra import multiply

Single = NDArray[np.float32]

# Receivers whose arrays stay in the cache.
BLOCK = 4096


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

    def write(self, rows: Single, lamps: Sequence[tuple[NDArray[np.float64], Single]]) -> None:
        """Fill rows 1, 2, ... of rows (p, 1 + functions, 3) zeros, whose row 0 has the sum of all lamps, in place, and
        dim row 0.

        lamps: of each its middle (3,) and its E / pi (p, 3). A lamp with a surface shines into the highlight from its
        middle: the functions of the view are far wider than it, as long as it is farther away than it is wide.
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
                for position, light in lamps:
                    self._add(total, block, flat, position, np.ascontiguousarray(light[block].T))
                rows[block, 1:] = total.transpose(2, 0, 1)
        rows[:, 0] *= surfaces.share[surfaces.material][:, None]

    def _add(self, total: Single, block: NDArray[np.int64], kernel: Single, position: NDArray[np.float64],
             light: Single) -> None:
        """Add one lamp's highlight to a block's rows (functions, 3, b). kernel: (functions * channels, n^2); light:
        (3, b)."""
        lit = np.flatnonzero(light.any(axis=0))
        if not len(lit):
            return
        whole = len(lit) == len(block)
        values = evaluate(self._order, self._directions(block if whole else block[lit], position)).astype(np.float32)
        reflected = multiply(kernel, values.T).reshape(total.shape[0], -1, len(lit))
        if whole:
            total += reflected * light
        else:
            total[:, :, lit] += reflected * light[:, lit]

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
