# SPDX-License-Identifier: GPL-3.0-or-later
"""Job folders among several processes, and what happens to a bake whose folder, disk or parent goes away."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from prt_addon.baking import record as records
from prt_addon.baking.claims import Claim, discard_if_free, is_free
from prt_addon.baking.job import claim_job, read_result, run_job, write_job
from prt_addon.baking.process import BakeProcess
from prt_addon.baking.record import CANCELLED, JobRecord, interrupted, note_end, reached, read_record, write_record
from prt_addon.baking.settings import BakeSettings
from prt_addon.errors import PRTError
from prt_addon.scene.scene_mesh import SceneMesh
from tests.core.shapes import box, drain, plane

ROOT = Path(__file__).resolve().parents[2]
SMALL = BakeSettings(order=2, directions=64, gather_directions=32, clusters=4, vectors=2, encoder="static", spacing=0.2,
                     error_receivers=0, threads=1)
LONG = replace(SMALL, error_receivers=64, error_paths=2 ** 20)
HOLDER = """
import sys, time
sys.path.insert(0, sys.argv[1])
from pathlib import Path
from prt_addon.baking.claims import Claim
claim = Claim.take(Path(sys.argv[2]))
print("held" if claim else "busy", flush=True)
time.sleep(60)
"""
RACER = """
import os, sys, time
sys.path.insert(0, sys.argv[1])
from pathlib import Path
from prt_addon.baking.claims import Claim
folder, taken = Path(sys.argv[2]), 0
deadline = time.monotonic() + 1.5
while time.monotonic() < deadline:
    claim = Claim.make(folder)
    if claim is None:
        continue
    os.close(os.open(folder / "mine", os.O_CREAT | os.O_EXCL))  # fails where two hold it
    time.sleep(0.001)
    assert (folder / "mine").exists()  # fails where another discarded it
    taken += 1
    claim.discard()
