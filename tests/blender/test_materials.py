# SPDX-License-Identifier: GPL-3.0-or-later
"""Albedo of node trees: plain colours against Cycles' own answer, the rest against known colours."""

from __future__ import annotations

from collections.abc import Callable

import bpy
import numpy as np
import pytest

from prt_addon.blender import materials
from prt_addon.blender.read_scene import read_objects
from tests.blender.scenes import add_cube, add_material, add_mesh, depsgraph, user_data_lines

QUAD = ([(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)], [(0, 1, 2, 3)])
Builder = Callable[[bpy.types.NodeTree, bpy.types.Node], None]
COLOUR = (0.7, 0.4, 0.2, 1.0)


def shader(kind: str, **values: object) -> Builder:
    """A builder of a material that is one shader node with these input values."""
    def build(tree: bpy.types.NodeTree, output: bpy.types.Node) -> None:
        node = tree.nodes.new(kind)
        for name, value in values.items():
            node.inputs[name.replace("_", " ")].default_value = value
        tree.links.new(node.outputs[0], output.inputs["Surface"])
    return build


def colour_through(kind: str, socket: str = "Color") -> Builder:
    """A builder: a colour node into a Diffuse BSDF; the caller sets it up."""
    def build(tree: bpy.types.NodeTree, output: bpy.types.Node) -> None:
        source, bsdf = tree.nodes.new(kind), tree.nodes.new("ShaderNodeBsdfDiffuse")
        tree.links.new(source.outputs[socket], bsdf.inputs["Color"])
        tree.links.new(bsdf.outputs[0], output.inputs["Surface"])
    return build


def albedo_of_quad(material: bpy.types.Material | None) -> np.ndarray:
    """Corner albedo (2, 3, 3) of a square with this material."""
    quad = add_mesh("Quad", *QUAD)
    quad.data.materials.append(material)
    result, = [o for o in read_objects(depsgraph()) if o.name == quad.name]
    bpy.data.objects.remove(quad)
    return result.corner_albedo


@pytest.mark.parametrize("build", [
    shader("ShaderNodeBsdfPrincipled", Base_Color=COLOUR),
    shader("ShaderNodeBsdfPrincipled", Base_Color=COLOUR, Metallic=0.3, Roughness=0.1),
    shader("ShaderNodeBsdfPrincipled", Base_Color=COLOUR, Transmission_Weight=0.4, Alpha=0.8),
    shader("ShaderNodeBsdfPrincipled", Base_Color=COLOUR, Coat_Weight=1.0, Sheen_Weight=1.0, Emission_Strength=3.0),
    shader("ShaderNodeBsdfPrincipled", Base_Color=(1.0, 0.5, -0.5, 1.0), Subsurface_Weight=1.0, Metallic=0.8),
    shader("ShaderNodeBsdfDiffuse", Color=COLOUR, Roughness=0.7),
    shader("ShaderNodeEmission", Color=COLOUR),
    shader("ShaderNodeBsdfAnisotropic", Color=COLOUR),
    shader("ShaderNodeBsdfTransparent"),
    lambda tree, output: None,
    colour_through("ShaderNodeRGB"),
])
def test_plain_colours_equal_cycles(scene: bpy.types.Scene, monkeypatch: pytest.MonkeyPatch, build: Builder) -> None:
    material = add_material("M", build)
    read = materials.constant_albedo(material)
    assert read is not None
    monkeypatch.setattr(materials, "constant_albedo", lambda material: None)
    assert np.allclose(albedo_of_quad(material), read, atol=2e-6)


def test_no_material_is_cycles_default(scene: bpy.types.Scene) -> None:
    cube = add_cube()
    assert np.allclose(read_objects(depsgraph())[0].corner_albedo, 0.8)
    cube.data.materials.append(None)
    assert np.allclose(read_objects(depsgraph())[0].corner_albedo, 0.8)


def test_vertex_colours_arrive_at_their_corners(scene: bpy.types.Scene) -> None:
    quad = add_mesh("Quad", *QUAD)
    wanted = np.array([(1, 0, 0), (0, 1, 0), (0, 0, 1), (0.25, 0.5, 0.75)], np.float32)
    layer = quad.data.color_attributes.new("Paint", "FLOAT_COLOR", "POINT")
    layer.data.foreach_set("color", np.c_[wanted, np.ones(4, np.float32)].ravel().astype(np.float32))
    material = add_material("M", colour_through("ShaderNodeVertexColor"))
    quad.data.materials.append(material)
    mesh, = read_objects(depsgraph())
    assert np.allclose(mesh.corner_albedo, wanted[mesh.triangles], atol=1e-3)


