# SPDX-License-Identifier: GPL-3.0-or-later
"""Point lights by nearest directions: right outside the convex hull, known to be wrong inside."""

from types import SimpleNamespace

import numpy as np
import pytest

from prt_addon.basis.cubemap import cubemap_solid_angles
from prt_addon.compression.eigentransport import eigentransport
from prt_addon.relighting.nearest_directions import inside_hull, nearest_texels, point_light_radiance
from prt_addon.scene.scene_mesh import SceneMesh
from prt_addon.tracing.tracer import Tracer
from prt_addon.transport.cubemap_transfer import cubemap_transfer
from prt_addon.transport.local_lights import unit_light_direct
from prt_addon.transport.receiver_set import ReceiverSet
from tests.core.shapes import drain, plane, sphere


@pytest.fixture(scope="module")
def scene():
    scene = SceneMesh.assemble([plane(size=4.0, cells=24), sphere(centre=(0, 0, 1.0), radius=0.6, subdivisions=3)])
    tracer = Tracer(scene.points, scene.triangles, 1)
    receivers = ReceiverSet.of_keys(scene, tracer, np.arange(len(scene.points)))
    transfer = drain(cubemap_transfer(tracer, receivers, 32)).T
    encoding = eigentransport(transfer, 192, 1 / np.sqrt(cubemap_solid_angles(32))).encoding
    baked = SimpleNamespace(cluster=encoding.cluster, weights=encoding.weights,
                            bases=encoding.bases[:, :, None, :, None])
    return scene, tracer, receivers, baked


def errors(scene, light, k):
    scene, tracer, receivers, baked = scene
    positions = scene.points[receivers.key]
    found = point_light_radiance(baked, positions, 32, light, [1.0, 2.0, 3.0], k)
    truth = drain(unit_light_direct(tracer, receivers, np.array([light])))[:, 0]
    assert np.allclose(found[:, 2], 3 * found[:, 0], rtol=1e-5)
    return np.linalg.norm(found[:, 0] - truth) / np.linalg.norm(truth), found[:, 0].sum() / truth.sum()


def test_a_light_outside_the_hull_is_right_within_the_cubemaps_resolution(scene):
    light = (1.0, 0.7, 5.0)
    assert not inside_hull(scene[0].points, light)[0]
    blurred, share = errors(scene, light, 4)
    assert blurred < 0.10 and share == pytest.approx(1.0, abs=0.02)
    assert errors(scene, light, 1)[0] < 0.16


def test_a_light_inside_the_hull_is_wrong_and_is_said_to_be(scene):
    light = (0.7, 0.0, 0.3)  # beside the ball, which hides the sky behind it from part of the floor
    assert inside_hull(scene[0].points, light)[0]
    assert errors(scene, light, 4)[0] > 0.25


def test_texels_and_shares():
    direction = np.array([[0.1, 0.2, 1.0], [5.0, -3.0, 0.2]])
    assert nearest_texels(direction, 8, 1)[0].shape == (2, 1)
    assert np.allclose(nearest_texels(direction, 8, 4)[1].sum(axis=1), 1.0)
    with pytest.raises(ValueError, match="1 or 4"):
        nearest_texels(direction, 8, 2)


def test_hulls_of_flat_and_tiny_scenes():
    flat = plane(cells=3).positions
    assert not inside_hull(flat, [[0, 0, 0], [0, 0, 1]]).any()
    assert not inside_hull(flat[:2], [0, 0, 0]).any()
    cube = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)])
    assert list(inside_hull(cube, [[0.5, 0.5, 0.5], [1.5, 0.5, 0.5], [1, 1, 1]])) == [True, False, False]
