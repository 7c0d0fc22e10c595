# SPDX-License-Identifier: GPL-3.0-or-later
"""The World and the lamps as light coefficients: read from values or evaluated by Cycles, both must say the same."""

from __future__ import annotations

import math
from pathlib import Path

import bpy
import numpy as np
import pytest
from mathutils import Euler

from prt_addon.basis.directions import spherical_fibonacci
from prt_addon.basis.spherical_harmonics import evaluate, zonal_cosine
from prt_addon.blender import lights, world, world_render
from prt_addon.errors import PRTError
from prt_addon.lighting.environment import apply_bands, direction_of_pixel, project
from tests.blender.cycles import add_white_facets, baked_irradiance, use_cycles
from tests.blender.scenes import add_cube, depsgraph, user_data_lines
from tests.blender.test_environment_orientation import set_world, smooth_image, write_image

ORDER = 6
CONSTANT = math.sqrt(4.0 * math.pi)  # coefficient of a unit environment in band 0


def coefficients(scene: bpy.types.Scene, **options: object) -> np.ndarray:
    return lights.light_coefficients(scene, depsgraph(), ORDER, **options).coefficients


def new_world(scene: bpy.types.Scene, colour: tuple[float, ...] = (1, 1, 1, 1), strength: float = 1.0,
              ) -> tuple[bpy.types.NodeTree, bpy.types.Node]:
    """A World of one Background node: its tree and that node."""
    scene.world = bpy.data.worlds.new("World")
    background = scene.world.node_tree.nodes["Background"]
    background.inputs["Color"].default_value, background.inputs["Strength"].default_value = colour, strength
    return scene.world.node_tree, background


@pytest.fixture(autouse=True)
def fast(monkeypatch: pytest.MonkeyPatch) -> None:
    """Small pictures, and nothing cached by another test."""
    monkeypatch.setattr(world_render, "SMALLEST_WIDTH", 256)
    monkeypatch.setattr(world, "_cache", {})


@pytest.fixture
def hdri(tmp_path: Path) -> Path:
    """An environment file without symmetry."""
    return write_image(tmp_path / "sky.exr", smooth_image())


def relative(found: np.ndarray, expected: np.ndarray) -> float:
    return float(np.linalg.norm(found - expected) / np.linalg.norm(expected))


def test_plain_colour_and_strength(scene: bpy.types.Scene) -> None:
    new_world(scene, (0.5, 0.25, 0.125, 1.0), 3.0)
    found = coefficients(scene)
    assert np.allclose(found[0], np.array([1.5, 0.75, 0.375]) * CONSTANT, rtol=1e-12)
    assert np.abs(found[1:]).max() < 1e-12
    by_cycles = world.read_environment(scene, depsgraph(), use_fast_paths=False)
    assert by_cycles.kind == "nodes"
    assert np.allclose(by_cycles.projected.coefficients[0], found[0], rtol=1e-6)


@pytest.mark.parametrize("make", [lambda scene: None, lambda scene: new_world(scene, strength=0.0),
                                  lambda scene: new_world(scene)[0].nodes.clear()], ids=["none", "black", "no output"])
def test_no_light_is_said(scene: bpy.types.Scene, make: object) -> None:
    make(scene)
    light = lights.light_coefficients(scene, depsgraph(), ORDER)
    assert not light.coefficients.any()
    assert "gives no light" in light.warnings[0]
    assert lights.reference_light(depsgraph()) is None


@pytest.mark.parametrize("rotation", [None, (0.0, 0.0, 0.9), (0.4, -0.7, 1.1)])
def test_hdri_read_and_evaluated_by_cycles_agree(scene: bpy.types.Scene, hdri: Path, rotation: object) -> None:
    new_world(scene, strength=2.0)
    set_world(scene.world, hdri, rotation)
    expected = 2.0 * project(smooth_image(), ORDER,
                             None if rotation is None else np.array(Euler(rotation).to_matrix()).T)
    fast = world.read_environment(scene, depsgraph())
    slow = world.read_environment(scene, depsgraph(), use_fast_paths=False)
    assert (fast.kind, slow.kind) == ("image", "nodes")
    assert relative(coefficients(scene), expected) < 1e-4  # half floats in the file
    # Cycles blurs between pixels: half a per mille at 2.8 degrees.
    assert relative(slow.projected.coefficients[:ORDER ** 2], expected) < 2e-3


