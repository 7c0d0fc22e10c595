# SPDX-License-Identifier: GPL-3.0-or-later
"""Single elements T(x, w_j) of a transfer matrix on demand, whatever computes them, and how many were asked for.

Huang & Ramamoorthi 2010 sample the matrix element by element (section 3). An element is value times factor: the value
is what must be computed (visibility, a path's throughput) and may be interpolated; the factor (cosine, reflection,
solid angle) is known for every element without any rays.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from ..basis.cubemap import cubemap_directions, cubemap_solid_angles
from ..linear_algebra import multiply
from ..tracing.tracer import Tracer
from .receiver_set import ReceiverSet

Single = NDArray[np.float32]
Places = NDArray[np.int64]

# Rays of a task: enough to hide its overhead, few enough that two tasks for each thread stay in the cache.
RAYS = 1 << 16


class Elements(Protocol):
    """A matrix of receivers x columns whose elements are computed on demand.

    columns: 6 r r, cubemap texels. angular: whether values are sampled where they vary (visibility) or on a quarter of
    the grid only (smooth indirect light). highest: the largest value that there can be. asked: elements computed so
    far.
    """

    columns: int
    angular: bool
    highest: float
    asked: int

    def __len__(self) -> int:
        """Receivers."""

    def evaluate(self, receivers: Places, columns: Places) -> Single:
        """Values (m,) of single elements; best in the order of columns, and of near receivers within one."""

    def unknown(self, receivers: Places) -> NDArray[np.bool_]:
        """(n, columns): which elements of these receivers are not known to be zero beforehand."""

    def factor(self, receivers: Places) -> Single:
        """(n, columns): what values are multiplied by."""


class TracedElements(ABC):
    """What elements have in common that take several rays each and are traced in parts, by `_trace` in the tracer's
    threads."""

    tracer: Tracer
    receivers: ReceiverSet
    asked: int

    def __len__(self) -> int:
        return len(self.receivers)

    def evaluate(self, receivers: Places, columns: Places) -> Single:
        """See `Elements`."""
        result = np.empty(len(receivers), np.float32)
        at_once = max(1, RAYS // self._rays_each())
        parts = (slice(start, start + at_once) for start in range(0, len(receivers), at_once))
        for part, (values, rays) in self.tracer.map_in_order(
                lambda part: self._trace(receivers[part], columns[part]), parts):
            result[part] = values
            self.tracer.rays += rays
        self.asked += len(receivers)
        return result

    @abstractmethod
    def _rays_each(self) -> int:
        """Rays, or paths, of an element."""

    @abstractmethod
    def _trace(self, receivers: Places, columns: Places) -> tuple[NDArray[np.floating], int]:
        """Values (m,) of elements and the rays traced for them."""


class PathTracedElements(TracedElements):
    """The same of paths: light that comes round from everywhere."""

    columns: int
    paths: int

    def _rays_each(self) -> int:
        return self.paths

    def unknown(self, receivers: Places) -> NDArray[np.bool_]:
        """All."""
        return np.ones((len(receivers), self.columns), bool)


@dataclass
class MatrixElements:
    """Elements of a matrix (receivers, columns) that is known, for tests and for what another solver has computed."""

    matrix: Single
    angular: bool = True
    highest: float = np.inf
    asked: int = 0

    @property
    def columns(self) -> int:
        """See `Elements`."""
        return self.matrix.shape[1]

    def __len__(self) -> int:
        return len(self.matrix)

    def evaluate(self, receivers: Places, columns: Places) -> Single:
        """See `Elements`."""
        self.asked += len(receivers)
        return self.matrix[receivers, columns]

    def unknown(self, receivers: Places) -> NDArray[np.bool_]:
        """All of them."""
        return np.ones((len(receivers), self.columns), bool)

    def factor(self, receivers: Places) -> Single:
        """One."""
        return np.ones((len(receivers), self.columns), np.float32)


@dataclass
class VisibilityElements:
    """Direct light in cubemap texels, one ray through the middle of each: value = visibility (the share of a receiver's
    faces that the direction is above, 0 where a ray hits), factor = cosine x solid angle / pi, with the receiver's sum
    over an open sky made exact, as in `cubemap_transfer` with one sample."""

    tracer: Tracer
    receivers: ReceiverSet
    r: int
    asked: int = 0
    angular: bool = True
    highest: float = 1.0
    _directions: Single = field(init=False)
    _weights: Single = field(init=False)

    def __post_init__(self) -> None:
        self._directions = np.ascontiguousarray(cubemap_directions(self.r), np.float32)
        self._weights = (cubemap_solid_angles(self.r) / np.pi).astype(np.float32)

    @property
    def columns(self) -> int:
        """See `Elements`."""
        return len(self._directions)

    def __len__(self) -> int:
        return len(self.receivers)

    def evaluate(self, receivers: Places, columns: Places) -> Single:
        """One shadow ray each, in the tracer's threads."""
        result = np.empty(len(receivers), np.float32)

        def trace(part: slice) -> Single:
            directions = self._directions[columns[part]]
            place = receivers[part]
            seen = np.ones(len(place), np.float32)
            cosine = np.vecdot(directions, self.receivers.normals[place].astype(np.float32))  # small
            low = np.flatnonzero(cosine < self.receivers.grazing[place])
            seen[low] = self.receivers.above_faces(place[low], directions[low])
            seen[self.tracer.occluded(self.receivers.origins[place], directions)] = 0.0
            return seen

        parts = (slice(start, start + RAYS) for start in range(0, len(receivers), RAYS))
        for part, seen in self.tracer.map_in_order(trace, parts):
            result[part] = seen
        self.tracer.rays += len(receivers)
        self.asked += len(receivers)
        return result

    def unknown(self, receivers: Places) -> NDArray[np.bool_]:
        """The hemisphere above the receiver."""
        return self._cosines(receivers) > 0.0

    def factor(self, receivers: Places) -> Single:
        """Clamped cosine x solid angle / pi, normalised."""
        result = np.maximum(self._cosines(receivers), 0.0)
        result *= self._weights
        result /= np.maximum(result.sum(axis=1, keepdims=True), np.finfo(np.float32).tiny)
        return result

    def _cosines(self, receivers: Places) -> Single:
        normals = self.receivers.normals[receivers].astype(np.float32)
        return multiply(normals, self._directions.T)
