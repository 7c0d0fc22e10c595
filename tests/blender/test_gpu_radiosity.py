# SPDX-License-Identifier: GPL-3.0-or-later
"""Jacobi iterations in a compute shader against the same on the CPU."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import sparse

from tests.blender.gpu_support import require_gpu


@pytest.fixture(scope="module")
def problem():
    """Rows of uneven length, one of them empty, that sum to at most 1; with a diagonal."""
    require_gpu()
    generator = np.random.default_rng(1)
    matrix = sparse.random(3000, 3000, 0.01, "csr", np.float32, generator)
    matrix = matrix + sparse.identity(3000, np.float32, "csr") * np.float32(0.3)
    keep = np.ones(3000, np.float32)
    keep[17] = 0.0
    sums = np.asarray(matrix.sum(axis=1)).ravel()
    matrix = (sparse.diags(keep / sums) @ matrix).tocsr().astype(np.float32)
    matrix.eliminate_zeros()
    albedo = generator.uniform(0.0, 0.95, (3000, 3)).astype(np.float32)
    emittance = generator.uniform(0.0, 2.0, (3000, 3)).astype(np.float32)
    return matrix, albedo, emittance


def test_the_gpu_iterates_as_the_cpu_does(problem):
    from prt.gpu_shaders.radiosity import BATCH, RadiosityOnGpu
    from prt.prt_addon.transport.radiosity import JACOBI, solve_radiosity

    matrix, albedo, emittance = problem
    on_gpu = RadiosityOnGpu(matrix)
    found = on_gpu.solve(albedo, emittance, tolerance=1.0, most=BATCH)
    expected = solve_radiosity(matrix, albedo, emittance, JACOBI, 1e-30, most=BATCH)
    assert found.iterations == expected.iterations == BATCH
    assert np.abs(found.radiosity / expected.radiosity - 1.0).max() < 2e-6
    assert found.residual == pytest.approx(np.sqrt(np.mean(np.square(expected.history[-2]))), rel=0.3)


def test_the_gpu_finds_the_exact_solution(problem):
    from prt.gpu_shaders.radiosity import RadiosityOnGpu
    from prt.prt_addon.transport.radiosity import BICGSTAB, solve_radiosity

    matrix, albedo, emittance = problem
    exact = solve_radiosity(matrix, albedo.astype(float), emittance.astype(float), BICGSTAB, 1e-12).radiosity
    found = RadiosityOnGpu(matrix).solve(albedo, emittance, tolerance=1e-6)
    assert found.residual <= 1e-6
    assert np.abs(found.radiosity / exact - 1.0).max() < 1e-5
    near = RadiosityOnGpu(matrix).solve(albedo, emittance, found.radiosity, 1e-6)
    assert near.iterations < found.iterations


def test_what_never_grows_dark_is_refused_on_the_gpu_too():
    require_gpu()
    from prt.gpu_shaders.radiosity import RadiosityOnGpu
    from prt.prt_addon.errors import BadScene

    with pytest.raises(BadScene):
        RadiosityOnGpu(sparse.identity(4, np.float32, "csr")).solve(np.ones((4, 3)), np.ones((4, 3)))


@pytest.mark.parametrize(("cost", "on_gpu"), [(1e-3, True), (10.0, False)])
def test_edits_are_solved_where_it_is_faster_and_come_out_the_same(problem, cost, on_gpu):
    from prt.gpu_shaders.radiosity import RadiosityOnGpu
    from prt.prt_addon.relighting.material_edits import TOLERANCE, MaterialEdits
    from prt.prt_addon.transport.live_operator import LiveOperator

    matrix, albedo, light = problem
    live = LiveOperator(matrix, 0.5 * albedo, np.ones(len(albedo), np.float32))
    solver = RadiosityOnGpu(matrix)

    def solve(albedo, source, start):
        return solver.solve(albedo, source, start, TOLERANCE)

    expected, _ = MaterialEdits(live).added(0.3 * albedo, 0.1 * light, light)
    edits = MaterialEdits(live, solve, cost)
    found, _ = edits.added(0.3 * albedo, 0.1 * light, light)
    assert edits.used_gpu == on_gpu
    assert np.sqrt(np.mean((found - expected) ** 2)) < 2.0 * TOLERANCE * np.sqrt(np.mean(expected ** 2))
