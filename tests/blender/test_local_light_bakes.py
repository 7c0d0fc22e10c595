# SPDX-License-Identifier: GPL-3.0-or-later
"""Light clouds from the scene to the relit picture: stored, moved, against Cycles, beside an environment."""

from __future__ import annotations

import json
import sys
import types
from pathlib import Path

import bpy
import numpy as np
import pytest
from blender.cycles import diffuse_material, use_cycles, vertex_radiance

ROOT = Path(__file__).parents[2]
if "prt" not in sys.modules:  # the checkout as a package, as tools/prt.py loads it, without registering anything
    sys.modules["prt"] = types.ModuleType("prt")
    sys.modules["prt"].__path__ = [str(ROOT)]

FAST = ["--preset", "draft", "--set", "directions=1024", "--set", "gather_directions=512", "--set", "spacing=0",
        "--set", "error_receivers=0", "--set", "bounce_error=1e-3", "--set", "compression_error=1e-3",
        "--set", "encoder=iterative", "--set", "vectors=12", "--set", "cloud_lights=125",
        "--set", "merge_response=0.01", "--set", "zone_receivers=200", "--set", "lamp_basis=cloud"]
LAMP = (0.22, -0.13, 1.31)
CELLS = 10


def run(*arguments: object) -> int:
    """The command's exit code, in this process."""
    from prt.operators.commands import main

    return main([str(a) for a in arguments])


def add_wall(name: str, corner: tuple, side_u: tuple, side_v: tuple, colour: tuple) -> bpy.types.Object:
    """A grid whose face looks towards side_u x side_v."""
    u, v = np.meshgrid(*(np.linspace(0.0, 1.0, CELLS + 1),) * 2, indexing="ij")
    points = np.asarray(corner) + u[..., None] * np.asarray(side_u) + v[..., None] * np.asarray(side_v)
    row = CELLS + 1
    faces = [(i * row + j, (i + 1) * row + j, (i + 1) * row + j + 1, i * row + j + 1)
             for i in range(CELLS) for j in range(CELLS)]
    mesh = bpy.data.meshes.new(name)
    mesh.from_pydata(points.reshape(-1, 3).tolist(), [], faces)
    mesh.materials.append(diffuse_material(name, (*colour, 1.0)))
    wall = bpy.data.objects.new(name, mesh)
    bpy.context.scene.collection.objects.link(wall)
    return wall


