# SPDX-License-Identifier: GPL-3.0-or-later
"""Baked objects in every 3D viewport: `enable(get_draw_list)` and `disable()`.

Blender runs handlers at two points of a viewport's redraw. At PRE_VIEW the active framebuffer is the viewport's
scene-linear picture, to which Blender applies the view transform later; at POST_VIEW, when the depth is known, the
active framebuffer is the overlays', which is clipped and gets no view transform. So the first handler remembers the
framebuffer of its region and the second draws into it. That a region's picture is what is bound at PRE_VIEW is
internal to Blender: where it can't be bound or has another size, objects are drawn over the overlays instead (the
colours of the Standard view transform) and `status()` says so.

The objects themselves stay visible and are covered exactly: selection, outlines and occlusion stay right. Where other
objects take part, the depth in the picture decides; Blender's floor grid has written its lines into that depth, so
that below the floor the original shows through the lines, and EEVEE's depth is of one jittered sample, so that the
original shows in single pixels along creases. Both end when `is_complete` says that only listed objects are visible.
Handlers do not run in final renders nor in viewport renders.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass, field
from typing import Any

import blf
import bpy
import gpu
import numpy as np
from bpy_extras.view3d_utils import location_3d_to_region_2d
from mathutils import Vector
from numpy.typing import NDArray

from ..prt_addon.errors import PRTError
from . import programs
from .draw import DrawingCache
from .occluders import Occluder, OccluderCache
from .overlay import NOTHING, Marks, OverlayCache, draw_legend
from .render_data import DrawItem

SPACE = bpy.types.SpaceView3D
GetDrawList = Callable[[], Sequence[DrawItem]]
IsComplete = Callable[[], bool]
GetOccluders = Callable[[], Sequence[Occluder]]


GetLabels = Callable[[], Sequence[tuple[str, Sequence[float]]]]
GetMarks = Callable[[], Marks]
LABEL_SIZE, LABEL_OFFSET = 12, (14, 10)  # in units of the interface's scale


def _never_complete() -> bool:
    return False


def _no_occluders() -> Sequence[Occluder]:
    return ()


def _no_marks() -> Marks:
    return NOTHING


def _no_labels() -> Sequence[tuple[str, Sequence[float]]]:
    return ()


@dataclass
class ViewportStatus:
    """What a panel may say about the preview. error: the last draw's PRTError in words, or empty.

    colour_managed: False after a draw that had to fall back to the overlays' buffer, with `fallback` saying why.
    """

    enabled: bool = False
    objects: int = 0
    colour_managed: bool = True
    fallback: str = ""
    error: str = ""


@dataclass
class _Viewport:
    """Everything that lives between `enable` and `disable`."""

    get_draw_list: GetDrawList
    is_complete: IsComplete
    get_labels: GetLabels = _no_labels
    get_occluders: GetOccluders = _no_occluders
    get_marks: GetMarks = _no_marks
    occluders: OccluderCache = field(default_factory=OccluderCache)
    handlers: list[Any] = field(default_factory=list)
    cache: DrawingCache = field(default_factory=DrawingCache)
    overlays: OverlayCache = field(default_factory=OverlayCache)
    framebuffers: dict[int, gpu.types.GPUFrameBuffer] = field(default_factory=dict)  # by region, within one redraw
    drawn: dict[int, set[Hashable]] = field(default_factory=dict)  # keys of the last redraw by region
    status: ViewportStatus = field(default_factory=lambda: ViewportStatus(enabled=True))


_active: _Viewport | None = None


def enable(get_draw_list: GetDrawList, is_complete: IsComplete = _never_complete,
           get_labels: GetLabels = _no_labels, get_occluders: GetOccluders = _no_occluders,
           get_marks: GetMarks = _no_marks) -> None:
    """Draw what `get_draw_list()` returns in every 3D viewport from now on. Called again, only the callables change.

    get_draw_list runs on every redraw of every region, with bpy.context of that region: it must be cheap, and may
    raise PRTError, which `status()` then shows. is_complete runs after it and says whether the listed objects are the
    only visible surfaces of the region; then they hide each other by their own depth alone. get_labels runs on every
    redraw, too: short texts and the places in the world (3,) beside which they stand while overlays are shown; and so
    does get_marks: what is marked in the scene then, and the legend. get_occluders is asked where Blender leaves no
    depth: for what else is visible in the region and can be in front.
    """
    global _active
    if _active is not None:
        _active.get_draw_list, _active.is_complete = get_draw_list, is_complete
        _active.get_labels, _active.get_occluders = get_labels, get_occluders
        _active.get_marks = get_marks
    else:
        _active = _Viewport(get_draw_list, is_complete, get_labels, get_occluders, get_marks)
        for handler, phase in ((_remember_framebuffer, "PRE_VIEW"), (_draw_region, "POST_VIEW"),
                               (_draw_labels, "POST_PIXEL")):
            _active.handlers.append(SPACE.draw_handler_add(handler, (), "WINDOW", phase))
    redraw()


def disable() -> None:
    """Stop drawing and free every GPU object. Does nothing when not enabled."""
    global _active
    if _active is None:
        return
    for handle in _active.handlers:
        SPACE.draw_handler_remove(handle, "WINDOW")
    _active.cache.clear()
    _active.overlays.clear()
    _active.occluders.clear()
    _active = None
    programs.release()
    redraw()


def is_enabled() -> bool:
    """Whether the handlers are in place."""
    return _active is not None


def status() -> ViewportStatus:
    """The state of the preview after the last redraw."""
    return ViewportStatus() if _active is None else _active.status


def redraw() -> None:
    """Ask every 3D viewport to redraw; call it when the light or the draw list changed."""
    for window in bpy.context.window_manager.windows if bpy.context.window_manager else ():
        for area in window.screen.areas:
            if area.type == "VIEW_3D":
                area.tag_redraw()


def _remember_framebuffer() -> None:
    """PRE_VIEW: keep the framebuffer of the region's scene-linear picture until POST_VIEW of the same redraw."""
    region = bpy.context.region
    if _active is not None and region is not None:
        _active.framebuffers[region.as_pointer()] = gpu.state.active_framebuffer_get()


