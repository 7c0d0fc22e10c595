# SPDX-License-Identifier: GPL-3.0-or-later
"""What contract.md promises about the .blend file, and that stored data is never silently wrong."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import bpy
import numpy as np
import pytest
from mathutils import Matrix

from prt_addon.blender import fingerprint, stored
from prt_addon.blender.read_scene import read_objects
from prt_addon.errors import StorageError
from prt_addon.scene.scene_mesh import SceneMesh
from prt_addon.storage.container import BakedTransfer, hemisphere_rows, make_header
from tests.blender.scenes import add_cube, depsgraph, place, user_data_lines

CLUSTERS, VECTORS, COLUMNS = 3, 6, 16


def add_smooth_sphere(name: str = "Sphere") -> bpy.types.Object:
    """A sphere whose vertices are its receivers."""
    bpy.ops.mesh.primitive_uv_sphere_add(segments=12, ring_count=8)
    bpy.ops.object.shade_smooth()
    bpy.context.object.name = bpy.context.object.data.name = name
    return bpy.context.object


def bake_of(scene_object: bpy.types.Object, seed: int = 0, functions: tuple[int, ...] = ()) -> BakedTransfer:
    """A made-up bake on the receivers that the scene really gives this object. functions: of the view, if any."""
    graph = depsgraph()
    assembled = SceneMesh.assemble(read_objects(graph, [scene_object.name]))
    share = next(o for o in assembled.objects if o.name == scene_object.name_full)
    random, count = np.random.default_rng(seed), share.points.stop - share.points.start
    bases = random.normal(size=(CLUSTERS, VECTORS + 1, 1 + len(functions), COLUMNS, 3)).astype(np.float32)
    header = make_header(
        bases.shape, {"kind": "spherical_harmonics", "order": 4, "condon_shortley": False},
        hemisphere_rows(functions) if functions else {"kind": "constant"},
        object=scene_object.name, vectors_per_cluster=[VECTORS] * CLUSTERS, digests={"settings": "abc"},
        source={"object": scene_object.name, "on_source_mesh": share.matches_source},
        matrix=[float(v) for v in share.matrix.ravel()])
    return BakedTransfer(
        header, random.integers(0, CLUSTERS, count).astype(np.int32),
        random.normal(size=(count, VECTORS)).astype(np.float32), bases, assembled.albedo[share.points],
        assembled.points[share.points].astype(np.float32), assembled.normals[share.points].astype(np.float32),
        (assembled.triangles[share.triangles] - share.points.start).astype(np.int32),
        assembled.tangents[share.points].astype(np.float32) if functions else None)


def assert_same(read: BakedTransfer | None, written: BakedTransfer) -> None:
    """Bulk data bit for bit, geometry within single precision, triangles as a set."""
    assert read is not None
    for name in ("cluster", "weights", "bases"):
        assert np.array_equal(getattr(read, name), getattr(written, name)), name
    assert np.allclose(read.albedo, written.albedo, atol=1e-7)
    size = np.abs(written.positions).max()
    assert np.allclose(read.positions, written.positions, atol=2e-6 * size)
    assert np.allclose(read.normals, written.normals, atol=1e-4)
    assert (read.tangents is None) == (written.tangents is None)
    if written.tangents is not None:
        assert np.allclose(read.tangents, written.tangents, atol=1e-4)
        assert np.abs(np.sum(read.tangents * read.normals, axis=1)).max() < 1e-6
    assert {_turned(t) for t in read.triangles.tolist()} == {_turned(t) for t in written.triangles.tolist()}


def _turned(triangle: list[int]) -> tuple[int, ...]:
    """The triangle from its lowest index, its winding kept."""
    start = triangle.index(min(triangle))
    return tuple(triangle[start:] + triangle[:start])


def test_contract_layout_on_the_own_mesh(scene: bpy.types.Scene) -> None:
    sphere = add_smooth_sphere()
    baked = bake_of(sphere)
    mesh = stored.write_baked(sphere, baked)
    assert mesh == sphere.data
    layout = {a.name: (a.data_type, a.domain) for a in mesh.attributes if a.name.startswith("prt_")}
    assert layout == {"prt_cluster": ("INT", "POINT"), "prt_weights_0": ("FLOAT4", "POINT"),
                      "prt_weights_1": ("FLOAT4", "POINT"), "prt_albedo": ("FLOAT_COLOR", "POINT"),
                      "prt_normal": ("FLOAT_VECTOR", "POINT")}
    second = np.empty(4 * len(mesh.vertices), np.float32)
    mesh.attributes["prt_weights_1"].data.foreach_get("vector", second)
    assert np.array_equal(second.reshape(-1, 4)[:, 1], baked.weights[:, 5])
    assert np.asarray(mesh["prt_bases"]).dtype == np.float32
    assert np.array_equal(np.asarray(mesh["prt_bases"]), baked.bases.ravel())
    header = json.loads(mesh["prt_header"])
    assert header["schema"] == 1
    assert header["shape"] == [CLUSTERS, VECTORS + 1, 1, COLUMNS, 3]
    assert header["source"] == {"object": "Sphere", "mesh": "Sphere", "on_source_mesh": True}
    assert {"geometry", "settings"} <= set(header["digests"])
    assert_same(stored.read_baked(sphere), baked)
    assert stored.baked_objects(scene) == [sphere]


TRANSFORMS = {"rigid": Matrix.Translation((5, 1, -3)) @ Matrix.Rotation(1.0, 4, "Y"),
              "mirror": Matrix.Diagonal((1, -2, 1, 1)),
              "shear": Matrix(((1, 0.8, 0, 1), (0, -1, 0, 2), (0.3, 0, 2, 3), (0, 0, 0, 1))),
              "tiny": Matrix.Diagonal((1e-6, 1e-6, 1e-6, 1)), "huge": Matrix.Diagonal((1e6, 1e6, 1e6, 1))}


@pytest.mark.parametrize("transform", TRANSFORMS)
@pytest.mark.parametrize("make", [add_smooth_sphere, add_cube], ids=["own mesh", "receiver"])
def test_roundtrip_under_any_transform(scene: bpy.types.Scene, make: Callable[..., object], transform: str) -> None:
    scene_object = make()
    place(scene_object, TRANSFORMS[transform])
    baked = bake_of(scene_object)
    mesh = stored.write_baked(scene_object, baked)
    assert (mesh == scene_object.data) == (make is add_smooth_sphere)
    assert_same(stored.read_baked(scene_object), baked)
    assert stored.stale(scene_object, depsgraph()) is None


ROW_SETS = {"subsurface": (0,), "9": tuple(range(9)), "24": (0, 1, *range(3, 25)), "25": tuple(range(25))}


@pytest.mark.parametrize("transform", TRANSFORMS)
@pytest.mark.parametrize("make", [add_smooth_sphere, add_cube], ids=["own mesh", "receiver"])
def test_view_dependent_rows_and_tangents_come_back(scene: bpy.types.Scene, make: Callable[..., object],
                                                    transform: str) -> None:
    scene_object = make()
    place(scene_object, TRANSFORMS[transform])
    baked = bake_of(scene_object, functions=ROW_SETS["9"])
    mesh = stored.write_baked(scene_object, baked)
    tangent = mesh.attributes["prt_tangent"]
    assert (tangent.data_type, tangent.domain) == ("FLOAT_VECTOR", "POINT")
    assert json.loads(mesh["prt_header"])["schema"] == 2
    assert_same(stored.read_baked(scene_object), baked)
    stored.write_baked(scene_object, bake_of(scene_object))
    assert "prt_tangent" not in stored.baked_mesh(scene_object).attributes
    assert stored.read_baked(scene_object).functions == ()


@pytest.mark.parametrize("rows", ROW_SETS)
def test_view_dependent_rows_survive_save_and_load(scene: bpy.types.Scene, rows: str, tmp_path: Path) -> None:
    sphere = add_smooth_sphere()
    baked = bake_of(sphere, functions=ROW_SETS[rows])
    stored.write_baked(sphere, baked)
    path = str(tmp_path / "baked.blend")
    bpy.ops.wm.save_as_mainfile(filepath=path)
    bpy.ops.wm.open_mainfile(filepath=path)
    read = stored.read_baked(bpy.data.objects["Sphere"])
    assert read.functions == ROW_SETS[rows]
    assert_same(read, baked)


def _rows(**changes: object) -> dict:
    return {"kind": "constant_and_hemisphere", "functions": list(range(9)), **changes}


ROW_DAMAGE = {
    "unknown kind": (lambda m: _set_header(m, rows=_rows(kind="mystery")), "rows"),
    "no rows": (lambda m: _set_header(m, rows=None), "rows"),
    "one too few": (lambda m: _set_header(m, rows=_rows(functions=list(range(8)))), "10 rows"),
    "twice": (lambda m: _set_header(m, rows=_rows(functions=[0] * 9)), "rows"),
    "out of range": (lambda m: _set_header(m, rows=_rows(functions=[*range(8), 100])), "rows"),
    "negative": (lambda m: _set_header(m, rows=_rows(functions=[*range(8), -1])), "rows"),
    "no number": (lambda m: _set_header(m, rows=_rows(functions=[*range(8), "8"])), "rows"),
    "no list": (lambda m: _set_header(m, rows=_rows(functions="012345678")), "rows"),
    "lost tangents": (lambda m: m.attributes.remove(m.attributes["prt_tangent"]), "prt_tangent"),
}


@pytest.mark.parametrize("damage", ROW_DAMAGE)
def test_damaged_rows_are_refused(scene: bpy.types.Scene, damage: str) -> None:
    sphere = add_smooth_sphere()
    mesh = stored.write_baked(sphere, bake_of(sphere, functions=ROW_SETS["9"]))
    spoil, words = ROW_DAMAGE[damage]
    spoil(mesh)
    with pytest.raises(StorageError, match=words):
        stored.read_baked(sphere)


def test_a_bake_without_its_tangents_is_not_written(scene: bpy.types.Scene) -> None:
    sphere = add_smooth_sphere()
    baked = bake_of(sphere, functions=ROW_SETS["9"])
    with pytest.raises(StorageError, match="no tangents"):
        stored.write_baked(sphere, BakedTransfer(**{**baked.__dict__, "tangents": None}))
    assert stored.baked_mesh(sphere) is None


def test_receiver_is_a_hidden_child_in_place(scene: bpy.types.Scene) -> None:
    cube = add_cube("Box")
    cube.location, cube.scale = (1, 2, 3), (2, 1, 1)
    baked = bake_of(cube)
    mesh = stored.write_baked(cube, baked)
    carrier = bpy.data.objects["PRT Box"]
    assert mesh.name == "PRT Box"
    assert carrier.data == mesh
    assert carrier.parent == cube
    assert carrier.hide_render
    assert carrier.hide_viewport
    assert carrier.users_collection == cube.users_collection
    assert not [a.name for a in cube.data.attributes if a.name.startswith("prt_")]
    carrier.hide_viewport = False
    depsgraph()
    world = np.array([carrier.matrix_world @ v.co for v in mesh.vertices])
    assert np.allclose(world, baked.positions, atol=1e-5)
    assert stored.baked_objects(scene) == [cube]
    # The receiver takes no part in the next bake, and that replaces it.
    assert {o.name for o in read_objects(depsgraph())} == {"Box"}
    again = bake_of(cube, seed=1)
    stored.write_baked(cube, again)
    assert_same(stored.read_baked(cube), again)
    assert [o.name for o in bpy.data.objects if o.name.startswith("PRT")] == ["PRT Box"]
    assert [m.name for m in bpy.data.meshes if m.name.startswith("PRT")] == ["PRT Box"]


def test_modifiers_and_shared_meshes_get_receivers(scene: bpy.types.Scene) -> None:
    first = add_smooth_sphere("First")
    second = bpy.data.objects.new("Second", first.data)
    scene.collection.objects.link(second)
    second.location = (4, 0, 0)
    bakes = {o: bake_of(o, seed) for seed, o in enumerate((first, second))}
    for scene_object, baked in bakes.items():
        assert stored.write_baked(scene_object, baked).name == f"PRT {scene_object.name}"
    for scene_object, baked in bakes.items():
        assert_same(stored.read_baked(scene_object), baked)
    assert stored.clear_baked(first)
    assert stored.read_baked(first) is None
    assert_same(stored.read_baked(second), bakes[second])
    third = add_smooth_sphere("Third")
    third.modifiers.new("Subdivision", "SUBSURF")
    baked = bake_of(third)
    assert len(baked.cluster) > len(third.data.vertices)
    assert stored.write_baked(third, baked).name == "PRT Third"


def test_moving_between_own_mesh_and_receiver_leaves_one_bake(scene: bpy.types.Scene) -> None:
    sphere = add_smooth_sphere()
    stored.write_baked(sphere, bake_of(sphere))
    sphere.modifiers.new("Subdivision", "SUBSURF")
    on_receiver = bake_of(sphere)
    stored.write_baked(sphere, on_receiver)
    assert "prt_header" not in sphere.data
    assert_same(stored.read_baked(sphere), on_receiver)
    sphere.modifiers.clear()
    own = bake_of(sphere)
    assert stored.write_baked(sphere, own) == sphere.data
    assert not [m.name for m in bpy.data.meshes if m.name.startswith("PRT")]
    assert not [o.name for o in bpy.data.objects if o.name.startswith("PRT")]
    assert_same(stored.read_baked(sphere), own)


@pytest.mark.parametrize("make", [add_smooth_sphere, add_cube], ids=["own mesh", "receiver"])
def test_clear_restores_the_file(scene: bpy.types.Scene, make: Callable[..., object]) -> None:
    scene_object = make()
    paint = scene_object.data.color_attributes.new("Paint", "BYTE_COLOR", "CORNER")
    scene_object.data.color_attributes.active_color = paint
    depsgraph()
    before = user_data_lines()
    stored.write_baked(scene_object, bake_of(scene_object))
    assert scene_object.data.color_attributes.active_color_name == "Paint"
    stored.clear_baked(scene_object)
    depsgraph()
    assert user_data_lines() == before
    assert not stored.clear_baked(scene_object)


@pytest.mark.parametrize("make", [add_smooth_sphere, add_cube], ids=["own mesh", "receiver"])
def test_survives_save_load_rename_append_link(scene: bpy.types.Scene, make: Callable[..., object],
                                               tmp_path: Path) -> None:
    scene_object = make()
    scene_object.name = scene_object.data.name = "Original"
    place(scene_object, TRANSFORMS["shear"])
    baked = bake_of(scene_object)
    stored.write_baked(scene_object, baked)
    scene_object.name, scene_object.data.name = "Renamed", "Renamed mesh"
    path = str(tmp_path / "baked.blend")
    bpy.ops.wm.save_as_mainfile(filepath=path)
    bpy.ops.wm.open_mainfile(filepath=path)
    loaded = bpy.data.objects["Renamed"]
    assert_same(stored.read_baked(loaded), baked)
    assert stored.stale(loaded, depsgraph()) is None
    for link in (False, True):
        bpy.ops.wm.read_factory_settings(use_empty=True)
        with bpy.data.libraries.load(path, link=link) as (source, target):
            target.objects = [name for name in source.objects if name == "Renamed"]
        arrived = target.objects[0]
        bpy.context.scene.collection.objects.link(arrived)
        assert_same(stored.read_baked(arrived), baked)
        assert stored.stale(arrived, depsgraph()) is None
        if link:
            with pytest.raises(StorageError, match="linked"):
                stored.write_baked(arrived, baked)


def test_a_copy_keeps_to_itself(scene: bpy.types.Scene) -> None:
    cube = add_cube("Box")
    baked = bake_of(cube)
    stored.write_baked(cube, baked)
    twin = cube.copy()
    twin.data = cube.data.copy()
    twin.location = (9, 0, 0)
    scene.collection.objects.link(twin)
    assert "moved" in stored.stale(twin, depsgraph())
    other = bake_of(twin, seed=1)
    stored.write_baked(twin, other)
    assert_same(stored.read_baked(cube), baked)
    assert_same(stored.read_baked(twin), other)
    stored.clear_baked(twin)
    assert_same(stored.read_baked(cube), baked)


def _edit_vertex(o: bpy.types.Object) -> None:
    o.data.vertices[0].co.x += 0.01
    o.data.update()


CHANGES = {
    "vertex": (_edit_vertex, "mesh or modifiers"),
    "modifier added": (lambda o: o.modifiers.new("Subdivision", "SUBSURF"), "mesh or modifiers"),
    "smoothness": (lambda o: o.data.polygons.foreach_set(
        "use_smooth", [not o.data.polygons[0].use_smooth] * len(o.data.polygons)), "mesh or modifiers"),
    "moved": (lambda o: setattr(o, "location", (0, 0, 0.1)), "moved"),
    "scaled": (lambda o: setattr(o, "scale", (1, 1, 1.01)), "moved"),
    "material": (lambda o: o.data.materials.append(bpy.data.materials.new("M")), "materials"),
}


@pytest.mark.parametrize("make", [add_smooth_sphere, add_cube], ids=["own mesh", "receiver"])
@pytest.mark.parametrize("change", CHANGES)
def test_any_change_makes_it_stale(scene: bpy.types.Scene, make: Callable[..., object], change: str) -> None:
    scene_object = make()
    stored.write_baked(scene_object, bake_of(scene_object))
    assert stored.stale(scene_object, depsgraph()) is None
    edit, words = CHANGES[change]
    edit(scene_object)
    assert words in stored.stale(scene_object, depsgraph())


def test_changing_a_modifier_makes_it_stale_and_undoing_it_does_not(scene: bpy.types.Scene) -> None:
    cube = add_cube()
    modifier = cube.modifiers.new("Bevel", "BEVEL")
    stored.write_baked(cube, bake_of(cube))
    modifier.width = 0.2
    assert "modifiers" in stored.stale(cube, depsgraph())
    modifier.width = 0.1
    assert stored.stale(cube, depsgraph()) is None


def test_other_objects_count_when_asked(scene: bpy.types.Scene) -> None:
    cube, other = add_cube(), add_cube("Lamp post")
    other.location = (3, 0, 0)
    baked = bake_of(cube)
    stored.write_baked(cube, baked, None, fingerprint.surroundings(depsgraph()))
    other.name = "Renamed post"
    graph = depsgraph()
    assert stored.stale(cube, graph, fingerprint.surroundings(graph)) is None
    other.location = (3, 0, 1)
    graph = depsgraph()
    assert "Renamed post" in stored.stale(cube, graph, fingerprint.surroundings(graph))
    assert stored.stale(cube, graph) is None
    bpy.data.objects.remove(other)
    graph = depsgraph()
    assert "Lamp post" in stored.stale(cube, graph, fingerprint.surroundings(graph))


def test_digest_taken_when_read_is_what_counts(scene: bpy.types.Scene) -> None:
    """An edit during the bake must show when it ends."""
    cube = add_cube()
    digests = fingerprint.fingerprint(cube, depsgraph())
    baked = bake_of(cube)
    _edit_vertex(cube)
    depsgraph()
    stored.write_baked(cube, baked, digests)
    assert "mesh or modifiers" in stored.stale(cube, depsgraph())


def test_transform_since_bake(scene: bpy.types.Scene) -> None:
    cube = add_cube()
    place(cube, TRANSFORMS["shear"])
    baked = bake_of(cube)
    stored.write_baked(cube, baked)
    assert np.array_equal(stored.transform_since_bake(cube, stored.stored_header(cube)), np.eye(4))
    move = Matrix.Translation((1, 2, 3)) @ Matrix.Rotation(0.3, 4, "Z")
    cube.parent.matrix_world = move
    depsgraph()
    assert np.allclose(stored.transform_since_bake(cube, stored.stored_header(cube)), np.array(move), atol=1e-5)


def _set_header(mesh: bpy.types.Mesh, **changes: object) -> None:
    mesh["prt_header"] = json.dumps({**json.loads(mesh["prt_header"]), **changes})


DAMAGE = {
    "newer schema": (lambda m: _set_header(m, schema=6), "schema 6"),
    "no json": (lambda m: m.__setitem__("prt_header", "{"), "not readable"),
    "lost attribute": (lambda m: m.attributes.remove(m.attributes["prt_weights_1"]), "prt_weights_1"),
    "lost bases": (lambda m: m.__delitem__("prt_bases"), "no bases"),
    "cut bases": (lambda m: (m.__delitem__("prt_bases"), m.__setitem__("prt_bases", np.zeros(5, np.float32))),
                  "bases hold 5"),
    "bad matrix": (lambda m: _set_header(m, matrix=[1.0]), "transform"),
    "cluster": (lambda m: setattr(m.attributes["prt_cluster"].data[0], "value", 99), "cluster index"),
}


@pytest.mark.parametrize("damage", DAMAGE)
def test_damaged_or_newer_data_is_refused(scene: bpy.types.Scene, damage: str) -> None:
    sphere = add_smooth_sphere()
    mesh = stored.write_baked(sphere, bake_of(sphere))
    spoil, words = DAMAGE[damage]
    spoil(mesh)
    with pytest.raises(StorageError, match=words) as caught:
        stored.read_baked(sphere)
    assert caught.value.subject == "Sphere"
    if damage == "newer schema":
        with pytest.raises(StorageError, match="schema 6"):
            stored.stale(sphere, depsgraph())
    assert stored.clear_baked(sphere)


def test_an_incomplete_bake_leaves_the_previous_one(scene: bpy.types.Scene) -> None:
    for scene_object in (add_smooth_sphere(), add_cube()):
        baked = bake_of(scene_object)
        stored.write_baked(scene_object, baked)
        broken = BakedTransfer(**{**baked.__dict__, "weights": baked.weights[:-1]})
        meshes = len(bpy.data.meshes)
        with pytest.raises(StorageError):
            stored.write_baked(scene_object, broken)
        assert len(bpy.data.meshes) == meshes
        assert_same(stored.read_baked(scene_object), baked)


def test_edit_mode_is_said_not_misread(scene: bpy.types.Scene) -> None:
    sphere = add_smooth_sphere()
    baked = bake_of(sphere)
    stored.write_baked(sphere, baked)
    bpy.ops.object.mode_set(mode="EDIT")
    with pytest.raises(StorageError, match="edit mode"):
        stored.read_baked(sphere)
    # A bake that ends while the artist edits must not be lost.
    stored.write_baked(sphere, baked)
    bpy.ops.object.mode_set(mode="OBJECT")
    assert_same(stored.read_baked(sphere), baked)


def test_what_a_deleted_object_leaves_is_no_baked_object(scene: bpy.types.Scene) -> None:
    cube = add_cube()
    cube.modifiers.new("Bevel", "BEVEL")
    stored.write_baked(cube, bake_of(cube))
    assert len(scene.objects) == 2
    stored.clear_orphans(scene)
    assert len(scene.objects) == 2
    bpy.data.objects.remove(cube)
    assert not stored.baked_objects(scene)
    stored.clear_orphans(scene)
    assert not scene.objects and not [m for m in bpy.data.meshes if m.name.startswith("PRT ")]
