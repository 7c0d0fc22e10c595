# SPDX-License-Identifier: GPL-3.0-or-later
"""Receivers as rays see them: a side of a point, an origin, a normal, in Morton order."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..basis.directions import random_rotation
from ..scene.receivers import morton_order, ray_origins
from ..scene.scene_mesh import SceneMesh
from ..tracing.tracer import Tracer

# Receivers handled at once: 64 directions of them in single precision are 4 MB, which the allocator reuses (larger
# arrays are given back to the system and their pages cleared anew at each task).
BLOCK = 16384


@dataclass(frozen=True)
class ReceiverSet:
    """r receivers in the order in which they are traced.

    key: (r,) int64, point + side * points (side 0 front, 1 back); origins: (r, 3) float32 in tracing space;
    normals: (r, 3) float64, towards the receiver's side.
    """

    key: NDArray[np.int64]
    origins: NDArray[np.float32]
    normals: NDArray[np.float64]

    @staticmethod
    def of_keys(scene: SceneMesh, tracer: Tracer, keys: NDArray[np.int64]) -> ReceiverSet:
        """The receivers with these keys, sorted along a Morton curve."""
        count = len(scene.points)
        origins = np.empty((len(keys), 3))
        normals = np.empty((len(keys), 3))
        back = keys >= count
        for side, chosen in ((1, ~back), (-1, back)):
            if chosen.any():
                points = keys[chosen] % count
                starts = ray_origins(scene.points, scene.normals, scene.triangles, tracer.diagonal, side)
                origins[chosen] = starts[points]
                normals[chosen] = side * scene.normals[points]
        order = morton_order(origins)
        return ReceiverSet(keys[order], tracer.to_tracing_space(origins[order]), normals[order])

    @staticmethod
    def joined(sets: list[ReceiverSet]) -> ReceiverSet:
        """Sets one after the other (each keeps its own Morton order)."""
        names = ("key", "origins", "normals")
        return ReceiverSet(*(np.concatenate([getattr(s, name) for s in sets]) for name in names))

    def __len__(self) -> int:
        return len(self.key)


@dataclass(frozen=True)
class Block:
    """A contiguous run of receivers and the rotation of the direction set that it is traced with."""

    receivers: slice
    rotation: NDArray[np.float64] | None


def blocks(count: int, group: int, seed: int) -> Iterator[Block]:
    """Blocks of at most BLOCK receivers; group > 0 makes blocks of that size, each with a random rotation."""
    size = min(group, BLOCK) if group > 0 else BLOCK
    for index, start in enumerate(range(0, count, size)):
        rotation = random_rotation(seed, index) if group > 0 else None
        yield Block(slice(start, min(start + size, count)), rotation)


def facing_cosines(directions: NDArray[np.float32], normals: NDArray[np.float64]) -> NDArray[np.float32]:
    """Clamped cosines (d, b) float32 between directions (d, 3) and normals (b, 3).

    Summed by numpy, not by BLAS: three terms gain nothing from it, and numpy lets the other threads trace meanwhile.
    """
    x, y, z = normals.astype(np.float32).T
    cosines = directions[:, :1] * x
    cosines += directions[:, 1:2] * y
    cosines += directions[:, 2:] * z
    return np.maximum(cosines, np.float32(0.0), out=cosines)


def rotated(directions: NDArray[np.float64], rotation: NDArray[np.float64] | None) -> NDArray[np.float64]:
    """Directions (n, 3) turned by a block's rotation."""
    return directions if rotation is None else directions @ rotation.T  # small
