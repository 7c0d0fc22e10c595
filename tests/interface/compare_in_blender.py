# SPDX-License-Identifier: GPL-3.0-or-later
"""Comparing with Cycles, reading the report and exporting, as an artist does them: run by run.py (driving.py)."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from pathlib import Path

import bpy

sys.path.insert(0, str(Path(__file__).parent))  # Blender runs this file by its path

from driving import (
    DRAWN,
    OUTPUT,
    SCENE,
    Step,
    area,
    children,
    invoke_bake,
    override,
    region,
    session,
    shoot,
    start,
    until,
    wait_for_bake,
)

IMAGE = "PRT Comparison"
CANCEL_SECONDS = 1.0
EXTRA = 0.5  # to see it: the picture that is drawn at the moment is finished first, which takes software that long


def open_scene() -> Step:
    """A baked scene, with the panel open and folded down to what this is about."""
    with override():
        bpy.ops.wm.open_mainfile(filepath=str(SCENE), load_ui=False)
    yield 1.0
    bpy.context.scene.render.resolution_x, bpy.context.scene.render.resolution_y = 640, 400
    space = area().spaces.active
    space.show_region_ui, space.shading.type = True, "SOLID"
    space.region_3d.view_rotation = (0.78, 0.42, 0.21, 0.41)
    space.region_3d.view_distance, space.region_3d.view_location = 8.0, (0.0, 0.0, 0.8)
    yield 1.0
    region("UI").active_panel_category = "PRT"
    with override():
        for name in ("compare", "export", "show_report", "write_report", "draw_camera"):
            assert not getattr(bpy.ops.prt, name).poll(), f"nothing is baked, yet prt.{name} can be invoked"
    bpy.context.scene.prt.preset = "standard"
    assert invoke_bake() == {"RUNNING_MODAL"}
    yield from wait_for_bake()
    assert not session().failed, session().message
    yield DRAWN


def invoke_compare() -> set[str]:
    with override():
        return bpy.ops.prt.compare("INVOKE_DEFAULT")


def settings_of(scene: bpy.types.Scene) -> list[str]:
    """Everything of the render's settings that a render could change, as text."""
    owners = (scene, scene.render, scene.cycles, scene.render.image_settings, scene.view_settings)
    return [f"{owner} {p.identifier} {getattr(owner, p.identifier)}" for owner in owners
            for p in owner.bl_rna.properties if p.type in ("BOOLEAN", "INT", "FLOAT", "ENUM", "STRING")
            and not getattr(p, "is_array", False)]


def compare_without_an_editor() -> Step:
    """It runs beside Blender, says what came out and where the picture is, and changes nothing else."""
    scene = bpy.context.scene
    scene.prt.compare_samples, scene.prt.compare_percentage = 16, 50.0
    before, render_results = settings_of(scene), [i.name for i in bpy.data.images if i.type == "RENDER_RESULT"]
    assert invoke_compare() == {"RUNNING_MODAL"}
    assert session().running and len(children()) == 1
    yield from wait_for_bake("c01_comparing")
    assert not session().failed, session().message
    assert session().message.startswith("Compared with Cycles: difference "), session().message
    assert "open an Image Editor" in session().comparison, session().comparison
    assert bpy.data.images[IMAGE].size[0] > 3 * 320 and not bpy.data.images[IMAGE].is_dirty
    assert settings_of(scene) == before
    assert [i.name for i in bpy.data.images if i.type == "RENDER_RESULT"] == render_results
    assert not children()
    box = region("UI")  # the panel is at the end of the sidebar
    subprocess.run(["xdotool", "mousemove", str(box.x + 60), "500", *["click", "5"] * 40], check=True)
    yield DRAWN
    shoot("c02_compared")


def compare_in_an_editor() -> Step:
    """With an Image Editor in the window the picture is opened there."""
    with override():
        bpy.ops.screen.area_split(direction="HORIZONTAL", factor=0.45)
    yield 1.0
    lowest = min((a for a in bpy.context.window_manager.windows[0].screen.areas if a.type == "VIEW_3D"),
                 key=lambda a: a.y)
    lowest.ui_type = "IMAGE_EDITOR"
    yield 1.0
    region("UI").active_panel_category = "PRT"
    assert invoke_compare() == {"RUNNING_MODAL"}
    yield from wait_for_bake()
    assert not session().failed, session().message
    assert lowest.spaces.active.image == bpy.data.images[IMAGE]
    assert "Image Editor" not in session().comparison and "within 5 %" in session().comparison
    assert [i.name for i in bpy.data.images if i.name.startswith(IMAGE)] == [IMAGE], "a second image was made"
    yield DRAWN
    shoot("c03_in_an_image_editor")


