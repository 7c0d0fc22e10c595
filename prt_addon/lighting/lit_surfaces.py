# SPDX-License-Identifier: GPL-3.0-or-later
"""Columns of local light by the surfaces that lamps shine on, in place of lights of a cloud.

Light that bounces is linear in the direct irradiance of the surfaces, wherever the lamp is and whatever its kind: the
transfer from patches of surface to receivers (direct-to-indirect transfer; Hasan, Pellacini & Bala 2006) serves Points,
Spots and Areas alike, near to walls, behind openings and outside of any region, where a cloud of lights (Kristensen et
al. 2005) interpolates between what its lights do. The price is paid when relighting: shadow rays from patches to lamps.

Lamps differ in few ways once their light has bounced, so columns are axes in the space of patch irradiances, those
along which the bounced light of many lamps differs most.
"""

from __future__ import annotations

import heapq
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .light_cloud import LightCloud

Double = NDArray[np.float64]
# How much a turn of the normal parts patches, as a share of the scene's diagonal for unit vectors.
TURN = 0.25


@dataclass(frozen=True, eq=False)
class LitSurfaces:
    """corners: (s, 3, 3) float32, world space, metres: triangles that stand for all surfaces, wound so that they look
    at the light (the two sides of a wall are two); patch: (s, 3) int32 that each corner's third belongs to, -1 for
    none; axes: (columns, patches) float32, a lamp's light in the columns for each patch's mean irradiance over pi."""

    corners: NDArray[np.float32]
    patch: NDArray[np.int32]
    axes: NDArray[np.float32]

    @property
    def columns(self) -> int:
        """Columns of the transfer."""
        return len(self.axes)

    @property
    def zones(self) -> int:
        """Columns mean the same at all receivers."""
        return 1

    @property
    def emission_order(self) -> int:
        """Columns have no directions: where a lamp shines is in the irradiance."""
        return 1


LocalBasis = LightCloud | LitSurfaces


def make_patches(points: Double, normals: Double, areas: Double, diagonal: float, most: int) -> NDArray[np.int32]:
    """Patches (p,) of surface points (p, 3) with unit normals, at most so many; -1 for points without area.

    Best-first halves: the patch of the largest moment (area times squared extent, of place and normal) is cut at the
    mean of the value that varies most, so that large flat walls and small round things are cut alike.
    """
    features = np.concatenate([points, TURN * diagonal * normals], axis=1)
    heap: list[tuple[float, int, NDArray[np.int64], int, float]] = []
    count = 0

    def push(members: NDArray[np.int64]) -> None:
        nonlocal count
        weight = areas[members]
        mean = np.sum(weight[:, None] * features[members], axis=0) / weight.sum()
        spread = np.sum(weight[:, None] * (features[members] - mean) ** 2, axis=0)
        widest = int(np.argmax(spread))
        heapq.heappush(heap, (-float(spread.sum()), count, members, widest, float(mean[widest])))
        count += 1

    whole = np.flatnonzero(areas > 0.0)
    if len(whole):
        push(whole)
    while heap and len(heap) < most and len(heap[0][2]) > 1 and heap[0][0] < 0.0:
        _, _, members, widest, mean = heapq.heappop(heap)
        low = features[members, widest] <= mean
        if low.all() or not low.any():  # equal up to rounding: in two halves, however
            low = np.arange(len(members)) < len(members) // 2
        push(members[low])
        push(members[~low])
    patch = np.full(len(points), -1, np.int32)
    for number, entry in enumerate(sorted(heap, key=lambda entry: entry[1])):
        patch[entry[2]] = number
    return patch


def lit_elements(corners: Double, patch: NDArray[np.int32], most: int, seed: int,
                 ) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
    """At most `most` of the triangles (t, 3, 3), with the patches (t, 3) of their corners, to stand for all of them.

    Where there are more, they are drawn systematically by area along the order of patches, so that each patch has its
    part, and grow about their middle to the area that they stand for.
    """
    area = triangle_areas(corners)
    kept = np.flatnonzero((area > 0.0) & (patch >= 0).any(axis=1))
    if len(kept) > most:
        kept = kept[np.lexsort((kept, patch[kept].max(axis=1)))]
        share = area[kept] / area[kept].sum() * most
        for _ in range(8):  # a large triangle counts once, the others share what is left
            large = share >= 1.0
            share[large] = 1.0
            rest = most - int(large.sum())
            if not (~large).any():
                break
            share[~large] *= rest / max(share[~large].sum(), 1e-300)
        start = np.random.Generator(np.random.PCG64([seed, 83])).uniform()
        taken = np.diff(np.floor(np.concatenate([[0.0], np.cumsum(share)]) + start)) > 0.0
        kept, share = kept[taken], np.minimum(share[taken], 1.0)
        middle = corners[kept].mean(axis=1, keepdims=True)
        return ((middle + (corners[kept] - middle) / np.sqrt(share)[:, None, None]).astype(np.float32), patch[kept])
    return corners[kept].astype(np.float32), patch[kept]


def triangle_areas(corners: NDArray[np.floating]) -> Double:
    """Areas (t,) of triangles (t, 3, 3)."""
    edges = np.asarray(corners[:, 1:], np.float64) - np.asarray(corners[:, :1], np.float64)
    return 0.5 * np.sqrt(np.sum(np.cross(edges[:, 0], edges[:, 1]) ** 2, axis=1))
