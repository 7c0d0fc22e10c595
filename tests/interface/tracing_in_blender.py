# SPDX-License-Identifier: GPL-3.0-or-later
"""Measuring the graphics driver's ray tracing, and a bake that it takes part in, in a Blender with its interface. Run
by run.py; its pictures are to be looked at."""

from __future__ import annotations

import importlib
import json
import sys
from pathlib import Path

import bpy

sys.path.insert(0, str(Path(__file__).parent))  # Blender runs this file by its path

from driving import (
    DRAWN,
    MODULE,
    SCENE,
    Step,
    area,
    baked_names,
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

choice = importlib.import_module(f"{MODULE}.operators.tracing_choice")
stored = importlib.import_module(f"{MODULE}.prt_addon.blender.stored_report")


def measure() -> Step:
    """Measured beside Blender, by a child that ends; a software driver is left out, by name and with its numbers."""
    with override():
        bpy.ops.wm.open_mainfile(filepath=str(SCENE), load_ui=False)
    yield 1.0
    area().spaces.active.show_region_ui = True
    yield 1.0
    region("UI").active_panel_category = "PRT"
    bpy.context.scene.prt.preset = "draft"
    with override():
        assert bpy.ops.prt.analyze() == {"FINISHED"}
    assert "Ray tracing on the GPU" not in session().analysis  # nobody has measured it
    with override():
        assert bpy.ops.prt.measure_tracing("INVOKE_DEFAULT") == {"RUNNING_MODAL"}
    yield 1.0
    shoot("01_measuring")
    yield from wait_for_bake()
    assert not session().failed and session().message.startswith("Rays are traced by Embree: "), session().message
    assert "left out" in session().message and choice.calibration_file().is_file()
    assert not children()
    yield DRAWN
    shoot("02_measured")


def analyze() -> Step:
    """The analysis says why."""
    with override():
        assert bpy.ops.prt.analyze() == {"FINISHED"}
    assert "Left out: Ray tracing on the GPU, because it traces " in session().analysis, session().analysis
    yield 3.0 * DRAWN  # the panel slides open
    shoot("03_analysis")


def cancelled() -> Step:
    """Esc ends the measurement and keeps the one before."""
    before = choice.calibration_file().read_text()
    with override():
        assert bpy.ops.prt.measure_tracing("INVOKE_DEFAULT") == {"RUNNING_MODAL"}
    yield 1.0
    with override():
        bpy.ops.prt.cancel()
    yield from until(lambda: not session().running, "the measurement goes on")
    assert choice.calibration_file().read_text() == before and not children()


def bake() -> Step:
    """With a measurement that favours the driver, a child Blender bakes with it, and this one stays alive."""
    path = choice.calibration_file()
    path.write_text(json.dumps(json.loads(path.read_text()) | {"occluded_rays": 1e12, "device": "a fast card"}))
    bpy.context.scene.prt.error_receivers = 0
    assert invoke_bake() == {"RUNNING_MODAL"}
    yield 1.0
    yield from wait_for_bake("04_baking")
    assert not session().failed, session().message
    yield from until(baked_names, "the panel lists no bake")
    tracer = stored.stored_report(bpy.context.scene)["tracer"]
    assert tracer["name"].startswith("Embree and ") and "gpu_rays" in tracer, tracer
    yield DRAWN
    shoot("05_baked")
    path.unlink()


start((measure, analyze, cancelled, bake), "tracing")
