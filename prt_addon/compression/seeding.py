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

# Alternations of fitting both halves and reassigning their points.
ROUNDS = 4
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


def split_points(points: Single, whole: Fit, vectors: int) -> tuple[NDArray[np.bool_], Fit, Fit] | None:
    """Divide points (m, d) between two subspaces of few vectors; None where they cannot be divided.

    whole: the fit of all the points. The first division is by the sign of the first weight.
    """
    basis = whole.basis
    side = whole.weights[:, 0] > 0
    for _ in range(ROUNDS):
        if not 0 < side.sum() < len(side):
            return None
        fits = fit_subspace(points[~side], basis), fit_subspace(points[side], basis)
        now = squared_distances(points, fits[1], vectors) < squared_distances(points, fits[0], vectors)
        if np.array_equal(now, side):
            break
        side = now
    if not 0 < side.sum() < len(side):
        return None
    return side, fit_subspace(points[~side], fits[0].basis), fit_subspace(points[side], fits[1].basis)


def fit_error(points: Single, fit: Fit, vectors: int) -> float:
    """Squared error of a fit to points (m, d) that uses its leading vectors.

    The difference of scatter and D_i^2 is rounding alone where nearly everything is explained (points of very different
    scale); only then are the residuals themselves formed.
    """
    scatter = fit.squares.sum(dtype=np.float64)
    error = float(scatter - fit.spread[:vectors].sum())
    if error > CANCELLATION * scatter:
        return error
    residuals = points - fit.mean - multiply(fit.weights[:, :vectors], fit.basis[:vectors])
    return float(row_squares(residuals).sum(dtype=np.float64))


def split_seeds(data: Single, clusters: int, vectors: int, enough: float, width: Callable[[float], int]) \
        -> NDArray[np.int32]:
    """Labels (p,) of at most `clusters` clusters of data (p, d); stops early at a squared error of `enough`.

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
    return labels


def _judge(data: Single, leaf: _Leaf, vectors: int, number: int) -> None:
    """Try to split a leaf: fills its halves and key, or leaves halves None. Its error becomes that in these data."""
    basis = np.pad(leaf.basis, ((0, 0), (0, data.shape[1] - leaf.basis.shape[1])))
    points = data[leaf.members]
    whole = fit_subspace(points, basis)
    leaf.error = fit_error(points, whole, vectors)
    split = split_points(points, whole, vectors)
    if split is None:
        return
    side, left, right = split
    errors = fit_error(points[~side], left, vectors), fit_error(points[side], right, vectors)
    leaf.halves = (_Leaf(-errors[0], number, leaf.members[~side], left.basis, errors[0]),
                   _Leaf(-errors[1], number, leaf.members[side], right.basis, errors[1]))
    leaf.key = sum(errors) - leaf.error
