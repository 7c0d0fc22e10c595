# SPDX-License-Identifier: GPL-3.0-or-later
"""The true highlight of a material for path tracing: random directions and single values, no quadrature and no basis.

GGX facets are drawn as a view sees them and evaluated here anew, independently of `transport.reflectance`, whose rules
bake with. Fresnel's curves and the energy of several bounces between facets are that module's own: they are
definitions (those of Cycles' Principled BSDF), not approximations whose error is to be measured.
"""

from __future__ import annotations

import math
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ..basis.hemisphere import meridian
from ..scene.surface_material import SurfaceMaterial
from ..transport.reflectance import PrincipledLobe, energy_of

Array = NDArray[np.float64]

# Heights at which what depends on the view's height alone is tabulated, denser towards the horizon, and the lowest:
# linear interpolation is then within 1e-3 of the function for roughness 0.2 and above.
TABLE = 1e-3 + (1.0 - 1e-3) * np.linspace(0.0, 1.0, 129) ** 2
# Views from below the shading normal's horizon see what lies at this height (as the tables' lowest entry).
LOWEST = TABLE[0]


class TrueHighlight:
    """One material's highlight: everything in the point's own frame (x tangent, y bitangent, z normal)."""

    def __init__(self, material: SurfaceMaterial) -> None:
        self.lobe = PrincipledLobe(material)
        self._alphas = np.array([self.lobe.alpha_x, self.lobe.alpha_y, 1.0])
        energy = energy_of(self.lobe.alpha_x, self.lobe.alpha_y, meridian(TABLE))
        self._gains = [energy.compensation(layer.mean()) for _, layer in self.lobe.layers]

    @cached_property
    def _left(self) -> Array:
        return self.lobe.dimming(meridian(TABLE))

    def diffuse_left(self, views: Array) -> Array:
        """What the highlight leaves of the diffuse layer (n,) towards views (n, 3)."""
        return np.interp(views[:, 2], TABLE, self._left)

    def sample(self, views: Array, numbers: Array) -> tuple[Array, Array]:
        """Directions (n, 3) for views (n, 3) and random numbers (n, 2), and weights (n, 3): the mean of weight times
        incident radiance is the exit radiance. Directions below the horizon weigh nothing.

        Dupuy & Benyoub 2023: light mirrored at the facets that a view sees is even over a cap in the frame in which
        the facets are a sphere's.
        """
        local = self._turned(views, -self.lobe.turn)
        stretched = local * self._alphas
        stretched /= _length(stretched)
        height = (1.0 - numbers[:, 0]) * (1.0 + stretched[:, 2]) - stretched[:, 2]
        radius, angle = np.sqrt(np.maximum(1.0 - height ** 2, 0.0)), 2.0 * np.pi * numbers[:, 1]
        facet = np.stack([radius * np.cos(angle), radius * np.sin(angle), height], axis=1) + stretched
        facet *= self._alphas
        facet /= np.maximum(_length(facet), 1e-300)
        cosine = np.sum(facet * local, axis=1)
        lights = 2.0 * cosine[:, None] * facet - local
        of_view, of_light = self._shadowing(local), self._shadowing(lights)
        masked = np.where(lights[:, 2] > 0.0, (1.0 + of_view) / (1.0 + of_view + of_light), 0.0)
        weights = self._fresnel(np.clip(cosine, 0.0, 1.0), local[:, 2]) * masked[:, None]
        return self._turned(lights, self.lobe.turn), weights

    def evaluate(self, views: Array, lights: Array) -> Array:
        """f(v, s) cos(s), (n, 3), of views and lights (n, 3); 0 for lights below the horizon."""
        view, light = self._turned(views, -self.lobe.turn), self._turned(lights, -self.lobe.turn)
        facet = view + light
        facet /= np.maximum(_length(facet), 1e-300)
        x, y, z = (facet / self._alphas).T
        density = 1.0 / (np.pi * self.lobe.alpha_x * self.lobe.alpha_y * (x * x + y * y + z * z) ** 2)
        masking = 1.0 / (1.0 + self._shadowing(view) + self._shadowing(light))
        value = np.where(light[:, 2] > 0.0, density * masking / (4.0 * view[:, 2]), 0.0)
        cosine = np.clip(np.sum(view * facet, axis=1), 0.0, 1.0)
        return self._fresnel(cosine, view[:, 2]) * value[:, None]

    def _fresnel(self, cosines: Array, heights: Array) -> Array:
        """Reflectance (n, 3) of all layers at facets, with the energy of several bounces towards the views' heights."""
        total = np.zeros((len(cosines), 3))
        for (weight, layer), gain in zip(self.lobe.layers, self._gains, strict=True):
            gains = np.stack([np.interp(heights, TABLE, gain[:, channel]) for channel in range(3)], axis=1)
            total += weight * layer.reflectance(cosines) * gains
        return total

    def _shadowing(self, directions: Array) -> Array:
        """Smith's Lambda (n,) of GGX (Heitz 2014, eqs. 72 and 86)."""
        x, y, z = directions.T
        slope = ((self.lobe.alpha_x * x) ** 2 + (self.lobe.alpha_y * y) ** 2) / np.maximum(z, 1e-9) ** 2
        return 0.5 * (np.sqrt(1.0 + slope) - 1.0)

    def _turned(self, directions: Array, angle: float) -> Array:
        """Directions turned about z."""
        if angle == 0.0:
            return directions
        cosine, sine = math.cos(angle), math.sin(angle)
        x, y, z = directions.T
        return np.stack([cosine * x - sine * y, sine * x + cosine * y, z], axis=1)


def above_horizon(views: Array) -> Array:
    """Unit views (n, 3) with those at or below the horizon lifted to just above it, in the same azimuth."""
    lifted = np.array(views)
    lifted[:, 2] = np.maximum(lifted[:, 2], LOWEST)
    return lifted / _length(lifted)


def cosine_directions(numbers: Array) -> Array:
    """Directions (n, 3) about +Z with density cos / pi, by Malley's method, of numbers (n, 2)."""
    radius, angle = np.sqrt(numbers[:, 0]), 2.0 * np.pi * numbers[:, 1]
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), np.sqrt(1.0 - numbers[:, 0])], axis=1)


def even_directions(numbers: Array) -> Array:
    """Directions (n, 3) even over the upper hemisphere."""
    height, angle = 1.0 - numbers[:, 0], 2.0 * np.pi * numbers[:, 1]
    radius = np.sqrt(1.0 - height ** 2)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), height], axis=1)


def to_world(local: Array, frames: Array) -> Array:
    """Local directions (n, 3) of frames (n, 3, 3), rows tangent, bitangent, normal."""
    return np.sum(local[:, :, None] * frames, axis=1)


def to_local(directions: Array, frames: Array) -> Array:
    """World directions (n, 3) in frames (n, 3, 3)."""
    return np.sum(frames * directions[:, None, :], axis=2)


def lattice(sets: int, count: int, generator: np.random.Generator) -> Array:
    """`sets` randomly shifted rank-1 lattices (golden ratio) of `count` numbers in the unit square: (sets * count, 2).
    """
    index = np.arange(count)
    points = np.stack([(index + 0.5) / count, np.modf(index * ((np.sqrt(5.0) - 1.0) / 2.0))[0]], axis=1)
    return ((points[None] + generator.random((sets, 1, 2))) % 1.0).reshape(-1, 2)


def _length(vectors: Array) -> Array:
    return np.sqrt(np.sum(vectors ** 2, axis=1, keepdims=True))
