# SPDX-License-Identifier: GPL-3.0-or-later
"""First clusters by best-first two-way splits, each judged by the error with the clusters' own few vectors.

LBG's random seeds ignore that a cluster with vectors may be long and thin; splitting the cluster whose split lowers
the error most puts clusters where the signal bends.
"""

from __future__ import annotations

import heapq
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ..linear_algebra import multiply, row_squares
from .subspaces import SPARE, Fit, Single, fit_subspace, squared_distances
from .workers import SERIAL, Workers

# Alternations of fitting both halves and reassigning their points.
ROUNDS = 2
# Share of the scatter below which an error in single precision is rounding.
CANCELLATION = 1e-4


@dataclass(order=True)
class _Leaf:
    """A cluster in the queue. key: minus its error until its split is known, then minus what the split gains."""

    key: float
    number: int
    members: NDArray[np.intp] = field(compare=False)
    basis: Single = field(compare=False)
    error: float = field(compare=False)
    halves: tuple[_Leaf, _Leaf] | None = field(compare=False, default=None)


def split_points(points: Single, whole: Fit, vectors: int) -> tuple[NDArray[np.bool_], Fit, Fit, Single] | None:
    """Divide points (m, d) between two subspaces of few vectors; None where they cannot be divided.

    whole: the fit of all the points. The first division is by the sign of the first weight. Returns which points are
    the second half's, the fits of the divisions before the last, and the squared distances to the nearer one (m,),
    whose sum the halves' own fits can only lower.
    """
    basis = whole.basis
    side = multiply(points - whole.mean, basis[:1].T)[:, 0] > 0
    result = None
    for _ in range(ROUNDS):
        if not 0 < np.count_nonzero(side) < len(side):
            break
        fits = fit_subspace(points[~side], basis), fit_subspace(points[side], basis)
        first, second = (squared_distances(points, fit, vectors) for fit in fits)
        now = second < first
        if not 0 < np.count_nonzero(now) < len(now):
            break
        result = now, *fits, np.minimum(first, second)
        if np.array_equal(now, side):
            break
        side = now
    return result


def fit_error(points: Single, fit: Fit, vectors: int) -> float:
    """Squared error of a fit to points (m, d) that uses its leading vectors.

    The difference of scatter and D_i^2 is rounding alone where nearly everything is explained (points of very different
    scale); only then are the residuals themselves formed.
    """
    error = float(fit.scatter - fit.spread[:vectors].sum())
    if error > CANCELLATION * fit.scatter:
        return error
    centred = points - fit.mean
    residuals = centred - multiply(multiply(centred, fit.basis[:vectors].T), fit.basis[:vectors])
    return float(row_squares(residuals).sum(dtype=np.float64))


def split_seeds(data: Single, clusters: int, vectors: int, enough: float, width: Callable[[float], int],
                workers: Workers = SERIAL) -> tuple[NDArray[np.int32], float]:
    """Labels (p,) of at most `clusters` clusters of data (p, d) and their squared error; stops early at `enough`.

    width: how many leading values to work on at a squared error; splits start on few values and get more.
    """
    leading = min(width(np.inf) + vectors + SPARE, data.shape[1])
    basis = np.zeros((vectors + SPARE, leading), np.float32)
    for _ in range(3):
        fit = fit_subspace(data[:, :leading], basis)
        basis = fit.basis
    error = fit_error(data[:, :leading], fit, vectors)
    queue = [_Leaf(-error, 0, np.arange(len(data)), basis, error)]
    done: list[_Leaf] = []
    made = 1
    while queue and len(queue) + len(done) < clusters and error > enough:
        workers.tick()
        leaf = heapq.heappop(queue)
        if leaf.halves is None:
            leading = max(leading, width(error))
            error -= leaf.error
            _judge(data[:, :leading], leaf, vectors, made)
            error += leaf.error
            if leaf.halves is None or leaf.key >= 0:
                done.append(leaf)
            else:
                heapq.heappush(queue, leaf)
            continue
        error += leaf.key
        made += 2
        for number, half in enumerate(leaf.halves):
            half.number = made + number
            heapq.heappush(queue, half)
    labels = np.zeros(len(data), np.int32)
    for label, leaf in enumerate(sorted(queue + done, key=lambda leaf: leaf.members[0])):
        labels[leaf.members] = label
    return labels, error


def _judge(data: Single, leaf: _Leaf, vectors: int, number: int) -> None:
    """Try to split a leaf: fills its halves and key, or leaves halves None. Its error becomes that in these data."""
    basis = np.pad(leaf.basis, ((0, 0), (0, data.shape[1] - leaf.basis.shape[1])))
    points = data[leaf.members]
    whole = fit_subspace(points, basis)
    leaf.error = fit_error(points, whole, vectors)
    split = split_points(points, whole, vectors)
    if split is None:
        return
    side, left, right, squared = split
    halves = (leaf.members[~side], left), (leaf.members[side], right)
    errors = [float(squared[half].sum(dtype=np.float64)) for half in (~side, side)]
    if sum(errors) < CANCELLATION * whole.scatter:  # rounding of the distances alone
        errors = [fit_error(data[members], fit_subspace(data[members], fit.basis), vectors) for members, fit in halves]
    leaf.halves = tuple(_Leaf(-error, number, members, fit.basis, error)
                        for (members, fit), error in zip(halves, errors, strict=True))
    leaf.key = sum(errors) - leaf.error
