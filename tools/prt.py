# SPDX-License-Identifier: GPL-3.0-or-later
"""`python tools/prt.py VERB ...`: the extension's commands from a checkout, with the bpy wheel in place of Blender."""

from __future__ import annotations

import importlib
import importlib.util
import io
import os
import signal
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = "prt"


def load_extension() -> None:
    """Import the checkout as the package `prt`, whatever its folder is called, without a search path."""
    import bpy  # noqa: F401  the wheel has to be there before the modules it brings are imported

    spec = importlib.util.spec_from_file_location(PACKAGE, ROOT / "__init__.py", submodule_search_locations=[str(ROOT)])
    module = importlib.util.module_from_spec(spec)
    sys.modules[PACKAGE] = module
    spec.loader.exec_module(module)


def leave(_number: int, _frame: object) -> None:
    """End at once. A KeyboardInterrupt while Blender starts is swallowed by it, and half its add-ons are missing."""
    os.write(2, b"prt: interrupted. Run the same command again\n")
    os._exit(3)


def run(arguments: list[str]) -> int:
    """Run one command; stdout carries its result alone. Blender's log goes to stderr from the import on."""
    # Unbuffered: what a closed pipe or a full disk refused must not come up again when the stream is closed.
    with io.TextIOWrapper(os.fdopen(os.dup(1), "wb", buffering=0), "utf-8", "surrogateescape",
                          write_through=True) as results:
        os.dup2(2, 1)
        for number in (signal.SIGINT, signal.SIGTERM):  # until the command takes them over
            signal.signal(number, leave)
        load_extension()
        return importlib.import_module(f"{PACKAGE}.operators.commands").main(arguments, results)


if __name__ == "__main__":
    sys.exit(run(sys.argv[1:]))
