# SPDX-License-Identifier: GPL-3.0-or-later
"""Reflection models as quadratures: where light scatters to from a view direction, and how much.

Everything in the local frame of a point: x tangent, y bitangent, z normal. A model answers for view directions v with
directions s_q and weights W_q such that, for incident radiance L over the hemisphere,

    integral of f(v, s) L(s) cos(s) ds  =  sum_q W_q L(s_q).

The nodes follow the lobe (they are the lobe's own sampling density), so that roughness 0.05 needs no more of them than
roughness 1. GGX with Smith's height-correlated masking, Fresnel and the energy of several bounces between facets as
Blender's Principled BSDF has them in Cycles 5.2, so that Cycles is the reference picture.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from ..basis.hemisphere import heights, meridian
from ..linear_algebra import row_squares
from ..scene.surface_material import SurfaceMaterial

Array = NDArray[np.float64]

# GGX below this is treated as this: a mirror's lobe has no square integral. Far below what any order resolves.
_SMALLEST_ALPHA = 1e-4
# A specular level so high that F0 passes this is cut, as Cycles does: the IOR of F0 = 1 is infinite.
_HIGHEST_F0 = 0.99
# Nodes over a lobe: moments up to order 10 are then within 5e-4 of those of many more nodes, relative RMS over views,
# for roughness 0.05..1 and anisotropy up to 0.8 (tests/core/test_brdf.py).
POLAR, AZIMUTH = 40, 40
# Steps to find where an angle lies, then halvings: to 5e-5, far below the distance of two nodes.
_STEPS, _BISECTIONS = 16, 12
# Heights of views between which the albedo of a single bounce is interpolated where there are many views.
LEVELS = 128


@dataclass(frozen=True)
class Scattered:
    """directions (n, q, 3); weights (n, q, c), 0 below the horizon; kernel (n, q, c): f(v, s) cos(s) at the nodes."""

    directions: Array
    weights: Array
    kernel: Array


class Lobe(Protocol):
    """A reflection model. isotropic: whether turns about z change nothing. turn: radians by which the lobe's own x
    axis is turned from the tangent (only anisotropic ones). channels: 1 or 3."""

    isotropic: bool
    turn: float
    channels: int

    def scatter(self, views: Array, polar: int = POLAR, azimuth: int = AZIMUTH) -> Scattered:
        """Nodes for views (n, 3) in the lobe's own frame."""


@dataclass(frozen=True)
class _Stretch:
    """Views (n, 3) of a lobe and the same in the frame in which its facets are those of a sphere."""

    alphas: Array
    views: Array
    stretched: Array

    def facet_normals(self, cap: Array) -> Array:
        """Unit facet normals (n, q, 3) that mirror the stretched views to `cap` (n, q, 3)."""
        normals = cap + self.stretched[:, None, :]
        normals *= self.alphas
        normals /= np.maximum(np.sqrt(row_squares(normals)), 1e-300)[..., None]
        return normals

    def lights(self, normals: Array) -> tuple[Array, Array]:
        """The views mirrored at facets: directions (n, q, 3), and the cosine between facet and view (n, q)."""
        cosines = np.sum(normals * self.views[:, None, :], axis=-1)
        return 2 * cosines[..., None] * normals - self.views[:, None, :], cosines


def _stretch(alpha_x: float, alpha_y: float, views: Array) -> _Stretch:
    alphas = np.array([alpha_x, alpha_y, 1.0])
    stretched = views * alphas
    return _Stretch(alphas, views, stretched / np.sqrt(row_squares(stretched))[:, None])


def _polar(angle: Array, phi: Array) -> Array:
    """Directions (..., 3) from the angle to +Z and the azimuth."""
    sine = np.sin(angle)
    return np.stack([sine * np.cos(phi), sine * np.sin(phi), np.broadcast_to(np.cos(angle), sine.shape)], axis=-1)


def _cap_ends(stretch: _Stretch, phi: Array) -> Array:
    """For every view and azimuth phi (a,) the angle from +Z (n, a) at which the cap ends: at the facets that a view
    can just see, or where the mirrored light would come from below the horizon.

    Light from there weighs nothing, but with a kink that Gauss-Legendre would have to cut across (1e-3 of error), so
    it is found first: +Z itself always mirrors to a direction above, the rim to one below. At grazing views of smooth
    lobes there can be three crossings; the outermost one is taken, and what lies below before it weighs nothing.
    """
    rim = np.broadcast_to(np.arccos(-stretch.stretched[:, 2])[:, None], (len(stretch.views), len(phi)))

    def is_above(angle: Array) -> NDArray[np.bool_]:
        return stretch.lights(stretch.facet_normals(_polar(angle, phi)))[0][..., 2] > 0

    low, high = np.zeros(rim.shape), np.array(rim)
    for share in np.sin(np.linspace(0, np.pi / 2, _STEPS + 2)[1:-1]):  # denser towards the rim
        angle = rim * share
        above = is_above(angle)
        low, high = np.where(above, angle, low), np.where(above, rim, np.where(high == rim, angle, high))
    for _ in range(_BISECTIONS):
        middle = (low + high) / 2
        above = is_above(middle)
        low, high = np.where(above, middle, low), np.where(above, high, middle)
    return low


