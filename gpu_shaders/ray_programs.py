# SPDX-License-Identifier: GPL-3.0-or-later
"""The kernels of the ray engine as compute programs, by the names under which prt_addon/tracing/ray_engine.py runs
them. Importing this module needs no gpu."""

from __future__ import annotations

from ..prt_addon.tracing.bounding_hierarchy import STACK
from ..prt_addon.tracing.ray_engine import CELLS, GROUP, MASKED, PAIRS, TRAVERSAL, WIDTH
from .compute_program import ComputeProgram


def _program(file: str, samplers: tuple[str, ...], constants: tuple[str, ...], occluded: bool,
             *defined: str) -> ComputeProgram:
    chosen = (*defined, "OCCLUDED") if occluded else defined
    defines = (("TEXTURE_WIDTH", str(WIDTH)), ("STACK", str(STACK)), *((name, "1") for name in chosen))
    return ComputeProgram(("texel_layout.glsl", "ray_triangle.glsl", "ray_answer.glsl", file), samplers,
                          (("answers", "WRITE"),), tuple(("INT", name) for name in constants), defines, (GROUP, 1, 1))


# (kernel, whether only occlusion is asked for) -> program
PROGRAMS: dict[tuple[str, bool], ComputeProgram] = {
    **{(TRAVERSAL, occluded): _program(
        "ray_traversal.comp.glsl", ("ray_origins", "ray_directions", "node_values", "triangle_values"),
        ("rays", "direction_step"), occluded) for occluded in (False, True)},
    (PAIRS, False): _program(
        "ray_traversal.comp.glsl", ("ray_origins", "ray_directions", "pair_codes", "node_values", "triangle_values"),
        ("rays", "origins"), False, "PAIRS"),
    (MASKED, True): _program(
        "ray_traversal.comp.glsl", ("ray_origins", "ray_directions", "asked_bits", "node_values", "triangle_values"),
        ("rays", "origins", "first"), True, "MASKED"),
    **{(CELLS, occluded): _program(
        "ray_cells.comp.glsl", ("ray_origins", "ray_directions", "triangle_values", "bucket_values", "pair_values"),
        ("rays", "direction_step", "bucket_rays"), occluded) for occluded in (False, True)},
}
