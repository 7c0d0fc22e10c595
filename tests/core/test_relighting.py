# SPDX-License-Identifier: GPL-3.0-or-later
"""Relighting in two steps equals decompressing M_p in double precision and multiplying it by the light."""

from __future__ import annotations

import time
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.special import sph_harm_y

from prt_addon.basis import spherical_harmonics
from prt_addon.lighting.windowing import for_highlights
from prt_addon.relighting.exit_radiance import cluster_constants, diffuse_radiance, exit_radiance, view_radiance


def random_baked(points: int, clusters: int, vectors: int, rows: int, columns: int, channels: int) -> SimpleNamespace:
    random = np.random.default_rng(points + vectors + rows + channels)
    return SimpleNamespace(
        cluster_zone=None,
        cluster=random.integers(0, clusters, points).astype(np.int32),
        weights=random.normal(size=(points, vectors)).astype(np.float32),
        bases=random.normal(size=(clusters, vectors + 1, rows, columns, channels)).astype(np.float32),
        albedo=random.uniform(size=(points, 3)).astype(np.float32),
        light=random.normal(size=(columns, 3)),
    )


def full_product(baked: SimpleNamespace) -> np.ndarray:
    """M_p l with M_p (rows, columns, channels) made explicit for every point."""
    bases, weights = baked.bases.astype(np.float64), baked.weights.astype(np.float64)
    result = []
    for point, cluster in enumerate(baked.cluster):
        matrix = bases[cluster, 0] + np.tensordot(weights[point], bases[cluster, 1:], axes=1)
        matrix = np.broadcast_to(matrix, (*matrix.shape[:2], 3))  # a neutral transfer serves all three channels
        result.append(np.stack([matrix[:, :, k] @ baked.light[:, k] for k in range(3)], axis=1))
    return np.array(result)


@pytest.mark.parametrize("vectors", [0, 1, 8])
@pytest.mark.parametrize(("rows", "columns", "channels"), [(1, 25, 1), (1, 100, 3), (16, 25, 1), (9, 16, 3)])
def test_two_steps_equal_the_full_product(vectors: int, rows: int, columns: int, channels: int) -> None:
    baked = random_baked(300, 12, vectors, rows, columns, channels)
    constants = cluster_constants(baked.bases, baked.light)
    assert constants.shape == (12, vectors + 1, rows, 3) and constants.dtype == np.float32
    radiance = exit_radiance(baked.cluster, baked.weights, constants)
    assert radiance.shape == (300, rows, 3) and radiance.dtype == np.float32
    expected = full_product(baked)
    assert np.abs(radiance - expected).max() < 5e-6 * np.abs(expected).max()


def test_a_points_value_does_not_depend_on_the_other_points() -> None:
    baked = random_baked(5000, 30, 8, 4, 25, 1)
    constants = cluster_constants(baked.bases, baked.light)
    whole = exit_radiance(baked.cluster, baked.weights, constants)
    for size in (1, 7, 1024):
        parts = [exit_radiance(baked.cluster[s:s + size], baked.weights[s:s + size], constants)
                 for s in range(0, 500 if size == 1 else 5000, size)]
        together = np.concatenate(parts)
        np.testing.assert_array_equal(together, whole[:len(together)])


def test_diffuse_radiance_multiplies_by_the_albedo() -> None:
    baked = random_baked(200, 5, 3, 1, 25, 1)
    radiance = diffuse_radiance(baked, baked.light)
    np.testing.assert_allclose(radiance, full_product(baked)[:, 0] * baked.albedo, atol=2e-4)
    with pytest.raises(ValueError, match="1 row"):
        diffuse_radiance(random_baked(5, 2, 1, 4, 9, 1), np.zeros((9, 3)))


def test_light_is_linear_and_black_light_is_black() -> None:
    baked = random_baked(100, 5, 3, 1, 25, 3)
    assert not diffuse_radiance(baked, np.zeros((25, 3))).any()
    np.testing.assert_array_equal(diffuse_radiance(baked, 2 * baked.light), 2 * diffuse_radiance(baked, baked.light))


def test_misfits_are_refused() -> None:
    baked = random_baked(10, 3, 2, 1, 9, 1)
    constants = cluster_constants(baked.bases, baked.light)
    with pytest.raises(ValueError, match="9 columns"):
        cluster_constants(baked.bases, np.zeros((16, 3)))
    with pytest.raises(ValueError, match="1 or 3"):
        cluster_constants(np.zeros((3, 2, 1, 9, 2), np.float32), baked.light)
    with pytest.raises(ValueError, match="weights"):
        exit_radiance(baked.cluster, baked.weights[:, :1], constants)
    with pytest.raises(ValueError, match="cluster indices"):
        exit_radiance(baked.cluster + 3, baked.weights, constants)
    assert exit_radiance(np.zeros(0, np.int32), np.zeros((0, 2), np.float32), constants).shape == (0, 1, 3)


