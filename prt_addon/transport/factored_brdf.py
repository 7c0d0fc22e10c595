# SPDX-License-Identifier: GPL-3.0-or-later
"""Reflection as a sum of a few products of a function of the view and one of the light (in-out factorisation).

    f(v, s) cos(s) ~ sum over k of g_k(v) f_k(s),    T_k(x, w_j) = V(x, w_j) f_k(w_j in x's frame) dw_j

(Huang & Ramamoorthi 2010, eqs. 2 and 3, after Wang et al. 2004 and Liu et al. 2004; the paper uses 4 terms.) Every
term is a transfer of one row: the same sampling and encoders serve. All terms share the visibility, so it is sampled
once for all of them. Anything but rough lobes loses much in 4 terms: `FactoredLobe.error` says how much.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..basis.cubemap import cubemap_directions, texel_of
from ..basis.directions import cosine_hemisphere, tangent_frames
from ..linear_algebra import gram, multiply, symmetric_eigenpairs
from ..scene.surface_material import SurfaceMaterial
from .elements import Places, Single, VisibilityElements
from .reflectance import PrincipledLobe

Array = NDArray[np.float64]

# Views and lights of the factorisation, texels along an edge of the tables, and the height below which views lie so
# low that they are looked up there instead.
VIEWS, LIGHTS, TABLE = 192, 768, 64
LOWEST = 1e-3
# Receivers whose directions are turned at once: 64 x 6,144 directions are 9 MB.
AT_ONCE = 64


@dataclass(frozen=True)
class FactoredLobe:
    """incoming (terms, 6 t t): f_k in the surface's frame, zero below the horizon; outgoing (terms, 6 t t): g_k.
    error: relative RMS of the sum of products over lights and pixels (views weighted by their cosine). captured:
    (terms,) share of the squared integral that each term adds."""

    incoming: Single
    outgoing: Single
    error: float
    captured: Array


def factored(material: SurfaceMaterial, terms: int = 4) -> FactoredLobe:
    """The best sum of `terms` products for a material's highlight (mean over its colours), least squares over pixels
    and lights: a singular value decomposition, whose functions are evaluated anywhere by Nystrom's formula."""
    lobe = PrincipledLobe(material)
    views, lights = cosine_hemisphere(VIEWS), cosine_hemisphere(LIGHTS)
    # Plain means over either set weigh by cosine; of lights, plain solid angle is wanted.
    light_scale = np.sqrt(1.0 / lights[:, 2])
    matrix = lobe.kernel(views, lights).mean(axis=2) * light_scale
    squares, left = symmetric_eigenpairs(gram(np.ascontiguousarray(matrix.T)), terms)
    right = multiply(np.ascontiguousarray(left.T), matrix) / np.maximum(squares, 1e-300)[:, None]
    table = cubemap_directions(TABLE)
    above = np.flatnonzero(table[:, 2] > 0.0)
    directions = _raised(table[above])
    incoming, outgoing = (np.zeros((terms, len(table)), np.float32) for _ in range(2))
    incoming[:, above] = multiply(np.ascontiguousarray(left.T), lobe.kernel(views, directions).mean(axis=2))
    low = table[above, 2] < LOWEST
    incoming[:, above[low]] *= (table[above[low], 2] / LOWEST).astype(np.float32)
    for start in range(0, len(above), VIEWS):
        part = slice(start, start + VIEWS)
        kernel = lobe.kernel(directions[part], lights).mean(axis=2) * light_scale
        outgoing[:, above[part]] = multiply(kernel, np.ascontiguousarray(right.T)).T
    total = float(np.sum(matrix ** 2))
    captured = squares / total if total > 0.0 else np.zeros(terms)
    return FactoredLobe(incoming, outgoing, float(np.sqrt(max(0.0, 1.0 - captured.sum()))), captured)


def _raised(directions: Array) -> Array:
    """Directions no lower than LOWEST."""
    raised = directions.copy()
    raised[:, 2] = np.maximum(raised[:, 2], LOWEST)
    return raised / np.sqrt(np.sum(raised ** 2, axis=1, keepdims=True))


@dataclass
class FactoredElements(VisibilityElements):
    """Visibility alone (factor 1), of which `term` makes the transfer of each term of a factored BRDF."""

    def factor(self, receivers: Places) -> Single:
        """One above the horizon."""
        return self.unknown(receivers).astype(np.float32)

    def term(self, lobe: FactoredLobe, number: int, receivers: Places) -> Single:
        """f_k(w_j) dw_j (n, columns) in the receivers' frames (`tangent_frames` of their normals)."""
        result = np.empty((len(receivers), self.columns), np.float32)
        solid_angles = self._weights * np.float32(np.pi)
        for start in range(0, len(receivers), AT_ONCE):
            part = receivers[start:start + AT_ONCE]
            frames = tangent_frames(self.receivers.normals[part]).astype(np.float32)
            local = multiply(frames.reshape(-1, 3), self._directions.T).reshape(len(part), 3, -1)
            texels = texel_of(local.transpose(0, 2, 1), TABLE)
            np.multiply(lobe.incoming[number][texels], solid_angles, out=result[start:start + AT_ONCE])
        return result
