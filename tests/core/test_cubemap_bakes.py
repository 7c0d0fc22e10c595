# SPDX-License-Identifier: GPL-3.0-or-later
"""Bakes in cubemap columns end to end: sharper shadows than harmonics, any encoder, on disk or in memory, resumed."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest

from prt_addon.baking.distant_basis import DistantBasis, distant_basis
from prt_addon.baking.recipe import bake, exhaust
from prt_addon.baking.settings import BakeSettings, make_settings
from prt_addon.errors import BadArguments, StorageError
from prt_addon.lighting.distant_light import DistantLight
from prt_addon.lighting.reference_light import ReferenceLight
from prt_addon.relighting.exit_radiance import diffuse_radiance
from prt_addon.relighting.scene_light import joined_light
from prt_addon.scene.scene_mesh import SceneMesh
from prt_addon.storage.columns import Columns, columns_entry, read_columns
from prt_addon.storage.container import check_header
from tests.core.shapes import plane, sphere

SMALL = BakeSettings(distant_basis="cubemap", cubemap_size=8, directions=1024, gather_directions=128, vectors=64,
                     encoder="eigentransport", spacing=0.05, compression_error=1e-3, error_receivers=24,
                     error_paths=2048, threads=1)


def still_life():
    meshes = [plane(size=4.0, albedo=(0.8, 0.8, 0.8)), sphere(centre=(0, 0, 0.9), radius=0.8, albedo=(0.8, 0.2, 0.1))]
    return SceneMesh.assemble(meshes, 0.05)


def sunny():
    sky = np.full((16, 32, 3), 0.3) * np.linspace(1.5, 0.5, 16)[:, None, None]
    sun = (np.array([0.5, 0.3, 0.8]) / np.linalg.norm([0.5, 0.3, 0.8]), np.array([3.0, 2.5, 2.0]), 0.35)
    return ReferenceLight.of(sky, None, [sun], "a sky with a soft sun")


@pytest.fixture(scope="module")
def baked():
    return exhaust(bake(still_life(), SMALL, light=sunny()))


def test_the_budget_has_all_parts_and_beats_harmonics_on_a_soft_sun(baked):
    errors = baked.report["errors"]
    assert set(errors) == {"sampling", "basis", "compression", "total"}
    assert errors["compression"]["relative_rms"] < 1.2e-2
    assert errors["basis"]["relative_rms"] < 0.06
    assert errors["total"]["relative_rms"] < 0.08
    harmonics = exhaust(bake(still_life(), replace(SMALL, distant_basis="sh", order=5, encoder="static", vectors=8),
                             light=sunny())).report["errors"]
    assert errors["total"]["relative_rms"] < 0.7 * harmonics["total"]["relative_rms"]
    assert all(check["verdict"] == "ok" for check in baked.report["stability"])


def test_containers_name_their_columns(baked):
    for found in baked.objects.values():
        assert found.lighting_basis == Columns(0, 0, 8) and found.lighting_basis.distant == 384
        assert found.header["schema"] == 4 and found.bases.shape[0] == 1
        assert check_header(found.header, "object") is found.header
        assert found.weights.shape[1] <= 64


def test_a_white_sky_lights_an_open_receiver_to_one(baked):
    white = np.ones((384, 3), np.float32)
    found = baked.objects["plane"]
    radiance = diffuse_radiance(found, white) / found.albedo
    rim = np.abs(found.positions[:, :2]).max(axis=1) > 1.9
    assert np.allclose(radiance[rim], 1.0, atol=0.06) and radiance.max() < 1.01


@pytest.mark.parametrize("encoder", ["static", "iterative"])
def test_clustered_encoders_take_the_same_columns(baked, encoder):
    found = exhaust(bake(still_life(), replace(SMALL, encoder=encoder, clusters=16, vectors=6, compression_error=0.02,
                                               error_receivers=0), light=sunny()))
    light = DistantBasis(0, 8).coefficients(sunny()).astype(np.float32)
    for name, container in found.objects.items():
        other = baked.objects[name]
        assert len(container.bases) > 1
        difference = diffuse_radiance(container, light) - diffuse_radiance(other, light)
        assert np.sqrt(np.mean(difference ** 2) / np.mean(diffuse_radiance(other, light) ** 2)) < 0.04


def test_a_small_memory_budget_changes_nothing_and_leaves_no_file(tmp_path):
    settings = replace(SMALL, error_receivers=0, bounces=3)  # the Krylov solver stops where its block is done
    small = exhaust(bake(still_life(), replace(settings, memory_budget=1e-6), tmp_path, light=sunny()))
    large = exhaust(bake(still_life(), settings, light=sunny()))
    for name, container in small.objects.items():
        other = large.objects[name]
        assert np.array_equal(container.weights, other.weights) and np.array_equal(container.bases, other.bases)
    assert {path.name for path in tmp_path.iterdir()} - {"stages.json"} == {"gather.npz"}


def test_a_stopped_bake_goes_on_after_its_last_stage(baked, tmp_path):
    steps = bake(still_life(), replace(SMALL, error_receivers=0), tmp_path, light=sunny())
    for progress in steps:
        if progress.stage == "encode":
            break
    steps.close()
    again = exhaust(bake(still_life(), replace(SMALL, error_receivers=0), tmp_path, light=sunny()))
    assert set(again.report["resumed"]) == {"gather", "direct", "interreflection"}
    for name, container in again.objects.items():
        difference = container.bases[0, 0] - baked.objects[name].bases[0, 0]
        assert np.abs(difference).max() < 1e-6


def test_local_lights_follow_behind_the_texels():
    settings = replace(SMALL, lighting="environment,local", cubemap_size=2, surface_columns=24, surface_patches=64,
                       cloud_lights=8, error_receivers=0, encoder="static", vectors=4, clusters=8)
    found = exhaust(bake(still_life(), settings, light=sunny()))
    for container in found.objects.values():
        basis = container.lighting_basis
        assert basis.cubemap == 2 and basis.cloud > 0 and basis.total == container.bases.shape[3]
        assert read_columns(container.header, "object", "remedy") == basis


def test_light_turns_with_the_object_the_other_way(baked):
    light = DistantLight(None, {8: DistantBasis(0, 8).coefficients(sunny())})
    basis = Columns(0, 0, 8)
    quarter = np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1.0]])
    turned = light.in_columns(basis, quarter)
    assert not np.allclose(turned, light.in_columns(basis))
    assert np.allclose(light.in_columns(basis, np.eye(3)), light.texels[8])
    back = DistantLight(None, {8: turned}).in_columns(basis, quarter.T)
    assert np.allclose(back, light.texels[8], rtol=1e-9)
    assert light.in_columns(Columns(5)) is None and light.in_columns(Columns(0, 0, 16)) is None
    with pytest.raises(ValueError, match="light of shape"):
        joined_light(basis, np.zeros((1536, 3)), None)


def test_headers_that_contradict_themselves_are_refused():
    entry = columns_entry(Columns(0, 0, 4))
    assert read_columns({"shape": [1, 3, 1, 96, 1], "columns": entry}, "a", "b") == Columns(0, 0, 4)
    for columns, broken in itertools.product((95, 6), (entry, {**entry, "size": 0}, {**entry, "size": "4"})):
        with pytest.raises(StorageError):
            read_columns({"shape": [1, 3, 1, columns, 1], "columns": broken}, "a", "b")


def test_settings_say_what_is_possible():
    made = make_settings("standard", {"distant_basis": "cubemap", "encoder": "eigentransport", "vectors": "192"})
    assert distant_basis(made, 1) == DistantBasis(0, 16) and distant_basis(BakeSettings(), 5) == DistantBasis(5)
    for wrong in ({"distant_basis": "haar"}, {"cubemap_size": "1"}, {"cubemap_size": "33"}, {"vectors": "25"},
                  {"encoder": "eigentransport", "vectors": "193"}, {"memory_budget": "-1"}):
        with pytest.raises(BadArguments):
            make_settings("standard", wrong)
    assert DistantBasis(0, 16).samples(2048) == 2 and DistantBasis(0, 32).samples(2048) == 1
    assert DistantBasis(0, 2).rays(2048) >= 1024
