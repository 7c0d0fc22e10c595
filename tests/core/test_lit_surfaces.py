# SPDX-License-Identifier: GPL-3.0-or-later
"""Local light in columns of lit surfaces: against closed forms, our own solution at the very place, and paths."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from prt_addon.baking.job import write_job
from prt_addon.baking.recipe import _Bake, bake, exhaust, transport_settings
from prt_addon.baking.settings import BakeSettings
from prt_addon.errors import StorageError
from prt_addon.lighting.lit_surfaces import LitSurfaces, lit_elements, make_patches, triangle_areas
from prt_addon.lighting.local_lights import LocalLight
from prt_addon.relighting.exit_radiance import cluster_constants, exit_radiance
from prt_addon.relighting.lamp_light import SurfaceLamps, lamps_in
from prt_addon.relighting.scene_light import joined_light
from prt_addon.relighting.surface_light import SurfaceLight
from prt_addon.scene.scene_mesh import SceneMesh
from prt_addon.storage.columns import Columns, read_columns, surfaces_entry
from prt_addon.storage.container import flatten_cloud, read_cloud
from prt_addon.tracing.tracer import Tracer
from prt_addon.transport.local_lights import LightSolver
from tests.core.shapes import box, make
from tests.core.test_local_bakes import LOCAL, lamp, room, stopped_and_resumed

SURFACES = replace(LOCAL, lamp_basis="surfaces", surface_patches=600, surface_columns=256, cloud_lights=48)


class Kept(_Bake):
    """A bake that keeps its operator and its transfer before compression."""

    def _local(self, gathered, visibility):
        self.kept_gather = gathered
        self.kept = yield from super()._local(gathered, visibility)
        return self.kept


def run(scene: SceneMesh, settings: BakeSettings) -> tuple[Kept, object]:
    process = Kept(scene, transport_settings(settings), None, None, {}, np.empty((0, 4, 4)))
    return process, exhaust(process.run())


@pytest.fixture(scope="module")
def baked():
    return run(room(), SURFACES)


@pytest.fixture(scope="module")
def walled():
    return run(room(wall=True), replace(SURFACES, error_receivers=0))


def drawn(container, lamps, tracer):
    """Unit-albedo bounced radiance (p, 3) as it is drawn."""
    light = joined_light(container.lighting_basis, None, lamps_in(container.cloud, tracer).step(lamps).values)
    return exit_radiance(container.cluster, container.weights,
                         cluster_constants(container.bases, light, container.cluster_zone))[:, 0]


def solved(process: Kept, position) -> np.ndarray:
    """Our own solution (p, 3) for a point of 1 W/sr at the very place."""
    gathered, count = process.kept_gather, len(process.scene.points)
    albedo = np.ascontiguousarray(process.albedo[gathered.receivers.key % count][:, :process.plan.needs.channels])
    solver = LightSolver(process.tracer, process.scene, gathered, albedo, 1e-4, -1)
    result = np.zeros((count, 3))
    front = gathered.receivers.key < count

    def take(_, response):
        result[gathered.receivers.key[front]] = response[front][:, 0]

    exhaust(solver.solve(np.array([position], float), take))
    return result[process.targets[0].points]


def relative(a, b):
    return float(np.sqrt(np.sum(np.square(a - b)) / np.sum(np.square(b))))


@pytest.mark.parametrize("position", [(0.5, 0.5, 0.5), (0.2, 0.7, 0.4), (0.85, 0.85, 0.8), (0.5, 0.5, 0.08),
                                      (0.06, 0.5, 0.3), (0.04, 0.05, 0.06)])
def test_bounced_light_is_our_own_solution_in_the_open_and_near_to_walls(baked, position):
    process, result = baked
    light = drawn(result.objects["room"], [lamp(position)], process.tracer)
    # The last stands within a vertex's distance of three walls.
    assert relative(light, solved(process, position)) < (0.15 if max(position) < 0.1 else 0.08)


def test_behind_a_wall_it_is_dark_and_a_slit_lets_through_what_it_should(walled):
    process, result = walled
    container = result.objects["room"]
    position = (0.46, 0.5, 0.5)
    light = drawn(container, [lamp(position)], process.tracer)
    beyond, here = container.positions[:, 0] > 0.56, container.positions[:, 0] < 0.44
    # What is left seeps under the wall: the floor's vertices below it belong to both sides.
    assert light[beyond].mean() < 0.04 * light[here].mean()
    # A wall that ends at half of the room's depth: the lamp's light reaches the other side around its end.
    half = make("wall", [(0.5, 0, 0), (0.5, 0.5, 0), (0.5, 0.5, 1), (0.5, 0, 1)], [(0, 1, 2), (0, 2, 3)],
                albedo=(0.6, 0.6, 0.6), target=False)
    scene = SceneMesh.assemble([box("room", inward=True, albedo=(0.7, 0.5, 0.3)), half], 0.06,
                               np.array([[0.25, 0.2, 0.5]]))
    process, result = run(scene, replace(SURFACES, error_receivers=0))
    light = drawn(result.objects["room"], [lamp((0.25, 0.2, 0.5))], process.tracer)
    assert relative(light, solved(process, (0.25, 0.2, 0.5))) < 0.08


def test_patches_never_reach_through_a_wall(walled):
    surfaces = walled[1].objects["room"].cloud
    side = np.sign(surfaces.corners.mean(axis=1)[:, 0] - 0.5)
    flat = np.abs(surfaces.corners[:, :, 0] - 0.5).max(axis=1) < 1e-5
    clear = np.abs(surfaces.corners[:, :, 0] - 0.5) > 1e-4  # vertices under the wall belong to both sides
    patches = [set(surfaces.patch[(~flat & (side == s))[:, None] & clear].tolist()) - {-1} for s in (-1, 1)]
    assert len(patches[0]) > 50 and not patches[0] & patches[1]


def test_spots_shine_where_they_look_and_areas_too(baked):
    """Towards a red wall the room gets red light from it; a light cloud of order 2 hardly knows where a spot looks."""
    process, result = baked
    container = result.objects["room"]
    down = np.eye(4)
    down[:3, 3] = (0.5, 0.5, 0.6)
    for found in (LocalLight("spot", "spot", down, np.full(3, 4 * np.pi), spot_angle=0.7),
                  LocalLight("area", "area", down, np.full(3, 4 * np.pi), size=(0.1, 0.2), spread=0.7)):
        light = drawn(container, [found], process.tracer)[:, 0]
        floor, ceiling = container.positions[:, 2] < 1e-4, container.positions[:, 2] > 1 - 1e-4
        assert light[ceiling].mean() > 1.3 * light[floor].mean()  # the lit spot on the floor shines up


def test_lamps_add_up_from_a_microwatt_to_a_gigawatt_and_nothing_else_is_needed(baked):
    process, result = baked
    container, tracer = result.objects["room"], process.tracer
    one, other = lamp((0.3, 0.3, 0.4)), lamp((0.7, 0.6, 0.5), name="other")
    apart = drawn(container, [one], tracer) + drawn(container, [other], tracer)
    assert np.allclose(drawn(container, [one, other], tracer), apart, rtol=1e-4, atol=1e-5)
    for watts in (1e-6, 1e9):
        scaled = drawn(container, [lamp((0.3, 0.3, 0.4), watts)], tracer)
        assert np.allclose(scaled, drawn(container, [one], tracer) * (watts / (4 * np.pi)), rtol=1e-4,
                           atol=1e-12 * watts)
    for place in ((50.0, 0.0, 0.0), (1e6, 1e6, 1e6), (0.5, 0.5, 0.0), (0.0, 0.0, 0.0), (0.5, 0.5, 1e-9)):
        assert np.isfinite(drawn(container, [lamp(place)], tracer)).all()
    assert not drawn(container, [], tracer).any()
    assert np.isfinite(SurfaceLamps(container.cloud, tracer).step([lamp((0.5, 0.5, 0.5), 1e300)]).values).all()


def test_a_lamp_that_stays_costs_no_rays(baked):
    process, result = baked
    lamps, tracer = SurfaceLamps(result.objects["room"].cloud, process.tracer), process.tracer
    first = lamps.step([lamp((0.3, 0.3, 0.4)), lamp((0.7, 0.6, 0.5), name="b")])
    before = tracer.rays
    brighter = lamps.step([lamp((0.3, 0.3, 0.4), 8 * np.pi), lamp((0.7, 0.6, 0.5), 8 * np.pi, name="b")])
    assert tracer.rays == before and np.allclose(brighter.values, 2.0 * first.values, rtol=1e-5)
    assert not first.outside and not first.unlit and first.settled


@pytest.mark.parametrize("height", [0.5, 0.05, 5e-3])
def test_the_flux_of_a_lamp_over_a_floor_is_half_of_what_it_emits(height):
    """However near it is to triangles of half a metre: the solid angle of the square floor."""
    size = 2.0
    cuts = np.linspace(-size, size, 9)
    x, y = np.meshgrid(cuts, cuts, indexing="ij")
    points = np.stack([x.ravel(), y.ravel(), np.zeros(81)], axis=1)
    first = (np.arange(8)[:, None] * 9 + np.arange(8)).ravel()
    quads = np.stack([first, first + 9, first + 10, first + 1], axis=1)
    triangles = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    corners = points[triangles]
    patch = np.repeat(np.arange(len(triangles))[:, None], 3, axis=1).astype(np.int32)
    # Seen from above its middle, the square is 4 asin(...) (four right triangles' corners).
    light = SurfaceLight(LitSurfaces(corners.astype(np.float32), patch, np.zeros((1, len(triangles)), np.float32)),
                         Tracer(points, triangles.astype(np.int32), 1))
    found = light.patches(lamp((0.0, 0.0, height)))
    flux = np.pi * np.sum(found * triangle_areas(corners))
    exact = 4.0 * np.arcsin(size ** 2 / (size ** 2 + height ** 2))
    assert flux == pytest.approx(exact, rel=0.02)


def test_patches_have_like_moments_and_points_without_area_none():
    generator = np.random.default_rng(0)
    points = generator.uniform(size=(2000, 3)) * (4.0, 1.0, 0.0)
    areas = np.where(np.arange(2000) % 10 == 0, 0.0, 1.0)
    patch = make_patches(points, np.tile([0.0, 0.0, 1.0], (2000, 1)), areas, 4.0, 100)
    assert (patch[areas == 0] == -1).all() and set(patch[areas > 0]) == set(range(100))
    extent = np.array([np.ptp(points[patch == k], axis=0).max() for k in range(100)])
    assert extent.max() < 0.6  # even squares have sides of 0.2
    same = make_patches(np.zeros((50, 3)), np.zeros((50, 3)), np.ones(50), 1.0, 8)
    assert set(same) == {0}  # nothing to tell them apart by


def test_drawn_triangles_stand_for_all_of_the_surface():
    generator = np.random.default_rng(1)
    corners = generator.uniform(size=(5000, 1, 3)) + 0.02 * generator.normal(size=(5000, 3, 3))
    patch = np.repeat(generator.integers(0, 40, 5000)[:, None], 3, axis=1).astype(np.int32)
    some, of = lit_elements(corners, patch, 800, 3)
    assert len(some) <= 800 and triangle_areas(some).sum() == pytest.approx(triangle_areas(corners).sum(), rel=0.02)
    whole = np.bincount(patch[:, 0], triangle_areas(corners))
    assert np.allclose(np.bincount(of[:, 0], triangle_areas(some)), whole, rtol=0.25)
    every, _ = lit_elements(corners, patch, 5000, 3)
    assert np.allclose(every, corners, atol=1e-6)


def test_the_report_tells_of_the_surfaces_and_of_the_error(baked):
    _, result = baked
    local, errors = result.report["local"], result.report["errors"]
    assert local["basis"] == "surfaces" and 0 < local["columns"] <= 256 and local["patches"] >= 500
    assert 0.0 <= local["left"] < 0.1
    assert errors["total"]["relative_rms"] < 0.08 and "bounced light of lamps" in result.report["headline"]
    assert result.objects["room"].lighting_basis == Columns(0, local["columns"])


def test_a_job_resumes_and_stored_surfaces_are_the_same(tmp_path):
    settings = replace(SURFACES, error_receivers=0, cloud_lights=12, surface_patches=120, surface_columns=40)
    found = stopped_and_resumed(write_job(tmp_path, room(), settings))
    direct = exhaust(bake(room(), settings)).objects["room"]
    assert np.array_equal(found.bases, direct.bases) and np.array_equal(found.cloud.axes, direct.cloud.axes)
    assert np.array_equal(found.cloud.corners, direct.cloud.corners)
    assert np.array_equal(found.cloud.patch, direct.cloud.patch)


def test_a_scene_without_bounces_has_dark_columns():
    settings = replace(SURFACES, bounces=0, error_receivers=0)
    container = exhaust(bake(room(), settings)).objects["room"]
    scene = room()
    assert not drawn(container, [lamp((0.5, 0.5, 0.5))], Tracer(scene.points, scene.triangles, 1)).any()


@pytest.mark.parametrize("change", [{"columns": 7}, {"patches": 0}, {"triangles": -1}, {"cluster_zone": [0, 1]}])
def test_contradicting_headers_are_refused(change):
    entry = surfaces_entry(Columns(0, 4), 2, 3, 2)
    header = {"shape": [2, 3, 1, 4, 1], "columns": entry}
    assert read_columns(header, "Cube", "Bake again") == Columns(0, 4)
    header["columns"] = entry | change
    with pytest.raises(StorageError):
        read_columns(header, "Cube", "Bake again")


def test_broken_numbers_are_refused():
    surfaces = LitSurfaces(np.ones((2, 3, 3), np.float32), np.array([[0, 1, 2], [0, 1, -1]], np.int32),
                           np.ones((4, 3), np.float32))
    header = {"columns": surfaces_entry(Columns(0, 4), 2, 3, 2)}
    flat = flatten_cloud(surfaces)
    found = read_cloud(header, flat, "Cube")
    assert np.array_equal(found.patch, surfaces.patch) and np.array_equal(found.axes, surfaces.axes)
    for broken in (None, flat[:-1], np.where(np.arange(len(flat)) == 0, np.nan, flat),
                   np.where(np.arange(len(flat)) == 18, 9.0, flat)):
        with pytest.raises(StorageError):
            read_cloud(header, broken, "Cube")


@pytest.mark.parametrize("place", [(0.5, 0.5, 0.0), (0.37, 0.41, 1e-9), (0.0, 0.0, 0.0)])
def test_a_lamp_that_touches_walls_shines_on_them(baked, place):
    """As bright as a little off them: a touching lamp is no dark one."""
    process, result = baked
    container, tracer = result.objects["room"], process.tracer
    touching = drawn(container, [lamp(place)], tracer).mean()
    inward = np.where(np.array(place) < 0.2, 0.004, 0.0)
    near = drawn(container, [lamp(place + inward)], tracer).mean()
    # In a corner all its light falls within one vertex's reach.
    assert touching == pytest.approx(near, rel=0.3 if not any(place) else 0.15)
