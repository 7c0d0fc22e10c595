# SPDX-License-Identifier: GPL-3.0-or-later
"""The error budget of highlights under lamps: what it says of spoilt data, and its paths against those of a sun."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from prt_addon.baking import recipe
from prt_addon.baking.highlight_reference import ALL_HITS, TrueSurfaces, arriving_radiance
from prt_addon.baking.recipe import bake, exhaust
from prt_addon.baking.settings import make_settings
from prt_addon.baking.surfaces import plan_surfaces
from prt_addon.lighting.light_cloud import box_matrix
from prt_addon.reporting.headline import headline
from prt_addon.reporting.html_report import render
from prt_addon.scene.scene_mesh import SceneMesh
from prt_addon.scene.surface_material import SurfaceMaterial
from prt_addon.tracing.tracer import Tracer
from prt_addon.transport.path_reference import DistantSuns, PointLights
from tests.core.shapes import plane, sphere

SETTINGS = make_settings("draft", {"spacing": "0", "threads": "1", "directions": "256", "gather_directions": "256",
                                   "lighting": "local", "lamp_basis": "cloud",
                                   "cloud_emission": "1", "cloud_lights": "27",
                                   "error_receivers": "24", "error_paths": "2048", "vectors": "12"})
REGIONS = np.array([box_matrix((-1.5, -1.5, 0.2), (1.5, 1.5, 2.2))])


def golden_ball():
    """A ball of rough gold over a floor."""
    gold = SurfaceMaterial(metallic=1.0, roughness=0.7, base_colour=(0.9, 0.7, 0.3))
    ball = sphere(centre=(0, 0, 0.8), radius=0.6, subdivisions=3)
    ball = replace(ball, corner_albedo=np.zeros_like(ball.corner_albedo), materials=(gold,),
                   material_index=np.zeros(len(ball.triangles), np.int32))
    return SceneMesh.assemble([plane(size=3.0, cells=14), ball])


@pytest.fixture(scope="module")
def measured():
    """The report of a bake, and its budget with rows as they are, twice as bright, and spoilt after the encoding."""
    found, original = {}, recipe.local_highlight_budget

    def spoilt(surfaces, sample, *arguments):
        found["plain"] = yield from original(surfaces, sample, *arguments)
        double = replace(sample, rows=2.0 * sample.rows, compressed=2.0 * sample.rows)
        found["double"] = yield from original(surfaces, double, *arguments)
        found["spoilt"] = yield from original(surfaces, replace(sample, compressed=1.1 * sample.rows), *arguments)
        return found["plain"]

    recipe.local_highlight_budget = spoilt
    try:
        report = exhaust(bake(golden_ball(), SETTINGS, regions=REGIONS)).report
    finally:
        recipe.local_highlight_budget = original
    return report, found


def test_what_is_spoilt_shows_where_it_was_spoilt(measured):
    _, found = measured
    rms = {name: {part: entry["relative_rms"] for part, entry in budget.items()} for name, budget in found.items()}
    plain = rms["plain"]
    assert set(plain) == {"baked", "bounces", "compression", "total", "direct"}
    assert 0.02 < plain["total"] < 0.4 and plain["compression"] < 0.1 and plain["bounces"] < 0.1
    assert 0.01 < plain["direct"] < 0.3  # 16 functions of a lamp in gold of roughness 0.7
    assert rms["double"]["compression"] == 0.0 and 0.7 < rms["double"]["total"] < 1.7
    assert 0.08 < rms["spoilt"]["compression"] < 0.13 and rms["spoilt"]["baked"] == plain["baked"]
    low, high = found["plain"]["total"]["interval"]
    assert low <= plain["total"] <= high


def test_report_and_headline_tell_of_it(measured):
    report, _ = measured
    assert "(highlights of lamps)" in headline(report)
    assert "Highlights under lamps" in render(report) and "The lamp itself" in render(report)


def test_a_far_point_is_a_sun(measured):
    """Paths lit by a point far away bring what those of a sun of its irradiance bring."""
    scene = golden_ball()
    tracer = Tracer(scene.points, scene.triangles, 1)
    plan = plan_surfaces(scene, SETTINGS)
    surfaces = TrueSurfaces.of(tracer, scene, plan, np.full((len(scene.points), 3), 0.6, np.float32))
    generator = np.random.Generator(np.random.PCG64(5))
    directions = generator.normal(size=(4000, 3))
    directions /= np.sqrt(np.sum(directions ** 2, axis=1, keepdims=True))
    origins = np.repeat(tracer.to_tracing_space(np.array([[0.0, -1.0, 0.4]])), 4000, axis=0)
    towards = np.array([0.3, -0.5, 0.8]) / np.sqrt(0.98)
    distance = 1e3

    def nothing(outwards):
        return np.zeros((len(outwards), 1, 3))

    def brought(lights):
        found, _ = arriving_radiance(surfaces, origins, directions.astype(np.float32), nothing, lights, 3,
                                     (0, ALL_HITS), [7])
        return found[:, :, 0]

    sun = brought(DistantSuns(towards[None], np.full((1, 3), distance ** -2), np.zeros(1)))
    point = brought(PointLights(distance * towards[None]))
    assert sun.max() > 0.0
    for depth in range(2):
        assert abs(point[:, depth].mean() / sun[:, depth].mean() - 1.0) < 0.05