def test_image_texture_is_linearised(scene: bpy.types.Scene) -> None:
    image = bpy.data.images.new("Texture", 2, 1)
    image.pixels.foreach_set(np.array([0.5, 0.5, 0.5, 1, 1, 0, 0, 1], np.float32))
    material = add_material("M", colour_through("ShaderNodeTexImage"))
    texture = next(n for n in material.node_tree.nodes if n.bl_idname == "ShaderNodeTexImage")
    texture.image, texture.interpolation = image, "Closest"
    quad = add_mesh("Quad", *QUAD)
    layer = quad.data.uv_layers.new(name="UV")
    layer.data.foreach_set("uv", np.array([0.1, 0.5, 0.9, 0.5, 0.9, 0.5, 0.1, 0.5], np.float32))
    quad.data.materials.append(material)
    mesh, = read_objects(depsgraph())
    left = mesh.positions[mesh.triangles][..., 0] < 0.5
    linear = ((round(0.5 * 255) / 255 + 0.055) / 1.055) ** 2.4  # IEC 61966-2-1
    assert np.allclose(mesh.corner_albedo[left], linear, atol=2e-3)
    assert np.allclose(mesh.corner_albedo[~left], (1, 0, 0), atol=2e-3)


def test_mixes_and_highlights_inside_groups(scene: bpy.types.Scene) -> None:
    group = bpy.data.node_groups.new("Group", "ShaderNodeTree")
    group.interface.new_socket("Shader", in_out="OUTPUT", socket_type="NodeSocketShader")
    end = group.nodes.new("NodeGroupOutput")
    mix = group.nodes.new("ShaderNodeMixShader")
    first, second = (group.nodes.new("ShaderNodeBsdfPrincipled") for _ in range(2))
    first.inputs["Base Color"].default_value, second.inputs["Base Color"].default_value = (1, 0, 0, 1), (0, 0, 1, 1)
    mix.inputs[0].default_value = 0.25
    group.links.new(first.outputs[0], mix.inputs[1])
    group.links.new(second.outputs[0], mix.inputs[2])
    group.links.new(mix.outputs[0], end.inputs[0])

    def build(tree: bpy.types.NodeTree, output: bpy.types.Node) -> None:
        node = tree.nodes.new("ShaderNodeGroup")
        node.node_tree = group
        tree.links.new(node.outputs[0], output.inputs["Surface"])

    before = len(bpy.data.node_groups)
    assert np.allclose(albedo_of_quad(add_material("M", build)), (0.75, 0, 0.25), atol=1e-5)
    assert len(bpy.data.node_groups) == before
    assert first.inputs["Specular IOR Level"].default_value == 0.5


def test_object_space_texture_uses_the_objects_transform(scene: bpy.types.Scene) -> None:
    """Colour = world position through the Geometry node."""
    material = add_material("M", colour_through("ShaderNodeNewGeometry", "Position"))
    quad = add_mesh("Quad", *QUAD)
    quad.location, quad.scale = (0.1, 0.2, 0.3), (0.5, 0.25, 1.0)
    quad.data.materials.append(material)
    mesh, = read_objects(depsgraph())
    assert np.allclose(mesh.corner_albedo, mesh.positions[mesh.triangles], atol=1e-3)


def test_generated_geometry_is_evaluated_too(scene: bpy.types.Scene) -> None:
    """A cube that only nodes make, coloured by position."""
    tree = bpy.data.node_groups.new("Make", "GeometryNodeTree")
    tree.interface.new_socket("Geometry", in_out="OUTPUT", socket_type="NodeSocketGeometry")
    cube, end = tree.nodes.new("GeometryNodeMeshCube"), tree.nodes.new("NodeGroupOutput")
    points, place = tree.nodes.new("GeometryNodePoints"), tree.nodes.new("GeometryNodeInstanceOnPoints")
    setter = tree.nodes.new("GeometryNodeSetMaterial")
    setter.inputs["Material"].default_value = add_material("M", colour_through("ShaderNodeTexCoord", "Object"))
    points.inputs["Position"].default_value = (2.0, 0.0, 0.0)
    tree.links.new(cube.outputs["Mesh"], setter.inputs["Geometry"])
    tree.links.new(points.outputs[0], place.inputs["Points"])
    tree.links.new(setter.outputs[0], place.inputs["Instance"])
    tree.links.new(place.outputs[0], end.inputs[0])
    add_mesh("Maker", *QUAD).modifiers.new("Nodes", "NODES").node_group = tree
    mesh, = read_objects(depsgraph())
    local = mesh.positions[mesh.triangles] - (2.0, 0.0, 0.0)
    assert np.allclose(mesh.corner_albedo, np.clip(local, 0, 1), atol=1e-3)


