# SPDX-License-Identifier: GPL-3.0-or-later
"""Numbers of vectors that differ between clusters (Sloan et al. 2003, section 4.3)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .clustered_pca import Work
from .global_frame import GlobalFrame
from .monitor import Monitor
from .settings import EncoderSettings
from .subspaces import SPARE, Subspaces

# Rounds of redistributing vectors and reclassifying, at most, and of signals whose sweeps on all values would cost most
# of the time; the relative decrease of the squared error, in tolerances, below which a round was in vain, and after how
# many of those in a row it ends; which look at all subspaces.
ROUNDS, WIDE_ROUNDS, PATIENCE, MOST_IN_VAIN, SURVEY_EVERY = 12, 16, 0.05, 2, 6
# Relative decrease of the squared error for which it is worth while: foretold by the spectra or, as points that follow
# their prices often gain ten times as much, shown by the first rounds TRIED.
WORTH, TRIED = 0.02, 4
# Updates after vectors are added, so that power steps find the spectra that decide about them.
SPECTRUM_STEPS = 2


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
    used = np.bincount(cluster[affordable], minlength=clusters)
    # What is left may buy vectors of smaller clusters; a cluster that can't pay for its next one gets no later one.
    left, closed = budget - int(costs[affordable].sum()), np.zeros(clusters, bool)
    for number, cost in zip(cluster[~affordable], costs[~affordable], strict=True):
        if left < counts[counts > 0].min():
            break
        if cost > left or closed[number]:
            closed[number] = True
        else:
            used[number] += 1
            left -= int(cost)
    return used


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
    """Whether redistributing vectors would lower the squared error by more than WORTH, from the spectra at hand.

    errors: (K,) with `vectors` vectors each; gains: (K, q) D_i^2 of more vectors than that.
    """
    used = distribute(gains, counts, int(counts.sum()) * vectors)
    most = np.arange(gains.shape[1])
    now = np.where(most < vectors, gains, 0.0).sum()
    then = np.where(most < used[:, None], gains, 0.0).sum()
    return bool(then - now > WORTH * errors.sum())


def adapt(frame: GlobalFrame, state: Subspaces, settings: EncoderSettings, monitor: Monitor) -> bool:
    """Section 4.3, in place, on the values that the state has: classify with each cluster's own number of vectors,
    update, redistribute.

    Points go where squared error and weights together cost least, at the price for which the last vector was bought.
    By the error alone, clusters of many vectors fill up with points for which few would do, and the vectors that this
    costs them are missed elsewhere (measured: 2 to 5 % more error). Keeps the best state. Returns False, with points
    and vectors as they were, where neither the clusters' spectra nor the first rounds say that it pays.
    """
    most = settings.most_vectors
    budget = len(state.labels) * settings.vectors
    work = Work.of(frame, state, settings, monitor)
    width = state.means.shape[1]
    state.resize(width, most + SPARE)
    for _ in range(SPECTRUM_STEPS):
        error = work.fit(state, width)
    best = even = error, state.labels, state.vectors
    pays = adaptation_pays(state.errors, state.counts, state.spread[:, :most], settings.vectors)
    in_vain = 0
    rounds = WIDE_ROUNDS if width < frame.coordinates.shape[1] else ROUNDS
    for number in range(rounds):
        state.vectors = distribute(state.spread[:, :most], state.counts, budget)
        error = state.error + float(frame.tail[state.means.shape[1]])
        monitor.note("adaptive", error, (number + 1) / rounds)
        last = best[0]
        if error < last:
            best = error, state.labels, state.vectors
        # Clusters of many vectors keep few points, for which more vectors are cheap: a round may raise it.
        pays |= best[0] < (1.0 - WORTH) * even[0]
        in_vain = in_vain + 1 if error > last * (1 - PATIENCE * settings.tolerance) else 0
        if in_vain == MOST_IN_VAIN or (number + 1 >= TRIED and not pays):
            break
        if number < rounds - 1:
            state.price = _price(state)
            work.sweep(state, error, number % SURVEY_EVERY == 0)
    if not pays:
        monitor.note("adaptive left out", even[0], 1.0)
        best = even
    state.labels, state.vectors, state.price = best[1], best[2], 0.0
    return pays


def _price(state: Subspaces) -> float:
    """What the least useful vector in use saves for each weight that it costs."""
    used = np.arange(state.spread.shape[1]) < state.vectors[:, None]
    rates = (state.spread / np.maximum(state.counts, 1)[:, None])[used]
    return float(rates.min(initial=np.inf)) if len(rates) else 0.0
