# SPDX-License-Identifier: GPL-3.0-or-later
"""Matrix radiosity against closed forms (form factors, furnace, integrating sphere) and a dense solution."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import sparse

from prt_addon.basis.directions import quadrature
from prt_addon.errors import BadScene
from prt_addon.scene.scene_mesh import SceneMesh
from prt_addon.tracing.tracer import Tracer
from prt_addon.transport.form_factors import (
    check_exits,
    form_factor,
    radius_bound,
    receiver_areas,
    row_sums,
    spectral_radius,
)
from prt_addon.transport.gather import gather_operator
from prt_addon.transport.radiosity import (
    BICGSTAB,
    CONJUGATE_GRADIENTS,
    GAUSS_SEIDEL,
    JACOBI,
    METHODS,
    choose_solver,
    predicted_iterations,
    solve_radiosity,
)
from tests.core.shapes import box, drain, make, plane

PLAIN = (JACOBI, GAUSS_SEIDEL, BICGSTAB)


def traced(meshes, directions, spacing=0.0):
    """The scene, the operator and the receivers' points."""
    scene = SceneMesh.assemble(meshes, spacing)
    tracer = Tracer(scene.points, scene.triangles, 1)
    gathered = drain(gather_operator(tracer, scene, np.flatnonzero(~scene.loose), *quadrature(directions, 4)))
    return scene, gathered


@pytest.fixture(scope="module")
def room():
    """A closed room with a block in it: some 600 receivers, double precision."""
    _, gathered = traced([box("room", inward=True), box("block", (0.3, 0.3, 0.1), (0.5, 0.6, 0.5))], 512, 0.12)
    return gathered.matrix.astype(np.float64)


@pytest.fixture(scope="module")
def small_room():
    _, gathered = traced([box("room", inward=True), box("block", (0.3, 0.3, 0.1), (0.5, 0.6, 0.5))], 256, 0.3)
    return gathered.matrix.astype(np.float64)


def standing(cells):
    """A unit square in the plane x = 0 over the edge of the one below it."""
    flat = plane(cells=cells, centre=(0.5, 0.5))
    turned = flat.positions[:, [2, 1, 0]]
    return make("wall", turned, flat.triangles[:, ::-1])


@pytest.mark.parametrize(("above", "exact", "tolerance"), [("parallel", 0.199825, 0.004),
                                                           ("perpendicular", 0.200044, 0.01)])
def test_form_factors_of_unit_squares(above, exact, tolerance):
    cells = 12
    floor = plane("floor", cells=cells, centre=(0.5, 0.5))
    other = plane("ceiling", height=1.0, cells=cells, centre=(0.5, 0.5), up=False) if above == "parallel" else \
        standing(cells)
    scene, gathered = traced([floor, other], 4096)
    point = gathered.receivers.key % len(scene.points)
    on_floor = point < scene.objects[0].points.stop
    front = gathered.receivers.key < len(scene.points)
    areas = receiver_areas(scene)[point] * front
    for start in (on_floor, ~on_floor):
        found = form_factor(gathered.matrix, areas, start & front, ~start)
        assert found == pytest.approx(exact, rel=tolerance)


def test_rows_of_a_closed_room_sum_to_one(room):
    assert np.abs(row_sums(room) - 1.0).max() < 1e-5


@pytest.mark.parametrize("albedo", [0.5, 0.8, 0.95, 0.999])
@pytest.mark.parametrize("method", PLAIN)
def test_furnace(small_room, albedo, method):
    room = small_room
    ones = np.ones((room.shape[0], 3))
    found = solve_radiosity(room, albedo * ones, ones, method, 1e-6, most=40000)
    assert found.residual <= 1e-6
    assert np.abs(found.radiosity * (1.0 - albedo) - 1.0).max() < 2e-3  # rows sum to 1 in single precision only


