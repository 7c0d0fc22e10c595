# SPDX-License-Identifier: GPL-3.0-or-later
"""Exit radiance of surfaces whose receivers are texels: at any place on them, and as the picture of their atlas.

Texels are evaluated first, each from its own cluster's constants, and then filtered: blending weights of different
clusters would mean nothing. What the shaders draw (gpu_shaders/texel_surface.frag.glsl) is held against this.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..scene.atlas import Atlas
from ..scene.tangents import tangent_frame
from ..scene.texel_surface import TexelSurface
from .exit_radiance import (
    Baked,
    FloatArray,
    baked_constants,
    combine_rows,
    exit_radiance,
    hemisphere_values,
    local_views,
)


class TexelBake(Baked, Protocol):
    """What is read of a bake at texels."""

    texels: TexelSurface | None


def texel_radiance(baked: TexelBake, light: ArrayLike, triangle: NDArray[np.integer], u: NDArray[np.floating],
                   v: NDArray[np.floating], views: ArrayLike | None = None, direct: FloatArray | None = None,
                   ) -> NDArray[np.float64]:
    """Radiance (n, 3) that leaves places on a surface: on its triangles (n,), with weights u, v of corners 1 and 2.

    light: as for `cluster_constants`; views: (n, 3) away from the surface, world space when baked, where rows depend on
    them (None: along the normals); direct: (p, rows, 3) direct light of lamps at the texels, None for none.
    """
    surface, layout = baked.texels, baked.texels.layout
    rows = exit_radiance(baked.cluster, baked.weights, baked_constants(baked, light))
    if direct is not None:
        rows = rows + direct
    found = layout.sample(rows.reshape(len(rows), -1), triangle, u, v).reshape(len(triangle), *rows.shape[1:])
    corner = surface.triangles[triangle]
    weights = np.stack([1.0 - u - v, u, v], axis=1)[:, :, None]
    albedo = np.sum(weights * corner_albedo(baked)[triangle], axis=1)
    if not baked.functions:
        return albedo * found[:, 0]
    normals, wanted = (np.sum(weights * values[corner], axis=1) for values in (surface.normals, surface.tangents))
    normals /= np.sqrt(np.sum(normals ** 2, axis=1, keepdims=True))
    views = normals if views is None else np.asarray(views, np.float64)
    values = hemisphere_values(baked.functions, local_views(views, normals, tangent_frame(wanted, normals)))
    return combine_rows(found, albedo, values)


def corner_albedo(baked: TexelBake) -> NDArray[np.float64]:
    """(t, 3, 3) albedo of the texels at the corners of the surface's triangles."""
    count = len(baked.texels.triangles)
    triangle = np.repeat(np.arange(count), 3)
    weights = np.tile(np.eye(3), (count, 1))
    return baked.texels.layout.sample(baked.albedo, triangle, weights[:, 1], weights[:, 2]).reshape(count, 3, 3)


def atlas_picture(surface: TexelSurface, values: NDArray[np.floating], rings: int = 0) -> FloatArray:
    """Values (n, k) of the texels as a picture (height, width, k) float32, row 0 the lowest; 0 outside of charts, up to
    `rings` texels beyond which they go on (mip maps and compression blend them in)."""
    picture = np.zeros((surface.height, surface.width, values.shape[1]), np.float32)
    mask = np.zeros(picture.shape[:2], bool)
    picture[surface.row, surface.column] = values
    mask[surface.row, surface.column] = True
    return Atlas.dilated(picture, mask, rings) if rings else picture
