# SPDX-License-Identifier: GPL-3.0-or-later
"""What glossy receivers keep of the shadow rays: their visibility itself, without the cosine, as SH coefficients.

The transfer of light to incident radiance is T_ij = integral of V y_i y_j. The product y_i y_j of functions of orders n
and m is a sum of functions of order n + m - 1 (`triple_products`), so the coefficients v_k = integral of V y_k of that
order hold T without loss: 81 numbers for 25 x 25, projected by the product that direct transfer uses.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..basis.spherical_harmonics import evaluate, expand_bands, zonal_hemisphere
from ..linear_algebra import multiply
from .receiver_set import ReceiverSet, weigh_by_faces

# Receivers finished at once.
BLOCK_OF_RESULT = 16384


@dataclass(frozen=True)
class Sample:
    """What a chunk of directions adds: the place among the chosen receivers, and coefficients (k, b) of `names`."""

    place: slice
    values: tuple[NDArray[np.float32], ...]


@dataclass(frozen=True)
class VisibilityCoefficients:
    """Integrals of the functions over parts of the receivers' hemispheres, without what lies under their faces.

    rows: (g,) places of the receivers in their set; visible: (g, order^2) float32, over what shows the sky; blocked:
    (g, blocked_order^2), over what shows a surface (None where it wasn't asked for).
    """

    rows: NDArray[np.int64]
    visible: NDArray[np.float32]
    blocked: NDArray[np.float32] | None


class HemisphereVisibility:
    """Collects the visibility of the chosen receivers (r,) bool; order: of its coefficients.

    blocked_order: also of the blocked part, for interreflection (0: not).
    """

    def __init__(self, chosen: NDArray[np.bool_], order: int, blocked_order: int = 0) -> None:
        self.chosen, self.order, self.blocked_order = chosen, order, blocked_order
        self._before = np.concatenate([[0], np.cumsum(chosen)])
        count = int(self._before[-1])
        shapes = [order * order] * 2 + [blocked_order * blocked_order]
        self._seen, self._sampled, self._blocked = (np.zeros((n, count), np.float32) for n in shapes)

    def sample(self, receivers: ReceiverSet, place: slice, directions: NDArray[np.float32],
               weights: NDArray[np.float64], cosines: NDArray[np.float32], visible: NDArray[np.float32],
               ) -> Sample | None:
        """The projection of one chunk of directions (d, 3); cosines and visible cosines (d, b) as direct transfer has
        them. Safe to run in a thread; None where no receiver of the block is chosen."""
        which = np.flatnonzero(self.chosen[place])
        if not len(which):
            return None
        share = None
        if self.blocked_order:
            share = cosines.copy()
            weigh_by_faces(receivers, place, directions, share)
        if len(which) < cosines.shape[1]:
            cosines, visible = np.take(cosines, which, axis=1), np.take(visible, which, axis=1)
            share = share if share is None else np.take(share, which, axis=1)
        # The quotient of what is visible of a cosine and the cosine: exactly 1 where all is, 0 where there is none.
        divisor = np.maximum(cosines, np.finfo(np.float32).tiny)
        seen = visible / divisor
        basis = np.ascontiguousarray((evaluate(self.order, directions) * weights[:, None]).T, np.float32)
        values = [multiply(basis, seen), multiply(basis, np.sign(cosines))]
        if share is not None:
            share /= divisor
            share -= seen
            values.append(multiply(basis[:self.blocked_order ** 2], share))
        first, last = self._before[place.start], self._before[place.stop]
        return Sample(slice(int(first), int(last)), tuple(values))

    def add(self, sample: Sample) -> None:
        """Add a sample; in the order of the tasks, so that sums do not depend on threads."""
        for total, values in zip((self._seen, self._sampled, self._blocked), sample.values, strict=False):
            total[:, sample.place] += values

    def result(self, normals: NDArray[np.float64]) -> VisibilityCoefficients:
        """The coefficients, without the quadrature's error on the whole hemisphere of a normal (r, 3), in proportion to
        what is seen (a control variate, as in direct transfer: an open receiver is exact at any number of directions).
        """
        rows = np.flatnonzero(self.chosen)
        visible = self._corrected(self._seen, normals[rows], self.order)
        blocked = self._corrected(self._blocked, normals[rows], self.blocked_order) if self.blocked_order else None
        return VisibilityCoefficients(rows, visible, blocked)

    def _corrected(self, values: NDArray[np.float32], normals: NDArray[np.float64], order: int) -> NDArray[np.float32]:
        result = np.empty((len(normals), order * order), np.float32)
        for start in range(0, len(result), BLOCK_OF_RESULT):
            part = slice(start, start + BLOCK_OF_RESULT)
            sampled = self._sampled[:order * order, part]
            share = values[0, part] / np.maximum(sampled[0], np.finfo(np.float32).tiny)
            exact = evaluate(order, normals[part]) * expand_bands(zonal_hemisphere(order))
            result[part] = values[:, part].T + share[:, None] * (exact - sampled.T)
        return result
