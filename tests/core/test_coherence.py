# SPDX-License-Identifier: GPL-3.0-or-later
"""Reclassification and superclusters against closed forms, brute-force decoding and the paper's greedy, plainly."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import linalg

from prt_addon.baking.recipe import bake, exhaust
from prt_addon.baking.settings import BakeSettings, make_settings
from prt_addon.compression import coherence
from prt_addon.compression.coherence import cluster_registers, make_coherent, overdraw, subspace_errors, superclusters
from prt_addon.compression.encoding import Encoding, encode
from prt_addon.compression.settings import EncoderSettings
from prt_addon.errors import BadArguments, Cancelled
from prt_addon.scene.scene_mesh import SceneMesh
from prt_addon.scene.surface_material import SurfaceMaterial
from tests.core.shapes import make, plane, sphere


def grid(cells: int) -> NDArray[np.int32]:
    """Triangles of a square grid of (cells + 1)^2 points; point (i, j) is i * (cells + 1) + j."""
    return plane(cells=cells).triangles


def of_means(signal: NDArray, labels: NDArray, means: NDArray) -> Encoding:
    """An encoding without vectors."""
    errors = np.square(signal - means[labels]).sum(axis=1)
    total = float(errors.sum())
    return Encoding(labels.astype(np.int32), means[:, None].astype(np.float32), np.zeros((len(labels), 0), np.float32),
                    np.zeros(len(means), np.int32), total, total / float(np.square(signal).sum()),
                    np.bincount(labels, errors, len(means)), ())


def surface_signal(cells: int, rows: int, columns: int, seed: int) -> NDArray[np.float32]:
    """Matrices over a grid: waves, with noise that makes clusters ragged and grows across so that they are uneven."""
    generator = np.random.default_rng(seed)
    line = np.linspace(0, 1, cells + 1)
    place = np.stack(np.meshgrid(line, line, indexing="ij"), axis=-1).reshape(-1, 2)
    waves = np.sin(place @ generator.normal(0, 6, (2, rows * columns)) + generator.uniform(0, 6, rows * columns))
    return (waves + 0.6 * place[:, :1] ** 8 * generator.normal(size=waves.shape)).astype(np.float32)


CELLS, METRIC = 40, np.array([[2.0, 0.3, 0.0], [0.3, 1.0, 0.2], [0.0, 0.2, 0.1]])


@cache
def encoded(method: str, with_metric: bool) -> tuple[NDArray[np.float32], Encoding, NDArray | None]:
    """A signal of 3 x 4 matrices, its encoding, and the metric."""
    signal, metric = surface_signal(CELLS, 3, 4, 5), METRIC if with_metric else None
    settings = EncoderSettings(24, 3, method, seed=2, restarts=0, vectors_limit=6)
    encoding = encode(signal, settings, metric)
    assert (np.ptp(encoding.vectors_per_cluster) > 0) == (method == "adaptive")
    return signal, encoding, metric


CASES = [("static", False), ("iterative", True), ("adaptive", True)]


def brute_errors(signal: NDArray, encoding: Encoding, metric: NDArray | None) -> NDArray[np.float64]:
    """Squared error of every point's decoded matrix, in double precision."""
    bases = encoding.bases.astype(float)[encoding.cluster]
    left = signal - bases[:, 0] - np.einsum("pv,pvn->pn", encoding.weights.astype(float), bases[:, 1:])
    left = left.reshape(len(left), -1, 4)
    return np.einsum("pmc,mk,pkc->p", left, np.eye(left.shape[1]) if metric is None else metric, left)