def _cap(stretch: _Stretch, polar: int, azimuth: int) -> tuple[Array, Array]:
    """Directions (n, polar * azimuth, 3) of the views' caps down to their `_cap_ends`, and their share (n, q) of the
    whole cap of visible facets.

    Gauss-Legendre in the polar angle: in z the nodes would meet the square root of 1 - z at the pole.
    """
    nodes, weights = heights(polar)
    phi = 2 * np.pi * (np.arange(azimuth) + 0.5) / azimuth
    ends = _cap_ends(stretch, phi)[:, None, :]
    angle = ends * nodes[:, None]
    share = ends * weights[:, None] * np.sin(angle) / (1 + stretch.stretched[:, 2])[:, None, None] / azimuth
    count = len(stretch.views)
    return _polar(angle, phi).reshape(count, -1, 3), share.reshape(count, -1)


def _smith_lambda(alpha_x: float, alpha_y: float, directions: Array) -> Array:
    """Lambda of Smith's masking for GGX.

    Heitz, Understanding the Masking-Shadowing Function in Microfacet-Based BRDFs (JCGT 2014), eqs. 72 and 86.
    """
    x, y, z = np.moveaxis(directions, -1, 0)
    slope = ((alpha_x * x) ** 2 + (alpha_y * y) ** 2) / np.maximum(z, 1e-12) ** 2  # horizon: masked altogether
    return (np.sqrt(1 + slope) - 1) / 2


@dataclass(frozen=True)
class Facets:
    """What the nodes of a view meet: light directions (n, q, 3), the share of the view's facets that they stand for
    times the light that leaves unblocked (n, q), the cosine between facet and view (n, q), the share alone (n, q, 0
    below the horizon), and distribution times masking over 4 cos(view), i.e. f cos without Fresnel (n, q)."""

    lights: Array
    unblocked: Array
    cosines: Array
    share: Array
    kernel: Array


def visible_facets(alpha_x: float, alpha_y: float, views: Array, polar: int = POLAR, azimuth: int = AZIMUTH) -> Facets:
    """GGX facets seen from views (n, 3).

    Dupuy & Benyoub, Sampling Visible GGX Normals with Spherical Caps (2023): in the frame stretched by alpha, light
    mirrored at a visible facet is uniform over a cap, a smooth map without corners, made here a quadrature. The
    weight that is left is masking G2 / G1 <= 1 (Heitz 2018, eq. 19).
    """
    stretch = _stretch(alpha_x, alpha_y, views)
    cap, share = _cap(stretch, polar, azimuth)
    normals = stretch.facet_normals(cap)
    lights, cosines = stretch.lights(normals)
    share = np.where(lights[..., 2] > 0, share, 0.0)
    of_view = _smith_lambda(alpha_x, alpha_y, views)[:, None]
    masking = 1 / (1 + of_view + _smith_lambda(alpha_x, alpha_y, lights))
    kernel = _distribution(alpha_x, alpha_y, normals) * masking / (4 * views[:, None, 2])
    return Facets(lights, share * masking * (1 + of_view), np.clip(cosines, 0.0, 1.0), share,
                  np.where(share > 0, kernel, 0.0))


def _distribution(alpha_x: float, alpha_y: float, normals: Array) -> Array:
    """GGX density of facet normals. Heitz 2014, eq. 85."""
    x, y, z = np.moveaxis(normals, -1, 0)
    length = (x / alpha_x) ** 2 + (y / alpha_y) ** 2 + z ** 2
    return 1 / (np.pi * alpha_x * alpha_y * length ** 2)


def single_bounce_albedo(alpha: float, z: Array) -> Array:
    """Share of light (n,) that isotropic GGX without Fresnel returns after one bounce to views at heights z (n,)."""
    return visible_facets(alpha, alpha, meridian(z)).unblocked.sum(axis=1)


