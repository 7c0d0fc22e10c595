# SPDX-License-Identifier: GPL-3.0-or-later
"""The products and eigenproblems that run without Python's lock, against numpy."""

from __future__ import annotations

import itertools
import threading

import numpy as np
import pytest

from prt_addon import linear_algebra, unlocked_blas
from prt_addon.linear_algebra import many_symmetric_eigenpairs, multiply

LAYOUTS = {"rows": np.ascontiguousarray, "columns": np.asfortranarray,
           "strided": lambda a: np.repeat(a, 2, axis=0)[::2]}


@pytest.mark.parametrize("kind", [np.float32, np.float64])
@pytest.mark.parametrize("layouts", list(itertools.product(LAYOUTS, repeat=2)))
@pytest.mark.parametrize("work", [0, 1 << 60])
def test_products_of_every_layout(kind, layouts, work, monkeypatch) -> None:
    monkeypatch.setattr(linear_algebra, "UNLOCKED_WORK", work)
    generator = np.random.default_rng(0)
    a = LAYOUTS[layouts[0]](generator.normal(size=(7, 5)).astype(kind))
    b = LAYOUTS[layouts[1]](generator.normal(size=(5, 11)).astype(kind))
    tolerance = 1e-5 if kind == np.float32 else 1e-13
    np.testing.assert_allclose(multiply(a, b), a @ b, atol=tolerance)
    out = np.ones((7, 11), kind)
    assert multiply(a, b, out, accumulate=True) is out
    np.testing.assert_allclose(out, 1 + a @ b, atol=tolerance)
    multiply(a, b, out)
    np.testing.assert_allclose(out, a @ b, atol=tolerance)
    assert multiply(a, b).dtype == kind and multiply(a, b).flags.c_contiguous


@pytest.mark.parametrize("available", [unlocked_blas.available, False])
def test_many_eigenpairs(available, monkeypatch) -> None:
    monkeypatch.setattr(unlocked_blas, "available", available)
    roots = np.random.default_rng(1).normal(size=(6, 9, 4))
    matrices = roots @ roots.transpose(0, 2, 1)
    kept = matrices.copy()
    values, rows = many_symmetric_eigenpairs(matrices)
    np.testing.assert_array_equal(matrices, kept)
    np.testing.assert_allclose(values, np.linalg.eigvalsh(matrices)[:, ::-1], atol=1e-12)
    columns = rows.transpose(0, 2, 1)
    np.testing.assert_allclose(matrices @ columns, values[:, None] * columns, atol=1e-12)
    np.testing.assert_allclose(rows @ columns, np.broadcast_to(np.eye(9), (6, 9, 9)), atol=1e-12)


@pytest.mark.skipif(not unlocked_blas.available, reason="this scipy does not export its routines: the fall-back works")
def test_large_products_let_other_threads_run() -> None:
    """The reason for the module: this scipy exports its routines, and while one works, Python goes on."""
    matrix = np.random.default_rng(0).normal(size=(1500, 1500)).astype(np.float32)
    thread = threading.Thread(target=lambda: multiply(matrix, matrix))
    thread.start()
    steps = 0
    while thread.is_alive():
        steps += 1
    assert steps > 20_000


@pytest.mark.parametrize("kind", [np.float32, np.float64])
def test_fall_back_gives_the_same_answers(kind, monkeypatch) -> None:
    """A scipy that exports no routines: large products, alone and added to an array, and eigenpairs."""
    generator = np.random.default_rng(2)
    a, b = generator.normal(size=(300, 120)).astype(kind), generator.normal(size=(120, 200)).astype(kind)
    roots = generator.normal(size=(5, 8, 8))

    def answers() -> list[np.ndarray]:
        out = np.ones((300, 200), kind)
        multiply(a, b, out, accumulate=True)
        values, rows = many_symmetric_eigenpairs(roots @ roots.transpose(0, 2, 1))
        return [multiply(a, b), out, values, np.abs(rows)]

    with monkeypatch.context() as patch:  # the routine itself must not be touched where it is said to be absent
        patch.setattr(unlocked_blas, "available", False)
        patch.setattr(unlocked_blas, "gemm", None)
        patch.setattr(unlocked_blas, "eigenpairs_in_place", None)
        found = answers()
    tolerance = 1e-4 if kind == np.float32 else 1e-11
    outside = [a.astype(float) @ b, 1 + a.astype(float) @ b,
               np.linalg.eigvalsh(roots @ roots.transpose(0, 2, 1))[:, ::-1]]
    for one, other in zip(found, outside, strict=False):
        np.testing.assert_allclose(one, other, atol=tolerance)
    for one, other in zip(found, answers(), strict=True):
        np.testing.assert_allclose(one, other, atol=tolerance)
