# SPDX-License-Identifier: GPL-3.0-or-later
"""Matrices of a material's reflection between spherical harmonics over the hemisphere, built once per material.

Sloan et al. 2003, eq. 1: M_p = A^-1 B A^-1 R_p T_p with B_ij = double integral over H of y_i(v) f(v, s) cos(s) y_j(s).
A^-1 stands for the truncated A^+ of `basis.hemisphere`. Two matrices leave this module:

outgoing  L = A^+ B, rows x incident functions. It takes incident radiance as coefficients l with
          L_in(s) = sum_j l_j y_j(s) on H: distant light turned into the local frame, before anything shadows it.
K = L A^+ (`reflection_matrix`), the paper's, takes traced radiance as plain integrals b_j = integral over H of L_in y_j
          and fits radiance to them first.

L may also be given plain integrals (the paper's zero-hemisphere projection): errors of b then come through least, but
what f cos has beyond the incident order is lost. Measured (lights of order 5 behind random half-space occluders, 25
rows, relative RMS over views at roughness 0.3 / 0.5 / 0.8): incident order 5: L 0.205 / 0.087 / 0.019, K 0.132 / 0.057
/ 0.008; order 8: L 0.126 / 0.051 / 0.008, K 0.121 / 0.050 / 0.006. So: K up to incident order 6, either from order 8.

The matrices are for unit light, hold all of f (coloured where it is: a last axis of 1 or 3 channels) and come in the
point's own frame: x tangent, y bitangent, z normal; an anisotropic lobe's rotation is in them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from ..basis import hemisphere, spherical_harmonics
from ..basis.hemisphere import Indices
from ..linear_algebra import batched_multiply, multiply
from ..scene.surface_material import SurfaceMaterial
from .reflectance import AZIMUTH, POLAR, Lobe, PrincipledLobe

Array = NDArray[np.float64]

# Smallest eigenvalue of A that is inverted on the incident side, where integrals are traced: errors of b along an
# eigenvector with eigenvalue e may grow by 1 / sqrt(e). At roughness 0.3, order 5, white noise in b leaves L 3.0, K
# with this limit 4.6, with 1e-3 9.7 and with all of A^-1 154 times as large, while the fit is hardly better (0.132,
# 0.126, 0.124 for the case in the docstring).
INCIDENT = 1e-2
# Heights of view directions, and azimuths in the quarter circle of an anisotropic lobe.
VIEW_HEIGHTS, VIEW_AZIMUTHS = 24, 8
# Light directions evaluated at once: at order 10, 26 MB of basis values.
_BLOCK = 32768


@dataclass(frozen=True)
class Views:
    """A quadrature of view directions (n, 3), weights (n,), that leans on a lobe's symmetry.

    Isotropic: one meridian (weights sum to 1); a function of azimuth m goes with cos(m phi) or sin(m phi) on both
    sides, so only equal m couple, and `circle` (k,) is the integral around. Else a quarter (weights sum to 2 pi):
    only functions equal under both mirror symmetries couple.
    """

    directions: Array
    weights: Array
    isotropic: bool

    def values(self, functions: Indices) -> Array:
        """(n, k); on the meridian sin(m phi) is replaced by cos(m phi): same profile."""
        bands, azimuths = hemisphere.bands_of(functions)
        profile = bands * (bands + 1) + (np.abs(azimuths) if self.isotropic else azimuths)
        return spherical_harmonics.evaluate(hemisphere.order_of(functions), self.directions)[:, profile]

    def circle(self, functions: Indices) -> Array:
        """Factors (k,) of an integral over H of a product with functions."""
        _, azimuths = hemisphere.bands_of(functions)
        return np.where(azimuths == 0, 2 * np.pi, np.pi) if self.isotropic else np.ones(len(functions))

    def couple(self, functions: Indices, others: Indices) -> NDArray[np.bool_]:
        """(k, n): whether the integral of a function with the reflection of another can be other than zero."""
        _, first = hemisphere.bands_of(functions)
        _, second = hemisphere.bands_of(others)
        if self.isotropic:
            return first[:, None] == second
        return ((first < 0)[:, None] == (second < 0)) & ((first[:, None] - second) % 2 == 0)


def views_for(isotropic: bool, height_count: int = VIEW_HEIGHTS, azimuth_count: int = VIEW_AZIMUTHS) -> Views:
    """See `Views`. Gauss-Legendre in z, even steps in azimuth."""
    z, weights = hemisphere.heights(height_count)
    if isotropic:
        return Views(hemisphere.meridian(z), weights, True)
    phi = np.pi / 2 * (np.arange(azimuth_count) + 0.5) / azimuth_count
    radius = np.sqrt((1 - z) * (1 + z))
    directions = np.stack([np.outer(radius, np.cos(phi)), np.outer(radius, np.sin(phi)),
                           np.repeat(z[:, None], azimuth_count, axis=1)], axis=-1).reshape(-1, 3)
    return Views(directions, np.repeat(weights * 2 * np.pi / azimuth_count, azimuth_count), False)


@dataclass(frozen=True)
class Reflection:
    """What a lobe makes of each incident function, at a quadrature of views: everything else follows from it.

    radiance (n, order^2, c): integral of f(v, s) cos(s) y_j(s) ds in the lobe's own frame; squares (n, c): integral of
    (f cos)^2, all of it; turn: of the lobe's frame about z.

    The shares are squared errors over the pixels that show a convex body: views weighted by their cosine. (The fit
    itself weighs all views alike, as the paper's; grazing views of a dielectric would drown all others here.)
    """

    views: Views
    order: int
    radiance: Array
    squares: Array
    turn: float

    @property
    def channels(self) -> int:
        """1 or 3."""
        return self.radiance.shape[2]

    def integrals(self, functions: Indices) -> Array:
        """B (k, order^2, c) in the lobe's own frame."""
        incident = np.arange(self.order ** 2)
        rows = self.views.values(functions) * self.views.weights[:, None]
        flat = self.radiance.reshape(len(rows), -1)
        product = multiply(np.ascontiguousarray(rows.T), flat).reshape(len(functions), -1, self.channels)
        factor = self.views.couple(functions, incident) * self.views.circle(incident)
        return product * factor[:, :, None]

    def _over_pixels(self, radiance: Array) -> Array:
        """Integral over H of the squares of (n, order^2, c) times the view's cosine, summed over lights: (c,)."""
        pixels = self.views.weights * self.views.directions[:, 2]
        squares = np.sum(radiance ** 2 * pixels[:, None, None], axis=0)
        return np.sum(squares * self.views.circle(np.arange(self.order ** 2))[:, None], axis=0)

    def albedo(self) -> Array:
        """(c,): exit radiance in a white surrounding, the mean over pixels."""
        pixels = self.views.weights * self.views.directions[:, 2]
        return np.sum(self.radiance[:, 0] * math.sqrt(4 * math.pi) * pixels[:, None], axis=0) / pixels.sum()

    def held_by_light(self) -> float:
        """Share of the lobe's squared integral over pixels and lights that light of this order meets (0..1)."""
        pixels = self.views.weights * self.views.directions[:, 2] * (2 * np.pi if self.views.isotropic else 1.0)
        return _share(self._over_pixels(self.radiance), np.sum(self.squares * pixels[:, None], axis=0))

    def held_by_rows(self, functions: Indices) -> float:
        """1 - squared relative error of these rows under light of this order, over pixels (0..1)."""
        coefficients = hemisphere.hemisphere_basis(functions).fit(self.integrals(functions))
        flat = multiply(self.views.values(functions), coefficients.reshape(len(functions), -1))
        whole = self._over_pixels(self.radiance)
        return _share(whole - self._over_pixels(self.radiance - flat.reshape(self.radiance.shape)), whole)


def _share(part: Array, whole: Array) -> float:
    """Part of whole over all channels. Quadratures differ by 1e-4, which must not show as more than everything; a fit
    that weighs grazing views more than pixels do may be worse than black over pixels, which is nothing held."""
    total = float(whole.sum())
    return min(max(float(part.sum()) / total, 0.0), 1.0) if total > 0 else 1.0


def reflection_of(lobe: Lobe, order: int, polar: int = POLAR, azimuth: int = AZIMUTH, views: Views | None = None,
                  ) -> Reflection:
    """Integrate a lobe against all functions of `order` (1..10 and more), in blocks of views."""
    views = views_for(lobe.isotropic) if views is None else views
    functions = np.arange(order ** 2)
    bands, azimuths = hemisphere.bands_of(functions)
    count = len(views.directions)
    radiance = np.empty((count, len(functions), lobe.channels))
    squares = np.empty((count, lobe.channels))
    step = max(1, _BLOCK // (polar * azimuth))
    for start in range(0, count, step):
        block = slice(start, min(start + step, count))
        scattered = lobe.scatter(views.directions[block], polar, azimuth)
        values = spherical_harmonics.evaluate(order, scattered.directions.reshape(-1, 3))
        values = values.reshape(*scattered.weights.shape[:2], -1)
        radiance[block] = batched_multiply(values.transpose(0, 2, 1), scattered.weights)
        squares[block] = np.sum(scattered.weights * scattered.kernel, axis=1)
    if views.isotropic:  # the profile of sin(m phi) is that of cos(m phi); on the meridian itself it is 0
        radiance = radiance[:, bands * (bands + 1) + np.abs(azimuths)]
    return Reflection(views, order, radiance, squares, lobe.turn)


def reflection_of_material(material: SurfaceMaterial, order: int) -> Reflection:
    """`reflection_of` the Principled BSDF's metallic and dielectric layers."""
    return reflection_of(PrincipledLobe(material), order)


def outgoing_matrix(reflection: Reflection, functions: Indices,
                    smallest: float = hemisphere.SINGLE_PRECISION) -> Array:
    """L = A^+ B (k, order^2, c): see the module's docstring for what it takes and when."""
    basis = hemisphere.hemisphere_basis(functions, smallest)
    return _turned(basis.fit(reflection.integrals(functions)), functions, reflection)


def reflection_matrix(reflection: Reflection, functions: Indices, incident: Indices | None = None,
                      smallest_incident: float = INCIDENT, smallest: float = hemisphere.SINGLE_PRECISION) -> Array:
    """K = A^+ B A^+ (k, len(incident), c), the paper's eq. 1: see the module's docstring.

    incident: all functions of the reflection's order unless given. smallest_incident: see INCIDENT; for integrals
    known to rounding `hemisphere.SINGLE_PRECISION` or lower.
    """
    incident = np.arange(reflection.order ** 2) if incident is None else np.asarray(incident, np.int64)
    whole = outgoing_matrix(reflection, functions, smallest)
    basis = hemisphere.hemisphere_basis(incident, smallest_incident)
    matrix = np.ascontiguousarray(np.moveaxis(basis.fit(np.moveaxis(whole[:, incident], 1, 0)), 0, 1))
    # What was not inverted is missing from a white surrounding too, some percent of a narrow lobe. The smallest change
    # that returns its light exactly is of rank one: no energy is made or lost.
    white = hemisphere.gram_matrix(np.union1d(incident, 0))[0, np.searchsorted(np.union1d(incident, 0), incident)]
    missing = whole[:, 0] - np.sum(matrix * white[:, None], axis=1)
    return matrix + missing[:, None] * (white / np.sum(white ** 2))[:, None]


def _turned(matrix: Array, functions: Indices, reflection: Reflection) -> Array:
    """The matrix of the lobe turned about z: f(R^-1 v, R^-1 s). Both sides turn, channel by channel."""
    if reflection.turn == 0.0:
        return matrix
    cosine, sine = math.cos(reflection.turn), math.sin(reflection.turn)
    turn = np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])
    rows = spherical_harmonics.rotation(hemisphere.order_of(functions), turn)[np.ix_(functions, functions)]
    columns = spherical_harmonics.rotation(reflection.order, turn)
    return np.stack([multiply(multiply(rows, np.ascontiguousarray(matrix[:, :, c])), np.ascontiguousarray(columns.T))
                     for c in range(matrix.shape[2])], axis=-1)


