# SPDX-License-Identifier: GPL-3.0-or-later
"""Runs a script as `blender --background [FILE.blend] --python SCRIPT -- ARGS` would, from a checkout with `bpy`.

    python tools/run_script.py [FILE.blend] SCRIPT -- ARGS
"""

from __future__ import annotations

import runpy
import sys

from prt import PACKAGE, load_extension


def main(arguments: list[str]) -> None:
    end = arguments.index("--") if "--" in arguments else len(arguments)
    *files, script = arguments[:end] or [""]
    if not script.endswith(".py") or len(files) > 1:
        sys.exit(f"run_script.py: {__doc__.splitlines()[-1].strip()}")
    load_extension()
    import bpy

    sys.modules[PACKAGE].register()
    for path in files:
        bpy.ops.wm.open_mainfile(filepath=path)
    sys.argv = [script, *arguments[end:]]
    runpy.run_path(script, run_name="__main__")


if __name__ == "__main__":
    main(sys.argv[1:])
