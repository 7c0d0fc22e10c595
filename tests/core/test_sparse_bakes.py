# SPDX-License-Identifier: GPL-3.0-or-later
"""Bakes whose direct light is sampled sparsely, against the same bakes of every element; and their elements against
the columns of `cubemap_transfer`."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from prt_addon.baking.distant_basis import DistantBasis
from prt_addon.baking.plan import make_plan
from prt_addon.baking.recipe import bake, exhaust
from prt_addon.baking.sampling import can_start_dense, choose, encode_from_dense
from prt_addon.baking.settings import BakeSettings, make_settings
from prt_addon.baking.sparse_choice import SPARSE
from prt_addon.compression.settings import EncoderSettings
from prt_addon.errors import BadArguments
from prt_addon.lighting.reference_light import ReferenceLight
from prt_addon.relighting.exit_radiance import diffuse_radiance
from prt_addon.reporting.html_report import render
from prt_addon.reporting.report_file import problem_of
from prt_addon.scene.scene_mesh import SceneMesh
from prt_addon.tracing.tracer import Tracer
from prt_addon.transport.cubemap_transfer import cubemap_transfer
from prt_addon.transport.receiver_set import ReceiverSet
from prt_addon.transport.texel_elements import TexelElements
from tests.core.shapes import drain, join, make, plane, sphere

WOVEN = BakeSettings(distant_basis="cubemap", cubemap_size=8, directions=1024, gather_directions=64, vectors=12,
                      clusters=24, encoder="iterative", spacing=0.0, compression_error=1e-3, error_receivers=0,
                      sampling="sparse", threads=1)


def still_life(cells=40, subdivisions=4):
    return SceneMesh.assemble([plane(size=4.0, cells=cells, albedo=(0.6,) * 3),
                               sphere(centre=(0, 0, 0.9), radius=0.8, subdivisions=subdivisions, albedo=(0.5,) * 3)])


def sunny():
    sky = np.full((16, 32, 3), 0.3) * np.linspace(1.5, 0.5, 16)[:, None, None]
    sun = (np.array([0.5, 0.3, 0.8]) / np.linalg.norm([0.5, 0.3, 0.8]), np.array([3.0, 2.5, 2.0]), 0.35)
    return ReferenceLight.of(sky, None, [sun], "a sky with a soft sun")


def difference(one, other, edge=8):
    light = DistantBasis(0, edge).coefficients(sunny()).astype(np.float32)
    found, truth = (np.concatenate([diffuse_radiance(made.objects[name], light) for name in made.objects])
                    for made in (one, other))
    return float(np.sqrt(np.mean((found - truth) ** 2) / np.mean(truth ** 2)))


@pytest.fixture(scope="module")
def pair():
    return tuple(exhaust(bake(still_life(), replace(WOVEN, sampling=way), light=sunny()))
                 for way in ("sparse", "every"))


@pytest.mark.parametrize(("edge", "samples"), [(2, 3), (4, 2), (6, 1)])
def test_elements_are_the_columns_of_a_bake(edge, samples):
    scene = SceneMesh.assemble([sphere(radius=0.5, centre=(0, 0, 0.6)), plane(size=4.0, cells=15)])
    tracer = Tracer(scene.points, scene.triangles, 2)
    receivers = ReceiverSet.of_keys(scene, tracer, np.flatnonzero(~scene.loose))
    truth = drain(cubemap_transfer(tracer, receivers, edge, samples))
    rays, elements = tracer.rays, TexelElements(tracer, receivers, edge, samples)
    everyone = np.arange(len(receivers))
    column, row = np.nonzero(elements.unknown(everyone).T)
    values = np.zeros((len(receivers), elements.columns), np.float32)
    values[row, column] = elements.evaluate(row, column)
    np.testing.assert_allclose((values * elements.factor(everyone)).T, truth, atol=1e-6)
    assert values.min() >= 0.0 and values.max() <= 1.0 and elements.asked == len(row)
    assert tracer.rays - rays == pytest.approx(rays, rel=1e-3)  # a ray along the horizon, more or less


def test_relit_within_the_error_that_the_report_states(pair):
    sparse, every = pair
    facts = sparse.report["sampling"]
    assert facts["traced"] < 0.2 and facts["checked"] == 128 and every.report["sampling"] == {}
    assert facts["elements"] == pytest.approx(facts["traced"] * facts["of"])
    assert 0.0 < facts["light_error"] < 0.015 and facts["light_error"] < facts["element_error"] < 0.1
    compression = sum(float(np.sqrt(o["relative_error"])) for made in pair
                      for o in made.report["clusters"]["objects"].values()) / 2
    assert difference(sparse, every) < 2.0 * facts["light_error"] + compression
    check = next(c for c in sparse.report["stability"] if "sparse sampling" in c["check"])
    assert check["verdict"] == "ok" and check["value"] == facts["light_error"]
    assert problem_of(sparse.report) is None and "Sparse sampling" in render(sparse.report)
    assert "Sparse sampling" not in render(every.report)


def test_clustered_pca_starts_from_dense_points(pair):
    stages = [stage for o in pair[0].report["clusters"]["objects"].values() for _, stage, _ in o["history"]]
    assert "all points" in stages
    assert "all points" not in [stage for o in pair[1].report["clusters"]["objects"].values()
                                for _, stage, _ in o["history"]]
    for name, found in pair[0].report["clusters"]["objects"].items():
        assert found["relative_error"] < 2.0 * max(pair[1].report["clusters"]["objects"][name]["relative_error"], 1e-6)


def test_the_same_on_any_threads_and_from_a_file(tmp_path):
    settings = replace(WOVEN, bounces=2, clusters=8, vectors=4)
    first = exhaust(bake(still_life(20, 2), settings, light=sunny()))
    for other in (replace(settings, threads=3), replace(settings, memory_budget=1e-6)):
        again = exhaust(bake(still_life(20, 2), other, tmp_path, light=sunny()))
        for name, container in first.objects.items():
            assert np.array_equal(again.objects[name].bases, container.bases)
            assert np.array_equal(again.objects[name].weights, container.weights)
        for left in tmp_path.iterdir():
            assert other.threads == 3 or left.name in ("stages.json", "gather.npz")
            left.unlink()


def test_a_stopped_bake_goes_on_and_tells_the_same(pair, tmp_path):
    for until in ("direct", "encode"):
        steps = bake(still_life(), WOVEN, tmp_path, light=sunny())
        for number, progress in enumerate(steps):
            if progress.stage == until and (until == "encode" or number > 8):
                break
        steps.close()
    assert (tmp_path / "direct.npz").exists()
    again = exhaust(bake(still_life(), WOVEN, tmp_path, light=sunny()))
    assert "direct" in again.report["resumed"] and again.report["sampling"] == pair[0].report["sampling"]
    for name, container in again.objects.items():
        assert np.array_equal(container.weights, pair[0].objects[name].weights)


def test_progress_grows_to_the_end():
    fractions = [step.fraction for step in bake(still_life(20, 2), replace(WOVEN, bounces=0, encoder="static"))]
    assert len(fractions) > 4 and fractions == sorted(fractions)


def test_extreme_scenes():
    """Parts far apart, a point without neighbours, points in one place, few receivers, two texels along an edge."""
    far = sphere("far", radius=0.3, centre=(400.0, 0, 0.3), subdivisions=1)
    twice = join("twice", plane(size=1.0, cells=6, height=-1.0), plane(size=1.0, cells=6, height=-1.0))
    lone = make("lone", [(0, 0, 9), (0.01, 0, 9), (0, 0.01, 9)], [(0, 1, 2)])
    scene = SceneMesh.assemble([plane(size=4.0, cells=12), sphere(centre=(0, 0, 0.9), radius=0.8), far, twice, lone])
    for edge in (8, 2):
        settings = replace(WOVEN, cubemap_size=edge, directions=64, bounces=1)
        sparse, every = (exhaust(bake(scene, replace(settings, sampling=way), light=sunny()))
                         for way in ("sparse", "every"))
        assert all(np.isfinite(found.bases).all() for found in sparse.objects.values())
        facts = sparse.report["sampling"]
        assert (facts == {}) == (edge == 2)
        if facts:  # a mesh so coarse is woven badly, and the report says so
            assert difference(sparse, every, edge) < 1.5 * facts["light_error"] < 0.2
            check = next(c for c in sparse.report["stability"] if "sparse sampling" in c["check"])
            assert "sampling=every" in check["verdict"]
        else:
            assert difference(sparse, every, edge) == 0.0
    assert any("too coarse" in line["why"] for line in sparse.report["left_out"])
    one = SceneMesh.assemble([lone, replace(plane(size=0.1, height=9.5, up=False), is_target=False)])
    assert len(exhaust(bake(one, WOVEN)).objects["lone"].weights) == 3


def test_other_encoders_and_lamps_take_sparse_columns():
    for change in ({"encoder": "eigentransport"}, {"encoder": "adaptive", "vectors": 3},
                   {"lighting": "environment,local", "surface_columns": 8, "surface_patches": 32, "cloud_lights": 4}):
        scene = SceneMesh.assemble([plane(size=4.0, cells=12), sphere(centre=(0, 0, 0.9), radius=0.8)])
        settings = replace(WOVEN, bounces=1, clusters=6, vectors=4)
        found = exhaust(bake(scene, replace(settings, **change), light=sunny()))
        assert found.report["sampling"]["chosen"] == "sparse"


def test_automatic_takes_every_element_and_says_why():
    settings = replace(WOVEN, sampling="automatic", bounces=0, clusters=4, vectors=2)
    scene = SceneMesh.assemble([plane(size=4.0, cells=12), sphere(centre=(0, 0, 0.9), radius=0.8)])
    found = exhaust(bake(scene, settings, light=sunny()))
    lines = [line for line in found.report["left_out"] if line["what"] == SPARSE]
    assert len(lines) == 1 and "tracing all of them takes about" in lines[0]["why"] and found.report["sampling"] == {}


def test_automatic_by_the_cost_of_an_element_and_the_error_asked_for(monkeypatch):
    scene = SceneMesh.assemble([sphere(radius=0.5, centre=(0, 0, 0.6)), plane(size=4.0, cells=15)])
    tracer = Tracer(scene.points, scene.triangles, 1)
    elements = TexelElements(tracer, ReceiverSet.of_keys(scene, tracer, np.flatnonzero(~scene.loose)), 8, 2)
    automatic = replace(WOVEN, sampling="automatic")
    for cost, error, expected in ((1e-7, 0.02, False), (1e-3, 0.02, True), (1e-3, 0.002, False)):
        monkeypatch.setattr("prt_addon.baking.sampling.element_seconds", lambda *_, cost=cost: cost)
        sparsely, line = choose(elements, replace(automatic, compression_error=error), True)
        assert sparsely == expected and (line is None) == expected
        assert expected or ("compression_error" in line.why) == (cost == 1e-3)
    assert choose(elements, replace(automatic, sampling="every"), True) == (False, None)
    assert choose(elements, replace(automatic, sampling="sparse"), True) == (True, None)
    assert not choose(elements, replace(automatic, sampling="sparse"), False)[0]
    assert "highlights" in choose(elements, replace(automatic, sampling="sparse"), True, True)[1].why


def test_points_in_one_place_join_themselves():
    signal = np.random.default_rng(0).random((40, 24)).astype(np.float32)
    dense = np.arange(40) % 2 == 0
    found = encode_from_dense(signal, dense, np.zeros((40, 3)), EncoderSettings(4, 2, threads=1, restarts=0), None)
    assert np.isfinite(found.weights).all() and len(found.weights) == 40
    assert not can_start_dense(np.zeros(4, bool), "static") and not can_start_dense(np.ones(4, bool), "static")
    assert not can_start_dense(dense, "eigentransport") and can_start_dense(dense, "adaptive")


def test_settings_and_forecast():
    assert make_settings("draft", {"sampling": "sparse"}).sampling == "sparse"
    with pytest.raises(BadArguments, match="sampling"):
        make_settings("draft", {"sampling": "some"})
    scene = still_life()
    sparse, every = (make_plan(scene, replace(WOVEN, sampling=way), None) for way in ("sparse", "every"))
    assert sparse.rays["direct"] < 0.3 * every.rays["direct"]
    assert sparse.peak_bytes >= every.peak_bytes
    harmonics = make_plan(scene, replace(WOVEN, distant_basis="sh"), None)
    assert any("distant_basis=cubemap" in hint for hint in harmonics.needs.hints)
