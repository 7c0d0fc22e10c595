# SPDX-License-Identifier: GPL-3.0-or-later
"""Static and iterative clustered PCA (Sloan et al. 2003, sections 4.1 and 4.2) in a rotated signal.

Vectors are added one by one with a few quick sweeps in between, among neighbours and on the leading values only; when
all are there, clusters are rearranged, and exact sweeps on all values end it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .global_frame import GlobalFrame
from .monitor import Monitor
from .neighbours import Neighbours, Sweep, nearest_of_all, reclassify_near
from .rebalancing import exchange, rebalance
from .reclassify import reclassify
from .seeding import split_seeds
from .settings import EncoderSettings
from .subspaces import NARROW, SPARE, Single, Subspaces, from_labels, update
from .vector_quantization import lbg, random_means
from .workers import Workers

# Energy that the values left out may hold, relative to the current squared error.
TRUNCATION = 0.2
# The same while splitting, whose clusters are only a start.
SEED_TRUNCATION = 0.3
# Vectors with which the first splits are judged.
SEED_VECTORS = 2
# Points for each cluster from which the first splits are made.
SEED_POINTS = 48
# Points of which no part is taken.
FEW_POINTS = 1 << 14
# Points for each of the few clusters that tell whether a target is in reach, and the predicted error over the target
# from which on it is not: vectors and sweeps lower the error of splits by a factor of two or three.
REACH_POINTS, OUT_OF_REACH = 128, 8.0
# Relative decrease of the squared error below which sweeps end while vectors are still to be added, and before the
# exact ones, in multiples of the tolerance asked for: what these sweeps leave, later ones find.
WHILE_ADDING, BEFORE_EXACT = 10.0, 2.0
# The same for the exact sweeps at the end, each of which costs as much as four among neighbours.
EXACT = 2.0
# Most rounds of rearranging clusters.
ROUNDS = 2
# Share of the points that a survey must have moved beyond their neighbours for the next one, the first with a number of
# vectors or another with as many, to be worth its time.
WORTH_THE_FIRST, WORTH_ANOTHER = 0.003, 0.005
# Share of the squared error held by the points that a survey tries with all subspaces.
SURVEYED = 0.6
# Of wide signals: sweeps for each number of vectors but the last LAST, and for those, where they help most; after how
# many the first and the next ones look at all subspaces; LBG iterations before all.
FIRST_SWEEPS, LAST_SWEEPS, LAST, SURVEY, SURVEY_EVERY, LBG_ITERATIONS = 3, 10, 1, 1, 3, 6


@dataclass
class Work:
    """What the steps of one iterative encode share."""

    frame: GlobalFrame
    settings: EncoderSettings
    monitor: Monitor
    neighbours: Neighbours
    # Share of the points that the last survey moved to a subspace on no list of neighbours.
    unseen: float = 1.0

    @staticmethod
    def of(frame: GlobalFrame, state: Subspaces, settings: EncoderSettings, monitor: Monitor) -> Work:
        """For an encode that starts from a state."""
        return Work(frame, settings, monitor, Neighbours(len(state.means)))

    def fit(self, state: Subspaces, width: int) -> float:
        """Update a state on `width` leading values; the error returned counts the energy left out as error, so it
        bounds the true one from above."""
        state.resize(width, state.bases.shape[1])
        return update(self.frame.coordinates[:, :width], state, self.monitor.workers) + float(self.frame.tail[width])

    def sweep(self, state: Subspaces, error: float, survey: bool = False) -> tuple[Sweep, float]:
        """One classification among neighbours (survey: of the worst points among all) and one update, on as many values
        as the error asks for."""
        width = state.means.shape[1]
        data, before = self.frame.coordinates[:, :width], state.labels
        sweep = reclassify_near(data, state, self.neighbours.lists(state), self.monitor.workers,
                                SURVEYED if survey else 0.0)
        if survey:
            self.unseen = sweep.unseen
        self.neighbours.learn(before, state.labels, sweep.runner_up)
        return sweep, self.fit(state, max(width, self.frame.leading(TRUNCATION * error)))


def static_labels(frame: GlobalFrame, settings: EncoderSettings, monitor: Monitor) -> NDArray[np.int32]:
    """Section 4.1: LBG from random points of the signal."""
    generator = np.random.default_rng(settings.seed)
    data = frame.coordinates
    return lbg(data, random_means(data, settings.clusters, generator), settings.iterations, monitor.workers)


def split_start(frame: GlobalFrame, settings: EncoderSettings, enough: float, monitor: Monitor,
                seed_vectors: int = SEED_VECTORS) -> Subspaces:
    """Subspaces from best-first splits.

    With a target in reach, splits are judged with all vectors and end where the target is met, so that a simple signal
    gets few clusters. Otherwise they are judged with seed_vectors on a random part of the points, as they are only a
    start, and every point goes to the nearest subspace.
    """
    if settings.target_error is not None and _in_reach(frame, settings, enough, monitor.workers):
        vectors, width = settings.vectors, frame.leading(TRUNCATION * enough)
        labels, _ = split_seeds(frame.coordinates, settings.clusters, vectors, enough - frame.tail[width],
                                lambda _: width, monitor.workers)
        return from_labels(labels, int(labels.max()) + 1, width, vectors)
    vectors = min(seed_vectors, settings.vectors)
    narrow = frame.coordinates.shape[1] <= NARROW  # elsewhere splits cost little beside the rest
    most = settings.clusters * SEED_POINTS if narrow else len(frame.coordinates)
    part, scale = _random_part(frame, settings, most)
    labels, error = split_seeds(part, settings.clusters, vectors, enough / scale,
                                lambda error: frame.leading(SEED_TRUNCATION * error * scale), monitor.workers)
    width = frame.leading(TRUNCATION * error * scale)
    state = from_labels(labels, int(labels.max()) + 1, width, vectors)
    if len(part) < len(frame.coordinates):
        update(part[:, :width], state, monitor.workers)
        state.labels = nearest_of_all(frame.coordinates[:, :width], state, monitor.workers)
    return state


def _random_part(frame: GlobalFrame, settings: EncoderSettings, most: int) -> tuple[Single, float]:
    """About `most` random points of the signal, in their order, and how many points each of them stands for; all where
    that would be nearly all, or where there are so few that it saves nothing."""
    points = len(frame.coordinates)
    if most > 0.7 * points or points < FEW_POINTS:
        return frame.coordinates, 1.0
    chosen = np.random.default_rng(settings.seed).permutation(points)[:most]
    return frame.coordinates[np.sort(chosen)], points / most


def _in_reach(frame: GlobalFrame, settings: EncoderSettings, enough: float, workers: Workers) -> bool:
    """Whether all clusters could meet the target, by splits of few points into few clusters.

    Their squared error falls by about the same factor with each doubling of the clusters. Where the error that this
    predicts is far above the target, no care needs to be spent on stopping in time.
    """
    few, more = settings.clusters // 32, settings.clusters // 8
    part, scale = _random_part(frame, settings, more * REACH_POINTS)
    if few < 2 or scale == 1.0:
        return True
    errors = [split_seeds(part, clusters, settings.vectors, enough / scale,
                          lambda error: frame.leading(TRUNCATION * error * scale), workers)[1] * scale
              for clusters in (few, more)]
    if min(errors) <= enough:
        return True
    falls = np.log(errors[0] / errors[1]) / np.log(more / few)
    return bool(errors[1] * (more / settings.clusters) ** falls < OUT_OF_REACH * enough)


def random_start(frame: GlobalFrame, settings: EncoderSettings, number: int, monitor: Monitor) -> Subspaces:
    """The paper's own start: random points of the signal, LBG, no vectors yet."""
    generator = np.random.default_rng((settings.seed, number))
    means = random_means(frame.coordinates, settings.clusters, generator)
    labels = lbg(frame.coordinates, means, settings.iterations, monitor.workers)
    return from_labels(labels, settings.clusters, frame.coordinates.shape[1], 0)


