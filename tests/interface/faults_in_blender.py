# SPDX-License-Identifier: GPL-3.0-or-later
"""What an artist does to a scene while it is baked, in a Blender with its interface: run by run.py.

Each ends in a message that names the object, the cause and the remedy, without a child process, with the previous bake
unchanged or the new one complete. in_blender.py has: the child killed, Esc, cancel; losses_in_blender.py: what a bake
needs goes away; killed_in_blender.py: Blender killed, and quitting.
"""

from __future__ import annotations

import subprocess
import sys
import time
from pathlib import Path

import bpy

sys.path.insert(0, str(Path(__file__).parent))  # Blender runs this file by its path

import long_bakes
from driving import (
    DRAWN,
    OUTPUT,
    Step,
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
from long_bakes import MIDDLE, QUICK, bake, ended, header, under_way


def open_scene() -> Step:
    yield from long_bakes.open_scene("faults")


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
    yield from ended()
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
    yield from ended()
    assert not session().failed and header("Statue") == before and header("Ground") != ground
    assert "cancelled" in session().ended and session().interrupted == ""


def edit_mesh() -> Step:
    """Vertices move while the bake runs: the result is stored and shown as stale, and the message says it."""
    bake("Statue", overrides=MIDDLE)
    yield from under_way()
    mesh = bpy.data.objects["Statue"].data
    mesh.vertices[0].co.x += 0.2
    mesh.update()
    yield from ended()
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
    yield from ended()
    assert "Statue is stale already: it was moved" in session().message, session().message
    assert not session().failed and not children()


def save() -> Step:
    """The file is saved under another name while the bake runs, which goes on; both saved files load."""
    before = header("Statue")
    bake("Statue", overrides=MIDDLE)
    yield from under_way()
    with override():
        bpy.ops.wm.save_as_mainfile(filepath=str(OUTPUT / "during.blend"))
    yield from ended()
    assert not session().failed and header("Statue") != before, session().message


def other_scene() -> Step:
    """The window shows another scene when a waiting bake's turn comes: it is of its own scene all the same."""
    before, own = header("Ground"), bpy.context.scene
    bake("Statue", overrides=MIDDLE)
    bake("Ground", overrides=QUICK + ", directions=150")
    yield from under_way()
    window().scene = bpy.data.scenes.new("Other")
    yield from ended()
    assert not session().failed and header("Ground") != before, session().message
    bpy.data.scenes.remove(window().scene)
    assert bpy.context.scene == own
    yield 0.5


def delete_object() -> Step:
    """One of two objects goes: the other's bake is stored. All go: nothing is, and the file is as it was."""
    bake("Statue", "Ground", overrides=MIDDLE)
    yield from under_way()
    bpy.data.objects.remove(bpy.data.objects["Statue"])
    yield from ended()
    assert "Statue was deleted meanwhile" in session().message and "Baked Ground" in session().message
    bake("Ground", overrides=MIDDLE + ", directions=128")
    yield from under_way()
    bpy.data.objects.remove(bpy.data.objects["Ground"])
    yield from ended()
    assert session().failed and "Ground: deleted while its bake ran" in session().message, session().message
    assert not children()
    with override():
        bpy.ops.wm.open_mainfile(filepath=str(OUTPUT / "during.blend"), load_ui=False)
    yield 1.0
    assert session().interrupted == ""


STEPS = (open_scene, queue, undo_queue, escape, edit_mesh, edit_mode, undo, save, other_scene, delete_object)

start(STEPS, "faults")
