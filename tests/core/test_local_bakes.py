# SPDX-License-Identifier: GPL-3.0-or-later
"""Bakes of local lights end to end, without Blender: against paths, in zones, resumed, in stiff and extreme cases."""

from __future__ import annotations

import numpy as np
import pytest

from prt_addon.baking.job import read_result, run_job, write_job
from prt_addon.baking.local_lights import fit_to_lamps
from prt_addon.baking.recipe import bake, exhaust
from prt_addon.baking.settings import BakeSettings, make_settings
from prt_addon.compression.groups import encode_groups
from prt_addon.compression.settings import EncoderSettings
from prt_addon.errors import BadArguments, BadScene, StorageError
from prt_addon.lighting.light_cloud import box_matrix
from prt_addon.lighting.local_lights import LocalLight
from prt_addon.relighting.exit_radiance import cluster_constants, exit_radiance, view_radiance
from prt_addon.relighting.lamp_light import DirectLight, LampLight
from prt_addon.relighting.scene_light import joined_light
from prt_addon.scene.scene_mesh import SceneMesh
from prt_addon.storage.columns import Columns, columns_entry, read_columns
from prt_addon.tracing.tracer import Tracer
from tests.core.shapes import box, make

LOCAL = BakeSettings(lighting="local", lamp_basis="cloud", cloud_lights=64, cloud_emission=1, zone_receivers=300,
                     gather_directions=512, bounce_error=1e-3, clusters=48, vectors=10, encoder="iterative",
                     compression_error=1e-3, spacing=0.06, error_receivers=24, error_paths=2048, threads=1,
                     merge_response=0.02)


def room(wall=False, albedo=(0.7, 0.5, 0.3)):
    """A closed unit room seen from inside, with or without a wall (open to both sides) at x = 0.5."""
    meshes = [box("room", inward=True, albedo=albedo)]
    if wall:
        corners = [(0.5, 0, 0), (0.5, 1, 0), (0.5, 1, 1), (0.5, 0, 1)]
        meshes.append(make("wall", corners, [(0, 1, 2), (0, 2, 3)], albedo=(0.6, 0.6, 0.6), target=False))
    return SceneMesh.assemble(meshes, 0.06, np.array([[0.4, 0.5, 0.5]]))


def lamp(position, watts=4.0 * np.pi, name="lamp"):
    matrix = np.eye(4)
    matrix[:3, 3] = position
    return LocalLight(name, "point", matrix, np.full(3, watts), key=name)


@pytest.fixture(scope="module")
def baked():
    return exhaust(bake(room(), LOCAL))


def indirect(container, tracer, *lamps):
    """Unit-albedo bounced radiance (p, 3) and what `step` told."""
    found = LampLight(container.cloud, tracer).step(lamps)
    light = joined_light(container.lighting_basis, None, found.values)
    constants = cluster_constants(container.bases, light, container.cluster_zone)
    return exit_radiance(container.cluster, container.weights, constants)[:, 0], found


def test_error_budget_and_facts(baked):
    report = baked.report
    errors = report["errors"]
    assert set(errors) == {"sampling", "basis", "compression", "total"}
    assert errors["total"]["relative_rms"] < 0.08 and errors["compression"]["relative_rms"] < 0.02
    assert errors["sampling"]["relative_rms"] < 0.05 and "bounced light of lamps" in report["headline"]
    local = report["local"]
    assert local["zones"] > 1 and local["lights"] <= 64 and max(local["merged"]) <= local["lights"]
    container = baked.objects["room"]
    assert container.lighting_basis == Columns(0, local["columns"])
    assert len(container.cluster_zone) == len(container.bases) and (np.diff(container.cluster_zone) >= 0).all()


def test_energy_of_a_closed_room(baked):
    """All that a lamp emits is absorbed: sum of A (1 - rho) E = 4 pi, E = pi (direct + bounced) for unit albedo."""
    container, scene = baked.objects["room"], room()
    tracer = Tracer(scene.points, scene.triangles, 1)
    bounced, _ = indirect(container, tracer, lamp((0.4, 0.55, 0.5)))
    direct = DirectLight(tracer, container).of([lamp((0.4, 0.55, 0.5))])[:, 0]
    corners = container.positions[container.triangles].astype(float)
    area = 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    own = np.bincount(container.triangles.ravel(), np.repeat(area / 3.0, 3), len(container.positions))
    absorbed = np.sum(own[:, None] * (1.0 - container.albedo) * np.pi * (direct + bounced), axis=0)
    assert np.allclose(absorbed, 4.0 * np.pi, rtol=0.03), absorbed


