# SPDX-License-Identifier: GPL-3.0-or-later
"""Lamps near the scene: Blender's Point, Spot and Area lights by formulas, in Blender's units.

What a lamp does is as Cycles of Blender 5.2 does it, found by baking white facets (tests/blender/
test_local_light_units.py compares): a Point of P watts has the intensity P / (4 pi), a Spot the same on its axis
whatever its cone (the manual, render/lights/light_object: the power of the whole sphere), an Area light's radiance is
P / (pi area). Object scale does not change the radius of a Point or Spot; it shapes a Spot's cone and an Area's size.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import linalg

from ..basis.point_sets import fibonacci_disc, fibonacci_square
from ..basis.spherical_harmonics import evaluate, expand_bands
from ..linear_algebra import multiply
from .windowing import remove_ringing

Array = NDArray[np.float64]
Kind = Literal["point", "spot", "area"]
Shape = Literal["rectangle", "ellipse"]

# Gauss nodes per smooth piece of an emission pattern and azimuths around its axis: exact for a plain spot up to order
# 20, and for cones stretched 4 to 1 to 1e-6.
NODES, AZIMUTHS = 48, 96
# How far below zero, as a share of its peak, a truncated pattern may go. Forbidding it altogether halves what order 5
# holds of a 45 degree spot (0.59 plain, 0.57 with this bound, 0.26 with lobes below 1 % of the mean).
NEGATIVE = 0.05
# Spreads below this are treated as this (Blender's own least value is 1 degree): towards 0 the radiance has no limit.
LEAST_SPREAD = math.radians(0.5)
# Least stretch of a lamp's scale over its largest: flatter cones can't be told apart in single precision.
FLATTEST = 1e-6


@dataclass(frozen=True, eq=False)
class LocalLight:
    """One lamp. key: the same for the same lamp or instance from frame to frame; matrix: (4, 4), lamp to world (it
    shines along its own -Z); power: (3,) W in linear Rec.709, of the whole sphere also for a Spot.

    radius: of a Point or Spot, metres in the world. soft_falloff: it shines as a disc that faces each receiver, whose
    irradiance head-on is I / (d^2 + radius^2), otherwise as a sphere, I / d^2. spot_angle: full angle of the cone;
    spot_blend: 0..1. shape, size: of an Area, full width and height in the lamp's own space; spread: full angle, pi
    for plain cosine emission. shadow: whether anything hides it.
    """

    name: str
    kind: Kind
    matrix: Array
    power: Array
    key: str = ""
    radius: float = 0.0
    soft_falloff: bool = True
    spot_angle: float = math.pi
    spot_blend: float = 0.0
    shape: Shape = "rectangle"
    size: tuple[float, float] = (1.0, 1.0)
    spread: float = math.pi
    shadow: bool = True
    _shape: Array = field(init=False, repr=False)
    _to_local: Array = field(init=False, repr=False)

    def __post_init__(self) -> None:
        """Keep what the lamp's scale makes of a cone, and its inverse."""
        object.__setattr__(self, "matrix", np.asarray(self.matrix, np.float64))
        object.__setattr__(self, "power", np.asarray(self.power, np.float64))
        shape, inverse = _invertible(self.matrix[:3, :3])
        object.__setattr__(self, "_shape", shape)
        object.__setattr__(self, "_to_local", inverse)

    @property
    def position(self) -> Array:
        """The lamp's middle (3,), metres."""
        return self.matrix[:3, 3]

    @property
    def to_local(self) -> Array:
        """Turns world directions into the lamp's own space, with its scale up to a factor: (3, 3)."""
        return self._to_local

    @property
    def half_axes(self) -> Array:
        """An Area's half width and half height as world vectors: (2, 3)."""
        return 0.5 * (self.matrix[:3, :2] * np.asarray(self.size)).T

    @property
    def axis(self) -> Array:
        """The unit direction (3,) that the lamp shines along; an Area's stands upright on its face."""
        away = -self.matrix[:3, 2]
        if self.kind == "area":
            upright = np.cross(*self.half_axes)
            away = upright * (1.0 if float(np.sum(upright * away)) >= 0.0 else -1.0)
        length = math.sqrt(float(np.sum(away * away)))
        return away / length if length > 0.0 else np.array([0.0, 0.0, -1.0])

    @property
    def area(self) -> float:
        """The shining surface, m^2: of an Area its face, of a Point or Spot the sphere."""
        if self.kind != "area":
            return 4.0 * math.pi * self.radius ** 2
        upright = np.cross(*self.half_axes)
        return math.sqrt(float(np.sum(upright ** 2))) * (4.0 if self.shape == "rectangle" else math.pi)

    @property
    def extent(self) -> float:
        """Half the largest width of the lamp, metres: 0 for one that throws hard shadows."""
        if self.kind != "area":
            return self.radius
        return 0.5 * math.hypot(*(2.0 * np.sqrt(np.sum(self.half_axes ** 2, axis=1))))

    @property
    def peak_intensity(self) -> Array:
        """Radiant intensity (3,) along the axis from afar, W/sr."""
        if self.kind == "area":
            return self.power / math.pi * spread_factor(self.spread)
        return self.power / (4.0 * math.pi)

    def intensity(self, directions: ArrayLike) -> Array:
        """Radiant intensity (n, 3) from afar, W/sr, towards world directions (n, 3) away from the lamp (any length)."""
        return self.pattern(np.asarray(directions, np.float64))[:, None] * self.peak_intensity

    def pattern(self, directions: Array) -> Array:
        """Intensity towards world directions (n, 3) as a share of the peak: (n,)."""
        if self.kind == "area":
            cosine = _cosines(directions, self.axis)
            return np.maximum(cosine, 0.0) * spread_pattern(cosine, self.spread)
        if self.kind == "spot":
            return spot_pattern(_cosines(multiply(directions, self._to_local.T), [0.0, 0.0, -1.0]), self.spot_angle,
                                self.spot_blend)
        return np.ones(len(directions))

    def points(self, samples: int, seed: int = 0) -> tuple[Array, Array]:
        """The lamp as a cluster of points that each emit its pattern: positions (s, 3), weights (s,) of sum 1.

        An Area is `samples` evenly spread points of its face, a Point or Spot is its centre: outside of it a sphere
        shines like a point.
        """
        if self.kind != "area" or samples == 1:
            return self.position[None].copy(), np.ones(1)
        unit = fibonacci_disc(samples, seed) if self.shape == "ellipse" else fibonacci_square(samples, seed)
        return self.position + multiply(unit, self.half_axes), np.full(samples, 1.0 / samples)

    def emission(self, order: int, negative: float = NEGATIVE) -> Array:
        """Coefficients (order^2, 3) of the intensity over functions sqrt(4 pi) y_k of the world's directions, W/sr.

        Coefficient 0 is the emitted power over 4 pi at every order and with every window. negative: how far below zero
        the truncated pattern may go, as a share of the lamp's peak, before its bands are damped (`remove_ringing`).
        """
        shares = self._shares(order)
        if order > 1 and shares[0] > 0.0:
            shares = shares * expand_bands(_window(shares, negative))
        return shares[:, None] * self.peak_intensity

    def explained(self, order: int, negative: float = NEGATIVE) -> float:
        """The share of the pattern's energy (integral of the squared intensity) that `emission(order, negative)` holds:
        1 minus the squared error over the whole; 1 for a lamp that gives no light."""
        directions, weights = self._rule()
        whole = float(np.sum(weights * self.pattern(directions) ** 2))
        plain = self._shares(order)
        kept = plain * expand_bands(_window(plain, negative)) if order > 1 and plain[0] > 0.0 else plain
        return 4.0 * math.pi * float(np.sum((2.0 * plain - kept) * kept)) / whole if whole > 0.0 else 1.0

    def _shares(self, order: int) -> Array:
        """Coefficients (order^2,) of the pattern itself: (1 / 4 pi) integral of pattern sqrt(4 pi) y_k."""
        directions, weights = self._rule()
        values = multiply(evaluate(order, directions).T, (self.pattern(directions) * weights)[:, None])[:, 0]
        return values / math.sqrt(4.0 * math.pi)

    def _rule(self) -> tuple[Array, Array]:
        """World directions (q, 3) and weights (q,) that integrate functions of direction over the lamp's emission.

        The rule runs over angles in the lamp's own space, where the pattern is smooth between a few angles; turning a
        solid angle there into one of the world costs the Jacobian |det M| / |M s|^3.
        """
        local, weights = _product_rule(self._kinks())
        if self.kind == "spot":
            linear = self._shape
            turned = multiply(local, linear.T)
            length = np.sqrt(np.sum(turned ** 2, axis=1))
            determinant = abs(float(np.sum(np.cross(linear[:, 0], linear[:, 1]) * linear[:, 2])))
            return turned / length[:, None], weights * determinant / length ** 3
        frame = _frame(self.axis)
        return multiply(-local, frame), weights  # local -Z is the frame's third row

    def _kinks(self) -> list[float]:
        """Cosines to the axis between which the pattern is smooth, from the edge of the light to the axis."""
        if self.kind == "point":
            return [-1.0, 1.0]
        if self.kind == "area":
            return [math.cos(0.5 * max(self.spread, LEAST_SPREAD)), 1.0]
        edge = math.cos(0.5 * self.spot_angle)
        inner = edge + (1.0 - edge) * self.spot_blend
        return [edge, inner, 1.0] if edge < inner < 1.0 else [edge, 1.0]


