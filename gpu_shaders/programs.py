# SPDX-License-Identifier: GPL-3.0-or-later
"""The two GPU programs, made of the GLSL files beside this module.

Push constants stay below the 128 bytes that Vulkan guarantees, and every declared one is used: setting an unused one
raises on OpenGL.
"""

from __future__ import annotations

import functools
from pathlib import Path

import gpu

from .render_data import TEXTURE_WIDTH

GROUP_SIZE = 64  # invocations of a work group; divides TEXTURE_WIDTH


def _source(*names: str) -> str:
    """The GLSL files joined in order."""
    return "\n".join((Path(__file__).parent / name).read_text(encoding="utf-8") for name in names)


@functools.cache
def exit_radiance() -> gpu.types.GPUShader:
    """The compute program that lights the points: see exit_radiance.comp.glsl."""
    info = gpu.types.GPUShaderCreateInfo()
    info.define("TEXTURE_WIDTH", str(TEXTURE_WIDTH))
    info.local_group_size(GROUP_SIZE, 1, 1)
    info.sampler(0, "FLOAT_2D", "encoding_values")
    info.sampler(1, "FLOAT_2D", "constant_values")
    info.image(0, "RGBA32F", "FLOAT_2D", "exit_values", qualifiers={"WRITE"})
    for name in ("points", "rows", "vectors"):
        info.push_constant("INT", name)
    info.compute_source(_source("texel_layout.glsl", "exit_radiance.comp.glsl"))
    return gpu.shader.create_from_info(info)


@functools.cache
def surface() -> gpu.types.GPUShader:
    """The program that draws a lit surface: see surface.vert.glsl and surface.frag.glsl."""
    varyings = gpu.types.GPUStageInterfaceInfo("prt_surface_varyings")
    varyings.smooth("VEC3", "unit_radiance")
    varyings.smooth("VEC3", "surface_albedo")
    info = gpu.types.GPUShaderCreateInfo()
    info.define("TEXTURE_WIDTH", str(TEXTURE_WIDTH))
    info.vertex_in(0, "VEC3", "position")
    info.vertex_in(1, "VEC3", "albedo")
    info.vertex_out(varyings)
    info.fragment_out(0, "VEC4", "fragment_colour")
    info.sampler(0, "FLOAT_2D", "exit_values")
    info.push_constant("MAT4", "transform")
    info.push_constant("FLOAT", "exposure")
    info.push_constant("FLOAT", "albedo_share")
    info.vertex_source(_source("texel_layout.glsl", "surface.vert.glsl"))
    info.fragment_source(_source("surface.frag.glsl"))
    return gpu.shader.create_from_info(info)


def release() -> None:
    """Free both programs; the next use compiles them again."""
    exit_radiance.cache_clear()
    surface.cache_clear()