def explained(material: SurfaceMaterial, functions: Indices, order: int) -> float:
    """Share (0..1) of the highlight's squared integral over pixels and light directions that light of this order and
    these rows together can hold: 1 - squared relative error, small lights weighing as much as wide ones.

    Its factors are `Reflection.held_by_light` and `held_by_rows`; a mirror's share is 0.
    """
    reflection = reflection_of_material(material, order)
    return reflection.held_by_light() * reflection.held_by_rows(functions)


# A highlight whose mean albedo is below half a step of an 8-bit display changes no pixel.
INVISIBLE = 0.5 / 255
# Below this share of the lobe the picture would be a blur in place of a reflection: a metal below roughness 0.20 at
# order 5 and 0.18 at order 10, a dielectric (whose grazing reflections are sharper) below 0.28 and 0.25.
MIRROR = 0.05
# Rows are added until they hold this share of what the light's order can show (squared: 10 % RMS is left).
ENOUGH = 0.99
ROW_COUNTS = (1, 4, 9, 16, 24, 25)


# Negative lobe, relative to the peak, that a highlight may keep: about what the clamped cosine of diffuse light has, where
# nobody sees it.
DEEPEST_LOBE = 0.03
_PROFILE, _HALVINGS, _STRONGEST = 181, 24, 1.0


