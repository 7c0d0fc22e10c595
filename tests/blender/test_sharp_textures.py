# SPDX-License-Identifier: GPL-3.0-or-later
"""Image textures on baked surfaces, pixel by pixel against renders of Cycles from the same camera."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import bpy
import numpy as np
import pytest

from tests.blender import gpu_support  # makes the checkout the package `prt`
from tests.blender.cycles import use_cycles
from tests.blender.scenes import add_mesh, depsgraph

# isort: split
from prt.gpu_shaders import offscreen, programs
from prt.gpu_shaders.render_data import DrawItem
from prt.prt_addon.baking.recipe import bake, exhaust
from prt.prt_addon.baking.settings import make_settings
from prt.prt_addon.blender import image_albedo, stored
from prt.prt_addon.blender.read_scene import read_objects
from prt.prt_addon.scene.scene_mesh import SceneMesh

WIDTH, HEIGHT, SAMPLES = 160, 120, 4
SKY = 0.8  # radiance of the constant World


@pytest.fixture(autouse=True, scope="module")
def graphics() -> Iterator[None]:
    gpu_support.require_gpu()
    yield
    programs.release()


@pytest.fixture
def lit(scene: bpy.types.Scene) -> bpy.types.Scene:
    """An empty scene under a constant World, with a camera that looks down on the origin at a slant."""
    world = use_cycles(16)
    world.node_tree.nodes["Background"].inputs["Color"].default_value = (SKY, SKY, SKY, 1.0)
    world.cycles.sampling_method = "NONE"
    scene.cycles.pixel_filter_type = "BOX"
    scene.render.resolution_x, scene.render.resolution_y, scene.render.resolution_percentage = WIDTH, HEIGHT, 100
    camera = bpy.data.objects.new("Camera", bpy.data.cameras.new("Camera"))
    camera.location, camera.rotation_euler = (0.4, -2.2, 2.6), (0.68, 0.0, 0.18)
    scene.collection.objects.link(camera)
    scene.camera = camera
    return scene


def add_image(name: str, pixels: np.ndarray, space: str = "sRGB", is_float: bool = False) -> bpy.types.Image:
    """An image packed into the file. pixels: (height, width, 4), row 0 at the bottom, as the file has them."""
    image = bpy.data.images.new(name, pixels.shape[1], pixels.shape[0], alpha=True, float_buffer=is_float)
    image.colorspace_settings.name = space
    image.pixels.foreach_set(np.ascontiguousarray(pixels, np.float32).ravel())
    image.update()
    image.pack()
    return image


def checker(side: int = 8, cell: int = 8, colours: tuple = ((0.9, 0.3, 0.1), (0.1, 0.35, 0.8))) -> np.ndarray:
    """A checker of side x side cells with a third colour in one corner, so that no flip or turn goes unseen."""
    rows, columns = np.indices((side * cell, side * cell)) // cell
    pixels = np.ones((side * cell, side * cell, 4))
    pixels[..., :3] = np.where(((rows + columns) % 2 == 0)[..., None], *colours)
    pixels[:2 * cell, :2 * cell, :3] = (0.1, 0.8, 0.2)
    return pixels


def image_material(name: str, image: bpy.types.Image, **settings: object) -> tuple[bpy.types.Material, Any]:
    """A matt Principled BSDF whose Base Color is the image; and the image's node."""
    material = bpy.data.materials.new(name)
    tree = material.node_tree
    shader = tree.nodes["Principled BSDF"]
    shader.inputs["Specular IOR Level"].default_value = 0.0
    node = tree.nodes.new("ShaderNodeTexImage")
    node.image = image
    for key, value in settings.items():
        setattr(node, key, value)
    tree.links.new(node.outputs["Color"], shader.inputs["Base Color"])
    return material, node


def add_plane(material: bpy.types.Material, scale: float = 1.0) -> bpy.types.Object:
    """Four vertices, one face from -1 to 1 whose UV map fills 0..scale."""
    plane = add_mesh("Plane", [(-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0)], [(0, 1, 2, 3)])
    layer = plane.data.uv_layers.new(name="Map")
    layer.uv.foreach_set("vector", np.array([(0, 0), (1, 0), (1, 1), (0, 1)], np.float32).ravel() * scale)
    plane.data.materials.append(material)
    return plane


def bake_and_store(*names: str, spacing: float = 0.0) -> None:
    """A bake of direct light, stored as the product stores it."""
    mesh = SceneMesh.assemble(read_objects(depsgraph(), names), spacing)
    settings = make_settings("draft", {"order": "3", "bounces": "0", "error_receivers": "0", "threads": "1"})
    for name, container in exhaust(bake(mesh, settings)).objects.items():
        stored.write_baked(bpy.data.objects[name], container)