def test_fifty_thousand_points_take_milliseconds() -> None:
    baked = random_baked(50_000, 256, 8, 1, 100, 1)
    seconds = []
    for _ in range(5):
        start = time.perf_counter()
        diffuse_radiance(baked, baked.light)
        seconds.append(time.perf_counter() - start)
    assert min(seconds) < 0.1  # 4-10 ms measured; the limit leaves room for a busy machine


def glossy_baked(points: int, functions: tuple[int, ...]) -> SimpleNamespace:
    baked = random_baked(points, 7, 3, 1 + len(functions), 9, 3)
    random = np.random.default_rng(1)
    frame = np.linalg.qr(random.normal(size=(points, 3, 3)))[0].transpose(0, 2, 1)
    frame[:, 2] = np.cross(frame[:, 0], frame[:, 1])  # right-handed: tangent, bitangent, normal
    baked.tangents, baked.normals = frame[:, 0].astype(np.float32), frame[:, 2].astype(np.float32)
    baked.functions, baked.frame, baked.soft_highlights = functions, frame, False
    return baked


def real_harmonics(index: int, local: np.ndarray) -> np.ndarray:
    """y_i from scipy's complex functions, as design/transfer.md states them."""
    degree = int(index ** 0.5)
    m = index - degree * (degree + 1)
    value = sph_harm_y(degree, abs(m), np.arccos(np.clip(local[:, 2], -1, 1)), np.arctan2(local[:, 1], local[:, 0]))
    return value.real if m == 0 else 2 ** 0.5 * (-1) ** m * (value.real if m > 0 else value.imag)


@pytest.mark.parametrize("functions", [(0,), tuple(range(16)), (0, 1, *range(3, 25)), tuple(range(25))])
def test_view_radiance_is_albedo_times_row_0_plus_functions_of_the_view(functions: tuple[int, ...]) -> None:
    baked = glossy_baked(200, functions)
    views = np.random.default_rng(3).normal(size=(200, 3)) * 5.0
    rows = full_product(baked)
    local = np.einsum("pij,pj->pi", baked.frame, views / np.linalg.norm(views, axis=1, keepdims=True))
    local[:, 2] = np.abs(local[:, 2])  # views from behind are mirrored to the front
    expected = baked.albedo * rows[:, 0]
    for row, index in enumerate(functions, start=1):
        expected = expected + real_harmonics(index, local)[:, None] * rows[:, row]
    found = view_radiance(baked, baked.light, views)
    assert found.dtype == np.float32
    assert np.abs(found - expected).max() < 1e-5 * np.abs(expected).max()


def test_view_radiance_of_diffuse_transfer_and_misfits() -> None:
    baked = glossy_baked(50, ())
    views = np.ones((50, 3))
    np.testing.assert_array_equal(view_radiance(baked, baked.light, views), diffuse_radiance(baked, baked.light))
    with pytest.raises(ValueError, match="one view"):
        view_radiance(baked, baked.light, views[:49])
    wrong = glossy_baked(50, (0, 1, 2))
    wrong.functions = (0, 1)
    with pytest.raises(ValueError, match="4 rows"):
        view_radiance(wrong, wrong.light, views)


def test_only_rows_of_the_view_reflect_the_softer_light() -> None:
    """And only distant light of it: columns of lamps come after it, in zones or not."""
    baked = glossy_baked(60, tuple(range(9)))  # of 9 columns
    baked.lighting_basis, baked.soft_highlights = SimpleNamespace(distant=4, cubemap=0), True
    sun = np.full_like(baked.light, 0.7)
    sun[:4] = spherical_harmonics.evaluate(2, np.array([[0.6, 0.0, 0.8]]))[0][:, None] * (3.0, 2.0, 1.0)
    softer = np.concatenate([for_highlights(sun[:4]), sun[4:]])
    assert np.abs(softer[:4] - sun[:4]).max() > 0.1
    views = np.random.default_rng(4).normal(size=(60, 3))
    for light in (sun, np.stack([sun, sun])):
        baked.cluster_zone = np.arange(len(baked.bases), dtype=np.int32) % 2 if light.ndim == 3 else None
        found = view_radiance(baked, light, views)
        diffuse, soft = SimpleNamespace(**vars(baked)), SimpleNamespace(**vars(baked))
        diffuse.functions, diffuse.bases = (), np.ascontiguousarray(baked.bases[:, :, :1])
        expected = view_radiance(diffuse, sun if light.ndim == 2 else light, views)
        soft.albedo, soft.soft_highlights = np.zeros_like(baked.albedo), False
        expected = expected + view_radiance(soft, softer if light.ndim == 2 else np.stack([softer] * 2), views)
        assert np.allclose(found, expected, atol=1e-4 * np.abs(expected).max())
