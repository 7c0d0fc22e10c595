# SPDX-License-Identifier: GPL-3.0-or-later
"""The GPU programs that draw surfaces whose receivers are texels: see texel_surface.frag.glsl."""

from __future__ import annotations

import functools

import gpu

from . import hemisphere_glsl, programs
from .compute_program import source
from .render_data import TEXTURE_WIDTH


@functools.cache
def texel_surface(functions: tuple[int, ...] = (), textured: bool = False) -> gpu.types.GPUShader:
    """The program that draws a lit surface from texels. functions: of the view, one for each row but the first;
    textured: its albedo is an image's."""
    varyings = gpu.types.GPUStageInterfaceInfo(f"prt_texels_{len(functions)}_varyings{'_textured' if textured else ''}")
    varyings.smooth("VEC2", "atlas_place")
    info = gpu.types.GPUShaderCreateInfo()
    info.define("TEXTURE_WIDTH", str(TEXTURE_WIDTH))
    info.define("ROWS", str(len(functions) + 1))
    info.vertex_in(0, "VEC3", "position")
    info.vertex_in(1, "VEC2", "place_in_atlas")
    programs.add_albedo(info, varyings, textured, 2, 3)
    viewer = bool(functions) and programs.sees_viewer(functions)
    if functions:
        info.define("HAS_ROWS")
    if viewer:
        info.define("SEES_VIEWER")
        for slot, name in ((3, "normal"), (4, "tangent")):
            info.vertex_in(slot, "VEC3", name)
        for name in ("to_viewer", "frame_normal", "frame_tangent"):
            varyings.smooth("VEC3", name)
        info.push_constant("VEC4", "viewer")
    info.vertex_out(varyings)
    info.fragment_out(0, "VEC4", "fragment_colour")
    for slot, name in enumerate(("exit_values", "direct_values", "atlas_points")):
        info.sampler(slot, "FLOAT_2D", name)
    info.push_constant("MAT4", "transform")
    for name in ("direct_share", "exposure", "albedo_share"):
        info.push_constant("FLOAT", name)
    info.vertex_source(source("texel_surface.vert.glsl"))
    rows = [_rows(functions), hemisphere_glsl.sum_rows(functions)] if functions else []
    text = source("texel_layout.glsl", "albedo.glsl", "texel_surface.frag.glsl")
    head, body = text.split("void main()", 1)
    info.fragment_source("\n".join([head, *rows, "void main()" + body]))
    return gpu.shader.create_from_info(info)


def _rows(functions: tuple[int, ...]) -> str:
    """The rows as the fragment's own, and `void fetch_rows(ivec4 around, vec4 shares)` that fills them."""
    names = hemisphere_glsl.row_names(functions)
    lines = [f"  {name} = row_around(around, shares, {index + 1});" for index, name in enumerate(names)]
    return "\n".join([*(f"vec3 {name};" for name in names), "void fetch_rows(ivec4 around, vec4 shares)", "{", *lines,
                      "}", ""])


programs.RELEASED_TOO.append(texel_surface.cache_clear)
