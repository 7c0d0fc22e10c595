# SPDX-License-Identifier: GPL-3.0-or-later
"""Lights that look alike to a zone merge (Kristensen et al. 2005, section 4.1).

Two lights may merge if delta = w1 |p_j - p_k| + w2 max_c ||X_j^c - X_k^c|| + V_jk < 1 (eq. 9), X_j^c the response of
receiver c to light j, V_jk 1 where geometry lies between them; two clusters, if all their pairs may. The pair of least
largest delta merges first: complete linkage (the paper calls it single linkage but asks for all pairs).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Literal, Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.cluster.hierarchy import fcluster, linkage

from ..tracing.tracer import Tracer
from .light_visibility import visible_between

Single = NDArray[np.float32]
Pairs = NDArray[np.intp]
Visibility = Callable[[Pairs, Pairs], NDArray[np.bool_]]

# Delta of pairs that may not merge. Any value from 1 on gives the same clusters: complete linkage takes the largest
# delta of two clusters, so one such pair keeps them apart whatever it says.
FAR = 2.0
# Default weights: lights farther apart than this fraction of the scene's size never merge, nor do lights whose
# responses differ by more than this fraction of the largest response anywhere.
FARTHEST = 0.5
LARGEST_DIFFERENCE = 0.05
# Numbers of responses held at once beyond what the caller holds (32 MB), and receivers whose differences stay in
# the cache.
BLOCK_NUMBERS = 8_000_000
MOST_RECEIVERS = 4096
# Receivers that stand for all in the lower bound of a difference, beside each light's brightest: brightest of parts.
PARTS = 4
SEARCHED = 8192
# Lights compared with another one at once: their rows fit the cache.
TOGETHER = 16
# Responses of a cluster's lights that lie this far below the largest count as this large in the harmonic mean.
HARMONIC_FLOOR = 0.25


class Responses(Protocol):
    """(receivers, lights, values) float32 from which runs of receivers are read, an array or one on disk (memmap)."""

    shape: tuple[int, ...]

    def __getitem__(self, part: slice) -> NDArray[np.floating]:
        ...


def default_weights(scene_size: float, largest_response: float, farthest: float = FARTHEST,
                    largest_difference: float = LARGEST_DIFFERENCE) -> tuple[float, float]:
    """w1 (1/m) and w2 (1/response) of eq. 9 from the scene's size, metres, and the largest response of a receiver.

    farthest, largest_difference: fractions of these beyond which two lights never merge. A scene of no size or no
    response has weight 0: there is nothing to tell lights apart by.
    """
    w1 = 1.0 / (farthest * scene_size) if farthest * scene_size > 0.0 else 0.0
    limit = largest_difference * largest_response
    return w1, 1.0 / limit if limit > 0.0 else 0.0


def largest_response(responses: Responses) -> float:
    """The largest length of a receiver's response to one light."""
    return max((float(_lengths(block).max(initial=0.0)) for _, block in _blocks(responses)), default=0.0)


def light_distances(positions: NDArray[np.float64], responses: Responses, w1: float, w2: float,
                    visible: Visibility | None = None) -> NDArray[np.float64]:
    """delta of eq. 9 for all pairs of lights, condensed as scipy's pdist has it; FAR where it is 1 or more.

    positions: (l, 3) metres; responses: (receivers, l, values); visible: whether pairs (two arrays of light numbers)
    see each other; None: all do. Pairs are ruled out by distance, by the receivers that are brightest for one of the
    two, and by visibility before the rest is compared receiver by receiver, until it is known to be 1 or more; so
    what is below 1 is exact. Raises ValueError for weights below 0, or numbers that are not finite.
    """
    count = len(positions)
    if not (0.0 <= w1 < np.inf and 0.0 <= w2 < np.inf):
        raise ValueError(f"light_distances: weights {w1} and {w2} must be finite and not below 0")
    if len(responses.shape) != 3 or responses.shape[1] != count:
        raise ValueError(f"light_distances: responses of shape {responses.shape} for {count} lights")
    first, second = np.triu_indices(count, 1)
    delta = np.full(len(first), FAR)
    with np.errstate(over="ignore"):  # what leaves the range is far
        apart = w1 * np.sqrt(np.sum((positions[first] - positions[second]) ** 2, axis=1))
    kept = np.flatnonzero(apart < 1.0)
    differences = np.zeros(len(kept))
    if w2 > 0.0 and len(kept):
        bound = _lower_bound(responses)
        kept = kept[_delta(apart[kept], w2, bound[first[kept], second[kept]]) < 1.0]
    if visible is not None and len(kept):
        kept = kept[visible(first[kept], second[kept])]
    if w2 > 0.0 and len(kept):
        kept, differences = _largest_differences(responses, first, second, kept, apart, w2)
    delta[kept] = _delta(apart[kept], w2, differences[:len(kept)])
    return np.minimum(delta, FAR)


