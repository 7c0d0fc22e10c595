# SPDX-License-Identifier: GPL-3.0-or-later
"""How far off the encoding of each point is: where on the surface the compression's error lies."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..linear_algebra import multiply
from .encoding import Encoding
from .global_frame import rows_at_once


def point_errors(signal: NDArray[np.floating], encoding: Encoding, metric: NDArray[np.float64] | None = None,
                 ) -> NDArray[np.float32]:
    """(p,) distances of a signal (p, n) to what its encoding stands for, relative to the RMS length of the signal.

    metric: as `encode` takes it. The mean of their squares is the encoding's relative error over all points. Costs one
    decoding: a product per cluster.
    """
    squares, energy = np.empty(len(signal)), 0.0
    # What a cluster of a whole object decodes to must not double the memory of a bake.
    at_once = rows_at_once(signal.shape[1])
    order = np.argsort(encoding.cluster, kind="stable")
    starts = np.searchsorted(encoding.cluster[order], np.arange(len(encoding.bases) + 1))
    for cluster, basis in enumerate(encoding.bases):
        for start in range(starts[cluster], starts[cluster + 1], at_once):
            members = order[start:min(start + at_once, starts[cluster + 1])]
            values = np.asarray(signal[members], np.float32)
            difference = values - basis[0] - multiply(encoding.weights[members], basis[1:])
            squares[members] = _squared_lengths(difference, metric)
            energy += float(_squared_lengths(values, metric).sum())
    mean = energy / max(len(signal), 1)
    return (np.sqrt(squares / mean) if mean > 0.0 else np.zeros(len(signal))).astype(np.float32)


def _squared_lengths(values: NDArray[np.float32], metric: NDArray[np.float64] | None) -> NDArray[np.float64]:
    """Squared lengths (p,) of values (p, n) in a metric of their rows; rounding takes none below zero."""
    if metric is None:
        return np.square(values).sum(axis=1, dtype=np.float64)
    rows = len(metric)
    by_row = values.reshape(len(values), rows, -1).transpose(1, 0, 2).reshape(rows, -1)
    turned = multiply(np.asarray(metric, np.float32), by_row)
    return np.maximum((by_row * turned).reshape(rows, len(values), -1).sum(axis=(0, 2), dtype=np.float64), 0.0)
