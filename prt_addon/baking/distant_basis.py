# SPDX-License-Identifier: GPL-3.0-or-later
"""The columns of distant light that a bake fills: spherical harmonics, or the texels of a cubemap.

What stages need to know of them, so that no stage asks which kind they are.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..basis.cubemap import cubemap_solid_angles, texel_of
from ..basis.spherical_harmonics import evaluate
from ..lighting.bright_light import BrightCells, bright_texels
from ..lighting.cubemap_light import EnvironmentTexels, sun_texels
from ..lighting.reference_light import ReferenceLight
from ..lighting.windowing import for_highlights
from ..linear_algebra import multiply
from ..reporting.wording import count, plural
from ..storage.columns import Columns
from .settings import BakeSettings

Double = NDArray[np.float64]

# Texels along an edge from which on one direction in each is enough.
FINE = 32
# Arrays of a cubemap's transfer that are alive at the same time and share the budget.
ARRAYS = 4


@dataclass(frozen=True)
class DistantBasis:
    """order: of the spherical harmonics, 0 with a cubemap; cubemap: texels along its edge, 0 with harmonics."""

    order: int
    cubemap: int = 0

    @property
    def columns(self) -> int:
        """How many there are."""
        return self.entry().distant

    @property
    def facts(self) -> dict[str, int]:
        """For JSON: the order, or the texels along an edge of the cubemap; and the columns."""
        size = {"cubemap_size": self.cubemap} if self.cubemap else {"order": self.order}
        return {**size, "columns": self.columns}

    @property
    def words(self) -> str:
        """The same in a line for a person."""
        if self.cubemap:
            return f"Sky by a cubemap of 6 x {self.cubemap} x {self.cubemap} texels: {count(self.columns)} columns"
        return f"Sky by spherical harmonics of order {self.order}: {plural(self.columns, 'column', 'columns')}"

    def entry(self, local: int = 0) -> Columns:
        """For the header, with so many columns of local light behind."""
        return Columns(self.order, local, self.cubemap)

    def samples(self, directions: int) -> int:
        """Along a texel's edge, so that so many directions or more are traced over the sphere; two at least, so that a
        column is a mean over its texel, but for texels as small as the finest ones."""
        wanted = max(1, math.ceil(math.sqrt(directions / self.columns)))
        return wanted if self.cubemap >= FINE else max(wanted, 2)

    def rays(self, directions: int) -> int:
        """Shadow rays from each receiver; directions: asked for, over the whole sphere."""
        return (self.columns * self.samples(directions) ** 2 if self.cubemap else directions) // 2

    def white(self, transfer: NDArray[np.floating]) -> Double:
        """What a white unit sky gives: (p, channels) of transfer (p, columns, channels)."""
        if self.cubemap:
            return transfer[:, :self.columns].sum(axis=1, dtype=np.float64)
        return transfer[:, 0].astype(np.float64) * np.sqrt(4.0 * np.pi)

    def white_light(self) -> Double:
        """The light (columns, 3) of a white world of radiance 1."""
        if self.cubemap:
            return np.ones((self.columns, 3))
        return np.concatenate([np.full((1, 3), np.sqrt(4.0 * np.pi)), np.zeros((self.columns - 1, 3))])

    def for_highlights(self, coefficients: Double) -> Double:
        """The light (columns, 3) as highlights reflect it: texels do not ring, harmonics get a window."""
        return coefficients if self.cubemap else for_highlights(coefficients)

    def scale(self) -> NDArray[np.float32] | None:
        """(columns,) what columns are multiplied by while they are encoded, so that sums of squares are integrals over
        the sphere; None where they are already."""
        return (1.0 / np.sqrt(cubemap_solid_angles(self.cubemap))).astype(np.float32) if self.cubemap else None

    def coefficients(self, light: ReferenceLight) -> Double:
        """The light (columns, 3) of these columns."""
        if not self.cubemap:
            return light.coefficients(self.order)
        # As it is drawn, a turn's blur included.
        total = EnvironmentTexels.of(light.image, self.cubemap).turned(light.rotation)
        for direction, irradiance, angle in zip(light.sun_directions, light.sun_irradiance, light.sun_angles,
                                                strict=True):
            total = total + sun_texels(direction, irradiance, float(angle), self.cubemap)
        return total

    def split(self, coefficients: Double, value: int) -> tuple[BrightCells | None, Double]:
        """Bright parts of the columns' light, to be sampled for this value of a reference, and the light (columns, 3)
        without them."""
        return bright_texels(coefficients, self.cubemap, value) if self.cubemap else (None, coefficients)

    def radiance(self, coefficients: Double, directions: Double) -> Double:
        """Radiance (n, 3) that the columns' light stands for, in unit directions (n, 3)."""
        if self.cubemap:
            return coefficients[texel_of(directions, self.cubemap)]
        return multiply(evaluate(self.order, directions), coefficients)


def array_budget(settings: BakeSettings) -> int | None:
    """Bytes up to which one array of a cubemap's transfer stays in memory; None where there is no limit."""
    return int(settings.memory_budget * 1e9 / ARRAYS) if settings.memory_budget > 0.0 else None


def distant_basis(settings: BakeSettings, order: int) -> DistantBasis:
    """What a bake's distant light is in; order: that its needs have come to."""
    if settings.distant_basis == "cubemap" and settings.distant_light:
        return DistantBasis(0, settings.cubemap_size)
    return DistantBasis(order)
