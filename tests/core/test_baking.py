# SPDX-License-Identifier: GPL-3.0-or-later
"""The recipe end to end: error budget, left-out work, resuming, cancelling, stability."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest

from prt_addon.baking.job import job_summary, read_result, run_job, write_job
from prt_addon.baking.recipe import bake, exhaust
from prt_addon.baking.settings import BakeSettings, make_settings, parse_overrides
from prt_addon.errors import BadArguments
from prt_addon.lighting.environment import project
from prt_addon.lighting.reference_light import ReferenceLight, averaged, stand_in_light
from prt_addon.scene.scene_mesh import SceneMesh
from prt_addon.tracing.tracer import Tracer
from prt_addon.transport.path_reference import DistantSuns, reference_radiance
from prt_addon.transport.receiver_set import ReceiverSet
from tests.core.shapes import box, drain, plane, sphere

SMALL = BakeSettings(order=3, directions=512, gather_directions=128, clusters=16, vectors=4, encoder="static",
                     spacing=0.05, compression_error=1e-2, error_receivers=24, error_paths=2048, threads=1)
NO_SUNS = DistantSuns(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0))


def still_life(spacing=0.05):
    meshes = [plane(size=4.0, albedo=(0.8, 0.8, 0.8)), sphere(centre=(0, 0, 0.9), radius=0.8, albedo=(0.8, 0.2, 0.1))]
    return SceneMesh.assemble(meshes, spacing)


def white(directions):
    return np.ones((len(directions), 1, 3))


def test_reference_of_a_convex_body_in_a_unit_sky_is_one():
    scene = SceneMesh.assemble([box()])
    tracer = Tracer(scene.points, scene.triangles, 1)
    receivers = ReceiverSet.of_keys(scene, tracer, np.arange(20))
    radiance = drain(reference_radiance(tracer, scene, receivers, scene.albedo, white, NO_SUNS, 512, -1, 3))
    assert np.abs(radiance - 1.0).max() < 1e-12


def test_reference_of_white_surfaces_returns_all_light():
    # Albedo 1 everywhere and no absorption: every path ends in the sky, radiance is 1 wherever it was emitted.
    scene = SceneMesh.assemble([plane(size=4.0, cells=2), box(low=(-0.5, -0.5, 0.5), high=(0.5, 0.5, 1.0))])
    tracer = Tracer(scene.points, scene.triangles, 1)
    receivers = ReceiverSet.of_keys(scene, tracer, np.arange(9))
    ones = np.ones_like(scene.albedo)
    radiance = drain(reference_radiance(tracer, scene, receivers, ones, white, NO_SUNS, 512, -1, 3))
    assert np.abs(radiance - 1.0).max() < 1e-9


@pytest.mark.parametrize("angle", [0.0, 0.01, 1.0])
def test_reference_sun_on_an_open_plane(angle):
    scene = SceneMesh.assemble([plane()])
    tracer = Tracer(scene.points, scene.triangles, 1)
    receivers = ReceiverSet.of_keys(scene, tracer, np.arange(4))
    direction = np.array([[0.6, 0.0, 0.8]])
    suns = DistantSuns(direction, np.array([[5.0, 2.0, 1.0]]), np.array([angle]))
    steps = reference_radiance(tracer, scene, receivers, scene.albedo, lambda d: 0.0 * white(d), suns, 4096, 0, 3)
    radiance = drain(steps)
    # Irradiance 5 on a facing plane, cosine 0.8, Lambertian: E cos / pi (a disc above the horizon has the same mean).
    assert np.abs(radiance - 0.8 / np.pi * np.array([5.0, 2.0, 1.0])).max() < 0.02


def test_budget_of_a_standard_bake_is_small_and_in_order():
    result = exhaust(bake(still_life(), SMALL))
    errors = result.report["errors"]
    assert set(errors) == {"sampling", "basis", "compression", "total"}
    for entry in errors.values():
        low, high = entry["interval"]
        assert low <= entry["relative_rms"] <= high or entry["relative_rms"] == 0.0
        assert entry["receivers"] == 24
    assert errors["total"]["relative_rms"] < 0.06
    assert errors["compression"]["relative_rms"] < 0.02


def test_sampling_error_falls_with_directions():
    def sampling(directions, gather_directions):
        settings = replace(SMALL, directions=directions, gather_directions=gather_directions, error_paths=8192)
        return exhaust(bake(still_life(), settings)).report["errors"]["sampling"]["relative_rms"]

    assert sampling(2048, 512) < 0.5 * sampling(48, 16)


def test_convex_mesh_needs_no_ray():
    settings = make_settings("draft", {"error_receivers": "0"})
    result = exhaust(bake(SceneMesh.assemble([sphere()]), settings))
    assert result.report["rays"] == 0
    assert any("convex" in item["why"] for item in result.report["left_out"])
    assert {s["name"] for s in result.report["stages"]} == {"prepare", "direct", "encode"}


def test_grey_scene_has_one_channel_and_coloured_three():
    grey = exhaust(bake(SceneMesh.assemble([plane(size=4.0, cells=8), box(low=(-1, -1, 0.5), high=(1, 1, 1))]), SMALL))
    assert {o.bases.shape[4] for o in grey.objects.values()} == {1}
    assert {o.bases.shape[4] for o in exhaust(bake(still_life(), SMALL)).objects.values()} == {3}


def test_closed_room_at_099_converges_and_says_how():
    room = SceneMesh.assemble([box(inward=True, albedo=(0.99,) * 3),
                               box("thing", (0.4, 0.4, 0.4), (0.6, 0.6, 0.6), albedo=(0.99,) * 3)], 0.2)
    report = exhaust(bake(room, SMALL)).report
    assert [s["verdict"] for s in report["stability"] if s["check"].startswith("energy left")] == ["ok"]
    assert all(np.isfinite(s["value"]) for s in report["stability"])


@pytest.mark.parametrize("directions", ["16", "256"])
def test_snow_in_a_white_world_returns_no_more_light_than_there_is(directions):
    # Whatever the number of rays: a draft's used to make 1.058 of 1.
    snow = (0.99,) * 3
    meshes = [plane(size=4.0, albedo=snow), sphere(centre=(0, 0, 0.9), radius=0.8, albedo=snow)]
    scene = SceneMesh.assemble(meshes, 0.05)
    settings = make_settings("draft", {"error_receivers": "0", "directions": directions, "gather_directions": "64"})
    check, = (s for s in exhaust(bake(scene, settings)).report["stability"] if s["check"].startswith("brightest"))
    assert check["verdict"] == "ok" and 0.98 < check["value"] < check["limit"] < 1.01


def test_inward_normals_of_an_open_mesh_are_pointed_out():
    # A black hollow ball with one face missing whose normals point inside: a few receivers see a speck of sky.
    mesh = sphere(subdivisions=3, inward=True, albedo=(0, 0, 0))
    ball = replace(mesh, triangles=mesh.triangles[1:], corner_normals=mesh.corner_normals[1:],
                   corner_albedo=mesh.corner_albedo[1:])
    report = exhaust(bake(SceneMesh.assemble([ball]), SMALL)).report
    assert any("point inwards" in s["verdict"] for s in report["stability"])


def test_killed_bake_resumes_to_the_same_result(tmp_path):
    scene = still_life()
    job = write_job(tmp_path, scene, SMALL, stand_in_light())
    steps = run_job(job)
    for progress in steps:
        if progress.stage == "interreflection":
            break
    steps.close()
    assert job_summary(job) == {"finished": ["direct", "gather"], "complete": False}
    assert write_job(tmp_path, scene, SMALL, stand_in_light()) == job
    drain(run_job(job))
    result = read_result(job)
    assert result.report["resumed"] == ["gather", "direct"]
    fresh = exhaust(bake(scene, SMALL, light=stand_in_light()))
    for name, container in fresh.objects.items():
        for part in ("cluster", "weights", "bases", "positions", "triangles"):
            assert np.array_equal(getattr(container, part), getattr(result.objects[name], part)), (name, part)
    assert not list(job.glob("*.part"))


def test_other_settings_are_another_job(tmp_path):
    scene = still_life()
    other = make_settings("draft", {"order": "2"})
    assert write_job(tmp_path, scene, SMALL) != write_job(tmp_path, scene, other)
    assert write_job(tmp_path, scene, SMALL) != write_job(tmp_path, still_life(0.04), SMALL)


def test_progress_never_falls():
    fractions = [p.fraction for p in bake(still_life(), SMALL)]
    assert all(b >= a - 1e-12 for a, b in itertools.pairwise(fractions))
    assert fractions[0] >= 0.0 and 0.9 < fractions[-1] <= 1.0


@pytest.mark.parametrize(("name", "value"), [
    ("order", "11"), ("order", "x"), ("clusters", "0"), ("encoder", "zip"), ("nonsense", "1"), ("spacing", "nan"),
    ("fit_order_to_light", "maybe")])
def test_bad_settings_are_refused_by_name(name, value):
    with pytest.raises(BadArguments, match=name):
        make_settings("standard", {name: value})


def test_reference_light_keeps_all_light_of_a_one_pixel_sun():
    image = np.zeros((512, 1024, 3), np.float32)
    image[100, 300] = 1e6
    light = ReferenceLight.of(image, None, [], "one pixel")
    assert light.image.shape == (256, 512, 3)  # finer than that of an even light, which is 128 wide
    assert ReferenceLight.of(np.ones_like(image), None, [], "even").image.shape == (64, 128, 3)
    assert np.allclose(light.coefficients(1), project(image, 1), rtol=1e-6)
    assert averaged(np.ones((100, 250, 3), np.float32), 128) == pytest.approx(1.0)


def test_window_is_left_out_where_nothing_rings_and_priced_where_it_does():
    gradient = np.linspace(2.0, 1.0, 32, dtype=np.float32)[:, None, None] * np.ones((1, 64, 3), np.float32)
    calm = exhaust(bake(still_life(), replace(SMALL, error_receivers=0),
                        light=ReferenceLight.of(gradient, None, [], "a gradient"))).report
    assert calm["windowing"]["rings"] is False and calm["windowing"]["cost"] == 0.0
    assert any("ringing" in item["what"] for item in calm["left_out"])
    image = np.zeros((32, 64, 3), np.float32)
    image[4, 20] = 100.0
    sharp = exhaust(bake(still_life(), replace(SMALL, error_receivers=0),
                         light=ReferenceLight.of(image, None, [], "one pixel"))).report
    assert sharp["windowing"]["rings"] is True and 0.0 < sharp["windowing"]["cost"] < 1.0
    assert not any("ringing" in item["what"] for item in sharp["left_out"])


def test_every_setting_can_be_overridden_by_its_name():
    for name, value in BakeSettings().as_dict().items():
        overrides = parse_overrides(f" {name} = {value},")
        assert overrides == {name: str(value)}
        assert make_settings("standard", overrides) == BakeSettings()
    with pytest.raises(BadArguments, match="NAME=VALUE"):
        parse_overrides("order")
