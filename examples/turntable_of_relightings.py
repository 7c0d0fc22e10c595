# SPDX-License-Identifier: GPL-3.0-or-later
"""Turn the sky once around a baked scene: one picture per step, and nothing is baked or rendered anew.

    blender --background BAKED.blend --python examples/turntable_of_relightings.py -- FOLDER [--frames 36]
        [--size 640x400] [--environment SKY.exr]

FOLDER gets 0001.png, 0002.png, ... A video of them, for example:
ffmpeg -framerate 24 -i FOLDER/%04d.png -pix_fmt yuv420p turntable.mp4
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

import bpy


def main(arguments: list[str]) -> int:
    parser = argparse.ArgumentParser(prog="turntable_of_relightings.py", description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--frames", type=int, default=36)
    parser.add_argument("--size", default="")
    parser.add_argument("--environment", type=Path, default=None)
    options = parser.parse_args(arguments)
    options.folder.mkdir(parents=True, exist_ok=True)
    environment = str(options.environment.resolve()) if options.environment else ""
    started = time.perf_counter()
    for frame in range(options.frames):
        bpy.ops.prt.draw_camera(filepath=str((options.folder / f"{frame + 1:04d}.png").resolve()), size=options.size,
                                environment=environment, rotate=360.0 * frame / options.frames)
    print(f"{options.frames} pictures in {time.perf_counter() - started:.1f} s")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[sys.argv.index("--") + 1:]))
