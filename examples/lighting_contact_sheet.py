# SPDX-License-Identifier: GPL-3.0-or-later
"""One sheet of a baked scene under many skies: to choose one, or to show a client.

    blender --background BAKED.blend --python examples/lighting_contact_sheet.py -- SHEET.png [SKIES ...]
        [--turns 0,120] [--size 480x300] [--columns 4]

SKIES: equirectangular .exr or .hdr files, or folders of them; without any, those that Blender brings along. Each is
drawn once for each turn (degrees).
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path

import blf
import bpy
import imbuf
import numpy as np

PAPER, GAP, CAPTION, TEXT = 24, 12, 30, 18  # grey of the sheet; pixels between pictures, under them, of letters
ENDINGS = {".exr", ".hdr"}


def sky_files(given: list[Path]) -> list[Path]:
    """The pictures among the files and folders given, or Blender's own."""
    if not given:
        given = [Path(bpy.utils.system_resource("DATAFILES", path="studiolights/world"))]
    found = [file for path in given for file in (sorted(path.iterdir()) if path.is_dir() else [path])]
    return [file.resolve() for file in found if file.suffix.lower() in ENDINGS]


def draw(sky: Path, turn: float, size: str, folder: Path) -> np.ndarray:
    """The camera's view under one sky: (height, width, 3) bytes, the lowest row first."""
    path = folder / "picture.png"
    bpy.ops.prt.draw_camera(filepath=str(path), size=size, environment=str(sky), rotate=turn)
    with imbuf.load(str(path)).with_buffer() as pixels:
        return np.array(pixels, np.uint8)[..., :3]


def lay_out(pictures: list[np.ndarray], captions: list[str], columns: int) -> object:
    """Pictures in rows with a caption under each, as an image buffer."""
    height, width, _ = pictures[0].shape
    rows = -(-len(pictures) // columns)
    size = GAP + columns * (width + GAP), GAP + rows * (height + CAPTION + GAP)
    sheet = imbuf.new(size)
    places = [(GAP + number % columns * (width + GAP), size[1] - (number // columns + 1) * (height + CAPTION + GAP))
              for number in range(len(pictures))]
    with sheet.with_buffer(write=True) as buffer:
        pixels = np.asarray(buffer)
        pixels[..., :3], pixels[..., 3] = PAPER, 255
        for picture, (left, bottom) in zip(pictures, places, strict=True):
            pixels[bottom + CAPTION:bottom + CAPTION + height, left:left + width, :3] = picture
    with blf.bind_imbuf(0, sheet):
        blf.size(0, TEXT)
        blf.color(0, 0.9, 0.9, 0.9, 1.0)
        for caption, (left, bottom) in zip(captions, places, strict=True):
            blf.position(0, left, bottom + CAPTION - TEXT - 3, 0.0)
            blf.draw_buffer(0, caption)
    return sheet


def main(arguments: list[str]) -> int:
    parser = argparse.ArgumentParser(prog="lighting_contact_sheet.py", description=__doc__.splitlines()[0])
    parser.add_argument("sheet", type=Path)
    parser.add_argument("skies", type=Path, nargs="*")
    parser.add_argument("--turns", default="0")
    parser.add_argument("--size", default="480x300")
    parser.add_argument("--columns", type=int, default=4)
    options = parser.parse_args(arguments)
    skies, turns = sky_files(options.skies), [float(turn) for turn in options.turns.split(",")]
    if not skies:
        sys.exit("lighting_contact_sheet.py: no .exr or .hdr file given")
    captions = [sky.stem + (f", {turn:g} degrees" if turn else "") for sky in skies for turn in turns]
    with tempfile.TemporaryDirectory() as folder:
        pictures = [draw(sky, turn, options.size, Path(folder)) for sky in skies for turn in turns]
    imbuf.write(lay_out(pictures, captions, min(options.columns, len(pictures))), filepath=str(options.sheet.resolve()))
    print(f"{len(pictures)} relightings: {options.sheet}")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[sys.argv.index("--") + 1:]))
