# SPDX-License-Identifier: GPL-3.0-or-later
"""Small pictures of baked objects as they stand on the screen: 8 bit, with the scene's view transform."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path

import bpy
import numpy as np
from numpy.typing import NDArray

from .offscreen import camera_view_projection, draw_view, environment_sampler, png_bytes, view_background
from .render_data import DrawItem

LONGER_SIDE = 192  # pixels
SAMPLES = 3  # per pixel and axis: small pictures show every stair
Sky = tuple[NDArray[np.float32], NDArray[np.float64]]  # an equirectangular picture (h, w, 3) and its rotation (3, 3)


def draw_thumbnail(scene: bpy.types.Scene, items: Sequence[DrawItem], sky: Sky | None,
                   region: bpy.types.Region | None = None,
                   region_data: bpy.types.RegionView3D | None = None) -> NDArray[np.uint8] | None:
    """The scene camera's view, else that of a 3D viewport's region: (height, width, 4), row 0 up, as it is displayed.

    sky: what stands behind; None leaves it transparent. None without camera and viewport. Raises PRTError without a
    graphics driver, and for a camera that makes no view.
    """
    if scene.camera is not None:
        render = scene.render
        width, height = thumbnail_size(render.resolution_x * render.pixel_aspect_x,
                                       render.resolution_y * render.pixel_aspect_y)
        view_projection = _camera(scene)
    elif region is not None and region_data is not None:
        width, height = thumbnail_size(region.width, region.height)
        view_projection = np.array(region_data.perspective_matrix, np.float64)
    else:
        return None
    background = None
    if sky is not None:
        background = view_background(view_projection, environment_sampler(*sky), width, height)
    return displayed(draw_view(items, view_projection, width, height, background, SAMPLES), scene)


def thumbnail_size(width: float, height: float) -> tuple[int, int]:
    """Pixels of a thumbnail of these proportions."""
    scale = LONGER_SIDE / max(width, height)
    return max(1, round(width * scale)), max(1, round(height * scale))


def displayed(picture: NDArray[np.float32], scene: bpy.types.Scene) -> NDArray[np.uint8]:
    """A scene-linear picture (h, w, 4), row 0 up, as its pixels stand on the screen."""
    height, width, _ = picture.shape
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "thumbnail.png"
        path.write_bytes(png_bytes(picture, scene))
        image = bpy.data.images.load(str(path))
        try:
            values = np.empty(width * height * 4, np.float32)
            image.pixels.foreach_get(values)  # of an 8 bit file: as they are in it
        finally:
            bpy.data.images.remove(image)
    return np.round(values.reshape(height, width, 4)[::-1] * 255.0).astype(np.uint8)


def _camera(scene: bpy.types.Scene) -> NDArray[np.float64]:
    """The camera's view in the proportions of the render, whatever its size."""
    width, height = scene.render.resolution_x, scene.render.resolution_y
    scale = LONGER_SIDE / max(width, height)
    return camera_view_projection(scene, max(1, round(width * scale)), max(1, round(height * scale)))
