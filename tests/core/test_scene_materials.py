# SPDX-License-Identifier: GPL-3.0-or-later
"""Materials and tangents of receivers: who gets which, where points split, what refinement does to them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from prt_addon.baking.job import read_job, write_job
from prt_addon.baking.settings import BakeSettings
from prt_addon.scene.scene_mesh import SceneMesh
from prt_addon.scene.surface_material import DIFFUSE, SurfaceMaterial
from prt_addon.scene.tangents import quiet_pole, smooth_tangents, tangent_frame
from tests.core.shapes import box, plane, sphere

GLOSSY = SurfaceMaterial("Varnish", specular_level=0.5, roughness=0.3)
SKIN = SurfaceMaterial("Skin", subsurface_weight=0.5, subsurface_radius=(0.1, 0.05, 0.02))


def unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def assert_frames(scene: SceneMesh) -> None:
    assert np.abs(np.sum(scene.tangents * scene.normals, axis=1)).max() < 1e-12
    assert np.abs(np.linalg.norm(scene.tangents, axis=1) - 1.0).max() < 1e-12


def test_defaults_are_diffuse_and_change_no_point() -> None:
    scene = SceneMesh.assemble([sphere(), box(low=(3, 0, 0), high=(4, 1, 1))])
    assert scene.materials == (DIFFUSE,) and not scene.material.any()
    assert scene.objects[0].matches_source
    assert_frames(scene)


def test_materials_are_numbered_once_over_objects_and_names_do_not_count() -> None:
    first = replace(sphere(), materials=(GLOSSY,))
    twin = replace(plane(cells=2), materials=(replace(GLOSSY, name="Copy"), SurfaceMaterial("Chalk"), SKIN),
                   material_index=np.array([0, 0, 1, 1, 2, 2, 2, 2], np.int32))
    scene = SceneMesh.assemble([first, twin])
    assert scene.materials == (DIFFUSE, GLOSSY, SKIN)
    assert (scene.material[scene.objects[0].points] == 1).all()
    assert set(scene.material[scene.objects[1].points]) == {0, 1, 2}
    numbers = scene.material[scene.triangles[scene.objects[1].triangles]]
    assert np.array_equal(numbers, np.repeat([[1], [1], [0], [0], [2], [2], [2], [2]], 3, axis=1))


@pytest.mark.parametrize(("other", "splits"), [(replace(GLOSSY, name="Same"), False), (SKIN, True), (DIFFUSE, True)])
def test_a_vertex_between_materials_splits_where_they_differ(other: SurfaceMaterial, splits: bool) -> None:
    mesh = plane(cells=2)
    half = (mesh.positions[mesh.triangles].mean(axis=1)[:, 0] > 0.0).astype(np.int32)
    scene = SceneMesh.assemble([replace(mesh, materials=(GLOSSY, other), material_index=half)])
    assert len(scene.points) == 9 + 3 * splits
    assert scene.objects[0].matches_source is not splits


def test_refinement_keeps_materials_and_interpolates_tangents() -> None:
    mesh = replace(plane(cells=1, size=2.0), materials=(GLOSSY, SKIN), material_index=np.array([0, 1], np.int32))
    wanted = np.broadcast_to(np.array([0.6, -0.8, 3.0], np.float32), (2, 3, 3))  # lifted out of the surface
    scene = SceneMesh.assemble([replace(mesh, corner_tangents=wanted)], 0.1)
    assert len(scene.points) > 100
    assert_frames(scene)
    assert np.abs(scene.tangents - (0.6, -0.8, 0.0)).max() < 1e-7
    numbers = scene.material[scene.triangles]
    assert (numbers == numbers[:, :1]).all() and set(numbers[:, 0]) == {1, 2}


def test_tangents_across_a_seam_split_and_along_a_smooth_map_do_not() -> None:
    mesh = sphere(subdivisions=3)
    around = np.cross([0.0, 0.0, 1.0], mesh.positions[mesh.triangles].mean(axis=1))
    per_face = np.repeat(around[:, None, :], 3, axis=1).astype(np.float32)
    scene = SceneMesh.assemble([replace(mesh, corner_tangents=per_face)])
    low = np.abs(scene.points[:, 2]) < 0.9
    assert len(np.unique(scene.points[low], axis=0)) == low.sum()
    wanted = unit(np.cross([0.0, 0.0, 1.0], scene.points[low]))
    assert np.sum(scene.tangents[low] * wanted, axis=1).min() > 0.99
    flipped = per_face * np.where(mesh.positions[mesh.triangles][:, :, :1].mean(axis=1, keepdims=True) > 0, 1, -1)
    seam = SceneMesh.assemble([replace(mesh, corner_tangents=flipped.astype(np.float32))])
    assert len(seam.points) > len(scene.points)
    assert_frames(seam)


def test_an_inward_mesh_takes_its_tangents_along() -> None:
    mesh = sphere(subdivisions=2, inward=True)
    wanted = np.cross([0.0, 0.0, 1.0], mesh.positions)[mesh.triangles].astype(np.float32)
    mesh = replace(mesh, corner_tangents=wanted, materials=(GLOSSY,))
    scene = SceneMesh.assemble([mesh])
    assert "inwards" in scene.warnings[0]
    low = np.abs(scene.points[:, 2]) < 0.9
    around = unit(np.cross([0.0, 0.0, 1.0], scene.points[low]))
    assert np.sum(scene.tangents[low] * around, axis=1).min() > 0.999


def test_dropped_triangles_keep_materials_with_theirs() -> None:
    mesh = plane("floor", cells=2)
    broken = mesh.triangles.copy()
    broken[3] = broken[3, [0, 0, 1]]
    index = np.array([0, 0, 0, 1, 0, 0, 0, 0], np.int32)
    scene = SceneMesh.assemble([replace(mesh, triangles=broken, materials=(GLOSSY, SKIN), material_index=index)])
    assert len(scene.triangles) == 7 and not (scene.material[scene.triangles] == 2).any()


def test_smooth_tangents_are_continuous_away_from_straight_down() -> None:
    random = np.random.default_rng(2)
    normals = unit(random.normal(size=(5000, 3)))
    normals = normals[normals[:, 2] > -0.9]
    near = unit(normals + 1e-3 * random.normal(size=normals.shape))
    change = np.linalg.norm(smooth_tangents(near) - smooth_tangents(normals), axis=1)
    assert change.max() < 1e-3 * 4.0 * np.sqrt(2.0 / 0.1)  # the field turns by (1 - cos) / sin of the angle from z
    special = np.array([[0, 0, 1.0], [0, 0, -1.0], [1e-8, 0, -1.0], [0, 1.0, 0], unit(np.array([1e-4, 1e-4, -1.0]))])
    for tangents in (smooth_tangents(special), tangent_frame(np.zeros_like(special), special),
                     tangent_frame(special * 2.0, special), tangent_frame(special * np.nan, special)):
        assert np.abs(np.linalg.norm(tangents, axis=1) - 1.0).max() < 1e-12
        assert np.abs(np.sum(tangents * special, axis=1)).max() < 1e-9


def test_frames_of_a_room_and_of_a_bumpy_ceiling_do_not_spin() -> None:
    random = np.random.default_rng(3)
    walls = np.repeat(np.concatenate([np.eye(3), -np.eye(3)]), 500, axis=0)
    normals = unit(walls + 1e-2 * random.normal(size=walls.shape))
    tangents = smooth_tangents(normals, quiet_pole(normals)).reshape(6, 500, 3)
    assert np.sum(tangents * tangents[:, :1], axis=2).min() > 0.99
    ceiling = normals[5 * 500:]
    assert np.sum(smooth_tangents(ceiling, quiet_pole(ceiling)) * smooth_tangents(ceiling, quiet_pole(ceiling))[0],
                  axis=1).min() > 0.99
    ball = sphere(radius=0.1, centre=(0.5, 0.5, 0.5))
    inward = SceneMesh.assemble([replace(box(inward=True), materials=(GLOSSY,)), ball])
    assert_frames(inward)


def test_misfits_of_a_reader_are_refused() -> None:
    mesh = plane(cells=1)
    for wrong in (replace(mesh, material_index=np.array([0, 1], np.int32)),
                  replace(mesh, material_index=np.zeros(3, np.int32)),
                  replace(mesh, corner_tangents=np.zeros((2, 3), np.float32))):
        with pytest.raises(ValueError, match="do not fit"):
            SceneMesh.assemble([wrong])


def test_a_job_brings_materials_and_tangents_back(tmp_path: Path) -> None:
    index = np.repeat(np.array([0, 1], np.int32), 4)
    mesh = replace(plane(cells=2), materials=(GLOSSY, SKIN), material_index=index)
    scene = SceneMesh.assemble([mesh])
    read, *_ = read_job(write_job(tmp_path, scene, BakeSettings()))
    assert read.materials == scene.materials
    assert np.array_equal(read.material, scene.material) and np.array_equal(read.tangents, scene.tangents)
    rougher = SceneMesh.assemble([replace(mesh, materials=(replace(GLOSSY, roughness=0.31), SKIN))])
    assert write_job(tmp_path, rougher, BakeSettings()) != write_job(tmp_path, scene, BakeSettings())