def mean_albedo(alpha: float) -> float:
    """The mean of `single_bounce_albedo` weighted by cosines: 2 times the integral of E(z) z."""
    z, weights = heights(16)
    return float(2 * np.sum(weights * z * single_bounce_albedo(alpha, z)))


def dielectric_fresnel(cosines: Array, ior: float) -> Array:
    """Unpolarised reflectance of a dielectric (Fresnel's equations), 1 where reflection is total."""
    square = ior * ior - 1 + cosines * cosines
    root = np.sqrt(np.maximum(square, 0.0))  # negative: total reflection, below
    perpendicular = (cosines - root) / (cosines + root + 1e-300)
    parallel = (root - ior * ior * cosines) / (root + ior * ior * cosines + 1e-300)
    return np.where(square <= 0, 1.0, (perpendicular ** 2 + parallel ** 2) / 2)


def normal_reflectance(ior: float) -> float:
    """F0 = ((ior - 1) / (ior + 1))^2."""
    return ((ior - 1) / (ior + 1)) ** 2


@dataclass(frozen=True)
class Dielectric:
    """The Principled BSDF's reflection above its diffuse layer: Fresnel's curve of an IOR, moved to start at f0 (3,).

    Made by `dielectric_of`. ior: that whose own F0 is that of the material with its specular level.
    """

    ior: float
    f0: Array

    def rise(self, cosines: Array) -> Array:
        """How far from f0 (0) to white (1) the curve is at these cosines."""
        base = normal_reflectance(self.ior)
        # Rounding dips below 0 at the normal; IORs below 1 have no lower value either.
        return np.clip((dielectric_fresnel(cosines, self.ior) - base) / (1 - base), 0.0, 1.0)

    def reflectance(self, cosines: Array) -> Array:
        """(..., 3)."""
        return self.f0 + (1 - self.f0) * self.rise(cosines)[..., None]

    def mean(self) -> Array:
        """Mean reflectance (3,) over the cosine-weighted hemisphere.

        Fits of Kulla & Conty, Revisiting Physically Based Shading at Imageworks (2017), as Cycles has them.
        """
        ior = self.ior
        if ior >= 1:
            average = (ior - 1) / (4.08567 + 1.00071 * ior)
        else:
            average = 0.997118 + 0.1014 * ior - 0.965241 * ior ** 2 - 0.130607 * ior ** 3
        base = normal_reflectance(ior)
        rise = min(max((average - base) / (1 - base), 0.0), 1.0)  # as Cycles: the fit can leave the range near ior 1
        return self.f0 + (1 - self.f0) * rise


def dielectric_of(material: SurfaceMaterial) -> Dielectric | None:
    """The dielectric layer, or None where it reflects nothing."""
    f0 = normal_reflectance(material.ior) * 2 * material.specular_level
    if f0 <= 0:
        return None
    root = math.sqrt(min(f0, _HIGHEST_F0))
    ior = (1 + root) / (1 - root)
    return Dielectric(1 / ior if material.ior < 1 else ior, np.minimum(f0 * np.asarray(material.specular_tint), 1.0))


@dataclass(frozen=True)
class Metal:
    """Schlick's curve from f0 (3,) with an edge darkened by b (3,): F82-tint.

    Kutz, Hasan, Edmondson, Novel Aspects of the Adobe Standard Material (2023), section 2.3; made by `metal_of`.
    """

    f0: Array
    b: Array

    def reflectance(self, cosines: Array) -> Array:
        """(..., 3)."""
        away = 1 - cosines[..., None]
        schlick = self.f0 + (1 - self.f0) * away ** 5
        return np.clip(schlick - self.b * cosines[..., None] * away ** 6, 0.0, 1.0)  # as Cycles

    def mean(self) -> Array:
        """Mean reflectance (3,) over the cosine-weighted hemisphere: exact where nothing was cut."""
        return self.f0 + (1 - self.f0) / 21 - self.b / 126


def metal_of(material: SurfaceMaterial) -> Metal:
    """The metallic layer: at cosine 1/7 (82 degrees) Schlick's value is multiplied by the specular tint."""
    f0 = np.clip(np.asarray(material.base_colour, np.float64), 0.0, 1.0)  # as Cycles
    tint = np.minimum(np.asarray(material.specular_tint, np.float64), 1.0)
    away = 6 / 7
    return Metal(f0, (f0 + (1 - f0) * away ** 5) * 7 / away ** 6 * (1 - tint))


