# SPDX-License-Identifier: GPL-3.0-or-later
"""What keeps a bake valid: everything stands together as it did, wherever that is; and what does not."""

from __future__ import annotations

from collections.abc import Callable

import bpy
import numpy as np
import pytest
from mathutils import Matrix

from prt_addon.blender import fingerprint, stored
from prt_addon.blender.bake_set import changed_piece, pack_place, unpack_places
from prt_addon.errors import StorageError
from tests.blender.scenes import add_cube, add_material, depsgraph
from tests.blender.test_stored import bake_of

TURN = Matrix.Translation((3.0, -2.0, 1.0)) @ Matrix.Rotation(1.2, 4, (0.3, 0.5, 0.8))
MOVES = {"shifted": (Matrix.Translation((100.0, 20.0, 3.0)), True), "turned": (TURN, True),
         "grown": (TURN @ Matrix.Scale(3.0, 4), True), "stretched": (Matrix.Diagonal((1, 1, 1.1, 1)), False),
         "mirrored": (Matrix.Diagonal((-1, 1, 1, 1)), False)}


def three(scene: bpy.types.Scene) -> tuple[bpy.types.Object, list[bpy.types.Object]]:
    """An empty, and three cubes that hang on it, the first of them baked."""
    holder = bpy.data.objects.new("Holder", None)
    scene.collection.objects.link(holder)
    cubes = [add_cube(name) for name in ("Statue", "Floor", "Wall")]
    for number, cube in enumerate(cubes):
        cube.parent, cube.location, cube.rotation_euler = holder, (3.0 * number, number, 0.0), (0.0, 0.4 * number, 0.1)
    graph = depsgraph()
    stored.write_baked(cubes[0], bake_of(cubes[0]), None, fingerprint.surroundings(graph))
    return holder, cubes


def why(cube: bpy.types.Object) -> str | None:
    graph = depsgraph()
    return stored.stale(cube, graph, fingerprint.surroundings(graph))


@pytest.mark.parametrize("name", MOVES)
def test_the_whole_set_may_move_alike(scene: bpy.types.Scene, name: str) -> None:
    holder, cubes = three(scene)
    assert why(cubes[0]) is None
    move, valid = MOVES[name]
    holder.matrix_world = move
    assert (why(cubes[0]) is None) == valid
    assert "moved" in (stored.stale(cubes[0], depsgraph()) or ""), "nobody asked what is around it"
    holder.matrix_world = Matrix()
    assert why(cubes[0]) is None


CHANGES: dict[str, tuple[Callable[[bpy.types.Object, list], object], str]] = {
    "the baked one alone": (lambda _, cubes: setattr(cubes[0], "location", (0.0, 0.0, 0.01)), "it was moved"),
    "another one alone": (lambda _, cubes: setattr(cubes[1], "location", (3.0, 1.0, 0.01)), "Floor"),
    "all but one": (lambda holder, cubes: (setattr(cubes[2], "parent", None), setattr(holder, "location", (1, 0, 0))),
                    "it was moved"),
    "another one is turned a little": (lambda _, cubes: setattr(cubes[2], "rotation_euler", (0.0, 0.8, 0.105)), "Wall"),
    "another one is painted": (lambda _, cubes: cubes[1].data.materials.append(red()), "Floor"),
    "a new one": (lambda _, cubes: add_cube("Guest"), "Guest"),
    "one is gone": (lambda _, cubes: bpy.data.objects.remove(cubes[2]), "Wall"),
    "a copy of it elsewhere": (lambda _, cubes: copy_of(cubes[0]), "Statue.001"),
}


def red() -> bpy.types.Material:
    def build(tree: bpy.types.NodeTree, output: bpy.types.Node) -> None:
        shader = tree.nodes.new("ShaderNodeBsdfDiffuse")
        shader.inputs["Color"].default_value = (1.0, 0.0, 0.0, 1.0)
        tree.links.new(shader.outputs["BSDF"], output.inputs["Surface"])

    return add_material("Red", build)


