# SPDX-License-Identifier: GPL-3.0-or-later
"""Moves that alternating classification and update cannot make: a cluster that helps little goes where error is large.

The alternation ends in a local minimum whose clusters differ in use. Dissolving the cluster whose points lose least by
going to their second nearest, and splitting the one that gains most by it, leaves such a minimum (after Patane and
Russo 2001, "The enhanced LBG algorithm", whose utility is the error here). Clusters that ran empty cost nothing to
dissolve, so they restart in the points that are approximated worst.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .neighbours import Sweep
from .seeding import fit_error, split_points
from .subspaces import Fit, Single, Subspaces
from .workers import SERIAL, Workers

# Share of the clusters that one round moves at most.
MOST_MOVED = 0.1
# Share of the clusters among which a random exchange chooses what to dissolve and what to split.
DRAWN = 0.5


def rebalance(data: Single, state: Subspaces, sweep: Sweep | None, workers: Workers = SERIAL) -> int:
    """Change labels in place by moves that lower the squared error by estimate; returns how many.

    sweep: the last classification of data (p, d), whose labels the fitted state still has; without one only empty
    clusters move. Call `update` next.
    """
    empty = state.counts == 0
    cost = np.where(empty, 0.0, np.inf if sweep is None else sweep.cost)
    most = max(1, int(MOST_MOVED * len(cost)), int(empty.sum()))
    cheap = [cluster for cluster in np.argsort(cost, kind="stable") if np.isfinite(cost[cluster])]
    held: set[int] = set()
    members, errors, moved = state.members(), state.errors, 0
    for large in np.argsort(-errors, kind="stable")[:2 * most]:
        cheap = [cluster for cluster in cheap if cluster not in held]
        if moved == most or not cheap or cost[cheap[0]] >= errors[large]:
            break
        workers.tick()
        small = cheap[0]
        if large in held or large == small:
            continue
        half = _second_half(data[members[large]], state, int(large), float(cost[small]))
        if half is not None:
            held |= {large, small, *_move(state, sweep, members[small], members[large][half], large, small)}
            moved += 1
    return moved


def exchange(data: Single, state: Subspaces, sweep: Sweep, generator: np.random.Generator) -> bool:
    """Dissolve a random one of the clusters of least use and split a random one of those of largest error, whatever
    that costs; False where the latter cannot be split. For arguments see `rebalance`."""
    most = max(1, int(np.ceil(DRAWN * len(state.means))))
    members = state.members()
    cost = np.where(state.counts == 0, 0.0, sweep.cost)
    small = generator.choice(np.argsort(cost, kind="stable")[:most])
    candidates = [cluster for cluster in np.argsort(-state.errors, kind="stable")[:most + 1] if cluster != small]
    for large in generator.permutation(candidates):
        half = _second_half(data[members[large]], state, int(large), -np.inf)
        if half is not None:
            _move(state, sweep, members[small], members[large][half], large, small)
            return True
    return False


def _move(state: Subspaces, sweep: Sweep | None, dissolved: NDArray[np.intp], half: NDArray[np.intp], large: int,
          small: int) -> set[int]:
    """Give the points of cluster `small` to their second nearest and half of `large` to it; returns who received."""
    receivers: NDArray[np.int32] = sweep.runner_up[dissolved] if sweep is not None else state.labels[:0]
    if len(dissolved):
        state.labels[dissolved] = receivers
    state.labels[half] = small
    state.means[small], state.bases[small], state.vectors[small] = (
        state.means[large], state.bases[large], state.vectors[large])
    return set(np.unique(receivers).tolist())


def _second_half(points: Single, state: Subspaces, cluster: int, cost: float) -> NDArray[np.bool_] | None:
    """Which points of a cluster to give to a new one; None where that gains less than the cost or cannot be."""
    if len(points) < 2:
        return None
    vectors = int(state.vectors[cluster])
    whole = Fit(state.means[cluster], state.bases[cluster], state.spread[cluster], float(state.scatter[cluster]))
    split = split_points(points, whole, vectors)
    if split is None or fit_error(points, whole, vectors) - split[3].sum(dtype=np.float64) <= cost:
        return None
    return split[0]
