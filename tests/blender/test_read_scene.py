# SPDX-License-Identifier: GPL-3.0-or-later
"""The reader against geometry that can be stated without Blender: places, windings, normals, who takes part."""

from __future__ import annotations

from collections.abc import Callable

import bpy
import numpy as np
import pytest
from mathutils import Matrix

from prt_addon.blender.read_scene import read_objects
from prt_addon.errors import BadScene
from prt_addon.scene.scene_mesh import ObjectMesh, SceneMesh
from tests.blender.scenes import add_cube, add_material, add_mesh, depsgraph, place, unit, user_data_lines

TRIANGLE = ([(0, 0, 0), (1, 0, 0), (0, 1, 0)], [(0, 1, 2)])


def by_name(objects: list[ObjectMesh]) -> dict[str, ObjectMesh]:
    return {o.name: o for o in objects}


def face_normals(mesh: ObjectMesh) -> np.ndarray:
    corners = mesh.positions[mesh.triangles]
    return unit(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]))


@pytest.mark.parametrize("matrix", [
    Matrix.Translation((3, -2, 1)) @ Matrix.Rotation(0.7, 4, "Y"),
    Matrix.Diagonal((1, 1, -1, 1)),
    Matrix.Diagonal((-2, -0.5, -3, 1)) @ Matrix.Rotation(0.4, 4, "X"),
    Matrix(((1, 0.8, 0, 1), (0, 1, 0, 2), (0.3, 0, 2, 3), (0, 0, 0, 1))),
    Matrix.Diagonal((1e-6, 1e-6, 1e-6, 1)),
    Matrix.Diagonal((1e6, 1e6, -1e6, 1)),
], ids=["rigid", "mirror", "negative", "shear", "tiny", "huge"])
def test_any_transform_keeps_cube_closed_and_facing_out(scene: bpy.types.Scene, matrix: Matrix) -> None:
    cube = add_cube()
    place(cube, matrix)
    mesh, = read_objects(depsgraph())
    used = np.array(matrix, np.float64)
    local = np.array([v.co for v in cube.data.vertices], np.float64)
    expected = local @ used[:3, :3].T + used[:3, 3]
    assert np.allclose(mesh.positions, expected, rtol=1e-6, atol=1e-6 * np.abs(expected).max())
    # Signed volume by the divergence theorem: 8 |det|, positive exactly if every triangle winds outwards.
    corners = mesh.positions[mesh.triangles] - used[:3, 3]
    volume = np.sum(np.linalg.det(corners)) / 6.0
    assert volume == pytest.approx(8.0 * abs(np.linalg.det(used[:3, :3])), rel=1e-5)
    # Flat shading: the shading normal is the geometric one, whatever the shear.
    assert np.allclose(mesh.corner_normals, np.repeat(face_normals(mesh)[:, None], 3, axis=1), atol=2e-6)
    assert mesh.winding_flipped == (np.linalg.det(used[:3, :3]) < 0)
    assert np.allclose(mesh.matrix, used)


def test_smooth_normals_under_shear_are_those_of_the_sheared_ellipsoid(scene: bpy.types.Scene) -> None:
    bpy.ops.mesh.primitive_uv_sphere_add(segments=64, ring_count=32)
    sphere = bpy.context.object
    bpy.ops.object.shade_smooth()
    matrix = np.array([[1, 0.6, 0, 0], [0, 1, 0, 0], [0, 0.2, -2, 0], [0, 0, 0, 1.0]])
    place(sphere, Matrix(matrix))
    mesh, = read_objects(depsgraph())
    inverse = np.linalg.inv(matrix[:3, :3])
    # Gradient of |M^-1 x|^2 at each corner.
    exact = unit(mesh.positions[mesh.triangles] @ inverse.T @ inverse)
    assert np.max(np.linalg.norm(mesh.corner_normals - exact, axis=2)) < 0.02


def test_custom_normals_survive(scene: bpy.types.Scene) -> None:
    triangle = add_mesh("T", *TRIANGLE)
    wanted = unit(np.array([(0.2, 0.1, 1), (-0.3, 0, 1), (0, 0.4, 1)]))
    triangle.data.normals_split_custom_set([tuple(n) for n in wanted])
    mesh, = read_objects(depsgraph())
    order = [list(map(tuple, TRIANGLE[0])).index(tuple(np.round(p))) for p in mesh.positions[mesh.triangles[0]]]
    assert np.allclose(mesh.corner_normals[0], wanted[order], atol=1e-3)


def test_modifiers_are_evaluated(scene: bpy.types.Scene) -> None:
    cube = add_cube()
    modifier = cube.modifiers.new("Array", "ARRAY")
    modifier.count = 3
    mesh, = read_objects(depsgraph())
    assert len(mesh.positions) == 24
    assert len(mesh.triangles) == 36
    cube.modifiers["Array"].show_viewport = False
    assert len(read_objects(depsgraph())[0].positions) == 8