def copy_of(cube: bpy.types.Object) -> bpy.types.Object:
    copy = cube.copy()
    bpy.context.scene.collection.objects.link(copy)
    copy.location.x -= 4.0
    return copy


@pytest.mark.parametrize("name", CHANGES)
def test_one_that_changes_alone_makes_the_bake_stale(scene: bpy.types.Scene, name: str) -> None:
    holder, cubes = three(scene)
    change, words = CHANGES[name]
    change(holder, cubes)
    assert words in (why(cubes[0]) or "still valid")


def test_a_copy_of_a_baked_object_is_stale_where_it_stands(scene: bpy.types.Scene) -> None:
    """Linked duplicates share the bake, full ones have it copied: both show light of another place."""
    _, cubes = three(scene)
    linked = copy_of(cubes[0])
    assert "moved" in why(linked)
    full = copy_of(cubes[0])
    full.data = cubes[0].data.copy()
    assert "moved" in why(full)


def test_what_only_the_viewport_hides_is_as_it_was(scene: bpy.types.Scene) -> None:
    """Renders still show it, so it still casts its shadow; hidden in renders it is gone."""
    _, cubes = three(scene)
    for hide in (lambda off: cubes[1].hide_set(off), lambda off: setattr(cubes[1], "hide_viewport", off)):
        hide(True)
        assert why(cubes[0]) is None
        cubes[2].location.x += 0.1
        assert "Wall" in why(cubes[0])
        cubes[2].location.x -= 0.1
        hide(False)
        assert why(cubes[0]) is None
    cubes[1].hide_render = True
    assert "Floor" in why(cubes[0])


def test_what_was_hidden_at_the_bake_counts_as_unknown(scene: bpy.types.Scene) -> None:
    _, cubes = three(scene)
    cubes[1].hide_set(True)
    stored.write_baked(cubes[0], bake_of(cubes[0]), None, fingerprint.surroundings(depsgraph()))
    assert why(cubes[0]) is None
    cubes[1].hide_set(False)
    assert why(cubes[0]) is None


def test_another_ones_mesh_with_its_bake_is_stale(scene: bpy.types.Scene) -> None:
    """All that the carried bake says of its own mesh is true, but what stood here is gone."""
    _, cubes = three(scene)
    cubes[1].location = cubes[0].location
    cubes[1].rotation_euler = cubes[0].rotation_euler
    cubes[1].scale = (1.0, 1.0, 2.0)
    graph = depsgraph()
    stored.write_baked(cubes[0], bake_of(cubes[0]), None, fingerprint.surroundings(graph))
    cubes[1].scale, cubes[1].data = (1.0, 1.0, 1.0), cubes[0].data.copy()
    cubes[1][stored.RECEIVER_PROPERTY] = cubes[0][stored.RECEIVER_PROPERTY]
    assert "Floor" in why(cubes[1]) and "Floor" in why(cubes[0])


def test_an_object_hidden_in_renders_keeps_its_own_bake(scene: bpy.types.Scene) -> None:
    _, cubes = three(scene)
    cubes[0].hide_render = True
    assert why(cubes[0]) is None
    cubes[2].location.z += 0.2
    assert "Wall" in why(cubes[0])


def test_edit_mode_alone_changes_nothing(scene: bpy.types.Scene) -> None:
    """Nor do sculpting and painting before the first stroke; an edit does at once."""
    _, cubes = three(scene)
    bpy.context.view_layer.objects.active = cubes[1]
    for mode in ("EDIT", "SCULPT", "WEIGHT_PAINT", "VERTEX_PAINT"):
        bpy.ops.object.mode_set(mode=mode)
        assert why(cubes[0]) is None, mode
        bpy.ops.object.mode_set(mode="OBJECT")
    bpy.ops.object.mode_set(mode="EDIT")
    bpy.ops.mesh.select_all(action="SELECT")
    bpy.ops.transform.translate(value=(0.0, 0.0, 0.1))
    assert "Floor" in why(cubes[0])
    bpy.ops.object.mode_set(mode="OBJECT")
    assert "Floor" in why(cubes[0])


