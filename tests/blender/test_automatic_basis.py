# SPDX-License-Identifier: GPL-3.0-or-later
"""The automatic sky through commands and panel: Analyze tells what it takes and why, the bake takes the same."""

from __future__ import annotations

import json
from pathlib import Path

import bpy
import pytest

from tests.blender.test_commands import make_scene, run

FAST = ["--preset", "draft", "--set", "directions=256", "--set", "gather_directions=64", "--set", "spacing=0.06",
        "--set", "error_receivers=0", "--set", "distant_basis=auto", "--set", "encoder=auto"]


def dim_sky() -> None:
    """So that the Sun is nearly all light."""
    bpy.context.scene.world.node_tree.nodes["Background"].inputs["Strength"].default_value = 0.05


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_scene(tmp_path_factory.mktemp("automatic") / "scene.blend", dim_sky)


def analysis(capsys: pytest.CaptureFixture[str], scene: Path, *more: str) -> dict:
    assert run("analyze", "--input", scene, *FAST, *more) == 0
    text = capsys.readouterr().out
    return json.loads(text[text.index("{"):])


def test_analyze_says_what_and_why(scene: Path, capsys: pytest.CaptureFixture[str]) -> None:
    sharp = analysis(capsys, scene, "--set", "light_error=0.04")
    assert sharp["choice"]["chosen"]["distant_basis"] == "cubemap" and "order" not in sharp["needs"]
    size = sharp["needs"]["cubemap_size"]
    assert sharp["needs"]["columns"] == 6 * size * size == 6 * sharp["choice"]["chosen"]["cubemap_size"] ** 2
    assert sharp["basis"].startswith(f"Sky by a cubemap of 6 x {size} x {size} texels")
    assert any(item["what"].startswith("sparse sampling") for item in sharp["left_out"])
    soft = analysis(capsys, scene, "--set", "light_error=0.5")
    assert soft["needs"]["order"] == 3 and soft["needs"]["columns"] == 9
    assert soft["choice"]["line"].startswith("Sky by spherical harmonics of order 3: about ")


def test_the_bake_takes_what_analyze_told(scene: Path, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    told = analysis(capsys, scene, "--set", "light_error=0.15")["choice"]
    report, output = tmp_path / "r.json", tmp_path / "b.blend"
    assert run("bake", "--input", scene, "--output", output, "--report", report, *FAST, "--set",
               "light_error=0.15") == 0
    found = json.loads(report.read_text())
    assert found["choice"]["line"] == told["line"] and found["choice"]["chosen"] == told["chosen"]
    assert found["settings"]["distant_basis"] == told["chosen"]["distant_basis"]
    bpy.ops.wm.open_mainfile(filepath=str(output))
    header = json.loads(next(mesh for mesh in bpy.data.meshes if "prt_header" in mesh)["prt_header"])
    assert "auto" not in (header["settings"]["distant_basis"], header["settings"]["encoder"])
    assert run("relight", "--input", output, "--output", tmp_path / "l.npz") == 0


@pytest.mark.parametrize(("more", "line"), [
    (["--set", "distant_basis=sh", "--set", "order=4"], "Sky by spherical harmonics of order 4: 16 columns"),
    (["--set", "distant_basis=cubemap", "--set", "encoder=static"],
     "Sky by a cubemap of 6 x 16 x 16 texels: 1\u202f536 columns"),
])
def test_what_is_set_by_hand_is_told_as_well(scene: Path, capsys: pytest.CaptureFixture[str], more: list[str],
                                             line: str) -> None:
    found = analysis(capsys, scene, *more)
    assert found["choice"] is None and found["basis"] == line
    from prt.operators.bake_session import analysis_lines

    assert line in analysis_lines(found)


def test_local_light_alone_has_no_sky(scene: Path, capsys: pytest.CaptureFixture[str]) -> None:
    found = analysis(capsys, scene, "--lighting", "local")
    assert found["basis"] == "" and found["choice"] is None
    assert not {"order", "cubemap_size", "columns"} & set(found["needs"])


def test_a_sharp_light_is_told_where_harmonics_are_set_by_hand(scene: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Nothing changes by itself; Analyze says what is lost, what would be taken, and is silent where enough is kept."""
    by_hand = ["--set", "distant_basis=sh", "--set", "encoder=static"]
    sharp = analysis(capsys, scene, *by_hand, "--set", "light_error=0.04")
    chosen = analysis(capsys, scene, "--set", "encoder=static", "--set", "light_error=0.04")["choice"]["chosen"]
    advice = next(hint for hint in sharp["hints"] if "Automatic" in hint)
    assert "lost with spherical harmonics of order 4" in advice and f"would take {chosen['name']}" in advice
    assert sharp["needs"]["order"] == 4 and sharp["choice"] is None
    soft = analysis(capsys, scene, *by_hand, "--set", "light_error=0.5")
    assert not any("Automatic" in hint for hint in soft["hints"])
