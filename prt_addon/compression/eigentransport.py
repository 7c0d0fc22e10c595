# SPDX-License-Identifier: GPL-3.0-or-later
"""Eigentransport: one basis for all receivers (Nowrouzezahrai et al. 2007). A clustered PCA with one cluster.

T ~ T_L B + mean over signals of thousands of columns, on disk if need be: tiles of bounded size are read in a few
passes, small signals are solved exactly.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import linalg

from ..errors import BadArguments
from ..linear_algebra import gram, multiply, symmetric_eigenpairs
from .encoding import Encoding
from .global_frame import check_signal
from .monitor import Progress

Single = NDArray[np.float32]
Double = NDArray[np.float64]

MOST_VECTORS = 192
# Points or columns up to which the smaller side's Gram matrix is solved outright.
EXACT_SIZE = 1024
# Columns of the random sample beyond the vectors, and power steps: Halko, Martinsson & Tropp (2011), algorithm 4.4.
OVERSAMPLING, POWER_STEPS = 32, 1
# Values of a tile: 32 MB, and the same once more while it is centred.
TILE = 1 << 23
# Singular values below this share of the largest are rounding of single precision.
NEGLIGIBLE = 1e-6


@dataclass(frozen=True)
class EigenTransport:
    """encoding: with one cluster, whose bases are in the signal's own units; captured: (vectors,) share of the variance
    (sum of squares about the mean, in the metric) that the first 1, 2, ... vectors hold; exact: not from a random
    sample."""

    encoding: Encoding
    captured: Double
    exact: bool

    def bytes(self) -> int:
        """Memory at run time: 4 d (v + 1), the weights and the light's coefficients (section 7.1)."""
        points, vectors = self.encoding.weights.shape
        return 4 * vectors * (points + 1)


@dataclass(frozen=True)
class _Source:
    """A signal (p, n) less its mean (n,), each column times a scale (n,), read in tiles."""

    signal: NDArray[np.floating]
    mean: Double
    scale: Double
    progress: Callable[[], None]

    def tiles(self, by_columns: bool | None = None) -> Iterator[tuple[slice, slice, Single]]:
        """Rows, columns, and the values there: whole columns, or whole rows; None: what lies together in memory."""
        self.progress()
        for rows, columns in _tiles(self.signal, by_columns):
            block = self.signal[rows, columns] - self.mean[columns].astype(np.float32)
            block *= self.scale[columns].astype(np.float32)
            yield rows, columns, np.asarray(block, np.float32)

    def times(self, right: NDArray) -> Double:
        """The whole times (n, k): (p, k) float64."""
        result = np.zeros((self.signal.shape[0], right.shape[1]))
        right = np.ascontiguousarray(right, np.float32)
        for rows, columns, block in self.tiles():
            result[rows] += multiply(block, right[columns])
        return result

    def transposed_times(self, left: NDArray) -> Double:
        """The transpose of the whole times (p, k): (n, k) float64."""
        result = np.zeros((self.signal.shape[1], left.shape[1]))
        left = np.ascontiguousarray(left, np.float32)
        for rows, columns, block in self.tiles():
            result[columns] += multiply(block.T, left[rows])
        return result


def eigentransport(signal: NDArray[np.floating], vectors: int, column_scale: ArrayLike | None = None,
                   target_error: float | None = None, seed: int = 0, progress: Progress | None = None,
                   exact: bool | None = None) -> EigenTransport:
    """The leading `vectors` eigentransports of a signal (p, n), one row per receiver; in any order of memory, or mapped
    from disk.

    column_scale: (n,) what columns are multiplied by for measuring errors: for transfer that holds its texels' solid
    angles their inverse roots, so that sums of squares are integrals over the sphere. target_error: squared error
    relative to the signal's own squares at which fewer vectors suffice. progress: called with the fraction done; what
    it raises ends the work. exact: None lets the size decide. Fewer vectors come back where the signal has no more.
    Raises BadArguments for impossible numbers, PRTError for an empty signal, NaN or infinity.
    """
    if not 1 <= vectors <= MOST_VECTORS:
        raise BadArguments("vectors", f"{vectors} is outside 1 to {MOST_VECTORS}", "Choose a number inside")
    check_signal(signal)
    scale = np.ones(signal.shape[1]) if column_scale is None else np.asarray(column_scale, np.float64)
    if scale.shape != (signal.shape[1],) or not (np.isfinite(scale) & (scale > 0)).all():
        raise BadArguments("column_scale", "it is not a positive number for each column", "Pass one for each")
    exact = min(signal.shape) <= EXACT_SIZE if exact is None else exact
    passes = _Passes(3 if exact else 4 + 2 * POWER_STEPS, progress)
    passes()
    mean, energy = _mean_and_energy(signal, scale)
    source = _Source(signal, mean, scale, passes)
    most = min(vectors, signal.shape[0] - 1, signal.shape[1])
    squares, axes, weights, scatter = (_exact if exact else _sampled)(source, max(most, 0), seed)
    kept = int(np.count_nonzero(squares > max(squares[0] * NEGLIGIBLE ** 2, np.finfo(np.float32).tiny))) \
        if len(squares) else 0
    left = np.maximum(scatter - np.cumsum(squares), 0.0)
    if target_error is not None and kept:
        enough = np.flatnonzero(left[:kept] <= target_error * energy)
        kept = int(enough[0]) + 1 if len(enough) else kept
    error = float(left[kept - 1]) if kept else scatter
    bases = np.empty((1, kept + 1, signal.shape[1]), np.float32)
    bases[0, 0], bases[0, 1:] = mean, axes[:, :kept].T / scale
    encoding = Encoding(np.zeros(len(signal), np.int32), bases, np.ascontiguousarray(weights[:, :kept], np.float32),
                        np.array([kept], np.int32), error, error / energy if energy > 0 else 0.0, np.array([error]), ())
    captured = np.cumsum(squares[:kept]) / scatter if scatter > 0 else np.ones(kept)
    return EigenTransport(encoding, np.minimum(captured, 1.0), exact)


