# SPDX-License-Identifier: GPL-3.0-or-later
"""Pictures of many channels as OpenEXR files. The library is imported when one is written."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..errors import PRTError, StorageError
from .files import FREE_SPACE


def write_exr(path: Path, channels: dict[str, NDArray[np.floating]]) -> None:
    """Write channels (height, width) by name, row 0 the lowest, in single precision, compressed without loss.

    The file is complete or absent. Raises PRTError where the library is missing, StorageError where the file can't be
    written.
    """
    try:
        import OpenEXR
    except ImportError as error:
        raise PRTError(str(path), f"the OpenEXR module is missing ({error})",
                       "Install the extension's own build for this Python") from error
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    pixels = {name: np.ascontiguousarray(values[::-1], np.float32) for name, values in channels.items()}
    beside = path.with_name(f".{path.stem}.{os.getpid()}.part.exr")
    try:
        OpenEXR.File(header, pixels).write(str(beside))
        os.replace(beside, path)
    except (OSError, RuntimeError) as error:
        raise StorageError(str(path), f"can't be written ({error})", FREE_SPACE) from error
    finally:
        beside.unlink(missing_ok=True)
