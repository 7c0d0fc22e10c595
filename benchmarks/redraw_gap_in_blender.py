# SPDX-License-Identifier: GPL-3.0-or-later
"""What redraw_gap.py starts in a Blender with its interface: orbits, and notes when the viewport is drawn."""

from __future__ import annotations

import itertools
import json
import sys
import time
from collections.abc import Generator
from pathlib import Path

import bpy
from mathutils import Quaternion

OUTPUT, SCENE, THREADS, SECONDS = sys.argv[sys.argv.index("--") + 1:][:4]
# A long stage of shadows, in which all threads work; the bake is cancelled after some seconds of it.
BAKE = "directions=200000, error_receivers=0, threads={}"
TURN = Quaternion((0.0, 0.0, 1.0), 0.02)
drawn: list[float] = []
gaps: dict[str, list[float]] = {}


def view() -> tuple[bpy.types.Window, bpy.types.Area, bpy.types.Region]:
    window = bpy.context.window_manager.windows[0]
    area = next(a for a in window.screen.areas if a.type == "VIEW_3D")
    return window, area, next(r for r in area.regions if r.type == "WINDOW")


def orbit(seconds: float, name: str, baking: bool) -> Generator[float]:
    """Turn the view as fast as Blender draws it; the gaps between the redraws go to `gaps`."""
    drawn.clear()
    end = time.monotonic() + seconds
    last = 0
    while time.monotonic() < end:
        if len(drawn) != last or not drawn:  # drawn since: turn on
            last = len(drawn)
            _, area, region = view()
            space = area.spaces.active.region_3d
            space.view_rotation.rotate(TURN)
            region.tag_redraw()
        if baking:
            assert bpy.context.window_manager.prt.running, bpy.context.window_manager.prt.message
        yield 0.001
    gaps.setdefault(name, []).extend(b - a for a, b in itertools.pairwise(drawn))


def steps() -> Generator[float]:
    window, area, region = view()
    with bpy.context.temp_override(window=window, area=area, region=region):
        bpy.ops.wm.open_mainfile(filepath=SCENE, load_ui=False)
    yield 1.0
    window, area, region = view()
    area.spaces.active.show_region_ui = True
    yield 2.0
    handler = bpy.types.SpaceView3D.draw_handler_add(lambda: drawn.append(time.monotonic()), (), "WINDOW", "POST_PIXEL")
    for threads in THREADS.split(","):
        yield from orbit(float(SECONDS) / 2.0, "idle", False)
        window, area, region = view()
        bpy.context.scene.prt.preset = "high"
        with bpy.context.temp_override(window=window, area=area, region=region):
            assert bpy.ops.prt.bake("INVOKE_DEFAULT", overrides=BAKE.format(threads)) == {"RUNNING_MODAL"}
        while bpy.context.window_manager.prt.stage != "Shadows":
            assert bpy.context.window_manager.prt.running, bpy.context.window_manager.prt.message
            yield 0.05
        started, before = time.monotonic(), bpy.context.window_manager.prt.fraction
        yield from orbit(float(SECONDS), f"baking, threads={threads}", True)
        done = bpy.context.window_manager.prt.fraction - before
        print(f"threads={threads}: {100.0 * done:.1f} % of the bake in {time.monotonic() - started:.1f} s", flush=True)
        bpy.ops.prt.cancel()
        while bpy.context.window_manager.prt.running:
            yield 0.05
        yield from orbit(float(SECONDS) / 2.0, "idle", False)
    bpy.types.SpaceView3D.draw_handler_remove(handler, "WINDOW")
    Path(OUTPUT, "gaps.json").write_text(json.dumps(gaps))


def advance(running: Generator[float]) -> float | None:
    try:
        return next(running)
    except StopIteration:
        return quit_blender()
    except BaseException:
        quit_blender()
        raise


def quit_blender() -> None:
    bpy.context.preferences.view.use_save_prompt = False
    bpy.ops.wm.quit_blender()


running = steps()
bpy.context.preferences.view.show_splash = False
bpy.app.timers.register(lambda: advance(running), first_interval=2.0, persistent=True)
