# SPDX-License-Identifier: GPL-3.0-or-later
"""Blender's GPU module as a device of the ray engine. Needs an active GPU context; main thread only."""

from __future__ import annotations

from typing import Any

import gpu
import numpy as np
from numpy.typing import NDArray

from .draw import make_texture
from .ray_programs import PROGRAMS


class BlenderDevice:
    """A `RayDevice` (prt_addon/tracing/ray_engine.py)."""

    def __init__(self) -> None:
        self.name = f"{gpu.platform.renderer_get()}, {gpu.platform.backend_type_get()}"

    def upload(self, texels: NDArray[np.float32]) -> gpu.types.GPUTexture:
        """A texture of (height, width, 4) values."""
        return make_texture(texels)

    def empty(self, width: int, height: int) -> gpu.types.GPUTexture:
        """A texture for a kernel's answers."""
        return gpu.types.GPUTexture((width, height), format="RGBA32F")

    def run(self, kernel: str, occluded: bool, textures: dict[str, Any], answers: Any, constants: dict[str, int],
            groups: int) -> None:
        """Start a kernel with so many work groups."""
        program = PROGRAMS[kernel, occluded].shader()
        program.bind()
        for name, texture in textures.items():
            program.uniform_sampler(name, texture)
        program.image("answers", answers)
        for name, value in constants.items():
            program.uniform_int(name, value)
        gpu.compute.dispatch(program, groups, 1, 1)

    def read(self, texture: gpu.types.GPUTexture) -> NDArray[np.float32]:
        """Its values (height, width, 4), once all kernels that write them have ended."""
        return np.asarray(texture.read(), np.float32).reshape(texture.height, texture.width, 4)
