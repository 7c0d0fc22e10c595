# SPDX-License-Identifier: GPL-3.0-or-later
"""Exit radiance of clustered transfer under one light, in two steps (Sloan et al. 2003, section 6, rendering).

M_p light = sum_k w_pk (B_ck light): the products in brackets are constants of the cluster, few and computed once per
light; each point then blends the constants of its own cluster.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.sparse import csr_array

from ..linear_algebra import multiply, sparse_multiply

FloatArray = NDArray[np.float32]


class Baked(Protocol):
    """What relighting reads of storage's BakedTransfer (this folder comes before storage)."""

    cluster: NDArray[np.int32]
    weights: FloatArray
    bases: FloatArray
    albedo: FloatArray


def cluster_constants(bases: FloatArray, light: ArrayLike) -> FloatArray:
    """Each basis of each cluster applied to the light: (clusters, vectors + 1, rows, 3) float32.

    bases: (clusters, vectors + 1, rows, columns, channels) float32, channels 1 (neutral transfer) or 3;
    light: (columns, 3) radiance coefficients. Raises ValueError where the shapes do not fit.
    """
    light = np.asarray(light)
    if bases.ndim != 5 or bases.shape[4] not in (1, 3):
        raise ValueError(f"bases must be (clusters, vectors + 1, rows, columns, 1 or 3), not {bases.shape}")
    columns, channels = bases.shape[3:]
    if light.shape != (columns, 3):
        raise ValueError(f"the transfer has {columns} columns and needs light ({columns}, 3), not {light.shape}")
    spread = np.zeros((columns, channels, 3), np.float32)
    if channels == 1:
        spread[:, 0] = light
    else:  # channel k of the transfer meets channel k of the light only; the zeros cost less than a strided copy
        for channel in range(3):
            spread[:, channel, channel] = light[:, channel]
    flat = multiply(np.ascontiguousarray(bases, np.float32).reshape(-1, columns * channels),
                    spread.reshape(columns * channels, 3))
    return flat.reshape(*bases.shape[:3], 3)


def exit_radiance(cluster: NDArray[np.integer], weights: FloatArray, constants: FloatArray) -> FloatArray:
    """Exit radiance of every point, for unit albedo where the transfer is diffuse: (p, rows, 3) float32.

    cluster: (p,) indices; weights: (p, vectors) float32; constants: of `cluster_constants`.
    The blend is a sparse product, one row [1, w_p1, w_p2, ...] per point: no BLAS needed, and a point's value depends
    on that point alone to the last bit, however the points are split. Raises ValueError where the shapes do not fit.
    """
    points, (clusters, representatives, rows, _) = len(cluster), constants.shape
    if weights.shape != (points, representatives - 1):
        raise ValueError(f"weights must be ({points}, {representatives - 1}), not {weights.shape}")
    if points == 0:
        return np.zeros((0, rows, 3), np.float32)
    if cluster.min() < 0 or cluster.max() >= clusters:
        raise ValueError(f"cluster indices must lie in 0..{clusters - 1}")
    values = np.empty((points, representatives), np.float32)
    values[:, 0] = 1
    values[:, 1:] = weights
    index_type = np.int32 if values.size < 2**31 else np.int64
    indices = cluster.astype(index_type)[:, None] * representatives + np.arange(representatives, dtype=index_type)
    starts = np.arange(0, values.size + 1, representatives, dtype=index_type)
    blend = csr_array((values.ravel(), indices.ravel(), starts), shape=(points, clusters * representatives))
    flat = sparse_multiply(blend, constants.reshape(clusters * representatives, rows * 3))
    return flat.reshape(points, rows, 3)


def diffuse_radiance(baked: Baked, light: ArrayLike) -> FloatArray:
    """Radiance (p, 3) float32 that leaves every receiver of diffuse transfer: unit-albedo exit radiance times albedo.

    light: (columns, 3) coefficients. Raises ValueError where the transfer has more than the one diffuse row or the
    light has another number of columns.
    """
    if baked.bases.shape[2] != 1:
        raise ValueError(f"diffuse radiance needs transfer with 1 row, not {baked.bases.shape[2]}")
    constants = cluster_constants(baked.bases, light)
    return exit_radiance(baked.cluster, baked.weights, constants)[:, 0] * baked.albedo