def _draw_region() -> None:
    """POST_VIEW: draw the list into the region."""
    viewport, region, space = _active, bpy.context.region, bpy.context.space_data
    if viewport is None or region is None:
        return
    framebuffer = viewport.framebuffers.pop(region.as_pointer(), None)
    if _sees_through(space.shading):
        _draw_marks(viewport, space)
        return
    try:
        items = viewport.get_draw_list()
        viewport.cache.keep_only(_keys_in_use(viewport, region, items))
        _draw_items(viewport, items, framebuffer)
        viewport.status.objects, viewport.status.error = len(items), ""
    except PRTError as error:  # nobody can catch it here; the panel shows it
        viewport.status.objects, viewport.status.error = 0, str(error)
    _draw_marks(viewport, space)


def _draw_marks(viewport: _Viewport, space: bpy.types.SpaceView3D) -> None:
    """Draw what is marked in the scene over the picture."""
    if space.overlay.show_overlays:
        viewport.overlays.draw(viewport.get_marks().overlays)


def _keys_in_use(viewport: _Viewport, region: bpy.types.Region, items: Sequence[DrawItem]) -> set[Hashable]:
    """What this and the other open regions draw: one in local view, or of another scene, must not cost them theirs."""
    windows = bpy.context.window_manager.windows if bpy.context.window_manager else ()
    there = {other.as_pointer() for window in windows for area in window.screen.areas if area.type == "VIEW_3D"
             for other in area.regions}
    viewport.drawn = {pointer: keys for pointer, keys in viewport.drawn.items() if pointer in there}
    viewport.drawn[region.as_pointer()] = {item.key for item in items}
    return set().union(*viewport.drawn.values())