def test_an_instanced_collection_counts_like_its_objects(scene: bpy.types.Scene) -> None:
    """Where the whole set is shown through an empty, nothing has changed for the pieces."""
    _, cubes = three(scene)
    before = fingerprint.surroundings(depsgraph())
    held = bpy.data.collections.new("Set")
    for found in list(scene.collection.objects):
        held.objects.link(found)
        scene.collection.objects.unlink(found)
    empty = bpy.data.objects.new("Instancer", None)
    empty.instance_type, empty.instance_collection = "COLLECTION", held
    scene.collection.objects.link(empty)
    empty.matrix_world = TURN
    now = fingerprint.surroundings(depsgraph())
    assert set(now) == {f"Instancer/{name}" for name in ("Statue", "Floor", "Wall")}
    assert changed_piece(before, now, np.array(TURN)) is None
    assert changed_piece(before, now, np.eye(4)) is not None
    assert cubes


def test_translucent_bodies_may_not_grow(scene: bpy.types.Scene) -> None:
    """Light travels through them by a length that does not grow along."""
    def build(tree: bpy.types.NodeTree, output: bpy.types.Node) -> None:
        shader = tree.nodes.new("ShaderNodeBsdfPrincipled")
        shader.inputs["Subsurface Weight"].default_value = 0.5
        tree.links.new(shader.outputs["BSDF"], output.inputs["Surface"])

    cube, wax = add_cube("Cube"), add_material("Wax", build)
    cube.data.materials.append(wax)
    stored.write_baked(cube, bake_of(cube), None, fingerprint.surroundings(depsgraph()))
    cube.rotation_euler = (0.0, 1.0, 0.5)
    assert why(cube) is None
    cube.scale = (2.0, 2.0, 2.0)
    assert "moved" in why(cube)


def test_rounding_of_parents_is_no_move() -> None:
    generator = np.random.default_rng(4)
    places = np.tile(np.eye(4), (300, 1, 1))
    places[:, :3] = generator.normal(size=(300, 3, 4)) * [1.0, 1.0, 1.0, 50.0]
    then = {str(n): "a" * 32 + pack_place(place) for n, place in enumerate(places)}
    moved = np.array(TURN @ Matrix.Scale(7.0, 4))
    now = {f"x{n}": "a" * 32 + pack_place(moved.astype(np.float32) @ place.astype(np.float32))
           for n, place in enumerate(places[::-1])}
    assert changed_piece(then, now, moved) is None
    turned = np.array(Matrix.Rotation(2e-4, 4, "X"))
    now["x7"] = "a" * 32 + pack_place(moved @ places[292] @ turned)
    assert changed_piece(then, now, moved) == "x7"


def test_entries_of_older_bakes_and_of_nobody() -> None:
    entry = "a" * 32 + pack_place(np.eye(4))
    assert np.array_equal(unpack_places([entry])[0], np.eye(4))
    assert changed_piece({"Old": "a" * 32}, {"Old": entry}, np.eye(4)) == "Old"
    with pytest.raises(ValueError, match="no place"):
        changed_piece({"Odd": "a" * 32 + "!"}, {"Odd": entry}, np.eye(4))


def test_a_broken_entry_is_told_in_a_line(scene: bpy.types.Scene) -> None:
    _, cubes = three(scene)
    mesh = stored.baked_mesh(cubes[0])
    mesh["prt_header"] = mesh["prt_header"].replace(pack_place(np.array(cubes[1].matrix_world)), "no place")
    with pytest.raises(StorageError, match="digests"):
        why(cubes[0])
