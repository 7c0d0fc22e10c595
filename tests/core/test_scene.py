# SPDX-License-Identifier: GPL-3.0-or-later
"""Assembling: splits, refinement, cleaning, orientation, needs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from prt_addon.errors import BadScene
from prt_addon.scene.needs import decide, is_lone_convex
from prt_addon.scene.orientation import is_closed, signed_volume
from prt_addon.scene.receivers import morton_order, ray_origins
from prt_addon.scene.scene_mesh import SceneMesh
from tests.core.shapes import box, join, make, plane, sphere


def area(points, triangles):
    corners = points[triangles]
    return 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)


def test_cube_gets_one_receiver_for_each_face_at_a_corner():
    scene = SceneMesh.assemble([box()])
    assert len(scene.points) == 24 and not scene.objects[0].matches_source
    for normal in np.unique(np.round(scene.normals, 6), axis=0):
        assert np.abs(np.abs(normal).max() - 1.0) < 1e-6


def test_smooth_mesh_keeps_its_vertices_in_order():
    mesh = sphere(subdivisions=2)
    scene = SceneMesh.assemble([mesh])
    assert scene.objects[0].matches_source
    assert np.array_equal(scene.points, mesh.positions)
    assert np.abs(scene.normals - mesh.positions).max() < 0.03  # a unit sphere's normal is its position


def test_two_materials_meet_in_a_sharp_line():
    mesh = plane(cells=2)
    mesh.corner_albedo[:4] = (1.0, 0.0, 0.0)
    scene = SceneMesh.assemble([mesh])
    assert not scene.objects[0].matches_source
    assert set(map(tuple, np.unique(scene.albedo, axis=0))) == {(0.5, 0.5, 0.5), (1.0, 0.0, 0.0)}


def test_loose_vertices_keep_their_place():
    mesh = sphere(subdivisions=1)
    mesh = replace(mesh, positions=np.concatenate([mesh.positions, [[9.0, 9.0, 9.0]]]))
    scene = SceneMesh.assemble([mesh])
    assert scene.objects[0].matches_source and scene.loose.sum() == 1 and scene.loose[-1]


@pytest.mark.parametrize("spacing", [0.3, 0.05])
def test_refinement_is_conforming_and_keeps_the_surface(spacing):
    mesh = make("strip", [[0, 0, 0], [4, 0, 0], [4, 0.3, 0.2], [0, 1, 0]], [[0, 1, 2], [0, 2, 3]])
    scene = SceneMesh.assemble([mesh], spacing)
    corners = scene.points[scene.triangles]
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max()
    assert longest <= spacing * scene.size * (1 + 1e-12)
    assert area(scene.points, scene.triangles).sum() == pytest.approx(area(mesh.positions, mesh.triangles).sum())
    edges = np.concatenate([scene.triangles[:, [0, 1]], scene.triangles[:, [1, 2]], scene.triangles[:, [2, 0]]])
    # Conforming: the flat-shaded fold splits points, so every inner edge has two triangles and the outline one; no
    # point lies inside another triangle's edge, which Euler's formula for each of the two flat pieces tells.
    count = np.unique(np.sort(edges, axis=1), axis=0, return_counts=True)[1]
    assert set(count) <= {1, 2}
    assert len(scene.points) - len(count) + len(scene.triangles) == 2


def test_bad_triangles_are_dropped_and_named():
    mesh = plane("floor", cells=2)
    triangles = np.concatenate([mesh.triangles, [[0, 0, 1]], mesh.triangles[:1, [1, 2, 0]]]).astype(np.int32)
    pad = np.repeat(mesh.corner_normals[:1], 2, axis=0)
    mesh = replace(mesh, triangles=triangles, corner_normals=np.concatenate([mesh.corner_normals, pad]),
                   corner_albedo=np.concatenate([mesh.corner_albedo, mesh.corner_albedo[:2]]))
    scene = SceneMesh.assemble([mesh])
    assert len(scene.triangles) == 8
    assert scene.warnings == ("floor: dropped 1 zero-area and 1 duplicate triangles",)


@pytest.mark.parametrize(("change", "cause"), [
    (lambda m: replace(m, triangles=m.triangles[:0], corner_normals=m.corner_normals[:0],
                       corner_albedo=m.corner_albedo[:0]), "no faces"),
    (lambda m: replace(m, positions=m.positions * np.nan), "finite"),
    (lambda m: replace(m, positions=m.positions * 0.0), "zero area"),
    (lambda m: replace(m, is_target=False), "no mesh object"),
])
def test_what_can_not_be_baked_says_so(change, cause):
    with pytest.raises(BadScene, match=cause):
        SceneMesh.assemble([change(plane())])


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
def test_scale_changes_nothing_but_scale(scale):
    mesh = sphere(subdivisions=2)
    scene = SceneMesh.assemble([replace(mesh, positions=mesh.positions * scale)], 0.05)
    same = SceneMesh.assemble([mesh], 0.05)
    assert np.array_equal(scene.triangles, same.triangles) and not scene.warnings[1:]


def test_inward_closed_mesh_is_turned_but_a_room_is_not():
    inward = sphere(subdivisions=2, inward=True)
    scene = SceneMesh.assemble([inward])
    assert "point inwards" in scene.warnings[0]
    assert np.sum(scene.normals * scene.points, axis=1).min() > 0.9
    room = SceneMesh.assemble([inward, box("chair", (-0.1, -0.1, -0.1), (0.1, 0.1, 0.1))])
    assert not room.warnings
    assert np.sum(room.normals[:10] * room.points[:10], axis=1).max() < -0.9


def test_closed_and_volume():
    cube = box(high=(2, 3, 4))
    assert is_closed(cube.positions, cube.triangles)
    assert signed_volume(cube.positions, cube.triangles) == pytest.approx(24.0)
    assert not is_closed(cube.positions, cube.triangles[1:])


def test_convex_or_not():
    notched = join("two", box(), box(low=(2, 0, 0), high=(3, 1, 1)))
    dented = sphere(subdivisions=2)
    dented.positions[0] *= 0.5
    for mesh, expected in ((box(), True), (sphere(), True), (plane(cells=3), True), (notched, False), (dented, False)):
        assert is_lone_convex(SceneMesh.assemble([mesh])) is expected, mesh.name


def test_needs_of_simple_scenes():
    lone = decide(SceneMesh.assemble([sphere()]), 5, -1, (1000, 100))
    assert not lone.shadow_rays and not lone.bounces and lone.channels == 1
    assert any("convex" in item.why for item in lone.left_out)
    pair = [box(albedo=(0.8, 0.2, 0.2)), plane(size=4.0)]
    coloured = decide(SceneMesh.assemble(pair), 5, -1, (1000, 100))
    assert coloured.shadow_rays and coloured.bounces and coloured.channels == 3 and not coloured.left_out
    grey = decide(SceneMesh.assemble([box(), plane(size=4.0)]), 5, -1, (1000, 100), light_order=2)
    assert grey.channels == 1 and grey.order == 5 and grey.hints
    fitted = decide(SceneMesh.assemble([box(), plane(size=4.0)]), 5, -1, (1000, 100), 2, True)
    assert fitted.order == 2
    black = decide(SceneMesh.assemble([box(albedo=(0, 0, 0)), plane(albedo=(0, 0, 0))]), 5, -1, (1000, 100))
    assert not black.bounces and black.shadow_rays


def test_origins_lie_above_their_own_faces_and_off_concave_edges():
    # An L of floor and wall that share an edge, smooth-shaded and flat-shaded.
    corner = join("corner", plane(size=2.0, cells=2),
                  make("wall", [[-1, 1, 0], [1, 1, 0], [1, 1, 2], [-1, 1, 2]], [[0, 1, 2], [0, 2, 3]]))
    scene = SceneMesh.assemble([corner])
    origins = ray_origins(scene.points, scene.normals, scene.triangles, scene.size)
    for triangle in scene.triangles:
        corners = scene.points[triangle]
        normal = np.cross(corners[1] - corners[0], corners[2] - corners[0])
        normal /= np.linalg.norm(normal)
        assert np.min((origins[triangle] - corners[0]) @ normal) > 0.5e-6 * scene.size
    floor = np.abs(scene.normals[:, 2]) > 0.9
    assert origins[floor & (scene.points[:, 1] > 0.99), 1].max() < 1.0 - 1e-3


def test_morton_order_is_a_permutation_that_brings_neighbours_together():
    points = np.random.default_rng(3).random((4000, 3))
    order = morton_order(points)
    assert np.array_equal(np.sort(order), np.arange(4000))
    step = np.linalg.norm(np.diff(points[order], axis=0), axis=1).mean()
    assert step < 0.25 * np.linalg.norm(np.diff(points, axis=0), axis=1).mean()