def test_lamps_add_up_and_scale_from_a_microwatt_to_a_gigawatt(baked):
    container, scene = baked.objects["room"], room()
    tracer = Tracer(scene.points, scene.triangles, 1)
    first, second = lamp((0.3, 0.3, 0.4)), lamp((0.7, 0.6, 0.5), name="other")
    one, _ = indirect(container, tracer, first)
    other, _ = indirect(container, tracer, second)
    both, _ = indirect(container, tracer, first, second)
    assert np.allclose(both, one + other, rtol=1e-4, atol=1e-6)
    twice, _ = indirect(container, tracer, first, lamp((0.3, 0.3, 0.4), name="twin"))  # two lights at one place
    assert np.allclose(twice, 2.0 * one, rtol=1e-5, atol=1e-6)
    for watts in (1e-6, 1e9):
        scaled, _ = indirect(container, tracer, lamp((0.3, 0.3, 0.4), watts))
        assert np.allclose(scaled, one * (watts / (4.0 * np.pi)), rtol=1e-4, atol=1e-12 * watts)


def test_outside_touching_and_inside_lamps_are_finite_and_named(baked):
    container, scene = baked.objects["room"], room()
    tracer = Tracer(scene.points, scene.triangles, 1)
    for place in ((50.0, 0.0, 0.0), (0.5, 0.5, -0.5), (1e6, 1e6, 1e6)):
        light, found = indirect(container, tracer, lamp(place))
        assert found.outside == ("lamp",) and not light.any()  # never silently wrong: no bounced light, and it says so
    for place in ((0.5, 0.5, 0.0), (0.0, 0.0, 0.0), (0.5, 0.5, 1e-9)):
        light, found = indirect(container, tracer, lamp(place))
        assert np.isfinite(light).all()
        assert np.isfinite(DirectLight(tracer, container).of([lamp(place)])).all()


def test_a_wall_keeps_bounced_light_on_its_side():
    """With visibility a lamp near a wall lights its own half only; the published leak is what it prevents.

    What is left seeps under the wall: the floor's vertices below it take both sides' light.
    """
    scene = room(wall=True)
    container = exhaust(bake(scene, LOCAL)).objects["room"]
    tracer = Tracer(scene.points, scene.triangles, 1)
    blind = Tracer(scene.points, scene.triangles[:0], 1)  # sees no wall
    beyond = container.positions[:, 0] > 0.56
    here = container.positions[:, 0] < 0.44
    kept, _ = indirect(container, tracer, lamp((0.46, 0.5, 0.5)))
    leaked, _ = indirect(container, blind, lamp((0.46, 0.5, 0.5)))
    assert kept[beyond].mean() < 0.04 * kept[here].mean()
    assert leaked[beyond].mean() > 0.1 * leaked[here].mean()


@pytest.mark.parametrize("merging", [{"merge_distance": 0.0}, {"merge_response": 0.0}, {"merge_response": 1e6},
                                     {"merge_distance": 1e6}, {"merged_response": "solution"}])
def test_merging_from_nothing_to_everything(merging):
    settings = {**LOCAL.as_dict(), "cloud_lights": 8, "error_receivers": 0, "spacing": 0.0, **merging}
    report = exhaust(bake(room(), BakeSettings(**settings))).report["local"]
    count = report["lights"]
    if 0.0 in merging.values():
        assert set(report["merged"]) == {count}
    elif merging.get("merge_response") == 1e6:
        assert max(report["merged"]) < count
    else:
        assert max(report["merged"]) <= count


