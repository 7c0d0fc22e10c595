# SPDX-License-Identifier: GPL-3.0-or-later
"""High dynamic range image files as arrays (height, width, 3) float32, scene-linear, top row first.

OpenEXR is imported when a file of that kind is read. Radiance pictures are read here: the format is small.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import PRTError

Image = NDArray[np.float32]
_USE_ANOTHER = "Choose an equirectangular .exr or .hdr file that opens in an image viewer"


def read_image(path: Path) -> Image:
    """The colours of an OpenEXR (.exr) or Radiance (.hdr) file. Raises PRTError naming the file it can't read."""
    if not path.exists():
        raise PRTError(str(path), "the image does not exist", "Check the path, or choose another image")
    if not path.is_file():
        raise PRTError(str(path), "this is no file", _USE_ANOTHER)
    readers = {".exr": _read_openexr, ".hdr": _read_radiance, ".pic": _read_radiance}
    reader = readers.get(path.suffix.lower())
    if reader is None:
        raise PRTError(str(path), f"files of the kind '{path.suffix}' are not read as light",
                       "Save it as .exr or .hdr, scene-linear")
    return reader(path)


def _read_openexr(path: Path) -> Image:
    """Red, green and blue of the first part that has them, alone or in a layer; a lone Y counts as grey.

    Pixels outside the file's data window are black, as the format says.
    """
    try:
        import OpenEXR
    except ImportError as error:
        raise PRTError(str(path), f"the OpenEXR module is missing ({error})",
                       "Install the extension's own build for this Python, or save the image as .hdr") from error
    try:
        with OpenEXR.File(str(path), separate_channels=True) as file:
            if not file.parts:  # pixel data broken: the module drops the part
                raise PRTError(str(path), "its pixel data is damaged or cut off", _USE_ANOTHER)
            return _openexr_colours(file, path)
    except (OSError, RuntimeError, ValueError) as error:
        raise PRTError(str(path), f"it is not a readable OpenEXR file ({error})", _USE_ANOTHER) from error


def _openexr_colours(file: Any, path: Path) -> Image:
    """The colours of the first part of an open OpenEXR file that has some."""
    names: list[str] = []
    for part in range(len(file.parts)):
        channels = file.channels(part)
        names += channels
        chosen = _colour_channels(list(channels))
        if chosen is None:
            continue
        pixels = [np.asarray(channels[name].pixels, np.float32) for name in chosen]
        if any(p.ndim != 2 or p.shape != pixels[0].shape for p in pixels):
            raise PRTError(str(path), "its colour channels have different sizes", _USE_ANOTHER)
        header = file.header(part)
        return _in_display_window(np.stack(pixels, axis=2), header["dataWindow"], header["displayWindow"])
    found = ", ".join(names) or "none"
    raise PRTError(str(path), f"it has no red, green and blue channels (only {found})", _USE_ANOTHER)


def _colour_channels(names: list[str]) -> list[str] | None:
    """The names of red, green and blue: plain ones first, then those of the first layer, then grey."""
    prefixes = sorted({name[:-1] for name in names if name[-1:] in ("R", "r")}, key=lambda p: (len(p) > 0, p))
    for prefix in prefixes:
        for letters in ("RGB", "rgb"):
            if all(prefix + letter in names for letter in letters):
                return [prefix + letter for letter in letters]
    return ["Y"] * 3 if "Y" in names else None


def _in_display_window(pixels: Image, data_window: tuple, display_window: tuple) -> Image:
    """The data placed in the picture's full frame. Corners are inclusive (x, y)."""
    data_start, display_start = (np.asarray(w[0], int)[::-1] for w in (data_window, display_window))
    height, width = np.asarray(display_window[1], int)[::-1] - display_start + 1
    offset = data_start - display_start
    if not offset.any() and pixels.shape[:2] == (height, width):
        return pixels
    frame = np.zeros((height, width, 3), np.float32)
    start = np.maximum(offset, 0)
    stop = np.minimum(offset + pixels.shape[:2], (height, width))
    if np.all(stop > start):
        inside = pixels[start[0] - offset[0]:stop[0] - offset[0], start[1] - offset[1]:stop[1] - offset[1]]
        frame[start[0]:stop[0], start[1]:stop[1]] = inside
    return frame


def _read_radiance(path: Path) -> Image:
    """A Radiance picture in RGBE, flat or run-length encoded (Ward, Real Pixels, Graphics Gems II, 1991)."""
    data = path.read_bytes()
    size = re.search(rb"\n\n-Y (\d+) \+X (\d+)\n", data)
    if not data.startswith(b"#?") or size is None or b"FORMAT=32-bit_rle_rgbe" not in data[:size.start()]:
        raise PRTError(str(path), "it is not a Radiance RGBE picture stored top row first", _USE_ANOTHER)
    height, width = int(size[1]), int(size[2])
    if height * width == 0 or height * width > 2**30:
        raise PRTError(str(path), f"its size {width} x {height} makes no sense", _USE_ANOTHER)
    try:
        rgbe = _radiance_pixels(data, size.end(), height, width)
    except (IndexError, ValueError) as error:
        raise PRTError(str(path), "its pixel data is damaged or cut off", _USE_ANOTHER) from error
    scale = np.ldexp(np.float32(1), rgbe[:, :, 3].astype(np.int32) - 136)  # 128 is the bias, 8 the mantissa's bits
    return rgbe[:, :, :3] * np.where(rgbe[:, :, 3] > 0, scale, np.float32(0))[:, :, None]


def _radiance_pixels(data: bytes, position: int, height: int, width: int) -> NDArray[np.uint8]:
    """Mantissas and exponents (height, width, 4). Raises IndexError or ValueError where the data does not add up."""
    marker = bytes([2, 2, width >> 8 & 255, width & 255])
    if not 8 <= width < 32768 or data[position:position + 4] != marker:
        return np.frombuffer(data, np.uint8, height * width * 4, position).reshape(height, width, 4)
    rows = np.empty((height, 4, width), np.uint8)
    for row in rows:
        if data[position:position + 4] != marker:
            raise ValueError("a row does not start as it should")
        line, position = _decode_runs(data, position + 4, 4 * width)
        row[...] = np.frombuffer(line, np.uint8).reshape(4, width)
    return rows.transpose(0, 2, 1)


def _decode_runs(data: bytes, position: int, length: int) -> tuple[bytes, int]:
    """`length` bytes from runs (count above 128: repeat one byte) and literals, and the position behind them."""
    line = bytearray()
    while len(line) < length:
        count = data[position]
        if count > 128:
            line += data[position + 1:position + 2] * (count - 128)
            position += 2
        else:
            line += data[position + 1:position + 1 + count]
            position += 1 + count
    if len(line) != length:
        raise ValueError("a run crosses the end of its row")
    return bytes(line), position
