# SPDX-License-Identifier: GPL-3.0-or-later
"""The child process around a bake, with stand-in jobs: messages, errors, crashes, cancel, and the parent's death."""

from __future__ import annotations

import importlib.util
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import ModuleType

import pytest

PACKAGE = Path(__file__).resolve().parents[2] / "prt_addon"
STAND_IN = '''
import os, signal, sys, time
from collections import namedtuple
from ..errors import BadScene
Progress = namedtuple("Progress", "stage fraction rays seconds_left")

def run_job(folder):
    kind = (folder / "kind").read_text()
    yield Progress("tracing", 0.25, 1000, None)
    if kind == "works":
        yield Progress("encoding", 0.75, 1000, 2.5)
    elif kind == "fails":
        raise BadScene("Cube", "the mesh has no faces", "Add faces")
    elif kind == "crashes":
        os.kill(os.getpid(), signal.SIGSEGV)
    elif kind == "killed":
        os.kill(os.getpid(), signal.SIGKILL)
    elif kind == "is defective":
        raise ZeroDivisionError("a defect")
    elif kind == "runs out of memory":
        raise MemoryError
    elif kind in ("sleeps", "leaves much"):
        if kind == "leaves much":
            (folder / "responses-abc").mkdir()
            (folder / "responses-abc" / "zone_0.npy").write_bytes(b"much")
            (folder / ".local.npz.1.part").write_bytes(b"half")
            (folder / "gather.npz").write_bytes(b"whole")
        yield Progress("encoding", 0.5, 1000, None)
        time.sleep(60)
    elif kind == "chatters":
        for number in range(20000):
            yield Progress("tracing", number / 20000, number, None)
'''


@pytest.fixture
def package(tmp_path: Path) -> Path:
    """A package with the real process, worker and errors, and the stand-in job."""
    folder = tmp_path / "stand_in"
    (folder / "baking").mkdir(parents=True)
    (folder / "__init__.py").touch()
    (folder / "baking" / "__init__.py").touch()
    shutil.copy(PACKAGE / "errors.py", folder)
    for name in ("process.py", "worker.py", "leftovers.py"):
        shutil.copy(PACKAGE / "baking" / name, folder / "baking")
    (folder / "baking" / "job.py").write_text(STAND_IN)
    return folder


@pytest.fixture
def process_module(package: Path) -> ModuleType:
    spec = importlib.util.spec_from_file_location("stand_in", package / "__init__.py",
                                                  submodule_search_locations=[str(package)])
    sys.modules["stand_in"] = importlib.util.module_from_spec(spec)
    yield importlib.import_module("stand_in.baking.process")
    for name in [name for name in sys.modules if name.split(".")[0] == "stand_in"]:
        del sys.modules[name]


def started(process_module: ModuleType, tmp_path: Path, kind: str) -> object:
    job = tmp_path / "job"
    job.mkdir(exist_ok=True)
    (job / "kind").write_text(kind)
    process = process_module.BakeProcess([sys.executable, "-I"], job)
    process.start()
    return process


def test_messages_arrive_in_order_and_end_with_done(process_module: ModuleType, tmp_path: Path) -> None:
    process = started(process_module, tmp_path, "works")
    messages = list(process.wait())
    assert [m["type"] for m in messages] == ["progress", "progress", "done"]
    assert messages[0]["seconds_left"] is None and messages[1]["seconds_left"] == 2.5
    assert process.finished and process.returncode == 0 and process.poll() == []


def test_poll_never_waits(process_module: ModuleType, tmp_path: Path) -> None:
    process = started(process_module, tmp_path, "sleeps")
    begun = time.monotonic()
    for _ in range(20):
        process.poll()
    assert time.monotonic() - begun < 0.5
    process.cancel()


