# SPDX-License-Identifier: GPL-3.0-or-later
"""Responses to lights of a cloud, against closed forms, brute force and the conservation of energy."""

from __future__ import annotations

import numpy as np
import pytest

from prt_addon.basis.directions import quadrature, tangent_frames
from prt_addon.basis.spherical_harmonics import evaluate
from prt_addon.scene.scene_mesh import SceneMesh
from prt_addon.tracing.tracer import Tracer
from prt_addon.transport.gather import gather_operator
from prt_addon.transport.local_lights import LightSolver, unit_light_direct
from prt_addon.transport.near_light import NearTriangles, linear_flux
from prt_addon.transport.receiver_set import ReceiverSet
from tests.core.shapes import box, drain, plane, sphere


def speck(centre, size=1e-3):
    """What makes a hull wound inwards a room: something in it."""
    return box(f"speck {centre}", np.asarray(centre) - size, np.asarray(centre) + size)


class Room:
    """A scene with its operator; responses by point."""

    def __init__(self, scene, albedo=0.5, directions=512, threads=1):
        self.scene, self.tracer = scene, Tracer(scene.points, scene.triangles, threads)
        keys = np.flatnonzero(~scene.loose)
        self.gathered = drain(gather_operator(self.tracer, scene, keys, *quadrature(directions, 4)))
        self.receivers = self.gathered.receivers
        self.albedo = np.broadcast_to(np.float32(albedo), (len(self.receivers), np.size(albedo))).copy()

    def solve(self, positions, tolerance=1e-5, bounces=-1, order=1, radius=0.0):
        blocks = []
        solver = LightSolver(self.tracer, self.scene, self.gathered, self.albedo, tolerance, bounces, order, radius)
        drain(solver.solve(np.atleast_2d(np.asarray(positions, float)), lambda _, values: blocks.append(values)))
        return np.concatenate(blocks, axis=1)

    def source(self, position, order=1, radius=0.0):
        """The field that bounces, with conserved flux."""
        position = np.atleast_2d(np.asarray(position, float))
        field = drain(unit_light_direct(self.tracer, self.receivers, position, order))
        near = NearTriangles(self.tracer, self.scene, self.receivers)
        near.replace(field, near.near(position)[0], position, order)
        return field

    @property
    def area(self):
        corners = self.scene.points[self.scene.triangles]
        face = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        share = np.repeat(np.linalg.norm(face, axis=1) / 6.0, 3)
        return np.bincount(self.scene.triangles.ravel(), share, len(self.scene.points))[self.receivers.key
                                                                                         % len(self.scene.points)]


@pytest.fixture(scope="module")
def room():
    """A closed room of 2 m with a block in it."""
    return Room(SceneMesh.assemble([box("room", (-1, -1, -1), (1, 1, 1), inward=True),
                                    box("block", (-0.6, -0.6, -0.9), (0.0, 0.0, -0.3))], 0.06), directions=2048)


def test_linear_flux_against_sums_over_points_of_the_triangle():
    triangles = np.random.default_rng(1).normal(size=(6, 3, 3))
    u = (np.arange(800) + 0.5) / 800
    second, third = (values.ravel() for values in np.meshgrid(u, u))
    inside = second + third < 1
    weights = np.stack([1 - second - third, second, third], axis=1)[inside]
    for triangle, flux in zip(triangles, linear_flux(triangles), strict=True):
        places = weights @ triangle
        normal = np.cross(triangle[1] - triangle[0], triangle[2] - triangle[0])
        element = np.abs(places @ normal) / np.linalg.norm(places, axis=1) ** 3 / 800**2
        assert np.abs(flux - element @ weights).max() < 5e-3 * flux.sum()


@pytest.mark.parametrize("height", [1e-12, 1e-6, 1e-2, 1.0, 1e4])
def test_flux_of_a_light_over_a_large_triangle_is_half_of_what_it_sends(height):
    far = 1e3 * max(1.0, height)
    triangle = np.array([[[far, 0, -height], [-far / 2, far, -height], [-far / 2, -far, -height]]])
    assert linear_flux(triangle).sum() == pytest.approx(2 * np.pi, rel=1e-2)
    assert np.ptp(linear_flux(triangle)) < 0.02


def test_point_light_over_a_plane():
    scene = SceneMesh.assemble([plane(size=4.0, cells=16)])
    tracer = Tracer(scene.points, scene.triangles, 1)
    receivers = ReceiverSet.of_keys(scene, tracer, np.arange(len(scene.points)))
    position = np.array([[0.3, -0.2, 1.5], [0.0, 0.0, -1.0]])
    found = drain(unit_light_direct(tracer, receivers, position))
    offset = position[0] - scene.points[receivers.key]
    square = np.sum(offset**2, axis=1)
    exact = 1.5 / square**1.5 / np.pi
    assert np.abs(found[:, 0] / exact - 1.0).max() < 0.01  # receivers are pulled 1 % of an edge into their faces
    assert not found[:, 1].any()
    directed = drain(unit_light_direct(tracer, receivers, position[:1], emission_order=3))
    functions = np.sqrt(4 * np.pi) * evaluate(3, -offset / np.sqrt(square)[:, None])
    assert np.abs(directed - exact[:, None] * functions).max() < 0.01 * np.abs(exact[:, None] * functions).max()


