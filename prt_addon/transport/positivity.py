# SPDX-License-Identifier: GPL-3.0-or-later
"""Highlights that stay above black: rows of hemispherical functions ring over views, as Fourier series do at an edge.

Beside a wall a highlight is bright for views that mirror the sky and dark for those that mirror the wall. A few smooth
functions of the view follow that edge with swings to both sides: a white metal of roughness 0.3 at the foot of a tall
wall in a white world is fitted as -0.17..1.17 by 9 rows, -0.11..1.11 by 16 and -0.09..1.09 by 24, where 0.01..0.99 is
true. It is the fit alone: with the integral over light directions exact instead of in incident functions of order 7 the
same numbers come out to 0.01 (tests/core/test_positivity.py holds that).

What is done about it is one factor for each receiver, so that the transfer stays linear in light. Its matrix M is drawn
towards that of the same amount of light without an edge,

    M' = t M + (1 - t) u m^T M / (m^T u),

u the response of the open surface to a white world, m the means of the functions over views weighted by their cosine
(so the flux that leaves stays the same for every light), and t the largest factor up to 1 with which no view sees less
than black in a white world. Receivers that do not ring keep their matrix to the last bit. Of linear smoothings that
were tried with the same bound (penalties on gradient and Laplacian, over sphere and hemisphere, as window's in
basis.spherical_harmonics) none was clearly better. Other lights than white have no such bound: at receivers that ring,
the lowest radiance under half-domes or a sky with a broad sun shrinks to between a twentieth and three quarters.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from ..basis import hemisphere, spherical_harmonics
from ..basis.hemisphere import Indices
from ..linear_algebra import multiply

WHITE = np.sqrt(4.0 * np.pi)  # the coefficient of a white world of radiance 1, all others are 0
# Views at which radiance is kept above black, 6 degrees apart from the horizon to the normal: order 5 swings once in 45
# degrees or more slowly, so what dips under zero between them is below 0.01 of the swing.
HEIGHTS, AZIMUTHS = 16, 32
# What the open surface is drawn to itself where its own fit leaves less than this share of its mean (a dielectric's 4
# rows are negative at the normal): a target near black would leave nothing of the receivers that are drawn to it.
LEAST_OPEN = 0.1


@lru_cache(maxsize=8)
def _views(functions: tuple[int, ...]) -> tuple[NDArray[np.float32], NDArray[np.float64]]:
    """Values (k, n) of the functions at the views, and their means (k,) over views weighted by the cosine."""
    angle = np.linspace(0.0, np.pi / 2, HEIGHTS)[:-1]
    azimuth = 2 * np.pi * np.arange(AZIMUTHS) / AZIMUTHS
    circle = np.stack([np.outer(np.cos(angle), np.cos(azimuth)), np.outer(np.cos(angle), np.sin(azimuth)),
                       np.repeat(np.sin(angle)[:, None], AZIMUTHS, axis=1)], axis=-1).reshape(-1, 3)
    values = hemisphere.evaluate(np.array(functions), np.concatenate([circle, [[0.0, 0.0, 1.0]]]))
    order = hemisphere.order_of(np.array(functions))
    normal = spherical_harmonics.evaluate(order, np.array([[0.0, 0.0, 1.0]]))[0]
    means = spherical_harmonics.expand_bands(spherical_harmonics.zonal_cosine(order)) * normal
    return np.ascontiguousarray(values.T, np.float32), means[np.array(functions)]


@dataclass(frozen=True)
class OpenSurface:
    """The response of a surface that sees all of a white world, as its rows hold it.

    functions (k,): of the rows, the constant one among them; response (k, channels): scaled to a mean of 1 over
    views weighted by their cosine, nowhere below LEAST_OPEN.
    """

    functions: Indices
    response: NDArray[np.float64]

    @staticmethod
    def of(kernel: NDArray[np.float64], functions: Indices) -> OpenSurface:
        """kernel: K (k, n^2, channels) of `brdf.reflection_matrix`."""
        functions = np.asarray(functions, np.int64)
        values, means = _views(tuple(functions))
        constant = np.where(functions == 0, WHITE, 0.0)
        incident = hemisphere.gram_matrix(np.arange(kernel.shape[1]))[0] * WHITE
        response = np.sum(kernel * incident[None, :, None], axis=1)
        shape = np.empty_like(response)
        for channel in range(response.shape[1]):
            mean = float(np.sum(means * response[:, channel]))
            if mean <= 0.0:  # it reflects nothing
                shape[:, channel] = constant
                continue
            unit = response[:, channel] / mean
            least = float(np.min(np.sum(values * unit[:, None], axis=0)))
            share = 1.0 if least >= LEAST_OPEN else (1.0 - LEAST_OPEN) / (1.0 - least)
            shape[:, channel] = share * unit + (1.0 - share) * constant
        return OpenSurface(functions, shape)


def keep_positive(matrices: NDArray[np.float32], surface: OpenSurface, in_white: NDArray[np.float32] | None = None,
                  ) -> NDArray[np.float32]:
    """Change matrices (b, k, columns, channels) in place as the module's docstring says; their factors t (b,).

    in_white: (b, k, channels) what they make of a white world, up to a factor; None: their first column, that of
    spherical harmonics' constant."""
    in_white = matrices[:, :, 0] if in_white is None else in_white
    values, means = _views(tuple(surface.functions))
    values, means = np.ascontiguousarray(values), means.astype(np.float32)
    factor = np.ones(len(matrices), np.float32)
    response = np.broadcast_to(surface.response, (len(means), matrices.shape[3])).astype(np.float32)
    for channel, shape in enumerate(response.T):
        white = np.ascontiguousarray(in_white[:, :, channel])
        seen = multiply(white, values)
        # The target at each view; where a receiver's own mean is below black there is nothing to draw it to but that.
        target = np.sum(white * means, axis=1)[:, None] * np.sum(values * shape[:, None], axis=0)
        low = seen < 0.0
        part = np.maximum(target, 0.0)
        allowed = np.where(low, part / np.where(low, part - seen, np.float32(1.0)), np.float32(1.0))
        np.minimum(factor, allowed.min(axis=1), out=factor)
    rings = np.flatnonzero(factor < 1.0)
    if len(rings):
        share = factor[rings, None, None]
        for channel, shape in enumerate(response.T):
            own = matrices[rings, :, :, channel]
            even = np.sum(own * means[None, :, None], axis=1)[:, None, :] * shape[None, :, None]
            matrices[rings, :, :, channel] = share * own + (np.float32(1.0) - share) * even
    return factor
