# SPDX-License-Identifier: GPL-3.0-or-later
"""Bakes of highlights and of translucent bodies from end to end, in surroundings whose answer is known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from prt_addon.baking.job import read_result, run_job, write_job
from prt_addon.baking.recipe import bake, exhaust
from prt_addon.baking.settings import make_settings
from prt_addon.errors import BadArguments
from prt_addon.relighting.exit_radiance import diffuse_radiance, view_radiance
from prt_addon.scene.scene_mesh import SceneMesh
from prt_addon.scene.surface_material import SurfaceMaterial
from tests.core.shapes import drain, join, plane, sphere

METAL = SurfaceMaterial("metal", (1.0, 1.0, 1.0), roughness=0.5, metallic=1.0, specular_level=0.5)
GOLD = replace(METAL, name="gold", base_colour=(1.0, 0.7, 0.3))
PLASTIC = SurfaceMaterial("plastic", (0.6, 0.6, 0.6), roughness=0.5, specular_level=0.5)
WAX = SurfaceMaterial("wax", (0.8, 0.5, 0.2), subsurface_weight=1.0, subsurface_radius=(3.0, 2.0, 1.0))
FEW = {"directions": "1024", "gather_directions": "256", "order": "5", "spacing": "0", "threads": "1",
       "error_receivers": "0", "compression_error": "0.001", "vectors": "12"}


def baked(meshes, **options):
    scene = SceneMesh.assemble(meshes if isinstance(meshes, list) else [meshes])
    return exhaust(bake(scene, make_settings("standard", FEW | {k: str(v) for k, v in options.items()})))


def white_light(columns):
    """A unit environment."""
    light = np.zeros((columns, 3))
    light[0] = np.sqrt(4 * np.pi)
    return light


def seen(container, degrees, light=None):
    """Radiance of all receivers towards views at an angle from their normals."""
    angle = np.radians(degrees)
    views = np.cos(angle) * container.normals + np.sin(angle) * container.tangents
    return view_radiance(container, white_light(container.columns) if light is None else light, views)


@pytest.mark.parametrize("degrees", [0.0, 30.0, 60.0])
def test_a_white_metal_ball_disappears_in_a_white_world(degrees):
    container = baked(replace(sphere(subdivisions=4, albedo=(0, 0, 0)), materials=(METAL,))).objects["sphere"]
    assert container.functions
    np.testing.assert_allclose(seen(container, degrees), 1.0, atol=0.01)


@pytest.mark.parametrize("degrees", [0.0, 30.0, 60.0])
def test_white_plastic_keeps_the_energy(degrees):
    """What the highlight takes from the diffuse layer it returns itself (up to what its layer absorbs: nothing)."""
    mesh = replace(sphere(subdivisions=4, albedo=(1, 1, 1)), materials=(replace(PLASTIC, base_colour=(1, 1, 1)),))
    container = baked(mesh, glossy_albedo=0).objects["sphere"]
    np.testing.assert_allclose(seen(container, degrees), 1.0, atol=0.01)


def test_coloured_metal_has_three_channels_and_the_metals_colour():
    container = baked(replace(sphere(subdivisions=3, albedo=(0, 0, 0)), materials=(GOLD,))).objects["sphere"]
    assert container.bases.shape[4] == 3
    np.testing.assert_allclose(seen(container, 0.0).mean(axis=0), GOLD.base_colour, atol=0.03)


def test_two_materials_on_one_mesh_keep_to_their_own_rows():
    ball = replace(sphere(subdivisions=2, albedo=(0, 0, 0), centre=(0, 0, 1.2)), materials=(METAL,))
    floor = plane(size=6.0, cells=8, albedo=(0.5, 0.5, 0.5))
    mesh = join("both", ball, floor)
    index = np.repeat(np.array([0, 1], np.int32), [len(ball.triangles), len(floor.triangles)])
    mesh = replace(mesh, materials=(METAL, replace(METAL, metallic=0.0, specular_level=0.0)), material_index=index)
    result = baked(mesh, compression_error=0, clusters=64, vectors=24)
    container = result.objects["both"]
    assert container.bases.shape[2] == 1 + len(container.functions) > 1
    light = np.zeros((container.columns, 3))
    light[0], light[2], light[3] = 2.0, 0.7, 0.5
    on_floor = np.abs(container.positions[:, 2]) < 1e-6
    straight, slanted = seen(container, 0.0, light), seen(container, 50.0, light)
    np.testing.assert_allclose(straight[on_floor], slanted[on_floor], atol=0.03)  # diffuse: the same from everywhere
    assert np.abs(straight - slanted)[~on_floor].max() > 0.2
    floor_only = baked([replace(ball, is_target=False), replace(floor, name="floor")]).objects["floor"]
    alone = diffuse_radiance(floor_only, light)
    place = {tuple(np.round(p, 5)): r for p, r in zip(floor_only.positions, alone, strict=True)}
    expected = np.array([place[tuple(np.round(p, 5))] for p in container.positions[on_floor]])
    np.testing.assert_allclose(straight[on_floor], expected, atol=0.03)


def test_wax_returns_its_colour_in_a_white_world_and_lets_light_through():
    result = baked(replace(sphere(subdivisions=3, albedo=WAX.base_colour), materials=(WAX,)))
    container = result.objects["sphere"]
    assert container.functions == (0,) and container.bases.shape[4] == 3
    colour = seen(container, 20.0).mean(axis=0)
    assert (colour < np.array(WAX.base_colour) + 0.01).all()
    assert (colour > 0.6 * np.array(WAX.base_colour)).all()  # thin parts lose some: the dipole's own limit
    above = np.zeros((container.columns, 3))
    above[0], above[2] = 1.0, 1.0  # mostly from +Z
    far = container.positions[:, 2] < -0.9
    plain = baked(replace(sphere(subdivisions=3, albedo=WAX.base_colour), materials=(WAX,)), subsurface="false")
    opaque = plain.objects["sphere"]
    assert not opaque.functions
    assert seen(container, 0.0, above)[far, 0].mean() > 1.2 * diffuse_radiance(opaque, above)[far, 0].mean()
    assert any("subsurface" in entry["what"] for entry in plain.report["left_out"])
    assert any("tree over wax" in check["check"] for check in result.report["stability"])


def test_layers_of_wax_metal_and_highlight_share_the_light():
    """White in every layer, half of it metal: no more leaves than came."""
    mixed = replace(WAX, base_colour=(1.0, 1.0, 1.0), metallic=0.5, specular_level=0.5, roughness=0.5,
                    subsurface_radius=(0.05, 0.05, 0.05))
    container = baked(replace(sphere(subdivisions=3, albedo=(0.5,) * 3), materials=(mixed,))).objects["sphere"]
    for degrees in (0.0, 45.0):
        np.testing.assert_allclose(seen(container, degrees), 1.0, atol=0.03)


def test_what_is_left_out_is_said():
    mesh = replace(sphere(subdivisions=2, albedo=(0.6, 0.6, 0.6)), materials=(PLASTIC,))
    faint = baked(mesh)  # 6 % of the light is less than the preset asks for
    assert faint.objects["sphere"].functions == ()
    assert any("glossy_albedo" in entry["why"] for entry in faint.report["left_out"])
    none = baked(replace(mesh, materials=(METAL,)), glossy_rows=0)
    assert none.objects["sphere"].functions == ()
    assert any("glossy_rows is 0: metal is drawn black" in entry["why"] for entry in none.report["left_out"])
    mirror = baked(replace(mesh, materials=(replace(METAL, roughness=0.05),)))
    assert len(mirror.objects["sphere"].functions) == 16  # blurred, not black
    assert any("sharp reflections" in entry["what"] for entry in mirror.report["left_out"])
    with pytest.raises(BadArguments, match="glossy_rows"):
        make_settings("standard", {"glossy_rows": "7"})


def test_a_body_small_against_its_mean_free_path_is_reported():
    """It returns little of the light: dark in the picture, and the dipole's fault."""
    def lost(radius):
        wax = replace(WAX, subsurface_radius=(radius,) * 3)
        result = baked(replace(sphere(subdivisions=2, albedo=WAX.base_colour), materials=(wax,)), bounces=0)
        check, = (c for c in result.report["stability"] if "loses by its sides" in c["check"])
        return check["value"], check["verdict"]

    value, verdict = lost(1000.0)
    assert value > 0.99 and "Subsurface Scale" in verdict
    value, verdict = lost(0.05)
    assert abs(value) < 0.05 and verdict == "ok"


