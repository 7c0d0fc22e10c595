# SPDX-License-Identifier: GPL-3.0-or-later
"""Which receiver of a bake a corner of another mesh of the same surface takes its light from."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

NEIGHBOURS = 8  # receivers around a vertex: one for each shading normal of a sharp corner
SAME_PLACE = 1e-4  # of the surface's size: receivers this much farther than the nearest count as near as it


def receivers_of_corners(points: NDArray[np.floating], corner_point: NDArray[np.integer],
                         corner_normals: NDArray[np.floating], receivers: NDArray[np.floating],
                         receiver_normals: NDArray[np.floating]) -> NDArray[np.intp]:
    """(corners,) into the receivers: of the nearest ones that which faces most as the corner does.

    points (n, 3), corner_point (corners,) into them, corner_normals (corners, 3), receivers and their unit normals
    (m, 3), all in one space.
    """
    count = min(NEIGHBOURS, len(receivers))
    distance, near = cKDTree(receivers).query(points, k=[*range(1, count + 1)])
    size = float(np.ptp(receivers, axis=0).max())
    is_near = distance <= distance[:, :1] + SAME_PLACE * size
    facing = (receiver_normals[near[corner_point]] * corner_normals[:, None]).sum(axis=2)
    best = np.argmax(np.where(is_near[corner_point], facing, -np.inf), axis=1)
    return near[corner_point, best]