def test_one_light_clouds_and_sealed_rooms_without_lights():
    settings = BakeSettings(**{**LOCAL.as_dict(), "cloud_lights": 1, "error_receivers": 0})
    container = exhaust(bake(room(), settings)).objects["room"]
    scene = room()
    tracer = Tracer(scene.points, scene.triangles, 1)
    light, found = indirect(container, tracer, lamp((0.5, 0.5, 0.5)))
    assert found.outside == () and light.min() > 0.0
    # A region of lights on one side of a wall leaves the other side dark, and a lamp there is outside.
    scene = room(wall=True)
    region = np.array([box_matrix((0.05, 0.05, 0.05), (0.45, 0.95, 0.95))])
    container = exhaust(bake(scene, LOCAL, regions=region)).objects["room"]
    tracer = Tracer(scene.points, scene.triangles, 1)
    light, found = indirect(container, tracer, lamp((0.8, 0.5, 0.5)))
    assert found.outside == ("lamp",) and not light.any()
    thin = np.array([box_matrix((-0.01, 0.0, 0.0), (0.01, 1.0, 1.0))])  # a region in a wall: all too near to it
    with pytest.raises(BadScene, match="no light fits"):
        exhaust(bake(room(), BakeSettings(**{**LOCAL.as_dict(), "cloud_radius": 0.2}), regions=thin))


def test_a_lamp_inside_a_solid_body_is_named_and_one_on_it_shines():
    cube = box("cube", (0.6, 0.2, 0.1), (0.9, 0.5, 0.4), target=False)
    meshes = [box("room", inward=True, albedo=(0.7, 0.5, 0.3)), cube]
    scene = SceneMesh.assemble(meshes, 0.1, np.array([[0.3, 0.5, 0.5]]))
    container = exhaust(bake(scene, BakeSettings(**{**LOCAL.as_dict(), "error_receivers": 0}))).objects["room"]
    tracer = Tracer(scene.points, scene.triangles, 1)
    light, found = indirect(container, tracer, lamp((0.75, 0.35, 0.25)))
    assert found.outside == ("lamp",) and not light.any()
    assert not DirectLight(tracer, container).of([lamp((0.75, 0.35, 0.25))]).any()
    light, found = indirect(container, tracer, lamp((0.6, 0.35, 0.25)))
    assert found.outside == () and np.isfinite(light).all() and light.mean() > 0.1


def test_regions_that_coincide_count_once():
    region = box_matrix((0.1, 0.1, 0.1), (0.9, 0.9, 0.9))
    settings = BakeSettings(**{**LOCAL.as_dict(), "error_receivers": 0, "cloud_lights": 27})
    one, two = (exhaust(bake(room(), settings, regions=np.array([region] * count))) for count in (1, 2))
    assert one.report["local"]["lights"] == two.report["local"]["lights"] == 27
    assert np.array_equal(one.objects["room"].cloud.dense, two.objects["room"].cloud.dense)


def test_the_light_of_a_lamp_hardly_changes_whatever_merges():
    """Weights of eq. 9 that are zero or huge: nothing merges, or all do, and what a lamp gives stays sound."""
    means = []
    scene = room()
    tracer = Tracer(scene.points, scene.triangles, 1)
    for merging in ({"merge_response": 0.0}, {"merge_distance": 1e6}, {"merge_response": 1e6},
                    {"merge_distance": 1e6, "merge_response": 1e6}):
        settings = BakeSettings(**{**LOCAL.as_dict(), "error_receivers": 0, "cloud_lights": 27, **merging})
        container = exhaust(bake(scene, settings)).objects["room"]
        light, found = indirect(container, tracer, lamp((0.4, 0.55, 0.5)))
        assert np.isfinite(light).all() and found.outside == ()
        means.append(float(light.mean()))
    assert max(means) < 1.1 * min(means), means


def stopped_and_resumed(folder):
    """The result of a job in which a killed bake left responses, stopped after its lamps' stage and run again."""
    (folder / "responses-killed").mkdir()
    (folder / "responses-killed" / "zone_0.npy").write_bytes(b"much")
    steps = run_job(folder)
    for progress in steps:
        if progress.stage == "encode":
            steps.close()
            break
    assert (folder / "local.npz").exists() and not list(folder.glob("responses-*"))
    for _ in run_job(folder):
        pass
    stored = read_result(folder)
    assert "local" in stored.report["resumed"]
    return stored.objects["room"]