@pytest.mark.parametrize(("kind", "exit_code", "words"), [
    ("fails", 1, "Cube: the mesh has no faces. Add faces"),
    ("crashes", 1, "SIGSEGV"),
    ("killed", 1, "memory ran out"),
    ("runs out of memory", 1, "memory ran out"),
    ("is defective", 1, "a defect"),
])
def test_every_bad_end_is_one_error(process_module: ModuleType, tmp_path: Path, kind: str, exit_code: int,
                                    words: str) -> None:
    *_, last = started(process_module, tmp_path, kind).wait()
    assert last["type"] == "error" and last["exit_code"] == exit_code
    with pytest.raises(Exception, match=words) as caught:
        process_module.raise_error(last)
    assert type(caught.value).__name__ == "PRTError" and "\n" not in str(caught.value)


def test_cancel_ends_the_child_and_a_new_one_can_start(process_module: ModuleType, tmp_path: Path) -> None:
    process = started(process_module, tmp_path, "sleeps")
    while not process.poll():
        time.sleep(0.01)
    begun = time.monotonic()
    process.cancel()
    process.cancel()
    assert time.monotonic() - begun < 1.0 and process.returncode is not None
    *_, last = process.wait()
    assert last["type"] == "error" and last["exit_code"] == 3
    assert [m["type"] for m in started(process_module, tmp_path, "works").wait()][-1] == "done"


@pytest.mark.parametrize("way", ["cancel", "kill"])
def test_no_end_leaves_anything_unfinished(process_module: ModuleType, tmp_path: Path, way: str) -> None:
    """Finished stages stay, half-written files and the folder of responses go."""
    process = started(process_module, tmp_path, "leaves much")
    messages: list = []
    while len(messages) < 2:
        messages += process.poll()
        time.sleep(0.01)
    assert len(unfinished(tmp_path / "job")) == 2
    if way == "cancel":
        process.cancel()
    else:
        process.process.kill()
        assert list(process.wait())[-1]["type"] == "error"
    assert not unfinished(tmp_path / "job") and (tmp_path / "job" / "gather.npz").exists()


def unfinished(job: Path) -> list[Path]:
    return [*job.glob("responses-*"), *job.glob(".*.part")]


def test_progress_is_thinned_out(process_module: ModuleType, tmp_path: Path) -> None:
    messages = list(started(process_module, tmp_path, "chatters").wait())
    assert messages[-1]["type"] == "done" and len(messages) < 100


@pytest.mark.skipif(sys.platform == "win32", reason="signals of POSIX")
def test_child_ignores_the_terminal_interrupt(process_module: ModuleType, tmp_path: Path) -> None:
    process = started(process_module, tmp_path, "sleeps")
    while not process.poll():
        time.sleep(0.01)
    process.process.send_signal(signal.SIGINT)
    time.sleep(0.2)
    assert process.returncode is None
    process.cancel()


@pytest.mark.skipif(sys.platform == "win32", reason="reads /proc or sends signal 0")
def test_child_dies_with_its_parent(package: Path, tmp_path: Path) -> None:
    """The parent is killed without a chance to clean up."""
    job = tmp_path / "job"
    job.mkdir()
    (job / "kind").write_text("leaves much")
    parent = tmp_path / "parent.py"
    parent.write_text(f'''
import sys, time
sys.path.insert(0, {str(tmp_path)!r})
from pathlib import Path
from stand_in.baking.process import BakeProcess
process = BakeProcess([sys.executable, "-I"], Path({str(job)!r}))
process.start()
messages = []
while len(messages) < 2:
    messages += process.poll()
    time.sleep(0.01)
print(process.process.pid, flush=True)
time.sleep(60)
''')
    running = subprocess.Popen([sys.executable, str(parent)], stdout=subprocess.PIPE, text=True)
    child = int(running.stdout.readline())
    assert unfinished(job)
    running.kill()
    running.wait()
    deadline = time.monotonic() + 5.0
    while _alive(child):
        assert time.monotonic() < deadline, "the child outlived its parent"
        time.sleep(0.05)
    assert not unfinished(job) and (job / "gather.npz").exists()


def _alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    status = Path(f"/proc/{pid}/stat")  # a zombie that nobody reaps is dead enough
    return not (status.exists() and status.read_text().rpartition(")")[2].split()[0] == "Z")
