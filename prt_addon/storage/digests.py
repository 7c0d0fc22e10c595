# SPDX-License-Identifier: GPL-3.0-or-later
"""Digests: equal input, equal text, on every machine."""

from __future__ import annotations

import hashlib
import json
from typing import Any

import numpy as np
from numpy.typing import NDArray


def digest_arrays(*arrays: NDArray[Any]) -> str:
    """Hexadecimal digest (32 characters) of the arrays' types, shapes and bytes."""
    state = hashlib.blake2b(digest_size=16)
    for array in arrays:
        state.update(f"{array.dtype.str}{array.shape}".encode())
        state.update(np.ascontiguousarray(array).tobytes())
    return state.hexdigest()


def digest_json(value: Any) -> str:
    """Hexadecimal digest (32 characters) of a JSON-able value, independent of the order of keys."""
    return hashlib.blake2b(json.dumps(value, sort_keys=True).encode(), digest_size=16).hexdigest()
