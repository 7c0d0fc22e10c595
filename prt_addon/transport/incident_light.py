# SPDX-License-Identifier: GPL-3.0-or-later
"""Light that reaches glossy receivers from other surfaces: from the hits of the gather's rays, for all columns at once.

The incident radiance from direction s is the exit radiance of what is met there, so each receiver's indirect transfer
is sum over hits of w y_i(s) L(hit, -s): small products (functions x hits) (hits x columns), whatever L is.
"""

from __future__ import annotations

from collections.abc import Generator, Iterator
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from ..basis.spherical_harmonics import evaluate, order_of
from ..linear_algebra import sparse_multiply, wide_batched_multiply
from ..scene.scene_mesh import SceneMesh
from .hit_record import HitRecord
from .receiver_set import ReceiverSet

# Receivers, and numbers in the largest temporary array (32 MB in single precision), of one block.
BLOCK = 1024
NUMBERS = 1 << 23
# Items of a group are padded to a multiple of this with zeros, so that groups of equal length are multiplied at once.
PADDING = 4


class SurfaceRadiance(Protocol):
    """What hit surfaces send back along the rays, per column and channel (values = columns * channels)."""

    values: int

    def along(self, hits: NDArray[np.int64]) -> NDArray[np.float32]:
        """Exit radiance (h, values) of these hits of the record, towards their receivers."""


