# SPDX-License-Identifier: GPL-3.0-or-later
"""Diffuse transfer in cubemap columns: what each texel's radiance does at each receiver, bounces included.

    t_j = (1 / pi) * integral over texel j of V(s) max(n.s, 0) ds

The same shadow rays, horizons of faces and gather operator as in spherical harmonics: another kind of columns, no
other path.
"""

from __future__ import annotations

from collections.abc import Generator, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from ..basis.cubemap import texel_count
from ..linear_algebra import multiply
from ..tracing.tracer import Tracer
from .column_arrays import COLUMNS_AT_ONCE, column_array, column_blocks
from .direct import CHUNK, cosine_visibility
from .interreflection import Interreflection, interreflect
from .receiver_set import Block, ReceiverSet, blocks, facing_cosines
from .texel_visibility import TexelVisibility, part_solid_angles, texel_directions

Single = NDArray[np.float32]

# Directions over the sphere that a fill traces at least: texels of small cubemaps are sampled on a grid of their own,
# so that a coarse column is the mean over its texel, not what its middle sees. 6 x 32 x 32.
LEAST_DIRECTIONS = 6144


# Of the tolerance that the sums of faces are bounced to: single texels' light dies out a little more slowly.
PROBE = 0.5


@dataclass(frozen=True)
class _Task:
    """texels: of the columns; directions: (texels * samples, 3); weights: (texels * samples,) solid angle / pi; scale:
    (b,) of the block's receivers."""

    block: Block
    texels: slice
    directions: Single
    weights: Single
    scale: Single


def samples_along(r: int) -> int:
    """How many directions along a texel's edge a cubemap of r texels needs for LEAST_DIRECTIONS over the sphere."""
    return max(1, int(np.ceil(np.sqrt(LEAST_DIRECTIONS / texel_count(r)))))


def cubemap_transfer(tracer: Tracer, receivers: ReceiverSet, r: int, samples: int = 0, shadow_rays: bool = True,
                     budget: int | None = None, folder: Path | None = None, plain: TexelVisibility | None = None,
                     ) -> Generator[float, None, Single]:
    """Yield progress, return unit-albedo direct transfer (6 r r, receivers) float32, columns first, in the receivers'
    order.

    samples: directions along a texel's edge, 0 = `samples_along`; each has the exact solid angle of its part of the
    texel. shadow_rays: False where nothing can be hit. budget, folder: of `column_array`. The finite directions' error
    on an open hemisphere's cosine is taken out by one factor per receiver: the columns of a receiver that sees the
    whole sky add up to 1. Independent of threads. plain: collects the visibility itself from the same rays, for the
    receivers whose glossy rows need it.
    """
    samples = samples or samples_along(r)
    result = column_array(texel_count(r), len(receivers), budget, folder)
    total, done = max(1, result.size), 0

    def trace(task: _Task) -> tuple:
        place = task.block.receivers
        cosines, visible, rays = cosine_visibility(tracer if shadow_rays else None, receivers, place, task.directions)
        which = slice(task.texels.start * samples ** 2, task.texels.stop * samples ** 2)
        sample = plain and plain.sample(receivers, place, which, task.directions, task.weights * np.float32(np.pi),
                                        cosines, visible)
        visible *= task.weights[:, None]
        texels = task.texels.stop - task.texels.start
        part = visible.reshape(texels, -1, visible.shape[1]).sum(axis=1) if samples > 1 else visible
        part *= task.scale
        return part, rays, sample

    for task, (part, rays, sample) in tracer.map_in_order(trace, _tasks(receivers, r, samples)):
        result[task.texels, task.block.receivers] = part
        if sample is not None:
            plain.add(sample)
        tracer.rays += rays
        done += part.size
        yield done / total
    return result


def _tasks(receivers: ReceiverSet, r: int, samples: int) -> Iterator[_Task]:
    """Chunks of texels for every block of receivers."""
    count = samples * samples
    directions = texel_directions(r, samples)
    weights = (part_solid_angles(r, samples) / np.pi).astype(np.float32)
    at_once = max(1, CHUNK // count)
    for block in blocks(len(receivers), 0, 0):
        normals = receivers.normals[block.receivers]
        open_sky = np.zeros(len(normals))
        for start in range(0, len(directions), CHUNK):
            part = slice(start, start + CHUNK)
            cosines = facing_cosines(directions[part], normals)
            open_sky += multiply(weights[None, part], cosines)[0]
        scale = (1.0 / open_sky).astype(np.float32)
        for texels in column_blocks(texel_count(r), at_once):
            part = slice(texels.start * count, texels.stop * count)
            yield _Task(block, texels, directions[part], weights[part], scale)


def bounced_columns(matrix: sparse.csr_matrix, albedo: Single, direct: Single, tolerance: float, bounces: int = -1,
                    budget: int | None = None, folder: Path | None = None, at_once: int = COLUMNS_AT_ONCE,
                    ) -> Generator[float, None, tuple[Single, Interreflection]]:
    """Yield progress, return the transfer with interreflection, and how it was solved, without its transfer.

    matrix, albedo (receivers, channels), tolerance, bounces: of `interreflect`; direct: (columns, receivers). Result:
    (columns * channels, receivers) float32, a column's channels side by side, written block by block of `at_once`
    columns, so that only a block's copies are in memory. How many bounces are enough is found on the sums of the faces'
    columns, so that it does not depend on the blocks; where those need the Krylov solver, each block is solved by it to
    the tolerance. The report is of all blocks together.
    """
    channels = albedo.shape[1]
    result = column_array(len(direct) * channels, direct.shape[1], budget, folder)
    solved = yield from _scaled(interreflect(matrix, albedo, _face_sums(direct), PROBE * tolerance, bounces), 0.0, 0.02)
    left = energy = 0.0
    for part in column_blocks(len(direct), at_once):
        block = np.ascontiguousarray(direct[part].T)
        steps = interreflect(matrix, albedo, block, tolerance, solved.bounces)
        bounced = yield from _scaled(steps, part.start / len(direct), (part.stop - part.start) / len(direct))
        rows = slice(part.start * channels, part.stop * channels)
        result[rows] = bounced.transfer.reshape(len(block), -1).T
        squares = float(np.sum(np.square(block, dtype=np.float64)))
        energy, left = energy + squares, left + squares * bounced.residual ** 2
    residual = float(np.sqrt(left / energy)) if energy > 0.0 else 0.0
    return result, replace(solved, transfer=np.empty((0, 0, channels), np.float32), residual=residual)


def _face_sums(direct: Single) -> Single:
    """(receivers, 6) of columns (6 r r, receivers): six lights that are each as wide as a face."""
    whole = np.zeros((6, direct.shape[1]))
    for part in column_blocks(len(direct)):
        face = np.arange(part.start, part.stop) * 6 // len(direct)
        for number in np.unique(face):
            whole[number] += direct[part][face == number].sum(axis=0, dtype=np.float64)
    return np.ascontiguousarray(whole.T, np.float32)


def _scaled(steps: Generator[float, None, Interreflection], first: float, width: float,
            ) -> Generator[float, None, Interreflection]:
    """Pass progress on as a part of a longer work."""
    while True:
        try:
            yield first + width * next(steps)
        except StopIteration as end:
            return end.value
