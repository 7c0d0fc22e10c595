# SPDX-License-Identifier: GPL-3.0-or-later
"""Even point sets on flat shapes: the same number and seed give the same points on every machine."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_GOLDEN_TURN = (math.sqrt(5) - 1) / 2


def fibonacci_square(count: int, seed: int = 0) -> Array:
    """`count` even points (count, 2) of the square [-1, 1]^2: steps of the golden ratio, shifted by the seed.

    Each point's first coordinate is the middle of one of `count` strips; the second leaps by the golden ratio's
    fraction, the number whose multiples spread best (Niederreiter, Random Number Generation and Quasi-Monte Carlo
    Methods (1992), ch. 3).
    """
    if count < 1:
        raise ValueError(f"a set of points needs 1 point or more, not {count}")
    index = np.arange(count)
    first = (index + 0.5) / count
    second = np.modf(0.5 / count + index * _GOLDEN_TURN + _shift(seed))[0] if count > 1 else np.array([0.5])
    return np.stack([2.0 * first - 1.0, 2.0 * second - 1.0], axis=1)


def fibonacci_disc(count: int, seed: int = 0) -> Array:
    """`count` points (count, 2) of equal area of the unit disc, on a golden spiral turned by the seed.

    Vogel, A Better Way to Construct the Sunflower Head (1979): radius sqrt((i + 1/2) / count).
    """
    if count < 1:
        raise ValueError(f"a set of points needs 1 point or more, not {count}")
    index = np.arange(count)
    radius = np.sqrt((index + 0.5) / count) if count > 1 else np.zeros(1)
    turn = 2.0 * math.pi * np.modf(index * _GOLDEN_TURN + _shift(seed))[0]
    return np.stack([radius * np.cos(turn), radius * np.sin(turn)], axis=1)


def _shift(seed: int) -> float:
    """A fraction of a turn; 0 for seed 0."""
    return float(np.random.Generator(np.random.PCG64(seed)).random()) if seed else 0.0
