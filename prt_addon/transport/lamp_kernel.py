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

import numpy as np
from numpy.typing import NDArray

from ..basis import hemisphere
from ..basis.hemisphere import Indices
from ..basis.spherical_harmonics import expand_bands
from ..linear_algebra import multiply, symmetric_eigenpairs
from .brdf import Reflection, outgoing_matrix, ringing_window

Array = NDArray[np.float64]

# Order of the functions of the lamp's direction; times the cosine they are of the next order, that of the bake's own
# incident functions, whose integrals are known. Orders 5 to 7 are within 3 % of each other: the rows limit the fit.
LAMP_ORDER = 6
# Smallest eigenvalue of their Gram matrix that is inverted: these integrals have no noise. With 1e-2 a white metal
# of roughness 0.8 is wrong by 11 % over lights and views instead of 4 %; sharper ones hardly differ.
SMALLEST = 1e-3


def lamp_kernel(reflection: Reflection, functions: Indices, window: bool = True) -> Array:
    """C (rows, LAMP_ORDER^2, channels): rows of exit radiance are C y(s) times E / pi of a white diffuse surface.

    s: the lamp's direction in the point's own frame. window: damp bands as `ringing_window` does for distant light, so
    that a highlight has no deeper dark rings than a Sun's. Raises ValueError where the reflection is of a lower order.
    """
    if reflection.order <= LAMP_ORDER:
        raise ValueError(f"a lamp's kernel needs a reflection of order {LAMP_ORDER + 1}, not {reflection.order}")
    wide = (LAMP_ORDER + 1) ** 2
    times_cosine = cosine_product(LAMP_ORDER)
    fitted = outgoing_matrix(reflection, functions)[:, :wide]
    gram = multiply(multiply(times_cosine, hemisphere.gram_matrix(np.arange(wide))), times_cosine.T)
    values, vectors = symmetric_eigenpairs(gram)
    kept = values >= SMALLEST * values[0]
    inverse = multiply(vectors[:, kept] / values[kept], np.ascontiguousarray(vectors[:, kept].T))
    to_kernel = multiply(np.ascontiguousarray(times_cosine.T), inverse)
    if window:
        to_kernel *= expand_bands(ringing_window(reflection, LAMP_ORDER))
    flat = np.ascontiguousarray(np.moveaxis(fitted, 2, 1)).reshape(-1, wide)
    kernel = multiply(flat, to_kernel)
    # Lamps all around are a white world: as for K, the smallest change that returns its light exactly is of rank one.
    white = np.sum(times_cosine * hemisphere.gram_matrix(np.arange(wide))[0], axis=1)
    missing = flat[:, 0] - np.sum(kernel * white, axis=1)
    kernel += missing[:, None] * (white / np.sum(white ** 2))
    kernel = math.pi * kernel.reshape(fitted.shape[0], fitted.shape[2], -1)
    return np.ascontiguousarray(np.moveaxis(kernel, 1, 2))


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
