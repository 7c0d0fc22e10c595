# SPDX-License-Identifier: GPL-3.0-or-later
"""The pictures of the documentation, taken in a real Blender with its interface; started by tools/pictures.py.

An artist's session: open the demo's scene, look at the panels, bake, switch the preview on, turn the sky, drag a lamp.
"""

from __future__ import annotations

import sys
from pathlib import Path

import bpy

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "tests" / "interface"))
from driving import (  # its path is known only now
    DRAWN,
    SCENE,
    Step,
    area,
    invoke_bake,
    override,
    region,
    select,
    session,
    shoot,
    start,
    until,
    wait_for_bake,
)

FRAMES = 24  # of the GIF
CLOSED = ("PRT_PT_rays", "PRT_PT_highlights", "PRT_PT_local_lights", "PRT_PT_compression")


def set_up() -> Step:
    """The scene in one large viewport, with the sidebar's tab open, seen from its camera."""
    with override():
        bpy.ops.wm.open_mainfile(filepath=str(SCENE), load_ui=False)
    yield DRAWN
    space = area().spaces.active
    space.show_region_ui, space.show_gizmo, space.overlay.show_floor = True, False, False
    space.overlay.show_axis_x = space.overlay.show_axis_y = space.overlay.show_cursor = False
    space.region_3d.view_perspective = "CAMERA"
    with override():
        bpy.ops.view3d.view_center_camera()
    yield 1.0
    region("UI").active_panel_category = "PRT"
    bpy.data.worlds[0].name = bpy.data.worlds[0].name
    select()
    yield 1.0


def panels() -> Step:
    """What an artist sees before the first bake."""
    shoot("panel_before")
    with override():
        bpy.ops.prt.analyze()
    yield DRAWN
    shoot("panel_analysis")


def bake() -> Step:
    """Progress in the panel and in the status bar, then the results."""
    bpy.context.scene.prt.preset = "standard"
    assert invoke_bake() == {"RUNNING_MODAL"}
    yield from wait_for_bake("panel_baking")
    assert not session().failed, session().message
    yield from until(lambda: session().objects, "nothing is listed")
    with override():
        bpy.ops.prt.toggle_preview()
    yield 2.0 * DRAWN
    shoot("panel_preview")


STEPS = (set_up, panels, bake)
start(STEPS, "pictures")
