# SPDX-License-Identifier: GPL-3.0-or-later
"""Driving a Blender with its interface as an artist does: what the scripts that run.py starts in it share.

A step is a generator function: `yield seconds` lets Blender draw and handle events for that long. Results go to
SCRIPT.json, screenshots beside it. Blender quits by itself afterwards.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
import traceback
from collections.abc import Callable, Generator, Iterator
from pathlib import Path

import bpy
import numpy as np
from bpy_extras.view3d_utils import location_3d_to_region_2d
from mathutils import Vector

MODULE = "bl_ext.user_default.prt"
OUTPUT, SCENE = (Path(text) for text in sys.argv[sys.argv.index("--") + 1:][:2])
# Share of a bake's time that may pass between two timer calls: a bake that blocks has 1. Seconds would say nothing, as
# software drawing on a loaded machine takes over a second per frame.
LONGEST_FREEZE = 0.4
BAKE_SECONDS = 180.0
DRAWN = 3.0  # seconds after which a change is on the screen, even there

Step = Generator[float]


def window() -> bpy.types.Window:
    return bpy.context.window_manager.windows[0]


def area() -> bpy.types.Area:
    return next(a for a in window().screen.areas if a.type == "VIEW_3D")


def region(kind: str = "WINDOW") -> bpy.types.Region:
    return next(r for r in area().regions if r.type == kind)


def override() -> object:
    return bpy.context.temp_override(window=window(), area=area(), region=region())


def session() -> bpy.types.PropertyGroup:
    return bpy.context.window_manager.prt


def shoot(name: str) -> np.ndarray:
    """A screenshot as (height, width, 3) in 0..255, saved as NAME.png."""
    path = OUTPUT / f"{name}.png"
    subprocess.run(["import", "-window", "root", str(path)], check=True, timeout=30)
    raw = subprocess.run(["convert", str(path), "-depth", "8", "rgb:-"], check=True, capture_output=True, timeout=30)
    return np.frombuffer(raw.stdout, np.uint8).reshape(1000, 1600, 3)


def view(picture: np.ndarray) -> np.ndarray:
    """The part of a screenshot that the viewport's middle fills."""
    box = region()
    height = picture.shape[0]
    top, bottom = height - (box.y + box.height) + 90, height - box.y - 10
    return picture[top:bottom, box.x + 80:box.x + box.width - 420].astype(np.float64)


def pixel(picture: np.ndarray, place: tuple[float, float, float]) -> np.ndarray:
    """The colour (3,) in 0..1 of a screenshot around a place in the world."""
    found = location_3d_to_region_2d(region(), area().spaces.active.region_3d, Vector(place))
    column, row = round(region().x + found.x), round(picture.shape[0] - (region().y + found.y))
    return picture[row - 1:row + 2, column - 1:column + 2].reshape(-1, 3).mean(axis=0) / 255.0


def until(condition: Callable[[], object], what: str, seconds: float = 15.0) -> Step:
    """Let Blender work until the condition holds; fails when it never does."""
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline, what
        yield 0.1


def baked_names() -> set[str]:
    """What the panel lists."""
    return {line.name for line in session().objects}


def select(*names: str) -> None:
    for scene_object in bpy.context.scene.objects:
        scene_object.select_set(scene_object.name in names)
    bpy.context.view_layer.objects.active = bpy.data.objects[names[0]] if names else None


def wait_for_bake(shot: str | None = None) -> Step:
    """Until no bake runs; fails where Blender froze meanwhile."""
    started = last = time.monotonic()
    longest = 0.0
    while session().running:
        assert time.monotonic() - started < BAKE_SECONDS, "the bake takes too long"
        yield 0.05
        longest, last = max(longest, time.monotonic() - last), time.monotonic()
        if shot and session().fraction > 0.3:
            shoot(shot)
            shot, last = None, time.monotonic()
    taken = time.monotonic() - started
    assert longest < LONGEST_FREEZE * taken, f"Blender froze for {longest:.2f} s of the bake's {taken:.2f} s"


def invoke_bake() -> set[str]:
    with override():
        return bpy.ops.prt.bake("INVOKE_DEFAULT")


def children() -> list[int]:
    """Process numbers of the living bake processes (Linux: /proc)."""
    found = []
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            command, status = (folder / "cmdline").read_bytes(), (folder / "stat").read_text()
        except OSError:  # it ended meanwhile
            continue
        if b"worker.py" in command and status.rpartition(")")[2].split()[1] == str(os.getpid()):
            found.append(int(folder.name))
    return found


def carrier(name: str) -> bpy.types.Mesh | None:
    """The mesh that holds an object's bake."""
    found = bpy.data.objects[name]
    mesh = found.get("prt_receiver") or found.data
    return mesh if "prt_header" in mesh else None


def _run_steps(steps: tuple[Callable[[], Step], ...], name: str) -> Iterator[float]:
    """Run the steps one after the other; a failure is noted and the next step goes on."""
    results: list[tuple[str, str]] = []
    for step in steps:
        failure = ""
        try:
            yield from step()
        except Exception:  # whatever a step raises is its result
            failure = traceback.format_exc()
            print(failure, flush=True)
        results.append((step.__name__, failure))
        (OUTPUT / f"{name}.json").write_text(json.dumps(results), encoding="utf-8")
        print(f"{'failed' if failure else 'passed'}: {step.__name__}", flush=True)


def start(steps: tuple[Callable[[], Step], ...], name: str) -> None:
    """Run the steps from now on, one per timer call; quit at the end."""
    running = _run_steps(steps, name)

    def advance() -> float | None:
        try:
            return next(running)
        except StopIteration:
            bpy.context.preferences.view.use_save_prompt = False
            bpy.ops.wm.quit_blender()
            return None

    bpy.context.preferences.view.show_splash = False
    bpy.app.timers.register(advance, first_interval=2.0, persistent=True)
