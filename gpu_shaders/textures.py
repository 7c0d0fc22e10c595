# SPDX-License-Identifier: GPL-3.0-or-later
"""Textures of numbers, to and from numpy. Needs an active GPU context."""

from __future__ import annotations

import gpu
import numpy as np
from numpy.typing import NDArray


def make_texture(texels: NDArray[np.float32]) -> gpu.types.GPUTexture:
    """An RGBA32F texture of (height, width, 4) values."""
    height, width, _ = texels.shape
    buffer = gpu.types.Buffer("FLOAT", texels.size, np.ascontiguousarray(texels, np.float32).reshape(-1))
    return gpu.types.GPUTexture((width, height), format="RGBA32F", data=buffer)


def read_texture(texture: gpu.types.GPUTexture) -> NDArray[np.float32]:
    """The values of an RGBA32F texture, (height, width, 4); row 0 is the texture's first, the lowest of a picture."""
    return np.array(texture.read(), np.float32).reshape(texture.height, texture.width, 4)