@pytest.mark.parametrize("albedo", [(0.5,), (0.9, 0.5, 0.0)])
def test_light_in_the_middle_of_a_closed_sphere(albedo):
    ball = Room(SceneMesh.assemble([sphere(radius=2.0, inward=True, subdivisions=4), speck((1.9, 0, 0))]), albedo)
    wall = ball.receivers.key < ball.scene.objects[0].points.stop
    found = ball.solve([[0.0, 0.0, 0.0]])[wall, 0]
    rho = np.array(albedo)
    expected = rho / (1 - rho) / (np.pi * 4.0)
    assert np.abs(found - expected).max() <= 0.01 * expected.max()


@pytest.mark.parametrize("position", [(0.3, 0.2, 0.1), (0.4, 0.5, -0.999), (0.313, 0.271, -1.0 + 1e-6),
                                      (-0.3, -0.3, -0.29), (0.99, 0.99, 0.99)])
def test_the_source_carries_what_the_light_sends(room, position):
    # In a closed room all 4 pi W arrive, however near the light is to a surface.
    field = room.source(position)[:, 0]
    assert float(np.sum(room.area * field) * np.pi) == pytest.approx(4 * np.pi, rel=0.03)


def test_all_that_is_sent_is_absorbed(room):
    positions = [(0.3, 0.2, 0.1), (0.4, 0.5, -0.99), (0.9, -0.9, 0.5)]
    indirect = room.solve(positions)[:, :, 0]
    for light, position in enumerate(positions):
        total = indirect[:, light] + room.source(position)[:, 0]
        absorbed = float(np.sum(room.area * total) * np.pi * 0.5)
        assert absorbed == pytest.approx(4 * np.pi, rel=0.04)


def test_stiff_room_keeps_its_energy():
    # Nearly white and closed: 200 bounces on average, so an operator that is 1e-4 off is 2 % off here.
    white = Room(SceneMesh.assemble([box("room", (-1, -1, -1), (1, 1, 1), inward=True), speck((0.9, 0.9, 0.9))], 0.1),
                 0.995)
    position = (0.1, -0.2, 0.3)
    total = white.solve(position, 1e-5)[:, 0, 0] + white.source(position)[:, 0]
    assert float(np.sum(white.area * total) * np.pi * 0.005) == pytest.approx(4 * np.pi, rel=0.05)


def first_bounce(room, place, normal, light, count, seed):
    """Brute force: one bounce by cosine-distributed rays, the light sampled at each hit."""
    rng = np.random.default_rng(seed)
    numbers = rng.random((count, 2))
    radius, turn = np.sqrt(numbers[:, 0]), 2 * np.pi * numbers[:, 1]
    local = np.stack([radius * np.cos(turn), radius * np.sin(turn), np.sqrt(1 - numbers[:, 0])], axis=1)
    towards = (local @ tangent_frames(normal[None])[0]).astype(np.float32)
    tracer, scene = room.tracer, room.scene
    origin = tracer.to_tracing_space((place + 1e-5 * normal)[None])
    hits = tracer.nearest(np.repeat(origin, count, axis=0), towards)
    corner = scene.points[scene.triangles[hits.triangle]]
    weights = np.stack([1.0 - hits.u - hits.v, hits.u, hits.v], axis=1)[:, :, None]
    face = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    face *= np.where(hits.front, 1.0, -1.0)[:, None] / np.linalg.norm(face, axis=1, keepdims=True)
    at = np.sum(weights * corner, axis=1) + 1e-5 * face
    to_light = light - at
    square = np.sum(to_light**2, axis=1)
    cosine = np.maximum(np.sum(to_light * face, axis=1), 0.0) / np.sqrt(square)
    start = tracer.to_tracing_space(at)
    hidden = tracer.occluded(start, tracer.to_tracing_space(light[None]) - start, np.ones(count, np.float32))
    return float(np.mean(np.where(hidden, 0.0, 0.5 * cosine / square / np.pi)))


