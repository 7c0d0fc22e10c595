# SPDX-License-Identifier: GPL-3.0-or-later
"""The steps an artist takes, in a Blender with its interface: run by run.py, one step per timer call (driving.py)."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
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
    carrier,
    children,
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
)

ALL = {"Statue", "Floor", "Wall"}


def open_scene() -> Step:
    """The panel is there, and says what can't be done yet."""
    with override():
        bpy.ops.wm.open_mainfile(filepath=str(SCENE), load_ui=False)
    yield 1.0
    space = area().spaces.active
    space.show_region_ui, space.shading.type = True, "SOLID"
    space.region_3d.view_rotation = (0.78, 0.42, 0.21, 0.41)
    space.region_3d.view_distance, space.region_3d.view_location = 8.0, (0.0, 0.0, 0.8)
    yield 1.5
    region("UI").active_panel_category = "PRT"
    yield 1.5
    shoot("01_panel")
    with override():
        assert bpy.ops.prt.bake.poll()
        assert not bpy.ops.prt.toggle_preview.poll(), "nothing is baked, yet the preview can be switched on"
        assert not bpy.ops.prt.clear.poll() and not bpy.ops.prt.cancel.poll()


def analyze() -> Step:
    """Analyze fills the panel and changes nothing."""
    with override():
        assert bpy.ops.prt.analyze() == {"FINISHED"}
    assert session().analysis
    yield DRAWN
    shoot("02_analysis")
    assert carrier("Statue") is None


def bake() -> Step:
    """A bake runs beside Blender, shows its progress, and stores its result in the selected object alone."""
    bpy.context.scene.prt.preset = "standard"
    select("Statue", "Floor")
    assert invoke_bake() == {"RUNNING_MODAL"}
    assert session().running and len(children()) == 1
    yield from wait_for_bake("03_baking")
    assert not session().failed, session().message
    assert carrier("Statue") and carrier("Floor") and carrier("Wall") is None
    yield from until(lambda: baked_names() == {"Statue", "Floor"}, "the panel does not list what was baked")
    yield 1.0
    shoot("04_baked")
    assert not any(line.stale for line in session().objects), [line.stale for line in session().objects]
    assert not children()


def undo_and_redo() -> Step:
    """One undo takes the bake away, redo brings it back, and the panel follows."""
    with override():
        bpy.ops.ed.undo()
    yield from until(lambda: carrier("Statue") is None and not baked_names(), "undo leaves the bake")
    with override():
        bpy.ops.ed.redo()
    yield from until(lambda: carrier("Statue") and len(baked_names()) == 2, "redo does not bring the bake back")


def bake_all() -> Step:
    """With nothing selected, all visible meshes are baked."""
    bpy.context.scene.prt.preset = "draft"
    select()
    assert invoke_bake() == {"RUNNING_MODAL"}
    yield from wait_for_bake()
    assert not session().failed, session().message
    yield from until(lambda: baked_names() == ALL, f"the panel lists {baked_names()}")


