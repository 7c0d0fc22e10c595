# SPDX-License-Identifier: GPL-3.0-or-later
"""The command line as scripts use it: results, exit codes, one line per error, and files that stay unharmed."""

from __future__ import annotations

import hashlib
import json
import os
import signal
import subprocess
import sys
import types
from collections.abc import Callable
from pathlib import Path

import bpy
import numpy as np
import pytest

ROOT = Path(__file__).parents[2]
TOOL = ROOT / "tools" / "prt.py"
FAST = ["--preset", "draft", "--set", "directions=64", "--set", "gather_directions=32", "--set", "spacing=0",
        "--set", "error_receivers=0"]

if "prt" not in sys.modules:  # the checkout as a package, as tools/prt.py loads it, without registering anything
    sys.modules["prt"] = types.ModuleType("prt")
    sys.modules["prt"].__path__ = [str(ROOT)]


def run(*arguments: object) -> int:
    """The command's exit code, in this process."""
    from prt.operators.commands import main

    return main([str(a) for a in arguments])


def program(*arguments: object) -> subprocess.CompletedProcess[str]:
    """The command in a process of its own."""
    return subprocess.run([sys.executable, str(TOOL), *(str(a) for a in arguments)], capture_output=True, text=True,
                          timeout=120)


def digest(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def make_scene(path: Path, edit: Callable[[], None] | None = None) -> Path:
    """A smooth ball over a red floor under a uniform sky with a Sun and a camera."""
    bpy.ops.wm.read_homefile(use_empty=True)
    world = bpy.data.worlds.new("Sky")
    world.node_tree.nodes["Background"].inputs["Color"].default_value = (0.5, 0.7, 1.0, 1.0)
    bpy.context.scene.world = world
    bpy.ops.mesh.primitive_uv_sphere_add(segments=16, ring_count=8, location=(0.0, 0.0, 1.2))
    bpy.context.object.name = "Ball"
    bpy.ops.object.shade_smooth()
    bpy.ops.mesh.primitive_grid_add(x_subdivisions=8, y_subdivisions=8, size=6.0)
    bpy.context.object.name = "Floor"
    red = bpy.data.materials.new("Red")
    red.node_tree.nodes["Principled BSDF"].inputs["Base Color"].default_value = (0.8, 0.1, 0.1, 1.0)
    bpy.context.object.data.materials.append(red)
    bpy.ops.object.light_add(type="SUN", rotation=(0.5, 0.2, 0.0))
    bpy.context.object.name = "Sun"
    bpy.ops.object.camera_add(location=(0.0, -8.0, 4.0), rotation=(1.15, 0.0, 0.0))
    bpy.context.scene.camera = bpy.context.object
    if edit:
        edit()
    bpy.ops.wm.save_as_mainfile(filepath=str(path))
    return path


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_scene(tmp_path_factory.mktemp("commands") / "scene.blend")


@pytest.fixture(scope="module")
def baked(scene: Path) -> Path:
    """The scene baked by the program, which leaves nothing on stdout but the paths and does not touch its input."""
    before, output, report = digest(scene), scene.with_name("baked.blend"), scene.with_name("report.json")
    done = program("bake", "--input", scene, "--output", output, "--report", report, *FAST,
                   "--set", "error_receivers=8")
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines() == [str(output), str(report)]
    assert "prt: " in done.stderr and "%" in done.stderr  # progress
    assert digest(scene) == before
    return output


def relit(baked: Path, output: Path, *arguments: object) -> dict[str, np.ndarray]:
    assert run("relight", "--input", baked, "--output", output, *arguments) == 0
    with np.load(output, allow_pickle=False) as arrays:
        return dict(arrays)


def test_analyze_prints_json_and_changes_nothing(scene: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = digest(scene), sorted(scene.parent.iterdir())
    assert run("analyze", "--input", scene, "--set", "bounces=0") == 0
    text = capsys.readouterr().out
    found = json.loads(text[text.index("{"):])
    assert found["left_out"] and found["seconds"] and found["stored_bytes"]
    assert (digest(scene), sorted(scene.parent.iterdir())) == before


@pytest.mark.parametrize("lighting", ["environment", "local", "environment,local", "local,environment"])
def test_every_kind_of_lighting_is_taken(lighting: str, scene: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """In any order, with the cost of what will be done: this scene has no lamp, and names no region for one."""
    assert run("analyze", "--input", scene, "--lighting", lighting, *FAST) == 0
    text = capsys.readouterr().out
    found = json.loads(text[text.index("{"):])
    assert ("local" in found["stages"]) == (lighting == "local")
    assert any("no lamp" in warning for warning in found["warnings"]) == ("," in lighting)


def test_relight_gives_the_promised_arrays(baked: Path, tmp_path: Path) -> None:
    arrays = relit(baked, tmp_path / "c.npz")
    points = len(arrays["radiance"])
    assert set(arrays) == {"radiance", "position", "normal", "albedo", "object"}
    assert all(arrays[name].shape == (points, 3) and arrays[name].dtype == np.float32
               for name in ("radiance", "position", "normal", "albedo"))
    assert set(arrays["object"]) == {"Ball", "Floor"} and arrays["object"].shape == (points,)
    # Half the sky lights the top of the ball fully: radiance = albedo * sky there.
    top = np.flatnonzero(arrays["object"] == "Ball")[np.argmax(arrays["position"][arrays["object"] == "Ball"][:, 2])]
    assert arrays["radiance"][top] == pytest.approx(arrays["albedo"][top] * (0.5, 0.7, 1.0), rel=0.02)


def test_relight_adds_suns_only_when_asked(baked: Path, tmp_path: Path) -> None:
    without, with_sun = relit(baked, tmp_path / "a.npz"), relit(baked, tmp_path / "b.npz", "--use-scene-lights")
    assert with_sun["radiance"].mean() > without["radiance"].mean() * 1.2


def test_rotation_of_a_uniform_sky_changes_nothing(baked: Path, tmp_path: Path) -> None:
    turned = relit(baked, tmp_path / "b.npz", "--rotate", "77.5")
    assert turned["radiance"] == pytest.approx(relit(baked, tmp_path / "a.npz")["radiance"], abs=1e-4)


def test_data_sits_where_the_contract_says(baked: Path) -> None:
    """The receivers are the vertices here, so everything is on the objects' own meshes."""
    bpy.ops.wm.open_mainfile(filepath=str(baked))
    mesh = bpy.data.objects["Ball"].data
    header = json.loads(mesh["prt_header"])
    clusters, representatives, *_ = header["shape"]
    weights = [a for a in mesh.attributes if a.name.startswith("prt_weights_")]
    assert mesh.attributes["prt_cluster"].data_type == "INT" and mesh.attributes["prt_cluster"].domain == "POINT"
    assert len(weights) == -(-(representatives - 1) // 4) and {a.data_type for a in weights} == {"FLOAT4"}
    assert len(mesh["prt_bases"]) == np.prod(header["shape"]) and clusters >= 1
    assert not [o for o in bpy.data.objects if o.name.startswith("PRT ")]


def test_report_and_export(baked: Path, tmp_path: Path) -> None:
    report = baked.with_name("report.json")
    stored = json.loads(report.read_text())
    assert {"schema", "scene", "settings", "seconds", "peak_bytes", "rays", "rays_per_second", "stages", "left_out",
            "errors", "clusters", "stability"} <= set(stored)
    assert run("report", "--input", report, "--output", tmp_path / "r.html") == 0
    page = (tmp_path / "r.html").read_text()
    assert "<svg" in page and "<script src" not in page
    assert run("export", "--input", baked, "--output", tmp_path / "out") == 0
    index = json.loads((tmp_path / "out" / "baked.json").read_text())
    with np.load(tmp_path / "out" / index["objects"][0]["file"]) as arrays:
        assert set(arrays) == set(index["arrays"]) and list(arrays["bases"].shape) == index["objects"][0]["header"][
            "shape"]


def test_preview_draws_a_picture(baked: Path, tmp_path: Path) -> None:
    output = tmp_path / "p.png"
    code = run("preview", "--input", baked, "--output", output, "--size", "64x48")
    if code == 1:
        pytest.skip("no graphics driver")
    image = bpy.data.images.load(str(output))
    assert code == 0 and tuple(image.size) == (64, 48) and max(image.pixels[:]) > 0.2


def test_the_operator_stores_what_the_command_stores(scene: Path, tmp_path: Path) -> None:
    """Two ways, one bake: bit for bit. The operator leaves nothing running, clear and unregister nothing behind."""
    import prt.prt_addon.blender.stored as stored

    paths = [tmp_path / "operator.blend", tmp_path / "command.blend"]
    done = subprocess.run([sys.executable, "-c", OPERATOR, str(TOOL), str(scene), *map(str, paths)],
                          capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stdout + done.stderr
    found = []
    for path in paths:
        bpy.ops.wm.open_mainfile(filepath=str(path))
        found.append({o.name: stored.read_baked(o) for o in stored.baked_objects(bpy.context.scene)})
    assert set(found[0]) == set(found[1]) == {"Ball", "Floor"}
    for name, transfer in found[0].items():
        for array in ("bases", "weights", "cluster", "albedo", "positions"):
            assert np.array_equal(getattr(transfer, array), getattr(found[1][name], array)), (name, array)


OPERATOR = """
import importlib.util, sys, bpy
spec = importlib.util.spec_from_file_location("tool", sys.argv[1])
tool = importlib.util.module_from_spec(spec)
spec.loader.exec_module(tool)
tool.load_extension()
sys.modules["prt"].register()
bpy.ops.wm.open_mainfile(filepath=sys.argv[2])
settings = bpy.context.scene.prt
assert settings.overrides() == {}
settings.preset = "draft"
assert settings.overrides() == {} and settings.glossy_rows == "9"
settings.glossy_rows, settings.glossy_albedo, settings.coherence, settings.subsurface = "4", 0.3, 0.05, False
assert settings.overrides() == {"glossy_rows": "4", "coherence": "0.05", "subsurface": "False"}
assert bpy.ops.prt.bake(overrides="directions=64, coherence=0.1") == {"FINISHED"}
import json
header = json.loads(next(m for m in bpy.data.meshes if "prt_header" in m)["prt_header"])
used = header["settings"]
assert (used["directions"], used["coherence"], used["glossy_rows"], used["subsurface"]) == (64, 0.1, 4, False)
assert header["coherence"]["both"] <= header["coherence"]["before"]
settings.preset = "standard"
assert settings.overrides() == {"coherence": "0.05", "subsurface": "False"}  # the scene's own, whatever the preset
settings.coherence, settings.subsurface = 0.0, True
assert settings.overrides() == {}
settings.preset = "draft"
assert bpy.ops.prt.bake() == {"FINISHED"}
assert not bpy.context.window_manager.prt.running
bpy.ops.wm.save_as_mainfile(filepath=sys.argv[3])
assert bpy.ops.prt.clear() == {"FINISHED"}
assert not [m for m in bpy.data.meshes if "prt_header" in m]
from prt.operators.commands import main
assert main(["bake", "--preset", "draft", "--input", sys.argv[2], "--output", sys.argv[4]]) == 0
sys.modules["prt"].unregister()
assert not hasattr(bpy.types.Scene, "prt")
"""


@pytest.mark.parametrize("arguments", [
    [], ["dance"], ["bake"], ["bake", "--input", "a.blend"], ["analyze", "--input", "absent.blend"],
    ["analyze", "--input", "SCENE", "--preset", "best"], ["analyze", "--input", "SCENE", "--set", "order"],
    ["analyze", "--input", "SCENE", "--set", "order=11"], ["analyze", "--input", "SCENE", "--set", "colour=red"],
    ["analyze", "--input", "SCENE", "--lighting", "moon"], ["analyze", "--input", "SCENE", "--lighting", ""],
    ["analyze", "--input", "SCENE", "--lighting", "local,"], ["analyze", "--inp", "SCENE"],
    ["bake", "--input", "SCENE", "--output", "SCENE"], ["bake", "--input", "SCENE", "--output", "x.txt"],
    ["preview", "--input", "SCENE", "--output", "x.png", "--size", "64"],
    ["relight", "--input", "SCENE", "--output", "x.npz", "--rotate", "north"],
    ["report", "--input", "absent.json", "--output", "x.html"],
])
def test_bad_arguments_are_one_line_and_exit_2(arguments: list[str], scene: Path, tmp_path: Path,
                                               monkeypatch: pytest.MonkeyPatch,
                                               capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.chdir(tmp_path)
    assert run(*(str(scene) if a == "SCENE" else a for a in arguments)) == 2
    captured = capsys.readouterr()
    assert len([line for line in captured.err.splitlines() if line.startswith("prt")]) == 1
    assert "Traceback" not in captured.err and not list(tmp_path.iterdir())


def _no_faces() -> None:
    bpy.data.objects["Ball"].data.clear_geometry()


def _nan() -> None:
    bpy.data.objects["Ball"].data.vertices[3].co.x = float("nan")


def _hidden() -> None:
    bpy.data.objects["Ball"].hide_render = True


@pytest.mark.parametrize(("edit", "arguments", "words"), [
    (_no_faces, ["--objects", "Ball"], "Ball: "),
    (_nan, [], "Ball: "),
    (_hidden, ["--objects", "Ball"], "Ball: "),
    (None, ["--objects", "Baal"], "Baal: "),
    (None, ["--output", "/absent/x.blend"], "no such folder"),
], ids=["no faces", "NaN", "hidden", "misspelt", "missing folder"])
def test_bad_scenes_are_one_line_and_exit_1(edit: Callable[[], None] | None, arguments: list[str], words: str,
                                            tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    source, output = make_scene(tmp_path / "bad.blend", edit), tmp_path / "out.blend"
    output.write_bytes(b"a previous result")
    before = digest(source), sorted(tmp_path.iterdir())
    assert run("bake", "--input", source, "--output", output, *FAST, *arguments) == 1
    lines = [line for line in capsys.readouterr().err.splitlines() if line.startswith("prt: ")]
    assert words in lines[-1]
    assert output.read_bytes() == b"a previous result" and (digest(source), sorted(tmp_path.iterdir())) == before


def test_read_only_outputs_are_refused_before_the_work(scene: Path, tmp_path: Path,
                                                       capsys: pytest.CaptureFixture[str]) -> None:
    output = tmp_path / "kept.blend"
    output.write_bytes(b"precious")
    output.chmod(0o444)
    assert run("bake", "--input", scene, "--output", output, *FAST) == 1
    assert "read-only" in capsys.readouterr().err and output.read_bytes() == b"precious"
    folder = tmp_path / "closed"
    folder.mkdir()
    folder.chmod(0o555)
    assert run("relight", "--input", scene, "--output", folder / "x.npz") == 1
    assert "read-only" in capsys.readouterr().err
    folder.chmod(0o755)


def test_a_file_that_is_no_blend_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    source = tmp_path / "text.blend"
    source.write_text("no blend file")
    assert run("analyze", "--input", source) == 1
    assert "text.blend" in capsys.readouterr().err


def test_unbaked_and_stale_scenes_are_refused(scene: Path, baked: Path, tmp_path: Path,
                                              capsys: pytest.CaptureFixture[str]) -> None:
    assert run("relight", "--input", scene, "--output", tmp_path / "x.npz") == 1
    assert "no object in it is baked" in capsys.readouterr().err
    bpy.ops.wm.open_mainfile(filepath=str(baked))
    bpy.data.objects["Ball"].data.vertices[0].co.z += 0.5
    edited = tmp_path / "edited.blend"
    bpy.ops.wm.save_as_mainfile(filepath=str(edited))
    assert run("relight", "--input", edited, "--output", tmp_path / "x.npz") == 1
    assert "stale" in capsys.readouterr().err and not (tmp_path / "x.npz").exists()


def test_a_newer_schema_is_refused(baked: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bpy.ops.wm.open_mainfile(filepath=str(baked))
    for mesh in bpy.data.meshes:
        if "prt_header" in mesh:
            mesh["prt_header"] = json.dumps({**json.loads(mesh["prt_header"]), "schema": 99})
    newer = tmp_path / "newer.blend"
    bpy.ops.wm.save_as_mainfile(filepath=str(newer))
    assert run("relight", "--input", newer, "--output", tmp_path / "x.npz") == 1
    assert "schema 99" in capsys.readouterr().err


@pytest.mark.skipif(sys.platform == "win32", reason="signals of POSIX")
@pytest.mark.parametrize("kill", [signal.SIGINT, signal.SIGKILL])
def test_an_interrupted_bake_changes_nothing_and_resumes(kill: signal.Signals, scene: Path, tmp_path: Path) -> None:
    """Interrupted when the last stage has begun; the next run starts after the finished ones."""
    output, report = tmp_path / "out.blend", tmp_path / "report.json"
    environment = {**os.environ, "BLENDER_USER_RESOURCES": str(tmp_path / "user")}
    command = [sys.executable, str(TOOL), "bake", "--input", str(scene), "--output", str(output), "--report",
               str(report), *FAST, "--set", "error_receivers=256", "--set", "error_paths=65536"]
    running = subprocess.Popen(command, stderr=subprocess.PIPE, text=True, env=environment)
    for line in running.stderr:
        if "Measuring" in line:
            break
    running.send_signal(kill)
    errors = running.communicate(timeout=30)[1]
    assert running.returncode == (-9 if kill == signal.SIGKILL else 3), errors
    assert "Traceback" not in errors and not output.exists() and not report.exists()
    assert kill == signal.SIGKILL or "resume" in errors
    jobs = list((tmp_path / "user").rglob("bake-*"))
    assert len(jobs) == 1 and list(jobs[0].glob("*.npz"))
    finished = {path.name: path.stat().st_mtime_ns for path in jobs[0].glob("*.npz")}
    running = subprocess.Popen(command, stderr=subprocess.PIPE, text=True, env=environment)
    for line in running.stderr:
        if "Measuring" in line:
            break
    assert {name: (jobs[0] / name).stat().st_mtime_ns for name in finished} == finished, "finished stages ran again"
    running.terminate()
    running.communicate(timeout=30)
