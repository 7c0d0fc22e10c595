# SPDX-License-Identifier: GPL-3.0-or-later
"""Metal and wax in cubemap columns through the commands: baked, relit, turned and drawn like any other bake."""

from __future__ import annotations

import json
from pathlib import Path

import bpy
import numpy as np
import pytest

from tests.blender.test_commands import relit, run
from tests.blender.test_cubemap_commands import half_sky

FAST = ["--preset", "draft", "--set", "directions=512", "--set", "gather_directions=64", "--set", "spacing=0",
        "--set", "error_receivers=16", "--set", "error_paths=1024", "--set", "distant_basis=cubemap",
        "--set", "cubemap_size=4"]


def add(name: str, place: tuple[float, float, float], **inputs: object) -> None:
    """A smooth ball of one Principled material."""
    bpy.ops.mesh.primitive_ico_sphere_add(subdivisions=3, radius=0.5, location=place)
    ball = bpy.context.object
    ball.name = name
    bpy.ops.object.shade_smooth()
    material = bpy.data.materials.new(name)
    material.use_nodes = True
    shader = material.node_tree.nodes["Principled BSDF"]
    for key, value in inputs.items():
        shader.inputs[key.replace("_", " ")].default_value = value
    ball.data.materials.append(material)


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A brushed brass ball and a wax ball on a floor, under a sky that is bright on one side."""
    folder = tmp_path_factory.mktemp("highlights")
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.ops.mesh.primitive_grid_add(x_subdivisions=12, y_subdivisions=12, size=4.0)
    add("Brass", (-0.6, 0.0, 0.51), Base_Color=(0.9, 0.6, 0.2, 1.0), Metallic=1.0, Roughness=0.4, Anisotropic=0.6)
    add("Wax", (0.6, 0.0, 0.51), Base_Color=(0.8, 0.5, 0.3, 1.0), Roughness=1.0, Specular_IOR_Level=0.0,
        Subsurface_Weight=1.0, Subsurface_Scale=0.2)
    camera = bpy.data.objects.new("Camera", bpy.data.cameras.new("Camera"))
    bpy.context.scene.collection.objects.link(camera)
    camera.location, camera.rotation_euler = (0.0, -4.0, 1.0), (1.4, 0.0, 0.0)
    bpy.context.scene.camera = camera
    path = folder / "scene.blend"
    bpy.ops.wm.save_as_mainfile(filepath=str(path))
    return path


@pytest.fixture(scope="module")
def baked(scene: Path) -> Path:
    output = scene.with_name("baked.blend")
    assert run("bake", "--input", scene, "--output", output, "--report", scene.with_name("r.json"), *FAST) == 0
    return output


def test_the_report_measures_highlights_and_nothing_was_forced_off(baked: Path) -> None:
    report = json.loads(baked.with_name("r.json").read_text())
    assert {"sampling", "rows", "basis", "bounces", "compression", "total"} <= set(report["highlight_errors"])
    assert {"glossy", "subsurface"} <= {stage["name"] for stage in report["stages"]}
    assert report["settings"]["glossy_rows"] == 9 and report["settings"]["subsurface"] is True
    assert not any("diffuse light only" in hint for hint in report["hints"])


def test_rows_and_texels_are_stored(baked: Path) -> None:
    bpy.ops.wm.open_mainfile(filepath=str(baked))
    import prt.prt_addon.blender.stored as stored

    rows = {found.name: stored.read_baked(found) for found in stored.baked_objects(bpy.context.scene)}
    assert {name: (len(t.functions), t.lighting_basis.cubemap, t.bases.shape[3]) for name, t in rows.items()} == {
        "Brass": (9, 4, 96), "Wax": (1, 4, 96), "Grid": (0, 4, 96)}


def test_relit_and_turned(baked: Path, tmp_path: Path) -> None:
    """A turned sky is the turned picture's sky, on metal and wax too."""
    for degrees, bound in ((90.0, 1e-4), (30.0, 0.06)):
        turned = relit(baked, tmp_path / "a.npz", "--environment", half_sky(tmp_path / "s.exr"), "--rotate",
                       str(degrees))
        made = relit(baked, tmp_path / "b.npz", "--environment", half_sky(tmp_path / f"{degrees}.exr", -degrees))
        power = np.sqrt(np.mean(made["radiance"] ** 2))
        assert np.sqrt(np.mean((turned["radiance"] - made["radiance"]) ** 2)) < bound * power
    assert made["radiance"].max() > 0.3


def test_preview_draws_the_highlight(baked: Path, tmp_path: Path) -> None:
    bpy.ops.wm.open_mainfile(filepath=str(baked))
    world = bpy.data.worlds.new("World")
    world.use_nodes = True
    world.node_tree.nodes["Background"].inputs["Color"].default_value = (1.0, 1.0, 1.0, 1.0)
    bpy.context.scene.world = world
    lit = tmp_path / "lit.blend"
    bpy.ops.wm.save_as_mainfile(filepath=str(lit))
    output = tmp_path / "p.png"
    if run("preview", "--input", lit, "--output", output, "--size", "96x64") == 1:
        pytest.skip("no graphics driver")
    image = bpy.data.images.load(str(output))
    pixels = np.array(image.pixels[:]).reshape(64, 96, 4)
    brass = pixels[26:36, 26:34, :3].reshape(-1, 3).mean(axis=0)
    assert brass[0] > 0.3 and brass[0] > 1.3 * brass[2]  # no black metal, and its own colour
