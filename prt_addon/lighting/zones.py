# SPDX-License-Identifier: GPL-3.0-or-later
"""Zones of receivers: boxes halved along their longest axis until few receivers are left (Kristensen et al. 2005, 4.2).

Lights far from a zone look alike to it and merge, so that every zone keeps its own few lights; and only one zone's
responses need to be in memory at a time.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Zones:
    """zone: (p,) int32, the zone of every receiver; boxes: (z, 2, 3) float64, low and high corner of every zone's cell
    of the halving, metres, world axes (cells do not overlap; empty ones are no zones)."""

    zone: NDArray[np.int32]
    boxes: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.boxes)

    def members(self) -> list[NDArray[np.int64]]:
        """The receivers of every zone, ascending."""
        order = np.argsort(self.zone, kind="stable")
        return np.split(order, np.searchsorted(self.zone[order], np.arange(1, len(self))))


def split_zones(positions: NDArray[np.floating], most_receivers: int, smallest_extent: float = 0.0) -> Zones:
    """Zones of receivers at positions (p, 3), metres.

    A box is halved while it holds more than most_receivers and its longest side is longer than smallest_extent
    (metres), and as long as halving can part its receivers at all. Receivers on the plane between two halves belong to
    the upper one. The same positions always give the same zones, in the order of a walk through the halves, so that
    neighbours in number are neighbours in space. Raises ValueError for positions that are not finite.
    """
    positions = np.asarray(positions, np.float64).reshape(-1, 3)
    if not np.isfinite(positions).all():
        raise ValueError("split_zones: positions must be finite")
    if most_receivers < 1:
        raise ValueError(f"split_zones: a zone needs room for 1 receiver or more, not {most_receivers}")
    zone, boxes = np.zeros(len(positions), np.int32), []
    pending = [(np.arange(len(positions)), positions.min(axis=0), positions.max(axis=0))] if len(positions) else []
    while pending:
        members, low, high = pending.pop()
        halves = None
        if len(members) > most_receivers and float((high - low).max()) > smallest_extent:
            halves = _halves(positions, members, low, high)
        if halves is None:
            zone[members] = len(boxes)
            boxes.append((low, high))
        else:
            pending += halves[::-1]  # the lower half is taken from the end first
    return Zones(zone, np.array(boxes, np.float64).reshape(-1, 2, 3))


def _halves(positions: NDArray[np.float64], members: NDArray[np.int64], low: NDArray[np.float64],
            high: NDArray[np.float64]) -> list[tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]]] | None:
    """The halves of a box that hold receivers, lower one first; None where its receivers all lie in one place or the
    box is too thin for floating point to halve."""
    axis = int(np.argmax(high - low))
    middle = low[axis] + 0.5 * (high[axis] - low[axis])
    inside = positions[members]
    if not low[axis] < middle < high[axis] or np.array_equal(inside.min(axis=0), inside.max(axis=0)):
        return None
    below = inside[:, axis] < middle
    top, bottom = high.copy(), low.copy()
    top[axis] = bottom[axis] = middle
    halves = [(members[below], low, top), (members[~below], bottom, high)]
    return [half for half in halves if len(half[0])]