def test_a_job_resumes_and_its_result_is_the_same(tmp_path):
    settings = BakeSettings(**{**LOCAL.as_dict(), "error_receivers": 0, "cloud_lights": 27})
    regions = np.array([box_matrix((0.1, 0.1, 0.1), (0.9, 0.9, 0.9))])
    folder = write_job(tmp_path, room(), settings, regions=regions)
    found = stopped_and_resumed(folder)
    direct = exhaust(bake(room(), settings, regions=regions)).objects["room"]
    assert np.array_equal(found.bases, direct.bases) and np.array_equal(found.cloud.positions, direct.cloud.positions)
    assert np.array_equal(found.cloud.dense, direct.cloud.dense) and found.cloud.spacing == direct.cloud.spacing


def test_views_add_direct_light(baked):
    container, scene = baked.objects["room"], room()
    tracer = Tracer(scene.points, scene.triangles, 1)
    shining = [lamp((0.5, 0.5, 0.6))]
    found = LampLight(container.cloud, tracer).step(shining)
    light = joined_light(container.lighting_basis, None, found.values)
    direct = DirectLight(tracer, container).of(shining)
    plain = view_radiance(container, light, container.normals)
    assert np.allclose(view_radiance(container, light, container.normals, direct),
                       plain + container.albedo * direct[:, 0], rtol=1e-5)


def test_settings_follow_the_lamps():
    both = make_settings("standard", {"lighting": "environment,local"})
    settings, left_out = fit_to_lamps(both, [])
    assert settings.lighting == "environment" and "no lamp" in left_out[0]
    settings, left_out = fit_to_lamps(both, [lamp((0, 0, 0))])
    assert settings.local_light and settings.cloud_emission == 1 and not left_out
    spot = LocalLight("spot", "spot", np.eye(4), np.ones(3), spot_angle=0.8)
    assert fit_to_lamps(both, [spot])[0].cloud_emission > 1
    with pytest.raises(BadArguments, match="lighting"):
        make_settings("standard", {"lighting": "moon"})


def test_groups_share_no_cluster():
    generator = np.random.default_rng(1)
    signal = generator.normal(size=(400, 12)).astype(np.float32)
    group = np.repeat([2, 5], [100, 300])
    encoding, cluster_group = encode_groups(signal, group, EncoderSettings(16, 3, threads=1))
    assert np.array_equal(cluster_group[encoding.cluster], group)
    squared = float(np.square(signal - encoding.decode(), dtype=np.float64).sum())
    assert encoding.squared_error == pytest.approx(squared, rel=1e-4)
    assert encoding.relative_error == pytest.approx(squared / np.square(signal, dtype=np.float64).sum(), rel=1e-3)
    assert np.isclose(encoding.discarded.sum(), encoding.squared_error, rtol=1e-6)


def test_constants_by_zone():
    generator = np.random.default_rng(2)
    bases = generator.normal(size=(6, 3, 1, 4, 3)).astype(np.float32)
    zones, light = np.array([0, 0, 2, 2, 1, 1]), generator.normal(size=(3, 4, 3))
    expected = np.einsum("kvrjc,kjc->kvrc", bases, light[zones])
    assert np.allclose(cluster_constants(bases, light, zones), expected, atol=1e-5)
    with pytest.raises(ValueError, match="zone"):
        cluster_constants(bases, light)


@pytest.mark.parametrize("change", [{"columns": 7}, {"lights": []}, {"cluster_zone": [0]}, {"cluster_zone": [0, 9]},
                                    {"spacing": -1.0}, {"emission_order": 0}, {"kind": "candles"}])
def test_contradicting_headers_are_refused(change):
    entry = columns_entry(Columns(0, 4), 2, 0.5, 0.0, (1, 1), (0, 1))
    header = {"shape": [2, 3, 1, 4, 1], "columns": entry}
    assert read_columns(header, "Cube", "Bake again") == Columns(0, 4)
    header["columns"] = entry | change
    with pytest.raises(StorageError, match="light"):
        read_columns(header, "Cube", "Bake again")
