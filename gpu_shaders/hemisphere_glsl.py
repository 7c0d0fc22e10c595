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