print(taken)
"""


def scene() -> SceneMesh:
    return SceneMesh.assemble([plane(size=2.0), box()], 0.2)


@pytest.fixture
def other(tmp_path: Path) -> Iterator[subprocess.Popen[str]]:
    """Another process that holds the folder `job`."""
    (tmp_path / "job").mkdir()
    holder = subprocess.Popen([sys.executable, "-c", HOLDER, str(ROOT), str(tmp_path / "job")], stdout=subprocess.PIPE,
                              text=True)
    assert holder.stdout.readline() == "held\n"
    yield holder
    holder.kill()
    holder.communicate()


def record(**changes: object) -> JobRecord:
    values = {"file": "a.blend", "scene": "Scene", "view_layer": "ViewLayer", "objects": ("Box",), "asked": None,
              "selected": (), "settings": SMALL.as_dict(), "digests": {"Box": {"geometry": "1", "materials": None}},
              "surroundings": {"Box": "2"}, "process": os.getpid(), "started": 1.0}
    return JobRecord(**{**values, **changes})


def test_a_folder_is_one_living_process_own(other: subprocess.Popen[str], tmp_path: Path) -> None:
    """Nobody else claims or discards it; killed, it holds nothing any more, though its file is still there."""
    folder = tmp_path / "job"
    (folder / "gather.npz").write_bytes(b"whole")
    assert Claim.take(folder) is None and not is_free(folder)
    assert not discard_if_free(folder) and (folder / "gather.npz").exists()
    other.kill()
    other.wait()
    claim = Claim.take(folder)
    assert claim is not None and Claim.take(folder) is None, "the same process claims it twice"
    claim.release()
    claim.release()
    assert discard_if_free(folder) and not folder.exists()


def test_no_two_ever_hold_a_folder_that_is_made_and_discarded(tmp_path: Path) -> None:
    racers = [subprocess.Popen([sys.executable, "-c", RACER, str(ROOT), str(tmp_path / "job")], stdout=subprocess.PIPE,
                               stderr=subprocess.PIPE, text=True) for _ in range(3)]
    for racer in racers:
        taken, errors = racer.communicate(timeout=30)
        assert racer.returncode == 0 and int(taken) > 5, errors


def test_two_bakes_of_one_scene_have_folders_of_their_own(tmp_path: Path) -> None:
    first = claim_job(tmp_path, scene(), SMALL)
    second = claim_job(tmp_path, scene(), SMALL)
    assert second.folder.name == f"{first.folder.name}-2"
    for claim in (first, second):
        drain(run_job(claim.folder))
    results = [read_result(claim.folder) for claim in (first, second)]
    assert all((results[0].objects[name].bases == results[1].objects[name].bases).all() for name in results[0].objects)
    second.discard()
    assert first.folder.is_dir() and not second.folder.exists()
    first.release()
    assert write_job(tmp_path, scene(), SMALL) == first.folder, "its stages are not found again"


def test_records_tell_interrupted_bakes_from_running_ended_and_foreign_ones(tmp_path: Path) -> None:
    kept = record(started=3.0)
    for name, written in (("bake-1", record()), ("bake-2", kept), ("bake-3", record()), ("bake-4", record())):
        (tmp_path / name).mkdir()
        write_record(tmp_path / name, written)
    (tmp_path / "bake-5").mkdir()  # of a version before records
    (tmp_path / "bake-6").mkdir()
    (tmp_path / "bake-6" / records.RECORD_FILE).write_text('{"schema": 99}')
    note_end(tmp_path / "bake-3", CANCELLED)
    claim = Claim.take(tmp_path / "bake-4")
    assert list(interrupted(tmp_path).items()) == [(tmp_path / "bake-2", kept), (tmp_path / "bake-1", record())]
    claim.release()
    assert read_record(tmp_path / "bake-3").state == CANCELLED
    note_end(tmp_path / "bake-5", CANCELLED)
    note_end(tmp_path / "absent", CANCELLED)
    assert kept.bake_settings() == SMALL
    with pytest.raises(PRTError, match="another version"):
        replace(kept, settings={**SMALL.as_dict(), "unheard_of": 1}).bake_settings()


def test_how_far_an_interrupted_bake_came(tmp_path: Path) -> None:
    folder = write_job(tmp_path, scene(), SMALL)
    assert reached(folder) == ("", 0, 0)
    steps = run_job(folder)
    for progress in steps:
        if progress.stage == "interreflection":
            break
    steps.close()
    assert reached(folder) == ("direct", 3, 5)
    drain(run_job(folder))
    assert reached(folder) == ("encode", 5, 5)


def started(folder: Path) -> BakeProcess:
    """The real child on a real job, in its last, long stage."""
    process = BakeProcess([sys.executable, "-I"], folder)
    process.start()
    deadline = time.monotonic() + 30.0
    while not any(message.get("stage") == "errors" for message in process.poll()):
        assert not process.finished and time.monotonic() < deadline
        time.sleep(0.02)
    return process


def end_of(process: BakeProcess, seconds: float) -> dict:
    """The last message, which has to come within so many seconds."""
    deadline = time.monotonic() + seconds
    while True:
        messages = process.poll()
        if process.finished:
            assert process.returncode is not None, "the child lives"
            return messages[-1]
        assert time.monotonic() < deadline, "nobody notices"
        time.sleep(0.02)


def test_a_deleted_folder_ends_the_bake_at_once(tmp_path: Path) -> None:
    process = started(write_job(tmp_path, scene(), LONG))
    shutil.rmtree(process.job)
    last = end_of(process, 2.0)
    assert last["type"] == "error" and "job folder was deleted" in last["cause"] and "bake again" in last["remedy"]
    process.cancel()
    assert not process.job.exists()


@pytest.mark.skipif(not hasattr(os, "geteuid"), reason="limits of POSIX")
def test_a_disk_too_full_for_messages_is_said_so(tmp_path: Path) -> None:
    """The child has no place left to say why it ends: its status says it."""
    import resource

    process = started(write_job(tmp_path, scene(), LONG))
    resource.prlimit(process.process.pid, resource.RLIMIT_FSIZE, (1, 1))
    last = end_of(process, 30.0)
    assert last["type"] == "error" and "disk is full" in last["cause"] and "space" in last["remedy"]
    assert not list(process.job.glob(".*.part"))


@pytest.mark.skipif(not hasattr(os, "geteuid"), reason="limits of POSIX")
def test_a_disk_too_full_for_a_stage_names_the_file(tmp_path: Path) -> None:
    import resource

    folder = write_job(tmp_path, scene(), SMALL)
    process = BakeProcess([sys.executable, "-I"], folder)
    process.start()
    resource.prlimit(process.process.pid, resource.RLIMIT_FSIZE, (4096, 4096))
    last = end_of(process, 30.0)
    assert last["type"] == "error" and "can't be written" in last["cause"] and "space" in last["remedy"], last
    assert str(folder) in last["subject"] and not list(folder.glob(".*.part"))


@pytest.mark.skipif(sys.platform == "win32", reason="signals of POSIX")
def test_cancel_does_not_wait_for_a_child_that_hangs(tmp_path: Path) -> None:
    process = started(write_job(tmp_path, scene(), LONG))
    process.process.send_signal(signal.SIGSTOP)
    begun = time.monotonic()
    process.cancel()
    assert time.monotonic() - begun < 1.0 and process.returncode is not None
