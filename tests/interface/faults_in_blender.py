# SPDX-License-Identifier: GPL-3.0-or-later
"""What can go wrong while a bake runs, in a Blender with its interface: run by run.py, one step per timer call.

Each fault ends in a message that names the object, the cause and the remedy, without a child process, with the previous
bake unchanged or the new one complete. in_blender.py has: the child killed, Esc, cancel; killed_in_blender.py: Blender
killed, and quitting.
"""

from __future__ import annotations

import resource
import shutil
import subprocess
import sys
import time
from pathlib import Path

import bpy

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
    override,
    region,
    select,
    session,
    shoot,
    start,
    until,
    wait_for_bake,
    window,
)

QUICK = "error_receivers=0"
# Finished stages soon, and then seconds of measuring the error.
LONG = "error_receivers=512, error_paths=65536"
MIDDLE = "error_receivers=8, error_paths=65536"


def bake(*names: str, overrides: str = LONG) -> set[str]:
    """Press Bake with these objects selected."""
    select(*names)
    with override():
        return bpy.ops.prt.bake("INVOKE_DEFAULT", overrides=overrides)


def under_way() -> Step:
    """Until the running bake measures its error: all other stages are done."""
    yield from until(lambda: session().stage == "Measuring the error" or not session().running, "no last stage", 60.0)
    assert session().running, session().message


def jobs_folder() -> Path:
    return sys.modules[f"{MODULE}.operators.bake_session"].jobs_folder()


def jobs() -> list[Path]:
    return list(jobs_folder().glob("bake-*"))


def cancel_all() -> Step:
    """Cancel answers within a second."""
    started = time.monotonic()
    assert bpy.ops.prt.cancel_all() == {"FINISHED"}
    while session().running:
        assert time.monotonic() - started < 1.0, "cancel does not answer"
        yield 0.02
    assert not children()


def header(name: str) -> str:
    return carrier(name)["prt_header"]


def open_scene() -> Step:
    with override():
        bpy.ops.wm.open_mainfile(filepath=str(SCENE), load_ui=False)
        bpy.ops.wm.save_as_mainfile(filepath=str(OUTPUT / "faults.blend"))
    yield 1.0
    bpy.context.scene.prt.preset = "draft"
    area().spaces.active.show_region_ui = True
    yield 1.0
    region("UI").active_panel_category = "PRT"
    assert bake("Statue", "Floor", "Wall", overrides=QUICK) == {"RUNNING_MODAL"}
    yield from wait_for_bake()
    assert not session().failed and not jobs(), session().message
    yield from until(lambda: baked_names() == {"Statue", "Floor", "Wall"}, "the panel does not list what was baked")


def queue() -> Step:
    """Bakes wait for each other, each with its own settings; a renamed object is found, a deleted one told of."""
    before = header("Statue"), header("Floor")
    assert bake("Statue", overrides=MIDDLE) == {"RUNNING_MODAL"}
    assert bake("Floor", overrides=QUICK + ", directions=300") == {"INTERFACE"}
    assert bake("Wall", overrides=QUICK) == {"INTERFACE"}
    assert bake("Statue", "Wall", overrides=QUICK) == {"INTERFACE"}
    assert session().waiting.splitlines() == ["Floor", "Wall", "Statue, Wall"], session().waiting
    assert len(children()) == 1
    yield from under_way()
    yield 0.5
    shoot("q01_queue")
    assert bpy.ops.prt.cancel(waiting=2) == {"FINISHED"}
    assert session().waiting.splitlines() == ["Floor", "Wall"]
    bpy.data.objects["Floor"].name = "Ground"
    bpy.data.objects.remove(bpy.data.objects["Wall"])
    yield from wait_for_bake()
    assert header("Statue") != before[0] and header("Ground") != before[1]
    assert '"directions": 300' in header("Ground") and '"directions": 300' not in header("Statue")
    assert "Wall: deleted before its turn" in session().message and session().failed, session().message
    told = session().ended.splitlines()
    assert len(told) == 2 and "Baked Statue" in told[0] and "Baked Ground" in told[1], told
    yield DRAWN
    shoot("q02_queue_ended")


def undo_queue() -> Step:
    """Each finished bake is one undo step."""
    both = header("Statue"), header("Ground")
    with override():
        bpy.ops.ed.undo()
    yield 0.5
    assert header("Statue") == both[0] and header("Ground") != both[1]
    with override():
        bpy.ops.ed.undo()
    yield 0.5
    assert header("Statue") != both[0]
    with override():
        bpy.ops.ed.redo()
        bpy.ops.ed.redo()
    yield 0.5
    assert (header("Statue"), header("Ground")) == both


