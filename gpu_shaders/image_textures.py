# SPDX-License-Identifier: GPL-3.0-or-later
"""Image textures on baked surfaces: vertices that carry places in them, and the images as Blender holds them.

A point of a surface lies at several places in its texture along a seam, so drawn vertices are points at one place each.
The GPU textures are Blender's own, asked for anew on every redraw: a painted, reloaded or replaced image is followed
without a copy of it, and its colour space is decoded by Blender.
"""

from __future__ import annotations

from dataclasses import dataclass

import bpy
import gpu
import numpy as np
from numpy.typing import NDArray

from ..prt_addon.scene.surface_textures import SurfaceTextures, TextureUse
from .render_data import RenderData

EXTENSIONS = ("REPEAT", "EXTEND", "CLIP", "MIRROR")  # by the number that albedo.glsl knows them by
STEP = 1e-6  # of a texture's width: places nearer than it are one vertex


@dataclass(frozen=True, eq=False)
class TexturedVertices:
    """vertices: (v,) int64, the untextured vertex that each one is a copy of; places: (v, 2) float32 in the texture;
    triangles: (t, 3) int32 of these vertices, in the order of the untextured ones."""

    vertices: NDArray[np.int64]
    places: NDArray[np.float32]
    triangles: NDArray[np.int32]


def textured_vertices(data: RenderData, textures: SurfaceTextures) -> TexturedVertices:
    """The vertices of a surface with its textures: one for each place that a vertex has in them."""
    vertex = data.triangles.reshape(-1).astype(np.int64)
    places = textures.places.reshape(-1, 2)
    steps = np.rint(places.astype(np.float64) / STEP)
    order = np.lexsort((steps[:, 1], steps[:, 0], vertex))
    first = np.ones(len(order), bool)
    first[1:] = (vertex[order[1:]] != vertex[order[:-1]]) | (steps[order[1:]] != steps[order[:-1]]).any(axis=1)
    number = np.empty(len(order), np.int32)
    number[order] = np.cumsum(first) - 1
    kept = order[first]
    return TexturedVertices(vertex[kept], np.ascontiguousarray(places[kept], np.float32), number.reshape(-1, 3))


def texture_of(use: TextureUse) -> tuple[gpu.types.GPUTexture, tuple[float, float, float, float]] | None:
    """Blender's texture of an image, and the shader's texture_factor; None where the image can't be had (now)."""
    image = bpy.data.images.get(use.image)
    if image is None:
        return None
    try:
        return gpu.texture.from_image(image), (*use.factor, float(switches_of(use, image)))
    except (RuntimeError, ValueError):
        return None


def switches_of(use: TextureUse, image: bpy.types.Image) -> int:
    """How albedo.glsl is to sample an image: 1 as it is stored, in 8 bit sRGB; 2 weighed by its alpha; 4 smoothly; and
    8 times the number of its extension."""
    stored = not image.is_float and image.colorspace_settings.name == "sRGB"
    weighed = image.alpha_mode == "STRAIGHT"
    return stored + 2 * weighed + 4 * use.smooth + 8 * EXTENSIONS.index(use.extension)
