# SPDX-License-Identifier: GPL-3.0-or-later
"""Blender ends in the middle of a bake, and its next start offers to resume it. run.py starts this script again while
it leaves the number of the next start in killed.again.

1: Blender is killed. 2: the bake is offered and resumed, and Blender quits meanwhile. 3: the bake is resumed to its
end, Blender is killed before it is stored. 4: the finished bake is stored at once.
"""

from __future__ import annotations

import json
import os
import signal
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
    carrier,
    children,
    override,
    region,
    select,
    session,
    shoot,
    start,
    until,
)

AGAIN, FILE = OUTPUT / "killed.again", OUTPUT / "killed.blend"
LONG = "error_receivers=12, error_paths=65536"
START = int(AGAIN.read_text()) if AGAIN.is_file() else 1


def next_start(number: int | None) -> None:
    """Have run.py start this script once more."""
    if number is None:
        AGAIN.unlink(missing_ok=True)
    else:
        AGAIN.write_text(str(number))


def jobs() -> list[Path]:
    return list(sys.modules[f"{MODULE}.operators.bake_session"].jobs_folder().glob("bake-*"))


def open_file(path: Path) -> Step:
    with override():
        bpy.ops.wm.open_mainfile(filepath=str(path), load_ui=False)
    yield 0.5
    area().spaces.active.show_region_ui = True
    yield 0.5
    region("UI").active_panel_category = "PRT"


def stamps() -> dict[str, int]:
    """When the finished stages were written."""
    return {path.name: path.stat().st_mtime_ns for path in jobs()[0].glob("*.npz")}


def kill_during_bake() -> Step:
    yield from open_file(SCENE)
    bpy.context.scene.prt.preset = "draft"
    with override():
        bpy.ops.wm.save_as_mainfile(filepath=str(FILE))
        select("Statue", "Floor")
        assert bpy.ops.prt.bake("INVOKE_DEFAULT", overrides=LONG) == {"RUNNING_MODAL"}
    yield from until(lambda: session().stage == "Measuring the error", "no last stage", 60.0)
    (OUTPUT / "killed.stamps").write_text(json.dumps([children(), stamps()]))
    next_start(2)
    os.kill(os.getpid(), signal.SIGKILL)
    yield 1.0


def quit_during_resumed_bake() -> Step:
    """Offered for its own file only; another file's panel says nothing."""
    orphans, finished = json.loads((OUTPUT / "killed.stamps").read_text())
    assert not [number for number in orphans if alive(number)], "the child outlived its Blender"
    yield from open_file(SCENE)
    yield 1.0
    assert not session().interrupted, "offered in another file"
    yield from open_file(FILE)
    yield from until(lambda: session().interrupted, "the interrupted bake is not offered")
    assert "A bake of Floor, Statue was interrupted after Bounced light" in session().interrupted, session().interrupted
    yield DRAWN
    shoot("k01_offered")
    with override():
        assert bpy.ops.prt.resume("INVOKE_DEFAULT") == {"RUNNING_MODAL"}
    yield from until(lambda: session().stage == "Measuring the error" or not session().running, "no last stage", 60.0)
    assert session().running, session().message
    assert {name: stamp for name, stamp in stamps().items() if name in finished} == finished, "stages ran again"
    (OUTPUT / "killed.stamps").write_text(json.dumps([children(), finished]))
    next_start(3)


def kill_before_it_is_stored() -> Step:
    """Done while Statue is in edit mode: nothing can be stored yet, and Blender is killed."""
    orphans, finished = json.loads((OUTPUT / "killed.stamps").read_text())
    assert not [number for number in orphans if alive(number)], "the child outlived quitting"
    yield from open_file(FILE)
    yield from until(lambda: session().interrupted, "the bake that quitting ended is not offered")
    assert carrier("Statue") is None
    with override():
        assert bpy.ops.prt.resume("INVOKE_DEFAULT") == {"RUNNING_MODAL"}
        select("Statue")
        bpy.ops.object.mode_set(mode="EDIT")
    yield from until(lambda: "Stored once" in session().stage, "the bake does not wait for edit mode", 60.0)
    assert {name: stamp for name, stamp in stamps().items() if name in finished} == finished, "stages ran again"
    next_start(4)
    os.kill(os.getpid(), signal.SIGKILL)
    yield 1.0


def store_at_once() -> Step:
    yield from open_file(FILE)
    yield from until(lambda: session().interrupted, "the finished bake is not offered")
    assert "done, but not stored" in session().interrupted, session().interrupted
    yield DRAWN
    shoot("k02_done")
    started = time.monotonic()
    with override():
        assert bpy.ops.prt.resume("INVOKE_DEFAULT") == {"RUNNING_MODAL"}
    assert not children(), "it is baked again"
    yield from until(lambda: not session().running, "never stored", 5.0)
    print(f"stored {time.monotonic() - started:.2f} s after Resume", flush=True)
    assert not session().failed and carrier("Statue") and carrier("Floor"), session().message
    assert "stale" not in session().message and not jobs() and not session().interrupted
    yield DRAWN
    shoot("k03_stored")
    with override():
        bpy.ops.wm.save_as_mainfile(filepath=str(FILE))
        bpy.ops.wm.open_mainfile(filepath=str(FILE), load_ui=False)
    yield 1.0
    assert carrier("Statue") and carrier("Floor")
    next_start(None)


def alive(number: int) -> bool:
    """Whether a bake process of that number runs."""
    try:
        return b"worker.py" in Path(f"/proc/{number}/cmdline").read_bytes()
    except OSError:
        return False


STEPS = {1: kill_during_bake, 2: quit_during_resumed_bake, 3: kill_before_it_is_stored, 4: store_at_once}

start((STEPS[START],), f"killed_{START}")