def make_room(path: Path, lamp: bool = True, sky: bool = False) -> Path:
    """A room open in front, red at its left, with a Point light in a region of lights."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    white = (0.7, 0.7, 0.7)
    add_wall("Floor", (-1, -1, 0), (2, 0, 0), (0, 2, 0), white)
    add_wall("Back", (-1, 1, 0), (2, 0, 0), (0, 0, 2), white)
    add_wall("Left", (-1, -1, 0), (0, 2, 0), (0, 0, 2), (0.7, 0.1, 0.1))
    add_wall("Right", (1, -1, 0), (0, 0, 2), (0, 2, 0), white)
    if lamp:
        data = bpy.data.lights.new("Lamp", "POINT")
        data.energy, data.shadow_soft_size = 20.0, 0.0
        source = bpy.data.objects.new("Lamp", data)
        source.location = LAMP
        bpy.context.scene.collection.objects.link(source)
    region = bpy.data.objects.new("Region", None)
    region.empty_display_type, region.location = "CUBE", (0.0, 0.0, 1.0)
    bpy.context.scene.collection.objects.link(region)
    world = bpy.data.worlds.new("World")
    world.node_tree.nodes["Background"].inputs["Color"].default_value = (0.4, 0.6, 1.0, 1.0) if sky else (0, 0, 0, 1)
    bpy.context.scene.world = world
    bpy.ops.wm.save_as_mainfile(filepath=str(path))
    return path


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("local")


@pytest.fixture(scope="module")
def baked(folder: Path) -> Path:
    """The room baked for local lights."""
    scene, output = make_room(folder / "room.blend"), folder / "baked.blend"
    assert run("bake", "--input", scene, "--output", output, "--report", folder / "report.json", "--lighting", "local",
               "--set", "cloud_region=Region", *FAST) == 0
    return output


def relit(baked: Path, *arguments: object) -> dict[str, np.ndarray]:
    """The arrays of `relight`."""
    output = baked.with_suffix(".npz")
    assert run("relight", "--input", baked, "--output", output, *arguments) == 0
    with np.load(output, allow_pickle=False) as arrays:
        return dict(arrays)


def moved(baked: Path, name: str, **changes: object) -> Path:
    """A copy of the file whose lamp was changed after the bake."""
    bpy.ops.wm.open_mainfile(filepath=str(baked))
    lamp = bpy.data.objects["Lamp"]
    for key, value in changes.items():
        setattr(lamp.data if hasattr(lamp.data, key) else lamp, key, value)
    copy = baked.with_name(f"{name}.blend")
    bpy.ops.wm.save_as_mainfile(filepath=str(copy), copy=True)
    return copy


def test_the_measured_error_is_told(folder: Path, capfd: pytest.CaptureFixture[str]) -> None:
    for lighting in ("local", "environment,local"):
        scene, report, page = make_room(folder / "told.blend", sky=True), folder / "told.json", folder / "told.html"
        assert run("bake", "--input", scene, "--output", folder / "told_baked.blend", "--lighting", lighting,
                   "--report", report, *FAST, "--set", "error_receivers=8", "--set", "error_paths=512",
                   "--set", "cloud_lights=27") == 0
        assert "bounced light of lamps" in capfd.readouterr().err
        told = json.loads(report.read_text())
        key = "errors" if lighting == "local" else "local_errors"
        assert set(told[key]) == set(told["errors"]) == {"sampling", "basis", "compression", "total"}
        assert run("report", "--input", report, "--output", page) == 0
        assert "Bounced light of lamps" in page.read_text() and "Light cloud" in page.read_text()


def test_report_and_header_tell_of_the_cloud(baked: Path, folder: Path) -> None:
    report = json.loads((folder / "report.json").read_text())
    local = report["local"]
    assert 60 <= local["lights"] <= 125 and local["zones"] >= 2 and max(local["merged"]) <= local["lights"]
    bpy.ops.wm.open_mainfile(filepath=str(baked))
    header = json.loads(bpy.data.objects["Floor"].data["prt_header"])
    assert header["schema"] == 3 and header["columns"]["kind"] == "light_cloud"
    assert header["shape"][3] == header["columns"]["columns"]
    assert len(header["columns"]["cluster_zone"]) == header["shape"][0]


def test_a_lamp_moved_after_the_bake_matches_cycles(baked: Path, folder: Path) -> None:
    """At a place that no light of the cloud has: direct and bounced light together, in Blender's units."""
    place = (-0.31, 0.18, 0.87)
    copy = moved(baked, "moved", location=place, energy=31.0)
    ours = relit(copy, "--use-scene-lights")
    bpy.ops.wm.open_mainfile(filepath=str(folder / "room.blend"))
    lamp = bpy.data.objects["Lamp"]
    lamp.location, lamp.data.energy = place, 31.0
    use_cycles(256)
    # Away from the edges between walls, where a vertex of Cycles' bake stands in both.
    inner = np.zeros((CELLS + 1, CELLS + 1), bool)
    inner[1:-1, 1:-1] = True
    for name in ("Floor", "Left"):
        truth = vertex_radiance(bpy.data.objects[name], {"DIRECT", "INDIRECT"})[inner.ravel()]
        bounced = vertex_radiance(bpy.data.objects[name], {"INDIRECT"})[inner.ravel()]
        mine = ours["object"] == name
        found = (ours["radiance"][mine] / ours["albedo"][mine])[:(CELLS + 1) ** 2][inner.ravel()]
        difference = np.sqrt(np.sum((found - truth) ** 2))
        assert difference < 0.02 * np.sqrt(np.sum(truth ** 2))
        assert difference < 0.12 * np.sqrt(np.sum(bounced ** 2))
        assert abs(found.mean() / truth.mean() - 1.0) < 0.02