def drawn(names: tuple[str, ...], textured: bool = True, samples: int = SAMPLES) -> np.ndarray:
    """The preview's picture (height, width, 4) under the constant World."""
    light, items = np.zeros((9, 3)), []
    light[0] = SKY * math.sqrt(4.0 * math.pi)
    for name in names:
        found = bpy.data.objects[name]
        baked = stored.read_baked(found)
        textures = image_albedo.surface_textures(found, baked, depsgraph()) if textured else None
        assert (textures is not None) == textured
        moved = stored.transform_since_bake(found, baked.header)
        items.append(DrawItem(name, baked, moved, light, textures=textures))
    return offscreen.draw_items(bpy.context.scene, items, WIDTH, HEIGHT, samples=samples)


def rendered(folder: Path) -> np.ndarray:
    """Cycles' picture (height, width, 3), row 0 up."""
    scene = bpy.context.scene
    scene.render.film_transparent = True
    scene.render.image_settings.file_format = "OPEN_EXR"
    scene.render.filepath = str(folder / "cycles.exr")
    bpy.ops.render.render(write_still=True)
    image = bpy.data.images.load(scene.render.filepath)
    pixels = np.empty(WIDTH * HEIGHT * 4, np.float32)
    image.pixels.foreach_get(pixels)
    bpy.data.images.remove(image)
    return pixels.reshape(HEIGHT, WIDTH, 4)[::-1, :, :3]


def even(picture: np.ndarray, spread: float = 0.03) -> np.ndarray:
    """Pixels (height, width) that are lit and have the colour of all their neighbours: away from edges."""
    low, high = picture.copy(), picture.copy()
    for down in (-1, 0, 1):
        for right in (-1, 0, 1):
            moved = np.roll(picture, (down, right), axis=(0, 1))
            low, high = np.minimum(low, moved), np.maximum(high, moved)
    inside = np.zeros(picture.shape[:2], bool)
    inside[1:-1, 1:-1] = True
    return inside & ((high - low).max(axis=2) < spread * max(float(picture.max()), 1e-6)) & (low.max(axis=2) > 1e-3)


def difference(ours: np.ndarray, theirs: np.ndarray) -> float:
    """Largest relative difference away from edges, each pixel's over its brightest channel in Cycles."""
    where = even(theirs)
    assert where.mean() > 0.1
    off = np.abs(ours[..., :3] - theirs)[where].max(axis=1) / theirs[where].max(axis=1)
    return float(off.max())


@pytest.mark.parametrize("space", ["sRGB", "Non-Color"])
def test_four_vertices_show_a_checker_as_cycles_does(lit: Any, tmp_path: Path, space: str) -> None:
    add_plane(image_material("Checker", add_image("checker", checker(), space))[0])
    bake_and_store("Plane")
    ours, theirs = drawn(("Plane",)), rendered(tmp_path)
    assert difference(ours, theirs) < 0.01
    # Per vertex none of it is there, so that the test can fail.
    assert difference(drawn(("Plane",), textured=False), theirs) > 0.2
    # As sharp: the squared steps from pixel to pixel, edges included, add up to as much; half a pixel of blur shows.
    interior = even(np.repeat((drawn(("Plane",), textured=False)[..., 3:] > 0.99).astype(float), 3, axis=2))
    inside = interior[:, 1:] & interior[:, :-1]
    blurred = (ours + np.roll(ours, 1, axis=1)) / 2.0
    sharp, soft, wanted = (np.square(np.diff(picture[..., 0], axis=1))[inside].sum()
                           for picture in (ours, blurred, theirs))
    print(f"{space}: squared steps {sharp / wanted:.3f} of Cycles', half a pixel softer {soft / wanted:.3f}")
    assert abs(sharp / wanted - 1.0) < 0.02 and soft < 0.9 * wanted
    assert np.abs(ours[..., :3] - theirs).mean() < 0.01 * theirs[theirs > 0.0].mean()


