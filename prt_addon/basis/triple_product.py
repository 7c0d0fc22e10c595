# SPDX-License-Identifier: GPL-3.0-or-later
"""Products of real spherical harmonics as sums of harmonics: the real Gaunt (tripling) coefficients."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from ..linear_algebra import multiply
from .spherical_harmonics import evaluate

# What is smaller is rounding: the least coefficient that is not zero is 5e-6 for orders 10 and 10.
ROUNDING = 1e-12


@lru_cache(maxsize=8)
def triple_products(first: int, second: int) -> NDArray[np.float64]:
    """C (k^2, first^2 * second^2), k = first + second - 1, with y_i y_j = sum_k C[k, i * second^2 + j] y_k exactly.

    Gauss-Legendre in z times even azimuths integrates all polynomials of degree 2 (first + second - 2) exactly, and
    those are the integrands y_i y_j y_k. Most entries are zero (25 x 25 functions: 22 of 23), but one dense product
    with all coefficients of many receivers is faster than a sparse one. Read-only: it is kept for the next caller.
    """
    order = first + second - 1
    heights, weights = np.polynomial.legendre.leggauss(order)
    azimuths = np.arange(2 * order - 1) * (2 * np.pi / (2 * order - 1))
    z = np.repeat(heights, len(azimuths))
    radius = np.sqrt((1 - z) * (1 + z))
    phi = np.tile(azimuths, order)
    values = evaluate(order, np.stack([radius * np.cos(phi), radius * np.sin(phi), z], axis=1))
    pairs = values[:, :first * first, None] * values[:, None, :second * second]
    weighted = values * np.repeat(weights * (2 * np.pi / len(azimuths)), len(azimuths))[:, None]
    result = multiply(weighted.T, pairs.reshape(len(z), -1))
    result[np.abs(result) < ROUNDING] = 0.0
    result.setflags(write=False)
    return result
