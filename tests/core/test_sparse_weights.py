# SPDX-License-Identifier: GPL-3.0-or-later
"""Batched L1 weights against an interior-point solver and against bound-constrained scipy, and their extreme cases."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import minimize

from prt_addon.transport import sparse_weights
from prt_addon.transport.sparse_weights import Normal


def visibility_like(count, neighbours, samples, seed=0):
    """Neighbours that hardly differ, as masks of discs that move a little: features (n, k, m), samples (n, m)."""
    generator = np.random.default_rng(seed)
    places = generator.uniform(-1, 1, (samples, 2))
    centres = generator.normal(0, 0.15, (count, neighbours + 1, 1, 2))
    masks = (np.sum((places - centres) ** 2, axis=-1) < 0.5).astype(np.float32)
    return masks[:, 1:], masks[:, 0]


def interior_point(matrix, right, limit, steps=80):
    """Least |A w - b|^2 + limit |w|_1 by a primal barrier method with Newton steps on bounds |w_i| <= u_i."""
    count = matrix.shape[1]
    weights, bounds, sharpness = np.zeros(count), np.ones(count), max(1.0, 1.0 / limit)
    hessian, gap = 2 * matrix.T @ matrix, np.inf

    def value(w, u):
        inside = u**2 - w**2
        if (u <= 0).any() or (inside <= 0).any():
            return np.inf
        return sharpness * (np.sum((matrix @ w - right) ** 2) + limit * u.sum()) - np.log(inside).sum()

    for _ in range(steps):
        residual = matrix @ weights - right
        inside = bounds**2 - weights**2
        g_w = sharpness * 2 * matrix.T @ residual + 2 * weights / inside
        g_u = sharpness * limit - 2 * bounds / inside
        d_1 = np.diag(2 * (bounds**2 + weights**2) / inside**2)
        d_2 = np.diag(-4 * bounds * weights / inside**2)
        step = np.linalg.solve(np.block([[sharpness * hessian + d_1, d_2], [d_2, d_1]]), -np.concatenate([g_w, g_u]))
        size, now, slope = 1.0, value(weights, bounds), np.concatenate([g_w, g_u]) @ step
        while value(weights + size * step[:count], bounds + size * step[count:]) > now + 0.01 * size * slope:
            size *= 0.5
            if size < 1e-12:
                break
        weights, bounds = weights + size * step[:count], bounds + size * step[count:]
        dual = 2 * residual * min(1.0, limit / max(np.abs(2 * matrix.T @ residual).max(), 1e-30))
        primal = residual @ residual + limit * np.abs(weights).sum()
        gap = primal - (-0.25 * dual @ dual - dual @ right)
        if gap < 1e-6 * primal:
            break
        if size > 0.5:
            sharpness = max(min(4 * count / max(gap, 1e-12), 2 * sharpness), sharpness)
    return weights


def objectives(features, samples, weights, limit):
    return np.sum((features.T @ weights - samples) ** 2) + limit * np.abs(weights).sum()


@pytest.mark.parametrize(("neighbours", "strength"), [(10, 1e-3), (24, 1e-3), (24, 1e-2), (40, 1e-3), (40, 0.1),
                                                       (40, 0.3)])
def test_objective_within_a_percent_of_the_interior_point_method(neighbours, strength):
    features, samples = visibility_like(12, neighbours, 350)
    weights = sparse_weights.solve(Normal.of(features, samples), strength)
    for a, b, w in zip(features.astype(float), samples.astype(float), weights, strict=True):
        limit = strength * 2 * np.abs(a @ b).max()
        best = objectives(a, b, interior_point(a.T, b, limit), limit)
        assert objectives(a, b, w, limit) <= 1.01 * best


def test_the_interior_point_method_agrees_with_scipy():
    """The reference itself, against bound-constrained minimisation of the split into positive and negative parts."""
    features, samples = visibility_like(3, 8, 120, seed=5)
    for a, b in zip(features.astype(float), samples.astype(float), strict=True):
        limit = 0.02 * np.abs(a @ b).max()

        def split(v, a=a, b=b, limit=limit):
            residual = a.T @ (v[:8] - v[8:]) - b
            slope = 2 * a @ residual
            return residual @ residual + limit * v.sum(), np.concatenate([slope, -slope]) + limit

        found = minimize(split, np.zeros(16), jac=True, bounds=[(0, None)] * 16, method="L-BFGS-B",
                         options={"maxiter": 5000, "ftol": 1e-15, "gtol": 1e-10})
        mine = objectives(a, b, interior_point(a.T, b, limit), limit)
        assert mine == pytest.approx(found.fun, rel=1e-4)


def test_the_objective_is_what_it_says():
    features, samples = visibility_like(4, 6, 50)
    normal = Normal.of(features, samples)
    weights = np.random.default_rng(1).normal(size=(4, 6))
    told = sparse_weights.objective(normal, np.sum(samples.astype(float) ** 2, axis=1), weights, 0.03)
    for a, b, w, value in zip(features.astype(float), samples.astype(float), weights, told, strict=True):
        assert value == pytest.approx(objectives(a, b, w, 0.03 * 2 * np.abs(a @ b).max()))


def test_l1_is_sparser_and_smaller_than_least_squares():
    """The paper's reason for it: least squares over-fits with large weights of both signs."""
    features, samples = visibility_like(20, 40, 60, seed=2)
    normal = Normal.of(features, samples)
    sparse, plain = sparse_weights.solve(normal, 0.01), sparse_weights.least_squares(normal)
    assert np.abs(sparse).sum() < 0.5 * np.abs(plain).sum()
    assert np.count_nonzero(sparse) < 0.5 * np.count_nonzero(np.abs(plain) > 1e-9)


