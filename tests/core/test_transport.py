# SPDX-License-Identifier: GPL-3.0-or-later
"""Transfer against closed forms: half spaces, discs, furnaces, form factors."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import sparse

from prt_addon.basis.directions import quadrature
from prt_addon.basis.spherical_harmonics import evaluate
from prt_addon.scene.scene_mesh import SceneMesh
from prt_addon.tracing.tracer import Tracer
from prt_addon.transport.buried import buried_receivers, fill_buried
from prt_addon.transport.direct import direct_transfer, unshadowed_transfer
from prt_addon.transport.gather import gather_operator
from prt_addon.transport.interreflection import interreflect
from prt_addon.transport.receiver_set import ReceiverSet
from tests.core.shapes import box, drain, join, plane, sphere

WHITE = np.sqrt(4.0 * np.pi)  # coefficient 0 of the unit environment


def direct(scene, order=3, count=4096, threads=1, group=0):
    tracer = Tracer(scene.points, scene.triangles, threads)
    receivers = ReceiverSet.of_keys(scene, tracer, np.flatnonzero(~scene.loose))
    steps = direct_transfer(tracer, receivers, *quadrature(count, order), order, group, 5)
    result = np.zeros((len(scene.points), order * order))
    result[receivers.key] = drain(steps)
    return result


def gather(scene, count=2048, threads=1):
    tracer = Tracer(scene.points, scene.triangles, threads)
    keys = np.concatenate([np.arange(o.points.start, o.points.stop) for o in scene.objects if o.is_target])
    return drain(gather_operator(tracer, scene, keys, *quadrature(count, 4)))


def test_open_receivers_are_exact_at_any_number_of_directions():
    scene = SceneMesh.assemble([plane(cells=4)])
    transfer = direct(scene, order=5, count=64)
    assert np.abs(transfer - unshadowed_transfer(scene.normals, 5)).max() < 1e-6
    assert np.abs(transfer[:, 0] * WHITE - 1.0).max() < 1e-6


def test_unshadowed_transfer_is_the_cosine_integral():
    directions, weights = quadrature(200_000, 2)
    normal = np.array([[0.48, -0.6, 0.64]])
    cosine = np.maximum(directions @ normal[0], 0.0)
    expected = (evaluate(4, directions) * (weights * cosine)[:, None]).sum(axis=0) / np.pi
    assert np.abs(unshadowed_transfer(normal, 4)[0] - expected).max() < 1e-5


@pytest.mark.parametrize(("radius", "distance"), [(1.0, 1.0), (0.5, 2.0), (3.0, 0.5)])
def test_disc_above_a_receiver(radius, distance):
    # A coaxial parallel disc takes r^2 / (r^2 + d^2) of the cosine-weighted hemisphere.
    angles = np.linspace(0, 2 * np.pi, 256, endpoint=False)
    rim = np.stack([radius * np.cos(angles), radius * np.sin(angles), np.full(256, distance)], axis=1)
    from tests.core.shapes import make
    fan = np.stack([np.full(256, 256), np.arange(256), (np.arange(256) + 1) % 256], axis=1)
    disc = make("disc", np.concatenate([rim, [[0, 0, distance]]]), fan, target=False)
    scene = SceneMesh.assemble([plane(size=1e-3), disc])
    seen = direct(scene, order=1, count=16384)[:4, 0] * WHITE
    assert np.abs(seen - distance**2 / (radius**2 + distance**2)).max() < 4e-3


def test_wall_blocks_half_the_sky_up_to_its_foot():
    # At the foot of an infinitely high wall half of the cosine is gone: the receiver on the edge must not go black.
    wall = join("both", plane(size=2.0, cells=2), box("wall", (-1000, 1, 0), (1000, 3, 1000)))
    scene = SceneMesh.assemble([wall])
    transfer = direct(scene, order=2)[:, 0] * WHITE
    foot = (scene.normals[:, 2] > 0.9) & (np.abs(scene.points[:, 1] - 1.0) < 1e-9) & (scene.points[:, 2] == 0.0)
    assert foot.sum() >= 3
    assert np.abs(transfer[foot] - 0.5).max() < 0.02


def test_touching_box_leaks_no_light_and_leaves_no_black_rim():
    scene = SceneMesh.assemble([plane(size=4.0, cells=8), box(low=(-0.5, -0.5, 0), high=(0.5, 0.5, 1))])
    seen = direct(scene, order=2)[:, 0] * WHITE
    below = (np.abs(scene.points[:, :2]).max(axis=1) < 0.4) & (scene.points[:, 2] == 0)
    assert below.any() and np.abs(seen[below]).max() < 1e-6
    sides = (np.abs(scene.normals[:, 2]) < 0.1)
    assert seen[sides].min() > 0.45  # a wall over a plane sees half the sphere's cosine: 0.5


def found_buried(scene, seen):
    """Keys of buried receivers, of all of the scene's."""
    tracer = Tracer(scene.points, scene.triangles, 1)
    receivers = ReceiverSet.of_keys(scene, tracer, np.arange(len(scene.points)))
    return buried_receivers(tracer, scene, receivers, seen[receivers.key])


