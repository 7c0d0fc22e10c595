# SPDX-License-Identifier: GPL-3.0-or-later
"""The stages of a bake whose distant light is a cubemap: large arrays by columns, on disk beyond the memory budget.

All arrays go on to the other stages as the same views that those of spherical harmonics have, (receivers, columns) and
(receivers, columns, channels), so that nothing else differs.
"""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from ..compression.encoding import Encoding
from ..lighting.reference_light import ReferenceLight
from ..scene.scene_mesh import SceneMesh
from ..tracing.tracer import Tracer
from ..transport.column_arrays import COLUMNS_AT_ONCE, column_array, column_blocks
from ..transport.cubemap_transfer import bounced_columns, cubemap_transfer
from ..transport.interreflection import Interreflection
from ..transport.receiver_set import ReceiverSet
from ..transport.texel_elements import TexelElements
from ..transport.texel_visibility import TexelVisibility
from .distant_basis import DistantBasis, array_budget
from .sampling import SampledDirect, choose, sparse_direct
from .settings import BakeSettings

Single = NDArray[np.float32]

# Copies of a block of columns while it is bounced, which take part of the budget too, and columns below which blocks
# are no more than a loop.
COPIES_OF_BLOCK, FEWEST_COLUMNS = 6, 16

def is_kept(transfer: Single, settings: BakeSettings) -> bool:
    """Whether a finished stage of such an array is written to the job folder: one beyond the budget is not, since it
    lies on the disk once already."""
    budget = array_budget(settings)
    return budget is None or transfer.nbytes <= budget


def direct_cubemap(tracer: Tracer, scene: SceneMesh, receivers: ReceiverSet, basis: DistantBasis,
                   settings: BakeSettings, shadow_rays: bool, light: ReferenceLight | None, folder: Path | None,
                   plain: TexelVisibility | None = None) -> Generator[float, None, SampledDirect]:
    """Yield progress, return direct transfer (r, columns) of every element, or woven from a part of them. plain:
    collects what receivers with highlights see, which takes every element."""
    samples = basis.samples(settings.directions)
    elements = TexelElements(tracer, receivers, basis.cubemap, samples)
    sparsely, left_out = choose(elements, settings, shadow_rays, plain is not None)
    if sparsely:
        return (yield from sparse_direct(elements, scene, basis, settings, light, folder))
    transfer = yield from cubemap_transfer(tracer, receivers, basis.cubemap, samples, shadow_rays,
                                           array_budget(settings), folder, plain)
    return SampledDirect(transfer.T, None, {}, left_out)


def bounced_cubemap(matrix: sparse.csr_matrix, albedo: Single, direct: Single, settings: BakeSettings,
                    folder: Path | None) -> Generator[float, None, Interreflection]:
    """Yield progress, return direct (r, columns) with all bounces: a transfer (r, columns, channels)."""
    budget, column = array_budget(settings), 4 * direct.shape[0] * albedo.shape[1]
    at_once = COLUMNS_AT_ONCE if budget is None else budget // (COPIES_OF_BLOCK * column)
    at_once = int(np.clip(at_once, FEWEST_COLUMNS, COLUMNS_AT_ONCE))
    found, solved = yield from bounced_columns(matrix, albedo, direct.T, settings.bounce_error, settings.bounces,
                                               budget, folder, at_once)
    return replace(solved, transfer=_by_receiver(found, albedo.shape[1]))


def by_point(key: NDArray[np.int64], transfer: Single, points: int, settings: BakeSettings, folder: Path | None,
             ) -> Single:
    """Transfer (points, columns, channels) in the order of points, zero where there is none, of transfer (r, columns,
    channels) of receivers with keys (r,)."""
    _, columns, channels = transfer.shape
    front = np.flatnonzero(key < points)
    place = key[front]
    result = column_array(columns * channels, points, array_budget(settings), folder)
    by_column = transfer.transpose(1, 2, 0)
    for part in column_blocks(columns):
        rows = slice(part.start * channels, part.stop * channels)
        result[rows, place] = by_column[part].reshape(-1, transfer.shape[0])[:, front]
    return _by_receiver(result, channels)


def cubemap_signal(transfer: Single, share: Single, channels: int, basis: DistantBasis, settings: BakeSettings,
                   folder: Path | None) -> Single:
    """An object's signal (p, 1, columns, channels), in the scale that errors are measured in, of its transfer
    (p, columns, 1 or channels) and the share (p,) that its diffuse layer sends back."""
    points, columns, _ = transfer.shape
    result = column_array(columns * channels, points, array_budget(settings), folder)
    scale = np.ones(columns, np.float32) if basis.scale() is None else basis.scale()
    by_column = transfer.transpose(1, 2, 0)
    for part in column_blocks(columns):
        rows = slice(part.start * channels, part.stop * channels)
        block = by_column[part] * scale[part, None, None] * share
        result[rows] = np.broadcast_to(block, (len(block), channels, points)).reshape(-1, points)
    return _by_receiver(result, channels)[:, None]


def without_scale(encoding: Encoding, basis: DistantBasis, shape: tuple[int, int, int]) -> Encoding:
    """The encoding with bases of the transfer itself. shape: (rows, columns, channels) of the signal, distant light's
    columns first."""
    scale = basis.scale()
    if scale is None:
        return encoding
    bases = encoding.bases.reshape(*encoding.bases.shape[:2], *shape).copy()
    bases[:, :, :, :len(scale)] /= scale[:, None]
    return replace(encoding, bases=bases.reshape(encoding.bases.shape))


def _by_receiver(stored: Single, channels: int) -> Single:
    """A view (n, columns, channels) of an array (columns * channels, n)."""
    return stored.reshape(-1, channels, stored.shape[1]).transpose(2, 0, 1)
