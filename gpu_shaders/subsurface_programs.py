# SPDX-License-Identifier: GPL-3.0-or-later
"""The compute programs of live subsurface light, and how their lists lie in textures. Imports neither gpu nor bpy."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .compute_program import ComputeProgram
from .render_data import TEXTURE_WIDTH, texture_values

GROUP_SIZE = 64
_LAYOUT = "texel_layout.glsl"
_WIDTH = (("TEXTURE_WIDTH", str(TEXTURE_WIDTH)),)


def _program(name: str, samplers: tuple[str, ...], image: tuple[str, str], *constants: tuple[str, str],
             ) -> ComputeProgram:
    return ComputeProgram((_LAYOUT, f"subsurface_{name}.comp.glsl"), samplers, (image,), constants, _WIDTH,
                          (GROUP_SIZE, 1, 1))


IRRADIANCE = _program("irradiance", ("place_values", "direct_values", "bounced_values"), ("pyramid_values", "WRITE"),
                      ("INT", "places"), ("INT", "rows"), ("FLOAT", "bounced_share"))
LAMP = _program("lamp", ("geometry_values",), ("pyramid_values", "WRITE"), ("INT", "places"), ("VEC4", "lamp"))
REDUCE = _program("reduce", (), ("pyramid_values", "READ_WRITE"), ("IVEC3", "level_range"))
GATHER = _program("gather", ("link_values", "pyramid_values"), ("scattered_values", "WRITE"),
                  ("INT", "places"), ("INT", "links"))
SHADE = _program("shade", ("direct_values", "bounced_values", "scattered_values", "leaving_values"),
                 ("shaded_values", "WRITE"), ("INT", "points"), ("INT", "rows"), ("FLOAT", "bounced_share"))


def link_texels(node: NDArray[np.integer], factor: NDArray[np.floating]) -> NDArray[np.float32]:
    """Links (places, K) with factors (places, K, 3) as a texture: texel k * places + place. Raises BadScene where they
    do not fit one."""
    places, links = node.shape
    values = np.empty((links * places, 4), np.float32)
    values[:, 0] = node.T.ravel()  # exact up to 2^24 nodes
    values[:, 1:] = factor.transpose(1, 0, 2).reshape(-1, 3)
    return texture_values(values)
