# SPDX-License-Identifier: GPL-3.0-or-later
"""Bakes at texels in Blender: stored and read back, relit, exported as pictures, and as images on the user's mesh."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import bpy
import numpy as np
import pytest

from tests.blender import gpu_support  # noqa: F401  makes the checkout the package `prt`
from tests.blender.cycles import diffuse_material, use_cycles
from tests.blender.scenes import add_cube, add_mesh, depsgraph
from tests.blender.test_live_preview import GROUPS

# isort: split
from prt.operators import export_atlas, properties
from prt.operators.export import PRT_OT_export, export_bakes
from prt.operators.light_images import PRT_OT_light_images
from prt.operators.relit import radiance_arrays, read_all, relit
from prt.prt_addon.baking.recipe import bake, exhaust
from prt.prt_addon.baking.settings import make_settings
from prt.prt_addon.blender import fingerprint, light_images, stored
from prt.prt_addon.blender.own_colours import can_show, own_corners
from prt.prt_addon.blender.read_scene import read_objects
from prt.prt_addon.errors import StorageError
from prt.prt_addon.lighting.image_files import read_image
from prt.prt_addon.scene.scene_mesh import SceneMesh
from prt.prt_addon.scene.texel_receivers import TexelChoice

QUICK = {"directions": "256", "gather_directions": "64", "error_receivers": "0", "threads": "1", "bounces": "1"}


@pytest.fixture
def room(scene: bpy.types.Scene) -> dict[str, Any]:
    """A floor of one quad below a mirrored, moved cube, baked at texels and stored; the containers by name."""
    world = use_cycles(4)
    world.node_tree.nodes["Background"].inputs["Color"].default_value = (1.0, 0.5, 0.25, 1.0)
    floor = add_mesh("Floor", [(-2, -2, 0), (2, -2, 0), (2, 2, 0), (-2, 2, 0)], [(0, 1, 2, 3)])
    cube = add_cube()
    cube.location, cube.scale, cube.rotation_euler = (0.3, 0.2, 0.8), (-0.4, 0.5, 0.4), (0.1, 0.0, 0.5)
    for thing in (floor, cube):
        thing.data.materials.append(diffuse_material(thing.name, (0.5, 0.6, 0.7, 1.0)))
    mesh = SceneMesh.assemble(read_objects(depsgraph(), ["Floor", "Cube"]), 1 / 24, None, TexelChoice("texels", 64))
    found = exhaust(bake(mesh, make_settings("draft", QUICK))).objects
    for name, baked in found.items():
        stored.write_baked(bpy.data.objects[name], baked)
    return found


def test_what_is_stored_is_read_back(room: dict[str, Any]) -> None:
    for name, baked in room.items():
        mesh = stored.baked_mesh(bpy.data.objects[name])
        assert mesh.name == f"PRT {name}" and len(mesh.vertices) == len(baked.cluster)
        found = stored.read_baked(bpy.data.objects[name])
        assert np.allclose(found.positions, baked.positions, atol=1e-5)
        assert np.array_equal(found.triangles, baked.triangles) and np.array_equal(found.weights, baked.weights)
        for field, values in baked.texels.arrays().items():
            assert np.allclose(getattr(found.texels, field), values, atol=1e-5), field
        assert found.texels.numbers() == baked.texels.numbers()
    name = "Floor"
    mesh = stored.baked_mesh(bpy.data.objects[name])
    mesh["prt_atlas"] = [0.0, 1.0]
    with pytest.raises(StorageError, match="Floor: the atlas of its texels is missing or broken"):
        stored.read_baked(bpy.data.objects[name])
    assert stored.clear_baked(bpy.data.objects[name]) and stored.baked_mesh(bpy.data.objects[name]) is None
    assert "prt_atlas" not in bpy.data.objects[name].data


def test_light_is_right_at_texels_and_on_the_own_mesh(room: dict[str, Any], scene: bpy.types.Scene) -> None:
    baked = read_all(scene, "test")
    lit = relit(scene, baked)
    arrays = radiance_arrays(baked, lit)
    far = np.sqrt(np.sum(arrays["position"][:, :2] ** 2, axis=1)) > 2.5  # of the floor's corners: an open sky
    floor = arrays["object"] == "Floor"
    lit_fully = (arrays["albedo"] * (1.0, 0.5, 0.25))[far & floor]
    assert np.abs(arrays["radiance"][far & floor] / lit_fully - 1.0).max() < 0.1
    assert arrays["radiance"][floor].min() < 0.8 * arrays["radiance"][floor & far].min()
    assert can_show(bpy.data.objects["Floor"])
    corners = own_corners(bpy.data.objects["Floor"], baked["Floor"])
    assert len(corners) == 4 and np.allclose(np.abs(baked["Floor"].positions[corners, :2]), 2.0, atol=1e-5)


def test_export_writes_pictures_and_a_surface_with_uvs(room: dict[str, Any], scene: bpy.types.Scene,
                                                       tmp_path: Path) -> None:
    baked = read_all(scene, "test")
    lit = relit(scene, baked)
    written = [path.name for path in export_bakes(baked, tmp_path / "out", lit)]
    assert {"0000_Floor_light.exr", "0000_Floor_weights.exr", "0001_Cube_surface.obj", "baked.json"} <= set(written)
    texels = baked["Floor"].texels
    picture = read_image(tmp_path / "out" / "0000_Floor_light.exr")[::-1]
    radiance = lit.radiance("Floor", baked["Floor"])
    assert np.array_equal(picture[texels.row, texels.column], radiance.astype(np.float32))
    channels = export_atlas.weight_channels(baked["Floor"])
    assert np.array_equal(channels["cluster"][texels.row, texels.column], baked["Floor"].cluster)
    assert np.array_equal(channels["w001"][texels.row, texels.column], baked["Floor"].weights[:, 1])
    outside = np.ones(channels["cluster"].shape, bool)
    outside[texels.row, texels.column] = False
    assert (channels["cluster"][outside] == -1).all()
    lines = (tmp_path / "out" / "0001_Cube_surface.obj").read_text().splitlines()
    assert sum(line.startswith("f ") for line in lines) == 12 and sum(line.startswith("vt ") for line in lines) == 36


def test_images_lie_on_the_users_mesh(room: dict[str, Any], scene: bpy.types.Scene) -> None:
    baked = read_all(scene, "test")
    lit = relit(scene, baked)
    for name, transfer in baked.items():
        thing = bpy.data.objects[name]
        assert light_images.write_uv_map(thing, transfer)
        radiance = lit.radiance(name, transfer)
        image = light_images.write_image(f"PRT {name}", export_atlas.atlas_picture(transfer.texels, radiance, 2))
        image = light_images.write_image(f"PRT {name}", export_atlas.atlas_picture(transfer.texels, radiance, 2))
        assert sum(i.name.startswith(f"PRT {name}") for i in bpy.data.images) == 1
        size, layer = np.array(image.size), thing.data.uv_layers["PRT Atlas"]
        pixels = np.empty(4 * size.prod(), np.float32)
        image.pixels.foreach_get(pixels)
        pixels = pixels.reshape(size[1], size[0], 4)
        # A corner of the mesh is a texel's place: what a renderer samples there is that texel's light.
        for loop in thing.data.loops:
            column, row = np.rint(np.array(layer.uv[loop.index].vector) * size - 0.5).astype(int)
            texel = np.flatnonzero((transfer.texels.column == column) & (transfer.texels.row == row))
            place = thing.matrix_world @ thing.data.vertices[loop.vertex_index].co
            assert len(texel) == 1 and np.allclose(transfer.positions[texel[0]], place, atol=1e-4)
            assert np.allclose(pixels[row, column, :3], radiance[texel[0]], atol=1e-5)
    assert stored.stale(bpy.data.objects["Floor"], depsgraph()) is None
    bpy.data.images.remove(bpy.data.images["PRT Floor"])
    bpy.data.images.new("PRT Floor", 4, 4)
    with pytest.raises(StorageError, match="PRT Floor: an image of this name is in the way"):
        light_images.write_image("PRT Floor", np.zeros((4, 4, 3), np.float32))
    bpy.data.objects["Cube"].modifiers.new("Bevel", "BEVEL")
    assert not light_images.write_uv_map(bpy.data.objects["Cube"], baked["Cube"])


def shown_by_image(image: bpy.types.Image) -> bpy.types.Material:
    """A material that emits an image as the atlas' UV map lays it on the surface."""
    material = bpy.data.materials.new("Shows it")
    nodes, links = material.node_tree.nodes, material.node_tree.links
    picture, places, glow = (nodes.new(f"ShaderNode{kind}") for kind in ("TexImage", "UVMap", "Emission"))
    picture.image, places.uv_map = image, "PRT Atlas"
    links.new(places.outputs["UV"], picture.inputs["Vector"])
    links.new(picture.outputs["Color"], glow.inputs["Color"])
    links.new(glow.outputs["Emission"], nodes["Material Output"].inputs["Surface"])
    return material


