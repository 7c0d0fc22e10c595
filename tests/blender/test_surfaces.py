# SPDX-License-Identifier: GPL-3.0-or-later
"""Materials beyond their albedo: every input that is read, what stands in for textures, tangents against Cycles."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import bpy
import numpy as np
import pytest
from mathutils import Matrix

from prt_addon.blender.cycles_bake import evaluate_corners, scratch_scene
from prt_addon.blender.fingerprint import geometry_digest
from prt_addon.blender.materials import constant_albedo
from prt_addon.blender.read_scene import read_objects
from prt_addon.blender.surfaces import SurfaceReader
from prt_addon.scene.scene_mesh import SceneMesh
from prt_addon.scene.surface_material import DIFFUSE, SurfaceMaterial
from tests.blender.scenes import add_cube, add_material, depsgraph, place, unit

Build = Callable[[bpy.types.NodeTree, bpy.types.Node], None]
PRINCIPLED = SurfaceMaterial("M", (0.8, 0.8, 0.8), 0.5, 0.0, 1.5, 0.5)


def one_node(kind: str, values: dict[str, object] | None = None, **properties: object) -> Build:
    def build(tree: bpy.types.NodeTree, output: bpy.types.Node) -> None:
        node = tree.nodes.new(kind)
        for name, value in properties.items():
            setattr(node, name, value)
        for name, value in (values or {}).items():
            node.inputs[name].default_value = value
        tree.links.new(node.outputs[0], output.inputs["Surface"])
    return build


def read(build: Build, warnings: list[str] | None = None) -> SurfaceMaterial:
    return SurfaceReader([] if warnings is None else warnings).of(add_material("M", build)).material


def assert_equal(found: SurfaceMaterial, expected: SurfaceMaterial) -> None:
    for name, value in expected.__dict__.items():
        assert getattr(found, name) == (value if isinstance(value, str) else pytest.approx(value, abs=1e-6)), name


@pytest.mark.parametrize(("values", "changes"), [
    ({}, {}),
    ({"Base Color": (0.1, 0.2, 0.3, 1)}, {"base_colour": (0.1, 0.2, 0.3)}),
    ({"Roughness": 0.3}, {"roughness": 0.3}),
    ({"Metallic": 0.7}, {"metallic": 0.7}),
    ({"IOR": 1.8}, {"ior": 1.8}),
    ({"IOR": 0.5}, {"ior": 2.0}),
    ({"Specular IOR Level": 0.9}, {"specular_level": 0.9}),
    ({"Specular Tint": (1, 0.5, 0.25, 1)}, {"specular_tint": (1.0, 0.5, 0.25)}),
    ({"Anisotropic": 0.6, "Anisotropic Rotation": 1.25}, {"anisotropic": 0.6, "anisotropic_rotation": 0.25}),
    ({"Anisotropic Rotation": 0.25}, {}),
    ({"Subsurface Weight": 0.4, "Subsurface Radius": (1, 0.5, 0.1), "Subsurface Scale": 0.02, "IOR": 1.3,
      "Subsurface Anisotropy": 0.3},
     {"subsurface_weight": 0.4, "subsurface_radius": (0.02, 0.01, 0.002), "subsurface_ior": 1.3, "ior": 1.3,
      "subsurface_anisotropy": 0.3}),
    ({"Metallic": 1.0, "Specular IOR Level": 0.0}, {"metallic": 1.0, "specular_level": 0.0}),
])
def test_every_principled_input(scene: bpy.types.Scene, values: dict[str, object], changes: dict[str, object]) -> None:
    warnings: list[str] = []
    assert_equal(read(one_node("ShaderNodeBsdfPrincipled", values), warnings), replace(PRINCIPLED, **changes))
    assert not warnings


def test_skin_has_its_own_ior(scene: bpy.types.Scene) -> None:
    values = {"Subsurface Weight": 1.0, "Subsurface IOR": 1.6}
    build = one_node("ShaderNodeBsdfPrincipled", values, subsurface_method="RANDOM_WALK_SKIN")
    assert read(build).subsurface_ior == pytest.approx(1.6)


@pytest.mark.parametrize("build", [
    one_node("ShaderNodeBsdfDiffuse"),
    one_node("ShaderNodeEmission"),
    one_node("ShaderNodeBsdfPrincipled", {"Specular IOR Level": 0.0}),
    one_node("ShaderNodeBsdfPrincipled", {"IOR": 1.0}),
    lambda tree, output: None,
])
def test_what_is_only_diffuse(scene: bpy.types.Scene, build: Build) -> None:
    assert read(build) == DIFFUSE


def widths(material: SurfaceMaterial) -> tuple[float, float]:
    """Width of the highlight along and across the tangent, a quarter turn of the frame applied."""
    aspect = (1.0 - 0.9 * material.anisotropic) ** 0.5
    pair = material.roughness ** 2 / aspect, material.roughness ** 2 * aspect
    return pair[::-1] if material.anisotropic_rotation == pytest.approx(0.25) else pair


@pytest.mark.parametrize(("anisotropy", "along"), [(0.0, 1.0), (0.4, 0.6), (-0.4, 1.0 / 0.6)])
def test_glossy_is_a_metal_that_reflects_its_colour(scene: bpy.types.Scene, anisotropy: float, along: float) -> None:
    values = {"Color": (0.8, 0.4, 0.0, 1.0), "Roughness": 0.6, "Anisotropy": anisotropy}
    found = read(one_node("ShaderNodeBsdfAnisotropic", values))
    assert (found.metallic, found.roughness, found.specular_level) == (1.0, pytest.approx(0.6), 0.0)
    colour = np.array(found.base_colour)
    assert np.allclose(colour, (0.8, 0.4, 0.0))
    # At 82 degrees (cosine 1/7) a metal reflects Schlick's value times its edge tint.
    at_edge = (colour + (1.0 - colour) * (1.0 - 1.0 / 7.0) ** 5) * found.specular_tint
    assert np.allclose(at_edge, colour)
    assert widths(found) == pytest.approx((0.36 * along, 0.36 / along))


def test_extreme_glossy_anisotropy_is_limited_and_named(scene: bpy.types.Scene) -> None:
    warnings: list[str] = []
    assert read(one_node("ShaderNodeBsdfAnisotropic", {"Anisotropy": 0.95}), warnings).anisotropic == 1.0
    assert "anisotropy 0.95" in warnings[0]


def linked(kind: str, output: str, name: str, setup: Callable[[bpy.types.Node], None] = lambda node: None) -> Build:
    """A Principled BSDF with one input fed by a node."""
    def build(tree: bpy.types.NodeTree, result: bpy.types.Node) -> None:
        node, source = tree.nodes.new("ShaderNodeBsdfPrincipled"), tree.nodes.new(kind)
        setup(source)
        tree.links.new(source.outputs[output], node.inputs[name])
        tree.links.new(node.outputs[0], result.inputs["Surface"])
    return build


def test_constants_are_read_through_links(scene: bpy.types.Scene) -> None:
    warnings: list[str] = []
    build = linked("ShaderNodeValue", "Value", "Roughness", lambda n: setattr(n.outputs[0], "default_value", 0.21))
    assert read(build, warnings).roughness == pytest.approx(0.21)
    assert not warnings


def test_textures_have_a_stand_in_and_a_warning(scene: bpy.types.Scene) -> None:
    image = bpy.data.images.new("half", 2, 1)
    image.pixels.foreach_set(np.array([1, 0, 0.5, 1, 0, 0, 0.5, 1], np.float32))  # sRGB values
    warnings: list[str] = []
    build = linked("ShaderNodeTexImage", "Color", "Base Color", lambda n: setattr(n, "image", image))
    assert read(build, warnings).base_colour == pytest.approx((0.5, 0.0, 0.2140), abs=2e-3)  # 8 bits
    assert warnings == ["Material M: Base Color varies; the mean of image half stands in"]
    image = bpy.data.images.new("data", 2, 1, is_data=True)
    image.pixels.foreach_set(np.array([1, 0, 0.5, 1, 0, 0, 0.5, 1], np.float32))
    build = linked("ShaderNodeTexImage", "Color", "Roughness", lambda n: setattr(n, "image", image))
    assert read(build, []).roughness == pytest.approx(0.2126 * 0.5 + 0.0722 * 0.5, abs=2e-3)
    warnings.clear()
    assert read(linked("ShaderNodeTexNoise", "Fac", "Roughness"), warnings).roughness == pytest.approx(0.5)
    assert warnings and "Material M" in warnings[0] and "Roughness" in warnings[0]


def mixed(share: float | None, *kinds: tuple[str, dict[str, object]], shader: str = "ShaderNodeMixShader") -> Build:
    def build(tree: bpy.types.NodeTree, output: bpy.types.Node) -> None:
        node = tree.nodes.new(shader)
        if share is not None:
            node.inputs[0].default_value = share
        for index, (kind, values) in enumerate(kinds):
            part = tree.nodes.new(kind)
            for name, value in values.items():
                part.inputs[name].default_value = value
            tree.links.new(part.outputs[0], node.inputs[index + (share is not None)])
        tree.links.new(node.outputs[0], output.inputs["Surface"])
    return build


METAL = ("ShaderNodeBsdfPrincipled", {"Metallic": 1.0, "Base Color": (0.9, 0.5, 0.1, 1), "Roughness": 0.2})
PLASTIC = ("ShaderNodeBsdfPrincipled", {"Roughness": 0.6})
CHALK, CLEAR = ("ShaderNodeBsdfDiffuse", {}), ("ShaderNodeBsdfTransparent", {})


def test_a_mix_is_one_surface_with_mixed_parameters_and_says_so(scene: bpy.types.Scene) -> None:
    warnings: list[str] = []
    found = read(mixed(0.25, PLASTIC, METAL), warnings)
    assert found.metallic == pytest.approx(0.25) and found.specular_level == pytest.approx(0.5)
    assert found.base_colour == pytest.approx((0.9, 0.5, 0.1)) and 0.2 < found.roughness < 0.6
    assert found.name == "M" and len(warnings) == 1 and "mixed parameters" in warnings[0]
    half = read(mixed(0.5, CHALK, METAL))
    assert half.metallic == pytest.approx(0.5) and half.specular_level == 0.0 and half.name[0] == "M"
    assert half.base_colour == pytest.approx((0.9, 0.5, 0.1)) and half.roughness == pytest.approx(0.2)
    assert read(mixed(1.0, PLASTIC, METAL)).metallic == 1.0 and read(mixed(0.0, CHALK, METAL)) == DIFFUSE
    assert read(mixed(0.5, CHALK, CHALK), warnings) == DIFFUSE
    assert read(mixed(0.4, CLEAR, METAL)).metallic == 1.0


def grouped(depth: int, values: dict[str, object], linked_roughness: bool = False) -> Build:
    """A Principled BSDF `depth` groups deep, whose Metallic, Base Color and Roughness are inputs of every group."""
    kinds = {"Metallic": "NodeSocketFloat", "Base Color": "NodeSocketColor", "Roughness": "NodeSocketFloat"}

    def build(tree: bpy.types.NodeTree, output: bpy.types.Node) -> None:
        inner: bpy.types.NodeTree | None = None
        for _ in range(depth):
            group = bpy.data.node_groups.new("Paint", "ShaderNodeTree")
            group.interface.new_socket("Shader", in_out="OUTPUT", socket_type="NodeSocketShader")
            for name, kind in kinds.items():
                group.interface.new_socket(name, in_out="INPUT", socket_type=kind)
            outside, result = group.nodes.new("NodeGroupInput"), group.nodes.new("NodeGroupOutput")
            node = group.nodes.new("ShaderNodeGroup" if inner else "ShaderNodeBsdfPrincipled")
            if inner:
                node.node_tree = inner
            for name in kinds:
                group.links.new(outside.outputs[name], node.inputs[name])
            group.links.new(node.outputs[0], result.inputs[0])
            inner = group
        node = tree.nodes.new("ShaderNodeGroup")
        node.node_tree = inner
        for name, value in values.items():
            node.inputs[name].default_value = value
        if linked_roughness:
            value = tree.nodes.new("ShaderNodeValue")
            value.outputs[0].default_value = 0.35
            tree.links.new(value.outputs[0], node.inputs["Roughness"])
        tree.links.new(node.outputs[0], output.inputs["Surface"])
    return build


@pytest.mark.parametrize("depth", [1, 3])
def test_principled_is_read_through_groups(scene: bpy.types.Scene, depth: int) -> None:
    warnings: list[str] = []
    values = {"Metallic": 1.0, "Base Color": (0.9, 0.5, 0.1, 1), "Roughness": 0.7}
    found = read(grouped(depth, values, linked_roughness=True), warnings)
    assert found.metallic == 1.0 and found.base_colour == pytest.approx((0.9, 0.5, 0.1))
    assert found.roughness == pytest.approx(0.35) and not warnings
    plain = add_material("P", grouped(depth, {"Base Color": (0.2, 0.4, 0.6, 1)}))
    assert constant_albedo(plain) == pytest.approx((0.2, 0.4, 0.6))


def test_metallic_is_a_metal(scene: bpy.types.Scene) -> None:
    tint = {"Base Color": (0.9, 0.5, 0.1, 1), "Edge Tint": (0.5, 0.6, 0.7, 1), "Roughness": 0.3}
    found = read(one_node("ShaderNodeBsdfMetallic", tint, fresnel_type="F82"))
    assert found.base_colour == pytest.approx((0.9, 0.5, 0.1)) and found.specular_tint == pytest.approx((0.5, 0.6, 0.7))
    assert found.metallic == 1.0 and found.roughness == pytest.approx(0.3) and found.specular_level == 0.0
    gold = read(one_node("ShaderNodeBsdfMetallic", {"IOR": (0.18, 0.42, 1.37), "Extinction": (3.42, 2.35, 1.77)},
                         fresnel_type="PHYSICAL_CONDUCTOR"))
    assert gold.base_colour == pytest.approx((0.944, 0.776, 0.373), abs=2e-3)


def test_other_lobes_than_ggx_are_named(scene: bpy.types.Scene) -> None:
    warnings: list[str] = []
    read(one_node("ShaderNodeBsdfAnisotropic", distribution="ASHIKHMIN_SHIRLEY"), warnings)
    assert len(warnings) == 1 and "Ashikhmin-Shirley" in warnings[0]
    read(one_node("ShaderNodeBsdfAnisotropic", distribution="GGX"), warnings)
    assert len(warnings) == 1


@pytest.mark.parametrize(("build", "colour"), [
    (one_node("ShaderNodeBsdfGlass", {"Color": (0.3, 0.6, 0.9, 1)}), (0.3, 0.6, 0.9)),
    (one_node("ShaderNodeBsdfRefraction", {"Color": (0.3, 0.6, 0.9, 1)}), (0.3, 0.6, 0.9)),
    (one_node("ShaderNodeBsdfPrincipled", {"Transmission Weight": 1.0, "Base Color": (0.3, 0.6, 0.9, 1)}),
     (0.3, 0.6, 0.9)),
    (mixed(None, METAL, CLEAR, shader="ShaderNodeAddShader"), (0.9, 0.5, 0.1)),
])
def test_what_is_not_read_is_not_black(scene: bpy.types.Scene, build: Build, colour: tuple[float, ...]) -> None:
    cube, warnings = add_cube("Vase"), []
    cube.data.materials.append(add_material("Odd", build))
    mesh, = read_objects(depsgraph(), None, warnings)
    assert np.allclose(mesh.corner_albedo, colour, atol=1e-3)
    line, = (w for w in warnings if "drawn as diffuse" in w)
    assert line.startswith("Vase: material Odd") and "node" in line and ";" in line


@pytest.mark.parametrize("build", [
    one_node("ShaderNodeBsdfDiffuse", {"Color": (0, 0, 0, 1)}), one_node("ShaderNodeEmission"),
    one_node("ShaderNodeBsdfPrincipled", {"Metallic": 1.0}), mixed(0.5, METAL, METAL), grouped(1, {"Metallic": 1.0}),
    one_node("ShaderNodeBsdfPrincipled", {"Base Color": (0, 0, 0, 1)})])
def test_what_is_black_or_a_metal_has_no_diffuse_colour(scene: bpy.types.Scene, build: Build) -> None:
    cube, warnings = add_cube(), []
    cube.data.materials.append(add_material("Black", build))
    mesh, = read_objects(depsgraph(), None, warnings)
    assert mesh.corner_albedo.max() < 1e-3 and not any("drawn as diffuse" in w for w in warnings)


@pytest.mark.parametrize("name", ["Coat Weight", "Sheen Weight", "Transmission Weight", "Thin Film Thickness"])
def test_what_is_left_out_is_named(scene: bpy.types.Scene, name: str) -> None:
    warnings: list[str] = []
    read(one_node("ShaderNodeBsdfPrincipled", {name: 0.5}), warnings)
    assert len(warnings) == 1 and name in warnings[0] and "left out" in warnings[0]
    warnings.clear()
    read(one_node("ShaderNodeBsdfPrincipled", {}), warnings)
    assert not warnings


def test_a_channel_or_the_alpha_of_an_image_is_what_is_averaged(scene: bpy.types.Scene) -> None:
    image = bpy.data.images.new("packed", 2, 1, is_data=True, alpha=True)
    image.pixels.foreach_set(np.array([0.2, 0.4, 0.6, 0.8, 0.2, 0.2, 0.6, 0.4], np.float32))

    def build(tree: bpy.types.NodeTree, output: bpy.types.Node) -> None:
        node, texture = tree.nodes.new("ShaderNodeBsdfPrincipled"), tree.nodes.new("ShaderNodeTexImage")
        parts = tree.nodes.new("ShaderNodeSeparateColor")
        texture.image = image
        tree.links.new(texture.outputs["Color"], parts.inputs[0])
        tree.links.new(parts.outputs["Green"], node.inputs["Roughness"])
        tree.links.new(parts.outputs["Blue"], node.inputs["Metallic"])
        tree.links.new(texture.outputs["Alpha"], node.inputs["Specular IOR Level"])
        tree.links.new(node.outputs[0], output.inputs["Surface"])
    found = read(build)
    assert (found.roughness, found.metallic, found.specular_level) == pytest.approx((0.3, 0.6, 0.6), abs=5e-3)


def test_uv_maps_count_where_images_are_seen_through_them(scene: bpy.types.Scene) -> None:
    cube = add_cube()
    for name in ("shown", "other"):
        cube.data.uv_layers.new(name=name)
    cube.data.uv_layers["shown"].active_render = True
    cube.data.materials.append(add_material("Plain", one_node("ShaderNodeBsdfPrincipled")))

    def moved(layer: str) -> bool:
        before = geometry_digest(cube, depsgraph())
        cube.data.uv_layers[layer].uv[0].vector = np.array(cube.data.uv_layers[layer].uv[0].vector) + 0.25
        cube.data.update()
        return geometry_digest(cube, depsgraph()) != before
    assert not moved("shown") and not moved("other")
    image = bpy.data.images.new("picture", 2, 2)
    cube.data.materials[0] = add_material("Textured", linked(
        "ShaderNodeTexImage", "Color", "Base Color", lambda n: setattr(n, "image", image)))
    assert moved("shown") and not moved("other")


def test_slots_materials_and_instances_reach_the_receivers(scene: bpy.types.Scene) -> None:
    cube = add_cube()
    for name, values in (("Matt", {"Specular IOR Level": 0.0}), ("Gold", {"Metallic": 1.0}), ("Wax", {
            "Subsurface Weight": 1.0})):
        cube.data.materials.append(add_material(name, one_node("ShaderNodeBsdfPrincipled", values)))
    cube.data.polygons.foreach_set("material_index", np.array([0, 1, 2, 0, 1, 7], np.int32))
    mesh, = read_objects(depsgraph())
    assert [m.name for m in mesh.materials] == ["", "Gold", "Wax"]
    assert sorted(np.bincount(mesh.material_index)) == [4, 4, 4]
    assert mesh.corner_tangents is None
    assembled = SceneMesh.assemble([mesh])
    assert np.array_equal(np.bincount(assembled.material), [8, 8, 8])


def add_test_mesh() -> bpy.types.Object:
    """A smooth sphere, dented and with a texture map of unequal scales, its triangles those of Cycles."""
    bpy.ops.mesh.primitive_uv_sphere_add(segments=24, ring_count=16)
    bpy.ops.object.mode_set(mode="EDIT")
    bpy.ops.mesh.quads_convert_to_tris()
    bpy.ops.object.mode_set(mode="OBJECT")
    bpy.ops.object.shade_smooth()
    sphere = bpy.context.object
    for vertex in sphere.data.vertices:
        vertex.co.x *= 1.0 + 0.3 * vertex.co.z
    sphere.data.update()
    return sphere


def cycles_tangents(scene_object: bpy.types.Object, build: Build) -> np.ndarray:
    """The tangents (corners, 3) that a node tree emits as colours, evaluated by Cycles."""
    def emitting(tree: bpy.types.NodeTree, output: bpy.types.Node) -> None:
        build(tree, output)
        source = tree.nodes[-1]
        scaled, emission = tree.nodes.new("ShaderNodeVectorMath"), tree.nodes.new("ShaderNodeEmission")
        scaled.operation = "MULTIPLY_ADD"
        scaled.inputs[1].default_value = scaled.inputs[2].default_value = (0.5, 0.5, 0.5)
        tree.links.new(source.outputs["Tangent"], scaled.inputs[0])
        tree.links.new(scaled.outputs[0], emission.inputs["Color"])
        tree.links.new(emission.outputs[0], output.inputs["Surface"])
    mesh = scene_object.data.copy()
    mesh.materials.clear()
    mesh.materials.append(add_material("Emits", emitting))
    with scratch_scene(bpy.context.scene) as scratch:
        return evaluate_corners(scratch, mesh, np.array(scene_object.matrix_world), "EMIT") * 2.0 - 1.0


def tangent_node(**properties: str) -> Build:
    def build(tree: bpy.types.NodeTree, output: bpy.types.Node) -> None:
        for name, value in properties.items():
            setattr(tree.nodes.new("ShaderNodeTangent") if name == "direction_type" else tree.nodes[-1], name, value)
    return build


def default_tangent(tree: bpy.types.NodeTree, output: bpy.types.Node) -> None:
    tree.nodes.new("ShaderNodeNewGeometry")  # Cycles links this to an unlinked Tangent


TRANSFORMS = {"none": Matrix.Identity(4), "scaled": Matrix.Rotation(0.7, 4, "Y") @ Matrix.Diagonal((1, 3, 0.5, 1)),
              "mirrored": Matrix.Rotation(0.4, 4, "X") @ Matrix.Diagonal((-1, 2, 1, 1))}
TANGENTS = {"default": (None, default_tangent), "X": ({"direction_type": "RADIAL", "axis": "X"}, None),
            "Y": ({"direction_type": "RADIAL", "axis": "Y"}, None),
            "UV": ({"direction_type": "UV_MAP", "uv_map": "UVMap"}, None)}


@pytest.mark.parametrize("transform", TRANSFORMS)
@pytest.mark.parametrize("kind", TANGENTS)
def test_tangents_are_those_of_cycles(scene: bpy.types.Scene, kind: str, transform: str) -> None:
    sphere = add_test_mesh()
    properties, build = TANGENTS[kind]

    def anisotropic(tree: bpy.types.NodeTree, output: bpy.types.Node) -> None:
        one_node("ShaderNodeBsdfPrincipled", {"Anisotropic": 0.8})(tree, output)
        if properties is not None:
            tangent_node(**properties)(tree, output)
            tree.links.new(tree.nodes[-1].outputs[0], tree.nodes["Principled BSDF"].inputs["Tangent"])
    sphere.data.materials.append(add_material("Brushed", anisotropic))
    place(sphere, TRANSFORMS[transform])
    mesh, = read_objects(depsgraph())
    assembled = SceneMesh.assemble([mesh])
    expected = cycles_tangents(sphere, build or tangent_node(**properties))
    corners = np.empty((len(sphere.data.loop_triangles), 3), np.int32)
    sphere.data.loop_triangles.foreach_get("loops", corners.ravel())
    if mesh.winding_flipped:
        corners = corners[:, [0, 2, 1]]
    expected = expected[corners].reshape(-1, 3)
    found = assembled.tangents[assembled.triangles].reshape(-1, 3)
    local = np.array(sphere.matrix_world.inverted())
    places = assembled.points[assembled.triangles].reshape(-1, 3) @ local[:3, :3].T + local[:3, 3]
    # Next to the axis every direction is as good as another, and Cycles evaluates a little inside the triangle. At the
    # seam of the map it keeps a tangent on each side, where a receiver takes their mean: 16 of 1,645 corners.
    axis = {"X": 0, "Y": 1}.get(kind, 2)
    away = np.abs(unit(places)[:, axis]) < 0.9
    angle = np.degrees(np.arccos(np.clip(np.sum(unit(found) * unit(expected), axis=1)[away], -1, 1)))
    assert away.mean() > 0.6
    assert np.percentile(angle, 94 if kind == "UV" else 100) < 0.2
    assert np.abs(np.sum(assembled.tangents * assembled.normals, axis=1)).max() < 1e-9


def test_generated_coordinates_come_from_before_deformation(scene: bpy.types.Scene) -> None:
    """A cast into a far place moves vertices, not the axis around which they were brushed."""
    sphere = add_test_mesh()
    sphere.data.materials.append(add_material("Brushed", one_node("ShaderNodeBsdfPrincipled", {"Anisotropic": 0.8})))
    before = SceneMesh.assemble(read_objects(depsgraph()))
    modifier = sphere.modifiers.new("Away", "DISPLACE")
    modifier.direction, modifier.strength, modifier.mid_level = "X", 7.0, 0.0
    after = SceneMesh.assemble(read_objects(depsgraph()))
    assert np.allclose(after.points, before.points + np.array([7.0, 0, 0]), atol=1e-4)
    assert np.allclose(after.tangents, before.tangents, atol=1e-4)


def render_of_cycles(build: Build, folder: Path) -> np.ndarray:
    """A sphere of this material under two Suns, direct light only: (32, 32, 3)."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    bpy.ops.mesh.primitive_uv_sphere_add(segments=32, ring_count=24)
    bpy.ops.object.shade_smooth()
    bpy.context.object.data.materials.append(add_material("M", build))
    for turn, energy in (((0.6, 0.2, 0.0), 3.0), ((1.2, 0.0, 1.0), 2.0)):
        sun = bpy.data.objects.new("Sun", bpy.data.lights.new("Sun", "SUN"))
        sun.data.energy, sun.rotation_euler = energy, turn
        scene.collection.objects.link(sun)
    scene.camera = bpy.data.objects.new("Camera", bpy.data.cameras.new("Camera"))
    scene.camera.data.type, scene.camera.data.ortho_scale = "ORTHO", 2.2
    scene.camera.location, scene.camera.rotation_euler = (0.0, -4.0, 4.0), (np.pi / 4, 0.0, 0.0)
    scene.collection.objects.link(scene.camera)
    scene.render.engine, scene.cycles.samples, scene.cycles.max_bounces = "CYCLES", 16, 0
    scene.cycles.use_denoising = False
    scene.render.resolution_x = scene.render.resolution_y = 32
    scene.render.image_settings.file_format = "OPEN_EXR"
    scene.render.filepath = str(folder / "render.exr")
    bpy.ops.render.render(write_still=True)
    image = bpy.data.images.load(scene.render.filepath)
    return np.array(image.pixels[:]).reshape(32, 32, 4)[..., :3]


@pytest.mark.parametrize("anisotropy", [0.4, -0.4])
def test_glossy_read_as_principled_renders_the_same_in_cycles(tmp_path: Path, anisotropy: float) -> None:
    values = {"Color": (0.8, 0.4, 0.1, 1), "Roughness": 0.5, "Anisotropy": anisotropy, "Rotation": 0.1}
    build = one_node("ShaderNodeBsdfAnisotropic", values, distribution="GGX")
    original, found = render_of_cycles(build, tmp_path), read(build)

    def principled(turn: float) -> Build:
        return one_node("ShaderNodeBsdfPrincipled", {
            "Base Color": (*found.base_colour, 1), "Roughness": found.roughness, "Metallic": found.metallic,
            "Specular Tint": (*found.specular_tint, 1), "Anisotropic": found.anisotropic,
            "Anisotropic Rotation": found.anisotropic_rotation + turn}, distribution="GGX")

    def difference(turn: float) -> float:
        rendered = render_of_cycles(principled(turn), tmp_path)
        return float(np.sqrt(((rendered - original) ** 2).mean() / (original ** 2).mean()))
    assert difference(0.0) < 1e-3
    assert difference(0.25) > 0.3
