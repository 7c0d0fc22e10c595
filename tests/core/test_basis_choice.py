# SPDX-License-Identifier: GPL-3.0-or-later
"""The automatic choice: what it takes under soft and hard light, that it keeps the asked error, what it says."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from prt_addon.baking import basis_choice
from prt_addon.baking.basis_choice import choose_basis
from prt_addon.baking.light_probe import LightProbe
from prt_addon.baking.recipe import bake, exhaust
from prt_addon.baking.settings import BakeSettings, make_settings
from prt_addon.errors import BadArguments
from prt_addon.lighting.reference_light import ReferenceLight
from prt_addon.reporting.html_report import render
from prt_addon.reporting.report_file import problem_of
from prt_addon.reporting.summary import summary
from prt_addon.scene.scene_mesh import SceneMesh
from prt_addon.scene.surface_material import SurfaceMaterial
from prt_addon.scene.texel_receivers import TexelChoice
from tests.core.shapes import plane, sphere

AUTO = {"distant_basis": "auto", "encoder": "auto", "threads": "1"}


def still_life(metal=False):
    ball = sphere(centre=(0, 0, 0.9), radius=0.8, subdivisions=4)
    if metal:
        gold = SurfaceMaterial(name="Gold", metallic=1.0, roughness=0.4, base_colour=(0.9, 0.7, 0.3))
        ball = replace(ball, corner_albedo=np.zeros_like(ball.corner_albedo), materials=(gold,),
                       material_index=np.zeros(len(ball.triangles), np.int32))
    return SceneMesh.assemble([plane(size=4.0, cells=40), ball])


def light(sky=0.0, sun=0.0):
    direction = np.array([0.5, 0.3, 0.8]) / np.linalg.norm([0.5, 0.3, 0.8])
    suns = [(direction, np.full(3, sun), 0.01)] if sun else []
    image = np.full((64, 128, 3), sky) * np.linspace(1.5, 0.5, 64)[:, None, None]
    return ReferenceLight.of(image, None, suns, "test")


@pytest.fixture(scope="module")
def scene():
    return still_life()


def chosen(scene, of_light, **more):
    settings, choice = choose_basis(scene, make_settings("standard", {**AUTO, **more}), of_light)
    assert "auto" not in (settings.distant_basis, settings.encoder)
    return settings, choice


def beyond_harmonics(scene, of_light, **more):
    """An error that no order keeps, and some cubemap does."""
    _, choice = chosen(scene, of_light, **more)
    errors = {kind: min(c["predicted_error"] for c in choice.facts["candidates"] if c["distant_basis"] == kind)
              for kind in ("sh", "cubemap")}
    assert errors["cubemap"] < errors["sh"]
    return 0.5 * (errors["cubemap"] + errors["sh"])


def test_a_soft_sky_gets_few_harmonics_and_a_sun_a_cubemap(scene):
    settings, choice = chosen(scene, light(1.0))
    assert (settings.distant_basis, settings.order, settings.encoder) == ("sh", 3, "iterative")
    assert choice.line.startswith("Sky by spherical harmonics of order 3: about ")
    asked = beyond_harmonics(scene, light(0.1, 3.0))
    settings, choice = chosen(scene, light(0.1, 3.0), light_error=str(asked))
    assert settings.distant_basis == "cubemap" and choice.facts["chosen"]["predicted_error"] <= asked
    assert "harmonics of order 10 would lose" in choice.line and choice.line.count(" asked") == 1


def test_a_smaller_error_never_costs_less(scene):
    costs, errors = [], []
    for asked in ("0.3", "0.12", "0.1", str(beyond_harmonics(scene, light(0.3, 3.0)))):
        _, choice = chosen(scene, light(0.3, 3.0), light_error=asked)
        found = choice.facts["chosen"]
        costs.append(found["stored_bytes"] * found["seconds"])
        errors.append(found["predicted_error"] / float(asked))
    assert costs == sorted(costs) and max(errors) <= 1.0


def test_nothing_that_keeps_the_error_is_said(scene):
    _, choice = chosen(scene, light(0.0, 3.0), light_error="0.001")
    least = min(found["predicted_error"] for found in choice.facts["candidates"])
    assert "more than the 0.10 % asked" in choice.line
    assert choice.facts["chosen"]["predicted_error"] <= basis_choice.NEAR_LEAST * least


def test_what_the_artist_chose_stays(scene):
    settings, choice = chosen(scene, light(0.1, 3.0), distant_basis="sh", order="4")
    assert (settings.distant_basis, settings.order, settings.encoder, choice) == ("sh", 4, "iterative", None)
    settings, choice = chosen(scene, light(0.1, 3.0), distant_basis="cubemap", cubemap_size="8")
    assert settings.cubemap_size == 8 and {c["distant_basis"] for c in choice.facts["candidates"]} == {"cubemap"}
    settings, _ = chosen(scene, light(0.1, 3.0), encoder="static")
    assert settings.encoder == "static"
    plain = BakeSettings()
    assert choose_basis(scene, plain, light(1.0)) == (plain, None)
    settings, choice = chosen(scene, light(1.0), lighting="local")
    assert (settings.distant_basis, choice) == ("sh", None)


@pytest.mark.parametrize(("goal", "method"), [("0.01", "static"), ("0.002", "iterative"), ("0.0005", "adaptive"),
                                              ("0", "iterative")])
def test_clusters_are_found_as_presets_find_them(scene, goal, method):
    settings, _ = chosen(scene, light(1.0), distant_basis="sh", compression_error=goal)
    assert settings.encoder == method


def test_highlights_are_not_baked_at_any_price():
    """Texels in rows of highlights cost many times what harmonics do: they are not taken, and the line says so."""
    scene = still_life(metal=True)
    settings, choice = chosen(scene, light(0.0, 3.0), light_error="0.02")
    found, candidates = choice.facts["chosen"], choice.facts["candidates"]
    assert found["seconds"] <= choice.facts["most_seconds"] < max(c["seconds"] for c in candidates)
    usual = next(c for c in candidates if c.get("order") == 5)["seconds"]
    assert choice.facts["most_seconds"] == pytest.approx(basis_choice.MOST_TIMES * usual)
    assert "more than the 2.0 % asked; a cubemap of 32 texels in clusters would lose" in choice.line
    assert choice.line.endswith("times as long") and "eigentransport" not in {c["encoder"] for c in candidates}
    without, _ = chosen(scene, light(0.0, 3.0), light_error="0.02", glossy_rows="0")
    assert without.distant_basis == "cubemap" and without.cubemap_size > settings.cubemap_size * (
        settings.distant_basis == "cubemap")


def test_columns_of_lamps_keep_clusters(scene):
    _, choice = chosen(scene, light(0.1, 3.0), lighting="environment,local", light_error="0.04")
    assert "eigentransport" not in {c["encoder"] for c in choice.facts["candidates"]}


def test_vectors_for_all_suit_soft_lights_and_clusters_suns():
    """Clusters leave a little of every light, vectors for all none of a soft one."""
    soft = LightProbe(tuple(0.3 * 0.7 ** order for order in range(14)), {8: 0.02, 16: 0.004, 32: 0.001}, 192, 1)
    assert basis_choice.vectors_error(soft, 192) < basis_choice.vectors_error(soft, 48)
    assert basis_choice.clusters_error(soft, 256, 8) > 1.5 * basis_choice.vectors_error(soft, 192)
    sharp = LightProbe((0.15,) * 14, {8: 0.05, 16: 0.04, 32: 0.01}, 192, 1)
    assert basis_choice.clusters_error(sharp, 256, 8) < basis_choice.vectors_error(sharp, 192)
    assert basis_choice.clusters_error(sharp, 1024, 20) < basis_choice.clusters_error(sharp, 256, 8)
    assert np.isfinite(basis_choice.clusters_error(sharp, 1, 0))


def test_no_light_is_judged_under_the_stand_in_sky(scene):
    _, none = chosen(scene, None)
    _, black = chosen(scene, light())
    assert none.line == black.line and none.facts["light"] == "a stand-in sky"


def test_the_report_tells_the_choice(scene):
    quick = {"error_receivers": "0", "spacing": "0", "directions": "256", "gather_directions": "64"}
    asked = beyond_harmonics(scene, light(0.1, 3.0), **quick)
    settings = make_settings("standard", {**AUTO, **quick, "light_error": str(asked)})
    report = exhaust(bake(scene, settings, light=light(0.1, 3.0))).report
    assert report["choice"]["line"] and report["settings"]["distant_basis"] == "cubemap"
    assert report["basis"].startswith("Sky by a cubemap of 6 x ") and report["basis"].endswith("columns")
    assert problem_of(report) is None
    page = render(report)
    assert "What the sky is held in" in page and "harmonics of order 10" in page and "Predicted error" in page
    assert any(line.text == report["choice"]["line"] for line in summary(report))
    assert any(item["what"].startswith("sparse sampling") for item in report["left_out"])


def test_settings_that_are_no_choice_are_refused():
    for wrong in ({"light_error": "0"}, {"light_error": "2"}, {"encoder": "automatic"}):
        with pytest.raises(BadArguments):
            make_settings("standard", wrong)


def test_texels_of_an_atlas_are_asked_as_vertices_are(scene):
    """Receivers that are texels see the true surface, so that they tell about the same of the light."""
    meshes = [plane(size=4.0), sphere(centre=(0, 0, 0.9), radius=0.8, subdivisions=3)]
    texels = SceneMesh.assemble(meshes, 1 / 40, None, TexelChoice("texels"))
    _, ours = chosen(texels, light(0.3, 3.0))
    _, theirs = chosen(scene, light(0.3, 3.0))
    for found, other in zip(ours.facts["candidates"], theirs.facts["candidates"], strict=True):
        assert 0.5 < found["basis_error"] / other["basis_error"] < 2.0
