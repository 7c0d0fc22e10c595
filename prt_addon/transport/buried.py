# SPDX-License-Identifier: GPL-3.0-or-later
"""Receivers inside other bodies: the floor's points under a wall, the part of an eye inside the head.

They are rightly dark, but triangles reach from them out into the open, and interpolation would draw dark teeth along
every contact. A buried receiver at the rim takes the mean transfer of its neighbours in the open instead (the dilation
of lightmaps over invalid texels).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..basis.directions import quadrature
from ..scene.scene_mesh import SceneMesh
from ..tracing.tracer import Tracer
from .receiver_set import ReceiverSet, facing_cosines

# Only a receiver that gets less of a white sky than this is looked at: one under a lid is dark, but not buried.
DARK = 5e-3
# It is buried if more than this share of its hemisphere shows backs of surfaces: it sees a body from inside.
BACK_SHARE = 0.5
DIRECTIONS = 128
# Rings of buried receivers that are filled: one reaches every triangle that leaves the body, the second is for the
# smooth start of what is hidden.
RINGS = 2


def buried_receivers(tracer: Tracer, scene: SceneMesh, keys: NDArray[np.int64], white: NDArray[np.floating],
                     ) -> NDArray[np.int64]:
    """Those of the receivers `keys` that lie inside a body. white: (k,) their radiance in a white unit environment."""
    dark = keys[white < DARK]
    if not len(dark):
        return dark
    receivers = ReceiverSet.of_keys(scene, tracer, dark)
    directions = quadrature(DIRECTIONS, 2)[0].astype(np.float32)
    cosines = facing_cosines(directions, receivers.normals)
    back = np.zeros(len(receivers))
    for index, direction in enumerate(directions):
        facing = np.flatnonzero(cosines[index] > 0.0)
        hits = tracer.nearest(receivers.origins[facing], direction[None, :])
        tracer.rays += len(facing)
        inside = (hits.triangle >= 0) & ~hits.front
        back[facing[inside]] += cosines[index, facing[inside]]
    return np.sort(receivers.key[back > BACK_SHARE * cosines.sum(axis=0)])


def fill_buried(scene: SceneMesh, buried: NDArray[np.int64], transfer: NDArray[np.float32]) -> int:
    """Give buried receivers at the rim the mean transfer of their open neighbours, in place; return how many.

    transfer: (points, columns, channels). Neighbours share an edge; the second ring takes the first ring's values.
    """
    open_points = ~scene.loose
    open_points[buried] = False
    edges = np.concatenate([scene.triangles[:, [0, 1]], scene.triangles[:, [1, 2]], scene.triangles[:, [2, 0]]])
    edges = np.unique(np.concatenate([edges, edges[:, ::-1]]), axis=0)
    filled = 0
    for _ in range(RINGS):
        rim = edges[~open_points[edges[:, 0]] & open_points[edges[:, 1]]]
        if not len(rim):
            break
        points, place = np.unique(rim[:, 0], return_inverse=True)
        total = np.zeros((len(points), *transfer.shape[1:]))
        np.add.at(total, place, transfer[rim[:, 1]])
        transfer[points] = total / np.bincount(place)[:, None, None]
        open_points[points] = True
        filled += len(points)
    return filled