def _invertible(linear: Array) -> tuple[Array, Array]:
    """The matrix (3, 3) over its largest stretch and the inverse of that.

    Stretches below FLATTEST are raised to it, so a lamp that a scale of zero flattens gets the thinnest cone that can
    be reckoned with; scaled to nothing altogether, it keeps its shape and shines along -Z.
    """
    left, stretches, right = linalg.svd(linear)
    if not stretches[0] > 0.0:
        return np.eye(3), np.eye(3)
    stretches = np.maximum(stretches / stretches[0], FLATTEST)
    return (left * stretches) @ right, (right.T / stretches) @ left.T  # small


def _window(shares: Array, negative: float) -> Array:
    """Factors per band (order,) that keep a pattern of peak 1 above -negative."""
    return remove_ringing(np.repeat(shares[:, None], 3, axis=1), negative / float(shares[0])).factors


def spot_pattern(cosine: NDArray[np.floating], angle: float, blend: float) -> NDArray[np.floating]:
    """A Spot's intensity as a share of its peak, by the cosine to its axis in its own space.

    A cubic step 3 t^2 - 2 t^3 with t = (cos - cos(angle / 2)) / (blend (1 - cos(angle / 2))) held in 0..1: found by
    fitting Cycles (largest difference 3e-5 over cones of 5 to 180 degrees and blends 0.15, 0.5 and 1).
    """
    edge = math.cos(0.5 * angle)
    width = blend * (1.0 - edge)
    if width < 1e-7:  # below the resolution of single-precision cosines: a hard edge
        return (cosine > edge).astype(cosine.dtype)
    step = np.clip((cosine - edge) * (1.0 / width), 0.0, 1.0)
    return step * step * (3.0 - 2.0 * step)