@pytest.mark.parametrize("extension", ["REPEAT", "EXTEND", "CLIP", "MIRROR"])
@pytest.mark.parametrize("interpolation", ["Linear", "Closest"])
def test_extension_interpolation_and_mapping(lit: Any, tmp_path: Path, extension: str, interpolation: str) -> None:
    """A few large texels, placed by a Mapping node, beyond the image's edges."""
    pixels = checker(4, 1)
    material, node = image_material("Few", add_image("few", pixels), extension=extension, interpolation=interpolation)
    mapping, map_node = (material.node_tree.nodes.new(kind) for kind in ("ShaderNodeMapping", "ShaderNodeUVMap"))
    map_node.uv_map = "Map"
    mapping.inputs["Location"].default_value = (-0.3, 0.2, 0.0)
    mapping.inputs["Rotation"].default_value = (0.0, 0.0, 0.3)
    mapping.inputs["Scale"].default_value = (0.9, 1.3, 1.0)
    material.node_tree.links.new(map_node.outputs["UV"], mapping.inputs["Vector"])
    material.node_tree.links.new(mapping.outputs["Vector"], node.inputs["Vector"])
    add_plane(material, 1.6)
    bake_and_store("Plane")
    ours, theirs = drawn(("Plane",))[..., :3], rendered(tmp_path)
    error = np.abs(ours - theirs).max(axis=2)
    print(f"{extension} {interpolation}: mean {error.mean():.5f}, 99 % {np.quantile(error, 0.99):.4f}")
    assert error.mean() < 0.005 * SKY and np.quantile(error, 0.9) < 0.005 * SKY


@pytest.mark.parametrize("kind", ["float", "alpha", "multiplied"])
def test_float_images_alpha_and_multiplied_colours(lit: Any, tmp_path: Path, kind: str) -> None:
    pixels = checker()
    if kind == "alpha":
        pixels[16:48, 16:48, 3] = 0.5
    image = add_image("checker", pixels, "Linear Rec.709" if kind == "float" else "sRGB", kind == "float")
    material, node = image_material("Checker", image)
    if kind == "multiplied":
        mix = material.node_tree.nodes.new("ShaderNodeMix")
        mix.data_type, mix.blend_type = "RGBA", "MULTIPLY"
        mix.inputs["Factor"].default_value = 0.7
        mix.inputs["B"].default_value = mix.inputs[7].default_value = (0.9, 0.5, 0.2, 1.0)
        material.node_tree.links.new(node.outputs["Color"], mix.inputs[6])
        material.node_tree.links.new(mix.outputs[2], material.node_tree.nodes["Principled BSDF"].inputs["Base Color"])
    add_plane(material)
    bake_and_store("Plane")
    assert difference(drawn(("Plane",)), rendered(tmp_path)) < 0.01


def test_a_sphere_with_a_seam(lit: Any, tmp_path: Path) -> None:
    """Many vertices, a pole and a seam, on a turned object; refined, so that receivers lie on a mesh of their own."""
    bpy.ops.mesh.primitive_uv_sphere_add(segments=32, ring_count=16, radius=0.9, rotation=(0.5, 0.2, 2.0))
    ball = bpy.context.object
    ball.name = "Ball"
    bpy.ops.object.shade_smooth()
    ball.data.materials.append(image_material("Checker", add_image("checker", checker(16, 8)))[0])
    bake_and_store("Ball", spacing=0.06)
    assert "prt_receiver" in ball and len(ball["prt_receiver"].vertices) > len(ball.data.vertices)
    ours, theirs = drawn(("Ball",)), rendered(tmp_path)
    where = even(theirs)
    off = np.abs(ours[..., :3] - theirs)[where].max(axis=1) / theirs[where].max(axis=1)
    assert np.quantile(off, 0.98) < 0.03 and off.mean() < 0.01  # 32 segments shade flat faces as round ones


def test_two_materials_with_two_textures(lit: Any, tmp_path: Path) -> None:
    plane = add_mesh("Two", [(x, y, 0) for y in (-1, 1) for x in (-1, 0, 1)], [(0, 1, 4, 3), (1, 2, 5, 4)])
    layer = plane.data.uv_layers.new(name="Map")
    layer.uv.foreach_set("vector", np.array([(0, 0), (1, 0), (1, 1), (0, 1)] * 2, np.float32).ravel())
    for name, colours in (("A", ((0.9, 0.9, 0.2), (0.3, 0.1, 0.1))), ("B", ((0.2, 0.9, 0.9), (0.5, 0.1, 0.6)))):
        plane.data.materials.append(image_material(name, add_image(name, checker(4, 8, colours)))[0])
    plane.data.polygons[1].material_index = 1
    bake_and_store("Two", spacing=0.1)
    assert difference(drawn(("Two",)), rendered(tmp_path)) < 0.01


