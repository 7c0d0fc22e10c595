# SPDX-License-Identifier: GPL-3.0-or-later
"""Transfer in cubemap columns against closed forms, spherical harmonics and paths."""

import numpy as np
import pytest

from prt_addon.basis.cubemap import cubemap_directions, cubemap_solid_angles
from prt_addon.basis.directions import quadrature, random_rotation
from prt_addon.basis.spherical_harmonics import evaluate
from prt_addon.errors import PRTError
from prt_addon.lighting.cubemap_light import sun_texels
from prt_addon.scene.scene_mesh import SceneMesh
from prt_addon.tracing.tracer import Tracer
from prt_addon.transport.column_arrays import column_array
from prt_addon.transport.cubemap_transfer import bounced_columns, cubemap_transfer, samples_along
from prt_addon.transport.direct import direct_transfer
from prt_addon.transport.energy_balance import balanced
from prt_addon.transport.gather import gather_operator
from prt_addon.transport.interreflection import interreflect
from prt_addon.transport.path_reference import DistantSuns, reference_radiance
from prt_addon.transport.receiver_set import ReceiverSet
from tests.core.shapes import box, drain, plane, sphere


def scene_of(*meshes):
    scene = SceneMesh.assemble(list(meshes))
    tracer = Tracer(scene.points, scene.triangles, 1)
    return scene, tracer, ReceiverSet.of_keys(scene, tracer, np.flatnonzero(~scene.loose))


@pytest.fixture(scope="module")
def ball():
    return scene_of(plane(size=4.0, cells=16), sphere(centre=(0, 0, 1.2)))


@pytest.fixture(scope="module")
def ball_gather(ball):
    scene, tracer, _ = ball
    return drain(gather_operator(tracer, scene, np.flatnonzero(~scene.loose), *quadrature(512, 4)))


@pytest.mark.parametrize("r", [1, 2, 8, 16])
def test_an_open_receiver_has_the_cosine_integrated_over_each_texel(r):
    _, tracer, receivers = scene_of(plane(cells=2))
    transfer = drain(cubemap_transfer(tracer, receivers, r))
    assert transfer.shape == (6 * r * r, 9)
    assert np.allclose(transfer.sum(axis=0), 1.0, atol=2e-6)
    # The plane sees face +Z in full, the lower halves of the sides not at all.
    top = transfer.reshape(6, r * r, 9)[4].sum(axis=0)
    expected = 0.5541269  # of the cosine / pi lies in the pyramid |x|, |y| < z: 4/(pi sqrt 2) atan(1 / sqrt 2)
    assert expected == pytest.approx(4 / (np.pi * np.sqrt(2)) * np.arctan(1 / np.sqrt(2)), abs=1e-6)
    assert np.allclose(top, expected, atol=2e-3)
    if r % 2 == 0:
        assert np.abs(transfer.reshape(6, r * r, 9)[5]).max() == 0.0


def test_turned_planes_sum_to_one_too():
    points = plane(cells=2)
    from dataclasses import replace
    rotation = random_rotation(3, 1)
    turned = replace(points, positions=points.positions @ rotation.T,
                     corner_normals=(points.corner_normals @ rotation.T).astype(np.float32))
    _, tracer, receivers = scene_of(turned)
    assert np.allclose(drain(cubemap_transfer(tracer, receivers, 8)).sum(axis=0), 1.0, atol=2e-6)


def test_the_sum_of_columns_is_what_a_constant_light_gives_in_harmonics(ball):
    _, tracer, receivers = ball
    harmonics = drain(direct_transfer(tracer, receivers, *quadrature(8192, 5), 5))
    columns = drain(cubemap_transfer(tracer, receivers, 8))
    difference = columns.sum(axis=0) - harmonics[:, 0] * np.sqrt(4 * np.pi)
    assert np.sqrt(np.mean(difference ** 2)) < 5e-3 and np.abs(difference).max() < 2e-2


