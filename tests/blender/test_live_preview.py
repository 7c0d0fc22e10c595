# SPDX-License-Identifier: GPL-3.0-or-later
"""What the viewport would draw, and the panel list, as the file changes: without a window, step by step."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import bpy
import numpy as np
import pytest
from mathutils import Matrix

from prt_addon.blender import fingerprint, stored
from tests.blender import gpu_support  # makes the checkout the package `prt`
from tests.blender.scenes import add_cube, depsgraph
from tests.blender.test_stored import bake_of

# isort: split
from prt.operators import live_preview, properties

GROUPS = (properties.PRTSettings, properties.PRTBakedObject, properties.PRTSession)
assert gpu_support


@pytest.fixture
def cubes(scene: bpy.types.Scene) -> Iterator[list[bpy.types.Object]]:
    """Two baked cubes and one that is not, under a grey sky; the preview's handlers are not attached."""
    for group in GROUPS:
        bpy.utils.register_class(group)
    properties.register()
    scene.world = bpy.data.worlds.new("Sky")
    made = [add_cube(name) for name in ("Statue", "Wall", "Post")]
    for number, cube in enumerate(made):
        cube.location.x = 3.0 * number
    around = fingerprint.surroundings(depsgraph())
    for cube in made[:2]:
        stored.write_baked(cube, bake_of(cube), None, around)
    live_preview._lives.clear()
    properties.session().preview = True
    yield made
    live_preview._lives.clear()
    properties.unregister()
    for group in reversed(GROUPS):
        bpy.utils.unregister_class(group)


def follow() -> live_preview.Live:
    """Everything that the timer would do, with what the handlers would have noted."""
    depsgraph()
    live = live_preview._lives.setdefault(live_preview._context_key(), live_preview.Live())
    live.light_dirty = live.stale_dirty = live.list_dirty = True
    live.stale_due = 0.0
    live_preview._follow()
    live_preview._tell_panel()
    return live


def listed() -> dict[str, bool]:
    """Names in the panel, and whether they are stale."""
    return {line.name: bool(line.stale) for line in properties.session().objects}


def test_bakes_are_listed_renamed_copied_and_removed(cubes: list[bpy.types.Object]) -> None:
    live = follow()
    assert listed() == {"Statue": False, "Wall": False} and live.signature is not None
    cubes[0].name = "Figure"
    follow()
    assert listed() == {"Figure": False, "Wall": False} and set(live.shown) == {"Figure", "Wall"}
    copy = cubes[1].copy()
    bpy.context.scene.collection.objects.link(copy)
    copy.location.z = 5.0
    follow()
    assert listed() == {"Figure": True, "Wall": True, "Wall.001": True}
    bpy.data.objects.remove(copy)
    follow()
    assert listed() == {"Figure": False, "Wall": False}
    bpy.data.objects.remove(cubes[0])
    follow()
    assert listed() == {"Wall": True}


def test_a_moved_set_turns_the_light_and_one_alone_is_stale(cubes: list[bpy.types.Object]) -> None:
    live = follow()
    turn = Matrix.Rotation(1.1, 4, (0.2, 0.4, 0.7))
    for cube in cubes:
        cube.matrix_world = turn @ cube.matrix_world
    follow()
    assert listed() == {"Statue": False, "Wall": False}
    assert all(np.allclose(shown.moved, np.array(turn), atol=1e-5) for shown in live.shown.values())
    cubes[1].location.x += 0.1
    follow()
    assert listed() == {"Statue": True, "Wall": True}
    assert all(shown.moved is None for shown in live.shown.values())


def test_each_scene_has_its_own(cubes: list[bpy.types.Object]) -> None:
    first = follow()
    other = bpy.data.scenes.new("Other")
    with bpy.context.temp_override(scene=other, view_layer=other.view_layers[0]):
        second = follow()
        assert second is not first and not second.shown and listed() == {}
    assert follow() is first and listed() == {"Statue": False, "Wall": False}
    assert cubes


def test_edit_mode_keeps_what_was_read_and_reads_again_after_it(cubes: list[bpy.types.Object]) -> None:
    follow()
    bpy.context.view_layer.objects.active = cubes[0]
    bpy.ops.object.mode_set(mode="EDIT")
    live = follow()
    assert listed()["Wall"] is False
    bpy.ops.object.mode_set(mode="OBJECT")
    follow()
    assert listed() == {"Statue": False, "Wall": False} and set(live.shown) == {"Statue", "Wall"}


def test_a_broken_bake_is_said_and_the_others_stay(cubes: list[bpy.types.Object]) -> None:
    mesh = stored.baked_mesh(cubes[0])
    mesh["prt_header"] = mesh["prt_header"].replace('"matrix": [', '"matrix": ["x", ')
    live = follow()
    assert listed() == {"Statue": True, "Wall": False} and set(live.shown) == {"Wall"}


def test_nothing_is_read_again_while_nothing_changes(cubes: list[bpy.types.Object]) -> None:
    live = follow()
    before = {name: shown.baked for name, shown in live.shown.items()}
    cubes[2].hide_set(True)  # only the viewport hides it
    follow()
    assert {name: shown.baked for name, shown in live.shown.items()} == before and listed() == {
        "Statue": False, "Wall": False}


def test_an_instanced_collection_shows_its_bakes(cubes: list[bpy.types.Object]) -> None:
    """The whole set through an empty: lit where it stands, turned light and all; beside the originals all are stale."""
    scene, held = bpy.context.scene, bpy.data.collections.new("Set")
    for found in list(scene.collection.objects):
        held.objects.link(found)
    empty = bpy.data.objects.new("Place", None)
    empty.instance_type, empty.instance_collection = "COLLECTION", held
    scene.collection.objects.link(empty)
    turn = Matrix.Translation((5.0, 9.0, 1.0)) @ Matrix.Rotation(0.7, 4, "Z")
    empty.matrix_world = turn
    follow()
    assert listed() == dict.fromkeys(("Statue", "Wall", "Place/Statue", "Place/Wall"), True)
    for found in list(held.objects):
        scene.collection.objects.unlink(found)
    live = follow()
    assert listed() == {"Place/Statue": False, "Place/Wall": False}
    assert all(np.allclose(shown.moved, np.array(turn), atol=1e-5) for shown in live.shown.values())
    assert live.owners == {"Place"}
    held.objects.unlink(cubes[2])
    follow()
    assert listed() == {"Place/Statue": True, "Place/Wall": True}


def test_linked_bakes_are_shown_and_lit(cubes: list[bpy.types.Object], tmp_path: Path) -> None:
    """Read-only, from another file, beside a local object of the same name."""
    from prt.operators.relit import read_all, relit

    path = tmp_path / "library.blend"
    bpy.ops.wm.save_as_mainfile(filepath=str(path))
    assert cubes
    bpy.ops.wm.read_homefile(use_empty=True)
    scene = bpy.context.scene
    scene.world = bpy.data.worlds.new("Sky")
    with bpy.data.libraries.load(str(path), link=True) as (_, into):
        into.objects = ["Statue", "Wall", "Post"]
    for found in into.objects:
        scene.collection.objects.link(found)
    live_preview._lives.clear()
    follow()
    names = {f"{name} [library.blend]" for name in ("Statue", "Wall")}
    assert listed() == dict.fromkeys(names, False)
    baked = read_all(scene, "scene")
    lit = relit(scene, baked)
    assert set(baked) == names and all(lit.radiance(name, b).max() > 0.0 for name, b in baked.items())
