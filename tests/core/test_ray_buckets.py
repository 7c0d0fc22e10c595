# SPDX-License-Identifier: GPL-3.0-or-later
"""The ray engine's arrays against Embree and brute force: tree, buckets, cells, cost model, choice. No GPU."""

from __future__ import annotations

import itertools
import json
from dataclasses import replace

import numpy as np
import pytest

from prt_addon.errors import PRTError
from prt_addon.tracing.bounding_hierarchy import LEAF, STACK, build, node_texels, triangle_texels
from prt_addon.tracing.ray_buckets import make_buckets, pair_with_cells
from prt_addon.tracing.ray_calibration import ball_field, field_rays
from prt_addon.tracing.ray_cost import NEAREST_BYTES, Calibration, choose_tracer, gpu_share, short_name
from prt_addon.tracing.ray_engine import FARTHEST, MOST_STEPS, bits_of, check_rays, make_passes, texels_of_bits
from prt_addon.tracing.tracer import Tracer

KNOWN = Calibration("a card", 2e9, 1e9, 5e8, 1e-4, 1e-7, 3e8, 1e8, 2e8, 1e7, 4)


@pytest.fixture(scope="module")
def field() -> tuple[np.ndarray, np.ndarray]:
    return ball_field()


def random_rays(count: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    generator = np.random.default_rng(seed)
    return (generator.uniform(-0.5, 0.5, (count, 3)).astype(np.float32),
            generator.normal(size=(count, 3)).astype(np.float32))


@pytest.mark.parametrize("count", [1, 2, 5, 17, 1000])
def test_tree_holds_every_triangle_once_and_boxes_hold_what_is_below(field, count):
    points, triangles = field[0], field[1][:count]
    tree = build(points, triangles)
    assert np.array_equal(np.sort(tree.order), np.arange(count))
    inner = np.flatnonzero(tree.left >= 0)
    left = tree.left[inner]
    assert np.array_equal(tree.count[left] + tree.count[left + 1], tree.count[inner])
    for node in range(len(tree.left)):
        corners = points[triangles[tree.order[tree.first[node]:tree.first[node] + tree.count[node]]]].reshape(-1, 3)
        assert (corners >= tree.low[node]).all() and (corners <= tree.high[node]).all()
        assert (tree.left[node] >= 0) == (tree.count[node] > LEAF)
    assert len(node_texels(tree)) == 4 * max(1, len(inner))
    assert len(triangle_texels(tree, points, triangles)) == 3 * count


def test_triangles_at_one_place_and_long_thin_rows_stay_within_the_stack():
    same = np.tile([[0, 1, 2]], (3000, 1)).astype(np.int32)
    assert build(np.eye(3, dtype=np.float32), same).levels <= 11
    # Each triangle ten times as far and as large as the last: halves by area cut off one triangle at a time.
    size = 1.5 ** np.arange(150)
    points = (np.eye(3)[None] * size[:, None, None] / size[-1]).reshape(-1, 3).astype(np.float32)
    tree = build(points, np.arange(len(points), dtype=np.int32).reshape(-1, 3))
    assert 8 < tree.levels < STACK


def test_no_triangles_and_corners_that_are_no_numbers():
    points = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [np.nan, 0, 0]], np.float32)
    tree = build(points, np.array([[0, 1, 3], [0, 1, 2]], np.int32))
    assert tree.order.tolist() == [1]
    empty = build(points, np.empty((0, 3), np.int32))
    texels = node_texels(empty)
    assert (texels[0, :3] > texels[1, :3]).all() and (texels[2, :3] > texels[3, :3]).all()  # boxes that nothing meets


