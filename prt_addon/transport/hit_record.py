# SPDX-License-Identifier: GPL-3.0-or-later
"""What the gather's rays met, kept for the receivers that reflect more than a cosine of it: no ray is traced twice."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .receiver_set import Block


@dataclass(frozen=True)
class HitRecord:
    """Hits of the wanted receivers, receiver after receiver: those of row p of the gather's receivers are first[p] to
    first[p + 1] - 1 (none for a receiver that isn't wanted).

    first: (r + 1,) int64; direction: (h,) int32 into directions (d, 3) float32, away from the receiver; triangle: (h,)
    int32; u, v: (h,) float32, weights of the triangle's corners 1 and 2; front: (h,) bool, the side that was hit;
    solid_angle: (h,) float32, what the ray stands for, in steradians, times the share of faces it lies above; share:
    (h,) float32, its part of the receiver's cosine-weighted hemisphere, as in the gather operator. 27 bytes a hit.
    """

    first: NDArray[np.int64]
    direction: NDArray[np.int32]
    triangle: NDArray[np.int32]
    u: NDArray[np.float32]
    v: NDArray[np.float32]
    front: NDArray[np.bool_]
    solid_angle: NDArray[np.float32]
    share: NDArray[np.float32]
    directions: NDArray[np.float32]


@dataclass(frozen=True)
class KeptHits:
    """Hits of one chunk of directions: as in HitRecord, with rows (h,) of the block and directions of the block."""

    row: NDArray[np.int64]
    direction: NDArray[np.int64]
    triangle: NDArray[np.int32]
    u: NDArray[np.float32]
    v: NDArray[np.float32]
    front: NDArray[np.bool_]
    solid_angle: NDArray[np.float32]
    share: NDArray[np.float32]

    def subset(self, which: NDArray) -> KeptHits:
        """Some of the hits."""
        return KeptHits(*(values[which] for values in vars(self).values()))


class HitRecorder:
    """Collects the hits of the receivers whose keys are wanted (2 * points,) bool, block after block."""

    def __init__(self, wanted: NDArray[np.bool_]) -> None:
        self.wanted = wanted
        self._counts: list[NDArray[np.int64]] = []
        self._hits: list[KeptHits] = []
        self._tables: list[NDArray[np.float32]] = []
        self._unturned: int | None = None
        self._length = 0

    def add_block(self, block: Block, directions: NDArray[np.float32], kept: list[KeptHits]) -> None:
        """Sort a block's chunks by receiver; directions (d, 3): the block's, all chunks one after the other."""
        rows = block.receivers.stop - block.receivers.start
        if not kept:
            self._counts.append(np.zeros(rows, np.int64))
            return
        offset = self._table(block, directions)
        joined = KeptHits(*(np.concatenate([getattr(k, name) for k in kept]) for name in vars(kept[0])))
        # Rows of a block are few enough for 16 bits, which numpy sorts stably by counting.
        hits = joined.subset(np.argsort(joined.row.astype(np.uint16), kind="stable"))
        self._counts.append(np.bincount(joined.row, minlength=rows))
        direction = (hits.direction + offset).astype(np.int32)
        self._hits.append(KeptHits(hits.row, direction, *list(vars(hits).values())[2:]))

    def _table(self, block: Block, directions: NDArray[np.float32]) -> int:
        """Where the block's directions start in the table of all; blocks that aren't turned share theirs."""
        if block.rotation is None and self._unturned is not None:
            return self._unturned
        offset = self._length
        if block.rotation is None:
            self._unturned = offset
        self._tables.append(directions)
        self._length += len(directions)
        return offset

    def result(self) -> HitRecord:
        """All blocks joined, in their order, which is that of the gather's receivers."""
        first = np.concatenate([[0], np.cumsum(np.concatenate([np.zeros(0, np.int64), *self._counts]))])
        empty = KeptHits(*(np.zeros(0, t) for t in (np.int64, np.int32, np.int32, np.float32, np.float32, bool,
                                                    np.float32, np.float32)))
        columns = [np.concatenate([getattr(k, name) for k in (empty, *self._hits)]) for name in list(vars(empty))[1:]]
        return HitRecord(first, *columns, np.concatenate([np.zeros((0, 3), np.float32), *self._tables]))