def merge_lights(positions: NDArray[np.float64], responses: Responses, visible: Visibility | None, w1: float,
                 w2: float) -> NDArray[np.int32]:
    """The cluster (l,) of each light, numbered in the order of their first lights. Arguments as for light_distances."""
    if len(positions) < 2:
        return np.zeros(len(positions), np.int32)
    distances = light_distances(positions, responses, w1, w2, visible)
    tree = linkage(distances, "complete")
    found = fcluster(tree, np.nextafter(1.0, 0.0), "distance")
    _, firsts, numbers = np.unique(found, return_index=True, return_inverse=True)
    return np.argsort(np.argsort(firsts)).astype(np.int32)[numbers]


def mutual_visibility(tracer: Tracer, positions: NDArray[np.float64]) -> Visibility:
    """For `merge_lights`: whether pairs of lights at positions (l, 3) see each other."""
    return lambda first, second: visible_between(tracer, positions[first], positions[second])


def merged_positions(tracer: Tracer, positions: NDArray[np.float64], labels: NDArray[np.integer],
                     ) -> NDArray[np.float64]:
    """Where the lights of clusters go (clusters, 3): to the mean of their lights, or, where one of these does not see
    that (a body or a wall is in between), to the light nearest to it."""
    count = int(labels.max(initial=-1)) + 1
    members = np.bincount(labels, minlength=count)
    mean = np.stack([np.bincount(labels, positions[:, axis], count) for axis in range(3)], axis=1) / members[:, None]
    distance = np.sum((positions - mean[labels]) ** 2, axis=1)
    hidden = np.unique(labels[~visible_between(tracer, mean[labels], positions)])
    order = np.lexsort((np.arange(len(labels)), distance, labels))
    nearest = order[np.searchsorted(labels[order], np.arange(count))]
    mean[hidden] = positions[nearest[hidden]]
    return mean


def merged_response(responses: Responses, labels: NDArray[np.integer], mode: Literal["harmonic", "arithmetic"],
                    channels: int = 1) -> Single:
    """Responses (receivers, clusters, values) float32 of clusters of lights, the mean over their lights.

    responses: (receivers, lights, values) with values = rows * channels, channels running fastest. "harmonic" is the
    paper's mean, applied to the length of each channel's rows; the direction is that of the arithmetic mean. It is
    the plain harmonic mean for positive diffuse responses. A zero would pull it to 0 however many other lights reach
    the receiver, and numbers of both signs could make it larger than any of them; so lengths below HARMONIC_FLOOR of
    the largest count as that: the result is continuous, changes sign with its arguments, and is never longer than the
    arithmetic mean.
    """
    if mode not in ("harmonic", "arithmetic"):
        raise ValueError(f"merged_response: {mode!r} is no mean")
    receivers, _, values = responses.shape
    order = np.argsort(labels, kind="stable")
    count = int(labels.max(initial=-1)) + 1
    starts = np.searchsorted(labels[order], np.arange(count))
    members = np.bincount(labels, minlength=count).astype(np.float32)[None, :, None]
    result = np.empty((receivers, count, values), np.float32)
    for part, block in _blocks(responses):
        block = np.take(block, order, axis=1)
        mean = np.add.reduceat(block, starts, axis=1) / members
        if mode == "harmonic":
            scale = _harmonic_scale(block, labels[order], starts, members, channels)
            mean = (mean.reshape(*mean.shape[:2], -1, channels) * scale[:, :, None, :]).reshape(mean.shape)
        result[part] = mean
    return result


def _harmonic_scale(block: Single, labels: NDArray[np.integer], starts: NDArray[np.intp], members: Single,
                    channels: int) -> Single:
    """Harmonic over arithmetic mean (b, clusters, channels) of the lengths of responses (b, lights, values) whose
    lights are sorted by cluster."""
    lengths = _lengths(block.reshape(*block.shape[:2], -1, channels).swapaxes(2, 3))
    least = np.float32(HARMONIC_FLOOR) * np.maximum.reduceat(lengths, starts, axis=1)
    lengths = np.maximum(lengths, least[:, labels])
    reciprocal = np.add.reduceat(np.divide(1.0, lengths, out=np.zeros_like(lengths), where=lengths > 0.0), starts, axis=1)
    total = reciprocal * np.add.reduceat(lengths, starts, axis=1)
    return np.divide(members ** 2, total, out=np.ones_like(total), where=total > 0.0)


def _lengths(values: NDArray[np.floating]) -> NDArray[np.floating]:
    """Euclidean lengths over the last axis, without leaving single precision's range."""
    count = values.shape[-1]
    if count == 1:
        return np.abs(values[..., 0])
    values = values.astype(_squares_type(values), copy=False)
    if count <= 4:
        squared = np.square(values[..., 0])
        for index in range(1, count):
            squared += np.square(values[..., index])
    else:
        squared = np.vecdot(values, values)  # small
    return np.sqrt(squared, out=squared).astype(np.float32)