def test_subdivision_gives_its_faces(scene: bpy.types.Scene) -> None:
    cube = add_cube()
    cube.modifiers.new("Subdivision", "SUBSURF").levels = 2
    assert len(read_objects(depsgraph())[0].triangles) == 6 * 16 * 2


def test_collection_instance_is_one_mesh_named_after_the_instancer(scene: bpy.types.Scene) -> None:
    collection = bpy.data.collections.new("Library")
    add_cube("A", collection)
    add_mesh("B", *TRIANGLE, collection)
    hidden = add_cube("C", collection)
    hidden.hide_render = True
    empty = bpy.data.objects.new("Instancer", None)
    empty.instance_type, empty.instance_collection = "COLLECTION", collection
    scene.collection.objects.link(empty)
    empty.location = (10, 0, 0)
    mesh, = read_objects(depsgraph(), ["Instancer"])
    assert mesh.name == "Instancer"
    assert mesh.is_target
    assert len(mesh.triangles) == 13
    assert mesh.positions[:, 0].min() == pytest.approx(9.0)
    assembled = SceneMesh.assemble([mesh])
    assert assembled.objects[0].is_target


def scattering_nodes() -> bpy.types.NodeTree:
    """A node group: cubes of 0.1 on every point of the mesh, next to the mesh itself."""
    tree = bpy.data.node_groups.new("Scatter", "GeometryNodeTree")
    tree.interface.new_socket("Geometry", in_out="INPUT", socket_type="NodeSocketGeometry")
    tree.interface.new_socket("Geometry", in_out="OUTPUT", socket_type="NodeSocketGeometry")
    source, result = tree.nodes.new("NodeGroupInput"), tree.nodes.new("NodeGroupOutput")
    cube, points = tree.nodes.new("GeometryNodeMeshCube"), tree.nodes.new("GeometryNodeInstanceOnPoints")
    material, join = tree.nodes.new("GeometryNodeSetMaterial"), tree.nodes.new("GeometryNodeJoinGeometry")
    cube.inputs["Size"].default_value = (0.1, 0.1, 0.1)
    red = add_material("Red", lambda t, o: _diffuse(t, o, (0.9, 0.1, 0.1, 1)))
    material.inputs["Material"].default_value = red
    tree.links.new(cube.outputs["Mesh"], material.inputs["Geometry"])
    tree.links.new(source.outputs[0], points.inputs["Points"])
    tree.links.new(material.outputs["Geometry"], points.inputs["Instance"])
    tree.links.new(source.outputs[0], join.inputs[0])
    tree.links.new(points.outputs[0], join.inputs[0])
    tree.links.new(join.outputs[0], result.inputs[0])
    return tree


def _diffuse(tree: bpy.types.NodeTree, output: bpy.types.Node, colour: tuple) -> None:
    node = tree.nodes.new("ShaderNodeBsdfDiffuse")
    node.inputs["Color"].default_value = colour
    tree.links.new(node.outputs[0], output.inputs["Surface"])


def test_geometry_nodes_instances_join_their_object_with_their_own_material(scene: bpy.types.Scene) -> None:
    triangle = add_mesh("Ground", *TRIANGLE)
    triangle.scale = (2, 2, 2)
    triangle.modifiers.new("Scatter", "NODES").node_group = scattering_nodes()
    mesh, = read_objects(depsgraph())
    assert len(mesh.triangles) == 1 + 3 * 12
    assert np.allclose(sorted(np.unique(np.round(mesh.positions[:, 0], 4))), [-0.1, 0, 0.1, 1.9, 2.0, 2.1])
    red = np.all(np.isclose(mesh.corner_albedo, (0.9, 0.1, 0.1)), axis=2)
    assert red.sum() == 3 * 36
    assert np.allclose(mesh.corner_albedo[~red], 0.8)


def test_vertex_instances_and_text(scene: bpy.types.Scene) -> None:
    parent, child = add_mesh("Parent", *TRIANGLE), add_cube("Child")
    child.parent, child.scale, parent.instance_type = parent, (0.1, 0.1, 0.1), "VERTS"
    text = bpy.data.curves.new("Text", "FONT")
    text.body, text.extrude = "I", 0.1
    scene.collection.objects.link(bpy.data.objects.new("Text", text))
    meshes = by_name(read_objects(depsgraph(), ["Parent"]))
    assert len(meshes["Parent"].triangles) == 1 + 36
    assert len(meshes["Text"].triangles) > 10
    assert not meshes["Text"].is_target