def test_receivers_inside_a_body_are_found_and_filled_from_outside():
    # A floor with a box standing on it: points under the box see only its inside. Its neighbours are in the open.
    scene = SceneMesh.assemble([plane(size=4.0, cells=16), box(low=(-0.6, -0.6, -0.2), high=(0.6, 0.6, 1))])
    seen = direct(scene, order=1)[:, 0] * WHITE
    buried = found_buried(scene, seen)
    floor = np.flatnonzero(scene.points[:, 2] == 0)
    inside = floor[np.abs(scene.points[floor, :2]).max(axis=1) < 0.6]
    assert set(buried) == set(inside)  # the box's lower corners stick out below the floor: in the open, not buried
    transfer = seen[:, None, None].astype(np.float32)
    assert transfer[inside].max() < 1e-6
    assert fill_buried(scene.triangles, scene.loose, buried, transfer) == len(inside) - 1  # not the innermost
    rim = inside[np.abs(scene.points[inside, :2]).max(axis=1) > 0.4]
    assert transfer[rim].min() > 0.4


def test_floor_under_a_hovering_body_is_filled_but_a_crevice_stays_dark():
    # 1 mm between floor and box, floor cells of 25 cm: below what the floor's receivers resolve.
    scene = SceneMesh.assemble([plane(size=4.0, cells=16), box(low=(-0.6, -0.6, 0.001), high=(0.6, 0.6, 1))])
    seen = direct(scene, order=1)[:, 0] * WHITE
    buried = found_buried(scene, seen)
    floor = np.flatnonzero(scene.points[:, 2] == 0)
    assert set(floor[np.abs(scene.points[floor, :2]).max(axis=1) < 0.6]) <= set(buried)
    # The same two bodies as one object are a crevice that the artist modelled.
    one = SceneMesh.assemble([join("one", plane(size=4.0, cells=16),
                                   box(low=(-0.6, -0.6, 0.001), high=(0.6, 0.6, 1)))])
    seen = direct(one, order=1)[:, 0] * WHITE
    assert not len(found_buried(one, seen))


def test_threads_and_chunks_change_nothing():
    scene = SceneMesh.assemble([plane(size=4.0, cells=16), sphere(centre=(0, 0, 1.2))])
    one = direct(scene, order=4, count=512, threads=1)
    assert np.array_equal(one, direct(scene, order=4, count=512, threads=3))
    matrices = [gather(scene, 128, threads).matrix for threads in (1, 3)]
    assert (matrices[0] != matrices[1]).nnz == 0


def test_random_rotation_of_groups_agrees_within_its_noise():
    scene = SceneMesh.assemble([plane(size=4.0, cells=16), sphere(centre=(0, 0, 1.2))])
    fixed, turned = direct(scene, count=1024), direct(scene, count=1024, group=64)
    assert 0.0 < np.sqrt(np.mean((fixed - turned) ** 2) / np.mean(fixed**2)) < 0.02


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
@pytest.mark.parametrize("shift", [0.0, 1e3])
def test_scale_and_place_change_nothing(scale, shift):
    def scene(scale, shift):
        from dataclasses import replace
        meshes = [plane(size=4.0, cells=8), sphere(centre=(0, 0, 1.2), subdivisions=2)]
        return SceneMesh.assemble([replace(m, positions=(m.positions + shift) * scale) for m in meshes])

    difference = direct(scene(scale, shift), count=256) - direct(scene(1.0, 0.0), count=256)
    assert np.sqrt(np.mean(difference**2)) < 2e-4


def test_closed_room_keeps_all_energy():
    room = SceneMesh.assemble([box(inward=True), box("thing", (0.4, 0.4, 0.4), (0.6, 0.6, 0.6))], 0.2)
    gathered = gather(room)
    assert gathered.hit_share == pytest.approx(1.0, abs=1e-6)
    assert np.abs(np.asarray(gathered.matrix.sum(axis=1)) - 1.0).max() < 1e-5


