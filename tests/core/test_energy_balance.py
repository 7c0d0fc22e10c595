# SPDX-License-Identifier: GPL-3.0-or-later
"""Sky and surfaces together fill a receiver's hemisphere: bounces are right in a white world at few directions."""

from __future__ import annotations

import numpy as np
import pytest

from prt_addon.basis.directions import quadrature
from prt_addon.scene.scene_mesh import SceneMesh
from prt_addon.tracing.tracer import Tracer
from prt_addon.transport.direct import direct_transfer
from prt_addon.transport.energy_balance import balanced
from prt_addon.transport.gather import gather_operator
from prt_addon.transport.interreflection import interreflect
from tests.core.shapes import box, drain, plane, sphere

ORDER = 4


def still_life(albedo):
    grey = (albedo,) * 3
    meshes = [plane(size=4.0, albedo=grey), sphere(centre=(0, 0, 0.9), radius=0.8, albedo=grey)]
    return SceneMesh.assemble(meshes, 1 / 24)


def traced(scene, directions, gather_directions):
    """The operator and the direct transfer of y_0, times sqrt(4 pi): the share of the sky that is seen."""
    tracer, keys = Tracer(scene.points, scene.triangles, 1), np.flatnonzero(~scene.loose)
    gathered = drain(gather_operator(tracer, scene, keys, *quadrature(gather_directions, ORDER)))
    direct = drain(direct_transfer(tracer, gathered.receivers, *quadrature(directions, ORDER), ORDER))
    return gathered, direct[:, :1]


def in_white_world(scene, gathered, direct):
    """Radiance by point of white surfaces, all bounces."""
    point = gathered.receivers.key % len(scene.points)
    found = drain(interreflect(gathered.matrix, scene.albedo[point][:, :1], direct, 1e-4)).transfer[:, 0, 0]
    front = gathered.receivers.key < len(scene.points)
    result = np.full(len(scene.points), np.nan)
    result[point[front]] = found[front] * np.sqrt(4 * np.pi)
    return result[~scene.loose]


@pytest.mark.parametrize(("albedo", "gain"), [(0.8, 3.0), (0.99, 15.0)])
def test_bounces_at_few_directions_are_those_of_many(albedo, gain):
    scene = still_life(albedo)
    exact = in_white_world(scene, *traced(scene, 4096, 4096))
    gathered, direct = traced(scene, 256, 128)
    before = in_white_world(scene, gathered, direct) - exact
    after = in_white_world(scene, balanced(gathered, direct[:, 0]), direct) - exact
    assert np.sqrt(np.mean(after ** 2)) < np.sqrt(np.mean(before ** 2)) / gain
    assert abs(after.mean()) < 5e-4
    assert (exact + after).max() < 1.002 < (exact + before).max()


def test_a_closed_room_is_left_as_it_is():
    scene = SceneMesh.assemble([box(inward=True), box("thing", (0.4,) * 3, (0.6,) * 3)], 0.2)
    gathered, direct = traced(scene, 256, 128)
    assert np.abs(gathered.shown - 1.0).max() < 1e-5
    assert np.allclose(balanced(gathered, direct[:, 0]).matrix.data, gathered.matrix.data, rtol=1e-5)


def test_light_that_was_lost_stays_lost():
    """Backs of surfaces that few receivers see are black; what is in front of them must not glow instead."""
    tilted = plane(size=0.06, height=0.05, up=True)  # over the floor, which sees its back
    scene = SceneMesh.assemble([plane(size=4.0, cells=8), tilted], 0.0)
    gathered, direct = traced(scene, 2048, 2048)
    assert not gathered.two_sided
    sums = np.asarray(gathered.matrix.sum(axis=1)).ravel()
    lost = np.flatnonzero(gathered.shown > sums + 0.01)
    assert len(lost)
    after = np.asarray(balanced(gathered, direct[:, 0]).matrix.sum(axis=1)).ravel()
    assert after[lost] == pytest.approx(sums[lost], abs=0.01)


def test_horizons_of_a_rough_surface_count():
    """Steep pyramids: what their smooth normals see of the sky and of surfaces is less than a hemisphere."""
    mesh = plane(size=1.0, cells=12, smooth=True)
    random = np.random.default_rng(1)
    mesh.positions[:, 2] += 0.05 * random.random(len(mesh.positions))
    scene = SceneMesh.assemble([mesh], 0.0)
    gathered, direct = traced(scene, 4096, 4096)
    before, after = gathered.matrix.data, balanced(gathered, direct[:, 0]).matrix.data
    assert np.sqrt(np.mean((after - before) ** 2)) < 0.05 * np.sqrt(np.mean(before ** 2))
    assert after.sum() == pytest.approx(before.sum(), rel=0.01)
