# SPDX-License-Identifier: GPL-3.0-or-later
"""Static and iterative clustered PCA (Sloan et al. 2003, sections 4.1 and 4.2) in a rotated signal."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from .global_frame import GlobalFrame
from .reclassify import reclassify
from .seeding import split_seeds
from .settings import EncoderSettings
from .subspaces import SPARE, Subspaces, from_labels, update
from .vector_quantization import lbg, random_means

# Energy that the values left out may hold, relative to the current squared error.
TRUNCATION = 0.1
# Vectors with which the first splits are judged.
SEED_VECTORS = 2
# Power steps for the first vectors of clusters that had none.
FIRST_STEPS = 3
# (stage, squared error in the frame's units, fraction done)
Report = Callable[[str, float, float], None]


def static_labels(frame: GlobalFrame, settings: EncoderSettings) -> NDArray[np.int32]:
    """Section 4.1: LBG from random points of the signal."""
    generator = np.random.default_rng(settings.seed)
    data = frame.coordinates
    return lbg(data, random_means(data, settings.clusters, generator), settings.iterations)


def split_start(frame: GlobalFrame, settings: EncoderSettings, enough: float,
                seed_vectors: int = SEED_VECTORS) -> Subspaces:
    """Subspaces from best-first splits.

    With a target, splits are judged with all vectors and end where the target is met, so that a simple signal gets few
    clusters; otherwise with seed_vectors.
    """
    vectors = settings.vectors if settings.target_error is not None else min(seed_vectors, settings.vectors)
    if settings.target_error is not None:
        width = frame.leading(TRUNCATION * enough)
        labels = split_seeds(frame.coordinates, settings.clusters, vectors, enough - frame.tail[width], lambda _: width)
    else:
        labels = split_seeds(frame.coordinates, settings.clusters, vectors, enough,
                             lambda error: frame.leading(TRUNCATION * error))
    state = from_labels(labels, int(labels.max()) + 1, 1, vectors)
    return state


def random_start(frame: GlobalFrame, settings: EncoderSettings, number: int) -> Subspaces:
    """The paper's own start: random points of the signal, LBG, no vectors yet."""
    generator = np.random.default_rng((settings.seed, number))
    labels = lbg(frame.coordinates, random_means(frame.coordinates, settings.clusters, generator), settings.iterations)
    return from_labels(labels, settings.clusters, frame.coordinates.shape[1], 0)


def converge(frame: GlobalFrame, state: Subspaces, settings: EncoderSettings, tolerance: float,
             values: int | None = None) -> float:
    """Alternate update and classification until the error falls by less than `tolerance` a sweep; returns the error.

    values: how many leading values to work on; None takes what the current error asks for. The error returned counts
    the energy left out as error, so it bounds the true one from above.
    """
    last, error = np.inf, state.error + frame.tail[state.means.shape[1]]
    for _ in range(settings.iterations):
        width = values or max(state.means.shape[1], frame.leading(TRUNCATION * error))
        grown = width > state.means.shape[1]
        if grown:
            state.resize(width, state.bases.shape[1])
        error = update(frame.coordinates[:, :width], state) + frame.tail[width]
        if error >= last * (1 - tolerance) and not grown:
            break
        last = error
        if reclassify(frame.coordinates[:, :width], state) == 0:
            break
    return error


def add_vector(state: Subspaces) -> None:
    """One more vector for every cluster; the spare ones move up."""
    state.vectors += 1
    state.resize(state.means.shape[1], int(state.vectors.max()) + SPARE)


def iterate(frame: GlobalFrame, state: Subspaces, settings: EncoderSettings, enough: float, report: Report) -> float:
    """Section 4.2: vectors added one by one, LBG sweeps in between; at last a sweep on all values."""
    first = int(state.vectors.max(initial=0))
    error = np.inf
    for vectors in range(first, settings.vectors + 1):
        if vectors > first:
            fresh = state.bases.shape[1] == 0
            add_vector(state)
            if fresh:  # nothing to start from: one power step would classify by an arbitrary direction
                for _ in range(FIRST_STEPS):
                    update(frame.coordinates[:, :state.means.shape[1]], state)
        error = converge(frame, state, settings, settings.tolerance)
        report(f"{vectors} vectors", error, (vectors + 1 - first) / (settings.vectors + 2 - first))
        if error <= enough:
            break
    error = converge(frame, state, settings, settings.tolerance, frame.coordinates.shape[1])
    report("all values", error, 1.0)
    return error