def alphas_of(material: SurfaceMaterial) -> tuple[float, float]:
    """GGX alpha along the turned tangent and across it: roughness^2, stretched by the anisotropy, at most 1."""
    aspect = math.sqrt(1 - 0.9 * min(max(material.anisotropic, 0.0), 1.0))
    alpha = min(max(material.roughness, 0.0), 1.0) ** 2
    return (min(max(alpha / aspect, _SMALLEST_ALPHA), 1.0), min(max(alpha * aspect, _SMALLEST_ALPHA), 1.0))


@dataclass(frozen=True)
class Energy:
    """Single-bounce albedo (n,) of the views, and its mean: what several bounces between facets must bring back."""

    albedo: Array
    mean: float

    def compensation(self, fresnel: Array) -> Array:
        """Factors (n, 3) on the single bounce, for a mean reflectance (3,).

        Kulla & Conty 2017, appendix; as in Cycles it depends on the view alone: a white metal returns exactly the
        light of a uniform surrounding, but the model is not reciprocal.
        """
        several = fresnel * self.mean / (1 - fresnel * (1 - self.mean))
        return 1 + several * ((1 - self.albedo) / self.albedo)[:, None]


def energy_of(alpha_x: float, alpha_y: float, views: Array) -> Energy:
    """Cycles takes the isotropic lobe of alpha = sqrt(alpha_x alpha_y) for this, so an anisotropic white metal is not
    exactly white there either."""
    alpha = math.sqrt(alpha_x * alpha_y)
    levels, place = np.unique(views[:, 2], return_inverse=True)
    return Energy(single_bounce_albedo(alpha, levels)[place.reshape(-1)], mean_albedo(alpha))


class PrincipledLobe:
    """The metallic and the dielectric reflection of a material; its diffuse and subsurface layers are not in it."""

    def __init__(self, material: SurfaceMaterial, compensate: bool = True) -> None:
        """compensate: with the energy of several bounces between facets (Cycles' Multiscatter GGX, the default)."""
        self.alpha_x, self.alpha_y = alphas_of(material)
        self.isotropic = self.alpha_x == self.alpha_y
        self.turn = 0.0 if self.isotropic else 2 * math.pi * material.anisotropic_rotation
        self.compensate = compensate
        self._levels: tuple[Array, Energy] | None = None
        self.metallic = min(max(material.metallic, 0.0), 1.0)
        layers: list[tuple[float, Metal | Dielectric]] = []
        if self.metallic > 0:
            layers.append((self.metallic, metal_of(material)))
        self.dielectric = dielectric_of(material) if self.metallic < 1 else None
        if self.dielectric is not None:
            layers.append((1 - self.metallic, self.dielectric))
        self.layers = layers
        grey = all(np.ptp(array) == 0 for _, layer in layers for array in _colours(layer))
        self.channels = 1 if grey else 3

    def scatter(self, views: Array, polar: int = POLAR, azimuth: int = AZIMUTH) -> Scattered:
        """See `Lobe`."""
        facets = visible_facets(self.alpha_x, self.alpha_y, views, polar, azimuth)
        reflectance = np.zeros((*facets.cosines.shape, self.channels))
        energy = energy_of(self.alpha_x, self.alpha_y, views) if self.compensate else None
        for weight, layer in self.layers:
            part = weight * layer.reflectance(facets.cosines)
            if energy is not None:
                part *= energy.compensation(layer.mean())[:, None, :]
            reflectance += part[..., :self.channels]
        return Scattered(facets.lights, facets.unblocked[..., None] * reflectance,
                         facets.kernel[..., None] * reflectance)

    def kernel(self, views: Array, lights: Array) -> Array:
        """f(v, s) cos(s) (n, m, c) of views (n, 3) and lights (m, 3) above the horizon, in the lobe's own frame."""
        half = views[:, None, :] + lights
        half /= np.sqrt(row_squares(half))[..., None]
        cosines = np.clip(np.sum(half * views[:, None, :], axis=-1), 0.0, 1.0)
        alphas = self.alpha_x, self.alpha_y
        masking = 1 / (1 + _smith_lambda(*alphas, views)[:, None] + _smith_lambda(*alphas, lights))
        facets = _distribution(*alphas, half) * masking / (4 * views[:, None, 2])
        energy = self._energy_between_levels(views[:, 2]) if self.compensate else None
        result = np.zeros((*facets.shape, self.channels))
        for weight, layer in self.layers:
            part = weight * layer.reflectance(cosines)
            if energy is not None:
                part *= energy.compensation(layer.mean())[:, None, :]
            result += part[..., :self.channels]
        return result * facets[..., None]

    def _energy_between_levels(self, z: Array) -> Energy:
        """`energy_of` many views at heights z (n,), interpolated between LEVELS."""
        if self._levels is None:
            levels = np.linspace(0.0, 1.0, LEVELS + 1)
            levels[0] = 1e-4
            self._levels = levels, energy_of(self.alpha_x, self.alpha_y, meridian(levels))
        levels, energy = self._levels
        return Energy(np.interp(z, levels, energy.albedo), energy.mean)

    def dimming(self, views: Array) -> Array:
        """What the dielectric leaves of the diffuse layer (n,) towards views (n, 3): 1 - its albedo there.

        As Cycles: the albedo is f0 + (1 - f0) s with s the mean rise of Fresnel's curve over visible facets whose
        light leaves upwards, at the isotropic roughness; of a tinted layer the brightest channel counts for all.
        """
        if self.dielectric is None:
            return np.ones(len(views))
        energy = energy_of(self.alpha_x, self.alpha_y, views)
        alpha = math.sqrt(self.alpha_x * self.alpha_y)
        levels, place = np.unique(views[:, 2], return_inverse=True)
        facets = visible_facets(alpha, alpha, meridian(levels))
        rise = np.sum(facets.share * self.dielectric.rise(facets.cosines), axis=1)[place.reshape(-1), None]
        f0 = self.dielectric.f0
        # Of the compensation Cycles counts here only the loss of colour and light, not the gain of 1 / E.
        loss = energy.compensation(self.dielectric.mean()) * energy.albedo[:, None]
        albedo = loss * (f0 + (1 - f0) * rise)
        return np.clip(1 - albedo.max(axis=1), 0.0, 1.0)  # as Cycles: a layer can't take more than there is


