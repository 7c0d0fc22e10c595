# SPDX-License-Identifier: GPL-3.0-or-later
"""The draw handlers without a window: what can be held here is that they come, do not pile up, and go.

The pictures are looked at in a real Blender (tests/interface).
"""

from __future__ import annotations

import types
from collections.abc import Iterator
from typing import Any

import bpy
import numpy as np
import pytest

from tests.blender import gpu_support  # makes the checkout the package `prt`

# isort: split
import gpu
from prt.gpu_shaders import draw, occluders, offscreen, programs, render_data, viewport
from prt.prt_addon.errors import BadScene


@pytest.fixture(autouse=True)
def handlers(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[tuple[Any, str]]]:
    """The handlers in place now, as (function, phase), recorded where Blender would keep them."""
    places: list[tuple[Any, str]] = []

    def add(function: Any, _arguments: tuple, region: str, phase: str) -> tuple[Any, str]:
        assert region == "WINDOW"
        places.append((function, phase))
        return places[-1]

    space = types.SimpleNamespace(draw_handler_add=add, draw_handler_remove=lambda handle, _: places.remove(handle))
    monkeypatch.setattr(viewport, "SPACE", space)
    yield places
    viewport.disable()
    assert not places


def test_enable_twice_replaces_the_list_and_disable_leaves_nothing(handlers: list) -> None:
    viewport.enable(list)
    viewport.enable(list)
    assert [phase for _, phase in handlers] == ["PRE_VIEW", "POST_VIEW", "POST_PIXEL"]
    assert viewport.is_enabled() and viewport.status().enabled
    viewport.disable()
    viewport.disable()
    assert not handlers and not viewport.is_enabled() and not viewport.status().enabled


class Region:
    """A stand-in for a region of the interface, drawn into an offscreen buffer."""

    def __init__(self, number: int, size: int) -> None:
        self.number, self.width, self.height = number, size, size

    def as_pointer(self) -> int:
        return self.number


def space_data(shading: str = "SOLID", overlays: bool = True, xray: bool = False) -> Any:
    return types.SimpleNamespace(
        shading=types.SimpleNamespace(type=shading, show_xray=xray),
        overlay=types.SimpleNamespace(show_overlays=overlays),
    )


def draw_redraw(handlers: list, monkeypatch: pytest.MonkeyPatch, **options: Any) -> np.ndarray:
    """One redraw as Blender does it, of a region of 32 x 32: the scene's picture after it, (32, 32, 4).

    depth: of the scene before POST_VIEW; region_size: what the region claims; engine, space: of the context.
    """
    region = Region(options.get("number", 1), options.get("region_size", 32))
    context = types.SimpleNamespace(
        region=region,
        space_data=options.get("space", space_data()),
        scene=types.SimpleNamespace(render=types.SimpleNamespace(engine=options.get("engine", "BLENDER_EEVEE"))),
        region_data=types.SimpleNamespace(perspective_matrix=np.eye(4)),
        window_manager=None,
    )
    monkeypatch.setattr(viewport, "bpy", types.SimpleNamespace(context=context))
    with offscreen._offscreen(32, 32) as picture:
        if options.get("pre_view", True):
            handlers[0][0]()
        gpu.state.active_framebuffer_get().clear(depth=options.get("depth", 1.0))
        with offscreen._offscreen(32, 32):  # the overlays' buffer is active at POST_VIEW
            handlers[1][0]()
        assert gpu.state.depth_test_get() == "NONE"
        pixels = draw.read_texture(picture.texture_color)
    return pixels


@pytest.fixture
def item() -> render_data.DrawItem:
    gpu_support.require_gpu()
    generator = np.random.default_rng(3)
    baked = gpu_support.made_up_bake(*gpu_support.grid_mesh(5, generator), generator)
    return render_data.DrawItem("key", baked, np.eye(4), gpu_support.bright_light(25, generator))


def covered(pixels: np.ndarray) -> bool:
    return bool(pixels[8:24, 8:24, 3].all() and pixels[8:24, 8:24, :3].min() > 0)


def test_draws_into_the_remembered_picture_not_into_the_overlays(
    handlers: list, monkeypatch: pytest.MonkeyPatch, item: render_data.DrawItem
) -> None:
    viewport.enable(lambda: [item])
    assert covered(draw_redraw(handlers, monkeypatch))
    assert viewport.status() == viewport.ViewportStatus(enabled=True, objects=1)


@pytest.mark.parametrize("options", [{"pre_view": False}, {"region_size": 31}])
def test_falls_back_to_the_overlays_and_says_so(
    handlers: list, monkeypatch: pytest.MonkeyPatch, item: render_data.DrawItem, options: dict
) -> None:
    viewport.enable(lambda: [item])
    assert not draw_redraw(handlers, monkeypatch, **options).any()
    assert not viewport.status().colour_managed and viewport.status().fallback
    assert covered(draw_redraw(handlers, monkeypatch))
    assert viewport.status().colour_managed and not viewport.status().fallback


