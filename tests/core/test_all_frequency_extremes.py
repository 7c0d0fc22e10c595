# SPDX-License-Identifier: GPL-3.0-or-later
"""Bakes in cubemap columns at their extremes: lights of one texel, black and of 1e6; one triangle, r = 2, darkness."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from prt_addon.baking.recipe import bake, exhaust
from prt_addon.baking.settings import BakeSettings
from prt_addon.basis.cubemap import cubemap_directions, cubemap_solid_angles, sample_directions, texel_of
from prt_addon.basis.directions import random_rotation
from prt_addon.lighting.cubemap_light import Turn
from prt_addon.lighting.reference_light import ReferenceLight
from prt_addon.relighting.exit_radiance import diffuse_radiance
from prt_addon.scene.scene_mesh import SceneMesh
from tests.core.shapes import box, make, plane, sphere

ENCODERS = ("adaptive", "eigentransport")  # the first works as iterative and static do, first
SMALL = BakeSettings(distant_basis="cubemap", cubemap_size=4, directions=512, gather_directions=64, clusters=8,
                     vectors=6, encoder="eigentransport", spacing=0.0, compression_error=0.0, error_receivers=0,
                     threads=1)


def baked(meshes, settings=SMALL, light=None):
    return exhaust(bake(SceneMesh.assemble(list(meshes)), settings, light=light))


def unit(container, light):
    """Unit-albedo radiance under light (columns, 3)."""
    return diffuse_radiance(container, np.asarray(light, np.float32)).astype(np.float64) / container.albedo


def texel_light(r, direction, radiance=1.0, rest=0.0):
    light = np.full((6 * r * r, 3), float(rest))
    light[texel_of(np.asarray([direction], float), r)[0]] = radiance
    return light


def still_life():
    return [plane(size=4.0, cells=8), sphere(centre=(0, 0, 1.1), subdivisions=2)]


@pytest.mark.parametrize("encoder", ENCODERS)
def test_a_light_of_one_texel_on_an_open_plane_is_its_cosine_integral(encoder):
    r, direction = 4, (0.3, 0.1, 1.0)
    found = baked([plane(cells=4)], replace(SMALL, encoder=encoder)).objects["plane"]
    fine = sample_directions(r, 64)[texel_of(np.array([direction]), r)[0]]
    # Parts even on the face: their solid angles fall with the cube of the distance, which is 1 / z there.
    weight = fine[:, 2] ** 3 / np.sum(fine[:, 2] ** 3)
    solid_angle = cubemap_solid_angles(r)[texel_of(np.array([direction]), r)[0]]
    expected = np.sum(fine[:, 2] * weight) * solid_angle / np.pi
    assert np.allclose(unit(found, texel_light(r, direction)), expected, rtol=2e-3)


@pytest.mark.parametrize("encoder", ENCODERS)
def test_black_light_is_black_and_its_budget_is_zero(encoder):
    black = ReferenceLight.of(np.zeros((8, 16, 3)), None, [], "nothing")
    result = baked(still_life(), replace(SMALL, encoder=encoder, error_receivers=12, error_paths=128), black)
    for container in result.objects.values():
        assert np.array_equal(unit(container, np.zeros((96, 3))), np.zeros((len(container.cluster), 3)))
    for entry in result.report["errors"].values():
        assert entry["relative_rms"] == 0.0 and np.isfinite(entry["interval"]).all()


@pytest.mark.parametrize("encoder", ENCODERS)
def test_a_dynamic_range_of_a_million_loses_nothing_to_rounding(encoder):
    light = texel_light(4, (0.4, 0.2, 0.9), 1e6, 1.0)
    for container in baked(still_life(), replace(SMALL, encoder=encoder)).objects.values():
        found = unit(container, light)
        bases, weights = container.bases[:, :, 0, :, 0].astype(float), container.weights.astype(float)
        chosen = bases[container.cluster]
        exact = (chosen[:, 0] + np.sum(weights[:, :, None] * chosen[:, 1:], axis=1)) @ light
        assert np.abs(found - exact).max() < 1e-5 * np.abs(exact).max()
        assert np.isfinite(found).all()


@pytest.mark.parametrize("encoder", ENCODERS)
@pytest.mark.parametrize("r", [2, 4])
def test_one_triangle(encoder, r):
    triangle = make("one", [[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]])
    found = baked([triangle], replace(SMALL, encoder=encoder, cubemap_size=r)).objects["one"]
    assert found.bases.shape[3] == 6 * r * r
    assert np.allclose(unit(found, np.ones((6 * r * r, 3))), 1.0, atol=1e-5)


@pytest.mark.parametrize("encoder", ENCODERS)
def test_a_rank_deficient_transfer_needs_no_vectors(encoder):
    # Every receiver of an open plane has the same columns: rank one, and nothing around the mean.
    result = baked([plane(cells=6)], replace(SMALL, encoder=encoder, cubemap_size=2))
    found = result.objects["plane"]
    assert np.isfinite(found.bases).all() and np.isfinite(found.weights).all()
    light = np.random.default_rng(1).random((24, 3))
    radiance = unit(found, light)
    assert np.ptp(radiance, axis=0).max() < 1e-5 * radiance.max()


@pytest.mark.parametrize("encoder", ENCODERS)
def test_r_2_keeps_all_light_of_a_still_life(encoder):
    result = baked(still_life(), replace(SMALL, encoder=encoder, cubemap_size=2))
    white = unit(result.objects["plane"], np.ones((24, 3)))
    rim = np.abs(result.objects["plane"].positions[:, :2]).max(axis=1) > 1.9
    assert white.max() < 1.001 and (white[rim] > 0.9).all()
    assert all(np.isfinite(check["value"]) for check in result.report["stability"])


@pytest.mark.parametrize("encoder", ENCODERS)
def test_in_the_dark_everything_is_black(encoder):
    # A ball in a closed box that faces in: no texel reaches it, nor the box.
    room = box("room", (-2, -2, -2), (2, 2, 2), inward=True)
    result = baked([room, sphere(radius=0.5, subdivisions=1)], replace(SMALL, encoder=encoder))
    light = np.random.default_rng(2).random((96, 3)) * 1e3
    for container in result.objects.values():
        assert np.isfinite(container.bases).all() and np.isfinite(container.weights).all()
        assert np.abs(unit(container, light)).max() < 1e-3
    assert any("dark" in check["verdict"] for check in result.report["stability"])


@pytest.mark.parametrize("encoder", ENCODERS)
def test_duplicated_vertices_are_lit_alike(encoder):
    ground = plane(size=4.0, cells=8)
    count = len(ground.triangles)
    split = replace(ground, positions=ground.positions[ground.triangles].reshape(-1, 3),
                    triangles=np.arange(3 * count, dtype=np.int32).reshape(-1, 3))  # each corner its own vertex
    found = baked([split, sphere(centre=(0, 0, 1.1), subdivisions=2)],
                  replace(SMALL, encoder=encoder, vectors=24 if encoder != "eigentransport" else 96)).objects["plane"]
    radiance = unit(found, np.random.default_rng(3).random((96, 3)))
    place = np.unique(np.round(found.positions, 5), axis=0, return_inverse=True)[1].ravel()
    mean = np.stack([np.bincount(place, radiance[:, k]) / np.bincount(place) for k in range(3)], axis=1)
    assert len(mean) < 0.3 * len(radiance)
    assert np.abs(radiance - mean[place]).max() < 0.03 * radiance.max()


def test_parts_far_apart_are_lit_as_if_alone():
    ball = sphere("ball", subdivisions=2)
    moved = ball.positions + np.array([500.0, 0.0, 0.0])
    far = replace(ball, positions=np.concatenate([ball.positions, moved]),
                  triangles=np.concatenate([ball.triangles, ball.triangles + len(ball.positions)]),
                  corner_normals=np.concatenate([ball.corner_normals] * 2),
                  corner_albedo=np.concatenate([ball.corner_albedo] * 2))
    light = np.random.default_rng(4).random((96, 3))
    settings = replace(SMALL, vectors=96)
    alone, both = (unit(baked([mesh], settings).objects["ball"], light) for mesh in (ball, far))
    assert np.allclose(both[:len(alone)], alone, atol=2e-4) and np.allclose(both[len(alone):], alone, atol=2e-4)


@pytest.mark.parametrize("vectors", [12, 48])
def test_an_eigentransport_bake_takes_the_memory_that_the_paper_says(vectors):
    # 4 d (v + 1) bytes with each vertex's d weights (section 7 of the paper); the shared vectors come on top of it.
    found = baked([plane(size=4.0, cells=12), sphere(centre=(0, 0, 1.1), subdivisions=2)],
                  replace(SMALL, vectors=vectors, cubemap_size=8)).objects["plane"]
    vertices, columns = len(found.cluster), 6 * 8 * 8
    assert found.weights.shape == (vertices, vectors)
    assert found.weights.nbytes + 4 * vectors == 4 * vectors * (vertices + 1)
    assert found.bases.nbytes == 4 * (vectors + 1) * columns


@pytest.mark.parametrize("encoder", ["static", "eigentransport"])
def test_a_turned_light_is_the_turned_geometry(encoder):
    # Light turned against a bake, as it is drawn, and the light as it is against a bake of the geometry turned back.
    r, rotation = 16, random_rotation(6, 3)
    settings = replace(SMALL, cubemap_size=r, encoder=encoder, directions=6144, vectors=24, clusters=32)
    meshes = still_life()

    def turned(mesh):
        return replace(mesh, positions=mesh.positions @ rotation,
                       corner_normals=(mesh.corner_normals @ rotation).astype(np.float32))

    straight, other = baked(meshes, settings), baked([turned(mesh) for mesh in meshes], settings)
    for name, make_light, bound in (
            ("smooth", lambda d: 0.3 + np.maximum(d @ [0.5, 0.3, 0.8], 0.0) ** 2, 0.01),
            ("edge", lambda d: np.where(d @ [0.6, 0.0, 0.8] > 0.9, 20.0, 0.3), 0.03)):
        light = np.repeat(make_light(cubemap_directions(r))[:, None], 3, axis=1)
        turned_light = Turn(r, rotation)(light)
        for key in straight.objects:
            ours = unit(straight.objects[key], turned_light)
            theirs = unit(other.objects[key], light)
            error = np.sqrt(np.mean((ours - theirs) ** 2) / np.mean(theirs ** 2))
            assert error < bound, (name, key, error)