def _draw_labels() -> None:
    """POST_PIXEL: write the labels beside their places, and the legend."""
    viewport, region, space = _active, bpy.context.region, bpy.context.space_data
    if viewport is None or region is None or not space.overlay.show_overlays:
        return
    scale, font = bpy.context.preferences.system.ui_scale, 0
    sidebars = [other.width for other in bpy.context.area.regions if other.type == "UI" and other.width > 1]
    legend = None if _sees_through(space.shading) else viewport.get_marks().legend
    if legend is not None:
        draw_legend(legend, region, sum(sidebars))
    blf.size(font, LABEL_SIZE * scale)
    blf.enable(font, blf.SHADOW)
    for text, place in viewport.get_labels():
        where = location_3d_to_region_2d(region, bpy.context.region_data, Vector(place))
        if where is None:  # behind the viewer
            continue
        aside, width = LABEL_OFFSET[0] * scale, blf.dimensions(font, text)[0]
        fits = where.x + aside + width < region.width - sum(sidebars)
        blf.color(font, 1.0, 0.75, 0.2, 1.0)
        blf.shadow(font, 3, 0.0, 0.0, 0.0, 0.9)
        blf.position(font, where.x + aside if fits else where.x - aside - width, where.y + LABEL_OFFSET[1] * scale, 0.0)
        blf.draw(font, text)
    blf.disable(font, blf.SHADOW)


def _draw_items(viewport: _Viewport, items: Sequence[DrawItem], framebuffer: gpu.types.GPUFrameBuffer | None) -> None:
    """Draw into the scene-linear picture, or over the overlays where that can't be had."""
    if not items:
        return
    view_projection = np.array(bpy.context.region_data.perspective_matrix, np.float64)
    if not all(item.is_lit for item in items):  # false colours: the overlays' buffer gets no view transform
        viewport.status.colour_managed, viewport.status.fallback = True, ""
        _prepare_depth(viewport, gpu.state.active_framebuffer_get(), view_projection)
        viewport.cache.draw(items, view_projection)
        return
    reason = _why_not_usable(framebuffer, bpy.context.region)
    viewport.status.colour_managed, viewport.status.fallback = not reason, reason
    if reason:
        viewport.cache.draw(items, view_projection)
        return
    with framebuffer.bind():
        _prepare_depth(viewport, framebuffer, view_projection)
        viewport.cache.draw(items, view_projection)


def _prepare_depth(viewport: _Viewport, framebuffer: gpu.types.GPUFrameBuffer,
                   view_projection: NDArray[np.float64]) -> None:
    """Clear the bound framebuffer's depth where it is not the scene's or not needed, and draw what it lacks."""
    complete = viewport.is_complete()
    if complete or _depth_is_missing(bpy.context.space_data, bpy.context.scene.render.engine):
        framebuffer.clear(depth=1.0)
        if not complete:
            viewport.occluders.draw(viewport.get_occluders(), view_projection)


def _why_not_usable(framebuffer: gpu.types.GPUFrameBuffer | None, region: bpy.types.Region) -> str:
    """Empty if the remembered framebuffer can be drawn to, else the reason."""
    if framebuffer is None:
        return "Blender announced no picture for this viewport"
    try:
        with framebuffer.bind():
            _, _, width, height = framebuffer.viewport_get()
    except (ReferenceError, RuntimeError, SystemError) as error:
        return f"the viewport's picture can't be bound ({error})"
    if (width, height) != (region.width, region.height):
        return f"the picture has {width}x{height} pixels, the viewport {region.width}x{region.height}"
    return ""


def _sees_through(shading: bpy.types.View3DShading) -> bool:
    """Whether the user asked to look through surfaces: a filled one would hide what is to be seen."""
    return shading.type == "WIREFRAME" or (shading.type == "SOLID" and shading.show_xray)


def _depth_is_missing(space: bpy.types.SpaceView3D, engine: str) -> bool:
    """Whether the picture's depth is not the scene's, so that others have to be drawn into it.

    Workbench always writes it, other engines only for the overlays: without them EEVEE leaves 0 everywhere, so that
    nothing would pass, and Cycles 1.
    """
    workbench = space.shading.type == "SOLID" or engine == "BLENDER_WORKBENCH"
    return not workbench and not space.overlay.show_overlays
