# SPDX-License-Identifier: GPL-3.0-or-later
"""Clustered PCA of points in groups that share no cluster: the zones of a light cloud (Kristensen et al. 2005, 5)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from .encoding import Encoding, encode
from .monitor import Progress
from .settings import EncoderSettings


def encode_groups(signal: NDArray[np.floating], group: NDArray[np.integer], settings: EncoderSettings,
                  metric: NDArray | None = None, progress: Progress | None = None,
                  ) -> tuple[Encoding, NDArray[np.int32]]:
    """`encode` for each group by itself, joined to one encoding, and every cluster's group (clusters,) int32, sorted.

    group: (p,) of each point. The clusters asked for are shared out by the groups' numbers of points, at least one
    each. Arguments and errors otherwise as for `encode`.
    """
    present, counts = np.unique(group, return_counts=True)
    parts, members, done = [], [], 0
    for number, count in zip(present, counts, strict=True):
        inside = np.flatnonzero(group == number)
        clusters = max(1, round(settings.clusters * count / len(group)))
        share = (done / len(group), count / len(group))
        report = None if progress is None else lambda fraction, share=share: progress(share[0] + share[1] * fraction)
        own = signal if len(present) == 1 else signal[inside]
        parts.append(encode(own, replace(settings, clusters=clusters), metric, report))
        members.append(inside)
        done += count
    if len(parts) == 1:
        return parts[0], np.full(len(parts[0].bases), present[0], np.int32)
    return _joined(parts, members, len(group)), np.repeat(present, [len(p.bases) for p in parts]).astype(np.int32)


def _joined(parts: list[Encoding], members: list[NDArray[np.intp]], points: int) -> Encoding:
    """One encoding of several, each of the points in its members."""
    most = max(part.weights.shape[1] for part in parts)
    cluster, weights = np.empty(points, np.int32), np.zeros((points, most), np.float32)
    bases = np.zeros((sum(len(p.bases) for p in parts), most + 1, parts[0].bases.shape[2]), np.float32)
    first, energy = 0, 0.0
    for part, inside in zip(parts, members, strict=True):
        cluster[inside] = part.cluster + first
        weights[inside, :part.weights.shape[1]] = part.weights
        bases[first:first + len(part.bases), :part.bases.shape[1]] = part.bases
        first += len(part.bases)
        energy += part.squared_error / part.relative_error if part.relative_error > 0.0 else 0.0
    squared = sum(part.squared_error for part in parts)
    history = tuple((t, f"part {number + 1}, {stage}", error) for number, part in enumerate(parts)
                    for t, stage, error in part.history)
    return Encoding(cluster, bases, weights, np.concatenate([p.vectors_per_cluster for p in parts]), squared,
                    squared / energy if energy > 0.0 else 0.0, np.concatenate([p.discarded for p in parts]), history,
                    all(part.adaptive_left_out for part in parts))
