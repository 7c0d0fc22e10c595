# SPDX-License-Identifier: GPL-3.0-or-later
"""What lamps need of a bake's materials, in the .blend file: attribute `prt_material`, property `prt_kernels`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import bpy
import numpy as np
import pytest

from prt_addon.blender import stored
from prt_addon.errors import StorageError
from prt_addon.relighting.lamp_highlights import LampSurfaces
from prt_addon.storage.container import BakedTransfer
from prt_addon.storage.lamp_surfaces import ENTRY, lamp_surfaces_entry
from tests.blender.scenes import add_cube
from tests.blender.test_stored import add_smooth_sphere, bake_of

FUNCTIONS = tuple(range(9))


def lit_bake_of(scene_object: bpy.types.Object) -> BakedTransfer:
    """A made-up bake with three materials' kernels."""
    baked, random = bake_of(scene_object, functions=FUNCTIONS), np.random.default_rng(1)
    material = random.integers(0, 3, len(baked.cluster)).astype(np.int32)
    surfaces = LampSurfaces(material, random.normal(size=(3, 9, 36, 3)).astype(np.float32),
                            random.random(3).astype(np.float32), random.normal(size=(3, 9)).astype(np.float32))
    return replace(baked, header={**baked.header, ENTRY: lamp_surfaces_entry(surfaces)}, lamp_surfaces=surfaces)


@pytest.mark.parametrize("make", [add_smooth_sphere, add_cube], ids=["own mesh", "receiver"])
def test_materials_and_kernels_survive_save_and_load(scene: bpy.types.Scene, make: Callable[..., bpy.types.Object],
                                                     tmp_path: Path) -> None:
    scene_object = make()
    baked = lit_bake_of(scene_object)
    mesh = stored.write_baked(scene_object, baked)
    attribute = mesh.attributes["prt_material"]
    assert (attribute.data_type, attribute.domain) == ("INT", "POINT")
    assert np.asarray(mesh["prt_kernels"]).dtype == np.float32
    path, name = str(tmp_path / "baked.blend"), scene_object.name
    bpy.ops.wm.save_as_mainfile(filepath=path)
    bpy.ops.wm.open_mainfile(filepath=path)
    read = stored.read_baked(bpy.data.objects[name])
    for part, value in vars(baked.lamp_surfaces).items():
        assert np.array_equal(getattr(read.lamp_surfaces, part), value), part


def test_another_bake_or_none_takes_it_all_away(scene: bpy.types.Scene) -> None:
    sphere = add_smooth_sphere()
    stored.write_baked(sphere, lit_bake_of(sphere))
    stored.write_baked(sphere, bake_of(sphere, functions=FUNCTIONS))
    assert stored.read_baked(sphere).lamp_surfaces is None
    assert "prt_material" not in sphere.data.attributes and "prt_kernels" not in sphere.data
    stored.write_baked(sphere, lit_bake_of(sphere))
    stored.clear_baked(sphere)
    assert not [a.name for a in sphere.data.attributes if a.name.startswith("prt_")]
    assert "prt_kernels" not in sphere.data


DAMAGE = {
    "lost attribute": (lambda m: m.attributes.remove(m.attributes["prt_material"]), "prt_material"),
    "lost kernels": (lambda m: m.__delitem__("prt_kernels"), "lamps"),
    "short kernels": (lambda m: m.__setitem__("prt_kernels", [1.0, 2.0]), "lamps"),
    "text": (lambda m: m.__setitem__("prt_kernels", "none"), "lamps"),
    "out of range": (lambda m: m.attributes["prt_material"].data.foreach_set(
        "value", np.full(len(m.vertices), 3, np.int32)), "lamps"),
}


@pytest.mark.parametrize("damage", DAMAGE)
def test_damaged_materials_are_refused(scene: bpy.types.Scene, damage: str) -> None:
    sphere = add_smooth_sphere()
    mesh = stored.write_baked(sphere, lit_bake_of(sphere))
    spoil, words = DAMAGE[damage]
    spoil(mesh)
    with pytest.raises(StorageError, match=words):
        stored.read_baked(sphere)


def test_materials_of_other_points_are_not_written(scene: bpy.types.Scene) -> None:
    sphere = add_smooth_sphere()
    baked = lit_bake_of(sphere)
    short = replace(baked.lamp_surfaces, material=baked.lamp_surfaces.material[:-1])
    with pytest.raises(StorageError, match="lamps"):
        stored.write_baked(sphere, replace(baked, lamp_surfaces=short))
    assert stored.read_baked(sphere) is None
