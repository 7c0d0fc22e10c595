# SPDX-License-Identifier: GPL-3.0-or-later
"""Light sources close to surfaces: the flux that triangles really get, split among their corners in closed form.

The gather operator interpolates a field between corners. Near a light the field is sharper than the mesh: sampled at
corners it misses the peak between them, or takes a corner's peak for whole triangles. What the operator needs at a
corner is the flux weighted by the corner's linear function, over the integral of that function (a lumped projection):
then the interpolated field carries exactly the light's flux, whatever the distance.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..basis.spherical_harmonics import evaluate
from ..linear_algebra import multiply
from ..scene.receivers import LIFT
from ..scene.scene_mesh import SceneMesh
from ..tracing.tracer import Tracer
from .receiver_set import ReceiverSet

Double = NDArray[np.float64]
# A light nearer to a triangle than this many of its longest edges is too sharp a field for the triangle's corners.
NEAR = 4.0
# A near triangle is cut in four until each part fills at most this solid angle (steradians), so that one shadow ray
# stands for 1/250 of the light; at most so many times, which ends at a light that touches the surface.
PART = 0.05
CUTS = 4
# Shadow rays start this far above the surface, in LIFTs: the point on it is only known to single precision.
RAY_LIFT = 4.0
_TINY = np.finfo(np.float64).tiny


def linear_flux(corners: Double) -> Double:
    """Flux (t, 3) of a unit point light at the origin (1 W/sr) through triangles (t, 3, 3), weighted by the linear
    function of each corner; a triangle's sum is its solid angle, whichever side is lit. Watts.

    With the foot f of the light in the triangle's plane, h its height, r the distance: weight = weight(f) + gradient .
    (x - f). The integral of h / r^3 is the solid angle (Van Oosterom & Strackee 1983, eq. 8), that of (x - f) h / r^3
    is -h times the boundary integral of the outward normal / r, by Gauss's theorem (as de Munck 1992 for
    potentials of linear double layers). Meant for triangles not many times smaller than their distance: beyond, the
    two parts cancel (relative error about 1e-16 (distance / edge)^4).
    """
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    length = np.sqrt(np.sum(corners ** 2, axis=2))
    volume = np.abs(np.sum(a * np.cross(b, c), axis=1))
    below = (length.prod(axis=1) + np.sum(a * b, axis=1) * length[:, 2] + np.sum(b * c, axis=1) * length[:, 0]
             + np.sum(c * a, axis=1) * length[:, 1])
    solid_angle = 2.0 * np.arctan2(volume, below)
    normal = np.cross(b - a, c - a)
    double_area = np.maximum(np.sqrt(np.sum(normal ** 2, axis=1)), _TINY)
    normal /= double_area[:, None]
    height = np.sum(normal * corners.mean(axis=1), axis=1)
    edges = np.roll(corners, -1, axis=1) - corners
    span = np.sqrt(np.sum(edges ** 2, axis=2))
    ends = length + np.roll(length, -1, axis=1)
    # A light on an edge makes the logarithm infinite while its factor, the height, is zero.
    logarithm = np.log((ends + span) / np.maximum(ends - span, 1e-15 * np.maximum(ends, 1e-290)))
    outward = np.cross(edges, normal[:, None, :]) / np.maximum(span, _TINY)[:, :, None]
    moment = -np.abs(height)[:, None] * np.sum(outward * logarithm[:, :, None], axis=1)
    gradient = np.cross(normal[:, None, :], np.roll(edges, -1, axis=1)) / double_area[:, None, None]
    foot = height[:, None] * normal - corners.mean(axis=1)
    weight = 1.0 / 3.0 + np.sum(gradient * foot[:, None, :], axis=2)
    flux = weight * solid_angle[:, None] + np.sum(gradient * moment[:, None, :], axis=2)
    # No corner gets less than nothing: below zero is rounding, which the others make up for.
    flux = np.maximum(flux, 0.0)
    return flux * (solid_angle / np.maximum(flux.sum(axis=1), _TINY))[:, None]


@dataclass(frozen=True)
class _Parts:
    """Pieces of triangles: corners (n, 3, 3) from the light, weights (n, 3, 3) of the triangle's corners (last axis) at
    the piece's, triangle (n,) they belong to."""

    corners: Double
    weights: Double
    triangle: NDArray[np.int64]

    def cut(self, flux: Double) -> tuple[_Parts, NDArray[np.bool_]]:
        """Those that get too much, in four each; and which were left alone."""
        small = flux.sum(axis=1) <= PART
        corners, weights, triangle = self.corners[~small], self.weights[~small], self.triangle[~small]
        pieces = [np.concatenate([_quarter(values, k) for k in range(4)]) for values in (corners, weights)]
        return _Parts(pieces[0], pieces[1], np.tile(triangle, 4)), small


def _quarter(values: Double, which: int) -> Double:
    """Values (n, 3, k) at the corners of one of the four triangles between corners and middles of edges."""
    middle = 0.5 * (values + np.roll(values, -1, axis=1))
    if which == 3:
        return middle
    return np.stack([values[:, which], middle[:, which], middle[:, which - 1]], axis=1)


