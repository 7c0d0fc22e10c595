# SPDX-License-Identifier: GPL-3.0-or-later
"""Bakes that last as long as a test wants: what the scripts of faults share."""

from __future__ import annotations

import sys
from pathlib import Path

import bpy
from driving import (
    MODULE,
    OUTPUT,
    SCENE,
    Step,
    area,
    baked_names,
    carrier,
    override,
    region,
    select,
    session,
    until,
)

# A few receivers and rays; then, if asked for, seconds or minutes of measuring the error.
QUICK = "error_receivers=0, spacing=0.15, directions=64, gather_directions=32, order=3"
MIDDLE = QUICK.replace("receivers=0", "receivers=6") + ", error_paths=65536"
LONG = QUICK.replace("receivers=0", "receivers=512") + ", error_paths=65536"


def bake(*names: str, overrides: str = LONG) -> set[str]:
    """Press Bake with these objects selected."""
    select(*names)
    with override():
        return bpy.ops.prt.bake("INVOKE_DEFAULT", overrides=overrides)


def under_way() -> Step:
    """Until the running bake measures its error: all other stages are done."""
    yield from until(lambda: session().stage == "Measuring the error" or not session().running, "no last stage", 60.0)
    assert session().running, session().message


def ended() -> Step:
    """Until no bake runs or waits."""
    yield from until(lambda: not session().running, "the bake takes too long", 90.0)


def jobs_folder() -> Path:
    return sys.modules[f"{MODULE}.operators.bake_session"].jobs_folder()


def jobs() -> list[Path]:
    return list(jobs_folder().glob("bake-*"))


def header(name: str) -> str:
    return carrier(name)["prt_header"]


def open_scene(name: str) -> Step:
    """The scene of the tests as a file of its own, with all of its objects baked."""
    with override():
        bpy.ops.wm.open_mainfile(filepath=str(SCENE), load_ui=False)
        bpy.ops.wm.save_as_mainfile(filepath=str(OUTPUT / f"{name}.blend"))
    yield 1.0
    bpy.context.scene.prt.preset = "draft"
    area().spaces.active.show_region_ui = True
    yield 1.0
    region("UI").active_panel_category = "PRT"
    assert bake("Statue", "Floor", "Wall", overrides=QUICK) == {"RUNNING_MODAL"}
    yield from ended()
    assert not session().failed and not jobs(), session().message
    yield from until(lambda: baked_names() == {"Statue", "Floor", "Wall"}, "the panel does not list what was baked")
    with override():
        bpy.ops.wm.save_mainfile()