def test_power_and_colour_scale_and_a_lamp_switched_off_is_dark(baked: Path) -> None:
    before = relit(baked, "--use-scene-lights")["radiance"]
    assert before.min() >= 0.0 and before.max() > 0.1
    double = relit(moved(baked, "double", energy=40.0), "--use-scene-lights")["radiance"]
    assert np.allclose(double, 2.0 * before, rtol=1e-5, atol=1e-6)
    red = relit(moved(baked, "red", color=(1.0, 0.0, 0.0)), "--use-scene-lights")["radiance"]
    assert np.allclose(red[:, 0], before[:, 0], rtol=1e-5, atol=1e-6) and not red[:, 1:].any()
    assert not relit(moved(baked, "off", hide_render=True), "--use-scene-lights")["radiance"].any()
    assert not relit(baked)["radiance"].any()  # without scene lights: the world is black


def test_a_lamp_outside_the_cloud_is_named(baked: Path, capfd: pytest.CaptureFixture[str]) -> None:
    far = relit(moved(baked, "far", location=(0.0, -30.0, 1.0)), "--use-scene-lights")["radiance"]
    assert "Lamp: outside the light cloud" in capfd.readouterr().err
    assert np.isfinite(far).all() and far.max() > 0.0


def test_both_kinds_of_light_are_the_sum_of_each(folder: Path, baked: Path) -> None:
    scene = make_room(folder / "sky.blend", sky=True)
    both, only = folder / "both.blend", folder / "environment.blend"
    assert run("bake", "--input", scene, "--output", both, "--lighting", "environment,local", "--set",
               "cloud_region=Region", *FAST) == 0
    assert run("bake", "--input", scene, "--output", only, *FAST) == 0
    sky, everything = relit(both)["radiance"], relit(both, "--use-scene-lights")["radiance"]
    alone, lamp = relit(only)["radiance"], relit(baked, "--use-scene-lights")["radiance"]
    assert np.sqrt(np.mean((sky - alone) ** 2)) < 0.005 * np.sqrt(np.mean(alone ** 2))
    assert np.sqrt(np.mean((everything - sky - lamp) ** 2)) < 0.01 * np.sqrt(np.mean(lamp ** 2))


def test_without_lamps_the_local_part_is_left_out(folder: Path) -> None:
    scene, output = make_room(folder / "dark.blend", lamp=False, sky=True), folder / "dark_baked.blend"
    report = folder / "dark.json"
    assert run("bake", "--input", scene, "--output", output, "--lighting", "environment,local", "--report", report,
               *FAST) == 0
    told = json.loads(report.read_text())
    assert "local" not in told and any("no lamp" in line for line in told["scene"]["warnings"])
    assert relit(output)["radiance"].max() > 0.1


@pytest.mark.parametrize("region, words", [("Nothing", "no object or collection"), ("Lamp", "no box empty")])
def test_a_wrong_region_is_refused_in_one_line(folder: Path, region: str, words: str,
                                               capfd: pytest.CaptureFixture[str]) -> None:
    scene = make_room(folder / "region.blend")
    assert run("bake", "--input", scene, "--output", folder / "none.blend", "--lighting", "local", "--set",
               f"cloud_region={region}", *FAST) == 1
    line = capfd.readouterr().err.strip().splitlines()[-1]
    assert region in line and words in line and not (folder / "none.blend").exists()


@pytest.mark.parametrize("lighting, key, basis, words", [
    ("environment", "errors", 0.01, "(diffuse)"), ("environment", "errors", 0.09, "sharper than the order"),
    ("local", "errors", 0.09, "few columns"), ("environment,local", "local_errors", 0.09, "few columns")])
def test_the_message_after_a_bake_knows_what_was_measured(lighting: str, key: str, basis: float, words: str) -> None:
    from prt.operators.bake_session import baked_message

    errors = {"basis": {"relative_rms": basis}, "total": {"relative_rms": 0.1}}
    report = {"clusters": {"count": 3}, "settings": {"lighting": lighting}, "errors": {}, "highlight_errors": {},
              key: errors}
    message = baked_message(types.SimpleNamespace(objects={"Cube": None}, report=report), 1.5)
    assert message.startswith("Baked Cube in 1.5 s, 3 clusters. Total error 10 %") and words in message