@pytest.mark.parametrize("boundaries", [1, 3])
def test_overdraw_of_stripes_is_known(boundaries: int) -> None:
    # Every boundary mixes one of 12 columns of cells, all the way down.
    column = np.tile(np.arange(13), 13)
    labels = np.minimum(column // 3, boundaries)
    assert overdraw(grid(12), labels) == pytest.approx(1 + boundaries / 12, abs=1e-12)


def specks(values: list[float]) -> tuple[NDArray, NDArray, Encoding]:
    """A grid in cluster 0 (mean 0, values 0.1) with specks in cluster 1 (mean 1), each amid six triangles."""
    places = [13 * (3 + 3 * i) + 6 for i in range(len(values))]
    signal = np.full((169, 1), 0.1)
    signal[places, 0] = values
    labels = np.zeros(169, np.int64)
    labels[places] = 1
    return grid(12), signal, of_means(signal, labels, np.array([[0.0], [1.0]]))


@pytest.mark.parametrize(("spare", "moves"), [(1.001, 1), (0.999, 0)])
def test_a_speck_moves_when_the_budget_allows_it(spare: float, moves: int) -> None:
    triangles, signal, encoding = specks([0.7])
    before = 168 * 0.01 + 0.3**2
    cost = 0.7**2 - 0.3**2
    result, found = make_coherent(encoding, triangles, signal, spare * cost / before)
    assert found.moved == moves
    assert found.squared_error_before == pytest.approx(before, rel=1e-6)
    assert found.squared_error_after == pytest.approx(before + moves * cost, rel=1e-6)
    assert found.before == pytest.approx(1 + 6 / 288)
    assert found.reclassified == pytest.approx(1 + (1 - moves) * 6 / 288)
    # A cluster without points is left out, and nothing changes where nothing moves.
    assert len(result.bases) == 2 - moves
    assert moves or result is encoding


def test_the_cheaper_of_two_specks_moves_first() -> None:
    triangles, signal, encoding = specks([0.8, 0.6])
    costs = np.array([0.8**2 - 0.2**2, 0.6**2 - 0.4**2])
    share = costs.max() / encoding.squared_error  # enough for either, not for both
    result, found = make_coherent(encoding, triangles, signal, share)
    assert found.moved == 1
    assert result.cluster[13 * 3 + 6] == 1 and result.cluster[13 * 6 + 6] == 0


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("share", [0.01, 0.05, 0.3])
def test_the_budget_holds_and_the_error_is_the_decoded_one(case: tuple[str, bool], share: float) -> None:
    signal, encoding, metric = encoded(*case)
    triangles = grid(CELLS)
    result, found = make_coherent(encoding, triangles, signal, share, metric, rows=3, registers=12)
    before, after = brute_errors(signal, encoding, metric), brute_errors(signal, result, metric)
    assert found.moved > 5
    assert after.sum() <= before.sum() * (1 + share)
    assert found.squared_error_before == pytest.approx(before.sum(), rel=1e-9)
    assert result.squared_error == found.squared_error_after == pytest.approx(after.sum(), rel=1e-9)
    assert result.relative_error / encoding.relative_error == pytest.approx(after.sum() / before.sum(), rel=1e-4)
    assert result.discarded == pytest.approx(np.bincount(result.cluster, after, len(result.bases)), rel=1e-6, abs=1e-9)
    assert found.reclassified < found.before
    assert found.reclassified == overdraw(triangles, result.cluster)
    assert found.superclustered < found.before and found.both < found.reclassified
    decoded = np.square(result.decode() - signal).sum() if metric is None else None
    assert decoded is None or decoded == pytest.approx(result.squared_error, rel=1e-4)


@pytest.mark.parametrize("case", CASES)
def test_moved_points_are_projected_and_others_stay(case: tuple[str, bool]) -> None:
    signal, encoding, metric = encoded(*case)
    result, found = make_coherent(encoding, grid(CELLS), signal, 0.1, metric)
    assert len(result.bases) == len(encoding.bases)
    assert np.array_equal(result.bases, encoding.bases)
    assert np.array_equal(result.vectors_per_cluster, encoding.vectors_per_cluster)
    moved = result.cluster != encoding.cluster
    assert moved.sum() == found.moved
    assert np.array_equal(result.weights[~moved], encoding.weights[~moved])
    root = np.kron(linalg.sqrtm(np.eye(3) if metric is None else metric), np.eye(4))
    for point in np.flatnonzero(moved)[:40]:
        mean, *axes = result.bases[result.cluster[point]].astype(float)
        used = result.vectors_per_cluster[result.cluster[point]]
        best = linalg.lstsq(root @ np.array(axes[:used]).T, root @ (signal[point] - mean))[0] if used else []
        assert result.weights[point, :used] == pytest.approx(best, abs=1e-5)
        assert not result.weights[point, used:].any()


def test_errors_in_other_subspaces_are_least_squares_residuals() -> None:
    signal, encoding, metric = encoded("iterative", True)
    points, clusters = np.arange(0, 200, 7), np.arange(0, 200, 7) % len(encoding.bases)
    root = np.kron(linalg.sqrtm(metric), np.eye(4))
    expected = []
    for point, cluster in zip(points, clusters, strict=True):
        mean, *axes = encoding.bases[cluster].astype(float)
        matrix, target = root @ np.array(axes).T, root @ (signal[point] - mean)
        expected.append(np.square(target - matrix @ linalg.lstsq(matrix, target)[0]).sum())
    assert subspace_errors(encoding, signal, points, clusters, metric) == pytest.approx(expected, rel=1e-6)


def best_moves(triangles: NDArray, labels: NDArray, errors: NDArray, points: NDArray) -> list[tuple]:
    """Quotient, cost, gain and target of the best move of points by drawing their triangles anew, errors (p, K)."""
    result = []
    for point in points:
        around = triangles[(triangles == point).any(axis=1)]
        corners, found = labels[around], (0.0, 0.0, 0, -1)
        drawn = sum(len(set(row)) for row in corners.tolist())
        for other in sorted(set(corners.ravel().tolist()) - {labels[point]}):
            gain = drawn - sum(len(set(row)) for row in np.where(around == point, other, corners).tolist())
            cost = errors[point, other] - errors[point, labels[point]]
            if gain > 0 and gain / max(cost, 1e-200) > found[0]:
                found = (gain / max(cost, 1e-200), cost, gain, other)
        result.append(found)
    return result


def all_errors(signal: NDArray, encoding: Encoding, metric: NDArray | None) -> NDArray[np.float64]:
    """Squared errors (p, K) of every point in every cluster."""
    points = np.arange(len(signal))
    return np.stack([subspace_errors(encoding, signal, points, np.full(len(points), k), metric)
                     for k in range(len(encoding.bases))], axis=1)


@pytest.mark.parametrize("soup", [False, True])
def test_gains_are_those_of_drawing_the_triangles_anew(soup: bool) -> None:
    signal, encoding, metric = encoded("adaptive", True)
    triangles = grid(CELLS)
    if soup:  # triangles that share points at random, name one twice or thrice, or come twice
        triangles = np.random.default_rng(1).integers(0, 90, (120, 3))
        triangles[::5, 1], triangles[::7, 2], triangles[1] = triangles[::5, 0], triangles[::7, 1], triangles[2]
    search = coherence._Search.of(triangles, coherence._Distances.of(encoding, signal, metric), lambda: None)
    search.look(np.arange(len(signal)))
    expected = best_moves(triangles, encoding.cluster, all_errors(signal, encoding, metric), np.arange(len(signal)))
    assert search.gain.tolist() == [gain for _, _, gain, _ in expected]
    movable = search.gain > 0
    assert movable.sum() > 30
    assert search.target[movable].tolist() == [target for *_, target in expected if target >= 0]
    assert search.cost[movable] == pytest.approx([cost for _, cost, gain, _ in expected if gain], rel=1e-6)


def plain_greedy(triangles: NDArray, signal: NDArray, encoding: Encoding, metric: NDArray | None,
                 share: float) -> float:
    """Section 5 move by move: the best quotient of all, everything recomputed after each; the overdraw it reaches."""
    labels, errors = encoding.cluster.astype(int), all_errors(signal, encoding, metric)
    points = np.arange(len(labels))
    left = share * errors[points, labels].sum()
    moves = best_moves(triangles, labels, errors, points)
    while True:
        fitting = [move[0] if move[1] <= left else 0.0 for move in moves]
        point = int(np.argmax(fitting))
        if fitting[point] <= 0:
            return overdraw(triangles, labels)
        labels[point], left = moves[point][3], left - moves[point][1]
        near = np.unique(triangles[(triangles == point).any(axis=1)])
        for other, move in zip(near, best_moves(triangles, labels, errors, near), strict=True):
            moves[other] = move


@pytest.mark.parametrize("case", CASES)
def test_moves_in_batches_reach_what_the_plain_greedy_reaches(case: tuple[str, bool]) -> None:
    signal, encoding, metric = encoded(*case)
    triangles = grid(CELLS)
    plain = plain_greedy(triangles, signal, encoding, metric, 0.05)
    _, found = make_coherent(encoding, triangles, signal, 0.05, metric)
    assert found.before - plain > 0.01
    assert found.before - found.reclassified >= 0.97 * (found.before - plain)


def test_the_result_is_deterministic_and_free_moves_cost_nothing() -> None:
    signal, encoding, metric = encoded("iterative", True)
    first, found = make_coherent(encoding, grid(CELLS), signal, 0.1, metric)
    second, again = make_coherent(encoding, grid(CELLS), signal, 0.1, metric)
    assert np.array_equal(first.cluster, second.cluster) and np.array_equal(first.weights, second.weights)
    assert found == again
    _, free = make_coherent(encoding, grid(CELLS), signal, 0.0, metric)
    assert free.squared_error_after <= free.squared_error_before * (1 + 1e-12)


def test_overdraw_never_rises_with_degenerate_and_repeated_triangles() -> None:
    signal, encoding, metric = encoded("static", False)
    generator = np.random.default_rng(0)
    for _ in range(5):
        chosen = generator.integers(0, 60, (200, 3))
        chosen[::5, 1] = chosen[::5, 0]
        chosen[::7, 2] = chosen[::7, 0]
        _, found = make_coherent(encoding, chosen, signal, 0.5, metric)
        assert found.both <= found.reclassified < found.before
    unchanged, found = make_coherent(encoding, np.zeros((0, 3), int), signal, 0.5)
    assert unchanged is encoding and found.moved == 0 and found.both == 1


def test_bad_input_is_named_and_a_cancel_goes_through() -> None:
    signal, encoding, _ = encoded("static", False)
    for share in (-0.1, np.nan):
        with pytest.raises(BadArguments, match="share"):
            make_coherent(encoding, grid(CELLS), signal, share)
    with pytest.raises(BadArguments, match="shape"):
        make_coherent(encoding, grid(CELLS), signal[:, :4], 0.1)

    def cancel() -> None:
        raise Cancelled("bake", "cancelled", "")
    with pytest.raises(Cancelled):
        make_coherent(encoding, grid(CELLS), signal, 0.1, tick=cancel)


@pytest.mark.parametrize(("registers", "groups"), [(0, 4), (1, 4), (2, 2), (3, 2), (4, 1)])
def test_superclusters_of_stripes(registers: int, groups: int) -> None:
    labels = np.tile(np.arange(13), 13) * 4 // 13
    found = superclusters(grid(12), labels, np.ones(4, int), registers)
    # A chain of equal links, of which the first is taken: two pairs at 2, a triple and one alone at 3.
    assert len(np.unique(found)) == groups
    assert overdraw(grid(12), found[labels]) == pytest.approx(1 + (groups - 1) / 12)


def plain_superclusters(triangles: NDArray, labels: NDArray, sizes: NDArray, registers: int) -> NDArray:
    """Greedy merging with everything counted anew before each merge."""
    group, total = np.arange(len(sizes)), sizes.copy()
    while True:
        corners = group[labels[triangles]]
        best = (0, 0, 0)
        inside = np.array([(corners == g).any(axis=1) for g in range(len(sizes))]).astype(int)
        shared = inside @ inside.T
        for one in range(len(sizes)):
            for other in range(one + 1, len(sizes)):
                if shared[one, other] and total[one] + total[other] <= registers:
                    best = min(best, (-shared[one, other], one, other))
        if best[0] == 0:
            return np.unique(group, return_inverse=True)[1]
        total[best[1]] += total[best[2]]
        group[group == best[2]] = best[1]


@pytest.mark.parametrize("registers", [9, 20, 40, 1000])
@pytest.mark.parametrize("scattered", [False, True])
def test_superclusters_equal_the_plain_greedy_and_fit(registers: int, scattered: bool) -> None:
    _, encoding, _ = encoded("adaptive", True)
    sizes = cluster_registers(encoding, 4)
    labels = np.random.default_rng(3).permutation(encoding.cluster) if scattered else encoding.cluster
    found = superclusters(grid(CELLS), labels, sizes, registers)
    assert np.array_equal(found, plain_superclusters(grid(CELLS), labels, sizes, registers))
    several = np.bincount(found) > 1
    assert (np.bincount(found, sizes)[several] <= registers).all()
    assert overdraw(grid(CELLS), found[labels]) <= overdraw(grid(CELLS), labels)


def test_registers_are_the_papers() -> None:
    # Section 6: glossy m_s (n' + 1) N_r / 4, diffuse m_s (n' + 1).
    _, encoding, _ = encoded("static", False)
    encoding = replace(encoding, vectors_per_cluster=np.full(24, 8, np.int32))
    assert (cluster_registers(encoding, 24) == 9 * 6).all()
    assert (cluster_registers(encoding, 1) == 9).all()


SETTINGS = BakeSettings(order=3, directions=256, gather_directions=64, clusters=24, vectors=2, encoder="static",
                        spacing=0.0, compression_error=0.0, error_receivers=0, threads=1)


def test_a_bake_reports_coherence_only_where_it_was_asked_for() -> None:
    cloth = plane(size=4.0, cells=24)
    # A loose point in front shifts the numbers of all others.
    cloth = make("cloth", np.concatenate([[[9.0, 9.0, 9.0]], cloth.positions]), cloth.triangles + 1)
    scene = SceneMesh.assemble([cloth, sphere(centre=(0, 0, 0.6), radius=0.5, subdivisions=2, target=False)])
    off = exhaust(bake(scene, SETTINGS))
    on = exhaust(bake(scene, replace(SETTINGS, coherence=0.1)))
    assert "coherence" not in off.report["clusters"]["objects"]["cloth"]
    before, after = (r.report["clusters"]["objects"]["cloth"] for r in (off, on))
    found = after["coherence"]
    assert found["moved"] > 0
    assert found["before"] == pytest.approx(before["overdraw"])
    assert found["reclassified"] == pytest.approx(after["overdraw"]) and after["overdraw"] < before["overdraw"]
    assert before["squared_error"] < after["squared_error"] <= 1.1 * before["squared_error"] * (1 + 1e-4)
    assert after["squared_error"] == found["squared_error_after"]


def test_a_bake_of_highlights_spends_its_budget_in_the_hemispheres_metric() -> None:
    metal = SurfaceMaterial("metal", (1.0, 1.0, 1.0), roughness=0.5, metallic=1.0, specular_level=0.5)
    ball = replace(sphere(subdivisions=3, albedo=(0, 0, 0)), materials=(metal,))
    scene = SceneMesh.assemble([ball, plane(size=6.0, height=-1.2, target=False)])
    result = exhaust(bake(scene, replace(SETTINGS, glossy_rows=9, coherence=0.1)))
    entry = result.report["clusters"]["objects"]["sphere"]
    found = entry["coherence"]
    assert result.objects["sphere"].bases.shape[2] == 10 and found["moved"] > 0
    # What the search adds up in the metric is the error that the encoder measured in its own way.
    assert found["squared_error_before"] == pytest.approx(entry["history"][-1][2], rel=1e-4)
    assert found["squared_error_after"] <= 1.1 * found["squared_error_before"]


def test_the_setting_has_limits() -> None:
    assert make_settings("standard").coherence == 0.0
    assert make_settings("standard", {"coherence": "0.5"}).coherence == 0.5
    with pytest.raises(BadArguments, match="coherence"):
        make_settings("standard", {"coherence": "0.6"})