def _squares_type(values: NDArray[np.floating]) -> type[np.floating]:
    """float32 where squares of all values that matter beside the largest are within its range, else float64."""
    largest = max(float(values.max(initial=0.0)), -float(values.min(initial=0.0)))
    return np.float32 if largest == 0.0 or 1e-12 < largest < 1e15 else np.float64


def _delta(apart: NDArray[np.float64], w2: float, differences: NDArray[np.floating]) -> NDArray[np.float64]:
    """w1 |p_j - p_k| + w2 max_c ||X_j^c - X_k^c||, inf beyond the range of numbers."""
    with np.errstate(over="ignore"):
        return apart + w2 * differences.astype(np.float64)


def _blocks(responses: Responses, most: int = 2 ** 62) -> Iterator[tuple[slice, Single]]:
    """Runs of receivers and their responses (b, lights, values). Raises ValueError where one is not finite."""
    receivers, lights, values = responses.shape
    size = int(min(max(BLOCK_NUMBERS // max(lights * values, 1), 1), most))
    for start in range(0, receivers, size):
        part = slice(start, min(start + size, receivers))
        block = np.asarray(responses[part], np.float32)
        if not np.isfinite(block.sum(dtype=np.float64)):
            light = int(np.flatnonzero(~np.isfinite(block).all(axis=(0, 2)))[0])
            raise ValueError(f"the response to light {light} is not finite")
        yield part, block


def _lower_bound(responses: Responses) -> Single:
    """A lower bound (l, l) of the largest difference of two lights' responses: the difference at the receivers that
    are brightest for one of the two in each of PARTS runs of receivers, of SEARCHED receivers of all."""
    lights = responses.shape[1]
    bound = np.zeros((lights, lights), np.float32)
    step = max(-(-responses.shape[0] // SEARCHED), 1)
    searched = _EveryFew(responses, step)
    for _, block in _blocks(searched, max(-(-searched.shape[0] // PARTS), 1)):
        brightest = _lengths(block).argmax(axis=0)
        for start in range(0, lights, 64):
            chosen = block[brightest[start:start + 64]]  # (64, lights, values), row j at light j's brightest receiver
            own = chosen[np.arange(len(chosen)), np.arange(start, start + len(chosen))]
            part = bound[start:start + 64]
            np.maximum(part, _lengths(chosen - own[:, None, :]), out=part)
    return np.maximum(bound, bound.T)


class _EveryFew:
    """Every so many receivers of responses."""

    def __init__(self, responses: Responses, step: int) -> None:
        self.responses, self.step = responses, step
        self.shape = (-(-responses.shape[0] // step), *responses.shape[1:])

    def __getitem__(self, part: slice) -> NDArray[np.floating]:
        return self.responses[part.start * self.step:part.stop * self.step:self.step]


def _largest_differences(responses: Responses, first: Pairs, second: Pairs, kept: Pairs, apart: NDArray[np.float64],
                         w2: float) -> tuple[Pairs, Single]:
    """max_c ||X_j^c - X_k^c|| of the pairs that stay below 1, and which pairs these are. kept: numbers of pairs."""
    largest = np.zeros(len(kept), np.float32)
    for _, block in _blocks(responses, MOST_RECEIVERS):
        if not len(kept):
            break
        used = np.union1d(first[kept], second[kept])
        chosen = np.take(block, used, axis=1)
        by_light = np.ascontiguousarray(chosen.transpose(2, 1, 0), _squares_type(chosen))  # (values, lights, receivers)
        place = np.searchsorted(used, second[kept])
        lights, starts = np.unique(first[kept], return_index=True)
        for light, start, end in zip(np.searchsorted(used, lights), starts, [*starts[1:], len(kept)], strict=True):
            for some in range(start, end, TOGETHER):
                part = slice(some, min(some + TOGETHER, end))
                _compare(by_light, light, place[part], largest[part])
        near = _delta(apart[kept], w2, largest) < 1.0
        kept, largest = kept[near], largest[near]
    return kept, largest


def _compare(by_light: Single, light: int, others: Pairs, largest: Single) -> None:
    """Raise largest (m,), in place, to the differences between a light and others (m,) at a block's receivers.
    by_light: (values, lights, receivers)."""
    if len(by_light) == 1:
        difference = np.take(by_light[0], others, axis=0)
        difference -= by_light[0, light]
        np.maximum(largest, difference.max(axis=1), out=largest)
        np.maximum(largest, -difference.min(axis=1), out=largest)
        return
    squared = np.zeros((len(others), by_light.shape[2]), by_light.dtype)
    for values in by_light:
        difference = np.take(values, others, axis=0)
        difference -= values[light]
        squared += np.square(difference, out=difference)
    np.maximum(largest, np.sqrt(squared.max(axis=1)).astype(np.float32), out=largest)
