# SPDX-License-Identifier: GPL-3.0-or-later
"""The comparison with Cycles: two ways to one picture agree, and a wrong light is told as what it is."""

from __future__ import annotations

import json
import math
import time
from pathlib import Path

import bpy
import numpy as np
import pytest

from tests.blender.cycles import diffuse_material, environment_world, smooth_environment
from tests.blender.gpu_support import require_gpu
from tests.blender.scenes import user_data_lines
from tests.blender.test_commands import run

SIZE = (96, 64)


@pytest.fixture(scope="module")
def baked(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Lambertian things on a floor under a smooth sky and a lamp-like box that is not baked, at high quality."""
    require_gpu()
    folder = tmp_path_factory.mktemp("compare")
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.ops.mesh.primitive_torus_add(location=(0, 0, 0.7), rotation=(0.5, 0.3, 0.0), major_segments=36,
                                     minor_segments=18, major_radius=0.6, minor_radius=0.3)
    bpy.context.object.name = "Ring"
    bpy.ops.object.shade_smooth()
    bpy.ops.mesh.primitive_grid_add(x_subdivisions=40, y_subdivisions=40, size=4.0)
    bpy.context.object.name = "Floor"
    bpy.ops.mesh.primitive_cube_add(size=0.4, location=(1.0, -0.8, 0.2))
    bpy.context.object.name = "Box"
    for name, colour in (("Ring", (0.8, 0.25, 0.1, 1)), ("Floor", (0.6, 0.7, 0.8, 1)), ("Box", (0.2, 0.2, 0.2, 1))):
        bpy.data.objects[name].data.materials.append(diffuse_material(name, colour))
    environment_world(smooth_environment(), 30.0, folder)
    bpy.ops.object.camera_add(location=(0.0, -4.5, 3.2), rotation=(math.radians(57), 0.0, 0.0))
    scene = bpy.context.scene
    scene.camera = bpy.context.object
    scene.render.resolution_x, scene.render.resolution_y = SIZE
    bpy.ops.wm.save_as_mainfile(filepath=str(folder / "scene.blend"))
    assert run("bake", "--input", folder / "scene.blend", "--output", folder / "baked.blend", "--objects", "Ring,Floor",
               "--preset", "high", "--set", "error_receivers=0", "--set", "spacing=0", "--set", "directions=1024",
               "--set", "gather_directions=256") == 0
    return folder / "baked.blend"


def finish(session: object) -> object:
    """What came out of a comparison, whose child must leave nothing behind."""
    messages = list(session.process.wait())
    assert messages[-1]["type"] == "done", messages[-1]
    compared = session.finish()
    assert not session.process.job.exists()
    return compared


def test_a_good_bake_agrees_with_cycles(baked: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Relative RMS without Cycles' noise below 1.5 %, by the command, with both its files."""
    picture, report = tmp_path / "p.png", tmp_path / "r.json"
    before = baked.read_bytes()
    assert run("compare", "--input", baked, "--output", picture, "--samples", "64", "--report", report) == 0
    assert capsys.readouterr().out.splitlines()[-2:] == [str(picture), str(report)]
    result = json.loads(report.read_text())
    print({name: value for name, value in result.items() if name != "objects"})
    assert result["relative_rms"] < 0.015 and abs(result["bias"]) < 0.01
    assert result["within"]["0.05"] > result["noise_within"]["0.05"] > 0.5
    assert 0.0 < result["noise"] < 0.06 and result["cycles"]["samples"] == 66
    assert [part["name"] for part in result["objects"]] == ["Ring", "Floor"]
    assert all(part["relative_rms"] < 0.02 and part["compared"] > 300 for part in result["objects"])
    assert 0.3 < result["compared"] / result["pixels"] < 0.8  # neither the sky, nor the box, nor edges
    assert picture.stat().st_size > 5000
    assert baked.read_bytes() == before


def test_a_wrong_light_is_told_as_what_it_is(baked: Path) -> None:
    """The preview under a World 1.2 times as strong as the one rendered: 20 % too bright."""
    from prt.operators.compare_session import DRAWN_SAMPLES, CompareSession
    from prt.operators.relit import draw_lit, read_all, relit

    bpy.ops.wm.open_mainfile(filepath=str(baked), load_ui=False)
    scene = bpy.context.scene
    session = CompareSession.start(scene, SIZE, 16)
    scene.world.node_tree.nodes["Background"].inputs["Strength"].default_value *= 1.2
    transfer = read_all(scene, "scene")
    session.drawn = draw_lit(scene, transfer, relit(scene, transfer), *SIZE, samples=DRAWN_SAMPLES)
    result = finish(session).result
    assert result["bias"] == pytest.approx(0.2, abs=0.01)
    assert result["relative_rms"] == pytest.approx(0.2, abs=0.015)
    assert result["within"]["0.05"] < 0.05


def test_nothing_of_the_user_s_is_touched(baked: Path) -> None:
    from prt.operators.compare_session import CompareSession

    bpy.ops.wm.open_mainfile(filepath=str(baked), load_ui=False)
    output = bpy.context.scene.render.image_settings  # Blender changes the colour space with the format
    output.file_format, output.color_management = "OPEN_EXR", "OVERRIDE"
    output.linear_colorspace_settings.name = "Linear Rec.2020"
    before, dirty = user_data_lines(), bpy.data.is_dirty
    compared = finish(CompareSession.start(bpy.context.scene, (48, 32), 2))
    assert user_data_lines() == before and bpy.data.is_dirty == dirty and bpy.data.filepath == str(baked)
    assert compared.picture.shape[1] > 3 * 480


def test_cancel_ends_the_render_at_once(baked: Path) -> None:
    from prt.operators.compare_session import CompareSession

    bpy.ops.wm.open_mainfile(filepath=str(baked), load_ui=False)
    session = CompareSession.start(bpy.context.scene, (1200, 800), 4096)
    while not session.process.poll():
        time.sleep(0.05)
    started = time.monotonic()
    session.process.cancel()
    assert time.monotonic() - started < 1.0
    assert session.process.returncode is not None and not session.process.job.exists()


def test_edges_are_left_out_and_creases_are_not() -> None:
    from prt.prt_addon.reporting.comparison import inner_pixels

    depth = np.full((12, 20), 5.0)
    objects = np.ones((12, 20), int)
    objects[:, 12:], depth[:, 12:] = 2, 5.0  # another object in the same plane
    objects[:3] = 0
    assert np.array_equal(inner_pixels(objects, depth)[:, 10:14].any(axis=0), [True, False, False, True])
    assert not inner_pixels(objects, depth)[:4].any() and inner_pixels(objects, depth)[5:, :11].all()
    jump = np.where(np.arange(20) < 8, 5.0, 5.5)[None, :].repeat(12, axis=0)
    found = inner_pixels(np.ones((12, 20), int), jump)
    assert not found[:, 7:9].any() and found[:, :5].all() and found[:, 12:].all()
    slope = np.abs(np.arange(20) - 10)[None, :].repeat(12, axis=0)
    assert inner_pixels(np.ones((12, 20), int), 1.0 / (0.2 - 0.001 * slope)).all()


def test_noise_does_not_count_as_a_difference() -> None:
    """A drawing that is the truth itself, against renders of 30 % noise: the estimate is near zero, the noise known."""
    from prt.prt_addon.reporting.comparison import compare

    generator = np.random.default_rng(1)
    truth = generator.uniform(0.5, 1.5, (200, 200, 3))
    halves = tuple(truth * (1.0 + generator.normal(0.0, 0.3, truth.shape)) for _ in range(2))
    objects = np.ones((200, 200), int)
    found = compare(truth * 1.05, halves, objects, objects > 0, ["A"])
    assert found["relative_rms"] == pytest.approx(0.05, abs=0.01) and found["bias"] == pytest.approx(0.05, abs=0.004)
    assert found["noise"] == pytest.approx(0.3 / np.sqrt(2.0), rel=0.03)
    nothing = compare(truth, halves, objects, objects > 1, ["A"])
    assert nothing["relative_rms"] is None and nothing["compared"] == 0