def ringing_window(reflection: Reflection, order: int) -> Array:
    """Factors per band (order,) on the light that a highlight reflects, so that its own profile does not ring below
    -DEEPEST_LOBE of its peak. All ones where light of this order holds it.

    Light cut at an order is negative beside every small bright source. Diffuse reflection blurs that away, a highlight
    sharper than the order shows it as black rings. The profile is that of the highlight seen along the normal, a
    function of one angle; of the windows the heat kernel loses least (see spherical_harmonics.window), and the weakest
    that suffices is found by bisection.
    """
    bands = np.arange(min(order, reflection.order))
    straight = int(np.argmax(reflection.views.directions[:, 2]))
    heights = np.cos(np.linspace(0.0, np.pi, _PROFILE))
    zonal = spherical_harmonics.evaluate(len(bands), hemisphere.meridian(heights))[:, bands * (bands + 1)]
    profile = reflection.radiance[straight][bands * (bands + 1)].mean(axis=1)

    def rings(strength: float) -> bool:
        factors = spherical_harmonics.window(len(bands), "heat", strength)
        shape = np.sum(zonal * (profile * factors), axis=1)
        return bool(shape.min() < -DEEPEST_LOBE * shape.max())

    if not rings(0.0):
        return np.ones(order)
    low, high = 0.0, _STRONGEST
    for _ in range(_HALVINGS):
        middle = (low + high) / 2
        low, high = (middle, high) if rings(middle) else (low, middle)
    return spherical_harmonics.window(order, "heat", high)


