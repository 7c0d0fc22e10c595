# SPDX-License-Identifier: GPL-3.0-or-later
"""One rotation of the whole signal into its principal axes, so that encoders work on a few leading values.

Distances are unchanged by a rotation, and the leading d values hold all but a known energy; encoders work on few values
while the error is large and on all of them at the end, so nothing is lost.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..errors import PRTError
from ..linear_algebra import gram, multiply, symmetric_eigenpairs
from .workers import SERIAL, Workers

# Rows per pass: bounds the temporaries. Constant, so that results never depend on the memory of a machine.
CHUNK = 4096


@dataclass(frozen=True)
class GlobalFrame:
    """Coordinates y = (x - mean) forward, x = mean + y backward.

    coordinates: (p, n) float32, scaled so that squares neither overflow nor underflow.
    mean (n,), forward (n, n), backward (n, n): float64; both carry the scale and the metric.
    scale: coordinates times scale are in the metric's units.
    tail: (n + 1,) float64; tail[d] is the energy (sum of squares) of coordinates beyond the leading d.
    energy: the signal's own sum of squares about zero, in squared coordinates.
    """

    coordinates: NDArray[np.float32]
    mean: NDArray[np.float64]
    forward: NDArray[np.float64]
    backward: NDArray[np.float64]
    scale: float
    tail: NDArray[np.float64]
    energy: float

    def leading(self, error: float) -> int:
        """How many leading values leave out at most `error` of the energy; at least one."""
        return max(1, int(np.searchsorted(-self.tail, -error)))


def check_signal(signal: NDArray) -> None:
    """Raises PRTError unless the signal is a finite, non-empty (points, values) array."""
    if signal.ndim != 2 or 0 in signal.shape:
        raise PRTError("signal", f"shape {signal.shape} is not points x values", "Pass at least one point and value")
    for start in range(0, signal.shape[0], CHUNK):
        bad = ~np.isfinite(signal[start:start + CHUNK]).all(axis=1)
        if bad.any():
            point = start + int(bad.argmax())
            raise PRTError("signal", f"point {point} holds NaN or infinity", "Look at the geometry around that point")


def metric_roots(metric: NDArray | None, values: int) -> tuple[NDArray, NDArray]:
    """The symmetric square root of a metric and its pseudo-inverse, both (values, values) float64.

    metric: (m, m) symmetric, no negative eigenvalue, m a divisor of `values`; it acts on the rows of a point's values
    seen as a (m, values / m) matrix. Directions of which the metric sees less than 1e-12 of its largest eigenvalue
    are dropped. Raises PRTError for any other metric.
    """
    if metric is None:
        return np.eye(values), np.eye(values)
    metric = np.asarray(metric, np.float64)
    rows = metric.shape[0]
    if metric.shape != (rows, rows) or values % rows or not np.allclose(metric, metric.T, atol=1e-12 * metric.max()):
        raise PRTError("metric", f"shape {metric.shape} is no symmetric matrix over {values} values", "Pass (m, m)")
    eigenvalues, vectors = symmetric_eigenpairs(metric)
    if not eigenvalues[0] > 0 or eigenvalues[-1] < -1e-9 * eigenvalues[0]:
        raise PRTError("metric", "it is not positive", "Pass a Gram matrix of linearly independent functions")
    kept = eigenvalues > 1e-12 * eigenvalues[0]
    roots = np.sqrt(eigenvalues[kept])
    vectors = vectors[:, kept]
    columns = np.eye(values // rows)
    return (np.kron(multiply(vectors * roots, vectors.T), columns),
            np.kron(multiply(vectors / roots, vectors.T), columns))


def global_frame(signal: NDArray[np.floating], metric: NDArray | None = None, workers: Workers = SERIAL) -> GlobalFrame:
    """The principal axes of a signal (p, n) in a metric, and the signal in them.

    Raises PRTError for an empty signal, NaN, infinity or an impossible metric.
    """
    check_signal(signal)
    points, values = signal.shape
    root, inverse_root = metric_roots(metric, values)
    mean, covariance, scale = _moments(signal, workers)
    within = multiply(multiply(root, covariance / points), root)
    _, axes = symmetric_eigenpairs((within + within.T) / 2)
    forward = multiply(root, axes) / scale
    backward = multiply(axes.T, inverse_root) * scale
    coordinates = np.empty((points, values), np.float32)
    seen, sums = np.zeros(values), np.zeros(values)
    single = np.ascontiguousarray(forward * scale, np.float32)
    for start in range(0, points, CHUNK):
        workers.tick()
        block = coordinates[start:start + CHUNK]
        multiply(_centred(signal[start:start + CHUNK], mean, scale), single, out=block)
        seen += np.square(block).sum(axis=0, dtype=np.float64)
        sums += block.sum(axis=0, dtype=np.float64)
    tail = np.append(np.cumsum(seen[::-1])[::-1], 0.0)
    offset = multiply(mean[None], forward)[0]
    energy = max(float(tail[0] + 2 * (offset * sums).sum() + points * (offset * offset).sum()), float(tail[0]) * 1e-3)
    return GlobalFrame(coordinates, mean, forward, backward, float(scale), tail, energy)


def _centred(block: NDArray[np.floating], mean: NDArray[np.float64], scale: float) -> NDArray[np.float32]:
    """Rows less the mean, over the scale, in single precision; the mean itself is one of single precision."""
    single = block.dtype == np.float32
    result = block - (mean.astype(np.float32) if single else mean)
    result *= 1 / scale
    return np.ascontiguousarray(result, np.float32)


def _moments(signal: NDArray[np.floating], workers: Workers) -> tuple[NDArray[np.float64], NDArray[np.float64], float]:
    """Mean (n,) rounded to single precision, scatter about it (n, n) over the scale's square, and the scale, the power
    of two nearest to the largest difference from the mean: sums of single-precision blocks in double precision."""
    points, values = signal.shape
    mean, low, high = np.zeros(values), np.full(values, np.inf), np.full(values, -np.inf)
    for start in range(0, points, CHUNK):
        block = signal[start:start + CHUNK]
        mean += block.sum(axis=0, dtype=np.float64)
        low, high = np.minimum(low, block.min(axis=0)), np.maximum(high, block.max(axis=0))
    mean = (mean / points).astype(np.float32).astype(np.float64)
    largest = float(np.maximum(high - mean, mean - low).max())
    scale = float(2.0 ** np.round(np.log2(largest))) if largest > 0 else 1.0
    scatter = np.zeros((values, values))
    for start in range(0, points, CHUNK):
        workers.tick()
        scatter += gram(_centred(signal[start:start + CHUNK], mean, scale))
    return mean, scatter, scale
