# SPDX-License-Identifier: GPL-3.0-or-later
"""The signals of objects, (p, rows, columns, channels): the rows of highlights, what they weigh, what encodings say."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..compression.encoding import Encoding
from ..compression.global_frame import rows_at_once
from ..linear_algebra import multiply


def energy(signal: NDArray[np.float32], metric: NDArray[np.float64] | None) -> float:
    """Sum of squares of a signal (p, rows, columns, channels), in the metric of its rows."""
    total = 0.0
    at_once = rows_at_once(signal[:1].size)
    for start in range(0, len(signal), at_once):
        block = signal[start:start + at_once]
        if metric is None:
            total += float(np.sum(np.square(block, dtype=np.float64)))
        else:
            rows = np.moveaxis(block, 1, 0).reshape(len(metric), -1).astype(np.float64)
            total += float(np.sum(multiply(metric, rows) * rows))
    return total


@dataclass(frozen=True)
class GlossyRows:
    """points: (g,) of the receivers with highlights; rows: (g, functions, columns, 1 or 3)."""

    points: NDArray[np.int64]
    rows: NDArray[np.float32]

    def write(self, signal: NDArray[np.float32], place: slice) -> None:
        """Put the rows of a target's points into a signal (p, functions, columns, channels), block by block.

        One channel serves all three.
        """
        inside = np.flatnonzero((self.points >= place.start) & (self.points < place.stop))
        at_once = rows_at_once(self.rows[:1].size)
        for start in range(0, len(inside), at_once):
            block = inside[start:start + at_once]
            signal[self.points[block] - place.start] = self.rows[block]

    def at(self, keys: NDArray[np.int64]) -> NDArray[np.float32]:
        """The rows of these points."""
        order = np.argsort(self.points)
        return self.rows[order[np.searchsorted(self.points, keys, sorter=order)]]


def decoded(encoding: Encoding, rows: NDArray[np.int64]) -> NDArray[np.float64]:
    """The signal (k, values) that an encoding stands for at some of its points."""
    result = np.empty((len(rows), encoding.bases.shape[2]))
    for place, row in enumerate(rows):
        basis = encoding.bases[encoding.cluster[row]].astype(np.float64)
        result[place] = basis[0] + np.sum(encoding.weights[row].astype(np.float64)[:, None] * basis[1:], axis=0)
    return result
