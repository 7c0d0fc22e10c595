# SPDX-License-Identifier: GPL-3.0-or-later
"""Bakes in cubemap columns through the commands: stored, relit, turned and drawn like any other bake."""

from __future__ import annotations

import json
import math
from pathlib import Path

import bpy
import numpy as np
import OpenEXR
import pytest
from mathutils import Matrix

from prt_addon.lighting.cubemap_light import total_flux
from prt_addon.lighting.environment import direction_of_pixel
from tests.blender.test_commands import make_scene, relit, run

FAST = ["--preset", "draft", "--set", "directions=512", "--set", "gather_directions=64", "--set", "spacing=0.04",
        "--set", "error_receivers=16", "--set", "error_paths=1024", "--set", "distant_basis=cubemap",
        "--set", "cubemap_size=8"]
EIGEN = ["--set", "encoder=eigentransport", "--set", "vectors=100", "--set", "compression_error=0"]

QUICK = ["--set", "glossy_rows=0", "--set", "bounces=0", "--set", "vectors=32", "--set", "error_receivers=0"]


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_scene(tmp_path_factory.mktemp("cubemap") / "scene.blend")


@pytest.fixture(scope="module")
def baked(scene: Path) -> Path:
    output = scene.with_name("eigen.blend")
    assert run("bake", "--input", scene, "--output", output, "--report", scene.with_name("r.json"), *FAST, *EIGEN) == 0
    return output


def half_sky(path: Path, degrees: float = 0.0) -> Path:
    """A sky that is bright where x > 0 after a turn about Z by `degrees`."""
    height, width = 64, 128
    directions = direction_of_pixel(np.arange(height)[:, None], np.arange(width)[None], height, width)
    angle = math.radians(degrees)
    bright = directions[..., 0] * math.cos(angle) + directions[..., 1] * math.sin(angle) > 0
    pixels = (np.where(bright, 2.0, 0.1)[..., None] * np.array([1.0, 0.9, 0.5])).astype(np.float32)
    with OpenEXR.File({}, {"RGB": pixels}) as file:
        file.write(str(path))
    return path


