# SPDX-License-Identifier: GPL-3.0-or-later
"""A material's highlight of a small lamp: from the lamp's direction to coefficients of the exit radiance.

Direct light of lamps is added when relighting (Kristensen et al. 2005, section 3), so here nothing is traced and no
integral over incident light has to be inverted: what is wanted is F(s), the rows' fit of f(v, s) cos(s) over views, as
a function of the lamp's direction s. It goes to zero with the cosine at the horizon, hence the fit

    F(s) = cos(s) sum_j C_j y_j(s)    by least squares over the upper hemisphere of s,

whose factor cos(s) E_perpendicular is the irradiance of the diffuse row, shadows, soft edges and horizon included: no
division by a small cosine, and no edge in the highlight where a lamp sets. (K of `brdf.reflection_matrix` times y_j(s)
is as near to F elsewhere, but at the horizon leaves a tenth of F at roughness 0.5 and a third at 0.3.)
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..basis import hemisphere, spherical_harmonics
from ..basis.hemisphere import Indices
from ..basis.spherical_harmonics import expand_bands
from ..linear_algebra import multiply, symmetric_eigenpairs
from .brdf import Reflection, outgoing_matrix

Array = NDArray[np.float64]

# Order of the functions of the lamp's direction; times the cosine they are of the next order, that of the bake's own
# incident functions, whose integrals are known. Orders 5 to 7 are within 3 % of each other: the rows limit the fit.
LAMP_ORDER = 6
# Smallest eigenvalue of their Gram matrix that is inverted: these integrals have no noise. With 1e-2 a white metal
# of roughness 0.8 is wrong by 11 % over lights and views instead of 4 %; sharper ones hardly differ.
SMALLEST = 1e-3


# Negative lobe, relative to the peak of the same view, that a highlight may keep where it is seen from above: deeper
# ones show as dark rings. Rows of their own ring more towards grazing views, which no window on lamps mends.
DEEPEST_LOBE = 0.05
_RINGS_SEEN_AT, _HALVINGS, _STRONGEST = 30.0, 12, 0.05


def lamp_kernel(reflection: Reflection, functions: Indices, window: bool = True) -> Array:
    """C (rows, LAMP_ORDER^2, channels): rows of exit radiance are C y(s) times E / pi of a white diffuse surface.

    s: the lamp's direction in the point's own frame. window: damp bands by the weakest heat kernel (see
    `spherical_harmonics.window`) that keeps lobes above -DEEPEST_LOBE; none at roughness 0.5. (The window of distant
    light is for its own order and far stronger: it would make the error at 0.5, 25 rows, seen straight on 25 % instead
    of 10.) Raises ValueError where the reflection is of a lower order.
    """
    if reflection.order <= LAMP_ORDER:
        raise ValueError(f"a lamp's kernel needs a reflection of order {LAMP_ORDER + 1}, not {reflection.order}")
    fit = _Fit.of(reflection, functions)
    views, lamps = profile_directions()
    seen = hemisphere.evaluate(functions, views)
    values = spherical_harmonics.evaluate(LAMP_ORDER, lamps) * lamps[:, 2:]

    def rings(strength: float) -> bool:
        profile = multiply(multiply(seen, fit.kernel(strength).mean(axis=2)), np.ascontiguousarray(values.T))
        return bool(np.any(profile.min(axis=1) < -DEEPEST_LOBE * profile.max(axis=1)))

    if not window or not rings(0.0):
        return fit.kernel(0.0)
    low, high = 0.0, _STRONGEST
    for _ in range(_HALVINGS):
        middle = (low + high) / 2
        low, high = (middle, high) if rings(middle) else (low, middle)
    return fit.kernel(high)


def profile_directions() -> tuple[Array, Array]:
    """Views (v, 3) at which rings are looked for, and lamps (n, 3) all over the hemisphere."""
    angle, turn = np.radians(_RINGS_SEEN_AT), np.pi / 4 * np.arange(4)
    slanted = np.stack([np.sin(angle) * np.cos(turn), np.sin(angle) * np.sin(turn), np.full(4, np.cos(angle))], axis=1)
    z, turn = np.linspace(0.02, 1.0, 25)[:, None], np.pi / 8 * np.arange(16)
    radius = np.sqrt(1.0 - z * z)
    lamps = np.stack([radius * np.cos(turn), radius * np.sin(turn), np.broadcast_to(z, (25, 16))], axis=-1)
    return np.concatenate([[[0.0, 0.0, 1.0]], slanted]), lamps.reshape(-1, 3)


@dataclass(frozen=True)
class _Fit:
    """plain: (rows, channels, n^2) the fit without a window, over pi; whole: (rows, channels) integral of F over lamps;
    white: (n^2,) integral of z y_j."""

    plain: Array
    whole: Array
    white: Array

    @staticmethod
    def of(reflection: Reflection, functions: Indices) -> _Fit:
        wide = (LAMP_ORDER + 1) ** 2
        times_cosine = cosine_product(LAMP_ORDER)
        fitted = np.moveaxis(outgoing_matrix(reflection, functions)[:, :wide], 2, 1)
        wide_gram = hemisphere.gram_matrix(np.arange(wide))
        gram = multiply(multiply(times_cosine, wide_gram), np.ascontiguousarray(times_cosine.T))
        values, vectors = symmetric_eigenpairs(gram)
        kept = values >= SMALLEST * values[0]
        inverse = multiply(vectors[:, kept] / values[kept], np.ascontiguousarray(vectors[:, kept].T))
        flat = np.ascontiguousarray(fitted).reshape(-1, wide)
        plain = multiply(multiply(flat, np.ascontiguousarray(times_cosine.T)), inverse)
        # y_0 is constant: the integral against it, over that of the lamps' own functions.
        white = np.sum(times_cosine * wide_gram[0], axis=1)
        return _Fit(plain.reshape(*fitted.shape[:2], -1), fitted[:, :, 0], white)

    def kernel(self, strength: float) -> Array:
        """(rows, n^2, channels) under a heat kernel of this strength. Lamps all around are a white world: as for K, the
        smallest change that returns its light exactly is of rank one."""
        kernel = self.plain * expand_bands(spherical_harmonics.window(LAMP_ORDER, "heat", strength))
        missing = self.whole - np.sum(kernel * self.white, axis=2)
        kernel += missing[:, :, None] * (self.white / np.sum(self.white ** 2))
        return np.ascontiguousarray(np.moveaxis(math.pi * kernel, 1, 2))


def cosine_product(order: int) -> Array:
    """(order^2, (order + 1)^2): z y_j as a sum of functions of one order more.

    Arfken & Weber, Mathematical Methods for Physicists, 12.9: z Y_l^m = a_(l+1) Y_(l+1)^m + a_l Y_(l-1)^m with
    a_l = sqrt((l^2 - m^2) / (4 l^2 - 1)); the same for real functions, whose m and -m differ by the azimuth alone.
    """
    bands, azimuths = hemisphere.bands_of(np.arange(order ** 2))
    result = np.zeros((order ** 2, (order + 1) ** 2))
    above, index = bands + 1, np.arange(order ** 2)
    result[index, above * (above + 1) + azimuths] = np.sqrt((above ** 2 - azimuths ** 2) / (4.0 * above ** 2 - 1.0))
    lower = np.flatnonzero(np.abs(azimuths) < bands)
    band, azimuth = bands[lower], azimuths[lower]
    result[lower, (band - 1) * band + azimuth] = np.sqrt((band ** 2 - azimuth ** 2) / (4.0 * band ** 2 - 1.0))
    return result
