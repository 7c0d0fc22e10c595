# SPDX-License-Identifier: GPL-3.0-or-later
"""Clustered PCA of a part of the points, which the others then join (Huang & Ramamoorthi 2010, section 6).

Where most points are linear combinations of a few dense ones near them, clusters and vectors of the dense points serve
all: the iterative encoder sees these alone, every other point joins the cluster of its nearest dense point, and a few
LBG sweeps over all points, which add no vectors, end it.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ..errors import PRTError
from ..linear_algebra import multiply
from .clustered_pca import Work, settle
from .encoding import Encoding, classify, finish
from .global_frame import CHUNK, GlobalFrame, check_signal, global_frame
from .monitor import Monitor, Progress
from .settings import EncoderSettings
from .subspaces import SPARE, Subspaces
from .workers import Workers

# Energy of the dense points that the frame made from them may leave out.
UNSEEN = 1e-4
# Vectors added together to the dense points' clusters, which are only a start for the sweeps over all points: a sixth
# to a third of the time saved, 0 to 0.9 % more error (bunny and its ground, 6 x 16 x 16 and 6 x 32 x 32).
TOGETHER = 2
# Sweeps over all points: most of them, and the relative decrease of the squared error below which they end.
SWEEPS, TOLERANCE = 6, 0.01


def encode_dense_first(signal: NDArray[np.floating], dense: NDArray[np.bool_], joins: NDArray[np.integer],
                       settings: EncoderSettings, progress: Progress | None = None) -> Encoding:
    """As `encoding.encode` of a signal (p, n) without a metric, from its dense points.

    dense: (p,) bool; joins: (p,) for every point a dense point like it, itself for dense ones. Its squared_error counts
    all points on all values, as there. Raises PRTError for a bad signal or where `joins` leads to a point that is not
    dense.
    """
    check_signal(signal)
    if dense.shape != (len(signal),) or joins.shape != dense.shape or not dense[joins].all():
        raise PRTError("signal", "some points join points that are not dense", "Pass a dense point for each")
    monitor = Monitor(progress)
    with Workers(settings.threads, monitor.tick) as monitor.workers:
        part = global_frame(np.ascontiguousarray(signal[dense]), None, monitor.workers, UNSEEN)
        monitor.unit = part.scale**2
        few, left_out = classify(part, replace(settings, together=max(TOGETHER, settings.together)), monitor)
        monitor.span(0.6, 0.95)
        frame = _all_points(signal, part, monitor.workers)
        number = np.cumsum(dense) - 1
        state = _joined(few, few.labels[number[joins]], settings)
        _sweep(frame, state, settings, monitor)
        result = finish(frame, state, None, monitor.workers)
    monitor.note("done", float(result.discarded.sum()) / monitor.unit, 1.0)
    return replace(result, history=tuple(monitor.history), adaptive_left_out=left_out)


def _all_points(signal: NDArray[np.floating], part: GlobalFrame, workers: Workers) -> GlobalFrame:
    """The frame of the dense points, with all points in it."""
    mean = part.mean.astype(signal.dtype)
    forward = np.ascontiguousarray(part.forward * part.scale, np.float32)
    coordinates = np.empty((len(signal), forward.shape[1]), np.float32)

    def project(start: int) -> tuple[NDArray[np.float64], float, float]:
        block = signal[start:start + CHUNK]
        energy = float(np.sum(np.square(block * (1 / part.scale)), dtype=np.float64))
        centred = np.ascontiguousarray((block - mean) * (1 / part.scale), np.float32)
        multiply(centred, forward, out=coordinates[start:start + CHUNK])
        whole = float(np.sum(np.square(centred), dtype=np.float64))
        return np.square(coordinates[start:start + CHUNK]).sum(axis=0, dtype=np.float64), whole, energy

    seen, whole, energy = np.zeros(forward.shape[1]), 0.0, 0.0
    for squares, block_whole, block_energy in workers.run(project, range(0, len(signal), CHUNK)):
        seen += squares
        whole += block_whole
        energy += block_energy
    rest = whole - seen.sum()
    # Of a complete frame, what is left is rounding.
    rest = max(rest, 0.0) if forward.shape[1] < len(forward) else 0.0
    tail = np.append(np.cumsum(seen[::-1])[::-1], 0.0) + rest
    return replace(part, coordinates=coordinates, tail=tail, energy=max(energy, float(tail[0]) * 1e-3))


def _joined(few: Subspaces, labels: NDArray[np.int32], settings: EncoderSettings) -> Subspaces:
    """Subspaces of the dense points, all points classified."""
    state = few.copy()
    state.labels = labels.astype(np.int32)
    state.resize(state.means.shape[1], int(state.vectors.max(initial=0)) + SPARE)
    return state


def _sweep(frame: GlobalFrame, state: Subspaces, settings: EncoderSettings, monitor: Monitor) -> None:
    """LBG sweeps over all points, in place."""
    if len(state.means) == 1:
        return
    work = Work.of(frame, state, replace(settings, iterations=min(SWEEPS, settings.iterations)), monitor)
    error = work.fit(state, max(state.means.shape[1], frame.leading(0.2 * float(frame.tail[0]))))
    error, _ = settle(work, state, error, TOLERANCE)
    monitor.note("all points", error, 1.0)