def test_a_material_that_shows_the_image_makes_nothing_stale(room: dict[str, Any]) -> None:
    floor = bpy.data.objects["Floor"]
    stored.write_baked(floor, room["Floor"], fingerprint.fingerprint(floor, depsgraph()))
    light_images.write_uv_map(floor, room["Floor"])
    picture = np.ones((room["Floor"].texels.height, room["Floor"].texels.width, 3), np.float32)
    floor.data.materials[0] = shown_by_image(light_images.write_image("PRT Floor", picture))
    assert stored.stale(floor, depsgraph()) is None
    floor.data.materials[0] = shown_by_image(bpy.data.images.new("Another", 4, 4))
    assert stored.stale(floor, depsgraph()) == "its materials changed since the bake"


def test_clearing_takes_image_and_uv_map_along_unless_they_are_used(room: dict[str, Any]) -> None:
    for name, baked in room.items():
        thing, size = bpy.data.objects[name], (baked.texels.height, baked.texels.width, 3)
        assert light_images.write_uv_map(thing, baked)
        image = light_images.write_image(f"PRT {name}", np.ones(size, np.float32))
    cube = bpy.data.objects["Cube"]
    cube.data.materials[0] = shown_by_image(image)
    for thing in (bpy.data.objects["Floor"], cube):
        light_images.drop_light_images(thing)
    assert "PRT Floor" not in bpy.data.images and not bpy.data.objects["Floor"].data.uv_layers
    assert "PRT Cube" in bpy.data.images and "PRT Atlas" in cube.data.uv_layers