def settle(work: Work, state: Subspaces, error: float, tolerance: float) -> tuple[float, Sweep]:
    """Alternate classification and update until the error falls by less than `tolerance` a sweep; returns the error
    and the last classification. error: that of the state given, which is fitted."""
    last = error
    for _ in range(work.settings.iterations):
        width = state.means.shape[1]
        sweep, error = work.sweep(state, last)
        if sweep.changed == 0 or (error >= last * (1 - tolerance) and state.means.shape[1] == width):
            break
        last = error
    return error, sweep


def rearrange(work: Work, state: Subspaces, error: float, sweep: Sweep, tolerance: float) -> float:
    """Move clusters to where they help more and settle, a bounded number of times, keeping only what lowers the error;
    returns the error. sweep: the last classification."""
    for _ in range(ROUNDS):
        before = state.copy()
        data = work.frame.coordinates[:, :state.means.shape[1]]
        if rebalance(data, state, sweep, work.monitor.workers) == 0:
            break
        now, sweep = settle(work, state, work.fit(state, state.means.shape[1]), tolerance)
        if now >= error:
            state.assign(before)
            break
        error = now
    return error


def iterate(frame: GlobalFrame, state: Subspaces, settings: EncoderSettings, enough: float, monitor: Monitor) -> float:
    """Section 4.2 from a start, in place: vectors added one by one, then exact sweeps on all values; the error."""
    work = Work.of(frame, state, settings, monitor)
    first, last = int(state.vectors.max(initial=0)), settings.vectors
    error = work.fit(state, state.means.shape[1])
    for vectors in range(first, last + 1):
        if vectors > first:  # the first spare vector, fitted with the others
            state.vectors[:] = vectors
            state.resize(state.means.shape[1], vectors + SPARE)
            error = state.error + float(frame.tail[state.means.shape[1]])
        tolerance = settings.tolerance * (BEFORE_EXACT if vectors == last else WHILE_ADDING)
        error, sweep = settle(work, state, error, tolerance)
        if vectors == last and error > enough:
            error = rearrange(work, state, error, sweep, tolerance)
        monitor.note(f"{vectors} vectors", error, (vectors + 1 - first) / (last + 3 - first))
        if error <= enough:
            break
    error = polish(work, state, enough)
    monitor.note("all values", error, 1.0)
    return error