def _colours(layer: Metal | Dielectric) -> tuple[Array, ...]:
    return (layer.f0, layer.b) if isinstance(layer, Metal) else (layer.f0,)


@dataclass(frozen=True)
class PhongLobe:
    """Phong's lobe (exponent + 2) / (2 pi) cos^exponent about the mirror direction, for unit albedo at the normal.

    Lafortune & Willems, Using the Modified Phong Reflectance Model for Physically Based Rendering (1994).
    """

    exponent: float
    colour: tuple[float, ...] = (1.0,)
    isotropic = True
    turn = 0.0

    @property
    def channels(self) -> int:
        """1 or 3, as many as the colour has."""
        return len(self.colour)

    def scatter(self, views: Array, polar: int = POLAR, azimuth: int = AZIMUTH) -> Scattered:
        """See `Lobe`. With u = cos^(exponent + 1) the lobe is uniform in u; Gauss-Legendre in the square root of
        1 - u, which is smooth at the axis."""
        nodes, weights = heights(polar)
        u = 1 - nodes ** 2
        cosine = u ** (1 / (self.exponent + 1))
        sine = np.sqrt(np.maximum(1 - cosine ** 2, 0.0))  # rounding at the axis
        phi = 2 * np.pi * (np.arange(azimuth) + 0.5) / azimuth
        local = np.stack([np.outer(sine, np.cos(phi)), np.outer(sine, np.sin(phi)),
                          np.repeat(cosine[:, None], azimuth, axis=1)], axis=-1).reshape(-1, 3)
        mirror = views * np.array([-1.0, -1.0, 1.0])
        lights = _about(mirror, local)
        share = np.repeat(2 * nodes * weights / azimuth, azimuth)  # of the lobe, sum 1
        above = np.maximum(lights[..., 2], 0.0)  # below the horizon no light comes in
        scale = (self.exponent + 2) / (self.exponent + 1)
        lobe = (self.exponent + 2) / (2 * np.pi) * np.repeat(cosine ** self.exponent, azimuth)
        colour = np.asarray(self.colour)
        return Scattered(lights, (scale * share * above)[..., None] * colour, (lobe * above)[..., None] * colour)


def _about(axes: Array, local: Array) -> Array:
    """Local directions (q, 3) with +Z turned onto each axis (n, 3): (n, q, 3). The tangent lies in the plane of the
    axis and z, so that mirror images of axes have mirror images of directions."""
    x, y, z = axes.T
    radius = np.hypot(x, y)
    safe = np.where(radius > 0, radius, 1.0)
    cosine, sine = np.where(radius > 0, x / safe, 1.0), np.where(radius > 0, y / safe, 0.0)
    tangent = np.stack([z * cosine, z * sine, -radius], axis=1)
    bitangent = np.stack([-sine, cosine, np.zeros_like(sine)], axis=1)
    return (local[:, :1] * tangent[:, None] + local[:, 1:2] * bitangent[:, None] + local[:, 2:] * axes[:, None])
