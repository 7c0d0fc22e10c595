# SPDX-License-Identifier: GPL-3.0-or-later
"""Files that are either complete or absent: written beside, flushed, moved into place."""

from __future__ import annotations

import json
import os
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from ..errors import StorageError

FREE_SPACE = "Free some space, or choose a folder that can be written"


def write_atomically(path: Path, write: Callable[[IO[bytes]], None]) -> None:
    """Let `write` fill a file beside `path` and move it there; an existing file stays until the new one is whole.

    Raises StorageError where the folder can't be written or the disk is full.
    """
    beside = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        with beside.open("wb") as stream:
            write(stream)
            stream.flush()
            os.fsync(stream.fileno())
        os.replace(beside, path)
    except OSError as error:
        beside.unlink(missing_ok=True)
        raise StorageError(str(path), f"can't be written ({error.strerror or error})", FREE_SPACE) from error
    except BaseException:
        beside.unlink(missing_ok=True)
        raise


def save_arrays(path: Path, arrays: dict[str, NDArray[Any]], header: dict[str, Any] | None = None) -> None:
    """Write arrays and an optional JSON-able header as an uncompressed .npz, atomically."""
    entries = dict(arrays)
    if header is not None:
        entries["header"] = np.frombuffer(json.dumps(header).encode(), np.uint8)
    write_atomically(path, lambda stream: np.savez(stream, allow_pickle=False, **entries))


def load_arrays(path: Path) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
    """Arrays and header of a file written by `save_arrays`. Raises StorageError where it is missing or broken."""
    try:
        with np.load(path, allow_pickle=False) as stored:
            arrays = {name: stored[name] for name in stored.files}
    except (OSError, ValueError, EOFError, KeyError, zipfile.BadZipFile) as error:
        raise StorageError(str(path), f"can't be read ({error})", "Bake again") from error
    header = json.loads(arrays.pop("header").tobytes().decode()) if "header" in arrays else {}
    return arrays, header


def intact(path: Path) -> tuple[dict[str, NDArray[Any]], dict[str, Any]] | None:
    """`load_arrays` of a file that can be made again: None, and the file removed, where it is broken."""
    try:
        return load_arrays(path)
    except StorageError:
        path.unlink(missing_ok=True)
        return None


def save_json(path: Path, value: Any) -> None:
    """Write a JSON-able value, atomically."""
    write_atomically(path, lambda stream: stream.write(json.dumps(value, indent=1).encode()) and None)
