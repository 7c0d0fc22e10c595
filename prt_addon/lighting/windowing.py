# SPDX-License-Identifier: GPL-3.0-or-later
"""Windowing against ringing: only where the truncated light goes negative, and no more than removes that."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..basis.directions import spherical_fibonacci
from ..basis.spherical_harmonics import evaluate, expand_bands, order_of, window
from ..linear_algebra import multiply

Array = NDArray[np.float64]

HIGHLIGHT_TOLERANCE = 1.0  # of the mean radiance; see `for_highlights`
_DIRECTIONS_PER_FUNCTION = 24  # dense enough that no lobe of the highest band is missed between directions


@dataclass(frozen=True)
class Windowing:
    """What removes the ringing of one light, and its price.

    factors: (order,) per band, all 1 where nothing rings; strength: of the heat window, 0 where nothing rings; cost:
    relative L2 change of the light, 0..1; lowest_before, lowest_after: smallest radiance over the sphere as a share
    of the mean (negative: rings).
    """

    factors: Array
    strength: float
    cost: float
    lowest_before: float
    lowest_after: float

    @property
    def rings(self) -> bool:
        """Whether the light needed a window."""
        return self.strength > 0


def remove_ringing(coefficients: ArrayLike, tolerance: float = 0.01) -> Windowing:
    """The weakest heat window that keeps light from going negative by more than `tolerance` times its mean.

    coefficients: (order^2, 3). A light is not windowed at all where it does not ring. The problem is that of Sloan,
    Stupid SH Tricks (2008), Windowing; in place of his Laplacian window the heat window is taken, whose kernel is
    positive: for a point-like sun at order 10 it leaves five times the peak at the same lowest value. The strength
    is found by bisection to 1 %, on the safe side. A channel without light takes no part. Raises ValueError where the
    coefficients are no whole number of bands.
    """
    coefficients = np.asarray(coefficients, np.float64)
    order = order_of(len(coefficients))
    functions = evaluate(order, spherical_fibonacci(_DIRECTIONS_PER_FUNCTION * order * order))

    def lowest(strength: float) -> float:
        factors = expand_bands(window(order, "heat", strength))
        return _lowest_share(multiply(functions, coefficients * factors[:, None]), coefficients[0])

    before = lowest(0.0)
    if before >= -tolerance:
        return Windowing(np.ones(order), 0.0, 0.0, before, before)
    strength = _weakest(lambda value: lowest(value) >= -tolerance)
    factors = window(order, "heat", strength)
    changed = np.square((1 - expand_bands(factors))[:, None] * coefficients).sum()
    return Windowing(factors, strength, math.sqrt(changed / np.square(coefficients).sum()), before, lowest(strength))


@lru_cache(maxsize=64)
def _highlight_factors(stored: bytes) -> Array:
    """Factors (order^2,) of `for_highlights` for coefficients stored as float64."""
    coefficients = np.frombuffer(stored).reshape(-1, 3)
    return expand_bands(remove_ringing(coefficients, HIGHLIGHT_TOLERANCE).factors)


def for_highlights(coefficients: ArrayLike) -> Array:
    """The light (order^2, 3) that highlights reflect: windowed where it rings so much that highlights would show it.

    A highlight is the light seen through the material's lobe, which smooths some of the ringing away, but shows the
    rest as black spots on bright metal, while a diffuse surface smooths all of it. So highlights alone get the window,
    and a weaker one than `remove_ringing` asks for by itself: where the lowest radiance lies under
    -HIGHLIGHT_TOLERANCE times the mean. On a ball of roughness 0.3 in a courtyard with a sun (order 5, 16 rows; lowest
    radiance -1.8 of the mean) this leaves 0.3 % of all points and views below black in place of 1.2 %, the darkest
    -0.07 in place of -0.21, for a change of 8 %; a tolerance of 0.5 would cost 14 %, none 24 %. A light that does not
    ring so much comes back as it is.
    """
    coefficients = np.ascontiguousarray(coefficients, np.float64)
    return coefficients * _highlight_factors(coefficients.tobytes())[:, None]


def _lowest_share(radiance: Array, constants: Array) -> float:
    """The smallest value (n, channels) relative to its channel's mean radiance; channels without light are left out."""
    means = constants / math.sqrt(4 * math.pi)
    lit = means > 1e-9 * max(float(means.max()), 0.0)
    return float((radiance[:, lit].min(axis=0) / means[lit]).min()) if lit.any() else 0.0


def _weakest(enough: Callable[[float], bool]) -> float:
    """The smallest strength, within 1 %, from which `enough` holds: doubling up, then bisecting the exponent."""
    high = 1e-6
    while not enough(high) and high < 1e3:  # there only the mean is left, which is positive
        high *= 4
    low = high / 4
    while high > 1.01 * low:
        middle = math.sqrt(low * high)
        low, high = (low, middle) if enough(middle) else (middle, high)
    return high