def test_a_plain_material_beside_a_textured_one(lit: Any, tmp_path: Path) -> None:
    plane = add_mesh("Two", [(x, y, 0) for y in (-1, 1) for x in (-1, 0, 1)], [(0, 1, 4, 3), (1, 2, 5, 4)])
    layer = plane.data.uv_layers.new(name="Map")
    layer.uv.foreach_set("vector", np.array([(0, 0), (1, 0), (1, 1), (0, 1)] * 2, np.float32).ravel())
    plain = bpy.data.materials.new("Plain")
    plain.node_tree.nodes["Principled BSDF"].inputs["Base Color"].default_value = (0.2, 0.5, 0.3, 1.0)
    plain.node_tree.nodes["Principled BSDF"].inputs["Specular IOR Level"].default_value = 0.0
    plane.data.materials.append(plain)
    plane.data.materials.append(image_material("A", add_image("A", checker(4, 8)))[0])
    plane.data.polygons[1].material_index = 1
    bake_and_store("Two")
    assert difference(drawn(("Two",)), rendered(tmp_path)) < 0.01


def test_the_picture_follows_the_image(lit: Any) -> None:
    image = add_image("checker", checker())
    add_plane(image_material("Checker", image)[0])
    bake_and_store("Plane")
    before = drawn(("Plane",))
    pixels = checker()
    pixels[..., :3] = (0.5, 0.5, 0.5)
    image.pixels.foreach_set(pixels.astype(np.float32).ravel())
    image.update()
    after = drawn(("Plane",))
    grey = ((0.5 + 0.055) / 1.055) ** 2.4 * SKY
    inside = after[..., 3] == 1.0
    assert np.abs(after[inside][:, :3] - grey).max() < 0.01 and np.abs(after - before)[inside].mean() > 0.1
    assert stored.stale(bpy.data.objects["Plane"], depsgraph()) is None  # painting alone is no reason to dim it


def test_vertices_have_the_image_at_their_place(lit: Any) -> None:
    """What bounces, and what is drawn without UVs: the image at the vertex, not its mean."""
    image = add_image("checker", checker())
    plane = add_plane(image_material("Checker", image)[0], 0.9)
    layer = plane.data.uv_layers["Map"]
    uv = np.empty((4, 2), np.float32)
    layer.uv.foreach_get("vector", uv.ravel())
    uv += 0.05
    layer.uv.foreach_set("vector", uv.ravel())
    bake_and_store("Plane")
    colours = checker()[(uv[:, 1] * 64).astype(int), (uv[:, 0] * 64).astype(int), :3]
    linear = np.where(colours > 0.04045, ((colours + 0.055) / 1.055) ** 2.4, colours / 12.92)
    assert np.abs(stored.read_baked(plane).albedo - linear).max() < 0.01


def _no_uv(plane: Any, _material: Any, _node: Any) -> None:
    plane.data.uv_layers.remove(plane.data.uv_layers[0])


def _box(_plane: Any, _material: Any, node: Any) -> None:
    node.projection = "BOX"


def _generated(_plane: Any, material: Any, node: Any) -> None:
    coordinates = material.node_tree.nodes.new("ShaderNodeTexCoord")
    material.node_tree.links.new(coordinates.outputs["Generated"], node.inputs["Vector"])


def _varying_metal(_plane: Any, material: Any, node: Any) -> None:
    material.node_tree.links.new(node.outputs["Color"], material.node_tree.nodes["Principled BSDF"].inputs["Metallic"])


def _inverted(_plane: Any, material: Any, node: Any) -> None:
    invert = material.node_tree.nodes.new("ShaderNodeInvert")
    material.node_tree.links.new(node.outputs["Color"], invert.inputs["Color"])
    material.node_tree.links.new(invert.outputs["Color"], material.node_tree.nodes["Principled BSDF"].inputs[0])


@pytest.mark.parametrize("change", [_no_uv, _box, _generated, _varying_metal, _inverted])
def test_what_is_not_read_stays_per_vertex(lit: Any, change: Callable[..., None]) -> None:
    material, node = image_material("Checker", add_image("checker", checker()))
    plane = add_plane(material)
    change(plane, material, node)
    bake_and_store("Plane")
    assert image_albedo.surface_textures(plane, stored.read_baked(plane), depsgraph()) is None


