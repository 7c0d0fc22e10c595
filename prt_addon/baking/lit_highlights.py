# SPDX-License-Identifier: GPL-3.0-or-later
"""Receivers with highlights in a bake of local lights."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ..transport.glossy import GlossySurfaces


@dataclass(frozen=True)
class LitHighlights:
    """The receivers with highlights of a bake of local lights.

    points: (g,) of the scene; places: (g,) among the gather's receivers; surfaces: what reflects there; blocked: (g,
    n^2), see `IndirectLight`.
    """

    points: NDArray[np.int64]
    places: NDArray[np.int64]
    surfaces: GlossySurfaces
    blocked: NDArray[np.float32]

    def of(self, which: NDArray[np.int64]) -> LitHighlights:
        """Some of them."""
        surfaces = replace(self.surfaces, frames=self.surfaces.frames[which], material=self.surfaces.material[which])
        return LitHighlights(self.points[which], self.places[which], surfaces, self.blocked[which])
