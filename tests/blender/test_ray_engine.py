# SPDX-License-Identifier: GPL-3.0-or-later
"""Rays on the GPU through Blender's own module, against Embree on the same rays. With a software driver too."""

from __future__ import annotations

import threading
from pathlib import Path

import bpy
import numpy as np
import pytest

from tests.blender import gpu_support  # makes the checkout the package `prt`

# isort: split
from prt.prt_addon.errors import PRTError
from prt.prt_addon.scene.texel_surface import TracedSurface
from prt.prt_addon.tracing.mixed_tracer import LEAST_RAYS, MixedTracer
from prt.prt_addon.tracing.ray_calibration import ball_field, calibrate, field_rays
from prt.prt_addon.tracing.ray_cost import choose_tracer
from prt.prt_addon.tracing.ray_engine import MOST_TRIANGLES, RayEngine
from prt.prt_addon.tracing.tracer import Tracer

# What single precision leaves of a distance in a scene of unit diagonal, away from grazing.
DISTANCE = 2e-6


@pytest.fixture(scope="module")
def device():
    gpu_support.require_gpu()
    from prt.gpu_shaders import programs
    from prt.gpu_shaders.ray_device import BlenderDevice
    yield BlenderDevice()
    programs.release()


def closed_room(cells: int = 6) -> tuple[np.ndarray, np.ndarray]:
    """A box whose walls share all their points, every wall of cells x cells quads, along the axes."""
    ticks = np.linspace(-0.5, 0.5, cells + 1) / np.sqrt(3.0)
    grid = np.stack(np.meshgrid(ticks, ticks, ticks, indexing="ij"), axis=-1).reshape(-1, 3)
    number = np.arange(len(grid)).reshape((cells + 1,) * 3)
    triangles = []
    for axis in range(3):
        for wall in (np.take(number, 0, axis=axis), np.take(number, cells, axis=axis)):
            a, b, c, d = (wall[:-1, :-1], wall[1:, :-1], wall[1:, 1:], wall[:-1, 1:])
            triangles += [np.stack([x.ravel() for x in t], axis=1) for t in ((a, b, c), (a, c, d))]
    return grid.astype(np.float32), np.concatenate(triangles).astype(np.int32)


def pair(device, points: np.ndarray, triangles: np.ndarray) -> tuple[RayEngine, Tracer, np.ndarray]:
    """The engine and Embree over the same corners."""
    tracer = Tracer(points.astype(np.float64), triangles, 1)
    points = tracer.to_tracing_space(points)
    return RayEngine(device, points, triangles), tracer, points


