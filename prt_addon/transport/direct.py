# SPDX-License-Identifier: GPL-3.0-or-later
"""Shadowed diffuse transfer: t_i = (1/pi) integral over H(n) of V(s) y_i(s) (n.s) ds  (Sloan 2003, section 3).

One direction is traced for all receivers of a block at once (coherent rays), the back hemisphere is never traced, and
visibility is projected to all coefficients by one product per chunk of directions.
"""

from __future__ import annotations

from collections.abc import Generator, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..basis.spherical_harmonics import evaluate, expand_bands, zonal_cosine
from ..linear_algebra import multiply
from ..tracing.tracer import Tracer
from .hemisphere_visibility import HemisphereVisibility
from .receiver_set import Block, ReceiverSet, blocks, facing_cosines, rotated, weigh_by_faces

# Directions per task: long enough to hide a task's overhead behind 64 x 32,000 rays, short enough to cancel at once.
CHUNK = 64


@dataclass(frozen=True)
class _Task:
    block: Block
    directions: NDArray[np.float32]
    weighted_basis: NDArray[np.float32]
    weights: NDArray[np.float64]


def unshadowed_transfer(normals: NDArray[np.float64], order: int) -> NDArray[np.float64]:
    """Exact transfer (n, order^2) of receivers that see their whole hemisphere: the cosine's zonal coefficients in
    the direction of the normal (Ramamoorthi & Hanrahan 2001, An Efficient Representation for Irradiance)."""
    return evaluate(order, normals) * expand_bands(zonal_cosine(order))


def direct_transfer(tracer: Tracer, receivers: ReceiverSet, directions: NDArray[np.float64],
                    weights: NDArray[np.float64], order: int, group: int = 0, seed: int = 0,
                    shadow_rays: bool = True, plain: HemisphereVisibility | None = None,
                    ) -> Generator[float, None, NDArray[np.float32]]:
    """Yield progress, return transfer (r, order^2) float32 of the receivers in their order.

    directions (d, 3), weights (d,): a quadrature of the sphere. group: see `blocks`. shadow_rays: False where nothing
    can be hit (a lone convex mesh): only the faces' own horizons count then. plain: collects the visibility itself from
    the same rays, for the receivers whose glossy rows need it.
    The quadrature's own error on the unshadowed cosine is known exactly, so it is taken out in proportion to what the
    receiver sees (a control variate): an open receiver is exact at any number of directions.
    """
    coefficients = np.zeros((order * order, len(receivers)), np.float32)
    unshadowed = np.zeros_like(coefficients)
    tasks = _tasks(receivers, directions, weights, order, group, seed)
    total = max(1, len(receivers) * len(directions))
    done = 0

    def trace(task: _Task) -> tuple:
        place = task.block.receivers
        traced = cosine_visibility(tracer if shadow_rays else None, receivers, place, task.directions)
        return traced, plain and plain.sample(receivers, place, task.directions, task.weights, *traced[:2])

    for task, ((cosines, visible, rays), sample) in tracer.map_in_order(trace, tasks):
        if sample is not None:
            plain.add(sample)
        place = task.block.receivers
        _accumulate(coefficients, place, task.weighted_basis, visible)
        _accumulate(unshadowed, place, task.weighted_basis, cosines)
        tracer.rays += rays
        done += cosines.size
        yield done / total
    return _without_quadrature_error(coefficients, unshadowed, receivers.normals, order)


def _tasks(receivers: ReceiverSet, directions: NDArray[np.float64], weights: NDArray[np.float64], order: int,
           group: int, seed: int) -> Iterator[_Task]:
    """Chunks of directions for every block of receivers."""
    for block in blocks(len(receivers), group, seed):
        turned = rotated(directions, block.rotation)
        basis = (evaluate(order, turned) * (weights / np.pi)[:, None]).T.astype(np.float32)
        for start in range(0, len(directions), CHUNK):
            chunk = slice(start, start + CHUNK)
            yield _Task(block, np.ascontiguousarray(turned[chunk], np.float32),
                        np.ascontiguousarray(basis[:, chunk]), weights[chunk])


def cosine_visibility(tracer: Tracer | None, receivers: ReceiverSet, place: slice, directions: NDArray[np.float32],
                       ) -> tuple[NDArray[np.float32], NDArray[np.float32], int]:
    """Clamped cosines (d, b), the same weighted by what is seen, and the number of rays.

    tracer: None where nothing can be hit.
    """
    cosines = facing_cosines(directions, receivers.normals[place])
    visible, rays = cosines.copy(), 0
    if tracer is not None:
        facing = cosines > 0.0
        rays = int(np.count_nonzero(facing))
        np.multiply(visible, ~tracer.occluded_where(receivers.origins[place], directions, facing), out=visible)
    # After tracing, when most pairs near the horizon are known to be dark: of the Buddha's one in seven is left, and
    # weighing all of them before would spare one ray in seven hundred.
    weigh_by_faces(receivers, place, directions, visible)
    return cosines, visible, rays


def _accumulate(coefficients: NDArray[np.float32], place: slice, basis: NDArray[np.float32],
                values: NDArray[np.float32]) -> None:
    """Add basis (n, d) times values (d, b) to the coefficients of a block."""
    if place.stop - place.start == coefficients.shape[1]:
        multiply(basis, values, out=coefficients, accumulate=True)
    else:
        coefficients[:, place] += multiply(basis, values)


def _without_quadrature_error(coefficients: NDArray[np.float32], unshadowed: NDArray[np.float32],
                              normals: NDArray[np.float64], order: int) -> NDArray[np.float32]:
    """Add seen x (exact - sampled) unshadowed transfer, seen = what share of the cosine is visible."""
    seen = coefficients[0] / np.maximum(unshadowed[0], np.finfo(np.float32).tiny)
    result = np.empty((coefficients.shape[1], coefficients.shape[0]), np.float32)
    for start in range(0, len(result), BLOCK_OF_RESULT):
        part = slice(start, start + BLOCK_OF_RESULT)
        exact = unshadowed_transfer(normals[part], order)
        result[part] = coefficients[:, part].T + seen[part, None] * (exact - unshadowed[:, part].T)
    return result


# Rows finished at once: the exact transfer of 16,384 receivers at order 10 is 13 MB in double precision.
BLOCK_OF_RESULT = 16384
