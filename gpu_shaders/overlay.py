# SPDX-License-Identifier: GPL-3.0-or-later
"""Marks over the viewport's picture: points, lines and triangles in the scene, and a legend of false colours.

They are drawn like Blender's own overlays, by its own programs, and only where overlays are shown. Colours are those
of the display (sRGB), untouched by the view transform.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import blf
import bpy
import gpu
import numpy as np
from gpu_extras.batch import batch_for_shader
from mathutils import Matrix
from numpy.typing import ArrayLike, NDArray

DEPTH_BIAS = 2e-6  # NDC towards the viewer: above the surface that is marked, and above its relit picture
PROGRAMS = {"POINTS": "POINT_FLAT_COLOR", "LINES": "FLAT_COLOR", "TRIS": "FLAT_COLOR"}
# Of the legend, in units of the interface's scale.
BAR, MARGIN, PADDING, TEXT = (200, 14), 20, 10, 12


@dataclass(frozen=True, eq=False)
class Overlay:
    """What is marked in the scene. kind: POINTS, LINES (pairs) or TRIS (triples, seen from their front alone).

    places: (n, 3) float32, world space; colours: (n, 4) float32; size: of points and lines, in pixels; in_front: drawn
    over surfaces that hide it. Never changed in place: another object means other marks.
    """

    kind: str
    places: NDArray[np.float32]
    colours: NDArray[np.float32]
    size: float = 1.0
    in_front: bool = False


@dataclass(frozen=True)
class Legend:
    """title: what the colours are of; colours: from left to right, display RGB, none for a title alone; labels: evenly
    spaced numbers below them."""

    title: str
    colours: tuple[tuple[float, float, float], ...] = ()
    labels: tuple[str, ...] = ()


@dataclass(frozen=True)
class Marks:
    """overlays: with (4, 4) each, from where it is given to where it is now; legend: None for none."""

    overlays: tuple[tuple[Overlay, ArrayLike], ...] = ()
    legend: Legend | None = None


NOTHING = Marks()


class OverlayCache:
    """The batches of overlays: built at their first drawing, dropped when they are shown no more."""

    def __init__(self) -> None:
        self._batches: dict[Overlay, gpu.types.GPUBatch] = {}

    def draw(self, overlays: Sequence[tuple[Overlay, ArrayLike]]) -> None:
        """Draw into the active framebuffer with Blender's present matrices; leaves the GPU state as it was."""
        self._batches = {overlay: self._batches[overlay] for overlay, _ in overlays if overlay in self._batches}
        if not overlays:
            return
        depth_test, depth_mask, blend = (gpu.state.depth_test_get(), gpu.state.depth_mask_get(), gpu.state.blend_get())
        gpu.state.depth_mask_set(False)
        gpu.state.blend_set("ALPHA")
        try:
            with gpu.matrix.push_pop_projection():
                projection = np.array(gpu.matrix.get_projection_matrix())
                projection[2] -= DEPTH_BIAS * projection[3]
                gpu.matrix.load_projection_matrix(Matrix(projection.tolist()))
                for overlay, moved in overlays:
                    self._draw(overlay, moved)
        finally:
            gpu.state.depth_test_set(depth_test)
            gpu.state.depth_mask_set(depth_mask)
            gpu.state.blend_set(blend)
            gpu.state.face_culling_set("NONE")
            gpu.state.point_size_set(1.0)
            gpu.state.line_width_set(1.0)

    def _draw(self, overlay: Overlay, moved: ArrayLike) -> None:
        program = gpu.shader.from_builtin(PROGRAMS[overlay.kind])
        if overlay not in self._batches:
            self._batches[overlay] = batch_for_shader(program, overlay.kind, {
                "pos": np.ascontiguousarray(overlay.places, np.float32),
                "color": np.ascontiguousarray(overlay.colours, np.float32)})
        gpu.state.depth_test_set("NONE" if overlay.in_front else "LESS_EQUAL")
        gpu.state.face_culling_set("BACK" if overlay.kind == "TRIS" else "NONE")
        scale = bpy.context.preferences.system.ui_scale
        gpu.state.point_size_set(overlay.size * scale)
        gpu.state.line_width_set(overlay.size * scale)
        with gpu.matrix.push_pop():
            gpu.matrix.multiply_matrix(Matrix(np.asarray(moved, np.float64).tolist()))
            self._batches[overlay].draw(program)

    def clear(self) -> None:
        """Drop every batch."""
        self._batches.clear()


def draw_legend(legend: Legend, region: bpy.types.Region, taken: float) -> None:
    """Draw a legend into the lower right of a region, left of what a sidebar takes of it (pixels)."""
    scale, font = bpy.context.preferences.system.ui_scale, 0
    blf.size(font, TEXT * scale)
    line = 1.5 * TEXT * scale
    title = blf.dimensions(font, legend.title)[0]
    inner = max(title, BAR[0] * scale if legend.colours else 0.0)
    height = line + (BAR[1] * scale + line if legend.colours else 0.0) + PADDING * scale
    width = inner + 2.0 * PADDING * scale
    left, low = region.width - taken - MARGIN * scale - width, MARGIN * scale
    gpu.state.blend_set("ALPHA")
    _rectangles([(left, low, left + width, low + height)], [(0.04, 0.04, 0.04, 0.75)])
    start = left + PADDING * scale
    if legend.colours:
        step, bottom = inner / len(legend.colours), low + line
        _rectangles([(start + k * step, bottom, start + (k + 1) * step, bottom + BAR[1] * scale)
                     for k in range(len(legend.colours))], [(*colour, 1.0) for colour in legend.colours])
    gpu.state.blend_set("NONE")
    blf.color(font, 0.95, 0.95, 0.95, 1.0)
    _write(font, legend.title, start, low + height - line + 0.3 * TEXT * scale)
    for number, label in enumerate(legend.labels):
        share = number / max(len(legend.labels) - 1, 1)
        # The outer ones stay within the bar.
        _write(font, label, start + share * (inner - blf.dimensions(font, label)[0]), low + 0.45 * TEXT * scale)


def _write(font: int, text: str, left: float, low: float) -> None:
    blf.position(font, left, low, 0.0)
    blf.draw(font, text)


def _rectangles(boxes: Sequence[tuple[float, float, float, float]],
                colours: Sequence[tuple[float, float, float, float]]) -> None:
    """Filled rectangles (left, low, right, high) in pixels of the region."""
    corners = [((a, b), (c, b), (c, d), (a, b), (c, d), (a, d)) for a, b, c, d in boxes]
    program = gpu.shader.from_builtin("FLAT_COLOR")
    places = np.array(corners, np.float32).reshape(-1, 2)
    batch = batch_for_shader(program, "TRIS", {
        "pos": np.concatenate([places, np.zeros((len(places), 1), np.float32)], axis=1),
        "color": np.repeat(np.array(colours, np.float32), 6, axis=0)})
    batch.draw(program)
