# SPDX-License-Identifier: GPL-3.0-or-later
"""Charts, atlases and their texels, against closed forms and against the surfaces that they came from."""

from __future__ import annotations

import numpy as np
import pytest

from prt_addon.errors import BadScene, PRTError
from prt_addon.scene import unwrapping
from prt_addon.scene.atlas import Atlas, make_atlas, nearest_in_triangles
from prt_addon.scene.charts import face_normals, projected_charts
from prt_addon.scene.scene_mesh import SceneMesh
from tests.core.shapes import box, make, plane, sphere


def atlas_of(mesh, **options):
    """The atlas of one object after SceneMesh split its points, and that scene."""
    scene = SceneMesh.assemble([mesh])
    return make_atlas(mesh.name, scene.points, scene.normals, scene.triangles, **options), scene


def random_places(scene, count=4000, seed=1):
    """Triangles, u, v evenly over the surface, and where they lie."""
    generator = np.random.default_rng(seed)
    areas = face_normals(scene.points, scene.triangles)[1]
    triangle = generator.choice(len(areas), count, p=areas / areas.sum())
    u, v = generator.random((2, count))
    u, v = np.where(u + v > 1.0, 1.0 - u, u), np.where(u + v > 1.0, 1.0 - v, v)
    corners = scene.points[scene.triangles[triangle]]
    at = corners[:, 0] + u[:, None] * (corners[:, 1] - corners[:, 0]) + v[:, None] * (corners[:, 2] - corners[:, 0])
    return triangle, u, v, at


SHAPES = {
    "quad": plane(size=2.0), "cube": box(), "triangle": make("t", [(0, 0, 0), (1, 0, 0), (0.2, 0.7, 0.3)], [(0, 1, 2)]),
    "sphere": sphere(subdivisions=2), "grid": plane(cells=7, size=3.0),
    "sliver": make("s", [(0, 0, 0), (5, 0, 0), (2, 0.01, 0)], [(0, 1, 2)]),
}


def test_a_quad_has_texels_on_its_rim_and_a_regular_grid():
    atlas, _ = atlas_of(plane(size=2.0), texel=0.25)
    assert (atlas.width, atlas.height, len(atlas.texels), atlas.charts) == (9, 9, 81, 1)
    assert np.allclose(np.abs(atlas.texels.positions[:, :2]).max(axis=0), 1.0)
    line = np.linspace(-1.0, 1.0, 9)
    assert np.allclose(np.sort(np.unique(np.round(atlas.texels.positions[:, 0], 9))), line)
    assert np.allclose(atlas.texels.areas.sum(), 4.0)
    assert np.allclose(np.sort(atlas.texels.areas)[[0, -1]], [0.25 ** 2 / 4, 0.25 ** 2])


def test_a_cube_has_six_charts_that_share_no_texel():
    atlas, _ = atlas_of(box(), texel=0.1)
    assert (atlas.charts, len(atlas.texels)) == (6, 6 * 121)
    assert len({*zip(atlas.texels.column, atlas.texels.row, strict=True)}) == len(atlas.texels)
    assert np.allclose(np.bincount(atlas.texels.chart, atlas.texels.areas), 1.0)


@pytest.mark.parametrize("name", SHAPES)
@pytest.mark.parametrize("method", ["projection", "xatlas"])
def test_samples_of_a_smooth_signal_are_right_everywhere(name, method):
    if method == "xatlas" and unwrapping.xatlas_file() is None:
        pytest.skip("no xatlas for this Python")
    atlas, scene = atlas_of(SHAPES[name], side=64, method=method)
    triangle, u, v, at = random_places(scene)
    # Of a linear function of the place a bilinear filter is exact but within a texel of a slanted rim.
    worst = np.abs(atlas.sample(atlas.texels.positions, triangle, u, v) - at).max()
    assert worst < 0.75 * atlas.texel * np.sqrt(3.0)
    mean = np.sqrt(np.mean((atlas.sample(atlas.texels.positions, triangle, u, v) - at) ** 2))
    assert mean < 0.12 * atlas.texel
    cell, u2, v2 = atlas.on_cell_triangles(triangle, u, v)
    corner = atlas.texels.positions[atlas.cell_triangles()[cell]]
    assert np.all((u2 >= -1e-9) & (v2 >= -1e-9) & (u2 + v2 <= 1.0 + 1e-9))
    linear = corner[:, 0] + u2[:, None] * (corner[:, 1] - corner[:, 0]) + v2[:, None] * (corner[:, 2] - corner[:, 0])
    assert np.abs(linear - at).max() < 1.0 * atlas.texel * np.sqrt(3.0)


