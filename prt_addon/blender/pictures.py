# SPDX-License-Identifier: GPL-3.0-or-later
"""Pictures for a screen: bytes (height, width, 3), row 0 on top; read, written, lettered, shown in an Image Editor."""

from __future__ import annotations

import tempfile
from pathlib import Path

import blf
import bpy
import imbuf
import numpy as np
from numpy.typing import NDArray

from ..storage.files import write_atomically

Picture = NDArray[np.uint8]
FONT = 0  # Blender's own
MARK = "prt_picture"  # on images that are ours to replace


def read_picture(path: Path) -> Picture:
    """An image file as it is, colours only."""
    buffer = imbuf.load(str(path))
    try:
        with buffer.with_buffer() as pixels:
            return np.array(pixels, np.uint8)[::-1, :, :3].copy()
    finally:
        buffer.free()


def write_picture(path: Path, picture: Picture) -> None:
    """Save as PNG; the file is complete or absent. Raises StorageError where it can't be written."""
    buffer = _buffer_of(picture)
    try:
        with tempfile.TemporaryDirectory() as folder:
            beside = Path(folder) / "picture.png"
            imbuf.write(buffer, filepath=str(beside))
            content = beside.read_bytes()
    finally:
        buffer.free()
    write_atomically(path, lambda stream: stream.write(content) and None)


def lettered(picture: Picture, texts: list[tuple[str, int, int, int]], colour: tuple[float, float, float],
             ) -> Picture:
    """The picture with texts on it: (text, left, baseline from the top, size), in pixels."""
    buffer = _buffer_of(picture)
    try:
        with blf.bind_imbuf(FONT, buffer):
            for text, left, baseline, size in texts:
                blf.size(FONT, size)
                blf.color(FONT, *colour, 1.0)
                blf.position(FONT, left, picture.shape[0] - baseline, 0.0)
                blf.draw_buffer(FONT, text)
        with buffer.with_buffer() as pixels:
            return np.array(pixels, np.uint8)[::-1, :, :3].copy()
    finally:
        buffer.free()


def text_width(text: str, size: int) -> int:
    """How many pixels a text takes."""
    blf.size(FONT, size)
    return int(np.ceil(blf.dimensions(FONT, text)[0]))


def store_image(name: str, picture: Picture) -> bpy.types.Image:
    """The picture as an image of the file, in place of ours of that name; without users, a saved file leaves it out."""
    height, width, _ = picture.shape
    image = bpy.data.images.get(name)
    if image is None or MARK not in image:
        image = bpy.data.images.new(name, width, height)
        image[MARK] = True
    elif tuple(image.size) != (width, height):
        image.scale(width, height)
    pixels = np.ones((height, width, 4), np.float32)
    pixels[..., :3] = picture[::-1] / np.float32(255.0)
    image.pixels.foreach_set(pixels.ravel())
    image.update()
    image.pack()  # else Blender asks to save it before it quits
    return image


def show_image(image: bpy.types.Image) -> bool:
    """Open it in an Image Editor that nobody paints in; whether there is one."""
    for window in bpy.context.window_manager.windows:
        for area in window.screen.areas:
            space = area.spaces.active
            if area.type == "IMAGE_EDITOR" and space.mode == "VIEW" and not space.use_image_pin:
                space.image = image
                region = next(r for r in area.regions if r.type == "WINDOW")
                with bpy.context.temp_override(window=window, area=area, region=region):
                    bpy.ops.image.view_all(fit_view=True)
                area.tag_redraw()
                return True
    return False


def _buffer_of(picture: Picture) -> object:
    height, width, _ = picture.shape
    buffer = imbuf.new((width, height))
    with buffer.with_buffer(write=True) as pixels:
        values = np.asarray(pixels)
        values[..., :3] = picture[::-1]
        values[..., 3] = 255
    return buffer
