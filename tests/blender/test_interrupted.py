# SPDX-License-Identifier: GPL-3.0-or-later
"""Interrupted bakes without an interface: who is offered what, resuming, scenes that changed, two Blenders at once."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import bpy
import pytest

ROOT = Path(__file__).parents[2]
TOOL = ROOT / "tools" / "prt.py"
FAST = ["--preset", "draft", "--set", "directions=64", "--set", "gather_directions=32", "--set", "spacing=0"]
LONG = ["--set", "error_receivers=16", "--set", "error_paths=65536"]

PREAMBLE = """
import importlib.util, sys, bpy
spec = importlib.util.spec_from_file_location("tool", sys.argv[1])
tool = importlib.util.module_from_spec(spec)
spec.loader.exec_module(tool)
tool.load_extension()
sys.modules["prt"].register()
from prt.operators import interrupted
from prt.operators.bake_session import jobs_folder
def offers():
    return [interrupted.offer_text(*item) for item in interrupted.offered().items()]
def jobs():
    return list(jobs_folder().glob("bake-*"))
def state():
    return bpy.context.window_manager.prt
"""


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    """A ball over a floor under a grey sky."""
    bpy.ops.wm.read_homefile(use_empty=True)
    bpy.context.scene.world = bpy.data.worlds.new("Sky")
    bpy.ops.mesh.primitive_uv_sphere_add(segments=12, ring_count=6, location=(0.0, 0.0, 1.2))
    bpy.context.object.name = "Ball"
    bpy.ops.mesh.primitive_grid_add(x_subdivisions=6, y_subdivisions=6, size=6.0)
    bpy.context.object.name = "Floor"
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "scene.blend"))
    return tmp_path / "scene.blend"


@pytest.fixture
def environment(tmp_path: Path) -> dict[str, str]:
    return {**os.environ, "BLENDER_USER_RESOURCES": str(tmp_path / "user")}


@pytest.fixture
def start(scene: Path, environment: dict[str, str]) -> Callable[..., subprocess.Popen[str]]:
    """Start a bake of the scene's file in a process of its own."""

    def run(output: str, *arguments: str) -> subprocess.Popen[str]:
        command = [sys.executable, str(TOOL), "bake", "--input", str(scene), "--output", str(scene.with_name(output))]
        return subprocess.Popen([*command, *FAST, *arguments], stderr=subprocess.PIPE, text=True, env=environment)

    return run


def in_last_stage(running: subprocess.Popen[str]) -> subprocess.Popen[str]:
    """The process, once all but the last stage is done."""
    for line in running.stderr:
        if "Measuring" in line:
            return running
    pytest.fail(f"the bake ended with {running.wait()}")


def killed(running: subprocess.Popen[str]) -> None:
    in_last_stage(running).send_signal(signal.SIGKILL)
    running.communicate(timeout=30)


def script(environment: dict[str, str], scene: Path, text: str) -> None:
    """Run lines in a process that has registered the extension; sys.argv[2] is the scene's file."""
    done = subprocess.run([sys.executable, "-c", PREAMBLE + text, str(TOOL), str(scene)], capture_output=True,
                          text=True, timeout=100, env=environment)
    assert done.returncode == 0, done.stdout + done.stderr


@pytest.mark.skipif(sys.platform == "win32", reason="signals of POSIX")
def test_a_killed_bake_is_offered_to_its_file_and_resumes(scene: Path, environment: dict[str, str],
                                                         start: Callable[..., subprocess.Popen[str]]) -> None:
    killed(start("out.blend", "--objects", "Ball", *LONG))
    script(environment, scene, """
assert not offers(), "offered to a file that was never saved"
bpy.ops.wm.open_mainfile(filepath=sys.argv[2])
assert offers() == ["A bake of Ball was interrupted after Bounced light (4 of 6 stages)"], offers()
before = {p.name: p.stat().st_mtime_ns for p in jobs()[0].glob("*.npz")}
from prt.operators import job_mixin
complete = job_mixin.JobMixin._complete
def stages_stand(self, context, job):
    now = {p.name: p.stat().st_mtime_ns for p in job.job.glob("*.npz")}
    assert before.items() <= now.items() and "result.npz" in now, (before, now)
    complete(self, context, job)
job_mixin.JobMixin._complete = stages_stand
assert bpy.ops.prt.resume() == {"FINISHED"}
assert "afresh" not in state().message and state().message.startswith("Baked Ball"), state().message
assert [m.name for m in bpy.data.meshes if "prt_header" in m] and "prt_header" not in bpy.data.objects["Floor"].data
assert not offers() and not jobs()
try:
    bpy.ops.prt.resume()
except RuntimeError as error:
    assert "no interrupted bake" in str(error)
else:
    raise AssertionError("resumed twice")
""")


@pytest.mark.skipif(sys.platform == "win32", reason="signals of POSIX")
def test_a_changed_scene_is_baked_afresh_and_a_discarded_bake_is_gone(
        scene: Path, environment: dict[str, str], start: Callable[..., subprocess.Popen[str]]) -> None:
    killed(start("out.blend", *LONG))
    script(environment, scene, """
bpy.ops.wm.open_mainfile(filepath=sys.argv[2])
assert len(offers()) == 1 and "Ball, Floor" in offers()[0], offers()
from prt.prt_addon.baking.claims import Claim
claim = Claim.take(jobs()[0])
assert not offers(), "offered while another process bakes it"
claim.release()
bpy.data.objects["Ball"].location.z = 2.0
bpy.context.view_layer.update()
kept = jobs()[0]
from prt.prt_addon.baking.record import read_record, write_record
record = read_record(kept)
assert bpy.ops.prt.resume() == {"FINISHED"}
assert "baked afresh" in state().message, state().message
assert not jobs() and not offers()
kept.mkdir()
write_record(kept, record)
assert len(offers()) == 1 and bpy.ops.prt.discard_interrupted() == {"FINISHED"} and not jobs()
kept.mkdir()
write_record(kept, record)
bpy.data.objects["Ball"].name = "Moon"
bpy.data.objects["Floor"].name = "Earth"
assert not offers(), "offered without any of its objects"
""")


@pytest.mark.skipif(sys.platform == "win32", reason="signals of POSIX")
def test_two_blenders_bake_one_file_at_once(scene: Path, start: Callable[..., subprocess.Popen[str]]) -> None:
    """Each ends well with a result of its own, equal to the other's; one that is killed takes nothing along."""
    short = ("--set", "error_receivers=16", "--set", "error_paths=65536")
    running = [in_last_stage(start(f"{name}.blend", *short)) for name in "ab"]
    third = in_last_stage(start("c.blend", *short))
    third.kill()
    third.communicate()
    for process in running:
        errors = process.communicate(timeout=100)[1]
        assert process.returncode == 0, errors
    bases = []
    for name in "ab":
        bpy.ops.wm.open_mainfile(filepath=str(scene.with_name(f"{name}.blend")))
        bases.append([list(m["prt_bases"]) for m in bpy.data.meshes if "prt_bases" in m])
    assert bases[0] and bases[0] == bases[1]
