# SPDX-License-Identifier: GPL-3.0-or-later
"""Texels as receivers: against vertices at the same places, closed forms, and the true surface that rays meet."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import cKDTree

from prt_addon.baking.job import read_job, read_result, run_job, write_job
from prt_addon.baking.recipe import bake, exhaust
from prt_addon.baking.settings import PRESETS, check, make_settings
from prt_addon.basis.directions import quadrature
from prt_addon.errors import BadArguments, BadScene
from prt_addon.relighting.exit_radiance import diffuse_radiance
from prt_addon.relighting.texel_light import atlas_picture, texel_radiance
from prt_addon.scene.needs import is_lone_convex
from prt_addon.scene.scene_mesh import SceneMesh
from prt_addon.scene.surface_material import SurfaceMaterial
from prt_addon.scene.texel_receivers import TexelChoice
from prt_addon.tracing.tracer import Tracer
from prt_addon.transport.direct import direct_transfer
from prt_addon.transport.gather import gather_operator
from prt_addon.transport.receiver_set import ReceiverSet
from tests.core.shapes import box, drain, make, plane, sphere

TEXELS = TexelChoice("texels")
QUICK = replace(PRESETS["draft"], directions=512, error_receivers=0, threads=1, bounces=1)


def direct_of(scene, order=4, directions=1024):
    """Direct transfer (p, columns) of a scene's targets by point."""
    tracer = Tracer.of_scene(scene, 1)
    receivers = ReceiverSet.of_keys(scene, tracer, np.arange(scene.objects[0].points.stop))
    found = drain(direct_transfer(tracer, receivers, *quadrature(directions, order), order, 0, 1, True, None))
    result = np.zeros_like(found)
    result[receivers.key] = found
    return result


def test_texels_at_the_places_of_vertices_have_their_transfer():
    floor, block = plane(size=2.0, cells=8), box("block", (-0.3, -0.4, 0.2), (0.5, 0.1, 0.8), target=False)
    fine = SceneMesh.assemble([floor, block])
    spacing = 0.25 / np.sqrt(8.0)  # of the diagonal: the cells' size
    coarse = SceneMesh.assemble([plane(size=2.0), block], spacing, None, TEXELS)
    points = coarse.points[coarse.objects[0].points]
    assert len(points) == 81 and coarse.surfaces[1] is None
    away, place = cKDTree(fine.points[fine.objects[0].points]).query(points)
    assert away.max() < 1e-12
    vertices, texels = direct_of(fine), direct_of(coarse)
    assert np.abs(texels - vertices[place]).max() < 2e-3 * np.abs(vertices).max()
    assert (vertices.std(axis=0) > 0).any()


def test_hits_on_the_true_surface_are_named_by_texels_around_them():
    ball = sphere(subdivisions=2)
    objects = [ball, box("b", (2, 0, 0), (3, 1, 2)), plane("p", 6.0, -1.5, target=False)]
    scene = SceneMesh.assemble(objects, 1 / 40, None, TEXELS)
    tracer = Tracer.of_scene(scene, 1)
    generator = np.random.default_rng(3)
    origins = tracer.to_tracing_space(generator.normal(0.0, 4.0, (3000, 3)) + np.array([0, 0, 5]))
    directions = generator.normal(0.0, 1.0, (3000, 3)).astype(np.float32) - 0.3 * origins * tracer.diagonal
    directions = (directions / np.linalg.norm(directions, axis=1, keepdims=True)).astype(np.float32)
    hits = tracer.nearest(origins, directions)
    met = np.flatnonzero(hits.triangle >= 0)
    assert len(met) > 500
    true = origins[met].astype(float) + hits.distance[met, None] * directions[met]
    place, _ = tracer.surface.places(*(values[met] for values in hits.traced))
    assert np.abs(tracer.to_tracing_space(place) - true).max() < 1e-5
    corners = scene.points[scene.triangles[hits.triangle[met]]]
    u, v = hits.u[met, None].astype(float), hits.v[met, None].astype(float)
    blended = corners[:, 0] * (1 - u - v) + corners[:, 1] * u + corners[:, 2] * v
    owner = np.searchsorted([o.triangles.stop for o in scene.objects], hits.triangle[met], side="right")
    off = np.sqrt(np.sum((blended - place) ** 2, axis=1))
    texel = np.array([s.texel if s else 1e-4 for s in scene.surfaces])
    assert set(owner) == {0, 1, 2} and (off < 0.75 * texel[owner]).all()
    assert off[owner == 1].max() < 1e-5  # texels on a box end on its edges: the blend is exact
    # Only the true triangles are traced, and convexity is that of the true surface.
    assert len(tracer.surface.triangles) == 320 + 12 + len(scene.triangles[scene.objects[2].triangles])
    assert is_lone_convex(SceneMesh.assemble([ball], 1 / 40, None, TEXELS))


