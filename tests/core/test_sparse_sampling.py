# SPDX-License-Identifier: GPL-3.0-or-later
"""Sparse sampling against matrices known in closed form (a sphere over a plane) and against the fully traced one."""

from __future__ import annotations

import numpy as np
import pytest

from prt_addon.basis.cubemap import cubemap_directions, cubemap_solid_angles, texel_of
from prt_addon.errors import BadArguments
from prt_addon.scene.scene_mesh import SceneMesh
from prt_addon.tracing.tracer import Tracer
from prt_addon.transport import angular_sampling
from prt_addon.transport.angular_sampling import dense_rows, quarter_grid, window_range
from prt_addon.transport.cubemap_transfer import cubemap_transfer
from prt_addon.transport.elements import MatrixElements, VisibilityElements
from prt_addon.transport.receiver_set import ReceiverSet
from prt_addon.transport.sparse_sampling import SparseSettings, sparse_transfer
from tests.core.shapes import drain, plane, sphere


class Once(MatrixElements):
    """Counts how often each element is asked for."""

    def evaluate(self, receivers, columns):
        self.seen = getattr(self, "seen", np.zeros(self.matrix.shape, int))
        np.add.at(self.seen, (receivers, columns), 1)
        return super().evaluate(receivers, columns)


def ground(side):
    line = np.linspace(-2, 2, side)
    x, y = np.meshgrid(line, line, indexing="ij")
    positions = np.stack([x.ravel(), y.ravel(), np.zeros(side * side)], axis=1)
    return positions, np.tile([0.0, 0.0, 1.0], (side * side, 1))


def seen_past_sphere(positions, r, centre=(0, 0, 0.6), radius=0.5):
    """Visibility (n, columns) of a plane's points under a sphere, in closed form."""
    directions = cubemap_directions(r)
    towards = np.asarray(centre) - positions
    along = towards @ directions.T
    apart = np.sum(towards**2, axis=1)[:, None] - along**2
    free = ~((along > 0) & (apart < radius**2)) & (directions[:, 2] > 0)
    return free.astype(np.float32)


def relative(found, truth):
    return np.linalg.norm(found - truth) / np.linalg.norm(truth)


def test_windows_against_loops():
    r, generator = 6, np.random.default_rng(0)
    coarse = generator.integers(0, 4, (2, 54)).astype(np.float32)
    computed = generator.random((2, 54)) < 0.8
    low, high = window_range(coarse, computed, r)
    whole = np.full((2, 6, r, r), np.nan)
    whole.reshape(2, -1)[:, quarter_grid(r)] = np.where(computed, coarse, np.nan)
    face = 3
    for row in (2, 3):  # windows that stay on their face, but for the border
        for column in (2, 3):
            inside = whole[:, face, max(row - 3, 0):row + 4, max(column - 3, 0):column + 4].reshape(2, -1)
            place = (face * r + row) * r + column
            assert (low[:, place] <= np.nanmin(inside, axis=1)).all()
            assert (high[:, place] >= np.nanmax(inside, axis=1)).all()
            if row == column == 2:
                np.testing.assert_array_equal(low[:, place], np.nanmin(inside, axis=1))
                np.testing.assert_array_equal(high[:, place], np.nanmax(inside, axis=1))


