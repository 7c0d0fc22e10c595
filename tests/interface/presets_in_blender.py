# SPDX-License-Identifier: GPL-3.0-or-later
"""The steps of an artist who keeps several lights of one scene: run by run.py, one step per timer call (driving.py)."""

from __future__ import annotations

import sys
from importlib import import_module
from pathlib import Path

import bpy
import numpy as np

sys.path.insert(0, str(Path(__file__).parent))  # Blender runs this file by its path

import itertools

from driving import (
    DRAWN,
    MODULE,
    OUTPUT,
    SCENE,
    Step,
    area,
    baked_names,
    invoke_bake,
    override,
    region,
    select,
    session,
    shoot,
    start,
    until,
    view,
    wait_for_bake,
    window,
)

NAMES = ("Day", "Evening", "Lamp")
MEAN_LEVELS = 0.5  # of 255: the same light gives the same picture
pictures: dict[str, np.ndarray] = {}


def lighting() -> bpy.types.PropertyGroup:
    return bpy.context.scene.prt_light


def strength() -> bpy.types.NodeSocket:
    return bpy.context.scene.world.node_tree.nodes["Background"].inputs["Strength"]


def rotation() -> bpy.types.NodeSocket:
    return bpy.context.scene.world.node_tree.nodes["Mapping"].inputs["Rotation"]


def thumbnail(name: str) -> np.ndarray:
    """A preset's picture (height, width, 3) in 0..255."""
    text = lighting().presets[name].thumbnail
    assert text, f"{name} has no thumbnail"
    return import_module(f"{MODULE}.operators.light_icons").from_text(text)[..., :3].astype(np.float64)


def frame() -> tuple[int, int, int, int]:
    """Where in a screenshot the camera's frame lies: top, bottom, left, right."""
    from bpy_extras.view3d_utils import location_3d_to_region_2d

    scene, box = bpy.context.scene, region()
    corners = [scene.camera.matrix_world @ corner for corner in scene.camera.data.view_frame(scene=scene)]
    places = [location_3d_to_region_2d(box, area().spaces.active.region_3d, corner) for corner in corners]
    columns, rows = [box.x + p.x for p in places], [1000 - (box.y + p.y) for p in places]
    return round(min(rows)), round(max(rows)), round(min(columns)), round(max(columns))


def shrunk(picture: np.ndarray, height: int, width: int) -> np.ndarray:
    """A picture averaged to fewer pixels."""
    rows = np.arange(height + 1) * picture.shape[0] // height
    columns = np.arange(width + 1) * picture.shape[1] // width
    return np.array([[picture[a:b, c:d].mean(axis=(0, 1)) for c, d in itertools.pairwise(columns)]
                     for a, b in itertools.pairwise(rows)])


def open_and_bake() -> Step:
    """A baked scene, seen through its camera, with the preview on."""
    with override():
        bpy.ops.wm.open_mainfile(filepath=str(SCENE), load_ui=False)
    yield 1.0
    space, scene = area().spaces.active, bpy.context.scene
    space.show_region_ui, space.shading.type, space.overlay.show_overlays = True, "SOLID", False
    space.region_3d.view_perspective = "CAMERA"
    scene.render.resolution_x, scene.render.resolution_y = 400, 300
    scene.view_settings.view_transform = "Standard"  # as Solid shading has it
    scene.camera.data.show_passepartout = False
    yield 1.5
    region("UI").active_panel_category = "PRT"
    scene.prt.preset = "draft"
    select()
    invoke_bake()
    yield from wait_for_bake()
    assert not session().failed, session().message
    yield from until(lambda: len(baked_names()) == 3, "the panel does not list what was baked")
    with override():
        bpy.ops.prt.toggle_preview()
    yield DRAWN


def scroll(panels: int = 4) -> None:
    """Move the sidebar up, so that what stands below is in the picture."""
    with bpy.context.temp_override(window=window(), area=area(), region=region("UI")):
        for _ in range(panels):
            if bpy.ops.view2d.scroll_down.poll():
                bpy.ops.view2d.scroll_down(deltay=150)


def light(name: str) -> None:
    """Three lights that have little in common."""
    sun, data = bpy.data.objects["Sun"], bpy.data.lights["Sun"]
    if name == "Day":
        strength().default_value, rotation().default_value[2] = 0.4, 0.0
        data.energy, data.color, sun.rotation_euler = 1.0, (1.0, 1.0, 1.0), (0.7, 0.0, 0.5)
    elif name == "Evening":
        strength().default_value, rotation().default_value[2] = 0.3, 2.5
        data.energy, data.color, sun.rotation_euler = 1.5, (1.0, 0.4, 0.1), (1.3, 0.0, -2.0)
    else:
        strength().default_value = 0.03
        data.energy, data.color, sun.rotation_euler = 2.0, (0.2, 0.4, 1.0), (0.2, 0.0, 2.0)


def add_presets() -> Step:
    """Each preset's thumbnail looks like the viewport, and no two are alike."""
    for name in NAMES:
        light(name)
        yield DRAWN
        pictures[name] = shoot(f"p01_{name}")
        with override():
            assert bpy.ops.prt.light_preset_add("INVOKE_DEFAULT", True, name=name) == {"FINISHED"}
        top, bottom, left, right = frame()
        drawn = thumbnail(name)
        assert drawn.shape == (144, 192, 3), drawn.shape
        seen = shrunk(pictures[name][top:bottom, left:right].astype(np.float64), 36, 48)
        # Objects alone: what the viewport shows behind them is not the World. The floor fills the middle.
        middle = slice(15, 30), slice(14, 34)
        difference = np.abs(seen - shrunk(drawn, 36, 48))[middle].mean()
        print(f"{name}: thumbnail and viewport differ by {difference:.2f} levels", flush=True)
        assert difference < 6.0, f"{name}: thumbnail and viewport differ by {difference:.2f} levels"
    scroll()
    yield DRAWN
    shoot("p02_panel")
    for first, second in (("Day", "Evening"), ("Day", "Lamp"), ("Evening", "Lamp")):
        assert np.abs(thumbnail(first) - thumbnail(second)).mean() > 5.0, f"{first} and {second} look alike"
    assert len({preset.icon for preset in lighting().presets}) == 3 and all(p.icon for p in lighting().presets)