def test_a_dark_metal_keeps_its_highlight_and_a_dark_plastic_does_not():
    """A metal has no diffuse layer that its light could stay in: without rows it would be drawn black."""
    mesh = sphere(subdivisions=2, albedo=(0, 0, 0))
    steel = replace(METAL, base_colour=(0.2, 0.2, 0.2))
    result = baked(replace(mesh, materials=(steel,)), glossy_albedo=0.3, order=4)
    assert result.objects["sphere"].functions
    assert seen(result.objects["sphere"], 0.0).mean() > 0.17
    assert not baked(replace(mesh, materials=(replace(PLASTIC, specular_level=1.0),)),
                     glossy_albedo=0.3).objects["sphere"].functions
    black = replace(METAL, base_colour=(0.0, 0.0, 0.0))
    assert not baked(replace(mesh, materials=(black,))).objects["sphere"].functions


def test_light_through_bodies_is_not_computed_twice(tmp_path):
    """Resumed after the subsurface stage: the same rows and the same checks, without that stage's work."""
    meshes = [replace(sphere(subdivisions=2, albedo=WAX.base_colour), materials=(WAX,))]
    scene, settings = SceneMesh.assemble(meshes), make_settings("standard", FEW)
    folder = write_job(tmp_path, scene, settings)
    steps = run_job(folder)
    while next(steps).stage != "encode":
        pass
    steps.close()
    drain(run_job(folder))
    resumed, whole = read_result(folder), exhaust(bake(scene, settings))
    assert "subsurface" in resumed.report["resumed"]
    np.testing.assert_array_equal(whole.objects["sphere"].bases, resumed.objects["sphere"].bases)
    assert whole.report["stability"] == resumed.report["stability"]


