# SPDX-License-Identifier: GPL-3.0-or-later
"""Caustics element by element against paths that follow the lobe, against a mirror's image, and sparsely sampled."""

from __future__ import annotations

import numpy as np
import pytest

from prt_addon.basis.cubemap import cubemap_directions, texel_of
from prt_addon.basis.directions import spherical_fibonacci
from prt_addon.scene.scene_mesh import SceneMesh
from prt_addon.scene.surface_material import SurfaceMaterial
from prt_addon.tracing.tracer import Tracer
from prt_addon.transport.caustic_elements import CausticElements, GlossySurfaces, gathered_caustics, sampled_lights
from prt_addon.transport.receiver_set import ReceiverSet
from prt_addon.transport.reflectance import PrincipledLobe
from prt_addon.transport.sparse_sampling import SparseSettings, sparse_transfer
from tests.core.shapes import drain, make, plane

R = 4


def metal(roughness):
    return PrincipledLobe(SurfaceMaterial("metal", (0.9,) * 3, roughness=roughness, metallic=1.0))


def ring(radius=0.6, height=0.5, segments=48):
    """An open cylinder, its normals inwards: surfaces are seen from either side."""
    angle = np.arange(segments) * 2 * np.pi / segments
    circle = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)
    points = np.concatenate([np.column_stack([circle, np.full(segments, z)]) for z in (0.02, height)])
    low, nxt = np.arange(segments), (np.arange(segments) + 1) % segments
    triangles = np.concatenate([np.stack([low, low + segments, nxt], axis=1),
                                np.stack([nxt, low + segments, nxt + segments], axis=1)])
    return make("ring", points, triangles, smooth=True)


def scene_with(glossy_object, roughness, cells=11):
    scene = SceneMesh.assemble([plane(size=3.0, cells=cells), glossy_object])
    tracer = Tracer(scene.points, scene.triangles, 2)
    points = np.zeros(len(scene.points), bool)
    points[scene.objects[1].points] = True
    keys = np.arange(scene.objects[0].points.start, scene.objects[0].points.stop)
    return tracer, scene, ReceiverSet.of_keys(scene, tracer, keys), GlossySurfaces(metal(roughness), points)


def whole(elements):
    column, row = np.nonzero(np.ones((elements.columns, len(elements)), bool))
    values = np.zeros((len(elements), elements.columns), np.float32)
    values[row, column] = elements.evaluate(row, column)
    return values * elements.factor(np.arange(len(elements)))


def test_directions_are_drawn_by_their_density():
    """The integral of the density over the hemisphere by an even set of directions, and means of drawn ones."""
    view = np.array([[0.6, 0.0, 0.8]])
    generator = np.random.default_rng(0)
    lights, density = sampled_lights(0.3, np.repeat(view, 40_000, axis=0), generator.random((40_000, 2)))
    up = lights[:, 2] > 0.0
    even = spherical_fibonacci(200_000)
    half = even + view
    half /= np.linalg.norm(half, axis=1, keepdims=True)
    length = (half[:, 0] ** 2 + half[:, 1] ** 2) / 0.09 + half[:, 2] ** 2
    seen = 2.0 / (1.0 + np.sqrt(1.0 + 0.09 * 0.36 / 0.64))
    wanted = np.where(half[:, 2] > 0, seen / (np.pi * 0.09 * length ** 2 * 4 * 0.8), 0.0)
    assert np.mean(wanted) * 4 * np.pi == pytest.approx(1.0, abs=5e-3)
    for values, all_values in ((lights[:, 0], even[:, 0]), (lights[:, 2] ** 2, even[:, 2] ** 2)):
        assert values.mean() == pytest.approx(np.mean(all_values * wanted) * 4 * np.pi, abs=1e-2)
    assert up.mean() > 0.9 and (density > 0.0).all()


