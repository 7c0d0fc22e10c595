# SPDX-License-Identifier: GPL-3.0-or-later
"""Matrices of a material's reflection between spherical harmonics over the hemisphere, built once per material.

Sloan et al. 2003, eq. 1: M_p = A^-1 B A^-1 R_p T_p with B_ij = double integral over H of y_i(v) f(v, s) cos(s) y_j(s).
A^-1 stands for the truncated A^+ of `basis.hemisphere`. Two matrices leave this module:

outgoing  L = A^+ B, rows x incident functions. It takes incident radiance as coefficients l with
          L_in(s) = sum_j l_j y_j(s) on H: distant light in the local frame before anything shadows it. It is also the
          robust choice for traced radiance held as plain integrals b_j = integral over H of L_in y_j (the paper's
          zero-hemisphere projection): then f cos, cut at the horizon where it is 0 anyway, is what the incident
          functions must hold, and errors of b come through unamplified.
K = L A^+ (`reflection_matrix`), the paper's. It takes the same plain integrals b and is exact where radiance over H is
          band-limited, but an error of b along an eigenvector of A with eigenvalue e grows by 1 / sqrt(e). Integrals
          that were traced have errors near 1e-3, so only eigenvalues above INCIDENT are inverted for them.

The matrices are for unit light, hold all of f (coloured where it is: a last axis of 1 or 3 channels) and come in the
point's own frame: x tangent, y bitangent, z normal; an anisotropic lobe's rotation is in them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..basis import hemisphere, spherical_harmonics
from ..basis.hemisphere import Indices
from ..linear_algebra import batched_multiply, multiply
from ..scene.surface_material import SurfaceMaterial
from .reflectance import AZIMUTH, POLAR, Lobe, PrincipledLobe

Array = NDArray[np.float64]

# Smallest eigenvalue of A that is inverted on the incident side, where integrals are traced.
INCIDENT = 1e-3
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

    radiance (n, order^2, c): integral of f(v, s) cos(s) y_j(s) ds in the lobe's own frame; energy (c,): the double
    integral of (f cos)^2, all of it; turn: of the lobe's frame about z.
    """

    views: Views
    order: int
    radiance: Array
    energy: Array
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

    def light_energy(self) -> Array:
        """(c,): squared exit radiance over H, summed over the incident functions (unit light in each)."""
        squares = np.sum(self.radiance ** 2 * self.views.weights[:, None, None], axis=0)
        return np.sum(squares * self.views.circle(np.arange(self.order ** 2))[:, None], axis=0)

    def held_by_light(self) -> float:
        """Share of the lobe's squared integral over views and lights that light of this order meets (0..1)."""
        return _share(self.light_energy(), self.energy)

    def held_by_rows(self, functions: Indices) -> float:
        """Share of the squared exit radiance under light of this order that these rows hold (0..1)."""
        basis = hemisphere.hemisphere_basis(functions)
        integrals = self.integrals(functions)
        held = np.sum(integrals * basis.fit(integrals), axis=(0, 1))
        return _share(held, self.light_energy())


def _share(part: Array, whole: Array) -> float:
    """Part of whole over all channels; quadratures differ by 1e-4, which must not show as more than everything."""
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
    around = 2 * np.pi if views.isotropic else 1.0
    energy = around * np.sum(squares * views.weights[:, None], axis=0)
    return Reflection(views, order, radiance, energy, lobe.turn)


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
    outgoing = outgoing_matrix(reflection, functions, smallest)[:, incident]
    basis = hemisphere.hemisphere_basis(incident, smallest_incident)
    return np.ascontiguousarray(np.moveaxis(basis.fit(np.moveaxis(outgoing, 1, 0)), 0, 1))


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