@pytest.mark.parametrize("name", SHAPES)
def test_texels_lie_on_the_surface_and_charts_keep_apart(name):
    atlas, scene = atlas_of(SHAPES[name], side=48)
    texels = atlas.texels
    corners = scene.points[scene.triangles[texels.triangle]]
    assert np.allclose(np.sum(texels.barycentric[:, :, None] * corners, axis=1), texels.positions)
    assert texels.barycentric.min() >= 0.0 and np.allclose(texels.barycentric.sum(axis=1), 1.0)
    assert np.allclose(np.sum(texels.normals ** 2, axis=1), 1.0)
    assert np.abs(np.sum(texels.normals * texels.tangents, axis=1)).max() < 1e-6
    assert np.isclose(texels.areas.sum(), face_normals(scene.points, scene.triangles)[1].sum())
    assert max(atlas.width, atlas.height) <= 48
    # All four texels of a square belong to one chart.
    assert (np.ptp(texels.chart[atlas.cells], axis=1) == 0).all()
    picture = atlas.picture(texels.chart + 1)
    for shift in ((0, 1), (1, 0), (1, 1), (0, 2), (2, 0)):  # two empty texels between charts
        near = picture[shift[0]:, shift[1]:], picture[:picture.shape[0] - shift[0], :picture.shape[1] - shift[1]]
        assert not ((near[0] != near[1]) & (near[0] > 0) & (near[1] > 0)).any()


def test_no_chart_overlaps_itself():
    for mesh in (sphere(subdivisions=2), box()):
        atlas, _ = atlas_of(mesh, side=80)
        places = np.stack([atlas.texels.column, atlas.texels.row], axis=1).astype(float)
        inner = np.flatnonzero(atlas.texels.outside == 0.0)
        covered = np.zeros(len(inner))
        for triangle in atlas.places:
            weights, distance = nearest_in_triangles(places[inner], np.broadcast_to(triangle, (len(inner), 3, 2)))
            covered += (distance == 0.0) & (weights.min(axis=1) > 1e-6)
        assert covered.max() == 1


def test_a_ramp_over_itself_is_parted():
    angle = np.linspace(0.0, 4.0 * np.pi, 41)  # two turns, one over the other
    rim = [np.stack([r * np.cos(angle), r * np.sin(angle), angle * 0.1], axis=1) for r in (1.0, 2.0)]
    inner, outer = np.arange(40), 41 + np.arange(40)
    triangles = np.concatenate([np.stack([inner, outer, outer + 1], axis=1), np.stack([inner, outer + 1, inner + 1],
                                                                                      axis=1)])
    atlas, scene = atlas_of(make("ramp", np.concatenate(rim), triangles, smooth=True), side=128)
    assert projected_charts(scene.points, scene.triangles).count == 1 and atlas.charts == 80
    triangle, u, v, at = random_places(scene)
    assert np.abs(atlas.sample(atlas.texels.positions, triangle, u, v) - at).max() < 1.3 * atlas.texel


def test_charts_follow_sharp_edges_only():
    scene = SceneMesh.assemble([sphere(subdivisions=3)])
    assert projected_charts(scene.points, scene.triangles).count == 6
    flat = SceneMesh.assemble([sphere(subdivisions=1, smooth=False)])
    assert projected_charts(flat.points, flat.triangles).count == len(flat.triangles)