def test_a_mirror_shows_the_sky_behind_it():
    """A wall of polished metal: the light of one texel comes from its mirror image, seen past the wall's edges."""
    wall = make("wall", [(0.5, -9, 0), (0.5, 9, 0), (0.5, 9, 9), (0.5, -9, 9)], [(0, 3, 2), (0, 2, 1)])
    tracer, scene, receivers, glossy = scene_with(wall, 0.02, 5)
    left = np.flatnonzero(scene.points[receivers.key][:, 0] < 0.4)
    some = receivers.taken(left[:4])
    found = drain(gathered_caustics(tracer, scene, some, glossy, R, 1 << 14, 1))
    truth = np.zeros_like(found)
    even = spherical_fibonacci(1 << 17)
    even = even[even[:, 2] > 0]
    for number, place in enumerate(scene.points[some.key]):
        ahead = even[:, 0] > 1e-9
        reach = (0.5 - place[0]) / np.where(ahead, even[:, 0], 1.0)
        meet = place + even * reach[:, None]
        hit = ahead & (np.abs(meet[:, 1]) < 9) & (meet[:, 2] < 9)
        image = even[hit] * [-1, 1, 1]
        truth[:, number] = np.bincount(texel_of(image, R), even[hit][:, 2] / np.pi * (4 * np.pi / (1 << 17)), 96)
    assert truth.sum() > 0.3
    np.testing.assert_allclose(found, 0.9 * truth, rtol=0.06, atol=6e-4)  # Fresnel adds a little


def test_elements_agree_with_paths_that_follow_the_lobe():
    tracer, scene, receivers, glossy = scene_with(ring(), 0.5)
    inside = np.flatnonzero(np.linalg.norm(scene.points[receivers.key][:, :2], axis=1) < 0.8)
    some = receivers.taken(inside[::2])
    for bounces in (1, 2):
        elements = CausticElements(tracer, scene, some, glossy, R, 512, bounces)
        found = whole(elements).T
        truth = drain(gathered_caustics(tracer, scene, some, glossy, R, 1 << 14, bounces))
        assert np.linalg.norm(found - truth) < 0.12 * np.linalg.norm(truth)
        assert found.sum() == pytest.approx(truth.sum(), rel=0.05)


def test_an_element_is_the_same_whenever_asked_and_paths_on_any_threads():
    tracer, scene, receivers, glossy = scene_with(ring(), 0.4)
    elements = CausticElements(tracer, scene, receivers, glossy, R, 32)
    row, column = np.arange(140), np.arange(140) % 96
    together = elements.evaluate(row, column)
    np.testing.assert_array_equal(elements.evaluate(row[100:], column[100:]), together[100:])
    assert elements.asked == 180 and together.max() > 0.0
    first, again = (drain(gathered_caustics(Tracer(scene.points, scene.triangles, threads), scene, receivers, glossy,
                                            R, 64)) for threads in (1, 3))
    np.testing.assert_array_equal(first, again)


def test_nothing_glossy_brings_nothing():
    tracer, scene, receivers, glossy = scene_with(ring(), 0.4)
    none = GlossySurfaces(glossy.lobe, np.zeros_like(glossy.points))
    assert not drain(gathered_caustics(tracer, scene, receivers, none, R, 16)).any()
    elements = CausticElements(tracer, scene, receivers, none, R, 16)
    assert not elements.evaluate(np.arange(50), np.arange(50)).any()


def test_sparse_sampling_of_a_caustic():
    tracer, scene, receivers, glossy = scene_with(ring(), 0.5, 23)
    truth = whole(CausticElements(tracer, scene, receivers, glossy, 6, 32, 1)).T
    elements = CausticElements(tracer, scene, receivers, glossy, 6, 32, 1)
    found = drain(sparse_transfer(elements, scene.points[receivers.key], receivers.normals,
                                  SparseSettings(radius=0.12)))
    assert found.sampled < 0.12
    light = np.maximum(cubemap_directions(6) @ [0.6, 0.0, 0.8], 0.0) ** 4
    relit, exact = light @ found.transfer, light @ truth
    assert np.linalg.norm(relit - exact) < 0.25 * np.linalg.norm(exact)