def test_every_method_finds_the_dense_solution_and_gauss_seidel_takes_half_of_jacobis_iterations(room):
    generator = np.random.default_rng(1)
    albedo = generator.uniform(0.2, 0.95, (room.shape[0], 3))
    emittance = generator.uniform(0.0, 1.0, albedo.shape)
    found = {method: solve_radiosity(room, albedo, emittance, method, 1e-9) for method in PLAIN}
    for channel in range(3):
        system = np.eye(room.shape[0]) - albedo[:, channel, None] * room.toarray()
        exact = np.linalg.solve(system, emittance[:, channel])
        for solution in found.values():
            assert np.abs(solution.radiosity[:, channel] / exact - 1.0).max() < 1e-6
    assert 0.35 < found[GAUSS_SEIDEL].iterations / found[JACOBI].iterations < 0.75  # the paper: about half
    for solution in found.values():
        assert len(solution.history) == len(solution.seconds) == solution.iterations
        assert solution.history[-1] <= 1e-9 < solution.history[0]


@pytest.mark.parametrize("method", METHODS)
def test_integrating_sphere_with_patches_of_very_different_size(method):
    """F_ij = A_j / A inside a sphere, whatever the patches: B = E + rho H with H = <E> / (1 - <rho>), means by area."""
    generator = np.random.default_rng(2)
    areas = 10.0 ** generator.uniform(-6.0, 0.0, 300)
    albedo = generator.uniform(0.9, 0.9999, (300, 3))
    albedo[:5], albedo[5:10] = 0.0, 1.0
    emittance = generator.uniform(0.0, 1.0, (300, 3)) * (generator.uniform(size=(300, 1)) < 0.1)
    matrix = sparse.csr_matrix(np.tile(areas / areas.sum(), (300, 1)))
    share = areas[:, None] / areas.sum()
    light = np.sum(share * emittance, axis=0) / (1.0 - np.sum(share * albedo, axis=0))
    found = solve_radiosity(matrix, albedo, emittance, method, 1e-10, areas)
    assert found.residual <= 1e-10
    assert np.allclose(found.radiosity, emittance + albedo * light, rtol=1e-6)


def test_conjugate_gradients_in_a_room_of_reciprocal_form_factors(room):
    """The room's factors made reciprocal: A_i F_ij = A_j F_ji, areas over six orders."""
    generator = np.random.default_rng(3)
    areas = 10.0 ** generator.uniform(-6.0, 0.0, room.shape[0])
    exchange = sparse.diags(np.sqrt(areas)) @ (0.5 * (room + room.T)) @ sparse.diags(np.sqrt(areas))
    matrix = (sparse.diags(0.5 / areas) @ exchange).tocsr()
    albedo = np.minimum(0.9 / np.maximum(row_sums(matrix), 1e-12), 0.9)[:, None].repeat(3, axis=1)
    emittance = generator.uniform(0.0, 1.0, albedo.shape)
    found = [solve_radiosity(matrix, albedo, emittance, method, 1e-9, areas) for method in (BICGSTAB,
                                                                                            CONJUGATE_GRADIENTS)]
    assert np.allclose(found[0].radiosity, found[1].radiosity, rtol=1e-5, atol=1e-7)


@pytest.mark.parametrize("method", PLAIN)
def test_disconnected_rooms_do_not_light_each_other(room, method):
    both = sparse.block_diag([room, room], format="csr")
    size = room.shape[0]
    albedo, emittance = np.full((2 * size, 3), 0.9), np.zeros((2 * size, 3))
    albedo[size:] = 0.3
    emittance[:size] = 1.0
    found = solve_radiosity(both, albedo, emittance, method, 1e-7).radiosity
    assert np.abs(found[:size] / 10.0 - 1.0).max() < 1e-3
    assert not found[size:].any()


