# SPDX-License-Identifier: GPL-3.0-or-later
"""One rotation of the whole signal into its principal axes, so that encoders work on a few leading values.

Distances are unchanged by a rotation, and the leading d values hold all but a known energy; encoders work on few values
while the error is large and on all of them at the end, so nothing is lost.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from ..errors import PRTError
from ..linear_algebra import gram, multiply, small_batched_multiply, symmetric_eigenpairs
from .workers import SERIAL, Workers

# Rows per pass: bounds the temporaries. Constant, so that results never depend on the memory of a machine.
CHUNK = 4096
# Values from which on only the leading axes are looked for, how many at first and at most.
WIDE, FIRST_WIDTH, MOST_WIDTH = 1024, 256, 768
# Values from which on these are the axes of some points, and their number and the frame's are bounded by so many values
# (as many as a bake keeps bases of): highlights in a cubemap's columns. Squares below this share of the largest are
# rounding. And the numbers of a pass' rows there.
VERY_WIDE, MOST_SAMPLED, MOST_FRAME, FEWEST_AXES, NEGLIGIBLE = 1 << 14, 1 << 25, 1 << 24, 64, 1e-10
MOST_NUMBERS = 1 << 23
# Points for each value from which the rotation is found.
ENOUGH_POINTS = 24


@dataclass(frozen=True)
class GlobalFrame:
    """Coordinates y = (x - mean) forward, x = mean + y backward.

    coordinates: (p, d) float32, d = n but for very wide signals, scaled so that squares neither overflow nor underflow.
    mean (n,), forward (n, n), backward (n, n): float64; both carry the scale and the metric.
    scale: coordinates times scale are in the metric's units.
    tail: (d + 1,) float64; tail[k] is the energy (sum of squares) beyond the leading k coordinates.
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
        return min(max(1, int(np.searchsorted(-self.tail, -error))), self.coordinates.shape[1])


