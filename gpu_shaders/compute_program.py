# SPDX-License-Identifier: GPL-3.0-or-later
"""A compute program described once: as Blender's GPU module takes it, and as plain GLSL for any other binding.

The plain text lets the same shader be timed on a machine without Blender (benchmarks), which is the only reason for it.
All textures are RGBA32F in two dimensions (render_data.py says why); in GLSL they are samplers, read by texelFetch, and
images, written by imageStore. Importing this module needs no gpu.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import gpu

GROUP_SIZE = 64  # invocations of a work group; divides render_data.TEXTURE_WIDTH
# Types of push constants as Blender names them, and in GLSL.
GLSL_TYPES = {"INT": "int", "FLOAT": "float", "VEC2": "vec2", "VEC3": "vec3", "VEC4": "vec4", "IVEC2": "ivec2",
              "IVEC3": "ivec3", "IVEC4": "ivec4", "MAT4": "mat4"}
ACCESS = {"WRITE": "writeonly", "READ": "readonly"}


def source(*names: str) -> str:
    """GLSL files of this folder joined in order."""
    return "\n".join((Path(__file__).parent / name).read_text(encoding="utf-8") for name in names)


@dataclass(frozen=True)
class ComputeProgram:
    """files: GLSL files of this folder, joined; samplers: names of textures read, bound in this order; images: (name,
    "READ", "WRITE" or "READ_WRITE"); constants: (Blender's type, name) of push constants, each used and all together
    within 128 bytes (Vulkan guarantees no more, OpenGL raises on unused ones); defines: (name, value); group: sizes of
    a work group."""

    files: tuple[str, ...]
    samplers: tuple[str, ...]
    images: tuple[tuple[str, str], ...]
    constants: tuple[tuple[str, str], ...]
    defines: tuple[tuple[str, str], ...] = ()
    group: tuple[int, int, int] = (GROUP_SIZE, 1, 1)

    def shader(self) -> gpu.types.GPUShader:
        """Compiled by Blender, once; `release` frees it."""
        return _compiled(self)

    def glsl(self) -> str:
        """Plain GLSL 4.3: sampler i and image i at binding i, push constants as uniforms of their names."""
        size = ", ".join(f"local_size_{axis} = {count}" for axis, count in zip("xyz", self.group, strict=True))
        lines = ["#version 430", *(f"#define {name} {value}" for name, value in self.defines), f"layout({size}) in;"]
        lines += [f"layout(binding = {slot}) uniform sampler2D {name};" for slot, name in enumerate(self.samplers)]
        lines += [f"layout(rgba32f, binding = {slot}) {ACCESS.get(access, '')} uniform image2D {name};"
                  for slot, (name, access) in enumerate(self.images)]
        lines += [f"uniform {GLSL_TYPES[kind]} {name};" for kind, name in self.constants]
        return "\n".join([*lines, source(*self.files)])


@functools.cache
def _compiled(program: ComputeProgram) -> gpu.types.GPUShader:
    import gpu

    info = gpu.types.GPUShaderCreateInfo()
    for name, value in program.defines:
        info.define(name, value)
    info.local_group_size(*program.group)
    for slot, name in enumerate(program.samplers):
        info.sampler(slot, "FLOAT_2D", name)
    for slot, (name, access) in enumerate(program.images):
        info.image(slot, "RGBA32F", "FLOAT_2D", name, qualifiers=set(access.split("_")))
    for kind, name in program.constants:
        info.push_constant(kind, name)
    info.compute_source(source(*program.files))
    return gpu.shader.create_from_info(info)


def release() -> None:
    """Free all compiled programs; the next use compiles them again."""
    _compiled.cache_clear()
