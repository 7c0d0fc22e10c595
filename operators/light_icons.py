# SPDX-License-Identifier: GPL-3.0-or-later
"""Thumbnails as text that a .blend file keeps, and as icons that panels draw."""

from __future__ import annotations

import base64
import json
import zlib

import bpy.utils.previews
import numpy as np
from numpy.typing import NDArray

MOST_ICONS = 256  # kept; older ones are made again when they are drawn
ICON_SIDE = 32
_icons: bpy.utils.previews.ImagePreviewCollection | None = None


def to_text(pixels: NDArray[np.uint8]) -> str:
    """(height, width, 4), row 0 up, as a text."""
    height, width, _ = pixels.shape
    packed = base64.b85encode(zlib.compress(pixels.tobytes(), 9)).decode()
    return json.dumps({"size": [width, height], "pixels": packed})


def from_text(text: str) -> NDArray[np.uint8] | None:
    """Pixels (height, width, 4) of `to_text`; None for anything else."""
    try:
        told = json.loads(text)
        (width, height), packed = told["size"], told["pixels"]
        values = np.frombuffer(zlib.decompress(base64.b85decode(packed)), np.uint8)
        return values.reshape(height, width, 4)
    except (ValueError, KeyError, TypeError, zlib.error):
        return None


def icon_of(text: str) -> int:
    """The number of a thumbnail's icon, which is made when it is first asked for; 0 for none."""
    global _icons
    if not text or bpy.app.background:
        return 0
    if _icons is None:
        _icons = bpy.utils.previews.new()
    key = f"{zlib.crc32(text.encode()):08x}{len(text)}"
    if key not in _icons:
        pixels = from_text(text)
        if pixels is None:
            return 0
        if len(_icons) >= MOST_ICONS:
            _icons.clear()
        _fill(_icons.new(key), pixels)
    return _icons[key].icon_id


def unregister() -> None:
    """Free all icons."""
    global _icons
    if _icons is not None:
        bpy.utils.previews.remove(_icons)
        _icons = None


def _fill(preview: bpy.types.ImagePreview, pixels: NDArray[np.uint8]) -> None:
    """Pixels into both sizes of a preview; Blender's start at the bottom."""
    height, width, _ = pixels.shape
    values = pixels[::-1].astype(np.float32) / 255.0
    preview.image_size = (width, height)
    preview.image_pixels_float.foreach_set(np.ascontiguousarray(values).ravel())
    side = min(height, width)
    step = (np.arange(ICON_SIDE) * side) // ICON_SIDE
    small = values[(height - side) // 2 + step][:, (width - side) // 2 + step]
    preview.icon_size = (ICON_SIDE, ICON_SIDE)
    preview.icon_pixels_float.foreach_set(np.ascontiguousarray(small).ravel())