def queue() -> Step:
    """Asked for while a bake runs, it waits, and compares what that bake stored."""
    scene = bpy.context.scene
    scene.prt.preset, scene.prt.compare_percentage = "draft", 25.0
    assert invoke_bake() == {"RUNNING_MODAL"}
    invoke_compare()
    assert session().waiting == "Comparison with Cycles", session().waiting
    yield from wait_for_bake()
    assert session().message.startswith("Compared with Cycles: difference "), session().message
    assert "Baked " in session().ended, session().ended
    assert f"of {160 * 100:,} pixels".replace(",", "\u202f") in session().comparison, session().comparison


def cancel() -> Step:
    """Esc and the panel's button end it within a second, with the last result still there."""
    before = session().comparison
    bpy.context.scene.prt.compare_samples, bpy.context.scene.prt.compare_percentage = 4096, 100.0
    for way in ("operator", "escape"):
        assert invoke_compare() == {"RUNNING_MODAL"}
        yield from until(lambda: session().fraction > 0.0 or not session().running, "the render does not begin", 40.0)
        assert session().running, session().message
        yield 1.0
        started = time.monotonic()
        if way == "operator":
            assert bpy.ops.prt.cancel() == {"FINISHED"}
        else:
            box = region()
            subprocess.run(["xdotool", "mousemove", str(box.x + box.width // 3), "300", "key", "Escape"], check=True)
        while session().running:
            assert time.monotonic() - started < CANCEL_SECONDS + EXTRA, f"{way} does not cancel"
            yield 0.05
        print(f"{way} cancelled after {time.monotonic() - started:.2f} s", flush=True)
        assert not children(), "the child outlived its cancel"
        assert "cancel" in session().message.lower() and not session().failed
        assert session().comparison == before
    assert not list(Path(bpy.app.tempdir).glob("prt-compare-*")), "a copy of the file is left"
    yield DRAWN
    shoot("c04_cancelled")


def report_and_export() -> Step:
    """Both ask where to by Blender's file browser, and write what the commands write."""
    with override():
        assert bpy.ops.prt.export("INVOKE_DEFAULT") == {"RUNNING_MODAL"}
    yield DRAWN
    shoot("c05_export_asks_where")
    browsers = [(w, a) for w in bpy.context.window_manager.windows for a in w.screen.areas if a.type == "FILE_BROWSER"]
    assert browsers, "no file browser is open"
    with bpy.context.temp_override(window=browsers[0][0], area=browsers[0][1]):
        bpy.ops.file.cancel()
    yield 1.0
    with override():
        assert bpy.ops.prt.export(directory=str(OUTPUT / "export")) == {"FINISHED"}
        assert bpy.ops.prt.write_report(filepath=str(OUTPUT / "report_ui.html")) == {"FINISHED"}
        assert bpy.ops.prt.write_report(filepath=str(OUTPUT / "report_ui.json")) == {"FINISHED"}
        assert bpy.ops.prt.show_report() == {"FINISHED"}
    index = json.loads((OUTPUT / "export" / "baked.json").read_text())
    assert {entry["name"] for entry in index["objects"]} == {"Statue", "Floor", "Wall"}
    assert "<html" in (OUTPUT / "report_ui.html").read_text()[:400].lower()
    with override():
        bpy.ops.wm.save_as_mainfile(filepath=str(OUTPUT / "compared.blend"))
        bpy.ops.wm.open_mainfile(filepath=str(OUTPUT / "compared.blend"), load_ui=False)
    yield DRAWN
    with override():
        assert bpy.ops.prt.write_report.poll(), "the report did not survive loading"
        assert bpy.ops.prt.write_report(filepath=str(OUTPUT / "again.json")) == {"FINISHED"}
    assert (OUTPUT / "again.json").read_bytes() == (OUTPUT / "report_ui.json").read_bytes()


STEPS = (open_scene, compare_without_an_editor, compare_in_an_editor, queue, cancel, report_and_export)

start(STEPS, "compare")