class _Corners:
    """The triangle corners that a record's hits lie between, as places in an array of receivers."""

    def __init__(self, record: HitRecord, scene: SceneMesh, place: NDArray[np.int64]) -> None:
        """place: (2 * points,) by key, -1 where there is none."""
        self.record, self._triangles, self._place = record, scene.triangles, place
        self._points = len(scene.points)

    def of(self, hits: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
        """Places (h, 3) and weights (h, 3); a corner without a place has place 0 and weight 0."""
        record = self.record
        key = self._triangles[record.triangle[hits]] + np.where(record.front[hits], 0, self._points)[:, None]
        u, v = record.u[hits], record.v[hits]
        weights = np.stack([np.float32(1.0) - u - v, u, v], axis=1)
        place = self._place[key]
        weights[place < 0] = 0.0
        return np.maximum(place, 0), weights


class DiffuseRadiance:
    """Diffuse exit radiance: what receivers send in every direction.

    radiance: (r, columns, channels) of the gather's receivers: albedo times transfer, all bounces included. Surfaces
    beyond the gather's last generation are black, as they are in its operator.
    """

    def __init__(self, record: HitRecord, scene: SceneMesh, receivers: ReceiverSet, radiance: NDArray[np.float32],
                 ) -> None:
        place = np.full(2 * len(scene.points), -1, np.int64)
        place[receivers.key] = np.arange(len(receivers))
        self._corners = _Corners(record, scene, place)
        self._radiance = np.ascontiguousarray(radiance, np.float32).reshape(len(receivers), -1)
        self.values = self._radiance.shape[1]

    def along(self, hits: NDArray[np.int64]) -> NDArray[np.float32]:
        """Radiance (h, values): interpolated between the corners."""
        place, weights = self._corners.of(hits)
        first = np.arange(0, 3 * len(hits) + 1, 3)
        matrix = sparse.csr_array((weights.ravel(), place.ravel(), first), shape=(len(hits), len(self._radiance)))
        return sparse_multiply(matrix, self._radiance)


class GlossyRadiance:
    """View-dependent exit radiance of glossy receivers, from their own matrices: one glossy bounce.

    key: (g,) of the glossy receivers; frames: (g, 3, 3), rows tangent, bitangent, normal; matrices: (g, rows, columns,
    channels); functions: (rows,) numbers of the hemispherical functions that the rows are coefficients of.
    """

    def __init__(self, record: HitRecord, scene: SceneMesh, key: NDArray[np.int64], frames: NDArray[np.float64],
                 matrices: NDArray[np.float32], functions: NDArray[np.int64]) -> None:
        place = np.full(2 * len(scene.points), -1, np.int64)
        place[key] = np.arange(len(key))
        self._corners = _Corners(record, scene, place)
        self._frames, self._functions = frames.astype(np.float32).reshape(-1, 9), np.asarray(functions)
        self._matrices = matrices.reshape(len(matrices), matrices.shape[1], -1)
        self._order = int(np.sqrt(self._functions.max(initial=0))) + 1
        self.values = self._matrices.shape[2]

    def along(self, hits: NDArray[np.int64]) -> NDArray[np.float32]:
        """Radiance (h, values) towards the receivers: each corner's in its own frame, interpolated. Corners are sorted
        by their receiver, whose matrix is then read once for all rays that meet it."""
        place, weights = self._corners.of(hits)
        entry = np.flatnonzero(weights.ravel() > 0.0)
        entry = entry[np.argsort(place.ravel()[entry], kind="stable")]
        which, weight = place.ravel()[entry], weights.ravel()[entry]
        values = self._view_functions(which, hits[entry // 3]) * weight[:, None]
        radiance = np.empty((len(entry), self.values), np.float32)
        surfaces, starts, counts = np.unique(which, return_index=True, return_counts=True)
        at_once = max(1, NUMBERS // (values.shape[1] * self.values))
        for group, items, filled in padded_groups(starts, counts, at_once):
            products = wide_batched_multiply(values[items], self._matrices[surfaces[group]])
            radiance[items[filled]] = products[filled]
        back = np.argsort(entry // 3, kind="stable")
        first = np.concatenate([[0], np.cumsum(np.bincount(entry // 3, minlength=len(hits)))])
        ones = np.ones(len(entry), np.float32)
        return sparse_multiply(sparse.csr_array((ones, back, first), shape=(len(hits), len(entry))), radiance)

    def _view_functions(self, which: NDArray[np.int64], hits: NDArray[np.int64]) -> NDArray[np.float32]:
        """Values (e, rows) of the hemispherical functions towards the receivers."""
        record = self._corners.record
        x, y, z = -record.directions.T[:, record.direction[hits]]
        frames = self._frames[which].T
        local = np.stack([frames[i] * x + frames[i + 1] * y + frames[i + 2] * z for i in (0, 3, 6)], axis=1)
        # A surface may be seen from under its shading normal. The functions are fitted to the upper hemisphere and mean
        # nothing below, so such a view sees what the horizon in its azimuth shows, as when it is drawn.
        local[:, 2] = np.maximum(local[:, 2], 0.0)
        length = np.sqrt(np.sum(local ** 2, axis=1, keepdims=True))
        local = np.where(length > 1e-6, local / np.maximum(length, np.float32(1e-6)),
                         np.float32([1.0, 0.0, 0.0]))
        return evaluate(self._order, local)[:, self._functions].astype(np.float32)


@dataclass(frozen=True)
class SumOfRadiances:
    """Several sources at once, all of the same columns; those of one channel count for each of three."""

    sources: tuple[SurfaceRadiance, ...]

    @property
    def values(self) -> int:
        """Columns times channels, of the source with most channels."""
        return max(source.values for source in self.sources)

    def along(self, hits: NDArray[np.int64]) -> NDArray[np.float32]:
        """Exit radiance (h, values)."""
        parts = [source.along(hits) for source in self.sources]
        return sum(part if part.shape[1] == self.values else np.repeat(part, self.values // part.shape[1], axis=1)
                   for part in parts)


def padded_groups(starts: NDArray[np.int64], counts: NDArray[np.int64], at_once: int,
                  ) -> Iterator[tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.bool_]]]:
    """Groups of contiguous items (starts, counts) in sets of equal padded length, at most `at_once` to a set.

    Yields the groups' numbers (k,), their items (k, n) and which of these are items of the group (the others repeat
    one). The padded length of a group depends on its count alone, so sums do not depend on the company.
    """
    length = -(-counts // PADDING) * PADDING
    for padded in np.unique(length[counts > 0]):
        members = np.flatnonzero(length == padded)
        offset = np.arange(padded)
        for start in range(0, len(members), at_once):
            group = members[start:start + at_once]
            filled = offset < counts[group, None]
            yield group, starts[group, None] + np.where(filled, offset, 0), filled


@dataclass(frozen=True)
class IndirectLight:
    """What glossy receivers get from other surfaces.

    rows: (g,) places of the receivers among the gather's; blocked: (g, n^2) from VisibilityCoefficients, whose order n
    is that of the incident functions.
    """

    record: HitRecord
    source: SurfaceRadiance
    rows: NDArray[np.int64]
    blocked: NDArray[np.float32]

    def blocks(self) -> Iterator[slice]:
        """Runs of receivers whose arrays stay bounded."""
        functions = self.blocked.shape[1]
        return bounded_blocks(self.record, self.rows, self.source.values, functions * self.source.values)

    def transfer(self, part: slice) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Of these receivers: T (b, n^2, values) in the global frame, sum over hits of w y_i(s) L, and what the same
        light adds to their unit-albedo diffuse exit radiance (b, values).

        The gather's few rays project a function of bounded order times a radiance that varies little: their error on
        the blocked directions alone is known from the many shadow rays, and taken out in proportion to the mean
        radiance (a control variate). Surfaces of equal radiance are so exact up to the shadow rays' own error.
        """
        record, rows = self.record, self.rows[part]
        counts = record.first[rows + 1] - record.first[rows]
        result = np.zeros((len(rows), self.blocked.shape[1], self.source.values), np.float32)
        if not counts.any():
            return result, result[:, 0].copy()
        hits = _hits_of(record, rows)
        radiance = self.source.along(hits)
        functions = evaluate(order_of(self.blocked.shape[1]), record.directions).astype(np.float32)
        at_once = max(1, NUMBERS // (int(counts.max() + PADDING) * max(self.source.values, functions.shape[1])))
        for group, items, filled in padded_groups(np.cumsum(counts) - counts, counts, at_once):
            weights = np.where(filled, record.solid_angle[hits[items]], np.float32(0.0))
            weighted = functions[record.direction[hits[items]]] * weights[:, :, None]
            sums = wide_batched_multiply(weighted.transpose(0, 2, 1), radiance[items])
            sampled = weighted.sum(axis=1)
            mean = sums[:, :1] / sampled[:, :1, None]
            result[group] = sums + (self.blocked[part][group] - sampled)[:, :, None] * mean
        return result, _gathered(record, hits, counts, radiance)


def bounded_blocks(record: HitRecord, rows: NDArray[np.int64], values: int, numbers: int) -> Iterator[slice]:
    """Runs of receivers (places in rows) of at most BLOCK, with at most NUMBERS numbers at 3 * values for each hit and
    `numbers` for each receiver (one receiver at least)."""
    cost = np.cumsum((record.first[rows + 1] - record.first[rows]) * (3 * values) + numbers)
    start = 0
    while start < len(rows):
        before = cost[start - 1] if start else 0
        stop = max(start + 1, int(np.searchsorted(cost, before + NUMBERS, side="right")))
        stop = min(stop, start + BLOCK, len(rows))
        yield slice(start, stop)
        start = stop


def _hits_of(record: HitRecord, rows: NDArray[np.int64]) -> NDArray[np.int64]:
    """The numbers of all hits of these receivers, one receiver after the other."""
    first, counts = record.first[rows], record.first[rows + 1] - record.first[rows]
    return np.repeat(first - (np.cumsum(counts) - counts), counts) + np.arange(counts.sum())


def irradiance_from(record: HitRecord, source: SurfaceRadiance, rows: NDArray[np.int64],
                    ) -> Generator[float, None, NDArray[np.float32]]:
    """Yield progress, return what these of the gather's receivers get of the source as unit-albedo diffuse exit
    radiance (k, values): a glossy bounce to receivers without glossy rows. Their hits must be in the record."""
    result = np.zeros((len(rows), source.values), np.float32)
    for part in bounded_blocks(record, rows, source.values, source.values):
        hits = _hits_of(record, rows[part])
        counts = record.first[rows[part] + 1] - record.first[rows[part]]
        result[part] = _gathered(record, hits, counts, source.along(hits))
        yield part.stop / len(rows)
    return result


def _gathered(record: HitRecord, hits: NDArray[np.int64], counts: NDArray[np.int64], radiance: NDArray[np.float32],
              ) -> NDArray[np.float32]:
    """Unit-albedo diffuse exit radiance (b, values) of receivers with so many hits each, from the hits' radiance."""
    first = np.concatenate([[0], np.cumsum(counts)])
    matrix = sparse.csr_array((record.share[hits], np.arange(len(hits)), first), shape=(len(counts), len(hits)))
    return sparse_multiply(matrix, radiance)
