# SPDX-License-Identifier: GPL-3.0-or-later
"""The dipole: how a scattering half-space spreads light that enters at a point (Jensen, Marschner, Levoy & Hanrahan
2001, A Practical Model for Subsurface Light Transport, section 2.1).

    R_d(r) = alpha' / 4pi  sum over both poles of  z (1 + sigma_tr d) exp(-sigma_tr d) / d^3,   d^2 = r^2 + z^2

in radiosity out per flux in (1/m^2), with the real source at z_r = 1 / sigma_t' below the surface and the virtual one
at z_v = z_r (1 + 4A/3) above it, sigma_tr = sqrt(3 sigma_a sigma_t') and A = (1 + F_dr) / (1 - F_dr) for the light
that the boundary throws back inside. Its integral over a disc has a closed form, and over the plane

    R = alpha'/2 (1 + exp(-4/3 A x)) exp(-x),   x = sqrt(3 (1 - alpha')).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..errors import BadArguments

# A mean free path below this share of the object's size is diffuse reflection at any sample spacing, and single
# precision holds what R_d makes of it. It also stands for a radius of 0, which means diffuse reflection. The decay
# length is at least 1/sqrt(3) of the mean free path, so it needs no floor of its own.
SHALLOWEST = 1e-9
LARGEST_X = np.sqrt(3.0)


def internal_reflectance(ior: float) -> float:
    """F_dr, the share of diffuse light inside that the boundary reflects back: Egan & Hilgeman's fit as Jensen 2001
    gives it, within 0.002 of the Fresnel integral for 1..2; exactly 0 at 1, where the fit says 0.0016."""
    if ior == 1.0:
        return 0.0
    if ior < 1.0:
        return -0.4399 + 0.7099 / ior - 0.3319 / ior**2 + 0.0636 / ior**3
    return -1.440 / ior**2 + 0.710 / ior + 0.668 + 0.0636 * ior


def boundary_factor(ior: float) -> float:
    """A = (1 + F_dr) / (1 - F_dr); 1 where nothing is reflected back."""
    if not 0.5 <= ior <= 4.0:
        raise BadArguments("index of refraction", f"{ior} is outside 0.5..4", "Enter that of a medium, such as 1.4")
    reflectance = internal_reflectance(ior)
    return (1.0 + reflectance) / (1.0 - reflectance)


def total_reflectance(x: ArrayLike, boundary: float) -> NDArray[np.float64]:
    """R of a half-space, 0..1, from x = sqrt(3 (1 - alpha')) in 0..sqrt(3) (Jensen 2001, the integral of R_d)."""
    x = np.asarray(x, np.float64)
    return 0.5 * (1.0 - x * x / 3.0) * (1.0 + np.exp(-4.0 / 3.0 * boundary * x)) * np.exp(-x)


def x_of_reflectance(reflectance: ArrayLike, boundary: float) -> NDArray[np.float64]:
    """The x whose half-space reflects this much, 0..1, to double precision: bisection, R falls with x.

    Solved in x and not in alpha': near white 1 - R is proportional to x, but 1 - alpha' to its square. 1 gives x = 0
    (no absorption), 0 gives sqrt(3) (no scattering).
    """
    wanted = np.asarray(reflectance, np.float64)
    low, high = np.zeros_like(wanted), np.full_like(wanted, LARGEST_X)
    for _ in range(60):
        middle = 0.5 * (low + high)
        brighter = total_reflectance(middle, boundary) > wanted
        low, high = np.where(brighter, middle, low), np.where(brighter, high, middle)
    return np.where(wanted >= 1.0, 0.0, np.where(wanted <= 0.0, LARGEST_X, 0.5 * (low + high)))


@dataclass(frozen=True)
class Medium:
    """A scattering medium. x: (3,) sqrt(3 (1 - alpha')) per colour channel, 0 (no absorption) to sqrt(3) (no
    scattering); depth: (3,) mean free path 1/sigma_t' in metres, 0 for diffuse reflection; boundary: A."""

    x: NDArray[np.float64]
    depth: NDArray[np.float64]
    boundary: float

    @staticmethod
    def of_coefficients(scattering: ArrayLike, absorption: ArrayLike, ior: float) -> Medium:
        """From sigma_s' and sigma_a (1/metre) as papers tabulate them."""
        scattering, absorption = (np.broadcast_to(np.asarray(v, np.float64), 3) for v in (scattering, absorption))
        extinction = scattering + absorption
        if not (np.isfinite(extinction).all() and (scattering >= 0.0).all() and (absorption >= 0.0).all()
                and (extinction > 0.0).all()):
            raise BadArguments("scattering coefficients", "they are negative, not finite or all zero",
                               "Enter positive numbers per metre")
        return Medium(np.sqrt(3.0 * absorption / extinction), 1.0 / extinction, boundary_factor(ior))

    @staticmethod
    def of_principled(base_colour: ArrayLike, radius: ArrayLike, ior: float = 1.0,
                      method: str = "RANDOM_WALK") -> Medium:
        """From the Principled BSDF: base colour (3,) 0..1, radius (3,) in metres, scale included.

        alpha' is such that a half-space returns the base colour under uniform light (`x_of_reflectance`). What the
        radius means is what Cycles makes of it (intern/cycles/kernel/closure/bssrdf.h, bssrdf_setup_radius), so that
        light travels as far in both: for "RANDOM_WALK" and "BURLEY" the mean free path 1/sigma_t' is radius / 4pi,
        whatever the colour; for "RANDOM_WALK_SKIN" it is radius * x, which makes the radius the dipole's own decay
        length 1/sigma_tr (there white has no mean free path: it reflects diffusely). Cycles then walks through the
        volume, so thin parts, corners and the first mean free path differ; and its walks leave the volume without
        reflection at the boundary, which is ior = 1 here (the default).
        """
        colour, radius = (np.broadcast_to(np.asarray(v, np.float64), 3) for v in (base_colour, radius))
        if not (np.isfinite(colour).all() and np.isfinite(radius).all() and (radius >= 0.0).all()):
            raise BadArguments("subsurface", "its colour is not finite or its radius not a number of 0 or more",
                               "Enter a radius of 0 or more")
        boundary = boundary_factor(ior)
        x = x_of_reflectance(np.clip(colour, 0.0, 1.0), boundary)  # a colour above 1 makes light: no such medium
        if method == "RANDOM_WALK_SKIN":
            return Medium(x, radius * x, boundary)
        if method in ("RANDOM_WALK", "BURLEY"):
            return Medium(x, radius / (4.0 * np.pi), boundary)
        raise BadArguments("subsurface method", f"{method} is unknown", "Use RANDOM_WALK, RANDOM_WALK_SKIN or BURLEY")

    def total(self) -> NDArray[np.float64]:
        """(3,) the reflectance R of a half-space."""
        return total_reflectance(self.x, self.boundary)

    def poles(self, channel: int, size: float) -> Poles:
        """What R_d takes of a channel, lengths in units of `size` (metres) and not below SHALLOWEST."""
        x, depth = float(self.x[channel]), max(float(self.depth[channel]) / size, SHALLOWEST)
        alpha = 0.0 if x >= LARGEST_X else 1.0 - x * x / 3.0
        return Poles(alpha, depth, depth * (1.0 + 4.0 / 3.0 * self.boundary), x / depth)


class Poles(NamedTuple):
    """One channel: alpha' and, in units of length, the depths z_r and z_v and the decay sigma_tr."""

    alpha: float
    real: float
    virtual: float
    decay: float


def diffuse_reflectance(poles: Poles, squared: NDArray[np.floating]) -> NDArray[np.floating]:
    """R_d at squared distances r^2, in their precision."""
    return _sum_of_poles(poles, squared, None, None)


def mean_reflectance(poles: Poles, squared: NDArray[np.floating], spread: NDArray[np.floating],
                     along: NDArray[np.floating]) -> NDArray[np.floating]:
    """R_d's mean over surface whose centre is at squared distance r^2, to second order, and at least 0.

    spread: trace of the surface's covariance C about its centre; along: r^T C r. With f(r^2) = R_d, the mean is
    f + f' tr C + 2 f'' r^T C r (half the covariance against the Hessian).
    """
    return np.maximum(_sum_of_poles(poles, squared, spread, along), 0.0)


def _sum_of_poles(poles: Poles, squared: NDArray[np.floating], spread: NDArray[np.floating] | None,
                  along: NDArray[np.floating] | None) -> NDArray[np.floating]:
    """Per pole, with q = sigma_tr d: c e^-q / d^3 ((1 + q) - (3 + 3q + q^2) tr C / 2d^2
    + (15 + 15q + 6q^2 + q^3) r^T C r / 2d^4), c = alpha' z / 4pi."""
    kind = squared.dtype.type
    result = np.zeros_like(squared)
    for depth in (poles.real, poles.virtual):
        inverse = squared + kind(depth * depth)
        np.sqrt(inverse, out=inverse)
        reach = inverse * kind(poles.decay)
        np.divide(kind(1.0), inverse, out=inverse)
        term = reach + kind(1.0)
        if spread is not None:
            # In nested form: 15 + 15q + 6q^2 + q^3 = 5 (3 + 3q + q^2) + q^2 + q^3.
            square = reach * reach
            first = kind(3.0) * term
            first += square
            second = kind(5.0) * first
            second += square * term
            second *= along
            second *= inverse
            second *= inverse
            first *= spread
            second -= first
            second *= inverse
            second *= inverse
            second *= kind(0.5)
            term += second
        np.negative(reach, out=reach)
        term *= np.exp(reach, out=reach)
        term *= kind(poles.alpha * depth / (4.0 * np.pi))
        # Not d^3 at once: of a shallow pole it leaves the range of single precision where the quotient does not.
        for _ in range(3):
            term *= inverse
        result += term
    return result


def slope_and_curvature(poles: Poles, nearest: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Upper bounds of |dR_d/dr| and of the Hessian's norm at all r >= nearest (double precision).

    Per pole, q = sigma_tr d: |dR_d/dr| = c r/d^5 (3 + 3q + q^2) e^-q, where the last factors fall with r while r/d^5
    rises to r = z/2 and falls from there; the Hessian's eigenvalues lie within c/d^5 (15 + 15q + 6q^2 + q^3) e^-q,
    which falls with r.
    """
    slope, curvature = np.zeros((2, *nearest.shape))
    for depth in (poles.real, poles.virtual):
        squared = nearest * nearest + depth * depth
        q = poles.decay * np.sqrt(squared)
        factor = poles.alpha * depth / (4.0 * np.pi) * np.exp(-q)
        first = 3.0 + 3.0 * q + q * q
        curvature += factor * (5.0 * first + q * q * (1.0 + q)) / (squared * squared * np.sqrt(squared))
        top = np.maximum(nearest, 0.5 * depth)
        squared = top * top + depth * depth
        slope += factor * first * top / (squared * squared * np.sqrt(squared))
    return slope, curvature


def disc_integral(poles: Poles, squared_radius: ArrayLike) -> NDArray[np.float64]:
    """Integral of R_d over a disc about the point: alpha'/2 sum of exp(-sigma_tr z) - z/d exp(-sigma_tr d).

    Written without a difference of nearly equal numbers, so it keeps its precision for a disc far smaller than z.
    """
    alpha, real, virtual, decay = poles
    squared = np.asarray(squared_radius, np.float64)
    result = np.zeros_like(squared)
    for depth in (real, virtual):
        distance = np.sqrt(squared + depth * depth)
        excess = squared / (distance + depth)
        fallen = -np.expm1(-decay * excess)
        result += 0.5 * alpha * np.exp(-decay * depth) * (fallen + (1.0 - fallen) * excess / distance)
    return result


def plane_integral(poles: Poles) -> float:
    """Integral of R_d over the plane: the half-space's R."""
    return 0.5 * poles.alpha * (np.exp(-poles.decay * poles.real) + np.exp(-poles.decay * poles.virtual))
