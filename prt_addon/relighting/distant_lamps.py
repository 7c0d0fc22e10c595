# SPDX-License-Identifier: GPL-3.0-or-later
"""Lamps on bakes of distant light alone: at each receiver a lamp is light from its direction, as strong as it is there.

The approximation of Nowrouzezahrai et al. 2007 (section 4.2.1) for Points, Spots and Areas, in both kinds of columns:
the nearest texels of a cubemap, or harmonics of the direction. Shadows and bounces are those of light from infinity, so
a lamp must be outside the convex hull of all that casts shadows (`nearest_directions.Hull`), and the nearer it is the
less do directions and distances at the occluders agree with those at the receiver (docs/eigentransport.md has errors
by distance). What receivers have beyond that, an Area's own width, is right: it is some points of its face.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from ..basis.cubemap import cubemap_solid_angles
from ..basis.spherical_harmonics import evaluate, expand_bands
from ..lighting.analytic import sun
from ..lighting.local_lights import LocalLight
from ..lighting.windowing import HIGHLIGHT_TOLERANCE, remove_ringing
from ..linear_algebra import multiply, row_squares
from .exit_radiance import Baked
from .nearest_directions import RECEIVERS_AT_ONCE, nearest_texels, texel_radiance

Single = NDArray[np.float32]
Double = NDArray[np.float64]

# Points of an Area's face, and texels around the direction to each: shadows move smoothly.
AREA_POINTS, NEAREST = 16, 4


class DistantBake(Baked, Protocol):
    """What is read of storage's BakedTransfer beside that."""

    positions: Single


def distant_lamp_radiance(baked: DistantBake, lamps: Sequence[LocalLight], window: bool = False) -> Single:
    """Exit radiance (p, rows, 3) that lamps add to a bake without columns of local light, in row 0 for unit albedo.

    lamps: as the bake sees them, with all their points outside the hull. window: without most of the ringing that light
    from one direction has in harmonics. Lamps farther away than numbers reach give nothing.
    """
    result = np.zeros((len(baked.cluster), baked.bases.shape[2], 3), np.float32)
    points = [(lamp, place, share) for lamp in lamps for place, share in zip(*lamp.points(AREA_POINTS), strict=True)]
    if not points or not len(result):
        return result
    if baked.lighting_basis.cubemap:
        for lamp, place, share in points:
            towards, irradiance = _arriving(baked.positions, lamp, place, share)
            result += _by_texels(baked, towards, irradiance)
        return result
    light = np.zeros((len(result), baked.lighting_basis.distant, 3), np.float32)
    order = round(baked.lighting_basis.distant ** 0.5)
    for lamp, place, share in points:
        towards, irradiance = _arriving(baked.positions, lamp, place, share)
        for start in range(0, len(light), RECEIVERS_AT_ONCE):
            part = slice(start, start + RECEIVERS_AT_ONCE)
            functions = evaluate(order, towards[part]).astype(np.float32)
            light[part] += functions[:, :, None] * irradiance[part, None].astype(np.float32)
    if window:
        light *= _factors(order, 0.01)[:, None]
    result[:, :1] = _by_harmonics(baked, light, slice(0, 1))
    if result.shape[1] > 1:
        if baked.soft_highlights:
            light *= _factors(order, HIGHLIGHT_TOLERANCE)[:, None]
        result[:, 1:] = _by_harmonics(baked, light, slice(1, None))
    return result


def _arriving(positions: Single, lamp: LocalLight, place: Double, share: float) -> tuple[Double, Double]:
    """Unit directions (p, 3) from receivers to a point of a lamp, and irradiance (p, 3) on a surface that faces it."""
    towards = place - positions.astype(np.float64)
    square = row_squares(towards)
    towards[square == 0.0] = (0.0, 0.0, np.finfo(np.float32).tiny)  # on the receiver: any direction
    with np.errstate(over="ignore", invalid="ignore"):
        irradiance = share * lamp.intensity(-towards) / np.maximum(square, np.finfo(np.float64).tiny)[:, None]
    limit = np.finfo(np.float32).max
    irradiance = np.nan_to_num(np.clip(irradiance, -limit, limit), nan=0.0)
    return towards / np.sqrt(row_squares(towards))[:, None], irradiance


def _by_texels(baked: DistantBake, towards: Double, irradiance: Double) -> Single:
    """Exit radiance of a cubemap's columns: a texel's radiance is what gives that irradiance."""
    size = baked.lighting_basis.cubemap
    texels, shares = nearest_texels(towards, size, NEAREST)
    return texel_radiance(baked, texels, shares / cubemap_solid_angles(size)[texels]) * irradiance[:, None].astype(
        np.float32)


def _by_harmonics(baked: DistantBake, light: Single, rows: slice) -> Single:
    """Some rows of exit radiance (p, rows, 3) under a light (p, columns, 3) of each receiver's own, by clusters: their
    vectors meet all their receivers in one product."""
    bases = baked.bases[:, :, rows]
    result = np.zeros((len(light), bases.shape[2], 3), np.float32)
    order = np.argsort(baked.cluster, kind="stable")
    starts = np.searchsorted(baked.cluster[order], np.arange(len(bases) + 1))
    for number in np.flatnonzero(np.diff(starts)):
        members = order[starts[number]:starts[number + 1]]
        weights = np.concatenate([np.ones((len(members), 1), np.float32), baked.weights[members]], axis=1)
        for channel in range(3):
            basis = bases[number, ..., channel % bases.shape[4]]
            values = multiply(light[members, :, channel], np.ascontiguousarray(basis.reshape(-1, basis.shape[2]).T))
            values = values.reshape(len(members), weights.shape[1], -1)
            result[members, :, channel] = np.sum(values * weights[:, :, None], axis=1)
    return result


@lru_cache(maxsize=16)
def _factors(order: int, tolerance: float) -> Single:
    """Factors (order^2,) that take the ringing out of light from one direction: the same for all directions."""
    light = sun([0.0, 0.0, 1.0], np.ones(3), 0.0, order)
    return expand_bands(remove_ringing(light, tolerance).factors).astype(np.float32)
