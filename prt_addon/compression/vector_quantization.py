# SPDX-License-Identifier: GPL-3.0-or-later
"""Vector quantization by the LBG algorithm (Linde, Buzo and Gray 1980; Sloan et al. 2003, section 4.1)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..linear_algebra import multiply, row_squares
from .subspaces import Single
from .workers import SERIAL, Workers

CHUNK = 1024


def nearest_means(data: Single, means: Single, workers: Workers = SERIAL) \
        -> tuple[NDArray[np.int32], NDArray[np.float32]]:
    """The nearest of means (K, d) to every point of data (p, d), and its squared distance."""
    labels = np.empty(len(data), np.int32)
    squared = np.empty(len(data), np.float32)
    lengths = row_squares(means)
    for start in range(0, len(data), CHUNK):
        workers.tick()
        block = data[start:start + CHUNK]
        distances = multiply(block, means.T)
        distances *= -2
        distances += lengths
        best = distances.argmin(axis=1)
        labels[start:start + CHUNK] = best
        squared[start:start + CHUNK] = row_squares(block - means[best])
    return labels, squared


def cluster_means(data: Single, labels: NDArray[np.int32], clusters: int) -> tuple[Single, NDArray[np.int64]]:
    """Means (K, d) of the points of each label, zero where a label has none, and the numbers of points."""
    counts = np.bincount(labels, minlength=clusters)
    order = np.argsort(labels, kind="stable")
    means = np.zeros((clusters, data.shape[1]), np.float32)
    for cluster, members in enumerate(np.split(order, np.cumsum(counts)[:-1])):
        if len(members):
            means[cluster] = data[members].mean(axis=0, dtype=np.float64)
    return means, counts


def lbg(data: Single, means: Single, iterations: int, workers: Workers = SERIAL) -> NDArray[np.int32]:
    """Labels after alternating classification and means from the given start, until no point switches.

    data: (p, d); means: (K, d). A cluster that loses all points restarts at the point farthest from its own mean.
    """
    labels, squared = nearest_means(data, means, workers)
    for _ in range(iterations):
        means, counts = cluster_means(data, labels, len(means))
        empty = np.flatnonzero(counts == 0)
        means[empty] = data[np.argsort(-squared, kind="stable")[:len(empty)]]
        before = labels
        labels, squared = nearest_means(data, means, workers)
        if np.array_equal(labels, before):
            break
    return labels


def random_means(data: Single, clusters: int, generator: np.random.Generator) -> Single:
    """Random points of the signal as first representatives, all different where the signal has that many."""
    chosen = generator.permutation(len(data))[:clusters]
    return np.ascontiguousarray(data[chosen])
