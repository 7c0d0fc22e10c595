# SPDX-License-Identifier: GPL-3.0-or-later
"""Lamps by nearest directions through commands and viewport: off unless asked, refused inside the hull."""

from __future__ import annotations

from pathlib import Path

import bpy
import numpy as np
import pytest

from tests.blender.test_commands import make_scene, relit, run

FAST = ["--preset", "draft", "--set", "directions=512", "--set", "gather_directions=64", "--set", "spacing=0.04",
        "--set", "error_receivers=0", "--set", "compression_error=0.002"]
KINDS = {"harmonics": ["--set", "order=6"],
         "cubemap": ["--set", "distant_basis=cubemap", "--set", "cubemap_size=8"]}
LAMPS = "--use-scene-lights", "--lamps-by-directions"


def add_lamp(name: str, location: tuple[float, float, float], kind: str = "POINT") -> None:
    lamp = bpy.data.lights.new(name, kind)
    lamp.energy, lamp.color = 800.0, (1.0, 0.5, 0.25)
    found = bpy.data.objects.new(name, lamp)
    found.location = location
    bpy.context.scene.collection.objects.link(found)


def lamps_instead_of_suns() -> None:
    bpy.data.objects.remove(bpy.data.objects["Sun"])
    bpy.context.scene.world = None
    add_lamp("Outside", (3.0, 1.0, 5.0))
    add_lamp("Inside", (0.5, 0.0, 0.3))


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_scene(tmp_path_factory.mktemp("lamps") / "scene.blend", lamps_instead_of_suns)


@pytest.fixture(scope="module", params=KINDS)
def baked(request: pytest.FixtureRequest, scene: Path) -> Path:
    output = scene.with_name(f"{request.param}.blend")
    assert run("bake", "--input", scene, "--output", output, *FAST, *KINDS[request.param]) == 0
    return output


@pytest.fixture(scope="module")
def exact(scene: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, np.ndarray]:
    """The outer lamp alone on a bake for local lights."""
    bpy.ops.wm.open_mainfile(filepath=str(scene))
    bpy.data.objects.remove(bpy.data.objects["Inside"])
    alone, output = scene.with_name("alone.blend"), scene.with_name("local.blend")
    bpy.ops.wm.save_as_mainfile(filepath=str(alone))
    assert run("bake", "--input", alone, "--output", output, *FAST, "--lighting", "local") == 0
    return relit(output, tmp_path_factory.mktemp("exact") / "e.npz", "--use-scene-lights")


def test_they_are_off_unless_asked_for(baked: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert not relit(baked, tmp_path / "a.npz", "--use-scene-lights")["radiance"].any()
    assert "near the scene, not part of an environment bake" in capsys.readouterr().err


def test_outside_the_hull_a_lamp_lights_and_inside_it_is_refused(
        baked: Path, exact: dict[str, np.ndarray], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    found = relit(baked, tmp_path / "a.npz", *LAMPS)
    told = capsys.readouterr().err
    assert "Inside: inside the hull of the scene" in told and "Lighting: Both" in told and "Outside:" not in told
    assert "not part of" not in told
    assert np.array_equal(found["position"], exact["position"])
    error = np.sqrt(np.sum((found["radiance"] - exact["radiance"]) ** 2) / np.sum(exact["radiance"] ** 2))
    assert error < 0.2
    assert found["radiance"].sum() == pytest.approx(exact["radiance"].sum(), rel=0.05)


def test_a_flag_without_the_lamps_is_refused(baked: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run("relight", "--input", baked, "--output", tmp_path / "a.npz", "--lamps-by-directions") == 2
    assert "Add --use-scene-lights" in capsys.readouterr().err and not (tmp_path / "a.npz").exists()


def test_preview_draws_them(baked: Path, tmp_path: Path) -> None:
    pictures = {}
    for name, more in (("dark", ()), ("lit", ("--lamps-by-directions",))):
        if run("preview", "--input", baked, "--output", tmp_path / f"{name}.png", "--size", "64x48", *more) == 1:
            pytest.skip("no graphics driver")
        image = bpy.data.images.load(str(tmp_path / f"{name}.png"))
        pictures[name] = np.array(image.pixels[:]).reshape(-1, 4)[:, :3]
    assert pictures["lit"].max() > pictures["dark"].max() + 0.2


def test_the_viewport_keeps_a_lamps_light_until_it_changes(baked: Path) -> None:
    bpy.ops.wm.open_mainfile(filepath=str(baked))
    from prt.operators.distant_lamps import DistantLamps
    from prt.operators.relit import read_all

    bakes, lamps, warnings = read_all(bpy.context.scene, "test"), DistantLamps(), []
    depsgraph = bpy.context.evaluated_depsgraph_get()
    usable = lamps.step(bakes, depsgraph, warnings)
    assert [lamp.name for lamp in usable] == ["Outside"] and len(warnings) == 1
    name, first = next(iter(bakes.items()))
    before = lamps.direct(name, first, usable)
    assert lamps.direct(name, first, usable) is before
    bpy.data.objects["Outside"].location.x += 1.0
    bpy.context.view_layer.update()
    usable = lamps.step(bakes, bpy.context.evaluated_depsgraph_get(), [])
    after = lamps.direct(name, first, usable)
    assert after is not before and not np.allclose(after, before)
    assert lamps.direct(name, first, []) is None


def test_an_area_that_reaches_into_the_hull_is_refused(baked: Path) -> None:
    bpy.ops.wm.open_mainfile(filepath=str(baked))
    from prt.operators.distant_lamps import DistantLamps
    from prt.operators.relit import read_all

    bpy.data.objects.remove(bpy.data.objects["Inside"])
    bpy.data.objects.remove(bpy.data.objects["Outside"])
    add_lamp("Wide", (0.0, 0.0, 3.0), "AREA")
    bpy.data.lights["Wide"].size = 1.0
    bakes, warnings = read_all(bpy.context.scene, "test"), []
    bpy.context.view_layer.update()
    assert len(DistantLamps().step(bakes, bpy.context.evaluated_depsgraph_get(), warnings)) == 1 and not warnings
    bpy.data.objects["Wide"].rotation_euler.y = 1.5
    bpy.data.lights["Wide"].size = 5.0
    bpy.context.view_layer.update()
    assert not DistantLamps().step(bakes, bpy.context.evaluated_depsgraph_get(), warnings)
    assert warnings and warnings[0].startswith("Wide: inside the hull")
