# SPDX-License-Identifier: GPL-3.0-or-later
"""How a bake keeps the links of live subsurface light: sizes in the header, everything else in one list of float32."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import StorageError
from ..relighting.live_scattering import SubsurfaceLinks

ENTRY = "subsurface_links"


def links_entry(links: SubsurfaceLinks) -> dict[str, Any]:
    """`subsurface_links` of a header."""
    return {"places": len(links.places), "links": links.texels.shape[1], "levels": links.levels,
            "holds": "places: receiver, factor, share through, area; then links: node, and halves of factor rgb and "
                     "shift xyz"}


def flatten_links(links: SubsurfaceLinks) -> NDArray[np.float32]:
    """One list of numbers."""
    return np.concatenate([links.places.ravel(), links.texels.ravel()]).astype(np.float32, copy=False)


def read_links(header: dict[str, Any], flat: NDArray | None, points: int, subject: str, remedy: str,
               ) -> SubsurfaceLinks | None:
    """The links of a header and its list of numbers; None where the header has none. Raises StorageError where they
    contradict each other."""
    entry = header.get(ENTRY)
    if entry is None:
        return None
    broken = StorageError(subject, "its links of subsurface light are missing or broken", remedy)
    sizes = [entry.get(name) if isinstance(entry, dict) else None for name in ("places", "links", "levels")]
    if not all(type(size) is int and size > 0 for size in sizes) or flat is None or sizes[2] > 16:
        raise broken
    places, links, levels = sizes
    values = np.asarray(flat, np.float32).ravel()
    if values.size < 4 * places:
        raise broken
    own = values[:4 * places].reshape(-1, 4)
    used = int((own[:, 0] >= 0.0).sum())
    if values.size != 4 * (places + used * links) or not used or not np.isfinite(values).all():
        raise broken
    texels = values[4 * places:].reshape(used, links, 4)
    count, level = places, places
    for above in range(1, levels):  # nodes of the levels above, each padded to a multiple of 4 but the last
        level //= 4
        level += -level % 4 if above + 1 < levels else 0
        count += level
    receiver, node = own[:, 0], texels[..., 0]
    named = receiver[receiver >= 0.0]
    if named.size and (named.max() >= points or len(np.unique(named)) != len(named)):
        raise broken
    if receiver.min() < -1.0 or node.min() < 0.0 or node.max() >= count or (own[:, 1:] < 0.0).any() or (
            levels > 1 and places % 4):
        raise broken
    return SubsurfaceLinks(own, texels, levels)
