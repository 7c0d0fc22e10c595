# SPDX-License-Identifier: GPL-3.0-or-later
"""Saving the .blend file so that an existing one is replaced by a complete new one or not at all."""

from __future__ import annotations

import os
import stat
from pathlib import Path

import bpy

from ..errors import StorageError

CHOOSE = "Choose a folder that can be written"


def save_blend(path: Path) -> None:
    """Write the open file to `path` (a copy: the open file keeps its own path): beside it first, then moved into place.

    Raises StorageError for a missing folder, a read-only file or folder, a full disk.
    """
    path = Path(path)
    if path.suffix.lower() != ".blend":
        raise StorageError(str(path), "a Blender file ends in .blend", "Give the output that ending")
    if not path.parent.is_dir():
        raise StorageError(str(path), "its folder does not exist", "Create the folder, or choose another")
    if path.is_dir():
        raise StorageError(str(path), "there is a folder of this name", "Choose another name")
    # Moving over a read-only file would succeed and break what its owner meant by protecting it.
    if path.exists() and _is_read_only(path):
        raise StorageError(str(path), "the file is read-only", "Make it writable, or choose another name")
    if _is_read_only(path.parent):
        raise StorageError(str(path), "its folder is read-only", CHOOSE)
    beside = path.with_name(f".{path.stem}.{os.getpid()}.part.blend")
    try:
        bpy.ops.wm.save_as_mainfile(filepath=str(beside), copy=True, check_existing=False)
        os.replace(beside, path)
    except (RuntimeError, OSError) as error:
        raise StorageError(str(path), f"can't be written ({_one_line(error)})", f"Free some space. {CHOOSE}") from error
    finally:
        for leftover in (beside, Path(f"{beside}@"), Path(f"{beside}1")):
            leftover.unlink(missing_ok=True)


def _is_read_only(path: Path) -> bool:
    """Whether the system refuses to write, or its owner marked it read-only (which does not stop an administrator)."""
    return not os.access(path, os.W_OK) or not path.stat().st_mode & (stat.S_IWUSR | stat.S_IWGRP | stat.S_IWOTH)


def _one_line(error: Exception) -> str:
    text = (getattr(error, "strerror", None) or str(error)).strip()
    return text.splitlines()[-1].removeprefix("Error: ").rstrip(".") if text else type(error).__name__
