# SPDX-License-Identifier: GPL-3.0-or-later
"""Numbers of vectors that differ between clusters (Sloan et al. 2003, section 4.3)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .clustered_pca import Report
from .global_frame import GlobalFrame
from .reclassify import reclassify
from .settings import EncoderSettings
from .subspaces import SPARE, Subspaces, update

# Rounds of redistributing vectors and reclassifying.
ROUNDS = 10


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


def adapt(frame: GlobalFrame, state: Subspaces, settings: EncoderSettings, report: Report) -> float:
    """Section 4.3: classify with each cluster's own number of vectors, update, redistribute; returns the error.

    Keeps the state that it was given where redistribution does not lower the error.
    """
    most = settings.most_vectors
    budget = len(state.labels) * settings.vectors
    data = frame.coordinates
    state.resize(data.shape[1], most + SPARE)
    best = update(data, state), state.labels, state.vectors
    for round_number in range(ROUNDS):
        state.vectors = distribute(state.spread[:, :most], state.counts, budget)
        error = state.error
        report("adaptive", error, (round_number + 1) / ROUNDS)
        last = best[0]
        if error < last:
            best = error, state.labels, state.vectors
        if error > last * (1 - settings.tolerance) or round_number == ROUNDS - 1:
            break
        reclassify(data, state)
        update(data, state)
    state.labels, state.vectors = best[1], best[2]
    return best[0]