def test_analyze_forecasts_it(scene: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run("analyze", "--input", scene, *FAST, *EIGEN) == 0
    found = json.loads((text := capsys.readouterr().out)[text.index("{"):])
    assert found["stored_bytes"] > 1e5 and "direct" in found["stages"]


def test_report_tells_its_errors(baked: Path) -> None:
    report = json.loads(baked.with_name("r.json").read_text())
    assert {"sampling", "basis", "compression", "total"} <= set(report["errors"])
    assert report["errors"]["compression"]["relative_rms"] < 0.02
    assert report["clusters"]["count"] == 2  # one for each object
    assert run("report", "--input", baked.with_name("r.json"), "--output", baked.with_name("r.html")) == 0


def test_all_vectors_are_stored_as_the_contract_says(baked: Path) -> None:
    bpy.ops.wm.open_mainfile(filepath=str(baked))
    import prt.prt_addon.blender.stored as stored

    for found in stored.baked_objects(bpy.context.scene):
        transfer = stored.read_baked(found)
        basis = transfer.lighting_basis
        assert (basis.cubemap, basis.order, basis.cloud) == (8, 0, 0) and transfer.bases.shape[0] == 1
        assert transfer.weights.shape[1] == 100
    meshes = [mesh for mesh in bpy.data.meshes if "prt_header" in mesh]
    assert len(meshes) == 2
    for mesh in meshes:
        assert {f"prt_weights_{k}" for k in range(25)} <= set(mesh.attributes.keys())
        assert json.loads(mesh["prt_header"])["columns"]["kind"] == "cubemap"


def test_it_agrees_with_harmonics_under_a_broad_light(baked: Path, scene: Path, tmp_path: Path) -> None:
    harmonics = tmp_path / "sh.blend"
    assert run("bake", "--input", scene, "--output", harmonics, *FAST, "--set", "distant_basis=sh", "--set",
               "order=8", "--set", "glossy_rows=0", "--set", "compression_error=0.001") == 0
    sky = half_sky(tmp_path / "sky.exr")
    ours = relit(baked, tmp_path / "a.npz", "--environment", sky)
    theirs = relit(harmonics, tmp_path / "b.npz", "--environment", sky)
    assert np.array_equal(ours["position"], theirs["position"])
    error = np.sqrt(np.mean((ours["radiance"] - theirs["radiance"]) ** 2) / np.mean(theirs["radiance"] ** 2))
    assert error < 0.04


def test_turning_by_a_quarter_is_exact_and_any_turn_is_close(baked: Path, tmp_path: Path) -> None:
    for degrees, bound in ((90.0, 1e-4), (30.0, 0.03)):
        # --rotate is the Mapping node's turn of the look-up: the picture turns the other way.
        turned = relit(baked, tmp_path / "a.npz", "--environment", half_sky(tmp_path / "s.exr"), "--rotate",
                       str(degrees))
        made = relit(baked, tmp_path / "b.npz", "--environment", half_sky(tmp_path / f"{degrees}.exr", -degrees))
        plain = relit(baked, tmp_path / "c.npz", "--environment", half_sky(tmp_path / "s.exr"))
        power = np.sqrt(np.mean(made["radiance"] ** 2))
        assert np.sqrt(np.mean((turned["radiance"] - made["radiance"]) ** 2)) < bound * power
        assert np.sqrt(np.mean((plain["radiance"] - made["radiance"]) ** 2)) > 5 * bound * power


def test_suns_have_all_their_light(baked: Path, tmp_path: Path) -> None:
    bpy.ops.wm.open_mainfile(filepath=str(baked))
    from prt.prt_addon.blender.lights import distant_light
    from prt.prt_addon.storage.columns import Columns

    depsgraph = bpy.context.evaluated_depsgraph_get()
    with_sun, without = (distant_light(bpy.context.scene, depsgraph, [Columns(0, 0, 8)], use_scene_lights=suns)[0]
                         for suns in (True, False))
    flux = total_flux(with_sun.texels[8], 8) - total_flux(without.texels[8], 8)
    assert np.allclose(flux, 1.0, rtol=1e-3)  # the new lamp's 1 W/m^2
    assert np.allclose(without.texels[8], [0.5, 0.7, 1.0], rtol=1e-5)
    lit = relit(baked, tmp_path / "a.npz", "--use-scene-lights")["radiance"]
    assert lit.mean() > relit(baked, tmp_path / "b.npz")["radiance"].mean() * 1.2


def test_light_of_a_turned_object(baked: Path) -> None:
    """The viewport turns the light of a rigidly turned object the other way."""
    bpy.ops.wm.open_mainfile(filepath=str(baked))
    from prt.operators import live_preview
    from prt.prt_addon.basis.cubemap import cubemap_directions, texel_of
    from prt.prt_addon.lighting.distant_light import DistantLight
    from prt.prt_addon.storage.columns import Columns

    texels = np.random.default_rng(1).random((384, 3))
    quarter = np.eye(4)
    quarter[:2, :2] = [[0, -1], [1, 0]]
    live = live_preview._live
    try:
        live.light, live.rotated = DistantLight(None, {8: texels}), {}
        basis = Columns(0, 0, 8)
        # In the object's own directions s the light is that of R s.
        place = texel_of(cubemap_directions(8) @ quarter[:3, :3].T, 8)
        assert np.allclose(live_preview._light_in(basis, quarter), texels[place], rtol=1e-9)
        assert live_preview._light_in(basis, np.eye(4)) is texels
        assert len(live.rotated) == 1
    finally:
        live.light, live.rotated = None, {}


def test_a_set_that_turned_as_a_whole_sees_the_light_turned_back(baked: Path, tmp_path: Path) -> None:
    """A quarter turn of everything under a sky that is turned along: as before, to rounding."""
    from tests.blender.test_moved_bakes import move

    moved = tmp_path / "moved.blend"
    for degrees, bound in ((90.0, 1e-4), (37.0, 0.03)):
        move(baked, moved, Matrix.Rotation(math.radians(degrees), 4, "Z"), with_lamps=True)
        before = relit(baked, tmp_path / "a.npz", "--environment", half_sky(tmp_path / "s.exr"))
        after = relit(moved, tmp_path / "b.npz", "--environment", half_sky(tmp_path / f"{degrees}.exr", degrees))
        power = np.sqrt(np.mean(before["radiance"] ** 2))
        assert np.sqrt(np.mean((after["radiance"] - before["radiance"]) ** 2)) < bound * power


def test_preview_draws_what_relight_says(baked: Path, tmp_path: Path) -> None:
    output = tmp_path / "p.png"
    if run("preview", "--input", baked, "--output", output, "--size", "64x48") == 1:
        pytest.skip("no graphics driver")
    image = bpy.data.images.load(str(output))
    assert tuple(image.size) == (64, 48) and max(image.pixels[:]) > 0.2


def test_sparse_samples_relit_as_every_element(scene: Path, tmp_path: Path) -> None:
    """Through the commands and the file; the report tells how far they may be off."""
    found = []
    for way in ("every", "sparse"):
        output = tmp_path / f"{way}.blend"
        assert run("bake", "--input", scene, "--output", output, "--report", tmp_path / "r.json", *FAST, *EIGEN,
                   *QUICK, "--set", f"sampling={way}") == 0
        found.append(relit(output, tmp_path / "a.npz", "--environment", half_sky(tmp_path / "s.exr"))["radiance"])
    facts = json.loads((tmp_path / "r.json").read_text())["sampling"]
    assert facts["traced"] < 0.25 and 0.0 < facts["light_error"] < 0.05
    power = np.sqrt(np.mean(found[0] ** 2))
    assert 0.0 < np.sqrt(np.mean((found[1] - found[0]) ** 2)) < (2.0 * facts["light_error"] + 0.01) * power
    assert run("report", "--input", tmp_path / "r.json", "--output", tmp_path / "r.html") == 0
    assert "Sparse sampling" in (tmp_path / "r.html").read_text()


def test_impossible_settings_end_in_2(scene: Path, tmp_path: Path) -> None:
    for wrong in ("distant_basis=haar", "cubemap_size=64", "vectors=193", "sampling=few"):
        assert run("bake", "--input", scene, "--output", tmp_path / "x.blend", "--set", wrong) == 2
    assert not (tmp_path / "x.blend").exists()