def test_what_reflects_everything_needs_a_way_out(room):
    size = room.shape[0]
    albedo = np.ones((size, 3))
    with pytest.raises(BadScene, match="receivers reflect all light"):
        solve_radiosity(room, albedo, np.ones((size, 3)))
    rooms = sparse.block_diag([room, room], format="csr")
    with pytest.raises(BadScene):  # the exit of one is none for the other
        check_exits(rooms, np.concatenate([albedo, 0.5 * albedo]))
    albedo[7] = 0.0  # a black patch is an exit
    found = solve_radiosity(room, albedo, np.ones((size, 3)), BICGSTAB, 1e-8)
    exact = np.linalg.solve(np.eye(size) - albedo[:, :1] * room.toarray(), np.ones(size))
    assert np.allclose(found.radiosity[:, 0], exact, rtol=1e-3)


@pytest.mark.parametrize("albedo", [0.3, 0.5, 0.9])
def test_the_spectral_radius_and_the_predictions_made_from_it(room, albedo):
    generator = np.random.default_rng(4)
    grey = np.full((room.shape[0], 3), albedo)
    assert spectral_radius(room, grey) == pytest.approx(albedo, rel=1e-4)
    assert radius_bound(room, grey) == pytest.approx(albedo, rel=1e-4)
    emittance = generator.uniform(0.0, 1.0, grey.shape)
    for method in PLAIN:
        found = solve_radiosity(room, grey, emittance, method, 1e-6).iterations
        assert 0.4 < found / predicted_iterations(method, albedo, 1e-6) < 2.5, method


def test_the_choice_goes_from_jacobi_to_krylov_as_rooms_grow_brighter(room):
    ones = np.ones((room.shape[0], 3))
    assert choose_solver(0.3, 1e-3) == JACOBI
    assert choose_solver(0.995, 1e-6) == BICGSTAB
    assert solve_radiosity(room, 0.3 * ones, ones).method == JACOBI
    assert solve_radiosity(room, 0.99 * ones, ones, tolerance=1e-6).method == BICGSTAB
    # Measured costs decide: a machine whose GPU makes products for nothing never leaves Jacobi.
    assert choose_solver(0.99, 1e-6, {JACOBI: 1e-3, BICGSTAB: 4.0}) == JACOBI


def test_a_near_start_saves_iterations_and_no_light_needs_none(room):
    albedo, emittance = np.full((room.shape[0], 3), 0.8), np.random.default_rng(5).uniform(size=(room.shape[0], 3))
    cold = solve_radiosity(room, albedo, emittance, JACOBI, 1e-6)
    warm = solve_radiosity(room, albedo, 1.001 * emittance, JACOBI, 1e-6, start=cold.radiosity)
    assert warm.iterations < 0.7 * cold.iterations
    assert not solve_radiosity(room, albedo, np.zeros_like(emittance)).radiosity.any()


@pytest.mark.parametrize("kind", [np.float32, np.float64])
@pytest.mark.parametrize("method", PLAIN)
def test_a_light_that_goes_out_in_some_channels_ends_in_few_iterations(room, method, kind):
    """From the solution of a bright coloured glow to a dim edit without blue, and with blue that is rounding alone."""
    matrix, size = room.astype(kind), room.shape[0]
    generator = np.random.default_rng(6)
    albedo = generator.uniform(0.3, 0.7, (size, 3)).astype(kind)
    glow = np.zeros((size, 3), kind)
    glow[:9] = 6.0, 4.0, 2.0
    bright = solve_radiosity(matrix, albedo, glow, method, 3e-3).radiosity
    for blue in (0.0, 1e-9, 1e-30):
        dim = np.zeros((size, 3), kind)
        dim[:40] = -0.01, 0.02, blue
        found = solve_radiosity(matrix, albedo, dim, method, 3e-3, start=bright)
        exact = solve_radiosity(room, albedo.astype(float), dim.astype(float), BICGSTAB, 1e-10).radiosity
        assert found.iterations < 60 and found.residual <= 3e-3
        assert np.abs(found.radiosity - exact).max() < 0.01 * np.abs(exact).max()
