# SPDX-License-Identifier: GPL-3.0-or-later
"""Matrix radiosity as textures, and the program that iterates on them. Imports no gpu (compute_program says why)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from .compute_program import ComputeProgram
from .render_data import TEXTURE_WIDTH, texture_values

JACOBI = ComputeProgram(
    ("texel_layout.glsl", "radiosity_jacobi.comp.glsl"),
    ("entry_values", "row_values", "albedo_values", "emittance_values", "radiosity_values"),
    (("next_values", "WRITE"),), (("INT", "receivers"),), (("TEXTURE_WIDTH", str(TEXTURE_WIDTH)),))


@dataclass(frozen=True)
class RadiosityTexels:
    """A matrix of form factors as radiosity_jacobi.comp.glsl reads it; entries, rows: (height, TEXTURE_WIDTH, 4)
    float32."""

    receivers: int
    entries: NDArray[np.float32]
    rows: NDArray[np.float32]


def radiosity_texels(matrix: sparse.csr_matrix) -> RadiosityTexels:
    """The texels of a matrix (r, r) of at most 2^24 receivers, whose numbers single precision holds. Rows lie in
    columns of texels as long as the longest row. Raises BadScene where they do not fit a texture."""
    receivers, counts = matrix.shape[0], np.diff(matrix.indptr)
    texels = -(-counts // 2)
    width = int(texels.max(initial=0))
    place = np.arange(matrix.nnz) - np.repeat(matrix.indptr[:-1], counts)
    entries = np.zeros((width * receivers, 2, 2), np.float32)
    where = place // 2 * receivers + np.repeat(np.arange(receivers), counts)
    entries[where, place % 2, 0] = matrix.indices
    entries[where, place % 2, 1] = matrix.data
    rows = np.stack([texels, matrix.diagonal()], axis=1)
    return RadiosityTexels(receivers, texture_values(entries.reshape(-1, 4)), texture_values(rows))
