# SPDX-License-Identifier: GPL-3.0-or-later
"""Highlights and light through bodies in a cubemap's columns: arrays of whole receivers, on disk beyond the budget.

A receiver's matrix has rows x texels x channels values (300 KB with 16 rows of a coloured metal and 16 texels along an
edge), so these arrays are filled and read receiver by receiver, where diffuse transfer goes column by column.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Generator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..tracing.tracer import Tracer
from ..transport.column_arrays import column_array, column_blocks
from ..transport.glossy import GlossySurfaces, filled_rows, rows_shape
from ..transport.hemisphere_visibility import VisibilityCoefficients
from ..transport.incident_light import IndirectLight
from ..transport.receiver_set import ReceiverSet
from ..transport.texel_visibility import TexelLight, TexelVisibility
from .distant_basis import DistantBasis, array_budget
from .settings import BakeSettings
from .surfaces import INCIDENT_ORDER

Single = NDArray[np.float32]

# Values of a block of receivers' matrices in memory: 64 MB.
BLOCK_VALUES = 1 << 24
# Copies of its columns' light that a body's transfer takes while it is found.
COPIES_OF_BODY = 8


def receiver_array(shape: tuple[int, ...], settings: BakeSettings, folder: Path | None) -> Single:
    """Zeros of this shape, receivers first: in memory, or in a file beyond the budget (`column_array`)."""
    return column_array(shape[0], math.prod(shape[1:]), array_budget(settings), folder).reshape(shape)


def texel_visibility(chosen: NDArray[np.bool_], basis: DistantBasis, settings: BakeSettings, bounces: bool,
                     ) -> TexelVisibility | None:
    """What collects the visibility of the receivers with highlights, chosen (r,); None where there are none."""
    if not chosen.any():
        return None
    directions = basis.columns * basis.samples(settings.directions) ** 2
    return TexelVisibility(chosen, directions, INCIDENT_ORDER if bounces else 0)


def texel_rows(tracer: Tracer, surfaces: GlossySurfaces, visibility: VisibilityCoefficients, receivers: ReceiverSet,
               basis: DistantBasis, settings: BakeSettings, indirect: IndirectLight | None, folder: Path | None,
               ) -> Generator[float, None, Single]:
    """Yield progress, return the highlights' rows (g, functions, columns, channels)."""
    light = TexelLight(basis.cubemap, basis.samples(settings.directions), visibility.visible,
                       receivers.normals[visibility.rows], INCIDENT_ORDER)
    out = receiver_array(rows_shape(surfaces, basis.columns, indirect), settings, folder)
    return (yield from filled_rows(tracer, surfaces, light, indirect, out))


def sent_by_surfaces(albedo: Single, transfer: Single, settings: BakeSettings, folder: Path | None) -> Single:
    """Albedo (r, 1, channels) times transfer (r, columns, channels), receivers first."""
    channels = max(albedo.shape[2], transfer.shape[2])
    result = receiver_array((*transfer.shape[:2], channels), settings, folder)
    for part in column_blocks(transfer.shape[1]):
        result[:, part] = transfer[:, part] * albedo
    return result


def texel_signal(shape: tuple[int, ...], basis: DistantBasis, settings: BakeSettings, folder: Path | None,
                 write: Callable[[Single, slice], None]) -> Single:
    """An object's signal (p, rows, columns, channels), in the scale that errors are measured in. write: puts the
    matrices of a run of its receivers into zeros."""
    result = receiver_array(shape, settings, folder)
    scale = np.ones(shape[2], np.float32) if basis.scale() is None else basis.scale()
    at_once = max(1, BLOCK_VALUES // math.prod(shape[1:]))
    for start in range(0, shape[0], at_once):
        part = slice(start, min(start + at_once, shape[0]))
        block = np.zeros((part.stop - part.start, *shape[1:]), np.float32)
        write(block, part)
        block *= scale[:, None]
        result[part] = block
    return result


def columns_through_bodies(receivers: int, basis: DistantBasis, settings: BakeSettings) -> int:
    """Columns of light that go through a body of so many receivers at once."""
    budget = array_budget(settings)
    if not basis.cubemap or budget is None:
        return basis.columns
    return max(16, min(basis.columns, budget // max(1, COPIES_OF_BODY * 4 * receivers)))