def test_the_finest_texels_that_fit_are_chosen():
    for side in (16, 33, 128):
        atlas, _ = atlas_of(box(high=(3, 2, 1)), side=side)
        assert max(atlas.width, atlas.height) <= side
        finer, _ = atlas_of(box(high=(3, 2, 1)), texel=0.9 * atlas.texel)
        assert max(finer.width, finer.height) >= side - 1
    both, _ = atlas_of(box(), texel=0.5, side=4096)
    assert both.texel == pytest.approx(0.5)


def test_degenerate_and_non_manifold_triangles():
    points = [(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1), (0.5, 0.5, -1)]
    fan = make("fan", points, [(0, 1, 2), (0, 1, 3), (0, 1, 4)])  # three faces at one edge
    atlas, scene = atlas_of(fan, side=32)
    triangle, u, v, at = random_places(scene, 500)
    assert np.abs(atlas.sample(atlas.texels.positions, triangle, u, v) - at).max() < 2.0 * atlas.texel
    flat = np.array([(0.0, 0, 0), (1, 0, 0), (2, 0, 0), (0, 1, 0)])
    up = np.broadcast_to([0.0, 0, 1], flat.shape)
    half = make_atlas("half", flat, up, np.array([(0, 1, 2), (0, 1, 3)]), side=8)
    assert half.chart.tolist() == [-1, 0] and half.fallback[0] == -1
    with pytest.raises(BadScene, match="line: no face has an area"):
        make_atlas("line", flat[:3], up[:3], np.array([(0, 1, 2)]), side=8)
    with pytest.raises(BadScene, match="crowd: its 320 charts do not fit"):
        mesh = SceneMesh.assemble([sphere(subdivisions=2, smooth=False)])
        make_atlas("crowd", mesh.points, mesh.normals, mesh.triangles, side=16)
    with pytest.raises(BadScene, match="fine: texels of"):
        make_atlas("fine", scene.points, scene.normals, scene.triangles, texel=1e-6)


def test_the_same_surface_gives_the_same_atlas():
    first, second = (atlas_of(sphere(subdivisions=2), side=40)[0] for _ in range(2))
    assert np.array_equal(first.texels.positions, second.texels.positions)
    assert np.array_equal(first.places, second.places)


def test_xatlas_that_takes_too_long_is_ended_and_named(monkeypatch, tmp_path):
    if unwrapping.xatlas_file() is None:
        pytest.skip("no xatlas for this Python")
    scene = SceneMesh.assemble([sphere(subdivisions=2)])
    with pytest.raises(PRTError, match=r"ball: it does not unwrap within 0.001 s .*Mend the mesh"):
        unwrapping.make_charts("ball", scene.points, scene.triangles, "xatlas", 0.001)
    assert unwrapping.make_charts("ball", scene.points, scene.triangles, "auto", 0.001).method == "projection"
    monkeypatch.setattr(unwrapping, "xatlas_file", lambda: None)
    with pytest.raises(PRTError, match="ball: xatlas is not there for Python"):
        unwrapping.make_charts("ball", scene.points, scene.triangles, "xatlas")


def test_dilation_takes_means_of_neighbours():
    picture, mask = np.zeros((5, 5, 1)), np.zeros((5, 5), bool)
    picture[2, 2], mask[2, 2] = 3.0, True
    once = Atlas.dilated(picture, mask, 1)
    assert np.allclose(once[1:4, 1:4], 3.0) and once[0].max() == 0.0
    assert np.allclose(Atlas.dilated(picture, mask, 2), 3.0)


def test_charts_start_at_multiples_for_mip_maps():
    atlas, _ = atlas_of(box(), texel=0.1, align=8, gutter=3)
    assert atlas.width % 8 == 0 and atlas.height % 8 == 0
    blocks = atlas.picture(atlas.texels.chart + 1)
    blocks = blocks.reshape(atlas.height // 8, 8, atlas.width // 8, 8).transpose(0, 2, 1, 3).reshape(-1, 64)
    assert all(len(set(block[block > 0])) <= 1 for block in blocks)
