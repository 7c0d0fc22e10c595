# SPDX-License-Identifier: GPL-3.0-or-later
"""One object's share of a scene, before all are joined."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .texel_surface import TexelSurface


@dataclass(frozen=True)
class Part:
    """An object after splitting, and refining or its texels, with its own numbering. surface: that texels lie on, None
    where points are vertices."""

    points: NDArray[np.float64]
    normals: NDArray[np.float64]
    albedo: NDArray[np.float32]
    triangles: NDArray[np.int32]
    material: NDArray[np.int32]
    tangents: NDArray[np.float64]
    matches_source: bool
    source: NDArray[np.int32]
    surface: TexelSurface | None = None