def test_a_closed_white_room_keeps_its_light():
    # Light that is 1 everywhere in a closed white room stays so: rows of the operator sum to 1.
    scene = SceneMesh.assemble([box(inward=True)], 1 / 12, np.array([[0.5, 0.5, 0.5]]), TEXELS)
    tracer = Tracer.of_scene(scene, 1)
    gathered = drain(gather_operator(tracer, scene, np.arange(len(scene.points)), *quadrature(256, 4)))
    rows = np.asarray(gathered.matrix.sum(axis=1)).ravel()
    assert np.abs(rows - 1.0).max() < 1e-3 and gathered.back_share < 1e-3 and gathered.lost_share == 0.0


def test_a_low_poly_room_is_as_exact_as_a_refined_one_of_as_many_receivers():
    room = box("room", (-2, -2, 0), (2, 2, 3), inward=True, albedo=(0.8, 0.5, 0.4))
    room = room.with_triangles(room.positions[room.triangles][:, :, 2].min(1) < 2.9)
    objects = [room, box("block", (-0.5, -0.5, 0.3), (0.5, 0.6, 1.2), albedo=(0.3, 0.6, 0.8))]
    found = {}
    for name, spacing in (("texels", 1 / 20), ("vertices", 1 / 16)):
        scene = SceneMesh.assemble(objects, spacing, None, TexelChoice(name))
        report = exhaust(bake(scene, replace(PRESETS["draft"], error_receivers=96, error_paths=2048, threads=1))).report
        found[name] = len(scene.points), report["errors"]["total"]["relative_rms"]
    assert found["texels"][0] < 1.1 * found["vertices"][0]
    assert found["texels"][1] < 1.3 * found["vertices"][1] + 0.005 and found["texels"][1] < 0.08


def test_a_job_bakes_texels_and_its_result_holds_their_atlas(tmp_path):
    floor = plane(size=2.0, albedo=(0.7, 0.3, 0.2))
    block = box("block", (-0.3, -0.4, 0.1), (0.5, 0.1, 0.8))
    scene = SceneMesh.assemble([floor, block], 1 / 30, None, TexelChoice("auto", 64))
    assert all(scene.surfaces) and "texels in 1 chart of" in scene.warnings[0]
    folder = write_job(tmp_path, scene, QUICK)
    again = read_job(folder)[0]
    assert np.array_equal(again.points, scene.points) and np.array_equal(again.faces, scene.faces)
    assert all(np.array_equal(a, b) for s, t in zip(again.surfaces, scene.surfaces, strict=True)
               for a, b in zip(s.arrays().values(), t.arrays().values(), strict=True))
    for _ in run_job(folder):
        pass
    baked = read_result(folder).objects["plane"]
    direct = exhaust(bake(scene, QUICK)).objects["plane"]
    assert np.array_equal(baked.weights, direct.weights) and np.array_equal(baked.bases, direct.bases)
    assert baked.header["schema"] == 5 and baked.header["atlas"]["charts"] == 1
    assert baked.drawn[1].shape == (2, 3) and baked.faces.shape == baked.positions.shape
    light = np.zeros((16, 3), np.float32)
    light[0] = 3.0
    radiance = diffuse_radiance(baked, light)
    # At the texels themselves the filter gives their own values.
    own = texel_radiance(baked, light, baked.texels.triangle, *_weights_at_texels(baked.texels))
    assert np.allclose(own, radiance, atol=1e-5)
    picture = atlas_picture(baked.texels, radiance, 2)
    assert np.array_equal(picture[baked.texels.row, baked.texels.column], radiance)


