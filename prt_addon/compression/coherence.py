# SPDX-License-Identifier: GPL-3.0-or-later
"""How clusters lie on the surface (Sloan et al. 2003, section 5)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def overdraw(triangles: NDArray[np.integer], cluster: NDArray[np.integer]) -> float:
    """Mean over triangles of how many different clusters their three points are in: 1 at best, 3 at worst.

    triangles: (t, 3) indices of points; cluster: (p,). No triangles count as 1.
    """
    if len(triangles) == 0:
        return 1.0
    corners = np.sort(cluster[triangles], axis=1)
    return float(1 + (np.diff(corners, axis=1) != 0).sum(axis=1).mean())
