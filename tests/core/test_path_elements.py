# SPDX-License-Identifier: GPL-3.0-or-later
"""Indirect light element by element against the reference path tracer, and its sparse sampling against all of it."""

from __future__ import annotations

import numpy as np
import pytest

from prt_addon.basis.cubemap import texel_of
from prt_addon.scene.scene_mesh import SceneMesh
from prt_addon.tracing.tracer import Tracer
from prt_addon.transport.path_elements import PathElements
from prt_addon.transport.path_reference import DistantSuns, reference_radiance
from prt_addon.transport.receiver_set import ReceiverSet
from prt_addon.transport.sparse_sampling import SparseSettings, sparse_transfer
from tests.core.shapes import drain, plane, sphere

R = 8


@pytest.fixture(scope="module")
def traced():
    scene = SceneMesh.assemble([sphere(radius=0.5, centre=(0, 0, 0.6)), plane(size=3.0, cells=23)])
    tracer = Tracer(scene.points, scene.triangles, 1)
    return scene, tracer, ReceiverSet.of_keys(scene, tracer, np.flatnonzero(~scene.loose))


def whole(elements):
    everyone = np.arange(len(elements))
    column, row = np.nonzero(np.ones((elements.columns, len(elements)), bool))
    values = np.zeros((len(elements), elements.columns), np.float32)
    values[row, column] = elements.evaluate(row, column)
    return values * elements.factor(everyone)


def test_against_the_reference_path_tracer(traced):
    scene, tracer, receivers = traced
    under = np.argsort(np.linalg.norm(scene.points[receivers.key % len(scene.points)] - [0.6, 0, 0.1], axis=1))[:6]
    some = receivers.taken(np.sort(under))
    albedo = np.full(len(scene.points), 0.6)
    found = whole(PathElements(tracer, scene, some, albedo, R, paths=512))
    bright = np.random.default_rng(0).random(6 * R * R) < 0.4

    def emission(directions):
        return np.repeat(bright[texel_of(directions, R)].astype(float)[:, None, None], 3, axis=2)

    none = DistantSuns(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0))
    colours = np.repeat(albedo[:, None], 3, axis=1)
    light = [drain(reference_radiance(tracer, scene, some, colours, emission, none, 1 << 14, bounces, 1))
             .mean(axis=0)[:, 0, 0] for bounces in (0, 2)]
    indirect = light[1] - light[0]
    assert indirect.min() > 0.01
    np.testing.assert_allclose(found @ bright, indirect, rtol=0.06, atol=0.004)


def test_elements_are_the_same_whenever_asked(traced):
    scene, tracer, receivers = traced
    elements = PathElements(tracer, scene, receivers, np.full(len(scene.points), 0.6), R)
    row, column = np.arange(300), np.arange(300) % 384
    together = elements.evaluate(row, column)
    np.testing.assert_array_equal(elements.evaluate(row[250:], column[250:]), together[250:])
    assert elements.asked == 350


def test_sparse_indirect_light(traced):
    scene, tracer, receivers = traced
    albedo = np.full(len(scene.points), 0.6)
    truth = whole(PathElements(tracer, scene, receivers, albedo, R, paths=8))
    elements = PathElements(tracer, scene, receivers, albedo, R, paths=8)
    positions = scene.points[receivers.key % len(scene.points)]
    found = drain(sparse_transfer(elements, positions, receivers.normals, SparseSettings(radius=0.1)))
    assert found.sampled < 0.12
    lit = np.linalg.norm(found.transfer.sum(axis=0) - truth.sum(axis=1)) / np.linalg.norm(truth.sum(axis=1))
    assert lit < 0.065
    assert found.dense_elements == pytest.approx(0.25 * truth.size / 4, rel=0.05)
