# SPDX-License-Identifier: GPL-3.0-or-later
"""Materials edited after a bake, in a Blender with its interface: the picture follows without a new bake, quickly. Run
by run.py; its pictures are to be looked at, its times are in editing_times.json."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable
from pathlib import Path

import bpy
import numpy as np

sys.path.insert(0, str(Path(__file__).parent))  # Blender runs this file by its path

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
    pixel,
    region,
    session,
    shoot,
    start,
    until,
    wait_for_bake,
)

ALL = {"Floor", "Ceiling", "Back", "Left", "Right", "Panel", "Box"}
PATIENCE = 60.0  # seconds, on a machine that does much else
DRAWS: list[tuple[int, float]] = []  # of this viewport: how many answers there were, and when
EDITS = 5
TIMES: dict[str, object] = {}


def settings() -> bpy.types.PropertyGroup:
    return bpy.context.scene.prt


def inputs(name: str) -> bpy.types.NodeInputs:
    return bpy.data.materials[name].node_tree.nodes["Principled BSDF"].inputs


def preview() -> object:
    return sys.modules[f"{MODULE}.operators.live_preview"]


def materials() -> object:
    """What follows the materials of the only scene."""
    return next(iter(preview()._lives.values())).materials


def note_draw() -> None:
    DRAWS.append((materials().answers, time.perf_counter()))


def followed(change: Callable[[], None]) -> Step:
    """Make a change of materials or light, and wait for the picture that shows its answer."""
    count = materials().answers
    change()
    yield from until(lambda: materials().answers > count, "no answer", PATIENCE)
    yield from until(lambda: preview().settled(), "not settled", PATIENCE)
    DRAWS.clear()
    area().tag_redraw()
    yield from until(lambda: DRAWS, "no picture follows", PATIENCE)
    yield 0.5


def base_colour(name: str, *colour: float) -> Callable[[], None]:
    def change() -> None:
        inputs(name)["Base Color"].default_value = (*colour, 1.0)
    return change


def glow(strength: float) -> Callable[[], None]:
    def change() -> None:
        inputs("Panel")["Emission Color"].default_value = (1.0, 0.75, 0.4, 1.0)
        inputs("Panel")["Emission Strength"].default_value = strength
    return change


def sky(strength: float) -> Callable[[], None]:
    def change() -> None:
        bpy.data.worlds["World"].node_tree.nodes["Background"].inputs["Strength"].default_value = strength
    return change


# Beside the left wall: on the back wall and on the floor; and on that wall itself.
BACK, FLOOR, LEFT, PANEL = (-0.85, 1.0, 0.6), (-0.85, 0.2, 0.0), (-1.0, 0.2, 1.0), (0.0, -0.1, 1.9)


def bake_with_live_editing() -> Step:
    """The switch is in the panel, and the bake stores what it needs."""
    with override():
        bpy.ops.wm.open_mainfile(filepath=str(SCENE), load_ui=False)
    yield 1.0
    space = area().spaces.active
    space.show_region_ui, space.shading.type = True, "SOLID"
    space.region_3d.view_perspective = "CAMERA"
    yield 1.5
    region("UI").active_panel_category = "PRT"
    settings().preset, settings().order, settings().live_editing = "draft", 3, True
    yield 0.5
    assert invoke_bake() == {"RUNNING_MODAL"}
    yield from wait_for_bake()
    assert not session().failed, session().message
    yield from until(lambda: baked_names() == ALL, f"the panel lists {baked_names()}")
    carriers = [mesh for mesh in bpy.data.meshes if "prt_live_counts" in mesh]
    assert len(carriers) == 1, carriers
    TIMES["receivers"] = len(np.asarray(carriers[0]["prt_live_counts"]))
    TIMES["entries"] = len(np.asarray(carriers[0]["prt_live_indices"]))
    with override():
        assert bpy.ops.prt.toggle_preview() == {"FINISHED"}
    yield from until(lambda: session().preview and preview().settled(), "not settled", PATIENCE)
    bpy.types.SpaceView3D.draw_handler_add(note_draw, (), "WINDOW", "POST_PIXEL")
    area().tag_redraw()
    yield from until(lambda: DRAWS, "nothing is drawn", PATIENCE)
    yield DRAWN
    shoot("01_baked")
    assert session().live_materials == "", session().live_materials


def follow_a_colour() -> Step:
    """The red wall turns green: the surfaces beside it follow, nothing is stale, and the panel says so."""
    before = shoot("02_red_wall")
    yield from followed(base_colour("Left", 0.05, 0.6, 0.05))
    after = shoot("03_green_wall")
    for place in (BACK, FLOOR):
        red, green = pixel(before, place), pixel(after, place)
        assert red[0] > red[1] and green[1] > green[0], (place, red, green)
    assert pixel(after, LEFT)[1] > 2.0 * pixel(after, LEFT)[0]
    assert "follows materials" in session().live_materials, session().live_materials
    assert not any(line.stale for line in session().objects), [line.stale for line in session().objects]


def in_time() -> Step:
    """A colour that is dragged: each edit is answered and shown; its times are printed, which no test may hold."""
    answers, pictures = [], []
    for step in range(EDITS):
        DRAWS.clear()
        count, edited = materials().answers, time.perf_counter()
        base_colour("Left", 0.1 + 0.08 * step, 0.55 - 0.06 * step, 0.05)()
        yield from until(lambda count=count: any(number > count for number, _ in DRAWS), "no picture follows", PATIENCE)
        answers.append(materials().seconds)
        pictures.append(next(moment for number, moment in DRAWS if number > count) - edited)
        yield from until(lambda: preview().settled(), "not settled", PATIENCE)
    DRAWS.clear()
    asked = time.perf_counter()
    area().tag_redraw()
    yield from until(lambda: DRAWS, "nothing is drawn", PATIENCE)
    TIMES["redraw_alone_ms"] = round(1e3 * (DRAWS[0][1] - asked), 1)
    TIMES["answer_ms"] = [round(1e3 * seconds, 1) for seconds in answers]
    TIMES["edit_to_picture_ms"] = [round(1e3 * seconds, 1) for seconds in pictures]
    TIMES["said"] = session().live_materials
    (OUTPUT / "editing_times.json").write_text(json.dumps(TIMES, indent=1), encoding="utf-8")
    print(json.dumps(TIMES), flush=True)
    shoot("04_dragged")


def follow_a_glow() -> Step:
    """The panel below the ceiling begins to shine: it is bright, and lights the room."""
    before = shoot("05_no_glow")
    yield from followed(glow(6.0))
    after = shoot("06_glow")
    assert pixel(after, PANEL).min() > 0.7 and pixel(after, PANEL).mean() > pixel(before, PANEL).mean()
    for place in (BACK, FLOOR, (0.5, 1.0, 1.5)):
        gained = pixel(after, place) - pixel(before, place)
        assert gained[0] > 0.03, (place, gained)
    yield from followed(glow(0.0))
    off = shoot("07_glow_off")
    assert np.abs(pixel(off, BACK) - pixel(before, BACK)).max() < 0.01


def undo_and_light() -> Step:
    """Edits survive a change of the light and an undo takes them back."""
    with override():
        bpy.ops.ed.undo_push(message="before")
    yield from followed(base_colour("Back", 0.1, 0.1, 0.8))
    with override():
        bpy.ops.ed.undo_push(message="blue")
    blue = shoot("08_blue_back")
    place = (0.2, 1.0, 1.5)
    assert pixel(blue, place)[2] > 1.5 * pixel(blue, place)[0]
    yield from followed(sky(2.0))
    bright = shoot("09_blue_in_more_light")
    assert pixel(bright, FLOOR).mean() > pixel(blue, FLOOR).mean() + 0.02
    yield from followed(sky(1.0))

    def undo() -> None:
        with override():
            bpy.ops.ed.undo()

    yield from followed(undo)
    undone = shoot("10_undone")
    assert pixel(undone, place)[2] < 1.2 * pixel(undone, place)[0], pixel(undone, place)


def what_is_not_followed() -> Step:
    """A metal's highlight would need a new bake: everything says that it is stale."""
    inputs("Box")["Metallic"].default_value = 1.0
    yield from until(lambda: all(line.stale for line in session().objects), "metal is not stale", PATIENCE)
    yield DRAWN
    shoot("11_metal_is_stale")
    inputs("Box")["Metallic"].default_value = 0.0
    yield from until(lambda: not any(line.stale for line in session().objects), "still stale", PATIENCE)
    with override():
        bpy.ops.prt.toggle_preview()
    yield DRAWN
    assert not session().preview and session().live_materials == ""


start((bake_with_live_editing, follow_a_colour, in_time, follow_a_glow, undo_and_light, what_is_not_followed),
      "editing")