class NearTriangles:
    """Replaces the direct field near lights by what conserves their flux.

    Threads may share it: nothing changes after it was made.
    """

    def __init__(self, tracer: Tracer, scene: SceneMesh, receivers: ReceiverSet, near: float = NEAR) -> None:
        self._tracer, self._scene, self._near = tracer, scene, near
        count = len(scene.points)
        self._row = np.full(2 * count, -1, np.int64)
        self._row[receivers.key] = np.arange(len(receivers))
        corners = scene.points[scene.triangles]
        edges = np.roll(corners, -1, axis=1) - corners
        self._longest = np.sqrt(np.max(np.sum(edges ** 2, axis=2), axis=1, initial=0.0))
        self._centre = corners.mean(axis=1)
        normal = np.cross(edges[:, 0], edges[:, 1])
        double_area = np.sqrt(np.sum(normal ** 2, axis=1))
        self._normal = normal / np.maximum(double_area, _TINY)[:, None]
        self._share = double_area / 6.0  # a corner's part of the triangle's area
        owner = scene.triangles.ravel()
        self._area = np.bincount(owner, np.repeat(self._share, 3), count)[receivers.key % max(1, count)]
        self._count = count

    def near(self, positions: Double, radius: float = 0.0) -> list[NDArray[np.int64]]:
        """The triangles near each light (l, 3)."""
        if not len(self._centre):
            return [np.zeros(0, np.int64)] * len(positions)
        middle = self._centre.mean(axis=0)
        centre, light = self._centre - middle, positions - middle
        squares = np.sum(centre ** 2, axis=1)[:, None] + np.sum(light ** 2, axis=1) - 2.0 * multiply(centre, light.T)
        near = squares < ((self._near * self._longest + radius) ** 2)[:, None]
        return [np.flatnonzero(near[:, light]) for light in range(len(positions))]

    def replace(self, field: NDArray[np.float32], near: NDArray[np.int64], spots: Double, emission_order: int) -> int:
        """Correct one light's field (r, functions), E / pi, in place; return the rays traced.

        near: triangles from `near`; spots: (s, 3), the points that the light stands for, of 1/s intensity each.
        """
        near = near[self._share[near] > 0.0]
        if not len(near):
            return 0
        functions, rays = emission_order ** 2, 0
        flux = np.zeros((len(self._area), functions))
        replaced = np.zeros(len(self._area))
        for spot in spots:
            side = np.sum((spot - self._centre[near]) * self._normal[near], axis=1) < 0.0
            got, used = self._flux(near, side, spot, emission_order)
            rays += used
            rows = self._row[self._scene.triangles[near] + self._count * side[:, None]]
            known = rows >= 0
            for function in range(functions):
                flux[:, function] += np.bincount(rows[known], got[:, :, function][known], len(flux)) / len(spots)
        for back in (0, 1):  # on either side these triangles' part of the corners' field is replaced
            rows = self._row[self._scene.triangles[near] + self._count * back]
            known = rows >= 0
            replaced += np.bincount(rows[known], np.repeat(self._share[near], 3)[known.ravel()], len(replaced))
        touched = np.flatnonzero(replaced)
        area = self._area[touched]
        kept = np.maximum(1.0 - replaced[touched] / area, 0.0)
        kept[kept < 1e-9] = 0.0  # a corner all of whose triangles are near: nothing of the sampled peak
        sampled = np.where(kept[:, None] > 0.0, kept[:, None] * field[touched], 0.0)
        field[touched] = sampled + flux[touched] / (np.pi * area[:, None])
        return rays

    def _flux(self, near: NDArray[np.int64], back: NDArray[np.bool_], spot: Double, emission_order: int,
              ) -> tuple[Double, int]:
        """Flux (t, 3, functions) that reaches the corners' functions of these triangles, and the rays traced."""
        corners = self._scene.points[self._scene.triangles[near]] - spot
        parts = _Parts(corners, np.broadcast_to(np.eye(3), (len(near), 3, 3)), np.arange(len(near)))
        result = np.zeros((len(near), 3, emission_order ** 2))
        rays = 0
        for level in range(CUTS + 1):
            flux = linear_flux(parts.corners)
            following, small = parts.cut(flux)
            use = np.ones(len(small), bool) if level == CUTS else small
            rays += int(use.sum())
            self._add(result, parts, flux, use, near, back, spot, emission_order)
            if level == CUTS or small.all():
                break
            parts = following
        return result, rays

    def _add(self, result: Double, parts: _Parts, flux: Double, use: NDArray[np.bool_], near: NDArray[np.int64],
             back: NDArray[np.bool_], spot: Double, emission_order: int) -> None:
        """Add what gets through to these pieces: one shadow ray each, to the middle of the piece's flux."""
        flux, triangle = flux[use], parts.triangle[use]
        total = flux.sum(axis=1)
        middle = np.sum(parts.corners[use] * flux[:, :, None], axis=1) / np.maximum(total, _TINY)[:, None]
        side = np.where(back[triangle], -1.0, 1.0)[:, None]
        start = middle + side * self._normal[near[triangle]] * (RAY_LIFT * LIFT * self._tracer.diagonal)
        origins = self._tracer.to_tracing_space(start + spot)
        towards = self._tracer.to_tracing_space(spot[None]) - origins
        hidden = self._tracer.occluded(origins, towards, np.ones(len(origins), np.float32))
        # A light nearer than the ray's start touches the surface: nothing lies between.
        hidden &= np.sum(middle ** 2, axis=1) > (2.0 * RAY_LIFT * LIFT * self._tracer.diagonal) ** 2
        weighted = np.sum(parts.weights[use] * np.where(hidden[:, None], 0.0, flux)[:, :, None], axis=1)
        if emission_order == 1:
            emitted = np.ones((len(total), 1))
        else:
            length = np.sqrt(np.sum(middle ** 2, axis=1))
            direction = np.where(length[:, None] > 0.0, middle / np.maximum(length, _TINY)[:, None],
                                 -side * self._normal[near[triangle]])
            emitted = np.sqrt(4.0 * np.pi) * evaluate(emission_order, direction)
        for corner in range(3):
            for function in range(emitted.shape[1]):
                result[:, corner, function] += np.bincount(triangle, weighted[:, corner] * emitted[:, function],
                                                           len(result))