@pytest.mark.parametrize("size", [64, 256])
def test_buckets_are_full_and_hold_their_rays(size):
    origins, directions = random_rays(1000)
    buckets = make_buckets(origins, directions, np.full(1000, 2.0, np.float32), size)
    assert np.array_equal(np.sort(buckets.order), np.arange(1000)) and len(buckets) == -(-1000 // size)
    for k in range(len(buckets)):
        rays = buckets.order[k * size:(k + 1) * size]
        for values, box in ((origins, buckets.origins[k]), (directions, buckets.directions[k])):
            assert np.array_equal(values[rays].min(axis=0), box[0]) and np.array_equal(values[rays].max(axis=0), box[1])


def test_buckets_hold_rays_that_are_alike():
    origins, directions = random_rays(1 << 14)
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    buckets = make_buckets(origins, directions, np.ones(1 << 14, np.float32), 64)
    of_bucket = np.ptp(buckets.origins, axis=1).mean() + np.ptp(buckets.directions, axis=1).mean()
    mixed = make_buckets(origins, directions, np.ones(1 << 14, np.float32), 1 << 14)
    assert of_bucket < 0.5 * (np.ptp(mixed.origins, axis=1).mean() + np.ptp(mixed.directions, axis=1).mean())


@pytest.mark.parametrize(("size", "most"), [(64, 4), (256, 32)])
def test_a_bucket_is_paired_with_every_cell_that_its_rays_hit(field, size, most):
    points, triangles = field
    tracer = Tracer(points.astype(np.float64), triangles, 1)
    points = tracer.to_tracing_space(points)
    tree = build(points, triangles)
    origins, directions = random_rays(2048, 5)
    directions[:300] = (0.0, 0.0, 1.0)  # along an axis
    hits = tracer.nearest(origins, directions)
    buckets = make_buckets(origins, directions, np.full(len(origins), FARTHEST), size)
    pairs = pair_with_cells(buckets, tree, most)
    assert (tree.count[pairs.cell] <= max(most, LEAF)).all() and len(pairs.first) == len(buckets) + 1
    place = np.empty(len(triangles), np.int64)
    place[tree.order] = np.arange(len(triangles))
    for position in np.flatnonzero(hits.triangle[buckets.order] >= 0):
        ray = buckets.order[position]
        part = slice(*pairs.first[position // size:position // size + 2])
        cell, at = pairs.cell[part], place[hits.triangle[ray]]
        found = np.flatnonzero((tree.first[cell] <= at) & (at < tree.first[cell] + tree.count[cell]))
        assert len(found) == 1 and pairs.near[part][found[0]] <= hits.distance[ray] * (1 + 1e-6)
        assert (np.diff(pairs.near[part]) >= 0.0).all()


def test_pairing_leaves_out_most_of_the_scene(field):
    points, triangles = field
    tree = build(points, triangles)
    origins, directions = field_rays(points)
    origins = origins[:4096]
    parallel = np.broadcast_to(directions[:1], origins.shape)
    pairs = pair_with_cells(make_buckets(origins, parallel, np.full(4096, FARTHEST), 64), tree, 16)
    assert tree.count[pairs.cell].sum() / 64 < 0.15 * len(triangles)


def test_rays_that_end_early_are_paired_with_near_cells_only(field):
    points, triangles = field
    tree = build(points, triangles)
    origins, directions = field_rays(points)
    origins, directions = origins[:4096], np.broadcast_to(directions[:1], (4096, 3))
    short = pair_with_cells(make_buckets(origins, directions, np.full(4096, 0.01, np.float32), 64), tree, 8)
    far = pair_with_cells(make_buckets(origins, directions, np.full(4096, FARTHEST), 64), tree, 8)
    assert 0 < len(short.cell) < 0.6 * len(far.cell) and (short.near <= 0.0101).all()


def test_passes_bound_the_work_of_a_dispatch_and_lose_no_pair(field):
    points, triangles = field
    tree = build(points, triangles)
    origins, directions = random_rays(512, 3)
    pairs = pair_with_cells(make_buckets(origins, directions, np.full(512, FARTHEST), 512), tree, 64)
    many = np.full(len(pairs.cell), 1000)
    passes = make_passes(pairs, many)
    assert len(passes.bucket) > 1
    assert (passes.triangles <= MOST_STEPS + 1001).all() and passes.triangles.sum() == many.sum()
    taken = np.concatenate([np.arange(a, b) for a, b in zip(passes.first, passes.end, strict=True)])
    assert np.array_equal(np.sort(taken), np.arange(len(pairs.cell)))
    for start, end in enumerate(passes.last_of_round):
        assert len(set(passes.bucket[start:end])) == end - start  # no bucket twice in one dispatch


def test_cost_is_the_papers_equation():
    assert KNOWN.published(256, 10, 4.0) == pytest.approx(256 * 10 / 2e9 + 256 * 4.0 / 1e9)
    assert KNOWN.seconds(256, 10) == pytest.approx(1e-4 + 256 * 10 / 2e9 + 256 * 16.0 / 1e9 + 256 * 32.0 / 5e8)
    assert KNOWN.on_device(64, 10) == pytest.approx(1e-4 + 10 * 1e-7 + 64 * 16.0 / 1e9)  # 64 rays do not fill a card
    # The paper's GeForce3 (section 6.1): 390 Mtests/s, 250 MB/s; ten triangles at gamma 4 give 240 Mtests/s.
    old = replace(KNOWN, fill=390e6, readback=250e6)
    assert 10 / old.published(1, 10, 4.0) == pytest.approx(240e6, rel=0.01)
    assert old.least_triangles(0.5) == int(np.ceil(NEAREST_BYTES / 250e6 * 390e6))


def test_buckets_are_shared_so_that_both_end_earliest():
    generator = np.random.default_rng(2)
    for _ in range(20):
        gpu, cpu = generator.uniform(0.1, 1.0, (2, 7))
        chosen = gpu_share(gpu, cpu)
        took = max(gpu[chosen].sum(), cpu[~chosen].sum())
        best = min(max(gpu[list(c)].sum(), cpu.sum() - cpu[list(c)].sum())
                   for n in range(8) for c in itertools.combinations(range(7), n))
        assert best - 1e-9 <= took <= best + 0.5 * (gpu.max() + cpu.max())
    assert not gpu_share(np.full(5, 100.0), np.full(5, 1.0)).any()  # a slow GPU gets nothing
    assert gpu_share(np.full(5, 1.0), np.full(5, 100.0)).all()


def test_calibration_survives_its_file_and_damage_is_seen():
    assert Calibration.from_json(KNOWN.to_json()) == KNOWN
    values = json.loads(KNOWN.to_json())
    for damage in ({"schema": 99}, {"fill": -1.0}, {"fill": float("nan")}, {"fill": "fast"}, {"more": 1}, {"device": 3},
                   {"threads": 0}):
        assert Calibration.from_json(json.dumps({**values, **damage})) is None
    del values["upload"]
    for text in (json.dumps(values), "", "[]", "{", "\0"):
        assert Calibration.from_json(text) is None


def test_the_gpu_is_chosen_only_where_it_was_measured_faster():
    assert not choose_tracer(None, 4).gpu and "not measured" in choose_tracer(None, 4).why
    assert choose_tracer(KNOWN, 4).gpu and not choose_tracer(KNOWN, 4).left_out
    assert not choose_tracer(KNOWN, 400).gpu  # many cores outdo it
    slow = choose_tracer(replace(KNOWN, occluded_rays=4e5, embree_rays=9.8e6, device="llvmpipe"), 4)
    assert not slow.gpu and slow.why == "Embree: 9.8 Mray/s here, the GPU 0.4 Mray/s (llvmpipe), left out"
    assert slow.left_out == "it traces 0.4 Mray/s here (llvmpipe) and Embree 9.8 Mray/s"


def test_names_of_drivers_are_told_short():
    for long, short in (("NVIDIA H200/PCIe/SSE2, OPENGL", "NVIDIA H200"), ("llvmpipe", "llvmpipe"),
                        ("llvmpipe (LLVM 22.1.8, 256 bits), VULKAN", "llvmpipe"),
                        ("AMD Radeon RX 6800 (radeonsi, navi21), OPENGL", "AMD Radeon RX 6800")):
        assert short_name(long) == short


def test_rays_that_lead_nowhere_are_refused():
    good = np.ones((3, 3), np.float32)
    check_rays(good, good)
    for bad in (0.0, np.nan, np.inf):
        directions = good.copy()
        directions[1] = bad
        with pytest.raises(PRTError, match="1 directions"):
            check_rays(good, directions)
    origins = good.copy()
    origins[2, 1] = np.nan
    with pytest.raises(PRTError, match="1 rays"):
        check_rays(origins, good)


def test_bits_of_answers():
    bits = np.random.default_rng(0).integers(0, 2, (2, 64))
    numbers = (bits.reshape(2, 4, 16) << np.arange(16)).sum(axis=2).astype(np.float32)
    assert np.array_equal(bits_of(numbers), bits.ravel().astype(bool))
    assert np.array_equal(texels_of_bits(bits.ravel().astype(bool)).ravel(), numbers.ravel())