def test_first_bounce_against_brute_force(room):
    rng = np.random.default_rng(3)
    count = len(room.scene.points)
    clear = (np.abs(room.scene.points) < 0.95).sum(axis=1) >= 2
    front = np.flatnonzero((room.receivers.key < count) & clear[room.receivers.key % count])
    chosen = rng.choice(front, 24, replace=False)
    lights = np.array([(0.3, 0.2, 0.1), (0.45, 0.52, -0.97)])
    found = room.solve(lights, bounces=1)[chosen, :, 0]
    points = room.scene.points[room.receivers.key[chosen]]
    places = np.array([room.tracer.diagonal * o + room.tracer._centre for o in room.receivers.origins[chosen]])
    assert np.abs(places - points).max() < 0.05
    expected = np.array([[first_bounce(room, place, normal, light, 60_000, 5) for light in lights]
                         for place, normal in zip(places, room.receivers.normals[chosen], strict=True)])
    error = np.sqrt(np.mean((found - expected) ** 2, axis=0) / np.mean(expected**2, axis=0))
    print(error, found.mean(axis=0) / expected.mean(axis=0))
    assert error[0] < 0.03
    # The light 3 cm over a floor of 25 cm cells: the operator's rays find its spot, smeared over the cells around it.
    assert error[1] < 0.15
    assert np.abs(found.mean(axis=0) / expected.mean(axis=0) - 1.0).max() < 0.05


def test_sealed_rooms_keep_their_light():
    two = SceneMesh.assemble([box("a", (0, 0, 0), (1, 1, 1), inward=True), speck((0.1, 0.1, 0.1)),
                              box("b", (2, 0, 0), (3, 1, 1), inward=True), speck((2.1, 0.1, 0.1))], 0.1)
    rooms = Room(two, 0.8)
    found = rooms.solve([[0.5, 0.5, 0.5]], tolerance=1e-4)[:, 0, 0]
    other = two.points[rooms.receivers.key % len(two.points), 0] > 1.5
    assert not found[other].any()
    wall = rooms.receivers.key < two.objects[0].points.stop
    assert found[wall].min() > 0.0


def test_colours_bounces_and_threads(room):
    colour = np.float32([0.7, 0.4, 0.0])
    grey = [Room(room.scene, float(c), 64).solve([[0.3, 0.2, 0.1]])[:, 0, 0] for c in colour]
    all_three = Room(room.scene, colour, 64, threads=3).solve([[0.3, 0.2, 0.1]])[:, 0]
    assert np.array_equal(all_three, np.stack(grey, axis=1)) and not all_three[:, 2].any()
    few = Room(room.scene, 0.7, 64)
    assert not few.solve([[0.3, 0.2, 0.1]], bounces=0).any()
    sums = [few.solve([[0.3, 0.2, 0.1]], bounces=n).sum() for n in (1, 2, 3)]
    assert 0 < sums[0] < sums[1] < sums[2] < grey[0].sum() * 1.001


def test_lights_do_not_depend_on_their_company(room):
    positions = np.random.default_rng(4).uniform(0.1, 0.9, (70, 3))  # two blocks of columns
    together, alone = room.solve(positions, bounces=2)[:, 40:41], room.solve(positions[40:41], bounces=2)
    # The leading fields of many lights stand for each of them only up to the solver's tolerance.
    assert np.sqrt(np.sum((together - alone) ** 2) / np.sum(alone ** 2)) < 1e-3


def test_directed_and_wide_lights(room):
    point = room.solve([[0.3, 0.2, 0.1]])
    directed = room.solve([[0.3, 0.2, 0.1]], order=2)
    assert np.abs(directed[:, 0] - point[:, 0]).max() < 1e-4 * point.max()
    # Nothing is lost of a function that is negative on one side: a linear emission adds up to the isotropic one.
    field = room.source([0.3, 0.2, -0.9], order=2)
    down = field[:, 0] - field[:, 2] / np.sqrt(3.0)  # 1 - cos: twice as much down as in the mean
    assert down.min() > -1e-6 and float(np.sum(room.area * down) * np.pi) == pytest.approx(4 * np.pi, rel=0.03)
    wide = room.solve([[0.3, 0.2, 0.1]], radius=0.02)
    assert np.sqrt(np.mean((wide - point) ** 2) / np.mean(point**2)) < 0.03


@pytest.mark.parametrize("position", ["vertex", (1.0, 0.3, 0.2), (1e6, 0, 0), (-0.3, -0.3, -0.6), (0.0, 0.0, -0.3)])
def test_extreme_places_stay_finite_and_bounded(room, position):
    place = room.scene.points[room.scene.objects[0].points.start + 5] if position == "vertex" else np.array(position)
    found = room.solve(place[None])
    assert np.isfinite(found).all() and found.min() >= 0.0
    # No more than a light in the room could give: 4 pi W absorbed, the part of the bounces half of it.
    assert float(np.sum(room.area * found[:, 0, 0]) * np.pi * 0.5) < 2 * np.pi * 1.1
    if position in ((1e6, 0, 0), (-0.3, -0.3, -0.6)):  # outside the room, inside the block
        assert found.max() == 0.0


def test_no_lights_and_no_surfaces_to_see():
    scene = SceneMesh.assemble([plane(cells=2)])
    lone = Room(scene)
    assert not lone.solve([[0.0, 0.0, 1.0]]).any()
    solver = LightSolver(lone.tracer, scene, lone.gathered, lone.albedo, 1e-3, -1)
    drain(solver.solve(np.zeros((0, 3)), lambda *_: pytest.fail("there is no light")))