def test_windows_reach_over_edges():
    """One odd sample beside an edge makes texels across it features too."""
    r = 8
    coarse, computed = np.zeros((1, 96), np.float32), np.ones((1, 96), bool)
    across = texel_of(np.array([[1.0, -0.99, 0.1]]), r)[0]
    near = np.abs(cubemap_directions(r)[quarter_grid(r)] @ cubemap_directions(r)[across]).argmax()
    coarse[0, near] = 1.0
    low, high = window_range(coarse, computed, r)
    faces = np.unique(np.flatnonzero((low != high)[0]) // (r * r))
    assert len(faces) >= 2


@pytest.mark.parametrize("r", [1, 2, 3, 5, 16])
def test_constant_rows_need_a_quarter_of_the_elements(r):
    elements = Once(np.full((3, 6 * r * r), 0.7, np.float32))
    rows = dense_rows(elements, np.array([2, 0]))
    np.testing.assert_array_equal(rows.values, np.float32(0.7))
    assert not rows.features.any()
    assert elements.asked == 2 * 6 * ((r + 1) // 2) ** 2


def test_dense_rows_of_visibility_are_right_where_features_are():
    positions, _ = ground(9)
    truth = seen_past_sphere(positions, 16)
    elements = Once(truth)
    rows = dense_rows(elements, np.arange(81))
    assert elements.seen.max() == 1
    assert elements.asked < 0.62 * truth.size
    np.testing.assert_array_equal(rows.values[elements.seen > 0], truth[elements.seen > 0])
    assert np.mean(rows.values != truth) < 2e-3


def test_smooth_rows_are_interpolated_from_a_quarter():
    directions = cubemap_directions(16)
    truth = (1.5 + directions @ np.array([[0.3, 0.5, 0.2], [-1, 0.1, 0]]).T).T.astype(np.float32)
    elements = MatrixElements(truth, angular=False)
    rows = dense_rows(elements, np.arange(2))
    assert elements.asked == truth.size // 4
    assert relative(rows.values, truth) < 0.02
    np.testing.assert_array_equal(np.flatnonzero(rows.features[0]), np.sort(quarter_grid(16)))


SETTINGS = SparseSettings(radius=0.07)


def test_plane_under_a_sphere():
    """Few elements, a small error, none asked for twice, and L1 better than the baselines (Figure 6)."""
    positions, normals = ground(48)
    truth = seen_past_sphere(positions, 16)
    weights = np.maximum(cubemap_directions(16)[:, 2], 0) * cubemap_solid_angles(16)
    errors = {}
    for method in ("l1", "least_squares", "radius"):
        elements = Once(truth)
        found = drain(sparse_transfer(elements, positions, normals, SparseSettings(radius=0.07, method=method)))
        assert elements.seen.max() == 1
        errors[method] = relative(found.transfer.T * weights, truth * weights)
        if method == "l1":
            assert found.sampled < 0.155  # the plane's own horizon is a feature here
            assert found.dense_elements + found.sparse_elements == elements.asked
            light = np.stack([weights, weights * (cubemap_directions(16)[:, 0] > 0.5)])
            assert relative(found.transfer.T @ light.T, truth @ light.T) < 0.01
            np.testing.assert_array_equal(found.transfer.T[elements.seen > 0], truth[elements.seen > 0])
    assert errors["l1"] < 0.06
    assert errors["l1"] < 0.9 * errors["least_squares"]
    assert errors["l1"] < 0.8 * errors["radius"]


def test_dense_vertices_go_where_the_rank_is_high():
    positions, normals = ground(40)
    found = drain(sparse_transfer(MatrixElements(seen_past_sphere(positions, 8)), positions, normals, SETTINGS))
    away = np.linalg.norm(positions[:, :2], axis=1)
    assert found.rank[away < 0.7].mean() > 1.5 * found.rank[away > 1.7].mean()
    assert found.dense[away < 0.7].mean() > 1.2 * found.dense[away > 1.7].mean()
    assert abs(found.dense.mean() - 0.25) < 0.02


def test_the_same_seed_gives_the_same_and_the_limit_holds():
    positions, normals = ground(30)
    truth = seen_past_sphere(positions, 8)
    first, again = (drain(sparse_transfer(MatrixElements(truth), positions, normals, SETTINGS)) for _ in range(2))
    np.testing.assert_array_equal(first.transfer, again.transfer)
    other = drain(sparse_transfer(MatrixElements(truth), positions, normals, SparseSettings(radius=0.07, seed=1)))
    assert (other.dense != first.dense).any()
    less = drain(sparse_transfer(MatrixElements(truth), positions, normals, SparseSettings(radius=0.07, most=0.1)))
    assert less.sampled < 0.11 < first.sampled


def test_all_dense_is_the_two_pass_sampling_alone():
    positions, normals = ground(10)
    truth = seen_past_sphere(positions, 8)
    found = drain(sparse_transfer(MatrixElements(truth), positions, normals, SparseSettings(dense=1.0)))
    assert found.dense.all() and found.sparse_elements == 0
    np.testing.assert_array_equal(found.transfer.T, dense_rows(MatrixElements(truth), np.arange(100)).values)


def test_extreme_scenes():
    """Far apart parts, lone vertices, duplicates, one vertex, two texels along an edge."""
    positions, normals = ground(12)
    truth = seen_past_sphere(positions, 2)
    found = drain(sparse_transfer(MatrixElements(truth), positions, normals, SETTINGS))
    assert np.isfinite(found.transfer).all()

    positions = np.concatenate([positions * 0.01, [[50.0, 0, 0]], positions * 0.01 + [0, 90.0, 0]])
    normals = np.tile([0.0, 0.0, 1.0], (len(positions), 1))
    truth = np.random.default_rng(0).random((len(positions), 6 * 16)).astype(np.float32)
    found = drain(sparse_transfer(MatrixElements(truth), positions, normals, SparseSettings(radius=1e-7)))
    assert np.isfinite(found.transfer).all()
    grid = quarter_grid(4)
    np.testing.assert_array_equal(found.transfer.T[found.dense][:, grid], truth[found.dense][:, grid])
    assert found.dense[144]  # the lone vertex is sampled itself

    same, up = np.zeros((200, 3)), np.tile([0.0, 0.0, 1.0], (200, 1))
    rows = np.tile(np.random.default_rng(1).random((1, 96)).astype(np.float32), (200, 1))
    found = drain(sparse_transfer(MatrixElements(rows), same, up, SETTINGS))
    np.testing.assert_allclose(found.transfer.T, rows, rtol=1.1e-3)  # the penalty of 0.001 takes that much
    assert drain(sparse_transfer(MatrixElements(rows[:1]), same[:1], up[:1], SETTINGS)).dense.all()
    black = drain(sparse_transfer(MatrixElements(rows * 0), same, up, SETTINGS))
    assert not black.transfer.any()


def test_bad_settings_and_columns_are_refused():
    for bad in ({"dense": 0.0}, {"most": 2.0}, {"features": -1.0}, {"rounds": 0}, {"radius": 0.0}, {"strength": -1.0}):
        with pytest.raises(BadArguments):
            SparseSettings(**bad)
    with pytest.raises(ValueError, match="no cubemap"):
        angular_sampling.edge_of(100)


@pytest.fixture(scope="module")
def traced():
    scene = SceneMesh.assemble([sphere(radius=0.5, centre=(0, 0, 0.6)), plane(size=4.0, cells=47)])
    tracer = Tracer(scene.points, scene.triangles, 1)
    receivers = ReceiverSet.of_keys(scene, tracer, np.flatnonzero(~scene.loose))
    return scene, tracer, receivers


def test_single_rays_give_the_fully_traced_matrix(traced):
    _, tracer, receivers = traced
    truth = drain(cubemap_transfer(tracer, receivers, 6, 1))
    elements = VisibilityElements(tracer, receivers, 6)
    everyone = np.arange(len(receivers))
    column, row = np.nonzero(elements.unknown(everyone).T)
    before = tracer.rays
    values = np.zeros((len(receivers), 216), np.float32)
    values[row, column] = elements.evaluate(row, column)
    assert tracer.rays - before == elements.asked == len(row)
    np.testing.assert_allclose((values * elements.factor(everyone)).T, truth, atol=2e-7)


def test_traced_scene_with_a_model(traced):
    scene, tracer, receivers = traced
    truth = drain(cubemap_transfer(tracer, receivers, 16, 1))
    elements = VisibilityElements(tracer, receivers, 16)
    positions = scene.points[receivers.key % len(scene.points)]
    found = drain(sparse_transfer(elements, positions, receivers.normals, SETTINGS))
    assert found.sampled < 0.12
    assert relative(found.transfer, truth) < 0.06
    assert relative(found.transfer.sum(axis=0), truth.sum(axis=0)) < 0.01
    threads = Tracer(scene.points, scene.triangles, 2)
    again = drain(sparse_transfer(VisibilityElements(threads, receivers, 16), positions, receivers.normals, SETTINGS))
    np.testing.assert_array_equal(again.transfer, found.transfer)
