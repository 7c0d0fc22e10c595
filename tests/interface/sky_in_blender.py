# SPDX-License-Identifier: GPL-3.0-or-later
"""The automatic sky, and lamps on a bake of distant light, in a Blender with its interface. Run by run.py; its pictures
are to be looked at."""

from __future__ import annotations

import sys
from pathlib import Path

import bpy
import numpy as np

sys.path.insert(0, str(Path(__file__).parent))  # Blender runs this file by its path

from driving import (
    DRAWN,
    SCENE,
    Step,
    area,
    baked_names,
    carrier,
    invoke_bake,
    override,
    region,
    session,
    shoot,
    start,
    until,
    view,
    wait_for_bake,
)

ALL = {"Ball", "Floor", "Statue", "Wall"}


def settings() -> bpy.types.PropertyGroup:
    return bpy.context.scene.prt


def analyze() -> Step:
    """Under a hard Sun the automatic sky is a cubemap, and the panel tells what and why."""
    with override():
        bpy.ops.wm.open_mainfile(filepath=str(SCENE), load_ui=False)
    yield 1.0
    sun = bpy.data.objects.new("Sun", bpy.data.lights.new("Sun", "SUN"))
    sun.data.energy, sun.data.angle, sun.rotation_euler = 4.0, 0.01, (0.6, 0.3, 0.0)
    bpy.context.scene.collection.objects.link(sun)
    bpy.context.scene.world.node_tree.nodes["Background"].inputs["Strength"].default_value = 0.1
    space = area().spaces.active
    space.show_region_ui, space.shading.type = True, "SOLID"
    space.region_3d.view_perspective = "PERSP"
    space.region_3d.view_rotation = (0.82, 0.49, 0.15, 0.26)
    space.region_3d.view_distance, space.region_3d.view_location = 7.5, (0.2, 0.0, 0.6)
    bpy.context.scene.cursor.location = (0.0, 0.0, -5.0)  # out of the pictures
    yield 1.5
    region("UI").active_panel_category = "PRT"
    settings().preset = "draft"
    settings().distant_basis, settings().encoder, settings().light_error = "auto", "auto", 0.08
    settings().error_receivers = 0
    with override():
        assert bpy.ops.prt.analyze() == {"FINISHED"}
    yield DRAWN
    shoot("01_analysis")
    assert "Sky by a cubemap of " in session().analysis, session().analysis
    assert "8.0 % asked" in session().analysis and "sparse sampling" in session().analysis, session().analysis


def bake() -> Step:
    """The bake takes what Analyze told."""
    line = next(line for line in session().analysis.splitlines() if line.startswith("Sky by"))
    assert invoke_bake() == {"RUNNING_MODAL"}
    yield from wait_for_bake()
    assert not session().failed, session().message
    yield from until(lambda: baked_names() == ALL, f"the panel lists {baked_names()}")
    assert line in session().last_bake, session().last_bake
    assert '"kind": "cubemap"' in carrier("Statue")["prt_header"].replace('":"', '": "')
    yield 1.0
    shoot("02_baked")


def lamps() -> Step:
    """Lamps light the bake where that is asked for, and follow; inside the hull one is refused in the panel."""
    bpy.context.scene.world.node_tree.nodes["Background"].inputs["Strength"].default_value = 0.02
    bpy.data.objects["Sun"].hide_render = bpy.data.objects["Sun"].hide_viewport = True
    lamp = bpy.data.objects["Lamp"]
    lamp.data.energy, lamp.location = 600.0, (-2.5, -2.5, 3.5)
    with override():
        assert bpy.ops.prt.toggle_preview() == {"FINISHED"}
    yield 2.0 * DRAWN
    dark = view(shoot("03_without_lamps"))
    assert "Lamp: a Point light is near the scene" in session().preview_message, session().preview_message
    settings().lamps_by_directions = True
    yield DRAWN
    lit = view(shoot("04_lamp"))
    assert lit.mean() > dark.mean() + 5.0, (dark.mean(), lit.mean())
    assert "Lamp" not in session().preview_message, session().preview_message
    lamp.location = (2.5, -2.5, 3.5)
    yield DRAWN
    moved = view(shoot("05_lamp_moved"))
    assert np.abs(moved - lit).mean() > 2.0, "the shadows did not follow"
    lamp.location = (0.2, -0.6, 0.4)
    yield DRAWN
    inside = view(shoot("06_lamp_inside"))
    assert "Lamp: inside the hull of the scene" in session().preview_message, session().preview_message
    assert abs(inside.mean() - dark.mean()) < 2.0, "a refused lamp lights"


def back() -> Step:
    """Without the switch all is as it was."""
    settings().lamps_by_directions = False
    yield DRAWN
    assert "near the scene" in session().preview_message, session().preview_message
    with override():
        bpy.ops.prt.toggle_preview()
    yield DRAWN
    assert not session().preview


start((analyze, bake, lamps, back), "sky")
