# SPDX-License-Identifier: GPL-3.0-or-later
"""Direct light of highlights in a cubemap's columns: what receivers see of every texel, without the cosine.

The transfer of a texel's light to incident radiance is T_ij = integral over texel j of V(s) y_i(s) ds. The shadow rays
of diffuse transfer know V already; it is kept as a byte for each direction (6 KB for each receiver with 6 x 32 x 32
directions) and turned into T block by block, as whole T take 200 times as much. A texel is the mean over its
directions by their exact solid angles, and what the finite directions miss of the open hemisphere is known and added
in proportion to what is seen (a control variate, as in spherical harmonics), so that open receivers are exact under a
white sky. Texels do not ring, so no light is windowed.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ..basis.cubemap import grid_solid_angles, sample_directions, texel_count, texel_edges
from ..basis.spherical_harmonics import evaluate, expand_bands, zonal_hemisphere
from ..linear_algebra import multiply
from .hemisphere_visibility import VisibilityCoefficients
from .receiver_set import ReceiverSet, facing_cosines, weigh_by_faces

Single = NDArray[np.float32]

SEEN = 255  # the byte of a direction that is seen above all faces
# Numbers of a part of T that is summed at once: it stays in the cache.
CACHED = 1 << 19


def texel_directions(r: int, samples: int) -> Single:
    """(6 r r samples^2, 3) of a fill, texel by texel."""
    return np.ascontiguousarray(sample_directions(r, samples).reshape(-1, 3), np.float32)


def part_solid_angles(r: int, samples: int) -> NDArray[np.float64]:
    """Exact solid angles (6 r r samples^2,) of the texels' parts, in the order of `texel_directions`."""
    face = grid_solid_angles(texel_edges(r * samples)).reshape(r, samples, r, samples).transpose(0, 2, 1, 3)
    return np.tile(face.ravel(), 6)


@dataclass(frozen=True)
class Sample:
    """What a chunk of directions adds: places, among all directions and among the chosen receivers; seen (d, b) uint8;
    sums (k, b): integrals over the open hemisphere and its blocked part."""

    directions: slice
    place: slice
    seen: NDArray[np.uint8]
    sums: tuple[Single, ...]


class TexelVisibility:
    """Collects the visibility of the chosen receivers (r,) bool; blocked_order: also of the blocked part, as
    coefficients for interreflection (0: not). As `HemisphereVisibility` for spherical harmonics."""

    def __init__(self, chosen: NDArray[np.bool_], directions: int, blocked_order: int = 0) -> None:
        self.chosen, self.order = chosen, blocked_order
        self._before = np.concatenate([[0], np.cumsum(chosen)])
        count = int(self._before[-1])
        self._seen = np.zeros((directions, count), np.uint8)
        self._open, self._blocked = (np.zeros((blocked_order ** 2, count), np.float32) for _ in range(2))

    def sample(self, receivers: ReceiverSet, place: slice, which: slice, directions: Single, solid_angles: Single,
               cosines: Single, visible: Single) -> Sample | None:
        """The chunk `which` of directions (d, 3); cosines and visible cosines (d, b) as diffuse transfer has them. Safe
        to run in a thread; None where no receiver of the block is chosen."""
        chosen = np.flatnonzero(self.chosen[place])
        if not len(chosen):
            return None
        own, seen = np.take(cosines, chosen, axis=1), np.take(visible, chosen, axis=1)
        divisor = np.maximum(own, np.finfo(np.float32).tiny)
        seen /= divisor
        sums: tuple[Single, ...] = ()
        if self.order:
            share = cosines.copy()
            weigh_by_faces(receivers, place, directions, share)
            share = np.take(share, chosen, axis=1)
            share /= divisor
            share -= seen
            basis = np.ascontiguousarray((evaluate(self.order, directions) * solid_angles[:, None]).T, np.float32)
            sums = multiply(basis, np.sign(own)), multiply(basis, share)
        first, last = self._before[place.start], self._before[place.stop]
        return Sample(which, slice(int(first), int(last)), np.rint(seen * SEEN).astype(np.uint8), sums)

    def add(self, sample: Sample) -> None:
        """Add a sample; in the order of the tasks, so that sums do not depend on threads."""
        self._seen[sample.directions, sample.place] = sample.seen
        if sample.sums:
            self._open[:, sample.place] += sample.sums[0]
            self._blocked[:, sample.place] += sample.sums[1]

    def result(self, normals: NDArray[np.float64]) -> VisibilityCoefficients:
        """visible: (g, directions) uint8; blocked: (g, blocked_order^2), of receivers with normals (r, 3)."""
        rows = np.flatnonzero(self.chosen)
        blocked = None
        if self.order:
            share = self._blocked[0] / np.maximum(self._open[0], np.finfo(np.float32).tiny)
            missing = open_hemisphere(normals[rows], self.order) - self._open.T
            blocked = (self._blocked.T + share[:, None] * missing).astype(np.float32)
        return VisibilityCoefficients(rows, np.ascontiguousarray(self._seen.T), blocked)