def spread_factor(spread: float) -> float:
    """Radiance along the axis of an Area light of some spread over that of full spread.

    A soft-box: its grid lets 1 - tan a / tan(spread / 2) of the face be seen at an angle a to the axis, and keeps the
    power. The integral of that share times cos a over the hemisphere is pi (1 - h / tan h), h = spread / 2.
    """
    half = 0.5 * max(spread, LEAST_SPREAD)
    return 1.0 / (1.0 - half / math.tan(half)) if half < 0.5 * math.pi - 1e-6 else 1.0


def spread_pattern(cosine: NDArray[np.floating], spread: float) -> NDArray[np.floating]:
    """The share of an Area's face that its grid lets be seen, by the cosine to its axis; see `spread_factor`."""
    half = 0.5 * max(spread, LEAST_SPREAD)
    if half >= 0.5 * math.pi - 1e-6:
        return (cosine > 0.0).astype(cosine.dtype)
    safe = np.maximum(cosine, 1e-6)  # behind the face nothing is seen: the tangent is beyond any grid's
    tangent = np.sqrt(np.maximum(1.0 - safe * safe, 0.0)) / safe
    return np.maximum(1.0 - tangent * (1.0 / math.tan(half)), 0.0)


def _cosines(directions: Array, axis: ArrayLike) -> Array:
    """Cosines (n,) between directions of any length and a unit axis; 0 for a direction of no length."""
    length = np.sqrt(np.sum(directions ** 2, axis=1))
    along = np.sum(directions * np.asarray(axis, np.float64), axis=1)
    return np.divide(along, length, out=np.zeros_like(length), where=length > 0.0)


def _frame(axis: Array) -> Array:
    """Rows: two directions across and the unit axis."""
    helper = np.eye(3)[int(np.argmin(np.abs(axis)))]
    across = np.cross(helper, axis)
    across /= math.sqrt(float(np.sum(across ** 2)))
    return np.stack([across, np.cross(axis, across), axis])


def _product_rule(kinks: list[float]) -> tuple[Array, Array]:
    """Directions (q, 3) about -Z and weights (q,): Gauss rules between angles to -Z, even azimuths around it.

    kinks: the cosines of those angles. In angles both the cubic step of a cosine and the tangent of a grid are smooth.
    """
    nodes, weights = np.polynomial.legendre.leggauss(NODES)
    angles = np.arccos(np.clip(kinks, -1.0, 1.0))
    highs, lows = angles[:-1, None], angles[1:, None]
    angle = (0.5 * (lows + highs) + 0.5 * (highs - lows) * nodes).ravel()
    sine = np.sin(angle)
    weight = (0.5 * (highs - lows) * weights).ravel() * sine * (2.0 * math.pi / AZIMUTHS)
    azimuth = 2.0 * math.pi * np.arange(AZIMUTHS) / AZIMUTHS
    directions = np.stack([sine[:, None] * np.cos(azimuth), sine[:, None] * np.sin(azimuth),
                           np.broadcast_to(-np.cos(angle)[:, None], (len(angle), AZIMUTHS))], axis=2)
    return directions.reshape(-1, 3), np.repeat(weight, AZIMUTHS)
