# SPDX-License-Identifier: GPL-3.0-or-later
"""The command line with bakes whose radiance depends on the view."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import bpy
import numpy as np
import pytest

from prt_addon.baking.plan import make_plan
from prt_addon.baking.settings import make_settings
from prt_addon.blender import stored
from prt_addon.relighting.exit_radiance import view_radiance
from prt_addon.reporting import wording
from prt_addon.scene.scene_mesh import SceneMesh
from prt_addon.scene.surface_material import SurfaceMaterial
from tests.blender.test_commands import run  # makes the checkout the package `prt`
from tests.blender.test_stored import ROW_SETS, add_smooth_sphere, bake_of
from tests.core.shapes import sphere


@pytest.fixture
def glossy(scene: bpy.types.Scene, tmp_path: Path) -> tuple[Path, object]:
    """A file with a made-up bake of 16 functions on a sphere under a grey sky, and the bake."""
    scene.world = bpy.data.worlds.new("Sky")
    scene.world.node_tree.nodes["Background"].inputs["Color"].default_value = (0.3, 0.5, 0.7, 1.0)
    sphere = add_smooth_sphere()
    camera = bpy.data.objects.new("Camera", bpy.data.cameras.new("Camera"))
    camera.location = (0.0, 0.0, 6.0)
    scene.collection.objects.link(camera)
    scene.camera = camera
    baked = bake_of(sphere, functions=ROW_SETS["9"])
    stored.write_baked(sphere, baked)
    path = tmp_path / "baked.blend"
    bpy.ops.wm.save_as_mainfile(filepath=str(path))
    return path, baked


def test_relight_gives_the_radiance_towards_the_normal(glossy: tuple[Path, object], tmp_path: Path) -> None:
    path, baked = glossy
    assert run("relight", "--input", path, "--output", tmp_path / "c.npz") == 0
    light = np.zeros((16, 3))
    light[0] = np.array((0.3, 0.5, 0.7)) * np.sqrt(4.0 * np.pi)
    with np.load(tmp_path / "c.npz") as arrays:
        expected = view_radiance(baked, light, baked.normals)
        assert np.abs(arrays["radiance"] - expected).max() < 1e-3 * np.abs(expected).max()


def test_export_writes_the_frames(glossy: tuple[Path, object], tmp_path: Path) -> None:
    path, baked = glossy
    assert run("export", "--input", path, "--output", tmp_path / "out") == 0
    index = json.loads((tmp_path / "out" / "baked.json").read_text())
    assert index["objects"][0]["header"]["rows"] == {"kind": "constant_and_hemisphere", "functions": list(range(9))}
    with np.load(tmp_path / "out" / index["objects"][0]["file"]) as arrays:
        assert set(arrays) == set(index["arrays"])
        assert np.allclose(arrays["tangents"], baked.tangents, atol=1e-4)


def test_preview_draws_it(glossy: tuple[Path, object], tmp_path: Path) -> None:
    code = run("preview", "--input", glossy[0], "--output", tmp_path / "p.png", "--size", "32x24")
    if code == 1:
        pytest.skip("no graphics driver")
    assert code == 0 and (tmp_path / "p.png").is_file()


def test_every_stage_of_a_bake_has_a_name_on_screen_and_in_the_report() -> None:
    from prt.operators.job_mixin import STAGES

    material = SurfaceMaterial("wax metal", metallic=0.5, specular_level=0.5, subsurface_weight=0.5,
                               subsurface_radius=(1.0, 1.0, 1.0))
    scene = SceneMesh.assemble([replace(sphere(subdivisions=1, albedo=(0.5, 0.5, 0.5)), materials=(material,))])
    stages = make_plan(scene, make_settings("draft", {"bounces": "1"}), None).seconds
    assert {"glossy", "subsurface"} <= stages.keys() <= STAGES.keys() & wording.STAGES.keys()