@pytest.mark.parametrize(("r", "bound"), [(8, 1.5e-2), (16, 6e-3)])
def test_a_smooth_light_gives_the_same_in_harmonics_and_in_columns(ball, r, bound):
    _, tracer, receivers = ball
    light = np.random.default_rng(5).normal(size=(25, 1))
    light[0] = 6.0
    harmonics = drain(direct_transfer(tracer, receivers, *quadrature(8192, 5), 5)) @ light
    texels = evaluate(5, cubemap_directions(r)) @ light
    columns = drain(cubemap_transfer(tracer, receivers, r)).T @ texels
    error = np.linalg.norm(columns - harmonics) / np.linalg.norm(harmonics)
    assert error < bound


def test_more_samples_in_a_texel_tend_to_its_mean(ball):
    _, tracer, receivers = ball
    truth = drain(cubemap_transfer(tracer, receivers, 4, 24))
    errors = [np.linalg.norm(drain(cubemap_transfer(tracer, receivers, 4, samples)) - truth) for samples in (1, 4, 8)]
    assert errors[0] > 4 * errors[1] > 4 * errors[2] * 1.3
    assert errors[2] < 0.03 * np.linalg.norm(truth)
    assert [samples_along(r) for r in (1, 2, 8, 16, 32)] == [32, 16, 4, 2, 1]


def test_disk_threads_and_blocks_change_nothing(ball, tmp_path):
    scene, tracer, receivers = ball
    one = drain(cubemap_transfer(tracer, receivers, 4, 4))
    many = Tracer(scene.points, scene.triangles, 3)
    other = drain(cubemap_transfer(many, receivers, 4, 4, budget=1000, folder=tmp_path))
    assert isinstance(other, np.memmap) and not isinstance(one, np.memmap)
    assert np.array_equal(one, other)
    assert list(tmp_path.iterdir()) == []  # nameless
    assert many.rays == pytest.approx(receivers.normals.shape[0] * 768, rel=0.1)


def test_no_room_on_disk_is_said(tmp_path):
    with pytest.raises(PRTError, match=r"GB of transfer can't be written"):
        column_array(1 << 20, 1 << 40, budget=0, folder=tmp_path)


def test_bounces_in_blocks_are_those_of_all_columns_at_once(ball, ball_gather, tmp_path):
    _, tracer, _ = ball
    receivers = ball_gather.receivers
    direct = drain(cubemap_transfer(tracer, receivers, 2, 4))
    albedo = np.random.default_rng(1).random((len(receivers), 3)).astype(np.float32)
    whole = drain(interreflect(ball_gather.matrix, albedo, np.ascontiguousarray(direct.T), 1e-6, 4))
    for budget in (None, 0):
        found, report = drain(bounced_columns(ball_gather.matrix, albedo, direct, 1e-6, 4, budget, tmp_path, 7))
        assert report.bounces == 4 and report.method == "series"
        assert np.allclose(found.reshape(24, 3, -1).transpose(2, 0, 1), whole.transfer, atol=1e-7)


@pytest.mark.parametrize("albedo", [0.4, 0.95])
def test_bounces_end_where_little_is_left_whatever_the_blocks(ball, ball_gather, albedo):
    _, tracer, _ = ball
    receivers = ball_gather.receivers
    direct = drain(cubemap_transfer(tracer, receivers, 2, 4))
    colour = np.full((len(receivers), 1), albedo, np.float32)
    exact = drain(interreflect(ball_gather.matrix, colour, np.ascontiguousarray(direct.T), 1e-7)).transfer[:, :, 0]
    for at_once in (5, 24):
        found, report = drain(bounced_columns(ball_gather.matrix, colour, direct, 1e-3, at_once=at_once))
        assert report.residual <= 1e-3 and np.linalg.norm(found.T - exact) < 2e-3 * np.linalg.norm(exact)


