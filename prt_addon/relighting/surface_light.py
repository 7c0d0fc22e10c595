# SPDX-License-Identifier: GPL-3.0-or-later
"""The light of lamps in the columns of lit surfaces: what they give to each patch, by shadow rays."""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ..lighting.lit_surfaces import LitSurfaces, triangle_areas
from ..lighting.local_lights import LocalLight
from ..linear_algebra import multiply
from ..scene.receivers import LIFT
from ..tracing.tracer import Tracer
from ..transport.near_light import linear_flux
from .direct_light import LitReceivers, direct_local_light

Double = NDArray[np.float64]
# A triangle nearer to a lamp than this many times its size is cut in four, and so on, at most so many times; parts end
# where they are farther away than FAR of their sizes.
NEAR, FAR, CUTS = 4.0, 2.0, 6
# Shadow rays from a triangle to a lamp that throws soft shadows: what has bounced shows none of their edges.
SAMPLES = 4
# A lamp nearer to a surface than this many LIFTs touches it.
TOUCHING = 4.0


class SurfaceLight:
    """Irradiance that lamps give to patches of surface.

    tracer: of everything that casts shadows.
    """

    def __init__(self, surfaces: LitSurfaces, tracer: Tracer) -> None:
        self.surfaces, self._tracer = surfaces, tracer
        self._corners = surfaces.corners.astype(np.float64)
        self._area = triangle_areas(self._corners)
        self._size = np.sqrt(self._area)
        self._middle = self._corners.mean(axis=1)
        self._normal = _normals(self._corners)
        self._receivers = LitReceivers.of_points(tracer, self._middle, self._normal)
        self._known = surfaces.patch.ravel() >= 0
        self._patch = surfaces.patch.ravel()[self._known].astype(np.intp)
        self._patches = surfaces.axes.shape[1]
        shares = np.repeat(self._area / 3.0, 3)[self._known]
        whole = np.bincount(self._patch, shares, self._patches).astype(np.float64)
        self._over_area = np.divide(1.0, whole, out=np.zeros_like(whole), where=whole > 0.0)
        self._kept: dict[Hashable, Double] = {}

    def columns(self, lamps: Sequence[LocalLight], keys: Sequence[Hashable]) -> Double:
        """Light (columns, 3) of all lamps together. keys: tell lamps apart that differ in more than power; what a lamp
        gives for each watt is kept while its key is among them, so that only lamps that move cost rays."""
        self._kept = {key: self._kept[key] if key in self._kept else self.patches(replace(lamp, power=np.ones(3)))
                      for key, lamp in zip(keys, lamps, strict=True)}
        light = np.zeros((self._patches, 3))
        for key, lamp in zip(keys, lamps, strict=True):
            light += self._kept[key][:, None] * lamp.power
        return multiply(self.surfaces.axes.astype(np.float64), light)

    def patches(self, lamp: LocalLight) -> Double:
        """Mean E / pi (patches,) of a lamp of even colour on each patch, so that its flux is right however near it
        is."""
        return self.mean(self.flux(lamp))

    def flux(self, lamp: LocalLight) -> Double:
        """Flux over pi (s, 3) of a lamp of even colour to the thirds of the triangles."""
        lamp = self._off_surfaces(lamp)
        value = direct_local_light(self._tracer, self._receivers, [lamp], SAMPLES)[:, 0].astype(np.float64)
        flux = np.repeat((value * self._area / 3.0)[:, None], 3, axis=1)
        reach = NEAR * self._size + lamp.extent
        near = np.flatnonzero(np.sum((self._middle - lamp.position) ** 2, axis=1) < reach * reach)
        if len(near):
            flux[near] = self._near(lamp, near)
        return flux

    def _off_surfaces(self, lamp: LocalLight) -> LocalLight:
        """A lamp that touches surfaces moved off them by what shadow rays leave out, so that it shines on them: half of
        what it emits. In a corner off each of its walls; between the two sides of one, to the first."""
        least = TOUCHING * LIFT * self._tracer.diagonal
        position = lamp.position.copy()
        away = position - self._middle
        height = np.sum(away * self._normal, axis=1)
        near = (np.abs(height) < least) & (np.sum(away ** 2, axis=1) < 4.0 * self._size ** 2)
        moved = np.zeros(3)
        for normal in self._normal[near]:
            if abs(float(np.sum(moved * normal))) < 0.5 * least:
                moved += least * normal
        if not moved.any():
            return lamp
        matrix = lamp.matrix.copy()
        matrix[:3, 3] = position + moved
        return replace(lamp, matrix=matrix)

    def mean(self, flux: Double) -> Double:
        """Mean E / pi (patches,) of flux over pi (s, 3)."""
        return np.bincount(self._patch, flux.ravel()[self._known], self._patches) * self._over_area

    def aimed(self, flux: Double, spot: LocalLight) -> Double:
        """Flux of a point as that of a spot at its place, by the triangles' middles: to learn from, not to show."""
        return flux * spot.pattern(self._middle - spot.position)[:, None]

    def _near(self, lamp: LocalLight, near: NDArray[np.int64]) -> Double:
        """Flux over pi (n, 3) to the corners' thirds of triangles near a lamp, by parts of them."""
        result = np.zeros((len(near), 3))
        corners, owner = self._corners[near], np.arange(len(near))
        shares = np.broadcast_to(np.eye(3), (len(near), 3, 3))  # of the triangle's corners at the part's corners
        for level in range(CUTS + 1):
            away = np.sqrt(np.sum((corners.mean(axis=1) - lamp.position) ** 2, axis=1)) - lamp.extent
            done = (away > FAR * self._size[near][owner] * 0.5 ** level) | (level == CUTS)
            if done.any():
                flux = self._part_flux(lamp, corners[done], self._normal[near][owner[done]])
                for corner in range(3):
                    result[:, corner] += np.bincount(owner[done], np.sum(flux * shares[done][:, :, corner], axis=1),
                                                     len(near))
            if done.all():
                break
            corners, shares = _quarters(corners[~done]), _quarters(shares[~done])
            owner = np.tile(owner[~done], 4)
        return result

    def _part_flux(self, lamp: LocalLight, corners: Double, normals: Double) -> Double:
        """Flux over pi (n, 3) that parts of triangles (n, 3, 3) get, by their corners' linear functions."""
        middle = corners.mean(axis=1)
        receivers = LitReceivers.of_points(self._tracer, middle, normals)
        value = direct_local_light(self._tracer, receivers, [lamp], SAMPLES)[:, 0].astype(np.float64)
        area = triangle_areas(corners)
        if lamp.kind == "area":
            return np.repeat((value * area / 3.0)[:, None], 3, axis=1)
        # Outside of it a sphere shines like a point, whose flux through a triangle has a closed form.
        towards = lamp.position - middle
        square = np.maximum(np.sum(towards ** 2, axis=1), 1e-300)
        sampled = np.maximum(np.sum(towards * normals, axis=1), 0.0) / (square * np.sqrt(square)) * area
        exact = linear_flux(corners - lamp.position)
        whole = exact.sum(axis=1)
        outside = (square > lamp.extent ** 2) & (sampled > 0.0)
        ratio = np.divide(whole, sampled, out=np.ones_like(whole), where=outside)
        # A point at the very height of the surface: the sample may be far too small, the solid angle is at most 2 pi.
        return (value * area * ratio)[:, None] * (exact / np.maximum(whole, 1e-300)[:, None])


def _normals(corners: Double) -> Double:
    """Unit normals (t, 3) of triangles."""
    upright = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return upright / np.maximum(np.sqrt(np.sum(upright ** 2, axis=1)), 1e-300)[:, None]


def _quarters(values: Double) -> Double:
    """Values (n, 3, k) at the corners of the four triangles between corners and middles of edges: (4 n, 3, k)."""
    middle = 0.5 * (values + np.roll(values, -1, axis=1))
    corners = [np.stack([values[:, k], middle[:, k], middle[:, k - 1]], axis=1) for k in range(3)]
    return np.concatenate([*corners, middle])
