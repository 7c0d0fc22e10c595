# SPDX-License-Identifier: GPL-3.0-or-later
"""How a bake with highlights and a light cloud keeps what its materials do to the direct light of lamps.

The header names what is small (`lamp_surfaces`), a list of numbers holds the kernels, and each point its material.
Bakes without it (of before, or without highlights) show lamps in their diffuse row alone.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import StorageError
from ..relighting.lamp_highlights import LampSurfaces

ENTRY = "lamp_surfaces"
MOST_ORDER = 10


def lamp_surfaces_entry(surfaces: LampSurfaces) -> dict[str, Any]:
    """`lamp_surfaces` of a header."""
    return {"shape": [int(n) for n in surfaces.kernels.shape], "share": [float(v) for v in surfaces.share],
            "dimming": [[float(v) for v in row] for row in surfaces.dimming],
            "holds": "rows = kernel . y(direction to the lamp in the exit frame) times E / pi"}


def read_lamp_surfaces(header: dict[str, Any], material: NDArray | None, flat_kernels: NDArray | None, points: int,
                       subject: str, remedy: str) -> LampSurfaces | None:
    """The surfaces of a header, the points' materials and the list of numbers; None where the header has none. Raises
    StorageError where they contradict each other."""
    entry = header.get(ENTRY)
    if entry is None:
        return None
    broken = StorageError(subject, "what its materials do to the light of lamps is missing or broken", remedy)
    shape = entry.get("shape") if isinstance(entry, dict) else None
    if not (isinstance(shape, list) and len(shape) == 4 and all(type(n) is int and n > 0 for n in shape)):
        raise broken
    functions, squares = header["shape"][2] - 1, [n * n for n in range(1, MOST_ORDER + 1)]
    if shape[1] != functions or shape[2] not in squares or shape[3] not in (1, 3):
        raise broken
    try:
        share, dimming = (np.array(entry.get(name), np.float32) for name in ("share", "dimming"))
        kernels = np.asarray(flat_kernels, np.float32).reshape(shape)
        number = np.asarray(material, np.int32)
    except (TypeError, ValueError) as error:
        raise broken from error
    sizes = share.shape == (shape[0],) and dimming.shape == (shape[0], functions) and number.shape == (points,)
    if not sizes or not all(np.isfinite(values).all() for values in (share, dimming, kernels)):
        raise broken
    if points and not (int(number.min()) >= 0 and int(number.max()) < shape[0]):
        raise broken
    return LampSurfaces(number, kernels, share, dimming)
