# SPDX-License-Identifier: GPL-3.0-or-later
"""Links of subsurface light as texels of four numbers, as they are stored and as the shaders read them.

The number of the node, exact up to 2^24, then three pairs of half-precision numbers (the paper's links are in half
precision, too): factors of red and green; factor of blue and the x of the shift; its y and z. A pair is one number of
32 bits, low half first. Its high half is never smaller than the smallest normal one, so that the pair is never a
denormal number, which drivers may take for 0, nor is it ever infinite.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..transport.subsurface_links import Links

# Factors are stored times this, so that those near the smallest half are of no account.
FACTOR_SCALE = 1024.0
SMALLEST, LARGEST = np.float32(2.0**-14), np.float32(60000.0)
# The shift of a link without one: two of its numbers are SMALLEST.
LEAST_SHIFT = 4.0 * float(SMALLEST)


def link_texels(links: Links) -> NDArray[np.float32]:
    """(r, K, 4) float32."""
    factor = links.factor * np.float32(FACTOR_SCALE)
    result = np.empty((*links.node.shape, 4), np.float32)
    result[..., 0] = links.node
    result[..., 1] = _pair(factor[..., 0], factor[..., 1])
    result[..., 2] = _pair(factor[..., 2], links.shift[..., 0])
    result[..., 3] = _pair(links.shift[..., 1], links.shift[..., 2])
    return result


def unpacked_links(texels: NDArray[np.float32]) -> Links:
    """What `link_texels` (r, K, 4) hold."""
    halves = np.ascontiguousarray(texels[..., 1:], np.float32).view(np.float16).astype(np.float32)
    shift = halves[..., 3:].copy()
    shift[np.abs(shift).sum(axis=-1) <= LEAST_SHIFT] = 0.0
    return Links(texels[..., 0].astype(np.int32), halves[..., :3] / np.float32(FACTOR_SCALE), shift, np.zeros(3))


def _pair(low: NDArray[np.float32], high: NDArray[np.float32]) -> NDArray[np.float32]:
    """Two halves as the bits of one number."""
    high = np.where(np.abs(high) < SMALLEST, np.where(high < 0.0, -SMALLEST, SMALLEST), high)
    low, high = (np.clip(value, -LARGEST, LARGEST).astype(np.float16).view(np.uint16).astype(np.uint32)
                 for value in (low, high))
    return (low | (high << np.uint32(16))).view(np.float32)
