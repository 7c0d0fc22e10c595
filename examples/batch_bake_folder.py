# SPDX-License-Identifier: GPL-3.0-or-later
"""Bake every .blend file of a folder, and write a report page for each.

    blender --background --python examples/batch_bake_folder.py -- SCENES BAKED
        [--preset draft] [--lighting environment]

BAKED gets NAME.blend and NAME.html for each NAME.blend of SCENES. Files that are there already are skipped, so that an
interrupted batch goes on where it stopped; a file that can't be baked is named and does not stop the others.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import bpy


def bake_file(source: Path, target: Path, preset: str, lighting: str) -> None:
    """Bake all visible meshes of one file into a new one. Raises RuntimeError with what the add-on says."""
    bpy.ops.wm.open_mainfile(filepath=str(source))
    bpy.ops.object.select_all(action="DESELECT")
    bpy.ops.prt.bake(preset=preset, lighting=lighting)
    bpy.ops.prt.write_report(filepath=str(target.with_suffix(".html")))
    bpy.ops.wm.save_as_mainfile(filepath=str(target), copy=True)  # last: the file's being there means it is done


def main(arguments: list[str]) -> int:
    parser = argparse.ArgumentParser(prog="batch_bake_folder.py", description=__doc__.splitlines()[0])
    parser.add_argument("scenes", type=Path)
    parser.add_argument("baked", type=Path)
    parser.add_argument("--preset", default="standard")
    parser.add_argument("--lighting", default="environment")
    options = parser.parse_args(arguments)
    options.baked.mkdir(parents=True, exist_ok=True)
    failed = 0
    for source in sorted(options.scenes.glob("*.blend")):
        target = options.baked / source.name
        if target.exists():
            print(f"{source.name}: baked already")
            continue
        try:
            bake_file(source.resolve(), target.resolve(), options.preset, options.lighting)
            print(f"{source.name}: {bpy.context.window_manager.prt.message}")
        except RuntimeError as error:  # how Blender passes on an operator's error
            failed += 1
            print(f"{source.name}: {str(error).strip()}", file=sys.stderr)
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[sys.argv.index("--") + 1:]))