def test_blenders_own_hdris_agree_on_both_paths(scene: bpy.types.Scene) -> None:
    folder = Path(bpy.utils.resource_path("LOCAL")) / "datafiles" / "studiolights" / "world"
    new_world(scene)
    set_world(scene.world, folder / "forest.exr", (0.0, 0.0, 2.0))
    fast = coefficients(scene)
    slow = world.read_environment(scene, depsgraph(), use_fast_paths=False).projected
    assert relative(slow.coefficients[:ORDER ** 2], fast) < 2e-3


def test_any_node_tree_gives_cycles_irradiance(scene: bpy.types.Scene) -> None:
    """A mix of two gradients that no fast path covers, against irradiance that Cycles bakes by itself."""
    tree = use_cycles(256).node_tree
    coordinates, separate = tree.nodes.new("ShaderNodeTexCoord"), tree.nodes.new("ShaderNodeSeparateXYZ")
    curve, mix = tree.nodes.new("ShaderNodeMath"), tree.nodes.new("ShaderNodeMix")
    curve.operation, mix.data_type = "MULTIPLY_ADD", "RGBA"
    curve.inputs[1].default_value = curve.inputs[2].default_value = 0.5
    mix.inputs[6].default_value, mix.inputs[7].default_value = (0.2, 0.1, 0.9, 1), (2.0, 1.0, 0.3, 1)
    tree.links.new(coordinates.outputs["Generated"], separate.inputs[0])
    tree.links.new(separate.outputs["Y"], curve.inputs[0])
    tree.links.new(curve.outputs[0], mix.inputs[0])
    tree.links.new(mix.outputs[2], tree.nodes["Background"].inputs["Color"])
    normals = spherical_fibonacci(60)
    theirs = baked_irradiance(add_white_facets(normals))
    ours = evaluate(ORDER, normals) @ apply_bands(coefficients(bpy.context.scene), zonal_cosine(ORDER))
    assert relative(ours, theirs) < 0.01