def cancel() -> Step:
    """Cancel ends the child soon and keeps the previous bake; so does Esc."""
    before = carrier("Statue")["prt_header"]
    for way in ("operator", "escape"):
        bpy.context.scene.prt.preset = "high"
        assert invoke_bake() == {"RUNNING_MODAL"}
        while session().fraction <= 0.02 and session().running:
            yield 0.05
        assert session().running, session().message
        started = time.monotonic()
        if way == "operator":
            assert bpy.ops.prt.cancel() == {"FINISHED"}
        else:
            box = region()
            subprocess.run(["xdotool", "mousemove", str(box.x + box.width // 3), str(500), "key", "Escape"], check=True)
        while session().running:
            assert time.monotonic() - started < 3.0, f"{way} does not cancel"
            yield 0.05
        assert not children(), "the child outlived its cancel"
        assert "cancel" in session().message.lower() and not session().failed
        assert carrier("Statue")["prt_header"] == before
    yield 0.5
    shoot("05_cancelled")
    bpy.context.scene.prt.preset = "draft"


def survive_crash() -> Step:
    """The bake process dies: Blender lives, one message says what happened, and the previous bake stays."""
    before = carrier("Statue")["prt_header"]
    bpy.context.scene.prt.preset = "high"
    assert invoke_bake() == {"RUNNING_MODAL"}
    yield 1.0
    os.kill(children()[0], signal.SIGKILL)
    yield from until(lambda: not session().running, "the bake still runs without its process")
    assert session().failed and "ended by signal SIGKILL" in session().message, session().message
    assert carrier("Statue")["prt_header"] == before
    yield DRAWN
    shoot("16_crashed")  # Blender's error bubble stays over it until a file is loaded
    bpy.context.scene.prt.preset = "draft"


def preview() -> Step:
    """The preview changes the picture, and Blender's own returns with it off."""
    yield 1.0
    off = view(shoot("06_preview_off"))
    with override():
        assert bpy.ops.prt.toggle_preview() == {"FINISHED"}
    yield 1.5
    on = view(shoot("07_preview_on"))
    assert session().preview and not session().preview_message, session().preview_message
    assert np.abs(on - off).mean() > 2.0, "switching the preview on changes nothing"
    area().spaces.active.shading.type = "MATERIAL"
    yield 2.0 * DRAWN
    shoot("07_preview_on_material")
    area().spaces.active.shading.type = "SOLID"
    with override():
        bpy.ops.prt.toggle_preview()
    yield DRAWN
    again = view(shoot("08_preview_off_again"))
    assert np.abs(again - off).mean() < 0.5, "the preview leaves traces"
    with override():
        bpy.ops.prt.toggle_preview()
    yield 1.0


def follow_light() -> Step:
    """Sun, HDRI, strength, exposure: the picture follows without a click."""
    before = view(shoot("09_light_before"))
    bpy.data.objects["Sun"].rotation_euler = (1.2, 0.0, -2.0)
    yield DRAWN
    sun = view(shoot("10_sun_moved"))
    assert np.abs(sun - before).mean() > 1.0, "moving the Sun changes nothing"
    mapping = next(n for n in bpy.context.scene.world.node_tree.nodes if n.type == "MAPPING")
    mapping.inputs["Rotation"].default_value[2] = 2.5
    yield DRAWN
    turned = view(shoot("11_hdri_turned"))
    assert np.abs(turned - sun).mean() > 1.0, "turning the HDRI changes nothing"
    bpy.context.scene.world.node_tree.nodes["Background"].inputs["Strength"].default_value = 0.2
    yield DRAWN
    darker = view(shoot("12_strength"))
    assert darker.mean() < turned.mean(), "a weaker World is not darker"
    bpy.context.scene.prt.exposure = 2.0
    yield DRAWN
    brighter = view(shoot("13_exposure"))
    assert brighter.mean() > darker.mean(), "exposure does not brighten"
    bpy.context.scene.prt.exposure = 0.0
    bpy.context.scene.world.node_tree.nodes["Background"].inputs["Strength"].default_value = 1.0
    bpy.data.lights["Sun"].energy = 0.0
    yield DRAWN
    no_sun = view(shoot("14_no_sun"))
    assert np.abs(no_sun - turned).mean() > 0.5, "the Sun's strength does nothing"
    lamp = bpy.data.lights["Sun"]
    lamp.keyframe_insert("energy", frame=1)
    lamp.energy = 4.0
    lamp.keyframe_insert("energy", frame=20)
    bpy.context.scene.frame_set(20)
    yield DRAWN
    assert np.abs(view(shoot("14_frame_20")) - no_sun).mean() > 0.5, "an animated Sun is not followed"
    bpy.context.scene.frame_set(1)


def warn_stale() -> Step:
    """An edited mesh makes its bake stale, and the panel says so."""
    bpy.data.objects["Statue"].data.vertices[0].co.x += 0.3
    bpy.data.objects["Statue"].data.update()
    bpy.context.view_layer.update()
    yield from until(lambda: session().objects["Statue"].stale, "an edited mesh is not reported as stale")
    yield 1.5
    shoot("15_stale")


def survive_reload() -> Step:
    """Save and load: the bakes are back, and the preview stays in step."""
    path = OUTPUT / "saved.blend"
    with override():
        bpy.ops.wm.save_as_mainfile(filepath=str(path))
        bpy.ops.wm.open_mainfile(filepath=str(path), load_ui=True)
    yield from until(lambda: baked_names() == ALL, f"the panel lists {baked_names()}")
    yield 2.0
    assert session().preview, "the preview is off after loading"
    shoot("16_reloaded")


def load_during_bake() -> Step:
    """Loading another file during a bake ends the child and nothing else happens."""
    bpy.context.scene.prt.preset = "high"
    assert invoke_bake() == {"RUNNING_MODAL"}
    yield 1.0
    with override():
        bpy.ops.wm.open_mainfile(filepath=str(OUTPUT / "saved.blend"), load_ui=False)
    yield 1.0
    assert not children() and not session().running


def clear() -> Step:
    """Clear removes the selected object's bake alone, then all."""
    select("Statue")
    with override():
        assert bpy.ops.prt.clear() == {"FINISHED"}
    yield from until(lambda: baked_names() == {"Floor", "Wall"}, "clear took the wrong objects")
    assert carrier("Statue") is None and carrier("Floor") is not None
    select()
    with override():
        assert bpy.ops.prt.clear() == {"FINISHED"}
    yield from until(lambda: not baked_names(), "clear left bakes")
    assert carrier("Floor") is None
    assert not [mesh.name for mesh in bpy.data.meshes if mesh.name.startswith("PRT ")]
    shoot("17_cleared")


def disable() -> Step:
    """Disabling leaves no handler, no type and no property behind."""
    handlers = bpy.app.handlers
    bpy.ops.preferences.addon_disable(module=MODULE)
    yield 0.5
    left = [f for name in dir(handlers) if isinstance(getattr(handlers, name), list)
            for f in getattr(handlers, name) if getattr(f, "__module__", "").startswith(MODULE)]
    assert not left, left
    assert not hasattr(bpy.types.Scene, "prt") and not hasattr(bpy.types, "PRT_PT_bake")
    bpy.ops.preferences.addon_enable(module=MODULE)
    yield 0.5
    assert hasattr(bpy.types.Scene, "prt") and not session().preview
    shoot("18_enabled_again")


STEPS = (open_scene, analyze, bake, undo_and_redo, bake_all, cancel, preview, follow_light, warn_stale, survive_reload,
         survive_crash, load_during_bake, clear, disable)

start(STEPS, "interface")