def rows_at_once(values: int) -> int:
    """Rows per pass of a signal of so many values."""
    return CHUNK if values <= VERY_WIDE else max(1, MOST_NUMBERS // values)


def most_axes(values: int) -> int:
    """Axes that are looked for of a signal of so many values, at most."""
    return min(values, MOST_WIDTH) if values <= VERY_WIDE else max(FEWEST_AXES, min(MOST_WIDTH, MOST_FRAME // values))


def axes_bytes(points: int, values: int) -> int:
    """What the axes of a very wide signal take while they are found, about; 0 for others."""
    if values <= VERY_WIDE:
        return 0
    return 40 * most_axes(values) * values + 12 * min(points * values, MOST_SAMPLED)


def check_signal(signal: NDArray) -> None:
    """Raises PRTError unless the signal is a finite, non-empty (points, values) array."""
    if signal.ndim != 2 or 0 in signal.shape:
        raise PRTError("signal", f"shape {signal.shape} is not points x values", "Pass at least one point and value")
    at_once = rows_at_once(signal.shape[1])
    for start in range(0, signal.shape[0], at_once):
        bad = ~np.isfinite(signal[start:start + at_once]).all(axis=1)
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


def global_frame(signal: NDArray[np.floating], metric: NDArray | None = None, workers: Workers = SERIAL,
                 left_out: float = 1e-8) -> GlobalFrame:
    """The principal axes of a signal (p, n) in a metric, and the signal in them.

    left_out: share of the energy that a frame of more than WIDE values may leave out for good (`leading_frame`).
    Raises PRTError for an empty signal, NaN, infinity or an impossible metric.
    """
    check_signal(signal)
    points, values = signal.shape
    if values > WIDE:
        return leading_frame(signal, metric, left_out, workers)
    root, inverse_root = metric_roots(metric, values)
    mean, covariance, scale = _moments(signal, workers)
    within = multiply(multiply(root, covariance / points), root)
    _, axes = symmetric_eigenpairs((within + within.T) / 2)
    forward = multiply(root, axes) / scale
    backward = multiply(axes.T, inverse_root) * scale
    coordinates = np.empty((points, values), np.float32)
    seen, sums = np.zeros(values), np.zeros(values)
    single = np.ascontiguousarray(forward * scale, np.float32)

    def project(start: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        block = coordinates[start:start + CHUNK]
        multiply(_centred(signal[start:start + CHUNK], mean, scale), single, out=block)
        return np.square(block).sum(axis=0, dtype=np.float64), block.sum(axis=0, dtype=np.float64)

    for squares, values_sum in workers.run(project, range(0, points, CHUNK)):  # summed in order
        seen += squares
        sums += values_sum
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
    of two nearest to the largest difference from the mean: sums of single-precision blocks in double precision.

    The scatter is of every k-th point where there are many times more than values: any rotation is exact, and this one
    has only to put most of the energy first."""
    mean, scale = _mean_and_scale(signal)
    scatter = np.zeros((signal.shape[1], signal.shape[1]))
    some = signal[::max(1, len(signal) // (ENOUGH_POINTS * signal.shape[1]))]
    for start in range(0, len(some), CHUNK):
        workers.tick()
        scatter += gram(_centred(some[start:start + CHUNK], mean, scale))
    scatter *= len(signal) / len(some)
    return mean, scatter, scale


def _mean_and_scale(signal: NDArray[np.floating]) -> tuple[NDArray[np.float64], float]:
    """See `_moments`."""
    points, values = signal.shape
    mean, low, high = np.zeros(values), np.full(values, np.inf), np.full(values, -np.inf)
    at_once = rows_at_once(values)
    for start in range(0, points, at_once):
        block = signal[start:start + at_once]
        mean += block.sum(axis=0, dtype=np.float64)
        low, high = np.minimum(low, block.min(axis=0)), np.maximum(high, block.max(axis=0))
    mean = (mean / points).astype(np.float32).astype(np.float64)
    largest = float(np.maximum(high - mean, mean - low).max())
    return mean, float(2.0 ** np.round(np.log2(largest))) if largest > 0 else 1.0


@dataclass(frozen=True)
class _Wide:
    """A wide signal in its metric, block by block. root, inverse: (m, m), None where there is no metric."""

    signal: NDArray[np.floating]
    mean: NDArray[np.float64]
    scale: float
    root: NDArray[np.float64] | None
    inverse: NDArray[np.float64] | None

    @staticmethod
    def of(signal: NDArray[np.floating], metric: NDArray | None) -> _Wide:
        mean, scale = _mean_and_scale(signal)
        if metric is None:
            return _Wide(signal, mean, scale, None, None)
        if signal.shape[1] % len(metric):
            metric_roots(metric, signal.shape[1])  # raises
        return _Wide(signal, mean, scale, *metric_roots(metric, len(metric)))

    def within(self, rows: NDArray[np.floating], matrix: NDArray[np.float64] | None) -> NDArray:
        """Rows (b, n), seen as (m, n / m) each, times a matrix (m, m) from the left."""
        if matrix is None:
            return rows
        stacked = rows.reshape(len(rows), len(matrix), -1)
        return small_batched_multiply(matrix.astype(rows.dtype)[None], stacked).reshape(rows.shape)

    def blocks(self, workers: Workers) -> Iterator[tuple[slice, NDArray[np.float32]]]:
        """Centred rows in the metric, in single precision."""
        at_once = rows_at_once(self.signal.shape[1])
        for start in range(0, len(self.signal), at_once):
            workers.tick()
            part = slice(start, start + at_once)
            yield part, self.within(_centred(self.signal[part], self.mean, self.scale), self.root)


def _sampled_axes(wide: _Wide, width: int, generator: np.random.Generator, workers: Workers) -> NDArray[np.float32]:
    """Orthonormal axes (n, width) near the leading ones: see `leading_frame`."""
    values = wide.signal.shape[1]
    sample = np.zeros((values, width))
    directions = generator.standard_normal((values, width), np.float32)
    for _, block in wide.blocks(workers):
        sample += multiply(block.T, multiply(block, directions))
    return np.ascontiguousarray(linalg.qr(sample, mode="economic")[0], np.float32)


def _axes_of_some(wide: _Wide) -> NDArray[np.float32]:
    """Orthonormal axes (n, k): the principal ones of points evenly spread over the signal, from their products with
    each other, which are few where values are very many."""
    points, values = wide.signal.shape
    count = min(points, max(FEWEST_AXES, min(MOST_SAMPLED // values, MOST_WIDTH + MOST_WIDTH // 2)))
    places = np.unique(np.linspace(0, points - 1, count).astype(np.int64))
    rows = wide.within(_centred(wide.signal[places], wide.mean, wide.scale), wide.root)
    products = np.zeros((len(places),) * 2)
    for start in range(0, values, CHUNK):
        products += gram(np.ascontiguousarray(rows[:, start:start + CHUNK].T, np.float64))
    squares, mix = symmetric_eigenpairs(products, most_axes(values))
    used = squares > NEGLIGIBLE * max(float(squares[0]), np.finfo(float).tiny)
    used[0] = True
    mix = mix[:, used] / np.sqrt(np.maximum(squares[used], np.finfo(float).tiny))
    axes = np.empty((values, mix.shape[1]), np.float32)
    for start in range(0, values, CHUNK):
        axes[start:start + CHUNK] = multiply(rows[:, start:start + CHUNK].astype(np.float64).T, mix)
    return axes


def leading_frame(signal: NDArray[np.floating], metric: NDArray | None, left_out: float, workers: Workers = SERIAL,
                  ) -> GlobalFrame:
    """As `global_frame` for signals so wide that all their axes cost more than the encode itself: only as many leading
    ones as leave out `left_out` of the energy, which tail[-1] holds and every error counts in.

    A randomised range finder with one power step (Halko, Martinsson & Tropp 2011, algorithm 4.4), made wider
    until it holds enough or MOST_WIDTH is reached; beyond VERY_WIDE the axes of some of the points.
    """
    points, values = signal.shape
    wide = _Wide.of(signal, metric)
    generator = np.random.default_rng(0)
    width, most = FIRST_WIDTH, min(points, values, MOST_WIDTH)
    while True:
        if values > VERY_WIDE:
            basis = _axes_of_some(wide)
            width = most = basis.shape[1]
        else:
            width = min(width, most)
            basis = _sampled_axes(wide, width, generator, workers)
        coordinates = np.empty((points, width), np.float32)
        rest, energy, offset = 0.0, 0.0, wide.within(wide.mean[None] / wide.scale, wide.root)
        for part, block in wide.blocks(workers):
            coordinates[part] = multiply(block, basis)
            energy += float(np.sum(np.square(block + offset), dtype=np.float64))
            block -= multiply(coordinates[part], basis.T)
            rest += float(np.sum(np.square(block), dtype=np.float64))
        if rest <= left_out * energy or width == most:
            break
        width *= 3
    _, turn = symmetric_eigenpairs(gram(coordinates).astype(np.float64))
    axes = multiply(basis.astype(np.float64), turn)
    seen = np.zeros(width)
    for start in range(0, points, CHUNK):
        block = coordinates[start:start + CHUNK]
        block[...] = multiply(block, turn.astype(np.float32))
        seen += np.square(block).sum(axis=0, dtype=np.float64)
    tail = np.append(np.cumsum(seen[::-1])[::-1], 0.0) + rest
    backward = wide.within(np.ascontiguousarray(axes.T), wide.inverse) * wide.scale
    forward = wide.within(np.ascontiguousarray(axes.T), wide.root).T / wide.scale
    return GlobalFrame(coordinates, wide.mean, forward, backward, wide.scale, tail, max(energy, float(tail[0]) * 1e-3))