def wide_start(frame: GlobalFrame, settings: EncoderSettings, monitor: Monitor) -> Subspaces:
    """The paper's own start, random points and a few LBG iterations, on the leading values that tell means apart."""
    width = frame.leading(TRUNCATION * float(frame.tail[0]))
    data = np.ascontiguousarray(frame.coordinates[:, :width])
    means = random_means(data, settings.clusters, np.random.default_rng(settings.seed))
    labels = lbg(data, means, min(settings.iterations, LBG_ITERATIONS), monitor.workers)
    return from_labels(labels, settings.clusters, width, 0)


def iterate_wide(frame: GlobalFrame, settings: EncoderSettings, enough: float, monitor: Monitor) -> Subspaces:
    """Section 4.2 for signals of many values and points, whose exact sweeps on all values would cost most of the time.

    Measured (Buddha, 24 x 25, 8 vectors): sweeps among neighbours alone end 5 % higher than with one sweep among all
    subspaces per number of vectors; and on the leading values that leave out a tenth of the error they end as low as on
    all values.
    """
    state = wide_start(frame, settings, monitor)
    work = Work.of(frame, state, settings, monitor)
    error = work.fit(state, state.means.shape[1])
    for vectors in (*range(0, settings.vectors, settings.together), settings.vectors):
        if vectors:
            state.vectors[:] = vectors
            state.resize(state.means.shape[1], vectors + SPARE)
        sweeps = FIRST_SWEEPS if vectors <= settings.vectors - LAST else LAST_SWEEPS
        for number in range(min(settings.iterations, sweeps)):
            survey = number % SURVEY_EVERY == SURVEY and work.unseen > (
                WORTH_THE_FIRST if number == SURVEY else WORTH_ANOTHER)
            sweep, error = work.sweep(state, error, survey)
            # While more sweeps will mend what a move spoils, any that promises to help is made.
            chosen = sweep if 0 < vectors < settings.vectors and number == SURVEY else None
            if chosen is not None or (state.counts == 0).any():
                width = state.means.shape[1]
                if rebalance(frame.coordinates[:, :width], state, chosen, monitor.workers):
                    error = work.fit(state, width)
            if sweep.changed == 0:
                break
        monitor.note(f"{vectors} vectors", error, (vectors + 1) / (settings.vectors + 2))
        if error <= enough:
            break
    if vectors == settings.vectors and error > enough:
        error = rearrange(work, state, error, sweep, settings.tolerance * BEFORE_EXACT)
    monitor.note("rearranged", error, 1.0)
    return state


def polish(work: Work, state: Subspaces, enough: float) -> float:
    """Exact sweeps on all values until the error falls by less than the tolerance; returns it.

    Clusters that lost all points restart in the worst approximated ones.
    """
    data, workers = work.frame.coordinates, work.monitor.workers
    last = work.fit(state, data.shape[1])
    for _ in range(work.settings.iterations):
        changed = reclassify(data, state, workers)
        error = update(data, state, workers)
        if error > enough and (state.counts == 0).any() and rebalance(data, state, None, workers):
            error = update(data, state, workers)
        if changed == 0 or error >= last * (1 - EXACT * work.settings.tolerance):
            break
        last = error
    return error


def disturb(frame: GlobalFrame, state: Subspaces, settings: EncoderSettings, enough: float, monitor: Monitor,
            trials: int) -> float:
    """Leave a local minimum by exchanging a cluster of small use for half of one of large error, both drawn at random,
    and settling anew, `trials` times; only what lowers the error stays. Returns the error.

    For small signals, where the minimum depends most on chance and a trial costs little.
    """
    work = Work.of(frame, state, settings, monitor)
    generator = np.random.default_rng((settings.seed, trials))
    best = polish(work, state, enough)
    for trial in range(trials):
        if best <= enough:
            break
        moved = state.copy()
        sweep, _ = work.sweep(moved, best)
        if not exchange(frame.coordinates, moved, sweep, generator):
            break
        settle(work, moved, work.fit(moved, moved.means.shape[1]), settings.tolerance)
        error = polish(work, moved, enough)
        if error < best:
            best = error
            state.assign(moved)
        monitor.note(f"trial {trial}", best, (trial + 1) / trials)
    return best
