# SPDX-License-Identifier: GPL-3.0-or-later
"""Depth of surfaces that are not ours, where Blender leaves none: without overlays its engines keep their depth to
themselves, and what stands in front of a baked object would be covered by it.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass

import gpu
import numpy as np
from mathutils import Matrix
from numpy.typing import ArrayLike, NDArray

from . import programs

Triangles = tuple[NDArray[np.float32], NDArray[np.int32]]


@dataclass(frozen=True)
class Occluder:
    """One placed mesh. key: changes when its shape does; matrix: (4, 4), mesh to world; read: gives its positions
    (v, 3) and triangles (t, 3), asked for once per key."""

    key: Hashable
    matrix: ArrayLike
    read: Callable[[], Triangles]


class OccluderCache:
    """Their meshes on the GPU, for as long as they are drawn."""

    def __init__(self) -> None:
        self._batches: dict[Hashable, gpu.types.GPUBatch | None] = {}

    def __len__(self) -> int:
        return len(self._batches)

    def draw(self, occluders: Sequence[Occluder], view_projection: NDArray[np.float64]) -> None:
        """Write their depth into the active framebuffer, and no colour; leaves the GPU state as it was."""
        self._batches = {key: self._batches[key] for key in {o.key for o in occluders} & self._batches.keys()}
        depth_test, depth_mask = gpu.state.depth_test_get(), gpu.state.depth_mask_get()
        gpu.state.depth_test_set("LESS_EQUAL")
        gpu.state.depth_mask_set(True)
        gpu.state.color_mask_set(False, False, False, False)
        gpu.state.face_culling_set("NONE")
        program = programs.depth_alone()
        try:
            for occluder in occluders:
                if occluder.key not in self._batches:
                    self._batches[occluder.key] = _make_batch(*occluder.read())
                batch = self._batches[occluder.key]
                if batch is not None:
                    transform = view_projection @ np.array(occluder.matrix, np.float64)  # small
                    program.bind()
                    program.uniform_float("transform", Matrix(transform.tolist()))
                    batch.draw(program)
        finally:
            gpu.state.color_mask_set(True, True, True, True)
            gpu.state.depth_test_set(depth_test)
            gpu.state.depth_mask_set(depth_mask)

    def clear(self) -> None:
        """Drop every GPU object."""
        self._batches.clear()


def _make_batch(positions: NDArray[np.float32], triangles: NDArray[np.int32]) -> gpu.types.GPUBatch | None:
    """None where there is nothing to draw."""
    if not len(triangles):
        return None
    layout = gpu.types.GPUVertFormat()
    layout.attr_add(id="position", comp_type="F32", len=3, fetch_mode="FLOAT")
    vertices = gpu.types.GPUVertBuf(layout, len(positions))
    vertices.attr_fill("position", np.ascontiguousarray(positions, np.float32))
    elements = gpu.types.GPUIndexBuf(type="TRIS", seq=np.ascontiguousarray(triangles, np.int32))
    return gpu.types.GPUBatch(type="TRIS", buf=vertices, elem=elements)