@pytest.mark.parametrize("albedo", [0.2, 0.5, 0.9, 0.99])
def test_furnace(albedo):
    # Every surface of a closed room emits 1: radiance is 1 / (1 - albedo), up to 100 (stiff).
    room = SceneMesh.assemble([box(inward=True), box("thing", (0.4, 0.4, 0.4), (0.6, 0.6, 0.6))], 0.2)
    gathered = gather(room, 256)
    size = len(gathered.receivers)
    emitted = np.ones((size, 4), np.float32) * np.array([1.0, 2.0, 0.0, -3.0], np.float32)
    result = drain(interreflect(gathered.matrix, np.full((size, 1), albedo, np.float32), emitted, 1e-5))
    expected = emitted[:, :, None] / (1.0 - albedo)
    assert np.abs(result.transfer - expected).max() <= 2e-3 * np.abs(expected).max()
    assert result.method == ("BiCGSTAB" if albedo > 0.7 else "series")
    assert result.residual <= 1e-5


@pytest.mark.parametrize("albedo", [0.5, 0.99])
def test_solver_against_a_direct_sparse_solution(albedo):
    rng = np.random.default_rng(2)
    matrix = sparse.random(300, 300, 0.05, random_state=3, format="csr", dtype=np.float32)
    matrix = sparse.csr_matrix(sparse.diags(1.0 / np.asarray(matrix.sum(axis=1)).ravel()) @ matrix).astype(np.float32)
    rho = rng.random((300, 3)).astype(np.float32) * albedo
    right = rng.normal(size=(300, 5)).astype(np.float32)
    result = drain(interreflect(matrix, rho, right, 1e-6))
    for channel in range(3):
        system = sparse.eye(300, format="csc") - sparse.csc_matrix(matrix.astype(float) @ sparse.diags(rho[:, channel]))
        exact = sparse.linalg.spsolve(system, right.astype(float))
        assert np.abs(result.transfer[:, :, channel] - exact).max() < 1e-4 * np.abs(exact).max()


def test_bounces_stop_where_they_are_told_or_where_nothing_is_left():
    scene = SceneMesh.assemble([plane(size=4.0, cells=8), sphere(centre=(0, 0, 1.2), subdivisions=2)])
    gathered = gather(scene, 512)
    start = np.ones((len(gathered.receivers), 1), np.float32)
    rho = np.full((len(start), 1), 0.5, np.float32)
    one = drain(interreflect(gathered.matrix, rho, start, 1e-3, bounces=1))
    assert one.bounces == 1
    expected = start + 0.5 * (gathered.matrix @ start)
    assert np.abs(one.transfer[:, :, 0] - expected).max() < 1e-6
    rough, fine = (drain(interreflect(gathered.matrix, rho, start, t)) for t in (1e-2, 1e-5))
    assert rough.bounces < fine.bounces
    assert np.linalg.norm(rough.transfer - fine.transfer) <= 1e-2 * np.linalg.norm(fine.transfer)


@pytest.mark.parametrize(("kind", "expected"), [("parallel", 0.199825), ("perpendicular", 0.200044)])
def test_form_factors_of_unit_squares(kind, expected):
    # G of a receiver summed over a square, averaged over the other square, is their form factor (transfer.md).
    from tests.core.shapes import make
    cells = 12
    floor = plane("floor", cells=cells, centre=(0.5, 0.5))
    if kind == "parallel":
        other = plane("other", cells=cells, height=1.0, centre=(0.5, 0.5), up=False)
    else:
        positions = floor.positions[:, [2, 0, 1]]
        other = make("other", positions, floor.triangles)
    scene = SceneMesh.assemble([floor, other])
    gathered = gather(scene, 4096)
    area = np.zeros(len(scene.points))
    np.add.at(area, scene.triangles.ravel(), 1.0 / (2 * cells * cells) / 3.0)
    place = np.empty(len(scene.points), int)
    place[gathered.receivers.key] = np.arange(len(gathered.receivers))
    first, second = (place[np.arange(o.points.start, o.points.stop)] for o in scene.objects)
    share = np.asarray(gathered.matrix[first][:, second].sum(axis=1)).ravel()
    assert float((share * area[scene.objects[0].points]).sum()) == pytest.approx(expected, rel=0.02)


def test_backs_are_followed_where_they_matter():
    # An open upright square seen from behind: its back is lit by the sky and must bounce light on.
    from tests.core.shapes import make
    wall = make("wall", [[-2, 1, 0], [2, 1, 0], [2, 1, 3], [-2, 1, 3]], [[0, 1, 2], [0, 2, 3]], target=False)
    scene = SceneMesh.assemble([plane(size=2.0, cells=8), wall])
    for facing in (scene, SceneMesh.assemble([plane(size=2.0, cells=8), make(
            "wall", wall.positions, wall.triangles[:, ::-1], target=False)])):
        gathered = gather(facing, 512)
        reached = np.asarray(gathered.matrix.sum(axis=1)).ravel()[np.argsort(gathered.receivers.key)][:81]
        assert gathered.lost_share < 1e-6 and reached.max() > 0.3