def test_a_missing_image_falls_back_to_the_points(lit: Any) -> None:
    image = add_image("checker", checker())
    plane = add_plane(image_material("Checker", image)[0])
    bake_and_store("Plane")
    baked = stored.read_baked(plane)
    textures = image_albedo.surface_textures(plane, baked, depsgraph())
    light = np.zeros((9, 3))
    light[0] = 1.0
    bpy.data.images.remove(image)
    pictures = [offscreen.draw_items(bpy.context.scene, [DrawItem("Plane", baked, np.eye(4), light, textures=used)],
                                     WIDTH, HEIGHT) for used in (textures, None)]
    assert np.array_equal(*pictures)


@pytest.mark.parametrize("kind", ["mirrored", "subdivided", "instanced"])
def test_whatever_makes_the_mesh(lit: Any, tmp_path: Path, kind: str) -> None:
    """A mirrored object, one with a modifier and a collection instance: their triangles are found all the same."""
    plane = add_plane(image_material("Checker", add_image("checker", checker()))[0])
    name = "Plane"
    if kind == "mirrored":
        plane.scale = (-1.0, 0.8, 1.0)
    elif kind == "subdivided":
        modifier = plane.modifiers.new("Subdivision", "SUBSURF")
        modifier.subdivision_type, modifier.levels = "SIMPLE", 3
    else:
        collection = bpy.data.collections.new("Instanced")
        bpy.context.scene.collection.objects.unlink(plane)
        collection.objects.link(plane)
        empty = bpy.data.objects.new("Instance", None)
        empty.instance_type, empty.instance_collection = "COLLECTION", collection
        empty.rotation_euler = (0.0, 0.0, 0.5)
        bpy.context.scene.collection.objects.link(empty)
        name = "Instance"
    bake_and_store(name, spacing=0.3 if kind == "mirrored" else 0.0)
    if kind == "instanced":  # its materials are not in slots of its own: stays per vertex, as before
        empty = bpy.data.objects[name]
        assert image_albedo.surface_textures(empty, stored.read_baked(empty), depsgraph()) is None
    else:
        assert difference(drawn((name,)), rendered(tmp_path)) < 0.01


@pytest.mark.parametrize("functions", [(), tuple(range(9))])
def test_view_dependent_light_is_no_part_of_the_texture(lit: Any, functions: tuple[int, ...]) -> None:
    """A texture that is linear in its place, beside points that have its value: the same picture by both programs."""
    from prt.prt_addon.scene.surface_textures import SurfaceTextures, TextureUse

    generator = np.random.default_rng(6)
    points, triangles = gpu_support.grid_mesh(9, generator)
    baked = gpu_support.made_up_bake(points, triangles, generator, clusters=4, vectors=2, functions=functions)
    ramp = np.ones((64, 64, 4))
    ramp[..., 0], ramp[..., 1] = np.meshgrid((np.arange(64) + 0.5) / 64, (np.arange(64) + 0.5) / 64)
    ramp[..., 2] = 0.5
    add_image("ramp", ramp, "Linear Rec.709", is_float=True)
    places = (0.5 + 0.45 * points[:, :2]).astype(np.float32)
    baked.albedo[:] = np.concatenate([places, np.full((len(points), 1), 0.5)], axis=1) * (0.9, 0.8, 0.7)
    use = TextureUse(("ramp", None), (0.9, 0.8, 0.7), True, "REPEAT")
    textures = SurfaceTextures((use,), np.zeros(len(triangles), np.int32), places[triangles], "ramp")
    light = gpu_support.bright_light(25, generator)
    pictures = [offscreen.draw_items(bpy.context.scene, [DrawItem("A", baked, np.eye(4), light, textures=used)],
                                     WIDTH, HEIGHT, samples=1) for used in (textures, None)]
    assert (pictures[0][..., 3] > 0.0).mean() > 0.2
    assert np.abs(pictures[0] - pictures[1]).max() < 2e-3 * pictures[1].max()


def test_a_baked_object_that_only_instances_show(lit: Any) -> None:
    """As after appending or linking its collection: its textures are found where instances place it."""
    plane = add_plane(image_material("Checker", add_image("checker", checker()))[0])
    bake_and_store("Plane", spacing=0.3)
    baked = stored.read_baked(plane)
    before = image_albedo.surface_textures(plane, baked, depsgraph())
    collection = bpy.data.collections.new("Instanced")
    bpy.context.scene.collection.objects.unlink(plane)
    collection.objects.link(plane)
    empty = bpy.data.objects.new("Instance", None)
    empty.instance_type, empty.instance_collection, empty.location = "COLLECTION", collection, (3.0, 1.0, 0.0)
    bpy.context.scene.collection.objects.link(empty)
    after = image_albedo.surface_textures(plane, baked, depsgraph())
    assert after is not None and after.key == before.key