def test_white_surfaces_under_a_white_sky_are_white(ball, ball_gather):
    # Any open scene that reflects everything looks like its furnace: exactly 1 wherever light can reach.
    _, tracer, _ = ball
    receivers = ball_gather.receivers
    direct = drain(cubemap_transfer(tracer, receivers, 8, 2))
    even = balanced(ball_gather, direct.sum(axis=0) / np.sqrt(4 * np.pi))
    albedo = np.ones((len(receivers), 1), np.float32)
    found, _ = drain(bounced_columns(even.matrix, albedo, direct, 1e-6))
    assert found.sum(axis=0).max() < 1.001  # never more light than there is
    assert np.abs(found.sum(axis=0) - 1.0).max() < 5e-3


def test_bouncing_in_a_basis_of_columns_has_a_small_measured_error(ball, ball_gather):
    _, tracer, _ = ball
    receivers, r = ball_gather.receivers, 8
    direct = drain(cubemap_transfer(tracer, receivers, r, 2))
    albedo = np.full((len(receivers), 1), 0.6, np.float32)
    exact = drain(bounced_columns(ball_gather.matrix, albedo, direct, 1e-5))[0]
    mean = direct.mean(axis=1, keepdims=True)
    left, values, right = np.linalg.svd((direct - mean).T, full_matrices=False)
    errors = []
    for vectors in (8, 24, 96):
        start = np.concatenate([np.ones((len(receivers), 1)), left[:, :vectors] * values[:vectors]], axis=1)
        start = start.astype(np.float32)
        ends = drain(interreflect(ball_gather.matrix, albedo, start, 1e-5)).transfer[:, :, 0]
        bounced = direct.T + (ends - start) @ np.concatenate([mean.T, right[:vectors]])
        errors.append(np.linalg.norm(bounced - exact.T) / np.linalg.norm(exact))
    assert errors[0] > errors[1] > errors[2]
    assert errors[1] < 0.015 and errors[2] < 4e-3


def test_against_paths_under_a_sharp_light():
    # A box on a plane, a sun as wide as a texel and a faint sky: brute force sees the same light texel by texel.
    scene, tracer, receivers = scene_of(plane(size=3.0, cells=12), box(low=(-0.4, -0.3, 0), high=(0.2, 0.3, 0.8)))
    keys = np.sort(receivers.key[receivers.normals[:, 2] > 0.9])[::7]
    gathered = drain(gather_operator(tracer, scene, np.arange(len(scene.points)), *quadrature(2048, 4)))
    albedo = np.full((len(scene.points), 3), 0.5, np.float32)
    r = 16
    texels = sun_texels([0.5, 0.4, 0.8], [3.0, 2.0, 1.0], 0.0, r) + 0.2
    direct = drain(cubemap_transfer(tracer, gathered.receivers, r))
    found, _ = drain(bounced_columns(balanced(gathered, direct.sum(axis=0) / np.sqrt(4 * np.pi)).matrix,
                                     albedo[gathered.receivers.key % len(scene.points), :1], direct, 1e-4))
    place = np.argsort(gathered.receivers.key)[np.searchsorted(np.sort(gathered.receivers.key), keys)]
    baked = found[:, place].T @ texels

    def emission(directions):
        from prt_addon.basis.cubemap import texel_of
        return texels[texel_of(directions, r)][:, None]

    suns = DistantSuns(np.empty((0, 3)), np.empty((0, 3)), np.empty(0))
    chosen = ReceiverSet.of_keys(scene, tracer, keys)
    halves = drain(reference_radiance(tracer, scene, chosen, albedo, emission, suns, 16384, -1, 4))[:, :, 0]
    order = np.searchsorted(keys, chosen.key)
    error = (baked[order] - halves[0]) * (baked[order] - halves[1])
    power = (halves[0] * halves[1]).sum()
    assert power > 0 and cubemap_solid_angles(r).sum() > 12
    assert np.sqrt(max(error.sum(), 0) / power) < 0.03
