# SPDX-License-Identifier: GPL-3.0-or-later
"""The one entrance to compression: a signal in, clusters, bases and weights out."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from ..linear_algebra import multiply
from .adaptive import adapt, trim_vectors
from .clustered_pca import SEED_VECTORS, disturb, iterate, iterate_wide, random_start, split_start, static_labels
from .global_frame import GlobalFrame, global_frame
from .monitor import Monitor, Progress
from .pca import principal_components
from .settings import EncoderSettings
from .subspaces import Subspaces, from_labels
from .workers import Workers

# Squared error relative to the signal's energy that single precision cannot lower: nothing is spent below it.
ROUNDING = 1e-12
# Energy that the frame of a very wide signal may leave out: of the squared error asked for, or of the whole energy.
UNSEEN, UNSEEN_WITHOUT_TARGET = 0.1, 1e-8
# Random starts beside the splits share a budget of so many values times clusters; no signal gets more than this many.
START_BUDGET, MOST_STARTS = 1 << 22, 6
# Random exchanges of clusters after the starts, for each of the random ones.
TRIALS_PER_START = 4
# Values from which on random starts and sweeps among all subspaces beat splits (measured at 100 and 400).
WIDE_VALUES = 64
CHUNK = 4096
# Clusters that a thread fits at a time.
FITTED_TOGETHER = 16


@dataclass(frozen=True)
class Encoding:
    """x_p = bases[c, 0] + sum over i of weights[p, i - 1] bases[c, i], with c = cluster[p] (Sloan et al. 2003, 3.3).

    cluster: (p,) int32; bases: (clusters, vectors + 1, n) float32, vector 0 the mean; weights: (p, vectors) float32.
    A cluster of fewer vectors has zeros in the rest of its bases and its points' weights.
    vectors_per_cluster: (clusters,) int32. squared_error: over all points and values, in the metric.
    relative_error: the same over the signal's own sum of squares in the metric.
    discarded: (clusters,) float64, each cluster's share of squared_error, the sum of its discarded D_i^2.
    history: (seconds, stage, squared error).
    adaptive_left_out: the adaptive method was asked for, but the clusters are so even that different numbers of vectors
        would hardly have lowered the error.
    """

    cluster: NDArray[np.int32]
    bases: NDArray[np.float32]
    weights: NDArray[np.float32]
    vectors_per_cluster: NDArray[np.int32]
    squared_error: float
    relative_error: float
    discarded: NDArray[np.float64]
    history: tuple[tuple[float, str, float], ...]
    adaptive_left_out: bool = False

    @property
    def storage_cost(self) -> int:
        """Numbers stored, m_p n' + m_c (n' + 1) n, counting for every cluster the vectors that it has (section 4.1)."""
        points = np.bincount(self.cluster, minlength=len(self.bases))
        per_point = int((points * self.vectors_per_cluster).sum())
        return per_point + int((self.vectors_per_cluster + 1).sum()) * self.bases.shape[2]

    def decode(self, points: slice = slice(None)) -> NDArray[np.float32]:
        """The approximated signal of a range of points: (points, n) float32."""
        cluster, weights = self.cluster[points], self.weights[points]
        result = np.empty((len(cluster), self.bases.shape[2]), np.float32)
        for index in np.unique(cluster):
            members = np.flatnonzero(cluster == index)
            result[members] = self.bases[index, 0] + multiply(weights[members], self.bases[index, 1:])
        return result


def encode(signal: NDArray[np.floating], settings: EncoderSettings, metric: NDArray | None = None,
           progress: Progress | None = None) -> Encoding:
    """Clustered PCA of a signal (p, n), one row per surface point (Sloan et al. 2003, section 4).

    metric: (m, m) symmetric positive, m a divisor of n, acting on the rows of a point's values seen as (m, n / m): the
    error is measured and minimised in it (for glossy rows the hemisphere's Gram matrix A). None is the identity.
    progress: called with the fraction done; what it raises (Cancelled) ends the encode.
    Raises PRTError for an empty signal, NaN or infinity, or an impossible metric. Clusters without points are left out,
    and fewer clusters and vectors are used where more would not lower the error.
    """
    monitor = Monitor(progress)
    unseen = UNSEEN * settings.target_error if settings.target_error else UNSEEN_WITHOUT_TARGET
    with Workers(settings.threads, monitor.tick) as monitor.workers:
        frame = global_frame(signal, metric, monitor.workers, unseen)
        monitor.unit = frame.scale**2
        state, left_out = classify(frame, settings, monitor)
        monitor.span(0.95, 1.0)
        enough = enough_of(frame, settings) if settings.target_error is not None else None
        result = finish(frame, state, enough, monitor.workers)
    monitor.note("done", float(result.discarded.sum()) / monitor.unit, 1.0)
    return replace(result, history=tuple(monitor.history), adaptive_left_out=left_out)


def pca(signal: NDArray[np.floating], vectors: int, metric: NDArray | None = None) -> Encoding:
    """One principal component analysis of the whole signal: one cluster."""
    return encode(signal, EncoderSettings(clusters=1, vectors=vectors, method="static"), metric)


def vector_quantization(signal: NDArray[np.floating], clusters: int, seed: int = 0,
                        iterations: int = 100) -> Encoding:
    """LBG alone: many clusters of a mean each."""
    return encode(signal, EncoderSettings(clusters, 0, "static", seed, iterations))


def enough_of(frame: GlobalFrame, settings: EncoderSettings) -> float:
    """The squared error, in the frame's units, below which nothing more is spent."""
    return max(settings.target_error or 0.0, ROUNDING) * frame.energy


def classify(frame: GlobalFrame, settings: EncoderSettings, monitor: Monitor) -> tuple[Subspaces, bool]:
    """Every point's cluster, every cluster's number of vectors, perhaps subspaces near the best; and whether the
    adaptive pass was left out."""
    if settings.clusters == 1 or frame.tail[0] <= ROUNDING * frame.energy:
        return _unfitted(np.zeros(len(frame.coordinates), np.int32), settings), False
    if settings.method == "static":
        return _unfitted(static_labels(frame, settings, monitor), settings), False
    share = 0.6 if settings.method == "adaptive" else 0.95
    state = _best_start(frame, settings, enough_of(frame, settings), monitor, share)
    left_out = False
    if settings.method == "adaptive":
        monitor.span(share, 0.95)
        left_out = not adapt(frame, state, settings, monitor)
    return state, left_out


def _unfitted(labels: NDArray[np.int32], settings: EncoderSettings) -> Subspaces:
    """A classification alone."""
    state = from_labels(labels, int(labels.max()) + 1, 0, settings.vectors)
    state.bases = state.bases[:, :0]
    return state


def _best_start(frame: GlobalFrame, settings: EncoderSettings, enough: float, monitor: Monitor,
                share: float) -> Subspaces:
    """Iterative clustered PCA from one or more starts; the lowest squared error wins, the splits among equals.

    The iteration ends in a local minimum that depends on the start by some 10 % where clusters are few, and small
    signals cost nothing, so they get several starts, more patience, and random exchanges of clusters from the best.
    share: the fraction of the whole work that this is.
    """
    restarts = settings.restarts
    if restarts is None:
        restarts = min(START_BUDGET // (frame.coordinates.size * settings.clusters), MOST_STARTS)
    if restarts == 0 or settings.target_error is not None:
        monitor.span(0.0, share)
        if settings.target_error is None and _is_wide(frame):
            return iterate_wide(frame, settings, enough, monitor)
        state = split_start(frame, settings, enough, monitor)
        iterate(frame, state, settings, enough, monitor)
        return state
    patient = replace(settings, tolerance=settings.tolerance / 10)
    starts: list[Callable[[], Subspaces]] = [
        partial(split_start, frame, patient, enough, monitor, seed_vectors) for seed_vectors in (SEED_VECTORS, 0)]
    starts += [partial(random_start, frame, patient, number, monitor) for number in range(restarts)]
    best, lowest = None, np.inf
    for number, start in enumerate(starts):
        monitor.span(share * number / (len(starts) + 1), share * (number + 1) / (len(starts) + 1),
                     f"start {number}, ")
        state = start()
        error = iterate(frame, state, patient, enough, monitor)
        if best is None or error < lowest:
            best, lowest = state, error
    monitor.span(share * len(starts) / (len(starts) + 1), share)
    disturb(frame, best, patient, enough, monitor, TRIALS_PER_START * restarts)
    return best


def _is_wide(frame: GlobalFrame) -> bool:
    """Whether clusters are long in many directions, so that their eigenproblems are not solved outright."""
    return frame.coordinates.shape[1] >= WIDE_VALUES


def finish(frame: GlobalFrame, state: Subspaces, enough: float | None, workers: Workers) -> Encoding:
    """Exact PCA of every cluster on all values, then back to the signal's own values.

    enough: squared error up to which the least useful vectors are left out again; None keeps all.
    """
    used, labels, counts = np.unique(state.labels, return_inverse=True, return_counts=True)
    members = np.split(np.argsort(labels, kind="stable"), np.cumsum(counts)[:-1])
    vectors = state.vectors

    def fitted(number: int) -> tuple[NDArray, NDArray, NDArray]:
        cluster = used[number]
        return principal_components(frame.coordinates[members[number]], int(vectors[cluster]), state.bases[cluster])

    fits = workers.run_in_blocks(fitted, len(members), FITTED_TOGETHER)
    kept = np.array([len(fit[2]) for fit in fits])
    if enough is not None:
        scatter = np.array([_scatter_about(frame, points, fit[0]) for points, fit in zip(members, fits, strict=True)])
        kept = trim_vectors([fit[2] for fit in fits], counts, scatter, enough)
    most, values = int(kept.max()), frame.coordinates.shape[1]
    bases = np.zeros((len(fits), most + 1, values))
    weights = np.zeros((len(labels), most), np.float32)
    discarded = np.zeros(len(fits))

    def weigh(cluster: int) -> None:
        points, (mean, axes, _) = members[cluster], fits[cluster]
        axes = axes[:kept[cluster]]
        bases[cluster, 0], bases[cluster, 1:len(axes) + 1] = mean, axes
        for start in range(0, len(points), CHUNK):
            rows = points[start:start + CHUNK]
            centred = frame.coordinates[rows] - mean
            weights[rows, :len(axes)] = multiply(centred, axes.T)
            discarded[cluster] += np.square(centred - multiply(weights[rows, :len(axes)].astype(float), axes)).sum()

    workers.run_in_blocks(weigh, len(members), FITTED_TOGETHER)
    original = multiply(bases.reshape(-1, values), frame.backward).reshape(*bases.shape[:2], -1)
    original[:, 0] += frame.mean
    discarded *= frame.scale**2
    unseen = frame.tail[-1] * frame.scale**2
    discarded += unseen * np.array([len(points) for points in members]) / len(labels)
    total = float(discarded.sum())
    energy = frame.energy * frame.scale**2
    return Encoding(labels.astype(np.int32), original.astype(np.float32), weights, kept.astype(np.int32), total,
                    total / energy if energy > 0 else 0.0, discarded, ())


def _scatter_about(frame: GlobalFrame, points: NDArray[np.intp], mean: NDArray[np.float64]) -> float:
    """Summed squared distance of points to a mean."""
    return sum(float(np.square(frame.coordinates[points[start:start + CHUNK]] - mean).sum())
               for start in range(0, len(points), CHUNK))
