# SPDX-License-Identifier: GPL-3.0-or-later
"""GLSL for the rows of view-dependent transfer, written out for a set of functions. Imports neither gpu nor bpy.

The functions are the real spherical harmonics of `basis.spherical_harmonics`, by the same recursion, whose constants
are known when the text is written: about two multiplications per function, no loop, no array.
"""

from __future__ import annotations

import math


def row_names(functions: tuple[int, ...]) -> list[str]:
    """The varyings that hold the coefficients of the functions, in order."""
    return [f"row_{index}" for index in range(len(functions))]


def fetch_rows(functions: tuple[int, ...]) -> str:
    """`void fetch_rows(int first_texel)` of the vertex stage: every varying from its texel of exit_values."""
    lines = [f"  {name} = texelFetch(exit_values, texel(first_texel + {index + 1}), 0).rgb;"
             for index, name in enumerate(row_names(functions))]
    return "\n".join(["void fetch_rows(int first_texel)", "{", *lines, "}", ""])


def add_direct_rows(functions: tuple[int, ...]) -> str:
    """`void add_direct_rows(int first_texel)` of the vertex stage: the direct light of lamps on top."""
    lines = [f"  {name} += texelFetch(direct_values, texel(first_texel + {index + 1}), 0).rgb;"
             for index, name in enumerate(row_names(functions))]
    return "\n".join(["void add_direct_rows(int first_texel)", "{", *lines, "}", ""])


def turns_with_frames(functions: tuple[int, ...]) -> bool:
    """Whether the rows can be turned about the normal: with every function of azimuth m the set has its twin -m."""
    return all(_twin(index) in functions for index in functions)


def _twin(index: int) -> int:
    """The function of the same band and azimuth -m."""
    band = math.isqrt(index)
    return 2 * band * (band + 1) - index


def turn_rows(functions: tuple[int, ...]) -> str:
    """`void turn_rows(float turn)` of the vertex stage: the varyings as coefficients in a frame that is turned by the
    angle about the normal. cos(m a) and sin(m a) of an azimuth a = a' + turn are sums of those of a'."""
    lines, azimuths = [], set()
    for name, index in zip(row_names(functions), functions, strict=True):
        band = math.isqrt(index)
        m = index - band * (band + 1)
        if m <= 0:
            continue
        if m not in azimuths:
            azimuths.add(m)
            lines += [f"  float cos_{m} = cos({m}.0 * turn);", f"  float sin_{m} = sin({m}.0 * turn);"]
        twin = row_names(functions)[functions.index(_twin(index))]
        lines += [f"  vec3 old_{index} = {name};", f"  {name} = old_{index} * cos_{m} + {twin} * sin_{m};",
                  f"  {twin} = {twin} * cos_{m} - old_{index} * sin_{m};"]
    return "\n".join(["void turn_rows(float turn)", "{", *lines, "}", ""])


def sum_rows(functions: tuple[int, ...]) -> str:
    """`vec3 sum_rows(vec3 view)` of the fragment stage: the sum of y_i(view) times row, for a unit view."""
    order = math.isqrt(max(functions)) + 1
    lines = ["  float c_0 = 1.0;", "  float s_0 = 0.0;"]
    sectoral = math.sqrt(1.0 / (4.0 * math.pi))
    for m in range(order):
        if m > 0:
            lines.append(f"  float c_{m} = view.x * c_{m - 1} - view.y * s_{m - 1};")
            lines.append(f"  float s_{m} = view.x * s_{m - 1} + view.y * c_{m - 1};")
            sectoral *= math.sqrt((2 * m + 1) / (2 * m)) * (math.sqrt(2.0) if m == 1 else 1.0)
        lines += _legendre(m, order, sectoral)
    terms = [f"{_value(index)} * {name}" for name, index in zip(row_names(functions), functions, strict=True)]
    total = "\n         + ".join(terms)
    return "\n".join(["vec3 sum_rows(vec3 view)", "{", *lines, f"  return {total};", "}", ""])


def _legendre(m: int, order: int, sectoral: float) -> list[str]:
    """Lines that define p_l_m, l = m .. order - 1: normalised Legendre functions without their sin^m(theta)."""
    lines = [f"  float p_{m}_{m} = {sectoral!r};"]
    for up in range(m + 1, order):
        band = up - 1
        a = math.sqrt((4 * up * up - 1) / (up * up - m * m))
        b = a * math.sqrt((band * band - m * m) / (4 * band * band - 1)) if band > m else 0.0
        before = f" - {b!r} * p_{band - 1}_{m}" if band > m else ""
        lines.append(f"  float p_{up}_{m} = {a!r} * view.z * p_{band}_{m}{before};")
    return lines


def _value(index: int) -> str:
    """The expression of y_i."""
    band = math.isqrt(index)
    m = index - band * (band + 1)
    return f"p_{band}_{abs(m)}" + (f" * c_{m}" if m > 0 else f" * s_{-m}" if m < 0 else "")