def escape() -> Step:
    """Esc ends the running bake within a second, and the next one begins."""
    before, ground = header("Statue"), header("Ground")
    bake("Statue")
    bake("Ground", overrides=QUICK + ", directions=200")
    yield from under_way()
    box = region()
    subprocess.run(["xdotool", "mousemove", str(box.x + box.width // 3), "500", "key", "Escape"], check=True)
    started = time.monotonic()
    while session().title == "Statue":
        assert time.monotonic() - started < 1.5, "Esc does not answer"  # and reads the next one's scene
        yield 0.02
    yield from wait_for_bake()
    assert not session().failed and header("Statue") == before and header("Ground") != ground
    assert "cancelled" in session().ended and session().interrupted == ""


def edit_mesh() -> Step:
    """Vertices move while the bake runs: the result is stored and shown as stale, and the message says it."""
    bake("Statue", overrides=MIDDLE)
    yield from under_way()
    mesh = bpy.data.objects["Statue"].data
    mesh.vertices[0].co.x += 0.2
    mesh.update()
    yield from wait_for_bake()
    text = session().message
    assert "Statue is stale already: its mesh or modifiers changed meanwhile" in text and "again" in text, text
    yield from until(lambda: session().objects["Statue"].stale, "not shown as stale")
    yield DRAWN
    shoot("q03_edited")


def edit_mode() -> Step:
    """A bake that ends while its mesh is edited waits for the end of edit mode; nothing is lost."""
    before = header("Statue")
    bake("Statue", overrides=QUICK)
    with override():
        bpy.ops.object.mode_set(mode="EDIT")
    yield from until(lambda: "Stored once Statue" in session().stage, f"no waiting: {session().stage}", 30.0)
    yield 0.5
    shoot("q04_waits")
    assert session().running and not children()
    with override():
        bpy.ops.object.mode_set(mode="OBJECT")
    yield from until(lambda: not session().running, "never stored")
    assert not session().failed and header("Statue") != before, session().message


def undo() -> Step:
    """Undo while the bake runs: it goes on, and says that it is of what was before."""
    select("Statue")
    with override():
        bpy.ops.ed.undo_push(message="Before")
        bpy.ops.transform.translate(value=(0.0, 0.0, 0.3))
        bpy.ops.ed.undo_push(message="Moved")
    bake("Statue", overrides=MIDDLE)
    yield from under_way()
    with override():
        bpy.ops.ed.undo()
    yield from wait_for_bake()
    assert "Statue is stale already: it was moved" in session().message, session().message
    assert not session().failed and not children()


def save() -> Step:
    """The file is saved under another name while the bake runs, which goes on; both saved files load."""
    before = header("Statue")
    bake("Statue", overrides=MIDDLE)
    yield from under_way()
    with override():
        bpy.ops.wm.save_as_mainfile(filepath=str(OUTPUT / "during.blend"))
    yield from wait_for_bake()
    assert not session().failed and header("Statue") != before, session().message


def other_scene() -> Step:
    """The window shows another scene when a waiting bake's turn comes: it is of its own scene all the same."""
    before, own = header("Ground"), bpy.context.scene
    bake("Statue", overrides=MIDDLE)
    bake("Ground", overrides=QUICK + ", directions=150")
    yield from under_way()
    window().scene = bpy.data.scenes.new("Other")
    yield from wait_for_bake()
    assert not session().failed and header("Ground") != before, session().message
    bpy.data.scenes.remove(window().scene)
    assert bpy.context.scene == own
    yield 0.5


def delete_object() -> Step:
    """One of two objects goes: the other's bake is stored. All go: nothing is, and the file is as it was."""
    bake("Statue", "Ground", overrides=MIDDLE)
    yield from under_way()
    bpy.data.objects.remove(bpy.data.objects["Statue"])
    yield from wait_for_bake()
    assert "Statue was deleted meanwhile" in session().message and "Baked Ground" in session().message
    bake("Ground", overrides=MIDDLE + ", directions=128")
    yield from under_way()
    bpy.data.objects.remove(bpy.data.objects["Ground"])
    yield from wait_for_bake()
    assert session().failed and "Ground: deleted while its bake ran" in session().message, session().message
    assert not children() and len(jobs()) == 1
    with override():
        bpy.ops.wm.open_mainfile(filepath=str(OUTPUT / "during.blend"), load_ui=False)
    yield 1.0
    assert session().interrupted == ""


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
    folder = jobs_folder()
    if subprocess.run(["mount", "-t", "tmpfs", "-o", "size=100k", "tmpfs", str(folder)], check=False).returncode:
        print("no small disk can be mounted here: left out", flush=True)
        return
    try:
        for kilobytes in (100, 300, 600):
            subprocess.run(["mount", "-o", f"remount,size={kilobytes}k", str(folder)], check=True)
            bake("Statue", overrides=QUICK + ", directions=2048, order=7")
            yield from until(lambda: not session().running, "the bake goes on without a disk", 60.0)
            print(f"{kilobytes} kB: {session().message}", flush=True)
            assert session().failed and "pace" in session().message, session().message
            assert not children() and header("Statue") == before
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
        bpy.ops.wm.open_mainfile(filepath=str(OUTPUT / "during.blend"), load_ui=False)
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
    yield from wait_for_bake()
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
    yield from until(lambda: baked_names() == {"Statue", "Ground"}, f"the panel lists {baked_names()}")
    assert all("not readable" not in line.stale for line in session().objects)


STEPS = (open_scene, queue, undo_queue, escape, edit_mesh, edit_mode, undo, save, other_scene, delete_object,
         delete_job_folder, fill_disk, close_window, load_file, disable, saved_files_load)

start(STEPS, "faults")
