# SPDX-License-Identifier: GPL-3.0-or-later
"""Point lights by their nearest directions among a cubemap's columns (Nowrouzezahrai et al. 2007, section 4.2.1).

At each receiver the light is the k texels nearest to the direction towards it. Transport is that of light from
infinity, so this is right only outside the scene's convex hull: a light among the objects would be hidden by what lies
behind it. `inside_hull` says so; lamps near the scene have their own columns (lit surfaces, light clouds), which are
right everywhere.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import ConvexHull, QhullError

from ..basis.cubemap import bilinear_texels, cubemap_solid_angles, texel_of
from ..linear_algebra import multiply, row_squares
from .exit_radiance import Baked

Double = NDArray[np.float64]

# Receivers handled at once: their vectors at one texel each, 192 floats, are 12 MB.
RECEIVERS_AT_ONCE = 16384
# A light this much farther out than the hull, as a share of the scene's extent, is outside: rounding, no more.
SLACK = 1e-9


def nearest_texels(towards: Double, r: int, k: int = 1) -> tuple[NDArray[np.int64], Double]:
    """The texels (n, k) that stand for light from directions (n, 3), and their shares (n, k), sum 1.

    k = 1: the texel that the direction falls in, as published; shadows then move in steps of a texel. k = 4: the four
    around it, bilinearly, across the faces' edges; shadows move smoothly. Raises ValueError for any other k.
    """
    if k == 1:
        return texel_of(towards, r)[:, None], np.ones((len(towards), 1))
    if k == 4:
        return bilinear_texels(towards, r)
    raise ValueError(f"1 or 4 nearest directions stand for a light, not {k}")


def point_light_radiance(baked: Baked, positions: ArrayLike, r: int, light: ArrayLike, intensity: ArrayLike,
                         k: int = 4) -> NDArray[np.float32]:
    """Unit-albedo exit radiance (p, 3) of all receivers under one point light, from diffuse cubemap columns.

    positions: (p, 3) of the receivers, metres; light: (3,) its place; intensity: (3,) W/sr. A texel's radiance is what
    makes its irradiance on a facing surface that of the light, intensity / distance^2 (equation 4's alpha), so only
    the direction is rounded to texels. The transfer is decoded at the texels that each receiver needs and nowhere
    else. Light columns come first; of three channels each is lit by its own.
    """
    towards = np.asarray(light, np.float64) - np.asarray(positions, np.float64)
    square = np.maximum(row_squares(towards), np.finfo(np.float64).tiny)
    texels, shares = nearest_texels(towards, r, k)
    alpha = shares / cubemap_solid_angles(r)[texels] / square[:, None]
    return texel_radiance(baked, texels, alpha)[:, 0] * np.asarray(intensity, np.float32)


def texel_radiance(baked: Baked, texels: NDArray[np.int64], radiance: Double) -> NDArray[np.float32]:
    """Exit radiance (p, rows, 3), for unit albedo in row 0, where k texels (p, k) of each receiver's own shine with a
    grey radiance (p, k): decoded there and nowhere else."""
    rows, channels = baked.bases.shape[2], baked.bases.shape[4]
    result = np.zeros((len(texels), rows, channels), np.float32)
    radiance = radiance.astype(np.float32)
    # (clusters, columns, vectors + 1, rows, channels): a receiver's vectors at a texel side by side.
    bases = np.ascontiguousarray(baked.bases.transpose(0, 3, 1, 2, 4))
    for start in range(0, len(texels), RECEIVERS_AT_ONCE):
        part = slice(start, start + RECEIVERS_AT_ONCE)
        for which in range(texels.shape[1]):
            vectors = bases[baked.cluster[part], texels[part, which]]
            transfer = vectors[:, 0] + np.sum(baked.weights[part, :, None, None] * vectors[:, 1:], axis=1)
            result[part] += transfer * radiance[part, which, None, None]
    return np.broadcast_to(result, (len(texels), rows, 3)) if channels == 1 else result


class Hull:
    """The convex hull of points (p, 3), kept for many questions. Flat scenes have a flat hull: nothing beside its plane
    is inside."""

    def __init__(self, points: ArrayLike) -> None:
        points = np.asarray(points, np.float64)
        self._planes, self._slack = np.empty((0, 4)), 0.0
        if len(points) < 4:
            return
        self._slack = SLACK * float(np.ptp(points, axis=0).max())
        try:
            self._planes = ConvexHull(points).equations
        except QhullError:  # flat
            return

    def inside(self, places: ArrayLike) -> NDArray[np.bool_]:
        """Whether places (n, 3) lie inside."""
        places = np.atleast_2d(np.asarray(places, np.float64))
        if not len(self._planes):
            return np.zeros(len(places), bool)
        heights = (multiply(places, np.ascontiguousarray(self._planes[:, :3].T)) + self._planes[:, 3]).max(axis=1)
        return heights < -self._slack


def inside_hull(points: ArrayLike, places: ArrayLike) -> NDArray[np.bool_]:
    """Whether places (n, 3) lie inside the convex hull of points (p, 3), where the approximation is wrong: see `Hull`.
    """
    return Hull(points).inside(places)
