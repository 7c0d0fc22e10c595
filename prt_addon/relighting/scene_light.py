# SPDX-License-Identifier: GPL-3.0-or-later
"""All of a scene's light in the columns of one bake: distant light first, then the lights of its light cloud."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray


class LightingBasis(Protocol):
    """What is read of storage's Columns (this folder comes before storage)."""

    cloud: int
    cubemap: int

    @property
    def distant(self) -> int:
        """Columns of distant light."""
        ...


def joined_light(basis: LightingBasis, distant: NDArray[np.floating] | None,
                 local: NDArray[np.floating] | None) -> NDArray[np.float32]:
    """Light (columns, 3), or (zones, columns, 3) where a light cloud takes part, float32.

    distant: (n, 3) coefficients, at least basis.distant of them (higher orders are left out; of a cubemap just as many
    as it has texels), or None for none; local:
    (zones, basis.cloud, 3) weights of the cloud's lights, or None for none. Raises ValueError where there are too few
    coefficients.
    """
    first = np.zeros((basis.distant, 3), np.float32)
    if distant is not None and basis.distant:
        if distant.ndim != 2 or distant.shape[1] != 3 or len(distant) < basis.distant \
                or (basis.cubemap and len(distant) != basis.distant):
            raise ValueError(f"light of shape {distant.shape} for a bake of ({basis.distant}, 3)")
        first[:] = distant[:basis.distant]
    if not basis.cloud:
        return first
    if local is None:
        return np.concatenate([first, np.zeros((basis.cloud, 3), np.float32)])
    if local.ndim != 3 or local.shape[1:] != (basis.cloud, 3):
        raise ValueError(f"local light of shape {local.shape} for a bake of {basis.cloud} lights")
    result = np.empty((len(local), basis.distant + basis.cloud, 3), np.float32)
    result[:, :basis.distant] = first
    result[:, basis.distant:] = local
    return result
