# SPDX-License-Identifier: GPL-3.0-or-later
"""What rays met."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Hits:
    """Nearest hits of n rays. triangle: (n,) int32, -1 for a miss; u, v: barycentric weights of corners 1 and 2;
    front: (n,) bool, the ray met the side that the triangle winds counter-clockwise on; distance: (n,) in tracing space
    (of world space, divided by the scene's diagonal); traced: triangle, u, v on the surface that was traced, where
    points are texels of it and the others name the scene's own triangles."""

    triangle: NDArray[np.int32]
    u: NDArray[np.float32]
    v: NDArray[np.float32]
    front: NDArray[np.bool_]
    distance: NDArray[np.float32]
    traced: tuple[NDArray[np.int32], NDArray[np.float32], NDArray[np.float32]] | None = None
