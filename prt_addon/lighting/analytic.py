# SPDX-License-Identifier: GPL-3.0-or-later
"""Lights given by formulas: the Sun lamp and a constant environment."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..basis.spherical_harmonics import evaluate, expand_bands

Array = NDArray[np.float64]


def constant(colour: ArrayLike, order: int) -> Array:
    """Coefficients (order^2, 3) of the same radiance (3,) from everywhere: sqrt(4 pi) times the colour in band 0."""
    coefficients = np.zeros((order * order, 3))
    coefficients[0] = math.sqrt(4 * math.pi) * np.asarray(colour, np.float64)
    return coefficients


def sun(direction_to_light: ArrayLike, strength_rgb: ArrayLike, angle: float, order: int,
        normalize: bool = True) -> Array:
    """Coefficients (order^2, 3) of Blender's Sun lamp.

    direction_to_light: (3,), any length, from the scene to the lamp (the lamp's local +Z); strength_rgb: (3,) lamp
    strength times colour (and 2^exposure); angle: full angle of the disc in radians, 0..pi; normalize: the lamp's own
    option of that name.

    With a = angle / 2, strength S is the irradiance in W/m^2 on a plane that faces the lamp, from a disc of even
    radiance L = S / (pi sin^2 a). Without `normalize`, L = S (a lamp with angle 0 keeps irradiance S). Calibrated
    against Cycles by tests/blender/test_sun_units.py. The disc is a spherical cap of solid angle 2 pi (1 - cos a), so
    c_lm = L 2 pi (1 - cos a) mean_l y_lm(direction), mean_l the mean of the Legendre polynomial P_l over the cap
    (Funk-Hecke; Sloan, Stupid SH Tricks (2008), Zonal Harmonics). Raises ValueError for a direction of no length
    or an angle outside 0..pi.
    """
    direction = np.asarray(direction_to_light, np.float64)
    length = float(np.sqrt(np.square(direction).sum()))
    if direction.shape != (3,) or not 0 < length < math.inf:
        raise ValueError("the direction to a sun must be 3 finite numbers, not all zero")
    if not 0 <= angle <= math.pi + 1e-6:  # Blender stores 180 degrees in single precision
        raise ValueError(f"the angle of a sun must lie in 0..pi, not {angle}")
    half = min(angle, math.pi) / 2
    # 2 pi (1 - cos a) / (pi sin^2 a) = 2 / (1 + cos a): the disc's flux over the irradiance it gives, 1 for a point.
    flux = 2 / (1 + math.cos(half))
    if not normalize and half > 0:
        flux *= math.pi * math.sin(half) ** 2
    zonal = expand_bands(_cap_means(order, half)) * evaluate(order, direction[None] / length)[0]
    return flux * zonal[:, None] * np.asarray(strength_rgb, np.float64)


def _cap_means(order: int, half_angle: float) -> Array:
    """Mean of each Legendre polynomial P_l over the cap z in cos(half_angle)..1: (order,), by an exact Gauss rule.

    The closed form (P_l-1 - P_l+1) / ((2 l + 1) (1 - z)) cancels catastrophically for the real sun's half degree.
    """
    nodes, weights = np.polynomial.legendre.leggauss(order // 2 + 1)
    z = 1 - (1 - nodes) * math.sin(half_angle / 2) ** 2  # 1 - cos = 2 sin^2 of the half
    return np.array([(weights * np.polynomial.legendre.Legendre.basis(band)(z)).sum() / 2 for band in range(order)])