def sphere_rays(count: int, seed: int, inside: float = 0.25) -> tuple[np.ndarray, np.ndarray]:
    generator = np.random.default_rng(seed)
    directions = generator.normal(size=(count, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return generator.uniform(-inside, inside, (count, 3)).astype(np.float32), directions.astype(np.float32)


def assert_agree(ours, theirs, different: int = 0) -> None:
    """The same triangles but for a few neighbours at the same distance; distances, weights and sides alike."""
    assert np.array_equal(ours.triangle >= 0, theirs.triangle >= 0)
    hit = ours.triangle >= 0
    assert (ours.triangle != theirs.triangle).sum() <= different
    assert np.abs(ours.distance - theirs.distance)[hit].max(initial=0.0) < DISTANCE
    same = hit & (ours.triangle == theirs.triangle)
    assert np.array_equal(ours.front[same], theirs.front[same])
    assert np.abs(ours.u - theirs.u)[same].max(initial=0.0) < 5e-4
    assert np.abs(ours.v - theirs.v)[same].max(initial=0.0) < 5e-4


@pytest.mark.parametrize("kernel", ["traversal", "cells"])
def test_a_closed_room_has_no_leaks_and_the_hits_are_embrees(device, kernel):
    engine, tracer, _ = pair(device, *closed_room())
    origins, directions = sphere_rays(6000, 1)
    ours = engine.nearest(origins, directions) if kernel == "traversal" else engine.cells_nearest(
        origins, directions, 128, 16)
    assert (ours.triangle >= 0).all()
    assert_agree(ours, tracer.nearest(origins, directions), 1)
    assert engine.occluded(origins, directions).all()


@pytest.mark.parametrize("kernel", ["traversal", "cells"])
def test_small_triangles_as_embree(device, kernel):
    engine, tracer, _ = pair(device, *ball_field())
    origins, directions = sphere_rays(3000, 2, 0.5)
    ours = engine.nearest(origins, directions) if kernel == "traversal" else engine.cells_nearest(
        origins, directions, 64, 16)
    theirs = tracer.nearest(origins, directions)
    assert 0.2 < (theirs.triangle >= 0).mean() < 0.95
    assert_agree(ours, theirs, 2)
    assert np.array_equal(engine.occluded(origins, directions), theirs.triangle >= 0)


def test_one_direction_for_all_and_a_reach(device):
    engine, tracer, points = pair(device, *ball_field())
    origins, directions = field_rays(points)
    origins, reach = origins[:5000], np.random.default_rng(1).uniform(0.0, 0.5, 5000).astype(np.float32)
    for direction in (directions[:1], np.float32([[0.0, 0.0, 1.0]]), np.float32([[0.0, -2.0, 0.0]])):
        assert_agree(engine.nearest(origins, direction), tracer.nearest(origins, direction), 2)
        assert (engine.occluded(origins, direction, reach) != tracer.occluded(origins, direction, reach)).sum() <= 1


def test_rays_along_axes_through_edges_and_corners_of_a_grid_do_not_pass(device):
    """The walls lie along the axes, and the rays start in planes of the grid: every one meets edges or corners."""
    engine, tracer, points = pair(device, *closed_room(8))
    inner = np.unique(np.round(points, 6))[1:-1]
    y, z = (a.ravel() for a in np.meshgrid(inner, inner))
    for axis in range(3):
        for sign in (-1.0, 1.0):
            direction = np.zeros((1, 3), np.float32)
            direction[0, axis] = sign
            origins = np.roll(np.stack([np.zeros_like(y), y, z], axis=1), axis, axis=1).astype(np.float32)
            ours = engine.nearest(origins, direction)
            assert (ours.triangle >= 0).all()
            assert np.abs(ours.distance - tracer.nearest(origins, direction).distance).max() < DISTANCE
    # And aimed at corners and middles of edges from a place that is in no plane of the grid.
    corners = points[closed_room(8)[1]]
    aims = np.concatenate([corners.reshape(-1, 3), corners.mean(axis=1), 0.5 * (corners[:, 0] + corners[:, 1]),
                           0.5 * (corners[:, 1] + corners[:, 2])])
    place = np.float32((0.03, -0.05, 0.07))
    directions = (aims - place).astype(np.float32)
    ours = engine.nearest(np.broadcast_to(place, aims.shape), directions)
    assert (ours.triangle >= 0).all() and np.abs(ours.distance - 1.0).max() < 1e-5


def test_grazing_rays_meet_a_wall_or_pass_it_as_embree_says(device):
    engine, tracer, points = pair(device, *ball_field())
    low, high = points.min(axis=0), points.max(axis=0)
    generator = np.random.default_rng(5)
    origins = generator.uniform(low, high, (4000, 3)).astype(np.float32)
    origins[:, 2] = low[2] + generator.uniform(-2e-4, 2e-4, 4000)  # in planes that touch the lowest balls
    turns = generator.uniform(0.0, 2.0 * np.pi, 4000)
    directions = np.stack([np.cos(turns), np.sin(turns), np.zeros(4000)], axis=1).astype(np.float32)
    assert (engine.occluded(origins, directions) != tracer.occluded(origins, directions)).sum() <= 2


def test_degenerate_triangles_are_never_hit_and_hide_nothing(device):
    points, triangles = closed_room(3)
    flat = np.array([[0, 0, 1], [2, 2, 2], [0, 1, 0]], np.int32)
    line = np.float32([[-0.1, 0.0, 0.0], [0.0, 0.0, 0.0], [0.1, 0.0, 0.0]])
    points, extra = np.concatenate([points, line]), np.arange(3, dtype=np.int32)[None] + len(points)
    engine, tracer, _ = pair(device, points, np.concatenate([flat, extra, triangles]))
    origins, directions = sphere_rays(3000, 4)
    directions[:500] = -origins[:500]  # many towards the line
    ours = engine.nearest(origins, directions)
    assert (ours.triangle >= 4).all()
    assert_agree(ours, tracer.nearest(origins, directions), 2)


def test_nothing_and_next_to_nothing(device):
    points = np.float32([[0, 0, 0], [1, 0, 0], [0, 1, 0]])
    empty = RayEngine(device, points, np.empty((0, 3), np.int32))
    origins, directions = sphere_rays(100, 6)
    assert (empty.nearest(origins, directions).triangle == -1).all() and not empty.occluded(origins, directions).any()
    assert (empty.cells_nearest(origins, directions, 64, 8).triangle == -1).all()
    assert len(empty.nearest(origins[:0], directions[:0]).triangle) == 0 == len(empty.occluded(origins[:0], directions))
    single, tracer, _ = pair(device, points, np.int32([[0, 1, 2]]))
    assert_agree(single.nearest(origins, directions), tracer.nearest(origins, directions))


def test_pairs_of_origins_and_directions_are_the_rays_one_by_one(device):
    engine, tracer, points = pair(device, *ball_field())
    origins, directions = field_rays(points)
    origins, directions = origins[:900], directions[:7]
    asked = np.random.default_rng(3).random((7, 900)) < 0.6
    codes = np.flatnonzero(asked)
    which, row, theirs = tracer.nearest_where(origins, directions, asked)
    assert np.array_equal(which * 900 + row, codes)
    assert_agree(engine.nearest_pairs(origins, directions, codes), theirs, 2)
    hit = tracer.occluded_where(origins, directions, asked)
    assert not hit[~asked].any() and np.array_equal(hit[asked], theirs.triangle >= 0)
    assert np.array_equal(engine.occluded_where(origins, directions, asked), hit)
    assert not engine.occluded_where(origins, directions, np.zeros_like(asked)).any()
    assert len(engine.nearest_pairs(origins, directions, codes[:0]).triangle) == 0
    with pytest.raises(ValueError, match="too many"):
        engine.nearest_pairs(np.zeros((1 << 16, 3), np.float32), np.ones((1 << 9, 3), np.float32), codes)


def test_bad_rays_and_scenes_are_refused(device):
    engine, _, _ = pair(device, *closed_room(2))
    origins, directions = sphere_rays(10, 7)
    for value in (0.0, np.nan):
        bad = directions.copy()
        bad[3] = value
        for ask in (engine.nearest, engine.occluded, lambda o, d: engine.cells_nearest(o, d, 64, 8)):
            with pytest.raises(PRTError, match="directions"):
                ask(origins, bad)
    with pytest.raises(PRTError, match="textures hold"):
        RayEngine(device, np.zeros((3, 3), np.float32), np.broadcast_to(np.int32([[0, 1, 2]]), (MOST_TRIANGLES + 1, 3)))
    missing = closed_room(2)[0].copy()
    missing[0] = np.nan
    leaky = RayEngine(device, missing, closed_room(2)[1])  # what has no corner is left out, the rest stays
    assert (leaky.nearest(origins, directions).triangle >= 0).mean() > 0.5


def test_slices_are_short_and_their_number_does_not_count(device):
    engine, tracer, _ = pair(device, *ball_field())
    origins, directions = sphere_rays(60_000, 8, 0.5)
    steps, seen = engine.occluded_steps(origins, directions), []
    while True:
        try:
            seen.append(next(steps))
        except StopIteration as end:
            answers = end.value
            break
    assert len(seen) > 2 and seen[-1] == 60_000 and (np.diff(seen) > 0).all()
    assert (answers != tracer.occluded(origins, directions)).sum() <= 2
    # Windows ends a driver after two seconds. On busy cores without a GPU, too; docs/ray_engine.md has what was measured.
    assert engine.record.longest < 2.0 and engine.record.seconds / engine.record.count < 0.25


def test_both_sides_share_the_work_and_keep_its_order(device):
    points, triangles = ball_field()
    mixed, alone = MixedTracer(points, triangles, 1, device), Tracer(points, triangles, 1)
    origins, directions = field_rays(points)
    origins = alone.to_tracing_space(origins)
    wheres = []

    def work(k: int) -> np.ndarray:
        wheres.append(threading.get_ident())
        return mixed.occluded_where(origins[4096 * k:4096 * (k + 1)], directions[:1], np.ones((1, 4096), bool))[0]
    found = list(mixed.map_in_order(work, range(8)))
    assert [k for k, _ in found] == list(range(8))
    assert (np.concatenate([hit for _, hit in found]) != alone.occluded(origins, directions[:1])).sum() <= 2
    assert len(set(wheres)) == 2 and 0 < mixed.gpu_rays < len(origins)
    assert mixed.gpu_rays == 4096 * wheres.count(threading.get_ident())
    known = mixed.gpu_rays
    few = np.ones((1, LEAST_RAYS - 1), bool)
    mixed.occluded_where(origins[:LEAST_RAYS - 1], directions[:1], few)  # not worth a dispatch
    mixed.nearest(origins, directions[:1])  # sent one by one Embree is faster
    assert mixed.gpu_rays == known and mixed.facts["gpu_rays"] == known
    which, row, hits = mixed.nearest_where(origins[:3000], directions[:2], np.ones((2, 3000), bool))
    assert mixed.gpu_rays == known + 6000 and np.array_equal(which * 3000 + row, np.arange(6000))
    assert_agree(hits, alone.nearest(origins[row], directions[which]), 2)
    closed = mixed.map_in_order(work, range(1000))
    next(closed)
    before = len(wheres)
    closed.close()
    assert len(wheres) <= before + 8


def test_hits_on_texels_are_named_as_embrees(device):
    """Triangles of the traced surface that stand for others of the scene (prt_addon/scene/texel_surface.py)."""
    points, triangles = ball_field()
    surface = TracedSurface(points.astype(np.float64), triangles, np.array([0, len(triangles)]),
                            np.array([100, len(triangles) + 100]), (None,))
    mixed, alone = MixedTracer(points, triangles, 1, device, surface), Tracer(points, triangles, 1, surface)
    origins, directions = field_rays(points)
    asked = np.ones((2, 2000), bool)
    *_, ours = mixed.nearest_where(alone.to_tracing_space(origins[:2000]), directions[:2], asked)
    *_, theirs = alone.nearest_where(alone.to_tracing_space(origins[:2000]), directions[:2], asked)
    assert mixed.gpu_rays == 4000 and ours.traced is not None and theirs.triangle.max() >= 100
    assert_agree(ours, theirs, 2)
    assert (ours.traced[0] != theirs.traced[0]).sum() <= 2


def test_errors_of_work_come_out(device):
    points, triangles = ball_field()
    mixed = MixedTracer(points, triangles, 1, device)

    def work(k: int) -> int:
        if k == 5:
            raise ZeroDivisionError
        return k
    done = []
    with pytest.raises(ZeroDivisionError):
        done += [k for k, _ in mixed.map_in_order(work, range(20))]


def test_this_machine_measures_itself_and_chooses(device):
    tracer = Tracer(*ball_field(), 1)

    def embree(_points, _triangles):
        return lambda origins, directions: tracer.occluded_where(
            tracer.to_tracing_space(origins), directions, np.ones((len(directions), len(origins)), bool))
    known = calibrate(device, embree, 1)
    assert known.device == device.name and min(known.fill, known.readback, known.upload, known.latency) > 0.0
    if "llvmpipe" in device.name:  # a software driver is no GPU
        choice = choose_tracer(known, 1)
        assert not choice.gpu and "llvmpipe" in choice.why and "left out" in choice.why
        assert known.embree_rays > 2.0 * known.occluded_rays


def small_scene() -> None:
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.ops.mesh.primitive_plane_add(size=4.0)
    bpy.ops.mesh.primitive_uv_sphere_add(segments=96, ring_count=48, radius=0.8, location=(0.0, 0.0, 0.9))


def test_a_bake_traced_on_the_gpu_is_the_bake_of_embree(device, tmp_path: Path, monkeypatch):
    """The whole way: a stored measurement that favours the GPU, and a child Blender that bakes with it."""
    from prt.operators import tracing_choice
    from prt.operators.bake_session import BakeSession
    from prt.prt_addon.baking.process import raise_error
    from prt.prt_addon.baking.settings import BakeSettings

    monkeypatch.setattr(tracing_choice, "calibration_file", lambda: tmp_path / "ray_engine.json")
    monkeypatch.setattr("prt.operators.bake_session.jobs_folder", lambda: tmp_path / "jobs")
    settings = BakeSettings(order=3, directions=64, gather_directions=32, bounces=1, clusters=1, vectors=4, threads=1,
                            error_receivers=0, spacing=0.0)
    found = {}
    for gpu_rays in (1.0, 1e12):
        (tmp_path / "ray_engine.json").write_text(made_up(gpu_rays).to_json())
        small_scene()
        session = BakeSession.start(bpy.context.evaluated_depsgraph_get(), settings, None)
        assert isinstance(session.process, tracing_choice.TracingProcess) == (gpu_rays > 1.0)
        for message in session.process.wait():
            if message["type"] == "error":
                raise_error(message)
        found[gpu_rays] = session.store(), np.load(session.job / "direct.npz")["transfer"]
        session.discard()
        session.close()
    (embree, theirs), (mixed, ours) = found.values()
    assert embree.report["tracer"]["name"] == "Embree" and mixed.report["tracer"]["gpu_rays"] > 0
    assert any(item["what"] == tracing_choice.WHAT for item in embree.report["left_out"])
    assert not any(item["what"] == tracing_choice.WHAT for item in mixed.report["left_out"])
    # A ray that meets a silhouette's edge differently moves one receiver by less than a tenth.
    assert theirs.shape == ours.shape and len(theirs) > 4000
    assert np.sqrt(np.mean((theirs - ours) ** 2)) < 1e-4 * np.sqrt(np.mean(theirs ** 2))
    assert (np.abs(theirs - ours).max(axis=1) > 1e-5).mean() < 1e-3


def made_up(gpu_rays: float):
    from prt.prt_addon.tracing.ray_cost import Calibration
    return Calibration("a driver", 1e9, 1e9, 1e9, 1e-4, 1e-7, 1e8, gpu_rays, gpu_rays, 1e7, 1)


def test_a_driver_that_falls_is_not_asked_again(tmp_path: Path, monkeypatch):
    from prt.operators import tracing_choice
    monkeypatch.setattr(tracing_choice, "calibration_file", lambda: tmp_path / "ray_engine.json")
    (tmp_path / "ray_engine.json").write_text(made_up(1e12).to_json())
    job = tmp_path / "job"
    job.mkdir()
    process = tracing_choice.TracingProcess(["false"], job)
    process.start()
    messages = list(process.wait())
    assert messages[-1]["type"] == "error" and "Embree alone" in messages[-1]["remedy"]
    assert not tracing_choice.tracing_choice().gpu
