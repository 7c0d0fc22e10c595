# SPDX-License-Identifier: GPL-3.0-or-later
"""What a bake needs goes away while it runs, in a Blender with its interface: its folder, the disk, its
window, its file, the extension. Run by run.py; see faults_in_blender.py.
"""

from __future__ import annotations

import resource
import shutil
import subprocess
import sys
from pathlib import Path

import bpy

sys.path.insert(0, str(Path(__file__).parent))  # Blender runs this file by its path

import long_bakes
from driving import (
    DRAWN,
    MODULE,
    OUTPUT,
    SCENE,
    Step,
    baked_names,
    children,
    override,
    region,
    select,
    session,
    shoot,
    start,
    until,
    window,
)
from long_bakes import LONG, MIDDLE, bake, ended, header, jobs, jobs_folder, under_way


def open_scene() -> Step:
    yield from long_bakes.open_scene("losses")


def delete_job_folder() -> Step:
    """Somebody cleans up: the bake ends at once and says why."""
    before = header("Statue")
    bake("Statue")
    yield from under_way()
    for folder in jobs():
        shutil.rmtree(folder)
    yield from until(lambda: not session().running, "the bake goes on without its folder", 2.0)
    assert session().failed and "job folder was deleted" in session().message, session().message
    assert not children() and header("Statue") == before


def fill_disk() -> Step:
    """No byte can be written any more: of the messages in one bake, of the stages in another."""
    before = header("Statue")
    bake("Statue")
    yield from under_way()
    resource.prlimit(children()[0], resource.RLIMIT_FSIZE, (1, 1))
    yield from until(lambda: not session().running, "the bake goes on without a disk", 30.0)
    assert session().failed and "disk is full" in session().message and "free some space" in session().message
    assert not children() and header("Statue") == before and not [p for j in jobs() for p in j.glob(".*.part")]
    yield DRAWN
    shoot("q05_full")
    stages = LONG + ", order=7, spacing=0.03, gather_directions=128"
    bake("Statue", overrides=stages)
    yield from under_way()
    written = max(jobs(), key=lambda folder: folder.stat().st_mtime)
    scene, gathered = ((written / name).stat().st_size // 1024 for name in ("scene.npz", "gather.npz"))
    bpy.ops.prt.cancel()
    yield from ended()
    folder = jobs_folder()
    if subprocess.run(["mount", "-t", "tmpfs", "-o", "size=1m", "tmpfs", str(folder)], check=False).returncode:
        print("no small disk can be mounted here: left out", flush=True)
        return
    try:
        for kilobytes, stage in ((scene + 64, "gather.npz"), (scene + gathered + 64, "direct.npz")):
            subprocess.run(["mount", "-o", f"remount,size={kilobytes}k", str(folder)], check=True)
            bake("Statue", overrides=stages)
            yield from ended()
            assert session().failed and f"{stage}: can't be written" in session().message, session().message
            assert "pace" in session().message and not children() and header("Statue") == before
            assert not [path for job in jobs() for path in job.glob(".*.part")]
    finally:
        subprocess.run(["umount", str(folder)], check=True)


def close_window() -> Step:
    """The window that a bake was started in is closed: another one follows it, and can cancel it."""
    with override():
        bpy.ops.wm.window_new()
    yield 2.0
    second = next(w for w in bpy.context.window_manager.windows if w != window())
    select("Statue")
    with bpy.context.temp_override(window=second):
        assert bpy.ops.prt.bake("INVOKE_DEFAULT", overrides=LONG) == {"RUNNING_MODAL"}
    yield from under_way()
    with bpy.context.temp_override(window=second):
        bpy.ops.wm.window_close()
    yield 2.0
    assert len(bpy.context.window_manager.windows) == 1
    assert session().running and len(children()) == 1, session().message
    box = region()
    subprocess.run(["xdotool", "mousemove", str(box.x + box.width // 3), "500", "key", "Escape"], check=True)
    yield from until(lambda: not session().running, "Esc does not reach the other window's bake", 2.0)
    assert "cancelled" in session().message and not children()


def load_file() -> Step:
    """Another file is loaded: the bake ends, says so, and is offered once its own file is open again."""
    bake("Statue")
    yield from under_way()
    with override():
        bpy.ops.wm.open_mainfile(filepath=str(SCENE), load_ui=False)
    yield 1.0
    assert not children() and not session().running and not session().interrupted
    assert "Statue: its bake ended because a file was loaded" in session().message, session().message
    with override():
        bpy.ops.wm.open_mainfile(filepath=str(OUTPUT / "losses.blend"), load_ui=False)
    yield from until(lambda: session().interrupted, "the interrupted bake is not offered")
    assert "A bake of Statue was interrupted after" in session().interrupted, session().interrupted
    yield DRAWN
    shoot("q06_offered")
    with override():
        assert bpy.ops.prt.discard_interrupted() == {"FINISHED"}
    assert not session().interrupted


def disable() -> Step:
    """The extension is disabled: no child, no handler, no timer; enabled again it offers to resume, which works."""
    before = header("Statue")
    bake("Statue", overrides=MIDDLE)
    yield from under_way()
    bpy.ops.preferences.addon_disable(module=MODULE)
    yield 0.5
    handlers = bpy.app.handlers
    left = [f for name in dir(handlers) if isinstance(getattr(handlers, name), list)
            for f in getattr(handlers, name) if getattr(f, "__module__", "").startswith(MODULE)]
    assert not children() and not left, left
    assert header("Statue") == before
    yield 1.0
    bpy.ops.preferences.addon_enable(module=MODULE)
    yield from until(lambda: session().interrupted, "the interrupted bake is not offered")
    with override():
        assert bpy.ops.prt.resume("INVOKE_DEFAULT") == {"RUNNING_MODAL"}
    assert not session().interrupted
    yield from ended()
    assert not session().failed and "afresh" not in session().message and header("Statue") != before
    assert not children()
    yield 1.0
    shoot("q07_resumed")


def saved_files_load() -> Step:
    """After all of that the file can be saved and loaded."""
    path = OUTPUT / "after.blend"
    with override():
        bpy.ops.wm.save_as_mainfile(filepath=str(path))
        bpy.ops.wm.open_mainfile(filepath=str(path), load_ui=False)
    yield from until(lambda: baked_names() == {"Statue", "Floor", "Wall"}, f"the panel lists {baked_names()}")
    assert all("not readable" not in line.stale for line in session().objects)


STEPS = (open_scene, delete_job_folder, fill_disk, close_window, load_file, disable, saved_files_load)

start(STEPS, "losses")