def switch() -> Step:
    """One click, and the viewport's pixels are those of the moment when the preset was stored."""
    for name in ("Day", "Lamp", "Evening"):
        with override():
            assert bpy.ops.prt.light_preset_apply("INVOKE_DEFAULT", True, name=name) == {"FINISHED"}
        yield DRAWN
        difference = np.abs(view(shoot(f"p03_{name}")) - view(pictures[name])).mean()
        print(f"{name}: applied, the viewport differs by {difference:.3f} levels", flush=True)
        assert difference < MEAN_LEVELS, f"{name}: the viewport differs by {difference:.2f} levels"
        assert lighting().chosen().name == name and not lighting().modified
    with override():
        bpy.ops.ed.undo()
    yield DRAWN
    assert lighting().chosen().name == "Lamp"
    assert np.abs(view(shoot("p04_undone")) - view(pictures["Lamp"])).mean() < MEAN_LEVELS, "undo leaves the light"


def solo() -> Step:
    """A light alone, and all as before."""
    with override():
        bpy.ops.prt.light_preset_apply("INVOKE_DEFAULT", True, name="Evening")
        bpy.ops.prt.light_solo("INVOKE_DEFAULT", True, name="Sun")
    yield DRAWN
    alone = view(shoot("p05_solo"))
    assert strength().default_value == 0.0 and alone.mean() < view(pictures["Evening"]).mean()
    with override():
        bpy.ops.prt.light_solo("INVOKE_DEFAULT", True, name="Sun")
    yield DRAWN
    assert np.abs(view(shoot("p06_all")) - view(pictures["Evening"])).mean() < MEAN_LEVELS


def animate() -> Step:
    """Keyframes from presets; the attribute follows the frames, and a modified light is marked."""
    scene = bpy.context.scene
    for number, name in ((1, "Day"), (20, "Evening")):
        scene.frame_set(number)
        with override():
            bpy.ops.prt.light_preset_apply("INVOKE_DEFAULT", True, name=name)
            assert bpy.ops.prt.keyframe_light("INVOKE_DEFAULT") == {"FINISHED"}
    lighting().follow_frames = True
    found = []
    for number in (1, 20):
        scene.frame_set(number)
        yield DRAWN
        mesh = bpy.data.objects["Statue"].get("prt_receiver") or bpy.data.objects["Statue"].data
        values = np.empty(4 * len(mesh.vertices), np.float32)
        mesh.color_attributes["PRT Light"].data.foreach_get("color", values)
        found.append(values)
        name = NAMES[0] if number == 1 else NAMES[1]
        assert np.abs(view(shoot(f"p07_frame_{number}")) - view(pictures[name])).mean() < MEAN_LEVELS, name
    assert np.abs(found[0] - found[1]).mean() > 0.02, "the attribute does not follow"
    assert not lighting().follow_message, lighting().follow_message
    scene.frame_set(10)
    yield DRAWN
    assert lighting().modified
    scroll(24)
    yield DRAWN
    shoot("p08_between")


def render_in_window() -> Step:
    """F12 out of the window: without a lock the colours stay and the panel says why; with it they follow."""
    scene, mesh = bpy.context.scene, bpy.data.objects["Statue"].get("prt_receiver") or bpy.data.objects["Statue"].data
    scene.render.engine, scene.cycles.samples, scene.cycles.use_denoising = "CYCLES", 1, False
    scene.render.resolution_x, scene.render.resolution_y = 32, 24
    scene.frame_start, scene.frame_end, scene.render.filepath = 19, 20, str(OUTPUT / "render_")
    bpy.context.preferences.view.render_display_type = "NONE"

    def written() -> np.ndarray:
        values = np.empty(4 * len(mesh.vertices), np.float32)
        mesh.color_attributes["PRT Light"].data.foreach_get("color", values)
        return values

    kept: list[np.ndarray] = []
    told: list[str] = []  # during renders: the frame change after them follows again

    def keep(*_arguments: object) -> None:
        told.append(lighting().follow_message)
        kept.append(written())

    bpy.app.handlers.render_post.append(keep)
    scene.frame_set(20)
    last = written()
    scene.frame_set(1)
    first = written()
    for locked in (False, True):
        scene.render.use_lock_interface = locked
        kept.clear()
        told.clear()
        with override():
            bpy.ops.render.render("INVOKE_DEFAULT", animation=True)
        yield from until(lambda: len(kept) == 2 and not bpy.app.is_job_running("RENDER"), "the render hangs", 60.0)
        if not locked:
            assert all("Lock Interface" in text for text in told), told
            assert np.array_equal(kept[1], first), "a render that does not lock the window changes colours"
            yield DRAWN
            shoot("p09_unlocked")
    bpy.app.handlers.render_post.remove(keep)
    assert told == ["", ""], told
    np.testing.assert_allclose(kept[1], last, rtol=1e-4, atol=1e-5)
    assert np.abs(kept[1] - kept[0]).max() > 1e-3, "both frames were rendered with one light"
    yield 1.0
    assert not lighting().follow_message, lighting().follow_message
    shoot("p10_rendered")


STEPS = (open_and_bake, add_presets, switch, solo, animate, render_in_window)

start(STEPS, "presets")