def _weights_at_texels(surface):
    """u, v of each texel on its triangle, from its place in the atlas (a square's texels lie on it)."""
    corners = surface.places[surface.triangle].astype(float)
    at = np.stack([surface.column, surface.row], axis=1) - corners[:, 0]
    edges = np.stack([corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]], axis=2)
    return np.linalg.solve(edges, at[:, :, None])[:, :, 0].T


def test_highlights_and_bodies_are_baked_at_texels():
    metal = SurfaceMaterial("metal", (0.9, 0.7, 0.4), 0.5, 1.0)
    wax = SurfaceMaterial("wax", (0.8, 0.7, 0.6), subsurface_weight=1.0, subsurface_radius=(0.1, 0.08, 0.05))
    objects = [replace(plane(size=2.0), materials=(metal,)),
               replace(box("block", (-0.3, -0.4, 0.1), (0.5, 0.1, 0.8)), materials=(wax,))]
    found = {}
    for name, spacing in (("texels", 1 / 20), ("vertices", 1 / 14)):
        scene = SceneMesh.assemble(objects, spacing, None, TexelChoice(name))
        result = exhaust(bake(scene, QUICK))
        assert all(c["verdict"] == "ok" or "ring" in c["verdict"] for c in result.report["stability"])
        light = np.zeros((16, 3), np.float32)
        light[0], light[2] = 3.0, 1.0
        found[name] = {}
        for key, baked in result.objects.items():
            assert len(baked.functions)
            rows = np.einsum("pk,pkrcn,c->prn", np.pad(baked.weights, ((0, 0), (1, 0)), constant_values=1.0),
                             baked.bases[baked.cluster], light[:, 0])
            found[name][key] = rows.mean(axis=(0, 2))
    for key in ("plane", "block"):
        a, b = found["texels"][key], found["vertices"][key]
        assert np.abs(a - b).max() < 0.06 * np.abs(b).max()


def test_what_makes_no_sense_is_refused_in_words():
    with pytest.raises(BadArguments, match="setting receivers: 'pixels' is unknown"):
        make_settings("draft", {"receivers": "pixels"})
    with pytest.raises(BadArguments, match="setting atlas_size"):
        make_settings("draft", {"atlas_size": "4"})
    assert check(QUICK).texels is None and make_settings("draft", {"receivers": "auto"}).texels.receivers == "auto"
    crowd = sphere(subdivisions=2, smooth=False)
    with pytest.raises(BadScene, match="sphere: its 320 charts do not fit an atlas of 16 x 16"):
        SceneMesh.assemble([crowd], 1 / 30, None, TexelChoice("texels", 16))


def test_automatic_texels_are_for_coarse_objects():
    objects = [plane(size=4.0), sphere(subdivisions=3, centre=(0, 0, 1.5)), plane("fine", 4.0, -0.1, cells=48)]
    scene = SceneMesh.assemble(objects, 1 / 64, None, TexelChoice("auto"))
    assert [s is not None for s in scene.surfaces] == [True, False, False]
    assert scene.surfaces[0].charts == 1


def test_loose_vertices_do_not_matter():
    mesh = make("t", [(0, 0, 0), (1, 0, 0), (0, 1, 0), (5, 5, 5)], [(0, 1, 2)])
    scene = SceneMesh.assemble([mesh], 1 / 10, None, TEXELS)
    assert not scene.loose.any() and scene.points.max() <= 1.0