def test_progress_of_highlights_never_falls_and_names_each_stage_at_once():
    """Two metals that see each other are done in two rounds; the stage shows before its first block is done."""
    meshes = [replace(sphere(subdivisions=2, albedo=(0, 0, 0), centre=(0, 0, 1.2)), materials=(GOLD,)),
              replace(plane(size=6.0, cells=8, albedo=(0.5, 0.4, 0.3)), materials=(replace(GOLD, metallic=0.5),))]
    steps = bake(SceneMesh.assemble(meshes), make_settings("standard", FEW | {"error_receivers": "8"}))
    seen = list(steps)
    fractions = [progress.fraction for progress in seen]
    assert fractions == sorted(fractions)
    stages = list(dict.fromkeys(progress.stage for progress in seen))
    assert stages == ["prepare", "gather", "direct", "interreflection", "glossy", "encode", "errors"]


def test_an_interrupted_bake_resumes_with_the_same_result(tmp_path):
    meshes = [replace(sphere(subdivisions=2, albedo=(0, 0, 0), centre=(0, 0, 1.2)), materials=(GOLD,)),
              plane(size=6.0, cells=8, albedo=(0.5, 0.4, 0.3))]
    scene, settings = SceneMesh.assemble(meshes), make_settings("standard", FEW)
    folder = write_job(tmp_path, scene, settings)
    steps = run_job(folder)
    while next(steps).stage != "encode":
        pass
    steps.close()
    assert {"gather", "direct", "glossy"} <= {path.stem for path in folder.glob("*.npz")}
    (folder / "glossy.npz").unlink()  # made again from the stored hits and visibility
    drain(run_job(folder))
    resumed = read_result(folder)
    assert set(resumed.report["resumed"]) == {"gather", "direct", "interreflection"}
    whole = exhaust(bake(scene, settings))
    for name, container in whole.objects.items():
        np.testing.assert_array_equal(container.bases, resumed.objects[name].bases)
        if container.functions:
            np.testing.assert_array_equal(container.tangents, resumed.objects[name].tangents)