class _Passes:
    """Tells the fraction of the passes over the signal that are behind."""

    def __init__(self, total: int, progress: Progress | None) -> None:
        self._total, self._progress, self._done = total, progress, 0

    def __call__(self) -> None:
        if self._progress is not None:
            self._progress(min(1.0, self._done / self._total))
        self._done += 1


def _tiles(signal: NDArray[np.floating], by_columns: bool | None = None) -> Iterator[tuple[slice, slice]]:
    """Slices of rows, or of columns, of TILE values each."""
    points, values = signal.shape
    by_columns = signal.strides[0] < signal.strides[1] if by_columns is None else by_columns
    along, across = (values, points) if by_columns else (points, values)
    step = max(1, TILE // across)
    for start in range(0, along, step):
        part = slice(start, min(start + step, along))
        yield (slice(0, points), part) if by_columns else (part, slice(0, values))


def _mean_and_energy(signal: NDArray[np.floating], scale: Double) -> tuple[Double, float]:
    """Mean (n,) rounded to single precision, and the sum of squares about zero of the scaled signal."""
    mean, energy = np.zeros(signal.shape[1]), 0.0
    for rows, columns in _tiles(signal):
        block = signal[rows, columns]
        mean[columns] += block.sum(axis=0, dtype=np.float64)
        squares = np.square(block, dtype=np.float64).sum(axis=0)
        energy += float(np.sum(squares * scale[columns] ** 2))
    return (mean / signal.shape[0]).astype(np.float32).astype(np.float64), energy


def _exact(source: _Source, count: int, _: int) -> tuple[Double, Double, Double, float]:
    """Squared singular values, vectors (n, k), weights (p, k) and the scatter, from the smaller side's Gram matrix."""
    points, values = source.signal.shape
    narrow = values <= points
    matrix = np.zeros((min(points, values),) * 2)
    for _, _, block in source.tiles(by_columns=not narrow):
        matrix += gram((block if narrow else block.T).astype(np.float64))
    squares, axes = symmetric_eigenpairs(matrix, count)
    if not narrow:
        axes = source.transposed_times(axes) / np.sqrt(np.maximum(squares, np.finfo(float).tiny))
    scatter = float(np.trace(matrix))
    return squares, axes, source.times(axes), scatter


def _sampled(source: _Source, count: int, seed: int) -> tuple[Double, Double, Double, float]:
    """As `_exact`, from a random sample of the range, with power steps and a Rayleigh-Ritz step on the rows' side, so
    that vectors are orthonormal and weights are the signal's exact projections."""
    points, values = source.signal.shape
    width = min(count + OVERSAMPLING, points, values)
    generator = np.random.Generator(np.random.PCG64([seed, 29]))
    axes = generator.standard_normal((values, width))
    for _ in range(1 + POWER_STEPS):
        sample = _orthonormal(source.times(axes))
        axes = _orthonormal(source.transposed_times(sample))
    scatter, weights = 0.0, np.zeros((points, width))
    for rows, columns, block in source.tiles():
        weights[rows] += multiply(block, np.ascontiguousarray(axes[columns], np.float32))
        scatter += float(np.sum(np.square(block, dtype=np.float64)))
    squares, turn = symmetric_eigenpairs(gram(weights), count)
    axes, weights = multiply(axes, turn), multiply(weights, turn)
    signs = np.sign(axes[np.abs(axes).argmax(axis=0), np.arange(axes.shape[1])])
    return squares, axes * signs, weights * signs, scatter


def _orthonormal(matrix: Double) -> Double:
    return linalg.qr(matrix, mode="economic", overwrite_a=True)[0]


def mean_compensated(found: Encoding, column_scale: ArrayLike | None = None) -> tuple[Single, Double]:
    """The published form without a mean (eqs. 5-10): weights (p, d) with the mean's own projection added, and that
    projection (d,).

    The exit radiance is then the product of these and the light's coefficients alone. What of the mean lies outside the
    basis is lost in it, so this add-on keeps the mean as vector 0 instead, at the cost of one more number per light.
    """
    scale = np.ones(found.bases.shape[2]) if column_scale is None else np.asarray(column_scale, np.float64)
    mean, vectors = (found.bases[0, part].astype(np.float64) * scale for part in (slice(0, 1), slice(1, None)))
    projected = multiply(mean, vectors.T)[0]
    return (found.weights + projected).astype(np.float32), projected