def test_images_and_exports_show_lamps_from_afar_where_the_panel_does(room: dict[str, Any], scene: bpy.types.Scene,
                                                                      tmp_path: Path) -> None:
    classes = (*GROUPS, PRT_OT_light_images, PRT_OT_export)
    for one in classes:
        bpy.utils.register_class(one)
    properties.register()
    try:
        lamp = bpy.data.objects.new("Far", bpy.data.lights.new("Far", "POINT"))
        lamp.location, lamp.data.energy = (3.0, -6.0, 6.0), 5000.0
        scene.collection.objects.link(lamp)
        means = []
        for shown in (False, True):
            scene.prt.lamps_by_directions = shown
            wanted = relit(scene, room, by_directions=shown).radiance("Floor", room["Floor"])
            assert bpy.ops.prt.light_images() == {"FINISHED"}
            assert bpy.ops.prt.export(directory=str(tmp_path / "out")) == {"FINISHED"}
            texels, image = room["Floor"].texels, bpy.data.images["PRT Floor"]
            pixels = np.array(image.pixels[:], np.float32).reshape(image.size[1], image.size[0], 4)[..., :3]
            for picture in (pixels, read_image(tmp_path / "out" / "0000_Floor_light.exr")[::-1]):
                assert np.allclose(picture[texels.row, texels.column], wanted, rtol=1e-4, atol=1e-5)
            means.append(float(wanted.mean()))
        assert means[1] > 1.2 * means[0]
    finally:
        properties.unregister()
        for one in reversed(classes):
            bpy.utils.unregister_class(one)
