# SPDX-License-Identifier: GPL-3.0-or-later
"""Glossy transfer against closed forms, brute-force integration and furnaces; the tools it is made of."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.special import sph_harm_y

from prt_addon.basis.directions import quadrature, tangent_frames
from prt_addon.basis.spherical_harmonics import evaluate, expand_bands, rotate, rotation, rotations, zonal_hemisphere
from prt_addon.basis.triple_product import triple_products
from prt_addon.scene.scene_mesh import SceneMesh
from prt_addon.tracing.tracer import Tracer
from prt_addon.transport import glossy, incident_light
from prt_addon.transport.direct import direct_transfer, unshadowed_transfer
from prt_addon.transport.gather import gather_operator
from prt_addon.transport.glossy import GlossySurfaces, glossy_transfer, surface_frames
from prt_addon.transport.hemisphere_visibility import HemisphereVisibility
from prt_addon.transport.incident_light import DiffuseRadiance, GlossyRadiance, IndirectLight, irradiance_from
from prt_addon.transport.receiver_set import ReceiverSet
from tests.core.shapes import box, drain, make, plane, sphere

Y0 = 1.0 / math.sqrt(4.0 * math.pi)
ALL = np.arange(25)


def random_directions(count, seed=0):
    directions = np.random.default_rng(seed).normal(size=(count, 3))
    return directions / np.linalg.norm(directions, axis=1, keepdims=True)


def hemisphere_rule(degree=24):
    """Directions and weights that integrate polynomials up to `degree` over the upper hemisphere exactly."""
    z, weights = np.polynomial.legendre.leggauss(degree // 2 + 1)
    z, weights = np.repeat((z + 1) / 2, degree + 1), np.repeat(weights / 2, degree + 1) * 2 * np.pi / (degree + 1)
    phi = np.tile(np.arange(degree + 1) * 2 * np.pi / (degree + 1), degree // 2 + 1)
    radius = np.sqrt(1 - z**2)
    return np.stack([radius * np.cos(phi), radius * np.sin(phi), z], axis=1), weights


def kernel_of(brdf, incident_order=5, functions=ALL):
    """K (rows, incident functions, 1): brdf(views, lights) times the cosine, fitted on both sides."""
    directions, weights = hemisphere_rule()
    root = np.sqrt(weights)[:, None]
    values = brdf(directions, directions) * directions[:, 2]
    out = np.linalg.pinv(evaluate(5, directions)[:, functions] * root, 1e-13) * root[:, 0]
    into = np.linalg.pinv(evaluate(incident_order, directions) * root, 1e-13) * root[:, 0]
    return (out @ values @ into.T)[:, :, None]


def diffuse_brdf(views, lights):
    return np.full((len(views), len(lights)), 1.0 / np.pi)


def lobe_brdf(views, lights):
    """A broad lobe about the mirrored view, a polynomial of degree 3 in both: K holds it exactly."""
    return (1.0 + views * (-1.0, -1.0, 1.0) @ lights.T) ** 3 / 8.0


def stretched_brdf(views, lights):
    """The same, different along the tangent and the bitangent."""
    return (1.0 + views * (-1.0, -0.3, 1.0) @ lights.T) ** 3 / 8.0 + 0.2 * lights[None, :, 0] ** 2


def traced(scene, order=3, incident=5, count=1024, threads=1, chosen=None, blocked=0, receivers=None, group=0):
    """Tracer, receivers, diffuse transfer and visibility coefficients of all points."""
    tracer = Tracer(scene.points, scene.triangles, threads)
    if receivers is None:
        receivers = ReceiverSet.of_keys(scene, tracer, np.flatnonzero(~scene.loose))
    chosen = np.ones(len(receivers), bool) if chosen is None else chosen
    plain = HemisphereVisibility(chosen, incident + order - 1, blocked)
    rule = quadrature(count, incident + order - 1)
    transfer = drain(direct_transfer(tracer, receivers, *rule, order, group, 3, plain=plain))
    return tracer, receivers, transfer, plain.result(receivers.normals)


def surfaces_of(receivers, brdf, frames=None, incident=5):
    frames = tangent_frames(receivers.normals) if frames is None else frames
    return GlossySurfaces(frames, np.zeros(len(receivers), np.int64), (kernel_of(brdf, incident),))


def matrices_of(scene, brdf, order=3, incident=5, count=1024, frames=None, threads=1):
    tracer, receivers, _, seen = traced(scene, order, incident, count, threads)
    surfaces = surfaces_of(receivers, brdf, frames, incident)
    return receivers, surfaces, drain(glossy_transfer(tracer, surfaces, order, seen.visible))


def views_above(count=40, seed=1):
    views = random_directions(count, seed)
    views[:, 2] = np.abs(views[:, 2])
    return views


# The tools


@pytest.mark.parametrize("order", [1, 2, 5, 10])
def test_many_rotations_at_once(order):
    matrices = np.concatenate([Rotation.random(20, rng=order).as_matrix(), np.eye(3)[None], -np.eye(3)[None],
                               np.diag([1.0, -1.0, -1.0])[None]])
    blocks = rotations(order, matrices)
    directions = random_directions(30)
    values = evaluate(order, directions)
    for number, matrix in enumerate(matrices):
        whole = rotation(order, matrix)
        turned = evaluate(order, directions @ matrix.T)
        for band in range(order):
            part, block = slice(band**2, (band + 1) ** 2), blocks[band][number]
            np.testing.assert_allclose(block @ block.T, np.eye(2 * band + 1), atol=1e-12)
            np.testing.assert_allclose(block, whole[part, part], atol=1e-12)
            np.testing.assert_allclose(turned[:, part], values[:, part] @ block.T, atol=1e-12)


def test_what_is_no_rotation_is_refused():
    for matrices in (np.eye(3), np.eye(3)[None] * 2.0, np.full((2, 3, 3), np.nan)):
        with pytest.raises(ValueError, match="rotation"):
            rotations(3, matrices)
    assert [b.shape for b in rotations(2, np.zeros((0, 3, 3)))] == [(0, 1, 1), (0, 3, 3)]


@pytest.mark.parametrize(("first", "second"), [(1, 3), (5, 5), (5, 10), (4, 2)])
def test_products_of_functions_are_sums_of_functions(first, second):
    directions = random_directions(200)
    theta, phi = np.arccos(np.clip(directions[:, 2], -1, 1)), np.arctan2(directions[:, 1], directions[:, 0])

    def scipy_values(order):
        columns = []
        for band in range(order):
            for m in range(-band, band + 1):
                value = sph_harm_y(band, abs(m), theta, phi) * (-1) ** m
                columns.append(value.real if m == 0 else math.sqrt(2) * (value.real if m > 0 else value.imag))
        return np.stack(columns, axis=1)

    products = scipy_values(first)[:, :, None] * scipy_values(second)[:, None, :]
    table = triple_products(first, second)
    np.testing.assert_allclose(scipy_values(first + second - 1) @ table, products.reshape(200, -1), atol=1e-11)
    assert not table.flags.writeable


def test_triple_products_of_three_functions_are_symmetric_and_selected():
    table = triple_products(4, 4)[:16].reshape(16, 16, 16)
    np.testing.assert_allclose(table, table.transpose(1, 0, 2), atol=1e-13)
    np.testing.assert_allclose(table, table.transpose(2, 1, 0), atol=1e-13)
    np.testing.assert_allclose(table[0], np.eye(16) * Y0, atol=1e-13)


def test_zonal_hemisphere_is_the_integral_over_the_upper_hemisphere():
    directions, weights = hemisphere_rule(24)
    integrals = weights @ evaluate(12, directions)
    expected = expand_bands(zonal_hemisphere(12)) * evaluate(12, np.array([[0.0, 0, 1]]))[0]
    np.testing.assert_allclose(integrals, expected, atol=1e-13)
    assert zonal_hemisphere(1) == pytest.approx([2 * np.pi])


def test_frames_are_right_handed_whatever_the_tangent():
    normals = random_directions(50)
    tangents = random_directions(50, 1) * 3.0
    tangents[:3] = np.stack([normals[0], np.zeros(3), np.full(3, np.nan)])
    frames = surface_frames(normals, tangents)
    np.testing.assert_allclose(frames @ frames.transpose(0, 2, 1), np.tile(np.eye(3), (50, 1, 1)), atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(frames), 1.0)
    np.testing.assert_allclose(np.cross(frames[:, 2], frames[:, 0]), frames[:, 1], atol=1e-12)
    assert np.all(np.sum(frames[3:, 0] * tangents[3:], axis=1) > 0)


# Direct light


@pytest.mark.parametrize("order", [3, 5])
def test_open_plane_reflects_random_light_as_brute_force_does(order):
    scene = SceneMesh.assemble([plane()])
    turn = Rotation.from_rotvec([0, 0, 0.7]).as_matrix()
    frames = np.tile(turn.T, (4, 1, 1))  # tangents 0.7 rad about +Z
    for brdf in (lobe_brdf, stretched_brdf):
        _, _, matrices = matrices_of(scene, brdf, order, count=64, frames=frames)
        light = np.random.default_rng(order).normal(size=(order * order, 2))
        views = views_above()
        directions, weights = hemisphere_rule()
        sky = evaluate(order, directions @ turn.T) @ light  # the frame's directions, in the world
        expected = brdf(views, directions) @ (sky * (weights * directions[:, 2])[:, None])
        exit_light = np.einsum("vi,rijc,jk->rvkc", evaluate(5, views), matrices, light)
        assert matrices.shape == (4, 25, order * order, 1) and matrices.dtype == np.float32
        np.testing.assert_allclose(exit_light[..., 0], np.tile(expected, (4, 1, 1)), atol=2e-4 * np.abs(expected).max())


def test_a_diffuse_kernel_gives_the_diffuse_transfer():
    scene = SceneMesh.assemble([plane(size=4.0, cells=6), sphere(centre=(0, 0, 1.2), subdivisions=2),
                                plane("roof", size=4.0, height=3.0, cells=6)])
    tracer, receivers, transfer, seen = traced(scene, order=4)
    result = drain(glossy_transfer(tracer, surfaces_of(receivers, diffuse_brdf), 4, seen.visible))
    views = views_above(10)
    exit_transfer = np.einsum("vi,rij->rvj", evaluate(5, views), result[..., 0])
    # The same rays; only the share of the quadrature's error that is taken out differs where part is hidden.
    open_ones = np.abs(transfer - unshadowed_transfer(receivers.normals, 4)).max(axis=1) < 1e-6
    assert 20 < open_ones.sum() < len(open_ones)
    difference = np.abs(exit_transfer - transfer[:, None, :])
    assert difference[open_ones].max() < 2e-5
    assert difference.max() < 4e-3


def test_half_space_occluder():
    # A wall of a kilometre, a centimetre away: nothing with x > 0 is seen, what is left is half a hemisphere.
    wall = make("wall", [(0.01, -1e3, -1e3), (0.01, 1e3, -1e3), (0.01, 1e3, 1e3), (0.01, -1e3, 1e3)],
                [(0, 2, 1), (0, 3, 2)], target=False)
    scene = SceneMesh.assemble([plane(size=1e-3), wall])
    tracer, receivers, _, seen = traced(scene, 3, 5, 16384, blocked=5)
    up = receivers.key < 4
    z, wz = np.polynomial.legendre.leggauss(20)
    x, wx = np.polynomial.legendre.leggauss(40)
    z, phi = np.repeat((z + 1) / 2, 40), np.tile(np.pi + x * np.pi / 2, 20)
    weights = np.repeat(wz / 2, 40) * np.tile(wx * np.pi / 2, 20)
    quarter = np.stack([np.sqrt(1 - z**2) * np.cos(phi), np.sqrt(1 - z**2) * np.sin(phi), z], axis=1)
    expected = weights @ evaluate(7, quarter)
    assert np.abs(seen.visible[up] - expected).max() < 4e-3
    mirrored = weights @ evaluate(5, quarter * (-1, 1, 1))
    assert np.abs(seen.blocked[up] - mirrored).max() < 4e-3
    surfaces = surfaces_of(receivers, lobe_brdf)
    result = drain(glossy_transfer(tracer, surfaces, 3, seen.visible))[up]
    views = views_above()
    local = quarter @ surfaces.frames[up][0].T
    brute = lobe_brdf(views, local) @ (evaluate(3, quarter) * (weights * quarter[:, 2])[:, None])
    got = np.einsum("vi,rij->rvj", evaluate(5, views), result[..., 0])
    assert np.abs(got - brute).max() < 4e-3 * np.abs(brute).max()


def test_turning_scene_light_and_tangents_together_changes_nothing():
    turn = Rotation.from_rotvec([0.4, -1.1, 0.6]).as_matrix()
    meshes = [plane(size=4.0, cells=4), sphere(centre=(0, 0, 1.5), subdivisions=2)]
    turned = [replace(m, positions=m.positions @ turn.T,
                      corner_normals=(m.corner_normals @ turn.T).astype(np.float32)) for m in meshes]
    light = np.random.default_rng(5).normal(size=16)
    results = []
    for parts, matrix in ((meshes, np.eye(3)), (turned, turn)):
        scene = SceneMesh.assemble(parts)
        tracer, receivers, _, seen = traced(scene, 4, count=4096)
        frames = surface_frames(receivers.normals, np.tile(matrix @ (0.3, 0.5, 0.8), (len(receivers), 1)))
        result = drain(glossy_transfer(tracer, surfaces_of(receivers, stretched_brdf, frames), 4, seen.visible))
        exit_light = np.einsum("vi,rij,j->rv", evaluate(5, views_above()), result[..., 0], rotate(light, matrix))
        results.append(exit_light[np.argsort(receivers.key)])
    difference = np.sqrt(np.mean((results[0] - results[1]) ** 2) / np.mean(results[0] ** 2))
    assert difference < 5e-3  # the directions did not turn along: what the quadrature makes of the shadows


def test_an_anisotropic_kernel_turns_with_the_tangent():
    scene = SceneMesh.assemble([plane()])
    quarter = Rotation.from_rotvec([0, 0, np.pi / 2]).as_matrix()
    light = np.random.default_rng(6).normal(size=9)
    views = views_above()
    along = matrices_of(scene, stretched_brdf, count=64, frames=np.tile(np.eye(3), (4, 1, 1)))[2][..., 0]
    across = matrices_of(scene, stretched_brdf, count=64, frames=np.tile(quarter.T, (4, 1, 1)))[2][..., 0]
    one = np.einsum("vi,rij,j->rv", evaluate(5, views), along, light)
    other = np.einsum("vi,rij,j->rv", evaluate(5, views), across, rotate(light, quarter))  # views in turned frames
    np.testing.assert_allclose(one, other, atol=1e-4 * np.abs(one).max())
    still = np.einsum("vi,rij,j->rv", evaluate(5, views @ quarter), across, light)  # the same views of the world
    assert np.abs(one - still).max() > 0.05 * np.abs(one).max()


def test_materials_and_channels_keep_apart():
    scene = SceneMesh.assemble([plane(cells=3)])
    tracer, receivers, _, seen = traced(scene, 3, count=64)
    frames, colours = tangent_frames(receivers.normals), np.array([1.0, 0.5, 0.25])
    kernels = (kernel_of(lobe_brdf) * colours, kernel_of(diffuse_brdf) * colours[::-1])
    material = np.arange(len(receivers)) % 2
    mixed = drain(glossy_transfer(tracer, GlossySurfaces(frames, material, kernels), 3, seen.visible))
    for number, brdf in ((0, lobe_brdf), (1, diffuse_brdf)):
        alone = drain(glossy_transfer(tracer, surfaces_of(receivers, brdf), 3, seen.visible))
        expected = alone * (colours if number == 0 else colours[::-1]).astype(np.float32)
        np.testing.assert_allclose(mixed[material == number], expected[material == number], atol=1e-5)
    with pytest.raises(ValueError, match="kernels"):
        GlossySurfaces(frames, material, (kernels[0], kernels[1][:, :16]))


# The same rays, chunks, threads


def test_diffuse_transfer_is_the_same_with_and_without_glossy_receivers():
    scene = SceneMesh.assemble([plane(size=4.0, cells=12), sphere(centre=(0, 0, 1.2), subdivisions=2)])
    tracer, receivers, transfer, seen = traced(scene, count=256, threads=2, blocked=5)
    rays = tracer.rays
    alone = Tracer(scene.points, scene.triangles, 1)
    rule = quadrature(256, 7)
    assert np.array_equal(transfer, drain(direct_transfer(alone, receivers, *rule, 3, 0, 3)))
    assert alone.rays == rays
    chosen = np.arange(len(receivers)) % 3 == 1
    some = traced(scene, count=256, chosen=chosen, blocked=5)[3]
    assert np.array_equal(some.rows, np.flatnonzero(chosen))
    assert np.abs(some.visible - seen.visible[chosen]).max() < 2e-6
    assert np.abs(some.blocked - seen.blocked[chosen]).max() < 2e-6
    # What is seen, what is blocked and what lies under the faces is the whole hemisphere.
    whole = evaluate(5, receivers.normals) * expand_bands(zonal_hemisphere(5))
    together = seen.visible[:, :25] + seen.blocked
    flat = scene.points[receivers.key, 2] == 0.0
    assert flat.sum() == 169 and seen.blocked[flat, 0].max() > 0.2
    assert np.abs(together - whole)[flat].max() < 1e-5
    none = traced(scene, count=64, chosen=np.zeros(len(receivers), bool))[3]
    assert none.visible.shape == (0, 49)


def room_parts(threads=1, count=256, group=0, albedo=0.5):
    """A closed white room with a box in it: tracer, scene, gather with hits, visibility."""
    room = SceneMesh.assemble([box(inward=True, albedo=(albedo,) * 3),
                               box("thing", (0.4, 0.4, 0.4), (0.6, 0.6, 0.6), albedo=(albedo,) * 3)], 0.3)
    tracer = Tracer(room.points, room.triangles, threads)
    wanted = np.ones(2 * len(room.points), bool)
    keys = np.arange(len(room.points))
    gathered = drain(gather_operator(tracer, room, keys, *quadrature(count, 4), group, 1, wanted))
    seen = traced(room, 2, 5, 512, threads, None, 5, gathered.receivers, group)[3]
    return tracer, room, gathered, seen


def room_matrices(threads=1, group=0):
    tracer, room, gathered, seen = room_parts(threads, group=group)
    radiance = np.random.default_rng(1).random((len(gathered.receivers), 4, 3)).astype(np.float32)
    surfaces = surfaces_of(gathered.receivers, stretched_brdf)
    source = DiffuseRadiance(gathered.hits, room, gathered.receivers, radiance)
    light = IndirectLight(gathered.hits, source, seen.rows, seen.blocked)
    first = drain(glossy_transfer(tracer, surfaces, 2, seen.visible, light))
    again = GlossyRadiance(gathered.hits, room, gathered.receivers.key, surfaces.frames, first, ALL)
    return first, drain(glossy_transfer(tracer, surfaces, 2, None,
                                        IndirectLight(gathered.hits, again, seen.rows, seen.blocked)))


def test_threads_and_blocks_change_nothing(monkeypatch):
    usual = room_matrices(1)
    for one, three in zip(usual, room_matrices(3), strict=True):
        assert np.array_equal(one, three)
    monkeypatch.setattr(incident_light, "BLOCK", 7)
    monkeypatch.setattr(incident_light, "NUMBERS", 1 << 14)
    monkeypatch.setattr(glossy, "BLOCK", 7)
    for one, small in zip(usual, room_matrices(1), strict=True):
        assert np.abs(one - small).max() <= 2e-6 * np.abs(one).max()


def test_a_preallocated_result_is_filled_in_place():
    scene = SceneMesh.assemble([plane(cells=2)])
    tracer, receivers, transfer, seen = traced(scene, 3, count=64)
    surfaces = surfaces_of(receivers, lobe_brdf)
    whole = np.full((len(receivers), 26, 9, 1), np.nan, np.float32)
    whole[:, 0, :, 0] = transfer
    drain(glossy_transfer(tracer, surfaces, 3, seen.visible, out=whole[:, 1:]))
    assert np.array_equal(whole[:, 1:], drain(glossy_transfer(tracer, surfaces, 3, seen.visible)))
    with pytest.raises(ValueError, match="out must be"):
        drain(glossy_transfer(tracer, surfaces, 3, seen.visible, out=whole))
    with pytest.raises(ValueError, match="visibility"):
        drain(glossy_transfer(tracer, surfaces, 3, None))


# Indirect light


@pytest.mark.parametrize("group", [0, 16])
def test_hits_hold_what_the_gather_operator_holds(group):
    _, room, gathered, _ = room_parts(group=group)
    record = gathered.hits
    radiance = np.random.default_rng(2).random((len(gathered.receivers), 2, 1)).astype(np.float32)
    source = DiffuseRadiance(record, room, gathered.receivers, radiance)
    rows = np.arange(len(gathered.receivers))
    expected = gathered.matrix @ radiance[:, :, 0]
    for chosen in (rows, rows[::3]):
        np.testing.assert_allclose(drain(irradiance_from(record, source, chosen)), expected[chosen], atol=1e-5)
    owner = np.repeat(rows, np.diff(record.first))
    cosines = np.sum(gathered.receivers.normals[owner] * record.directions[record.direction], axis=1)
    assert cosines.min() > 0.0
    # A ray's share of the cosine-weighted hemisphere is its solid angle times its cosine over pi, but for the rule's
    # normalisation.
    ratio = record.share * np.pi / (record.solid_angle * cosines)
    assert np.abs(ratio[record.solid_angle > 0] - 1.0).max() < 0.05


def test_only_wanted_receivers_keep_their_hits_and_nothing_else_changes():
    room = SceneMesh.assemble([box(inward=True), box("thing", (0.4, 0.4, 0.4), (0.6, 0.6, 0.6))], 0.3)
    tracer = Tracer(room.points, room.triangles, 1)
    keys, rule = np.arange(len(room.points)), quadrature(64, 4)
    wanted = np.zeros(2 * len(keys), bool)
    wanted[keys[::5]] = True
    some = drain(gather_operator(tracer, room, keys, *rule, wanted=wanted))
    rays = tracer.rays
    without = drain(gather_operator(tracer, room, keys, *rule))
    assert without.hits is None and tracer.rays == 2 * rays
    assert (some.matrix != without.matrix).nnz == 0
    counts = np.diff(some.hits.first)
    assert np.array_equal(counts > 0, wanted[some.receivers.key])


@pytest.mark.parametrize("count", [64, 512])
def test_white_furnace(count):
    # Every surface of a closed room sends 1 everywhere: the incident radiance of all receivers is 1.
    tracer, room, gathered, seen = room_parts(count=count)
    receivers, scale = gathered.receivers, np.array([1.0, 2.0, 0.0, -3.0], np.float32)
    radiance = np.tile(scale, (len(receivers), 1))[:, :, None]
    source = DiffuseRadiance(gathered.hits, room, receivers, radiance)
    light = IndirectLight(gathered.hits, source, seen.rows, seen.blocked)
    assert np.abs(seen.visible).max() < 1e-5
    surfaces = surfaces_of(receivers, lobe_brdf)
    matrices = drain(glossy_transfer(tracer, surfaces, 2, seen.visible, light))
    views, (directions, weights) = views_above(), hemisphere_rule()
    reflected = lobe_brdf(views, directions) @ (weights * directions[:, 2])
    exit_light = np.einsum("vi,rij->rvj", evaluate(5, views), matrices[..., 0])
    expected = reflected[:, None] * scale
    assert np.abs(exit_light - expected).max() < 1e-3 * np.abs(expected).max()
    # Now the surfaces' glossy rows send the same, and the glossy bounce must bring what the diffuse one brought.
    white = np.zeros((len(receivers), 25, 4, 1), np.float32)
    white[:, 0, :, 0] = scale / Y0
    again = GlossyRadiance(gathered.hits, room, receivers.key, surfaces.frames, white, ALL)
    second = IndirectLight(gathered.hits, again, seen.rows, seen.blocked)
    diffuse = np.full((len(receivers), 4), np.nan, np.float32)
    bounced = drain(glossy_transfer(tracer, surfaces, 2, None, second, diffuse=diffuse))
    assert np.abs(bounced - matrices).max() < 2e-5 * np.abs(matrices).max()
    np.testing.assert_allclose(diffuse, np.tile(scale, (len(receivers), 1)), atol=1e-4)


@pytest.mark.parametrize("faces", [[(0, 2, 1), (0, 3, 2)], [(0, 1, 2), (0, 2, 3)]], ids=["front", "back"])
def test_a_bright_wall_lights_half_the_hemisphere(faces):
    wall = make("wall", [(0.01, -1e3, -1e3), (0.01, 1e3, -1e3), (0.01, 1e3, 1e3), (0.01, -1e3, 1e3)], faces,
                target=False)
    scene = SceneMesh.assemble([plane(size=1e-3), wall])
    tracer = Tracer(scene.points, scene.triangles, 1)
    wanted = np.ones(2 * len(scene.points), bool)
    gathered = drain(gather_operator(tracer, scene, np.arange(4), *quadrature(512, 4), wanted=wanted))
    seen = traced(scene, 2, 5, 8192, blocked=5, receivers=gathered.receivers)[3]
    assert len(gathered.hits.directions) == 512  # two generations, one table
    facing = gathered.receivers.normals[:, 0] < -0.5  # the wall's receivers on the side that the plane sees
    assert facing.sum() == 4
    source = DiffuseRadiance(gathered.hits, scene, gathered.receivers,
                             np.tile(facing.astype(np.float32)[:, None, None], (1, 4, 1)))
    surfaces = surfaces_of(gathered.receivers, lobe_brdf)
    light = IndirectLight(gathered.hits, source, seen.rows, seen.blocked)
    result = drain(glossy_transfer(tracer, surfaces, 2, None, light))
    here = np.flatnonzero(gathered.receivers.key < 4)
    directions, weights = hemisphere_rule(200)
    lit = weights * directions[:, 2] * (directions[:, 0] > 0)
    views = views_above()
    expected = lobe_brdf(views, directions @ surfaces.frames[here[0]].T) @ lit
    exit_light = np.einsum("vi,rij->rvj", evaluate(5, views), result[here][..., 0])
    assert np.abs(exit_light - expected[:, None]).max() < 1e-2 * expected.max()


def test_faces_hide_what_lies_under_them_from_glossy_receivers_too():
    # A vertex of a smooth-shaded cube sees, as the mean over its faces, two lunes' worth less than its hemisphere.
    thing = box("thing", (0.45, 0.45, 0.45), (0.55, 0.55, 0.55))
    outwards = np.sign(thing.positions - 0.5)[thing.triangles] / np.sqrt(3.0)
    room = SceneMesh.assemble([box(inward=True), replace(thing, corner_normals=outwards.astype(np.float32))], 0.3)
    cube = room.objects[1].points
    tracer = Tracer(room.points, room.triangles, 1)
    wanted = np.ones(2 * len(room.points), bool)
    gathered = drain(gather_operator(tracer, room, np.arange(len(room.points)), *quadrature(4096, 4), wanted=wanted))
    seen = traced(room, 2, 5, 4096, blocked=5, receivers=gathered.receivers)[3]
    corner = np.flatnonzero((gathered.receivers.key >= cube.start) & (gathered.receivers.key < cube.start + 8))
    expected = 2.0 * (np.pi - np.arccos(1.0 / np.sqrt(3.0)))
    solid = np.add.reduceat(gathered.hits.solid_angle, gathered.hits.first[:-1])
    assert len(corner) == 8
    np.testing.assert_allclose(solid[corner], expected, rtol=0.02)
    np.testing.assert_allclose(seen.blocked[corner, 0] / Y0, expected, rtol=0.02)


def brute_radiance(record, scene, hit, key, frames, matrices):
    """Exit radiance of a hit from the matrices of its corners, in angles."""
    view = -record.directions[record.direction[hit]].astype(float)
    u, v = float(record.u[hit]), float(record.v[hit])
    total = np.zeros(matrices.shape[2:])
    for point, weight in zip(scene.triangles[record.triangle[hit]], (1 - u - v, u, v), strict=True):
        place = np.flatnonzero(key == point + (0 if record.front[hit] else len(scene.points)))
        if len(place):
            x, y, z = frames[place[0]] @ view
            height = max(z, 0.0)
            azimuth, radius = np.arctan2(y, x), np.sqrt(1 - height**2)
            above = np.array([[radius * np.cos(azimuth), radius * np.sin(azimuth), height]])
            total += weight * np.tensordot(evaluate(5, above)[0, 1:], matrices[place[0]], 1)
    return total


def test_sums_over_hits_equal_brute_force():
    room = SceneMesh.assemble([box(inward=True), sphere("thing", 0.2, (0.5, 0.5, 0.5), 1)], 0.4)
    tracer = Tracer(room.points, room.triangles, 1)
    wanted = np.ones(2 * len(room.points), bool)
    gathered = drain(gather_operator(tracer, room, np.arange(len(room.points)), *quadrature(96, 4), wanted=wanted))
    record, receivers, rng = gathered.hits, gathered.receivers, np.random.default_rng(4)
    some = np.sort(rng.permutation(len(receivers))[:len(receivers) // 2])  # the other half has no glossy rows
    frames = surface_frames(receivers.normals[some], random_directions(len(some), 2))
    matrices = rng.normal(size=(len(some), 24, 4, 3)).astype(np.float32)
    source = GlossyRadiance(record, room, receivers.key[some], frames, matrices, ALL[1:])
    hits = rng.permutation(len(record.triangle))[:400]
    brute = np.array([brute_radiance(record, room, h, receivers.key[some], frames, matrices) for h in hits])
    np.testing.assert_allclose(source.along(hits), brute.reshape(400, -1), atol=2e-4)
    owner = np.repeat(np.arange(len(receivers)), np.diff(record.first))
    # The control variate: the blocked coefficients that the hits themselves sample leave the plain sum.
    basis = evaluate(3, record.directions[record.direction]) * record.solid_angle[:, None]
    sampled = np.zeros((len(receivers), 9))
    np.add.at(sampled, owner, basis)
    rows = np.arange(len(receivers))[::2]
    light = IndirectLight(record, source, rows, sampled[rows].astype(np.float32))
    transfer = np.concatenate([light.transfer(part)[0] for part in light.blocks()])
    expected = np.zeros((len(receivers), 9, 12))
    np.add.at(expected, owner, basis[:, :, None] * source.along(np.arange(len(owner)))[:, None, :])
    np.testing.assert_allclose(transfer, expected[rows], atol=2e-4)


def test_coloured_indirect_light_keeps_its_channels():
    tracer, room, gathered, seen = room_parts()
    radiance = np.random.default_rng(7).random((len(gathered.receivers), 4, 3)).astype(np.float32)
    surfaces = surfaces_of(gathered.receivers, stretched_brdf)

    def result(values, material):
        source = DiffuseRadiance(gathered.hits, room, gathered.receivers, values)
        light = IndirectLight(gathered.hits, source, seen.rows, seen.blocked)
        return drain(glossy_transfer(tracer, material, 2, seen.visible, light))

    together = result(radiance, surfaces)
    assert together.shape[3] == 3
    for channel in range(3):
        alone = result(np.ascontiguousarray(radiance[:, :, channel:channel + 1]), surfaces)
        np.testing.assert_allclose(together[..., channel], alone[..., 0], atol=1e-4 * np.abs(alone).max())
    colours = np.array([1.0, 0.5, 0.0])
    coloured = replace(surfaces, kernels=(surfaces.kernels[0] * colours,))
    np.testing.assert_allclose(result(radiance, coloured), together * colours, atol=1e-4 * np.abs(together).max())


def test_a_glossy_floor_is_seen_from_above_as_its_matrices_say():
    # A small ceiling looks down on a wide floor whose exit radiance is linear and quadratic in the view direction.
    floor = plane("floor", size=2000.0, cells=4, target=False)
    scene = SceneMesh.assemble([plane("ceiling", size=1e-3, height=1.0, up=False), floor])
    tracer = Tracer(scene.points, scene.triangles, 1)
    wanted = np.ones(2 * len(scene.points), bool)
    gathered = drain(gather_operator(tracer, scene, np.arange(4), *quadrature(2048, 5), wanted=wanted))
    receivers = gathered.receivers
    seen = traced(scene, 2, 5, 2048, blocked=5, receivers=receivers)[3]
    below = np.flatnonzero(receivers.key >= 4)
    frames = surface_frames(receivers.normals, np.tile([1.0, 0.5, 0.0], (len(receivers), 1)))
    coefficients = np.random.default_rng(3).normal(size=(9, 4))
    matrices = np.tile(coefficients.astype(np.float32)[None, :, :, None], (len(below), 1, 1, 1))
    source = GlossyRadiance(gathered.hits, scene, receivers.key[below], frames[below], matrices, np.arange(9))
    here = np.flatnonzero(receivers.key < 4)
    transfer, _ = IndirectLight(gathered.hits, source, here, seen.blocked[here]).transfer(slice(0, 4))
    directions, weights = hemisphere_rule()
    down = directions * (1, 1, -1)
    local = -down @ frames[below[0]].T
    expected = (evaluate(5, down) * weights[:, None]).T @ (evaluate(3, local) @ coefficients)
    assert np.abs(transfer - expected).max() < 1e-2 * np.abs(expected).max()