def busy_scene() -> None:
    """Textured, modified, instanced, selected, in an unusual state everywhere the reader could leave a mark."""
    cube, quad = add_cube("Textured"), add_mesh("Painted", *QUAD)
    cube.data.materials.append(add_material("Place", colour_through("ShaderNodeTexCoord", "Object")))
    cube.modifiers.new("Bevel", "BEVEL")
    paint = quad.data.color_attributes.new("Paint", "BYTE_COLOR", "CORNER")
    quad.data.color_attributes.new("Other", "FLOAT_COLOR", "POINT")
    quad.data.color_attributes.active_color = paint
    quad.data.uv_layers.new(name="UV")
    quad.data.materials.append(add_material("Attribute", colour_through("ShaderNodeVertexColor")))
    quad.data.materials.append(None)
    quad.hide_set(True)
    scene = bpy.context.scene
    scene.render.engine, scene.cycles.samples, scene.render.bake.margin = "BLENDER_EEVEE", 77, 3
    scene.frame_set(12)
    bpy.ops.object.select_all(action="DESELECT")
    cube.select_set(True)
    bpy.context.view_layer.objects.active = cube


@pytest.mark.parametrize("mode", ["OBJECT", "EDIT", "VERTEX_PAINT"])
def test_nothing_of_the_users_changes(scene: bpy.types.Scene, mode: str) -> None:
    busy_scene()
    bpy.ops.object.mode_set(mode=mode)
    depsgraph()
    before = user_data_lines()
    meshes = read_objects(depsgraph())
    assert np.ptp(next(m for m in meshes if m.name == "Textured").corner_albedo) > 0.1
    after = user_data_lines()
    assert [pair for pair in zip(before, after, strict=False) if pair[0] != pair[1]] == []
    assert len(after) == len(before)


def test_the_scenes_own_light_does_not_matter(scene: bpy.types.Scene) -> None:
    material = add_material("M", colour_through("ShaderNodeTexChecker"))
    dark = albedo_of_quad(material)
    scene.world = bpy.data.worlds.new("World")
    light = bpy.data.objects.new("Sun", bpy.data.lights.new("Sun", "SUN"))
    light.data.energy = 100.0
    scene.collection.objects.link(light)
    assert np.array_equal(albedo_of_quad(material), dark)


def test_nothing_is_left_after_a_failure(scene: bpy.types.Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    busy_scene()
    before = user_data_lines()

    def fail(*arguments: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(materials, "evaluate_corners", fail)
    with pytest.raises(KeyboardInterrupt):
        read_objects(depsgraph())
    assert user_data_lines() == before


def test_digest_follows_values_links_and_groups(scene: bpy.types.Scene) -> None:
    material = add_material("M", colour_through("ShaderNodeTexChecker"))
    digests = [materials.material_digest([material])]
    nodes = {n.bl_idname: n for n in material.node_tree.nodes}
    nodes["ShaderNodeTexChecker"].inputs["Scale"].default_value = 3.0
    digests.append(materials.material_digest([material]))
    material.node_tree.links.remove(nodes["ShaderNodeBsdfDiffuse"].inputs["Color"].links[0])
    digests.append(materials.material_digest([material]))
    assert len(set(digests)) == 3
    nodes["ShaderNodeTexChecker"].location = (400, 10)
    assert materials.material_digest([material]) == digests[-1]


def test_a_missing_image_is_named(scene: bpy.types.Scene) -> None:
    material = add_material("Poster", colour_through("ShaderNodeTexImage"))
    texture = next(n for n in material.node_tree.nodes if n.bl_idname == "ShaderNodeTexImage")
    assert materials.missing_images(material) == [
        "Material Poster: an image texture node has no image, which shows black"]
    texture.image = bpy.data.images.new("lost", 4, 4)
    texture.image.source, texture.image.filepath = "FILE", "//lost.png"
    assert len(materials.missing_images(material)) == 1 and "lost.png" in materials.missing_images(material)[0]
    add_quad = bpy.data.objects.new("Quad", bpy.data.meshes.new("Quad"))
    add_quad.data.from_pydata([(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)], [], [(0, 1, 2, 3)])
    add_quad.data.materials.append(material)
    scene.collection.objects.link(add_quad)
    warnings: list[str] = []
    read_objects(depsgraph(), None, warnings)
    assert any("lost.png" in line for line in warnings)
