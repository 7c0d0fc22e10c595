# SPDX-License-Identifier: GPL-3.0-or-later
"""Exit radiance of clustered transfer under one light, in two steps (Sloan et al. 2003, section 6, rendering).

M_p light = sum_k w_pk (B_ck light): the products in brackets are constants of the cluster, few and computed once per
light; each point then blends the constants of its own cluster.
"""

from __future__ import annotations

import math
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.sparse import csr_array

from ..basis.spherical_harmonics import evaluate
from ..lighting.windowing import for_highlights
from ..linear_algebra import multiply, sparse_multiply
from .scene_light import LightingBasis

FloatArray = NDArray[np.float32]


class Baked(Protocol):
    """What relighting reads of storage's BakedTransfer (this folder comes before storage)."""

    cluster: NDArray[np.int32]
    weights: FloatArray
    bases: FloatArray
    albedo: FloatArray
    normals: FloatArray
    tangents: FloatArray | None

    @property
    def soft_highlights(self) -> bool:
        """Whether highlights reflect a light that rings less."""
        ...

    @property
    def lighting_basis(self) -> LightingBasis:
        """Which columns belong to distant light."""
        ...

    @property
    def functions(self) -> tuple[int, ...]:
        """The spherical harmonics of the exit direction that rows 1, 2, ... belong to."""
        ...

    @property
    def cluster_zone(self) -> NDArray[np.int32] | None:
        """The zone of the light cloud that each cluster lies in; None without local lights."""
        ...


def baked_constants(baked: Baked, light: ArrayLike) -> FloatArray:
    """`cluster_constants` of a bake, whose rows of the view reflect distant light without most of its ringing
    (`lighting.windowing.for_highlights`) where it asks for that."""
    plain = cluster_constants(baked.bases, light, baked.cluster_zone)
    if not (baked.functions and baked.soft_highlights and baked.lighting_basis.distant):
        return plain
    if baked.lighting_basis.cubemap:  # texels do not ring
        return plain
    light = np.asarray(light, np.float32)
    softer, distant = light.copy(), baked.lighting_basis.distant
    shared = light[:distant] if light.ndim == 2 else light[0, :distant]  # distant light is the same in every zone
    softer[..., :distant, :] = for_highlights(shared)
    if np.array_equal(softer, light):
        return plain
    rows = np.ascontiguousarray(baked.bases[:, :, 1:])
    return np.concatenate([plain[:, :, :1], cluster_constants(rows, softer, baked.cluster_zone)], axis=2)


def cluster_constants(bases: FloatArray, light: ArrayLike, cluster_zone: NDArray[np.integer] | None = None,
                      ) -> FloatArray:
    """Each basis of each cluster applied to the light: (clusters, vectors + 1, rows, 3) float32.

    bases: (clusters, vectors + 1, rows, columns, channels) float32, channels 1 (neutral transfer) or 3;
    light: (columns, 3) coefficients, or (zones, columns, 3) where they differ by zone (local lights), with cluster_zone
    (clusters,) saying which zone each cluster lies in. Raises ValueError where the shapes do not fit.
    """
    light = np.asarray(light)
    if bases.ndim != 5 or bases.shape[4] not in (1, 3):
        raise ValueError(f"bases must be (clusters, vectors + 1, rows, columns, 1 or 3), not {bases.shape}")
    columns = bases.shape[3]
    if light.ndim == 2 and light.shape == (columns, 3):
        return _constants(bases, light)
    if light.ndim != 3 or light.shape[1:] != (columns, 3):
        raise ValueError(f"the transfer has {columns} columns and needs light ({columns}, 3), not {light.shape}")
    if cluster_zone is None or len(cluster_zone) != len(bases):
        raise ValueError(f"light of {len(light)} zones needs the zone of each of {len(bases)} clusters")
    result = np.zeros((*bases.shape[:3], 3), np.float32)
    for zone in np.unique(cluster_zone):
        if light[zone].any():
            inside = np.flatnonzero(cluster_zone == zone)
            # Clusters of a zone lie side by side, so that this is a view as a rule.
            run = slice(inside[0], inside[-1] + 1) if inside[-1] - inside[0] == len(inside) - 1 else inside
            result[run] = _constants(bases[run], light[zone])
    return result


