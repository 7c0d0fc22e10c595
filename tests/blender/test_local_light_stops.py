# SPDX-License-Identifier: GPL-3.0-or-later
"""A bake that is stopped among its local lights: nothing unfinished stays, and the next one goes on from there."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from tests.blender.test_local_light_bakes import make_room

TOOL = Path(__file__).parents[2] / "tools" / "prt.py"
# Few rays, many lights: most of the bake is the lamps' stage.
LONG = ["--preset", "draft", "--lighting", "local", "--set", "cloud_region=Region", "--set", "cloud_lights=200",
        "--set", "merge_response=0", "--set", "cloud_emission=1", "--set", "error_receivers=0", "--set", "spacing=0.02",
        "--set", "vectors=2", "--set", "clusters=8", "--set", "lamp_basis=cloud"]


def unfinished(job: Path) -> list[Path]:
    return [*job.glob("responses-*"), *job.glob(".*.part")]


@pytest.mark.skipif(sys.platform == "win32", reason="signals of POSIX")
def test_stopped_among_its_local_lights_a_bake_leaves_nothing_and_resumes(tmp_path: Path) -> None:
    """Interrupted, then killed without a chance to clean up, then left alone."""
    scene, output, report = make_room(tmp_path / "room.blend"), tmp_path / "baked.blend", tmp_path / "report.json"
    environment = {**os.environ, "BLENDER_USER_RESOURCES": str(tmp_path / "user")}
    command = [sys.executable, str(TOOL), "bake", "--input", str(scene), "--output", str(output), "--report",
               str(report), *LONG]
    for number in (signal.SIGINT, signal.SIGKILL):
        running = subprocess.Popen(command, stderr=subprocess.PIPE, text=True, env=environment)
        for line in running.stderr:
            if "Local lights" in line:
                break
        (job,) = (tmp_path / "user").rglob("bake-*")
        deadline = time.monotonic() + 20.0
        while not unfinished(job):  # until there is something to leave behind
            assert time.monotonic() < deadline and running.poll() is None
            time.sleep(0.01)
        running.send_signal(number)
        errors = running.communicate(timeout=30)[1]
        assert running.returncode == (3 if number == signal.SIGINT else -9), errors
        assert "Traceback" not in errors and not output.exists()
        while unfinished(job):  # of the killed one: its child notices and cleans up
            assert time.monotonic() < deadline, unfinished(job)
            time.sleep(0.05)
        assert {path.stem for path in job.glob("*.npz")} == {"scene", "gather", "direct", "interreflection"}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    assert json.loads(report.read_text())["resumed"] == ["gather", "direct", "interreflection"]
    assert not job.exists()
