# SPDX-License-Identifier: GPL-3.0-or-later
"""The GPU programs, made of the GLSL files beside this module: one that lights points, one that draws diffuse
surfaces, and one for each set of functions of the view.

Push constants stay below the 128 bytes that Vulkan guarantees, and every declared one is used: setting an unused one
raises on OpenGL.
"""

from __future__ import annotations

import functools
from collections.abc import Callable

import gpu

from ..prt_addon.errors import PRTError
from . import compute_program, hemisphere_glsl
from .compute_program import ComputeProgram, source
from .render_data import TEXTURE_WIDTH

RELEASED_TOO: list[Callable[[], None]] = []  # what frees the programs of modules that build on this one


EXIT_RADIANCE = ComputeProgram(
    ("texel_layout.glsl", "exit_radiance.comp.glsl"), ("encoding_values", "constant_values"),
    (("exit_values", "WRITE"),), (("INT", "points"), ("INT", "rows"), ("INT", "vectors")),
    (("TEXTURE_WIDTH", str(TEXTURE_WIDTH)),))


def exit_radiance() -> gpu.types.GPUShader:
    """The compute program that lights the points: see exit_radiance.comp.glsl."""
    return EXIT_RADIANCE.shader()


@functools.cache
def surface(textured: bool = False) -> gpu.types.GPUShader:
    """The program that draws a lit surface: see surface.vert.glsl and surface.frag.glsl. textured: its albedo is an
    image's."""
    varyings = gpu.types.GPUStageInterfaceInfo(f"prt_surface_varyings{'_textured' if textured else ''}")
    varyings.smooth("VEC3", "unit_radiance")
    info = gpu.types.GPUShaderCreateInfo()
    info.define("TEXTURE_WIDTH", str(TEXTURE_WIDTH))
    info.vertex_in(0, "VEC3", "position")
    add_albedo(info, varyings, textured, 1)
    if textured:
        info.vertex_in(2, "FLOAT", "receiver")
    info.vertex_out(varyings)
    info.fragment_out(0, "VEC4", "fragment_colour")
    info.sampler(0, "FLOAT_2D", "exit_values")
    info.sampler(1, "FLOAT_2D", "direct_values")
    info.push_constant("MAT4", "transform")
    info.push_constant("FLOAT", "direct_share")
    info.push_constant("FLOAT", "exposure")
    info.push_constant("FLOAT", "albedo_share")
    info.vertex_source(source("texel_layout.glsl", "surface.vert.glsl"))
    info.fragment_source(source("albedo.glsl", "surface.frag.glsl"))
    return gpu.shader.create_from_info(info)


@functools.cache
def depth_alone() -> gpu.types.GPUShader:
    """The program that writes the depth of other surfaces: see depth.vert.glsl."""
    info = gpu.types.GPUShaderCreateInfo()
    info.vertex_in(0, "VEC3", "position")
    info.fragment_out(0, "VEC4", "fragment_colour")
    info.push_constant("MAT4", "transform")
    info.vertex_source(source("depth.vert.glsl"))
    info.fragment_source(source("depth.frag.glsl"))
    return gpu.shader.create_from_info(info)


def add_albedo(info: gpu.types.GPUShaderCreateInfo, varyings: gpu.types.GPUStageInterfaceInfo, textured: bool,
               slot: int, sampler: int = 2) -> None:
    """Declare where albedo.glsl takes its colour from: the vertices, by an attribute in a slot, or an image, in the
    place `sampler`."""
    if textured:
        info.define("TEXTURED")
        info.vertex_in(slot, "VEC2", "place")
        varyings.smooth("VEC2", "texture_place")
        info.sampler(sampler, "FLOAT_2D", "albedo_image")
        info.push_constant("VEC4", "texture_factor")
    else:
        info.vertex_in(slot, "VEC3", "albedo")
        varyings.smooth("VEC3", "surface_albedo")


def sees_viewer(functions: tuple[int, ...]) -> bool:
    """Whether some function is not constant. Where none is, nothing of the viewer is declared: see above."""
    return any(functions)


@functools.cache
def view_surface(functions: tuple[int, ...], textured: bool = False) -> gpu.types.GPUShader:
    """The program that draws a lit surface whose radiance depends on the view: see view_surface.vert.glsl.

    functions: of the view, one for each row but the first; textured: its albedo is an image's. Raises PRTError where
    the driver passes too few numbers from vertices to fragments.
    """
    names = ["diffuse_radiance", *hemisphere_glsl.row_names(functions)]
    names += ["local_view"] if sees_viewer(functions) else []
    most = gpu.capabilities.max_varying_floats_get() // 4  # each takes a slot of four
    if len(names) + 1 > most:  # and that of the albedo
        raise PRTError("the preview", f"the graphics driver passes {most} values to a pixel, this bake needs "
                       f"{len(names) + 1}", "Bake with fewer functions of the view")
    varyings = gpu.types.GPUStageInterfaceInfo(f"prt_view_{len(functions)}_varyings{'_textured' if textured else ''}")
    for name in names:
        varyings.smooth("VEC3", name)
    info = gpu.types.GPUShaderCreateInfo()
    info.define("TEXTURE_WIDTH", str(TEXTURE_WIDTH))
    info.define("ROWS", str(len(functions) + 1))
    for slot, name in enumerate(("position", "normal", "tangent")):
        info.vertex_in(slot, "VEC3", name)
    info.vertex_in(3, "VEC2", "receiver_and_turn")
    add_albedo(info, varyings, textured, 4)
    info.vertex_out(varyings)
    info.fragment_out(0, "VEC4", "fragment_colour")
    info.sampler(0, "FLOAT_2D", "exit_values")
    info.sampler(1, "FLOAT_2D", "direct_values")
    info.push_constant("MAT4", "transform")
    info.push_constant("FLOAT", "direct_share")
    if sees_viewer(functions):
        info.define("SEES_VIEWER")
        info.push_constant("VEC4", "viewer")
    info.push_constant("FLOAT", "exposure")
    info.push_constant("FLOAT", "albedo_share")
    fetch, total = hemisphere_glsl.fetch_rows(functions), hemisphere_glsl.sum_rows(functions)
    fetch += hemisphere_glsl.add_direct_rows(functions)
    turn = hemisphere_glsl.turn_rows(functions)
    info.vertex_source("\n".join([source("texel_layout.glsl"), fetch, turn, source("view_surface.vert.glsl")]))
    info.fragment_source("\n".join([total, source("albedo.glsl", "view_surface.frag.glsl")]))
    return gpu.shader.create_from_info(info)


def release() -> None:
    """Free all programs; the next use compiles them again."""
    compute_program.release()
    for forget in RELEASED_TOO:
        forget()
    surface.cache_clear()
    depth_alone.cache_clear()
    view_surface.cache_clear()