def test_least_squares_against_numpy():
    generator = np.random.default_rng(3)
    features, samples = generator.normal(size=(5, 7, 40)), generator.normal(size=(5, 40))
    found = sparse_weights.least_squares(Normal.of(features, samples))
    for a, b, w in zip(features, samples, found, strict=True):
        np.testing.assert_allclose(w, np.linalg.lstsq(a.T, b, rcond=None)[0], rtol=1e-4, atol=1e-5)


def test_no_neighbours_empty_slots_and_zero_features():
    features, samples = visibility_like(6, 10, 100)
    features[0] = 0.0  # no neighbour says anything
    samples[1] = 0.0  # the vertex itself sees nothing
    features[2, 4:] = 0.0  # empty slots
    normal = Normal.of(features, samples)
    for weights in (sparse_weights.solve(normal), sparse_weights.least_squares(normal)):
        assert np.isfinite(weights).all()
        assert not weights[0].any()
        assert np.abs(weights[1]).max() < 1e-12
        assert not weights[2, 4:].any()
    alone = sparse_weights.solve(Normal.of(features[2:3, :4], samples[2:3]))
    np.testing.assert_allclose(sparse_weights.solve(normal)[2, :4], alone[0], atol=1e-12)
    assert sparse_weights.solve(Normal(np.zeros((3, 0, 0)), np.zeros((3, 0)))).shape == (3, 0)
    assert sparse_weights.solve(Normal(np.zeros((0, 4, 4)), np.zeros((0, 4)))).shape == (0, 4)


def test_duplicated_and_rank_deficient_neighbours():
    features, samples = visibility_like(8, 6, 100)
    doubled = np.concatenate([features, features, np.tile(features[:, :1], (1, 4, 1))], axis=1)
    for solver in (sparse_weights.solve, sparse_weights.least_squares):
        weights = solver(Normal.of(doubled, samples))
        assert np.isfinite(weights).all() and np.abs(weights).max() < 10
        once = solver(Normal.of(features, samples))
        for a, b, w, d, v in zip(features, samples, once, doubled, weights, strict=True):
            assert np.sum((d.T @ v - b) ** 2) <= np.sum((a.T @ w - b) ** 2) * 1.02 + 1e-4


def test_a_vertex_like_its_neighbour_takes_it():
    features, samples = visibility_like(5, 12, 300)
    samples = features[:, 3].copy()
    weights = sparse_weights.solve(Normal.of(features, samples), 1e-3)
    assert (np.abs(weights).argmax(axis=1) == 3).all()
    assert (weights[:, 3] > 0.97).all()


def test_adding_up_keeps_the_brightness_that_the_penalty_takes():
    features, samples = visibility_like(20, 24, 200, seed=4)
    normal = Normal.of(features, samples)
    plain, added = (sparse_weights.solve(n, 0.01).sum(axis=1) for n in (normal, normal.adding_up(8.0)))
    assert np.abs(added - 1).mean() < 0.3 * np.abs(plain - 1).mean()
    features[0, 5:] = 0.0
    assert not sparse_weights.solve(Normal.of(features, samples).adding_up(8.0))[0, 5:].any()


def test_results_do_not_depend_on_the_batch():
    features, samples = visibility_like(33, 24, 200)
    whole = sparse_weights.solve(Normal.of(features, samples))
    for size in (1, 7, 32):
        parts = [sparse_weights.solve(Normal.of(features[i:i + size], samples[i:i + size]))
                 for i in range(0, 33, size)]
        np.testing.assert_array_equal(np.concatenate(parts), whole)


def test_weights_by_distance():
    weights = sparse_weights.by_distance(np.array([[1.0, 2.0, np.inf], [np.inf] * 3, [0.0, 0.5, 1.0]]), 1.0)
    np.testing.assert_allclose(weights[0], [2 / 3, 1 / 3, 0.0])
    assert not weights[1].any()
    assert weights[2, 0] > 0.99


def test_inverse_against_numpy():
    generator = np.random.default_rng(0)
    rows = generator.normal(size=(6, 20, 9))
    matrices = rows.transpose(0, 2, 1) @ rows
    ridge = np.full(6, 0.3)
    np.testing.assert_allclose(sparse_weights.inverted(matrices, ridge),
                               np.linalg.inv(matrices + 0.3 * np.eye(9)), rtol=1e-9, atol=1e-12)
