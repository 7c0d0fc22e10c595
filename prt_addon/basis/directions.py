# SPDX-License-Identifier: GPL-3.0-or-later
"""Sets of directions: even point sets, quadrature, random rotations, local frames. All deterministic."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import linalg

from ..linear_algebra import gram, multiply
from .spherical_harmonics import evaluate

Array = NDArray[np.float64]

_GOLDEN_TURN = (math.sqrt(5) - 1) / 2  # the golden ratio's fraction: of all turns the one that repeats least
# A corrected weight may shrink to this share of the even one: positive weights keep the sum stable (no cancellation),
# and a direction that counts for nothing would waste its rays.
_SMALLEST_SHARE = 0.1


def _golden_azimuths(count: int) -> Array:
    return 2 * np.pi * np.modf(np.arange(count) * _GOLDEN_TURN)[0]


def _check_count(count: int) -> None:
    if count < 1:
        raise ValueError(f"a set of directions needs 1 direction or more, not {count}")


def spherical_fibonacci(count: int) -> Array:
    """`count` nearly evenly spread unit directions (count, 3), from +Z down to -Z.

    Keinert, Innmann, Saenger, Stamminger, Spherical Fibonacci Mapping (2015), eq. 1.
    """
    _check_count(count)
    z = 1 - (2 * np.arange(count) + 1) / count
    return _from_height(z, _golden_azimuths(count))


def _from_height(z: Array, azimuth: Array) -> Array:
    radius = np.sqrt((1 - z) * (1 + z))
    return np.stack([radius * np.cos(azimuth), radius * np.sin(azimuth), z], axis=1)


def quadrature(count: int, order: int) -> tuple[Array, Array]:
    """Directions (count, 3) and positive weights (count,), sum 4 pi, for projections to spherical harmonics of `order`.

    Fibonacci directions; the even weights are corrected by the smallest change (in the sum of squares) that makes
    the sum exact for all functions of order 2 * order, hence for every product of two functions of `order`. Where
    `count` is too small for that with positive weights, the highest order that leaves them positive is taken
    (`exact_order` says which). From 6 * order^2 directions on (measured, orders 1..10) it is the full order.
    Raises ValueError for count or order below 1.
    """
    _check_count(count)
    if order < 1:
        raise ValueError(f"a quadrature needs order 1 or more, not {order}")
    directions = spherical_fibonacci(count)
    for exact in range(2 * order, 1, -1):
        if exact * exact > count:
            continue
        weights = _corrected_weights(directions, exact)
        if weights is not None:
            return directions, weights
    return directions, np.full(count, 4 * np.pi / count)


def _corrected_weights(directions: Array, order: int) -> Array | None:
    """Weights exact to `order` nearest to even ones, or None where that needs (nearly) negative ones."""
    count = len(directions)
    even = 4 * np.pi / count
    values = evaluate(order, directions)
    wanted = np.zeros((order * order, 1))
    wanted[0] = math.sqrt(4 * np.pi)
    weights = np.full((count, 1), even)
    try:
        factor = linalg.cho_factor(gram(values))
    except linalg.LinAlgError:  # fewer independent directions than functions
        return None
    for _ in range(2):  # the second step removes the rounding of the first
        missing = wanted - multiply(values.T, weights)
        weights = weights + multiply(values, linalg.cho_solve(factor, missing))
    exact = np.abs(wanted - multiply(values.T, weights)).max() < 1e-12
    return weights[:, 0] if exact and weights.min() > _SMALLEST_SHARE * even else None


def exact_order(directions: Array, weights: Array, highest: int, tolerance: float = 1e-11) -> int:
    """The largest order up to `highest` whose functions these weights all integrate to within `tolerance` (0: none)."""
    sums = multiply(evaluate(highest, directions).T, weights[:, None])[:, 0]
    sums[0] -= math.sqrt(4 * np.pi)
    wrong = np.flatnonzero(np.abs(sums) > tolerance)
    return highest if len(wrong) == 0 else math.isqrt(int(wrong[0]))


def random_rotation(seed: int, index: int) -> Array:
    """A uniformly random rotation (3, 3), the same for the same seed and index on every machine.

    Shoemake, Uniform Random Rotations, Graphics Gems III (1992): a uniform unit quaternion from three uniform numbers.
    """
    first, second, third = np.random.Generator(np.random.PCG64([seed, index])).random(3)
    a, b = math.sqrt(1 - first), math.sqrt(first)
    x, y = a * math.sin(2 * math.pi * second), a * math.cos(2 * math.pi * second)
    z, w = b * math.sin(2 * math.pi * third), b * math.cos(2 * math.pi * third)
    return np.array([
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ])


def cosine_hemisphere(count: int) -> Array:
    """`count` directions (count, 3) about local +Z with density cos / pi, so that plain means integrate f cos / pi.

    A Fibonacci disc lifted to the hemisphere (Malley's method; Pharr, Jakob, Humphreys, PBR 3rd ed., 13.6.3).
    """
    _check_count(count)
    squared_radius = (np.arange(count) + 0.5) / count
    return _from_height(np.sqrt(1 - squared_radius), _golden_azimuths(count))


def tangent_frames(normals: ArrayLike) -> Array:
    """Right-handed orthonormal frames (n, 3, 3) of unit normals (n, 3): the rows are tangent, bitangent, normal.

    A local direction d becomes d[0] tangent + d[1] bitangent + d[2] normal. Duff et al., Building an Orthonormal
    Basis, Revisited (JCGT 2017), listing 3: no branch, no singular normal.
    """
    normals = np.asarray(normals, np.float64)
    x, y, z = normals.T
    sign = np.copysign(1.0, z)
    a = -1 / (sign + z)
    b = x * y * a
    tangent = np.stack([1 + sign * x * x * a, sign * b, -sign * x], axis=1)
    bitangent = np.stack([b, sign + y * y * a, -y], axis=1)
    return np.stack([tangent, bitangent, normals], axis=1)


def disc_directions(frame: NDArray[np.float64], angle: float, numbers: NDArray[np.float64],
                    ) -> tuple[NDArray[np.float64], float]:
    """Directions (n, 3) even over a disc of full angle (radians) about the last row of a frame (3, 3), from numbers
    (n, 2) in [0, 1), and the disc's solid angle over its projected one (1 for a point)."""
    half = 0.5 * angle
    drop = 2.0 * np.sin(0.5 * half) ** 2 * numbers[:, 0]  # 1 - cos, without cancellation for the real sun
    radius, turn = np.sqrt(drop * (2.0 - drop)), 2.0 * np.pi * numbers[:, 1]
    local = np.stack([radius * np.cos(turn), radius * np.sin(turn), 1.0 - drop], axis=1)
    return np.sum(local[:, :, None] * frame[None], axis=1), float(1.0 / np.cos(0.5 * half) ** 2)