def test_a_freed_picture_is_not_drawn_to(
    handlers: list, monkeypatch: pytest.MonkeyPatch, item: render_data.DrawItem
) -> None:
    with offscreen._offscreen(32, 32):
        freed = gpu.state.active_framebuffer_get()
    viewport.enable(lambda: [item])
    assert viewport._why_not_usable(freed, Region(1, 32))


@pytest.mark.parametrize(
    ("engine", "shading", "overlays", "drawn"),
    [
        ("BLENDER_EEVEE", "RENDERED", False, True),
        ("BLENDER_EEVEE", "MATERIAL", False, True),
        ("CYCLES", "RENDERED", False, True),
        ("BLENDER_EEVEE", "RENDERED", True, False),
        ("BLENDER_EEVEE", "SOLID", False, False),
        ("BLENDER_WORKBENCH", "RENDERED", False, False),
    ],
)
def test_depth_is_replaced_only_where_the_engine_leaves_none(
    handlers: list,
    monkeypatch: pytest.MonkeyPatch,
    item: render_data.DrawItem,
    engine: str,
    shading: str,
    overlays: bool,
    drawn: bool,
) -> None:
    viewport.enable(lambda: [item])
    space = space_data(shading, overlays)
    pixels = draw_redraw(handlers, monkeypatch, depth=0.0, engine=engine, space=space)
    assert covered(pixels) == drawn and pixels.any() == drawn


def test_a_complete_list_hides_by_its_own_depth(
    handlers: list, monkeypatch: pytest.MonkeyPatch, item: render_data.DrawItem
) -> None:
    complete = [True]
    viewport.enable(lambda: [item], lambda: complete[0])
    assert covered(draw_redraw(handlers, monkeypatch, depth=0.0))
    complete[0] = False
    assert not draw_redraw(handlers, monkeypatch, depth=0.0).any()


@pytest.mark.parametrize(("height", "hidden"), [(-0.5, True), (0.5, False)])
def test_others_hide_where_the_engine_leaves_no_depth(
    handlers: list, monkeypatch: pytest.MonkeyPatch, item: render_data.DrawItem, height: float, hidden: bool
) -> None:
    """A square over the left half, in front (towards -1 in clip space) or behind; it is read once."""
    corners = np.array([[-1, -1, height], [0, -1, height], [0, 1, height], [-1, 1, height]], np.float32)
    reads = []

    def read() -> tuple[np.ndarray, np.ndarray]:
        reads.append(1)
        return corners, np.array([[0, 1, 2], [0, 2, 3]], np.int32)

    viewport.enable(lambda: [item], get_occluders=lambda: [occluders.Occluder("square", np.eye(4), read)])
    for _ in range(2):
        pixels = draw_redraw(handlers, monkeypatch, depth=0.0, space=space_data("RENDERED", overlays=False))
        assert pixels[8:24, 20:24].all() and pixels[8:24, 8:12].any() != hidden
    assert len(reads) == 1 and len(viewport._active.occluders) == 1
    pixels = draw_redraw(handlers, monkeypatch, depth=1.0, space=space_data("RENDERED"))
    assert covered(pixels), "where Blender's own depth is there, nobody else is asked"


@pytest.mark.parametrize("space", [space_data("WIREFRAME"), space_data("SOLID", xray=True)])
def test_see_through_shading_is_left_alone(
    handlers: list, monkeypatch: pytest.MonkeyPatch, item: render_data.DrawItem, space: Any
) -> None:
    viewport.enable(lambda: [item])
    assert not draw_redraw(handlers, monkeypatch, space=space).any()


def test_regions_keep_their_pictures_apart_and_hidden_objects_are_dropped(
    handlers: list, monkeypatch: pytest.MonkeyPatch, item: render_data.DrawItem
) -> None:
    shown = [item]
    viewport.enable(lambda: shown)
    for number in (1, 2, 1):
        assert covered(draw_redraw(handlers, monkeypatch, number=number))
    assert not viewport._active.framebuffers and len(viewport._active.cache) == 1
    shown.clear()
    assert not draw_redraw(handlers, monkeypatch).any()
    assert len(viewport._active.cache) == 0


def test_errors_of_the_list_are_told_and_end(
    handlers: list, monkeypatch: pytest.MonkeyPatch, item: render_data.DrawItem
) -> None:
    broken = render_data.DrawItem("broken", item.baked, np.eye(4), np.zeros((4, 3)))
    viewport.enable(lambda: [broken])
    draw_redraw(handlers, monkeypatch)
    assert "the light" in viewport.status().error and viewport.status().objects == 0

    def refuse() -> list:
        raise BadScene("Suzanne", "its bake is broken", "Bake it again")

    viewport.enable(refuse)
    draw_redraw(handlers, monkeypatch)
    assert viewport.status().error == "Suzanne: its bake is broken. Bake it again"
    viewport.enable(lambda: [item])
    assert covered(draw_redraw(handlers, monkeypatch))
    assert not viewport.status().error


def test_real_handlers_can_be_added_and_removed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(viewport, "SPACE", bpy.types.SpaceView3D)
    viewport.enable(list)
    viewport.disable()


@pytest.fixture(autouse=True, scope="module")
def free_programs() -> Iterator[None]:
    yield
    programs.release()