def test_render_visibility_decides_and_the_viewports_does_not(scene: bpy.types.Scene) -> None:
    add_cube("Seen")
    for name in ("Eye", "Monitor", "Camera"):
        add_cube(name)
    bpy.data.objects["Eye"].hide_set(True)
    bpy.data.objects["Monitor"].hide_viewport = True
    bpy.data.objects["Camera"].hide_render = True
    for name, hide in (("In hidden collection", "hide_render"), ("In unseen collection", "hide_viewport")):
        collection = bpy.data.collections.new(name)
        scene.collection.children.link(collection)
        add_cube(name, collection)
        setattr(collection, hide, True)
    before = user_data_lines()
    names = {o.name for o in read_objects(depsgraph())}
    assert names == {"Seen", "Eye", "Monitor", "In unseen collection"}
    assert user_data_lines() == before
    assert bpy.data.objects["Eye"].hide_get()


def test_an_object_without_faces_is_skipped_by_name_unless_it_was_asked_for(scene: bpy.types.Scene) -> None:
    add_cube("Cube")
    add_mesh("Points", TRIANGLE[0], [])
    warnings: list[str] = []
    mesh, = read_objects(depsgraph(), None, warnings)
    assert mesh.name == "Cube" and mesh.is_target
    assert [line for line in warnings if line.startswith("Points: ") and "no faces" in line]
    with pytest.raises(BadScene, match="no faces"):
        read_objects(depsgraph(), ["Points"])


@pytest.mark.parametrize(("make", "targets", "name", "words"), [
    (lambda: setattr(add_cube("Hidden"), "hide_render", True), ["Hidden"], "Hidden", "hidden in renders"),
    (lambda: add_cube(), ["Missing"], "Missing", "no object of this name"),
    (lambda: add_mesh("Points", TRIANGLE[0], []), None, "Points", "no faces"),
    (lambda: add_mesh("Empty", [], []), None, "Empty", "no faces"),
    (lambda: add_mesh("Broken", [(0, 0, 0), (float("nan"), 0, 0), (0, 1, 0)], [(0, 1, 2)]), None, "Broken", "finite"),
    (lambda: setattr(add_cube("Flat"), "scale", (1, 1, 0)), None, "Flat", "scale is zero"),
    (lambda: None, None, "scene", "no object"),
    (lambda: bpy.context.scene.collection.objects.link(bpy.data.objects.new("Null", None)), ["Null"], "scene",
     "no mesh"),
])
def test_bad_input_is_named(scene: bpy.types.Scene, make: Callable[..., object], targets: list[str] | None, name: str,
                             words: str) -> None:
    make()
    with pytest.raises(BadScene, match=words) as caught:
        read_objects(depsgraph(), targets)
    assert caught.value.subject == name


def test_an_object_without_faces_stops_the_bake_only_where_it_was_named(scene: bpy.types.Scene) -> None:
    add_cube("Whole")
    add_mesh("Points", TRIANGLE[0], [])
    add_mesh("Empty", [], [])
    warnings: list[str] = []
    assert {o.name: o.is_target for o in read_objects(depsgraph(), None, warnings)} == {"Whole": True}
    assert [w.split(":")[0] for w in warnings] == ["Points", "Empty"] and "no faces" in warnings[0]
    with pytest.raises(BadScene, match="no faces") as caught:
        read_objects(depsgraph(), ["Whole", "Points"])
    assert caught.value.subject == "Points"
    bystanders = {o.name: o.is_target for o in read_objects(depsgraph(), ["Whole"])}
    assert bystanders.pop("Whole") and not any(bystanders.values())


def test_a_flat_caster_is_fine(scene: bpy.types.Scene) -> None:
    add_cube("Target")
    add_cube("Flat").scale = (1, 1, 0)
    meshes = by_name(read_objects(depsgraph(), ["Target"]))
    assert np.isfinite(meshes["Flat"].corner_normals).all()
    assert np.allclose(np.abs(meshes["Flat"].corner_normals[np.abs(meshes["Flat"].corner_normals[:, 0, 2]) > 0.5]),
                       (0, 0, 1), atol=1e-6)


def test_several_materials_per_mesh(scene: bpy.types.Scene) -> None:
    cube = add_cube()
    colours = [(0.1, 0.2, 0.3, 1), (0.7, 0.6, 0.5, 1)]
    for index, colour in enumerate(colours):
        cube.data.materials.append(add_material(f"M{index}", lambda t, o, c=colour: _diffuse(t, o, c)))
    cube.data.polygons.foreach_set("material_index", np.array([0, 1, 1, 0, 0, 1], np.int32))
    mesh, = read_objects(depsgraph())
    is_first = np.all(np.isclose(mesh.corner_albedo, colours[0][:3]), axis=(1, 2))
    is_second = np.all(np.isclose(mesh.corner_albedo, colours[1][:3]), axis=(1, 2))
    assert (is_first.sum(), is_second.sum()) == (6, 6)
    # The slot of the object overrides the mesh's.
    cube.material_slots[1].link = "OBJECT"
    cube.material_slots[1].material = bpy.data.materials["M0"]
    assert np.allclose(read_objects(depsgraph())[0].corner_albedo, colours[0][:3])