@dataclass(frozen=True)
class RowChoice:
    """How a material's highlight is held. kind: diffuse (none worth rows), glossy, mirror (left out: SH can't hold it).

    rows: hemispherical rows, 0 unless glossy; explained: see the function, of the most rows allowed where kind is
    mirror; why: one clause for the report.
    """

    kind: Literal["diffuse", "glossy", "mirror"]
    rows: int
    explained: float
    why: str

    @property
    def functions(self) -> Indices:
        """Indices of the rows' functions."""
        return hemisphere.functions_of(self.rows) if self.rows else np.zeros(0, np.int64)


def choose_rows(material: SurfaceMaterial, order: int, most: int = 25, reflection: Reflection | None = None,
                ) -> RowChoice:
    """Rows for a material's highlight under light of `order`: the fewest that hold it, at most `most`.

    reflection: of this material at this order, where it is known already. Subsurface light is not looked at: it needs
    no row of its own beside the constant one.
    """
    if material.specular_level <= 0 and material.metallic <= 0:
        return RowChoice("diffuse", 0, 1.0, "it reflects nothing but diffuse light")
    reflection = reflection_of_material(material, order) if reflection is None else reflection
    albedo = float(reflection.albedo().max())
    if albedo < INVISIBLE:
        return RowChoice("diffuse", 0, 1.0, f"its highlight returns {albedo:.2%} of the light, which shows in no pixel")
    counts = [count for count in ROW_COUNTS if count <= most]
    light = reflection.held_by_light()
    if light * reflection.held_by_rows(hemisphere.functions_of(counts[-1])) < MIRROR:
        share = light * reflection.held_by_rows(hemisphere.functions_of(counts[-1]))
        return RowChoice("mirror", 0, share, f"roughness {material.roughness:.2f} is too close to a mirror: light of"
                         f" order {order} and {counts[-1]} rows hold {share:.1%} of its highlight")
    held = 0.0
    for count in counts:
        held = reflection.held_by_rows(hemisphere.functions_of(count))
        if held >= ENOUGH:
            break
    return RowChoice("glossy", count, light * held, f"{count} rows hold {held:.1%} of what light of order {order} shows"
                     f" in its highlight, and {light * held:.1%} of a highlight of small lights")


@dataclass(frozen=True)
class DiffuseLeft:
    """What the dielectric layer leaves of the diffuse one.

    mean: over pixels (views weighted by their cosine), the factor on the constant row. coefficients (k,): of what
    differs from the mean, in the rows' functions, to be multiplied by the diffuse exit radiance.
    """

    mean: float
    coefficients: Array


def diffuse_left(material: SurfaceMaterial, functions: Indices) -> DiffuseLeft:
    """See `DiffuseLeft`. The metallic share is not in it: it belongs to the albedo of the diffuse layer."""
    views = views_for(isotropic=True)  # Cycles dims by the isotropic lobe
    left = PrincipledLobe(material).dimming(views.directions)
    pixels = views.weights * views.directions[:, 2]
    mean = float(np.sum(left * pixels) / pixels.sum())
    _, azimuths = hemisphere.bands_of(functions)
    profile = views.values(functions) * (views.weights * 2 * np.pi * (left - mean))[:, None]
    integrals = np.where(azimuths == 0, profile.sum(axis=0), 0.0)
    return DiffuseLeft(mean, hemisphere.hemisphere_basis(functions).fit(integrals))
