# SPDX-License-Identifier: GPL-3.0-or-later
"""A scene's distant light in every kind of columns that its bakes ask for."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..basis.spherical_harmonics import rotate
from .cubemap_light import Turn

Array = NDArray[np.float64]


class DistantColumns(Protocol):
    """What is read of storage's Columns (this folder comes before storage)."""

    order: int
    cubemap: int


@dataclass(frozen=True)
class DistantLight:
    """harmonics: (order^2, 3) coefficients of the highest order asked for, None where no bake has any; texels: (6 r r,
    3) mean radiance by the cubemap's size r."""

    harmonics: Array | None = None
    texels: Mapping[int, Array] = field(default_factory=dict)

    def in_columns(self, columns: DistantColumns, turn: ArrayLike | None = None) -> Array | None:
        """The light of some columns, f(turn^-1 s) where a rotation (3, 3) is given; None where there is none."""
        if columns.cubemap:
            texels = self.texels.get(columns.cubemap)
            return texels if texels is None or turn is None else Turn(columns.cubemap, turn)(texels)
        if self.harmonics is None or turn is None:
            return self.harmonics
        return rotate(self.harmonics, turn)