def test_sky_textures_small_sun_keeps_its_energy(scene: bpy.types.Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    """The disc of half a degree, evaluated on two grids that cut it differently, and against the sun turned off."""
    tree, background = new_world(scene)
    sky = tree.nodes.new("ShaderNodeTexSky")
    sky.sun_elevation, sky.sun_rotation, sky.sun_size = 0.8, 1.0, math.radians(0.545)
    tree.links.new(sky.outputs[0], background.inputs["Color"])
    finer = project(world_render.render_world(scene, scene.world, 1300), ORDER)
    monkeypatch.setattr(world_render, "SMALLEST_WIDTH", 1024)
    with_sun = coefficients(scene)
    assert relative(with_sun, finer) < 0.01
    sky.sun_size = math.radians(0.05)
    assert relative(coefficients(scene), with_sun) < 1e-3
    monkeypatch.setattr(world_render, "SMALLEST_WIDTH", 256)
    sky.sun_disc = False
    without = coefficients(scene)
    added = with_sun - without
    # What the disc adds is a point light: its linear band points at it, as long as sqrt(3) times the mean.
    direction = added[[3, 1, 2], 1]
    assert np.linalg.norm(direction) / added[0, 1] == pytest.approx(math.sqrt(3.0), rel=2e-3)
    unit = direction / np.linalg.norm(direction)
    assert unit[2] == pytest.approx(math.sin(0.8), abs=2e-3)
    assert without[0, 2] > without[0, 0] > 0.0  # the sky is blue


def test_sky_texture_gives_cycles_irradiance(scene: bpy.types.Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    """Sun and sky together, against irradiance that Cycles bakes by itself."""
    monkeypatch.setattr(world_render, "SMALLEST_WIDTH", 1024)
    tree = use_cycles(256).node_tree
    sky = tree.nodes.new("ShaderNodeTexSky")
    sky.sun_elevation, sky.sun_rotation = 0.8, 1.0
    tree.links.new(sky.outputs[0], tree.nodes["Background"].inputs["Color"])
    normals = spherical_fibonacci(60)
    light = project(world_render.render_world(bpy.context.scene, bpy.context.scene.world), 24)
    ours = evaluate(24, normals) @ apply_bands(light, zonal_cosine(24))
    assert relative(ours, baked_irradiance(add_white_facets(normals))) < 0.01


def test_rotate_means_the_mapping_nodes_rotation(scene: bpy.types.Scene, hdri: Path) -> None:
    new_world(scene)
    set_world(scene.world, hdri, (0.0, 0.0, math.radians(30.0)))
    at_30 = coefficients(scene, rotate_degrees=40.0)
    next(n for n in scene.world.node_tree.nodes if n.bl_idname == "ShaderNodeMapping").inputs[
        "Rotation"].default_value = (0.0, 0.0, math.radians(70.0))
    assert np.allclose(at_30, coefficients(scene), atol=1e-6)


def test_file_in_place_of_the_world(scene: bpy.types.Scene, hdri: Path) -> None:
    new_world(scene, strength=7.0)
    add_sun(scene, strength=1.0)
    found = coefficients(scene, environment_override=hdri, use_scene_lights=False)
    assert relative(found, project(smooth_image(), ORDER)) < 1e-4
    with_sun = coefficients(scene, environment_override=hdri)
    assert (with_sun - found)[0] == pytest.approx(1.0 / CONSTANT, rel=1e-4)  # irradiance 1 from straight above
    with pytest.raises(PRTError, match=r"gone\.exr"):
        coefficients(scene, environment_override=hdri.with_name("gone.exr"))


def test_missing_or_broken_images_are_named(scene: bpy.types.Scene, hdri: Path, tmp_path: Path) -> None:
    new_world(scene)
    set_world(scene.world, hdri, None)
    hdri.rename(tmp_path / "moved.exr")
    with pytest.raises(PRTError, match=r"sky\.exr.*does not exist"):
        coefficients(scene)
    hdri.write_bytes(b"no image")
    scene.world.node_tree.nodes["Environment Texture"].image.reload()
    with pytest.raises(PRTError, match=r"sky\.exr"):
        coefficients(scene)
    broken = smooth_image()
    broken[3, 5, 1] = np.nan
    image = bpy.data.images.load(str(write_image(tmp_path / "nan.exr", broken)))
    scene.world.node_tree.nodes["Environment Texture"].image = image
    with pytest.raises(PRTError, match=r"nan\.exr.*column 5, row 3"):
        coefficients(scene)
    scene.world.node_tree.nodes["Environment Texture"].image = None
    with pytest.raises(PRTError, match="no image"):
        coefficients(scene)


def test_packed_images_need_no_file(scene: bpy.types.Scene, hdri: Path) -> None:
    new_world(scene)
    set_world(scene.world, hdri, None)
    scene.world.node_tree.nodes["Environment Texture"].image.pack()
    hdri.unlink()
    assert relative(coefficients(scene), project(smooth_image(), ORDER)) < 1e-4


def test_background_for_the_camera_only_does_not_light(scene: bpy.types.Scene) -> None:
    tree, background = new_world(scene, (0.25, 0.5, 1.0, 1.0))
    shown, mix = tree.nodes.new("ShaderNodeBackground"), tree.nodes.new("ShaderNodeMixShader")
    path, output = tree.nodes.new("ShaderNodeLightPath"), tree.get_output_node("CYCLES")
    shown.inputs["Color"].default_value = (9, 9, 9, 1)
    tree.links.new(path.outputs["Is Camera Ray"], mix.inputs[0])
    tree.links.new(background.outputs[0], mix.inputs[1])
    tree.links.new(shown.outputs[0], mix.inputs[2])
    tree.links.new(mix.outputs[0], output.inputs["Surface"])
    assert np.allclose(coefficients(scene)[0], np.array([0.25, 0.5, 1.0]) * CONSTANT, rtol=1e-5)


def test_evaluated_directions_are_exact_up_to_the_poles(scene: bpy.types.Scene) -> None:
    """A World that shows its own direction: every pixel holds the direction it stands for."""
    tree, background = new_world(scene)
    coordinates, shift = tree.nodes.new("ShaderNodeTexCoord"), tree.nodes.new("ShaderNodeVectorMath")
    shift.operation, shift.inputs[1].default_value = "ADD", (2.0, 2.0, 2.0)
    tree.links.new(coordinates.outputs["Generated"], shift.inputs[0])
    tree.links.new(shift.outputs[0], background.inputs["Color"])
    image = world_render.render_world(scene, scene.world)
    height, width = image.shape[:2]
    expected = direction_of_pixel(np.arange(height)[:, None], np.arange(width)[None, :], height, width) + 2.0
    assert np.abs(image - expected).max() < 0.1 * math.pi / height  # a tenth of a pixel


def test_evaluating_leaves_no_trace(scene: bpy.types.Scene) -> None:
    tree, background = new_world(scene)
    tree.links.new(tree.nodes.new("ShaderNodeTexSky").outputs[0], background.inputs["Color"])
    cube = add_cube()
    cube.select_set(True)
    bpy.context.view_layer.objects.active = cube
    bpy.ops.object.mode_set(mode="EDIT")
    depsgraph()
    before = user_data_lines()
    coefficients(scene)
    assert user_data_lines() == before


def test_second_reading_is_cached_and_every_change_shows(scene: bpy.types.Scene,
                                                         monkeypatch: pytest.MonkeyPatch) -> None:
    tree, background = new_world(scene)
    sky = tree.nodes.new("ShaderNodeTexSky")
    tree.links.new(sky.outputs[0], background.inputs["Color"])
    rendered = []
    original = world.render_world
    monkeypatch.setattr(world, "render_world", lambda *a: rendered.append(1) or original(*a))
    first = lights.light_coefficients(scene, depsgraph(), ORDER)
    assert lights.light_coefficients(scene, depsgraph(), ORDER).signature == first.signature
    assert len(rendered) == 1
    sky.sun_elevation += 0.1
    assert lights.light_coefficients(scene, depsgraph(), ORDER).signature != first.signature
    assert len(rendered) == 2


def add_sun(scene: bpy.types.Scene, name: str = "Sun", strength: float = 2.0) -> bpy.types.Object:
    lamp = bpy.data.objects.new(name, bpy.data.lights.new(name, "SUN"))
    lamp.data.energy, lamp.data.angle = strength, 0.0
    scene.collection.objects.link(lamp)
    return lamp


def test_suns_follow_colour_direction_exposure_and_nodes(scene: bpy.types.Scene) -> None:
    lamp = add_sun(scene)
    lamp.data.color, lamp.rotation_euler = (1.0, 0.5, 0.25), (math.pi / 2.0, 0.0, 0.0)
    plain = coefficients(scene)
    assert np.allclose(plain[0] * CONSTANT, (2.0, 1.0, 0.5))
    direction = plain[[3, 1, 2], 0]
    assert np.allclose(direction / np.linalg.norm(direction), (0.0, -1.0, 0.0), atol=1e-6)
    lamp.data.exposure = 2.0
    assert np.allclose(coefficients(scene), 4.0 * plain)
    lamp.data.node_tree.nodes["Emission"].inputs["Strength"].default_value = 0.5
    assert np.allclose(coefficients(scene), 2.0 * plain)


def test_temperature_equals_cycles(scene: bpy.types.Scene) -> None:
    use_cycles(16)
    lamp = add_sun(scene)
    lamp.data.use_temperature, lamp.data.temperature = True, 3000.0
    depsgraph()
    facet = np.array([[0.0, 0.0, 1.0]])
    assert np.allclose(coefficients(scene)[0] * CONSTANT / math.pi, baked_irradiance(add_white_facets(facet)),
                       rtol=5e-3)


def test_who_lights_is_what_renders_show(scene: bpy.types.Scene) -> None:
    add_sun(scene, "Shown", 1.0)
    add_sun(scene, "Off", 10.0).hide_render = True
    add_sun(scene, "Unseen", 100.0).hide_set(True)
    near = bpy.data.objects.new("Lamp", bpy.data.lights.new("Lamp", "POINT"))
    scene.collection.objects.link(near)
    collection = bpy.data.collections.new("Library")
    empty = bpy.data.objects.new("Instancer", None)
    empty.instance_type, empty.instance_collection = "COLLECTION", collection
    instanced = bpy.data.objects.new("Inside", bpy.data.lights.new("Inside", "SUN"))
    instanced.data.energy = 1000.0
    collection.objects.link(instanced)
    scene.collection.objects.link(empty)
    light = lights.light_coefficients(scene, depsgraph(), ORDER)
    assert light.coefficients[0, 0] * CONSTANT == pytest.approx(1101.0, rel=1e-3)
    text = "\n".join(light.warnings)
    assert "Lamp: a Point light" in text
    assert "Unseen: the viewport hides it" in text
    assert {p["name"] for p in light.parts if p["kind"] == "sun"} == {"Shown", "Unseen", "Inside"}


def test_window_only_where_it_rings(scene: bpy.types.Scene, hdri: Path) -> None:
    new_world(scene)
    set_world(scene.world, hdri, None)
    assert np.array_equal(coefficients(scene, window=True), coefficients(scene))
    add_sun(scene, strength=50.0)
    light = lights.light_coefficients(scene, depsgraph(), ORDER, window=True)
    assert light.parts[-1]["kind"] == "window"
    assert 0.0 < light.parts[-1]["cost"] < 1.0
    radiance = evaluate(ORDER, spherical_fibonacci(3000)) @ light.coefficients
    assert radiance.min() > -0.02 * light.coefficients[0].max() / CONSTANT


def test_reference_light_holds_the_same_light(scene: bpy.types.Scene, hdri: Path) -> None:
    new_world(scene, strength=2.0)
    set_world(scene.world, hdri, (0.4, -0.7, 1.1))
    lamp = add_sun(scene)
    lamp.data.angle, lamp.rotation_euler = 0.5, (0.5, 0.2, 0.1)
    reference = lights.reference_light(depsgraph())
    assert relative(reference.coefficients(ORDER), coefficients(scene)) < 0.01
    assert "Sun" in reference.description


def test_truncation_is_that_of_the_image(scene: bpy.types.Scene, tmp_path: Path) -> None:
    new_world(scene)
    image = np.zeros((32, 64, 3))
    image[16, 10] = 1.0
    set_world(scene.world, write_image(tmp_path / "point.exr", image), None)
    light = lights.light_coefficients(scene, depsgraph(), ORDER)
    # A pixel of solid angle w holds energy w per channel, of which order n keeps n^2 w^2 / (4 pi).
    solid_angle = (math.cos(16 * math.pi / 32) - math.cos(17 * math.pi / 32)) * 2.0 * math.pi / 64.0
    assert light.parts[0]["truncation"] == pytest.approx(1.0 - ORDER ** 2 * solid_angle / (4.0 * math.pi), rel=1e-3)
    assert light.parts[0]["energy"] == pytest.approx(3.0 * ORDER ** 2 * solid_angle ** 2 / (4.0 * math.pi), rel=0.02)