def open_hemisphere(normals: NDArray[np.float64], order: int) -> NDArray[np.float64]:
    """Integrals (g, order^2) of the functions over the hemispheres of normals (g, 3)."""
    return evaluate(order, normals) * expand_bands(zonal_hemisphere(order))


@dataclass(frozen=True)
class TexelLight:
    """Direct light of g receivers in a cubemap's columns, r texels along an edge and samples^2 directions in each.

    seen: (g, 6 r r samples^2) uint8 of `TexelVisibility`; normals: (g, 3); order: of the incident functions. None of
    seen: the columns without direct light.
    """

    r: int
    samples: int
    seen: NDArray[np.uint8] | None
    normals: NDArray[np.float64]
    order: int

    @property
    def columns(self) -> int:
        """Texels."""
        return texel_count(self.r)

    @cached_property
    def _directions(self) -> Single:
        return texel_directions(self.r, self.samples)

    @cached_property
    def _weighted(self) -> Single:
        """Functions times solid angles (order^2, directions)."""
        values = evaluate(self.order, self._directions) * part_solid_angles(self.r, self.samples)[:, None]
        return np.ascontiguousarray(values.T, np.float32)

    @cached_property
    def _by_sample(self) -> Single:
        """The same (samples^2, order^2, columns)."""
        return np.ascontiguousarray(self._weighted.reshape(len(self._weighted), self.columns, -1).transpose(2, 0, 1))

    def incident(self, part: slice) -> Single | None:
        """T (b, order^2, columns) in the global frame."""
        if self.seen is None:
            return None
        seen = self.seen[part].astype(np.float32) / np.float32(SEEN)
        missing = self._missing(self.normals[part])
        area = part_solid_angles(self.r, self.samples).astype(np.float32)
        seen_area = (seen * area).reshape(len(seen), self.columns, -1).sum(axis=2)
        seen_area /= np.float32(2.0 * np.pi)  # of an open receiver, columns add up to about 1
        by_sample = np.ascontiguousarray(seen.reshape(len(seen), self.columns, -1).transpose(2, 0, 1))
        result = np.empty((len(seen), self.order ** 2, self.columns), np.float32)
        at_once = max(1, CACHED // result[:1].size)
        for start in range(0, len(seen), at_once):
            block = slice(start, start + at_once)
            total = missing[block, :, None] * seen_area[block, None, :]
            product = np.empty_like(total)
            for shown, functions in zip(by_sample, self._by_sample, strict=True):
                np.multiply(shown[block, None, :], functions, out=product)
                total += product
            result[block] = total
        return result

    def _missing(self, normals: NDArray[np.float64]) -> Single:
        """What the directions miss of the functions' integrals over open hemispheres: (b, order^2)."""
        facing = np.sign(facing_cosines(self._directions, normals))
        sampled = multiply(self._weighted, facing)
        return (open_hemisphere(normals, self.order) - sampled.T).astype(np.float32)

    @staticmethod
    def white(rows: Single) -> Single:
        """What rows (b, k, columns, channels) make of a white world: (b, k, channels), up to a factor."""
        return rows.sum(axis=2)