def _constants(bases: FloatArray, light: NDArray) -> FloatArray:
    """`cluster_constants` for one light (columns, 3)."""
    columns, channels = bases.shape[3:]
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

    light: as for `cluster_constants`. Raises ValueError where the transfer has more than the one diffuse row or the
    light has another number of columns.
    """
    if baked.bases.shape[2] != 1:
        raise ValueError(f"diffuse radiance needs transfer with 1 row, not {baked.bases.shape[2]}")
    constants = cluster_constants(baked.bases, light, baked.cluster_zone)
    return exit_radiance(baked.cluster, baked.weights, constants)[:, 0] * baked.albedo


def view_radiance(baked: Baked, light: ArrayLike, views: ArrayLike, direct: FloatArray | None = None) -> FloatArray:
    """Radiance (p, 3) float32 that leaves every receiver towards its view, diffuse transfer too.

    light: as for `cluster_constants`; views: (p, 3) directions in world space when baked, away from the surface, of any
    length above zero; direct: (p, rows, 3) direct light of lamps to add, None for none. Views from behind the surface:
    see `hemisphere_values`. Raises ValueError where shapes do not fit.
    """
    views = np.asarray(views, np.float64)
    if views.shape != baked.normals.shape:
        raise ValueError(f"one view for each of {len(baked.normals)} receivers is needed, not {views.shape}")
    constants = baked_constants(baked, light)
    rows = exit_radiance(baked.cluster, baked.weights, constants)
    if direct is not None:
        rows = rows + direct
    if not baked.functions:
        return rows[:, 0] * baked.albedo
    values = hemisphere_values(baked.functions, local_views(views, baked.normals, baked.tangents))
    return combine_rows(rows, baked.albedo, values)


def local_views(views: ArrayLike, normals: ArrayLike, tangents: ArrayLike) -> NDArray[np.float64]:
    """Views (p, 3) in the frames of receivers: x along the tangent, y along normal x tangent, z along the normal."""
    views, normals, tangents = (np.asarray(v, np.float64) for v in (views, normals, tangents))
    return np.stack([np.sum(views * axis, axis=1) for axis in (tangents, np.cross(normals, tangents), normals)], axis=1)


def hemisphere_values(functions: tuple[int, ...], local: NDArray[np.float64]) -> NDArray[np.float64]:
    """y_i (p, functions) of local views (p, 3) of any length above zero.

    Rows are fitted over the upper hemisphere only and mean nothing below it, so a view from behind is mirrored to the
    front: continuous at the horizon, where interpolated normals dip under it, and a back face looks like the front
    from the mirrored place.
    """
    unit = local / np.sqrt(np.sum(local ** 2, axis=1, keepdims=True))
    unit[:, 2] = np.abs(unit[:, 2])
    order = math.isqrt(max(functions)) + 1
    return evaluate(order, unit)[:, list(functions)]


def combine_rows(rows: FloatArray, albedo: FloatArray, values: NDArray[np.floating]) -> FloatArray:
    """albedo * row 0 + sum_i y_i * row i, (p, 3) float32, of rows (p, 1 + functions, 3) and y_i (p, functions)."""
    if rows.shape[1] != 1 + values.shape[1]:
        raise ValueError(f"{rows.shape[1]} rows need {rows.shape[1] - 1} functions, not {values.shape[1]}")
    radiance = albedo * rows[:, 0]
    for index in range(values.shape[1]):
        radiance += values[:, index, None].astype(np.float32) * rows[:, 1 + index]
    return radiance
