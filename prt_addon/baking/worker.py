# SPDX-License-Identifier: GPL-3.0-or-later
"""The bake's child process: run by path as `python -I worker.py JOB --site FOLDER`, writes JSON lines on stdout.

It is no part of the package while it starts (an isolated Python knows neither the extension nor its wheels), so it
loads `prt_addon` from its own place on disk first. Threads are fine here: this is not Blender's process.
"""

from __future__ import annotations

import argparse
import errno
import importlib
import importlib.util
import json
import os
import signal
import site
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

PACKAGE_FOLDER = Path(__file__).resolve().parents[1]
PROGRESS_SECONDS = 0.1  # between two progress lines of the same stage
NICENESS = 15  # at 5 a software-drawn viewport redrew 1.64 times as slowly while baking on two cores


def load_package(folder: Path) -> ModuleType:
    """Import the package in `folder` under its folder's name, without a search path."""
    spec = importlib.util.spec_from_file_location(
        folder.name, folder / "__init__.py", submodule_search_locations=[str(folder)]
    )
    if spec is None or spec.loader is None:
        raise ImportError(f"{folder} is no package")
    module = importlib.util.module_from_spec(spec)
    sys.modules[folder.name] = module
    spec.loader.exec_module(module)
    return module


def use_wheels(folder: str) -> None:
    """Tell this Python where the extension's wheels lie."""
    site.addsitedir(folder)


def emit(message_type: str, **values: Any) -> None:
    """Write one message; the parent knows the closed set of types (process.MESSAGES)."""
    sys.stdout.write(json.dumps({"type": message_type, **values}) + "\n")
    sys.stdout.flush()


def die_with_parent(clean_up: Callable[[], None]) -> None:
    """End at once when the parent closes our input or dies: finished stages are on disk, so nothing is lost.
    clean_up: removes what is unfinished, as no parent is left to do it.

    Its own thread, because the main thread may be inside a long call. It reads the bare descriptor: the lock of a
    buffered sys.stdin held at the interpreter's end aborts the process.
    """

    def watch() -> None:
        while os.read(0, 1):
            pass
        try:
            clean_up()
        finally:
            os._exit(3)

    threading.Thread(target=watch, daemon=True, name="parent watch").start()


def be_polite() -> None:
    """Ctrl-C is the parent's to handle; the artist's other programs go first (Windows: set by the parent)."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    if hasattr(os, "nice"):
        os.nice(NICENESS)


def run_or_give_up(job_folder: Path, clean_up: Callable[[], None], cant_write: int,
                   package: str = PACKAGE_FOLDER.name, **options: Any) -> int:
    """`run`; where its messages can't be written (a full disk), end at once with the status that says so."""
    try:
        return run(job_folder, package, **options)
    except OSError as error:
        if error.errno not in (errno.ENOSPC, errno.EDQUOT, errno.EIO, errno.EFBIG, errno.EROFS):
            raise
        clean_up()
        os._exit(cant_write)  # without a flush of what can't be written


def run(job_folder: Path, package: str, **options: Any) -> int:
    """Bake the job, with its result left in the folder. package: the name under which `prt_addon` is imported; options:
    of `run_job`. Returns the exit status."""
    errors = importlib.import_module(f"{package}.errors")
    try:
        job = importlib.import_module(f"{package}.baking.job")
        last_stage, last_time = None, 0.0
        for progress in job.run_job(job_folder, **options):
            now = time.monotonic()
            if progress.stage != last_stage or now - last_time >= PROGRESS_SECONDS:
                last_stage, last_time = progress.stage, now
                emit("progress", stage=progress.stage, fraction=float(progress.fraction), rays=int(progress.rays),
                     seconds_left=None if progress.seconds_left is None else float(progress.seconds_left))
    except errors.PRTError as error:
        emit("error", subject=error.subject, cause=error.cause, remedy=error.remedy, exit_code=error.exit_code)
        return error.exit_code
    except MemoryError:
        emit("error", subject="Bake", cause="memory ran out",
             remedy="Choose a lower order, fewer directions, lights or objects and bake again to resume", exit_code=1)
        return 1
    emit("done")
    return 0


def main() -> int:
    parser = argparse.ArgumentParser()
    parser.add_argument("job", type=Path)
    parser.add_argument("--site", required=True)
    arguments = parser.parse_args()
    use_wheels(arguments.site)
    be_polite()
    load_package(PACKAGE_FOLDER)
    leftovers = importlib.import_module(f"{PACKAGE_FOLDER.name}.baking.leftovers")

    def clean_up() -> None:
        leftovers.drop_unfinished(arguments.job)

    die_with_parent(clean_up)
    return run_or_give_up(arguments.job, clean_up, leftovers.CANT_WRITE)


if __name__ == "__main__":
    sys.exit(main())
