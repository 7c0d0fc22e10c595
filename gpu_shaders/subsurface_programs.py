# SPDX-License-Identifier: GPL-3.0-or-later
"""The compute programs of live subsurface light. Imports neither gpu nor bpy.

Each comes with moments (links take the light at a place within their node, NODE_TEXELS = 4) and without (the links of
Carr et al. 2003, one texel for each node), which only the benchmark uses.
"""

from __future__ import annotations

from ..prt_addon.relighting.subsurface_texels import FACTOR_SCALE, LEAST_SHIFT
from .compute_program import ComputeProgram
from .render_data import TEXTURE_WIDTH

NODE_TEXELS = 4
_SAMPLERS = {
    "irradiance": ("place_values", "direct_values", "bounced_values"), "lamp": ("geometry_values",),
    "reduce": ("centre_values",), "gather": ("link_values", "pyramid_values"),
    "shade": ("direct_values", "bounced_values", "scattered_values", "leaving_values"),
}
_IMAGES = {"irradiance": ("pyramid_values", "WRITE"), "lamp": ("pyramid_values", "WRITE"),
           "reduce": ("pyramid_values", "READ_WRITE"), "gather": ("scattered_values", "WRITE"),
           "shade": ("shaded_values", "WRITE")}
_CONSTANTS = {
    "irradiance": (("INT", "places"), ("INT", "rows"), ("FLOAT", "bounced_share")),
    "lamp": (("INT", "places"), ("VEC4", "lamp")), "reduce": (("IVEC4", "level_range"),),
    "gather": (("INT", "places"), ("INT", "links")),
    "shade": (("INT", "points"), ("INT", "rows"), ("FLOAT", "bounced_share")),
}


def program(name: str, moments: bool = True) -> ComputeProgram:
    """irradiance or lamp (pass one), reduce (its pyramid), gather (pass two) or shade (pass three)."""
    defines = [("TEXTURE_WIDTH", str(TEXTURE_WIDTH))]
    if name not in ("shade",):
        defines.append(("NODE_TEXELS", str(NODE_TEXELS if moments else 1)))
    if name == "gather":
        defines += [("FACTOR_SCALE", f"{FACTOR_SCALE:.1f}"), ("LEAST_SHIFT", f"{LEAST_SHIFT:.9f}")]
    if moments and name in ("reduce", "gather"):
        defines.append(("MOMENTS", "1"))
    samplers = () if name == "reduce" and not moments else _SAMPLERS[name]
    return ComputeProgram(("texel_layout.glsl", f"subsurface_{name}.comp.glsl"), samplers, (_IMAGES[name],),
                          _CONSTANTS[name], tuple(defines))
