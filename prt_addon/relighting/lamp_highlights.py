# SPDX-License-Identifier: GPL-3.0-or-later
"""Highlights of lamps: their direct light in the rows of a bake's view-dependent surfaces.

A light cloud holds bounced light only, so what a lamp sends straight to a metal is added when relighting, with the
same few functions of the view as the bake's: each material's kernel (`transport.lamp_kernel`) takes the lamp's
direction in the receiver's frame to rows of exit radiance, for the irradiance that the diffuse row gets.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..basis.spherical_harmonics import evaluate, order_of
from ..linear_algebra import multiply

Single = NDArray[np.float32]

# Receivers whose arrays stay in the cache.
BLOCK = 2048


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
        self._surfaces, self._albedo = surfaces, albedo
        self._members = {int(m): np.flatnonzero(surfaces.material == m) for m in surfaces.shiny}
        self._frames = np.stack([tangents, np.cross(normals, tangents), normals], axis=1).astype(np.float32)
        self._positions = positions
        self._order = order_of(surfaces.kernels.shape[2])

    def add(self, rows: Single, position: NDArray[np.float64], light: Single) -> None:
        """Add one lamp's highlight to rows (p, 1 + functions, 3), in place.

        position: (3,) the lamp's middle; light: (p, 3) its E / pi. A lamp with a surface shines into the highlight
        from its middle; the bake's functions of the view are far wider than it, as long as it is farther than wide.
        """
        kernels = self._surfaces.kernels
        lit = light.any(axis=1)
        for material, members in self._members.items():
            # (n^2, functions * channels)
            kernel = np.ascontiguousarray(kernels[material].transpose(1, 0, 2).reshape(kernels.shape[2], -1))
            for block in _blocks(members[lit[members]]):
                values = evaluate(self._order, self._directions(block, position)).astype(np.float32)
                reflected = multiply(values, kernel).reshape(len(block), kernels.shape[1], -1)
                rows[block, 1:] += reflected * light[block][:, None, :]

    def finish(self, rows: Single) -> None:
        """Let the layers above dim the diffuse light of row 0, in place, once all lamps are added."""
        surfaces = self._surfaces
        for material, members in self._members.items():
            dimming = surfaces.dimming[material]
            if dimming.any():
                for block in _blocks(members):
                    reflected = self._albedo[block] * rows[block, 0]
                    rows[block, 1:] += dimming[None, :, None] * reflected[:, None, :]
        rows[:, 0] *= surfaces.share[surfaces.material][:, None]

    def _directions(self, block: NDArray[np.int64], position: NDArray[np.float64]) -> Single:
        """Unit directions (b, 3) to the lamp in the receivers' frames; what lies below the horizon (the middle of a
        lamp whose rim is above) is lifted to it."""
        towards = (position - self._positions[block]).astype(np.float32)
        frames = self._frames[block]
        local = np.stack([np.sum(frames[:, axis] * towards, axis=1) for axis in range(3)], axis=1)
        local[:, 2] = np.maximum(local[:, 2], 0.0)
        length = np.sqrt(np.sum(local * local, axis=1, keepdims=True))
        return np.where(length > 0.0, local / np.maximum(length, np.finfo(np.float32).tiny), np.float32([0, 0, 1]))


def _blocks(members: NDArray[np.int64]) -> Iterator[NDArray[np.int64]]:
    for start in range(0, len(members), BLOCK):
        yield members[start:start + BLOCK]
