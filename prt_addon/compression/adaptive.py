# SPDX-License-Identifier: GPL-3.0-or-later
"""Numbers of vectors that differ between clusters (Sloan et al. 2003, section 4.3)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .clustered_pca import Work
from .global_frame import GlobalFrame
from .monitor import Monitor
from .reclassify import reclassify
from .settings import EncoderSettings
from .subspaces import SPARE, Subspaces, update

# Rounds of redistributing vectors and reclassifying.
ROUNDS = 10
# Updates after vectors are added, so that power steps find the spectra that decide about them.
SPECTRUM_STEPS = 2
# Of signals whose exact sweeps on all values would cost most of the time: rounds, and which of them looks at all
# subspaces.
WIDE_ROUNDS, SURVEY_EVERY = 8, 4


def distribute(gains: NDArray[np.float64], counts: NDArray[np.int64], budget: int) -> NDArray[np.int64]:
    """Numbers of vectors (K,) by greatest decrease of squared error per stored weight, D_i^2 / m_k, within a budget.

    gains: (K, q) the clusters' D_i^2, descending along a row; counts: (K,) m_k; budget: most weights stored in all.
    """
    clusters, most = gains.shape
    rates = gains / np.maximum(counts, 1)[:, None]
    order = np.argsort(-rates, axis=None, kind="stable")
    cluster = order // most if most else order
    costs = counts[cluster]
    worth = (gains.reshape(-1)[order] > 0) & (costs > 0)
    cluster, costs = cluster[worth], costs[worth]
    affordable = np.cumsum(costs) <= budget
    # The first vector that no longer fits ends the list: taking later, cheaper ones would break the order.
    return np.bincount(cluster[affordable], minlength=clusters)


def trim_vectors(gains: list[NDArray[np.float64]], counts: NDArray[np.int64], scatter: NDArray[np.float64],
                 enough: float) -> NDArray[np.int64]:
    """Numbers of vectors left when those that gain least per stored weight go, as long as the squared error stays at
    or below `enough`. gains: per cluster its D_i^2, descending; scatter: (K,) squared distances to the means."""
    kept = np.array([len(row) for row in gains])
    error = float(scatter.sum() - sum(row.sum() for row in gains))
    cluster = np.repeat(np.arange(len(gains)), kept)
    flat = np.concatenate(gains) if len(gains) else np.zeros(0)
    # Ascending rate; within a cluster the smallest D_i^2 first, so that vectors go from the last.
    order = np.argsort(flat / counts[cluster], kind="stable")[::1]
    spared = error + np.cumsum(flat[order]) <= enough
    return kept - np.bincount(cluster[order[spared]], minlength=len(gains))


def adaptation_pays(errors: NDArray[np.float64], counts: NDArray[np.int64], gains: NDArray[np.float64],
                    vectors: int) -> bool:
    """Whether redistributing vectors would lower the squared error by more than 2 %, from the spectra at hand.

    errors: (K,) with `vectors` vectors each; gains: (K, q) D_i^2 of more vectors than that.
    """
    used = distribute(gains, counts, int(counts.sum()) * vectors)
    most = np.arange(gains.shape[1])
    now = np.where(most < vectors, gains, 0.0).sum()
    then = np.where(most < used[:, None], gains, 0.0).sum()
    return bool(then - now > 0.02 * errors.sum())


def adapt(frame: GlobalFrame, state: Subspaces, settings: EncoderSettings, monitor: Monitor) -> bool:
    """Section 4.3, in place: classify with each cluster's own number of vectors, update, redistribute.

    Returns False, with nothing changed, where the clusters' spectra say that it would not pay. Keeps the best state.
    """
    most = settings.most_vectors
    budget = len(state.labels) * settings.vectors
    if state.means.shape[1] < frame.coordinates.shape[1]:
        return _adapt_wide(frame, state, settings, monitor, budget)
    data = frame.coordinates
    state.resize(data.shape[1], most + SPARE)
    for _ in range(SPECTRUM_STEPS):
        best = update(data, state, monitor.workers), state.labels, state.vectors
    if not adaptation_pays(state.errors, state.counts, state.spread[:, :most], settings.vectors):
        monitor.note("adaptive left out", best[0], 1.0)
        return False
    for round_number in range(ROUNDS):
        state.vectors = distribute(state.spread[:, :most], state.counts, budget)
        error = state.error
        monitor.note("adaptive", error, (round_number + 1) / ROUNDS)
        last = best[0]
        if error < last:
            best = error, state.labels, state.vectors
        if error > last * (1 - settings.tolerance) or round_number == ROUNDS - 1:
            break
        reclassify(data, state, monitor.workers)
        update(data, state, monitor.workers)
    state.labels, state.vectors = best[1], best[2]
    return True


def _adapt_wide(frame: GlobalFrame, state: Subspaces, settings: EncoderSettings, monitor: Monitor, budget: int) -> bool:
    """`adapt` on the leading values that the state has, most sweeps among neighbours."""
    most = settings.most_vectors
    work = Work.of(frame, state, settings, monitor)
    state.resize(state.means.shape[1], most + SPARE)
    for _ in range(SPECTRUM_STEPS):
        error = work.fit(state, state.means.shape[1])
    best = error, state.labels, state.vectors
    if not adaptation_pays(state.errors, state.counts, state.spread[:, :most], settings.vectors):
        monitor.note("adaptive left out", error, 1.0)
        return False
    for number in range(WIDE_ROUNDS):
        state.vectors = distribute(state.spread[:, :most], state.counts, budget)
        error = state.error + float(frame.tail[state.means.shape[1]])
        monitor.note("adaptive", error, (number + 1) / WIDE_ROUNDS)
        last = best[0]
        if error < last:
            best = error, state.labels, state.vectors
        # Clusters of many vectors keep few points, for which more vectors are cheap: later rounds may raise it.
        if error > last * (1 - settings.tolerance / 2):
            break
        if number < WIDE_ROUNDS - 1:
            work.sweep(state, error, number % SURVEY_EVERY == 0)
    state.labels, state.vectors = best[1], best[2]
    return True
