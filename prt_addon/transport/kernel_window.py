# SPDX-License-Identifier: GPL-3.0-or-later
"""A material's matrix K for light as sharp as a texel: softened until its highlight of a small light does not ring.

Light in spherical harmonics is cut at its own order, and its own window takes care of what rings. A texel's light is as
sharp as the texel, and what is cut then are the rows: a few smooth functions of the view follow a narrow highlight with
swings to both sides, black spots on a metal beside the sun's reflection. As rows of lamps (`lamp_kernel`), K is damped,
band by band of the incident functions, by the weakest heat kernel that leaves no lobe below -DEEPEST_LOBE of the peak,
or hardly deeper ones than any leaves.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..basis import hemisphere, spherical_harmonics
from ..basis.hemisphere import Indices
from ..basis.spherical_harmonics import expand_bands, order_of
from ..linear_algebra import multiply
from .lamp_kernel import DEEPEST_LOBE, profile_directions

Array = NDArray[np.float64]

# Strengths that are tried, up to that of lamps. Rows ring by themselves in some views, which no softer light mends: a
# stronger one that gains less than ENOUGH of the peak is not taken.
_STRENGTHS, ENOUGH = np.linspace(0.0, 0.05, 26), 0.01


def softened(kernel: Array, functions: Indices) -> tuple[Array, float]:
    """K (rows, n^2, channels) and the factor that its highest band is left with, 1 where nothing rings.

    What K returns of a white world stays the same, by the smallest change that does it (of rank one).
    """
    views, lights = profile_directions()
    seen = hemisphere.evaluate(functions, views)
    order = order_of(kernel.shape[1])
    values = np.ascontiguousarray(spherical_harmonics.evaluate(order, lights).T)
    white = hemisphere.gram_matrix(np.arange(kernel.shape[1]))[0]
    whole = np.sum(kernel * white[:, None], axis=1)

    def damped(strength: float) -> Array:
        factors = expand_bands(spherical_harmonics.window(order, "heat", strength))
        result = kernel * factors[:, None]
        missing = whole - np.sum(result * white[:, None], axis=1)
        return result + missing[:, None] * (white / np.sum(white ** 2))[:, None]

    def depth(strength: float) -> float:
        profile = multiply(multiply(seen, np.ascontiguousarray(damped(strength).mean(axis=2))), values)
        return float(np.max(-profile.min(axis=1) / np.maximum(profile.max(axis=1), np.finfo(np.float64).tiny)))

    depths = np.array([depth(strength) for strength in _STRENGTHS])
    chosen = float(_STRENGTHS[np.flatnonzero(depths <= max(DEEPEST_LOBE, depths.min() + ENOUGH))[0]])
    if chosen == 0.0:
        return kernel, 1.0
    return damped(chosen), float(spherical_harmonics.window(order, "heat", chosen)[-1])
