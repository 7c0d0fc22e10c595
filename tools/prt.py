# SPDX-License-Identifier: GPL-3.0-or-later
"""`python tools/prt.py VERB ...`: the extension's commands from a checkout, with the bpy wheel in place of Blender."""

from __future__ import annotations

import importlib
import importlib.util
import sys
from pathlib import Path

import bpy  # noqa: F401  the wheel has to be imported before anything that registers with it

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = "prt"


def load_extension() -> None:
    """Import the checkout as the package `prt`, whatever its folder is called, without a search path."""
    spec = importlib.util.spec_from_file_location(PACKAGE, ROOT / "__init__.py", submodule_search_locations=[str(ROOT)])
    module = importlib.util.module_from_spec(spec)
    sys.modules[PACKAGE] = module
    spec.loader.exec_module(module)


if __name__ == "__main__":
    load_extension()
    sys.exit(importlib.import_module(f"{PACKAGE}.operators.commands").run_as_program(sys.argv[1:]))
