# SPDX-License-Identifier: GPL-3.0-or-later
"""Edits of albedo and emission from a bake's kept form factors, against fresh bakes and closed forms."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import sparse

from prt_addon.baking.job import claim_job, read_result, run_job
from prt_addon.baking.recipe import bake, exhaust
from prt_addon.baking.settings import make_settings
from prt_addon.errors import BadScene
from prt_addon.relighting.exit_radiance import baked_constants, exit_radiance
from prt_addon.relighting.glowing_surfaces import glow_of
from prt_addon.relighting.material_edits import TOLERANCE, MaterialEdits
from prt_addon.relighting.source_irradiance import polygon_irradiance
from prt_addon.scene.scene_mesh import SceneMesh
from prt_addon.tracing.tracer import Tracer
from prt_addon.transport.live_operator import LiveOperator, in_order_of_points, sampled_rows, sampling_error
from tests.core.shapes import box, join, plane, sphere

BEFORE, AFTER = (0.2, 0.2, 0.2), (0.9, 0.2, 0.1)
SETTINGS = replace(make_settings("standard"), live_editing=True, error_receivers=0, clusters=64)


def still_life(floor):
    # Nothing touches: what counts as buried below a contact depends on the light there.
    meshes = [plane("floor", 4.0, cells=16, albedo=floor), box("block", (-0.5, -0.5, 0.1), (0.5, 0.5, 1.0),
                                                               albedo=(0.6, 0.6, 0.6)),
              sphere("ball", 0.5, (1.1, 0.0, 0.6), albedo=(0.7, 0.5, 0.3))]
    return SceneMesh.assemble(meshes, 1 / 24, split_slots=True)


def light():
    coefficients = np.zeros((25, 3))
    coefficients[0], coefficients[2], coefficients[3], coefficients[6] = 3.0, (1.0, 1.5, 2.0), 0.7, -0.5
    return coefficients


def rows_of(result):
    """The diffuse row (points, 3) of all objects."""
    return np.concatenate([exit_radiance(o.cluster, o.weights, baked_constants(o, light()))[:, 0]
                           for o in result.objects.values()])


def rms(values):
    return float(np.sqrt(np.mean(np.square(values))))


@pytest.fixture(scope="module")
def baked():
    return exhaust(bake(still_life(BEFORE), SETTINGS))


def test_another_albedo_gives_what_a_fresh_bake_gives(baked):
    before, fresh = rows_of(baked), rows_of(exhaust(bake(still_life(AFTER), SETTINGS)))
    edits = MaterialEdits(baked.objects["floor"].live)
    arriving = edits.arriving(before)
    change = np.zeros_like(arriving)
    change[:len(baked.objects["floor"].positions)] = np.subtract(AFTER, BEFORE)
    added, solution = edits.added(change, np.zeros_like(arriving), arriving)
    found = before + added[:len(before)]
    assert rms(before - fresh) > 0.05 * rms(fresh)  # the edit is to be seen
    assert rms(found - fresh) < 0.005 * rms(fresh)
    assert np.percentile(np.abs(found - fresh), 99) < 0.01 * fresh.max()
    assert solution.residual <= TOLERANCE
    # And back: what is asked again starts from the last answer, and nothing is left of the edit.
    back, _ = edits.added(np.zeros_like(change), np.zeros_like(arriving), arriving)
    assert np.abs(back).max() == 0.0


def test_no_edit_changes_nothing_and_costs_nothing(baked):
    edits = MaterialEdits(baked.objects["floor"].live)
    arriving = edits.arriving(rows_of(baked))
    added, solution = edits.added(np.zeros_like(arriving), np.zeros_like(arriving), arriving)
    assert not added.any()
    assert solution.iterations == 0


def test_a_glowing_surface_lights_the_others_by_their_form_factors(baked):
    """A glowing ball over a dark floor: the irradiance of a sphere, E = pi L (R / d)^2 cos."""
    live = baked.objects["floor"].live
    dark = LiveOperator(live.matrix, np.zeros_like(live.albedo), live.share)
    edits = MaterialEdits(dark)
    floor, block, ball = (len(o.positions) for o in baked.objects.values())
    emission = np.zeros_like(live.albedo)
    emission[floor + block:floor + block + ball] = 2.0
    added, _ = edits.added(np.zeros_like(emission), emission, np.zeros_like(emission))
    place = baked.objects["floor"].positions
    away = np.array((1.1, 0.0, 0.6)) - place
    distance = np.linalg.norm(away, axis=1)
    expected = 2.0 * (0.5 / distance) ** 2 * away[:, 2] / distance
    near = (distance < 1.2) & (place[:, 0] > 0.7)  # where the block hides nothing of it
    assert near.sum() > 20
    assert rms(added[:floor][near] / expected[near, None] - 1.0) < 0.05


def test_traced_glow_is_lamberts_formula_and_casts_shadows():
    """A square panel over a floor, from both of its sides, and a plate that hides it from half of the floor."""
    floor, panel = plane("floor", 4.0, cells=24), plane("panel", 0.6, height=1.2, cells=4, up=False)
    open_scene = Tracer(np.concatenate([floor.positions, panel.positions]), np.concatenate(
        [floor.triangles, panel.triangles + len(floor.positions)]), 1)
    normals = np.tile((0.0, 0.0, 1.0), (len(floor.positions), 1))
    corners = panel.positions[panel.triangles]
    found = glow_of(open_scene, floor.positions, normals, floor.triangles, corners)
    square = np.array([(-0.3, -0.3), (0.3, -0.3), (0.3, 0.3), (-0.3, 0.3)])
    outline = np.concatenate([square, np.full((4, 1), 1.2)], axis=1)[:, None] - floor.positions
    exact = polygon_irradiance(outline, normals) / np.pi
    assert np.abs(found - exact).max() < 0.01 * exact.max()
    turned = glow_of(open_scene, floor.positions, normals, floor.triangles, corners[:, ::-1])
    assert np.allclose(turned, found, atol=0.01 * exact.max())
    plate = plane("plate", 2.0, height=0.6, centre=(1.0, 0.0))
    meshes = (floor, panel, plate)
    starts = np.cumsum([0, *(len(mesh.positions) for mesh in meshes)])
    shaded = Tracer(np.concatenate([mesh.positions for mesh in meshes]), np.concatenate(
        [mesh.triangles + start for mesh, start in zip(meshes, starts, strict=False)]), 1)
    found = glow_of(shaded, floor.positions, normals, floor.triangles, corners)
    x, y = floor.positions[:, 0], np.abs(floor.positions[:, 1])
    assert not found[(x > 0.4) & (x < 1.6) & (y < 0.6)].any()
    lit = x < -0.4
    assert np.abs(found[lit] - exact[lit]).max() < 0.01 * exact.max()


def test_a_traced_glow_joins_the_solution():
    """A furnace whose glow arrives as form factors say gives the same either way."""
    matrix = sparse.csr_matrix(np.full((40, 40), 1.0 / 40.0, np.float32))
    edits = MaterialEdits(LiveOperator(matrix, np.full((40, 3), 0.5, np.float32), np.ones(40, np.float32)))
    ones, nothing = np.ones((40, 3), np.float32), np.zeros((40, 3), np.float32)
    known, _ = edits.added(0.3 * ones, ones, nothing, ones[:25])
    assert np.allclose(known, 5.0, rtol=TOLERANCE)


def test_furnace_after_an_edit():
    """A closed room of albedo 0.5 that glows: 1 / (1 - albedo), also after another albedo."""
    matrix = sparse.csr_matrix(np.full((40, 40), 1.0 / 40.0, np.float32))
    edits = MaterialEdits(LiveOperator(matrix, np.full((40, 3), 0.5, np.float32), np.ones(40, np.float32)))
    ones, nothing = np.ones((40, 3), np.float32), np.zeros((40, 3), np.float32)
    for albedo in (0.5, 0.8, 0.99, 0.2):
        added, _ = edits.added((albedo - 0.5) * ones, ones, nothing)
        assert np.allclose(added, 1.0 / (1.0 - albedo), rtol=TOLERANCE)


def test_albedo_is_limited_as_in_a_bake():
    matrix = sparse.identity(4, np.float32, "csr")
    edits = MaterialEdits(LiveOperator(matrix, np.full((4, 3), 0.5, np.float32), np.ones(4, np.float32)))
    added, _ = edits.added(np.full((4, 3), 0.5, np.float32), np.ones((4, 3), np.float32), np.zeros((4, 3), np.float32))
    assert np.allclose(added, 200.0, rtol=TOLERANCE)  # 1 / (1 - 0.995)
    with pytest.raises(BadScene):  # rows of more than 1, which no bake makes
        MaterialEdits(LiveOperator(2.0 * matrix, edits.operator.albedo, edits.operator.share)).added(
            np.full((4, 3), 0.5, np.float32), np.ones((4, 3), np.float32), np.zeros((4, 3), np.float32))


def test_sampled_rows_keep_sums_and_the_error_falls_with_entries(baked):
    generator = np.random.default_rng(1)
    matrix = sparse.random(400, 400, 0.5, "csr", np.float32, generator)
    smooth = (1.5 + np.sin(np.arange(400) / 40.0))[:, None].astype(np.float32)
    errors = []
    for most in (8, 32, 128):
        found = sampled_rows(matrix, most)
        assert np.diff(found.indptr).max() <= most
        assert np.allclose(found.sum(axis=1), matrix.sum(axis=1), rtol=1e-5)
        errors.append(sampling_error(matrix, found, smooth))
    assert errors[0] > errors[1] > errors[2]
    assert errors[2] < 0.01
    assert sampled_rows(matrix, 400) is matrix
    assert baked.report["live_editing"]["error"] < 0.02
    assert baked.report["live_editing"]["bytes"] == baked.objects["floor"].live.bytes


def test_order_of_points_is_that_of_the_containers():
    matrix = sparse.random(6, 6, 0.6, "csr", np.float32, np.random.default_rng(2))
    key = np.array([4, 0, 9, 2, 1, 12])  # 8 points, so that 9 and 12 are backs; point 3 is no receiver
    found, keys = in_order_of_points(matrix, key, np.array([0, 1, 2, 3]), 8)
    assert list(keys) == [0, 1, 2, 3, 4, 9, 12]
    dense = np.zeros((7, 7), np.float32)
    place = [list(keys).index(k) for k in key]
    dense[np.ix_(place, place)] = matrix.toarray()
    assert np.array_equal(found.toarray(), dense)


def test_slots_that_look_the_same_share_no_point():
    halves = join("halves", plane(cells=2, centre=(0.5, 0.0)), plane(cells=2, centre=(-0.5, 0.0)))
    positions, place = np.unique(halves.positions.round(6), axis=0, return_inverse=True)
    mesh = replace(halves, positions=positions, triangles=place[halves.triangles].astype(np.int32),
                   materials=halves.materials * 2,
                   material_index=np.repeat(np.arange(2, dtype=np.int32), len(halves.triangles) // 2))
    assert len(SceneMesh.assemble([mesh], 0.0).points) == 15
    apart = SceneMesh.assemble([mesh], 0.0, split_slots=True)
    assert len(apart.points) == 18
    first, second = (set(part.ravel()) for part in np.split(apart.triangles, 2))
    assert not first & second


def test_the_operator_survives_a_job_and_plain_bakes_have_none(tmp_path, baked):
    settings = replace(SETTINGS, directions=64, gather_directions=64)
    claim = claim_job(tmp_path, still_life(BEFORE), settings)
    for _ in run_job(claim.folder):
        pass
    stored = read_result(claim.folder)
    claim.release()
    direct = exhaust(bake(still_life(BEFORE), settings))
    entries = [o.header["live_editing"] for o in stored.objects.values()]
    assert [entry["start"] for entry in entries] == list(np.cumsum([0] + [len(o.positions) for o in
                                                                          stored.objects.values()])[:-1])
    assert len({entry["operator"] for entry in entries}) == 1
    assert [o.live is not None for o in stored.objects.values()] == [True, False, False]
    for name, values in direct.objects["floor"].live.arrays().items():
        assert np.array_equal(stored.objects["floor"].live.arrays()[name], values)
    plain = exhaust(bake(still_life(BEFORE), replace(settings, live_editing=False)))
    assert all(o.live is None and "live_editing" not in o.header for o in plain.objects.values())


@pytest.mark.parametrize(("name", "values"), [("counts", [1, 1]), ("indices", [0, 9]), ("values", [np.nan, 1.0]),
                                              ("surfaces", [0.0])])
def test_broken_arrays_are_refused(name, values):
    arrays = LiveOperator(sparse.identity(2, np.float32, "csr"), np.ones((2, 3), np.float32),
                          np.ones(2, np.float32)).arrays()
    assert LiveOperator.of_arrays(arrays).matrix.nnz == 2
    with pytest.raises(ValueError, match=r"it|number|arrays"):
        LiveOperator.of_arrays({**arrays, name: np.asarray(values * (2 if name == "counts" else 1))})
