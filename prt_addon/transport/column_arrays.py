# SPDX-License-Identifier: GPL-3.0-or-later
"""Transfer too large for memory: arrays of whole columns, on disk where a budget says so.

Columns come first, (columns, receivers): a fill writes one direction for many receivers, a bounce and a principal
component analysis read whole columns, and each of these is one run of the file.
"""

from __future__ import annotations

import errno
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from ..errors import PRTError

Single = NDArray[np.float32]

# Columns in memory at once: 256 of 50,000 receivers are 51 MB.
COLUMNS_AT_ONCE = 256


def column_array(columns: int, receivers: int, budget: int | None = None, folder: Path | None = None,
                 kind: DTypeLike = np.float32) -> NDArray[Any]:
    """Zeros (columns, receivers): in memory where they take at most `budget` bytes (None: always), else in a nameless
    file of `folder` (None: the system's for temporary files), which goes away with the array.

    Raises PRTError where the disk has no room for it.
    """
    size = np.dtype(kind).itemsize * columns * receivers
    if budget is None or size <= budget or not size:
        return np.zeros((columns, receivers), kind)
    try:
        free = shutil.disk_usage(folder or tempfile.gettempdir()).free
        if size > free:  # else the file's pages would find no room later, which ends the process
            raise OSError(errno.ENOSPC, f"{free / 1e9:.1f} GB are free")
        with tempfile.TemporaryFile(dir=folder) as file:
            file.truncate(size)
            return np.memmap(file, kind, "r+", shape=(columns, receivers))
    except OSError as error:
        remedy = "Free some disk space, or choose a smaller cubemap or fewer glossy_rows"
        raise PRTError(str(folder or tempfile.gettempdir()), f"{size / 1e9:.1f} GB of transfer can't be written there "
                       f"({error.strerror or error})", remedy) from error


def column_blocks(columns: int, at_once: int = COLUMNS_AT_ONCE) -> Iterator[slice]:
    """Slices of all columns, `at_once` each."""
    for start in range(0, columns, at_once):
        yield slice(start, min(start + at_once, columns))
