# SPDX-License-Identifier: GPL-3.0-or-later
"""Light presets, solo and keyframes, and a colour attribute that follows the frames, in playback and in renders."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from pathlib import Path

import bpy
import numpy as np
import pytest

from prt_addon.blender import light_keyframes, light_state, stored
from tests.blender.scenes import user_data_lines
from tests.blender.test_commands import run  # makes the checkout the package `prt`
from tests.blender.test_stored import add_smooth_sphere, bake_of

KINDS = ("POINT", "SPOT", "SUN", "AREA")


@pytest.fixture
def lit(scene: bpy.types.Scene) -> Iterator[bpy.types.Scene]:
    """An HDRI and a light of each kind, with everything of the product that lights need registered."""
    from prt.operators import (
        follow_frames,
        keyframe_light,
        light_presets,
        light_properties,
        properties,
        relight,
    )

    classes = (properties.PRTSettings, properties.PRTBakedObject, properties.PRTSession, *light_properties.CLASSES,
               *light_presets.CLASSES, keyframe_light.PRT_OT_keyframe_light, relight.PRT_OT_relight)
    for cls in classes:
        bpy.utils.register_class(cls)
    for module in (properties, light_properties, follow_frames):
        module.register()
    scene.world = hdri_world("Sky")
    for number, kind in enumerate(KINDS):
        add_light(kind.title(), kind).location = (number, 1.0, 2.0)
    yield scene
    for module in (follow_frames, light_properties, properties):
        module.unregister()
    for cls in reversed(classes):
        bpy.utils.unregister_class(cls)


def hdri_world(name: str) -> bpy.types.World:
    """A World of an image turned by a Mapping node."""
    world = bpy.data.worlds.new(name)
    nodes, links = world.node_tree.nodes, world.node_tree.links
    texture, mapping = nodes.new("ShaderNodeTexEnvironment"), nodes.new("ShaderNodeMapping")
    texture.image = hdri(f"{name}.exr", (0.2, 0.4, 0.9))
    links.new(nodes.new("ShaderNodeTexCoord").outputs["Generated"], mapping.inputs["Vector"])
    links.new(mapping.outputs["Vector"], texture.inputs["Vector"])
    links.new(texture.outputs["Color"], nodes["Background"].inputs["Color"])
    return world


def hdri(name: str, colour: tuple[float, float, float]) -> bpy.types.Image:
    image = bpy.data.images.new(name, 16, 8, float_buffer=True)
    image.colorspace_settings.name = "Linear Rec.709"
    pixels = np.ones((8, 16, 4), np.float32)
    pixels[..., :3] = colour
    pixels[4:, :, :3] *= 3.0
    pixels[:, 3] *= 5.0
    image.pixels.foreach_set(pixels.ravel())
    image.pack()
    return image


def add_light(name: str, kind: str, data: bpy.types.Light | None = None) -> bpy.types.Object:
    light = bpy.data.objects.new(name, data or bpy.data.lights.new(name, kind))
    bpy.context.scene.collection.objects.link(light)
    return light


def background() -> bpy.types.NodeSocket:
    return bpy.context.scene.world.node_tree.nodes["Background"].inputs["Strength"]


def turn() -> bpy.types.NodeSocket:
    return bpy.context.scene.world.node_tree.nodes["Mapping"].inputs["Rotation"]


def change_everything() -> None:
    """Every value of the light that a preset promises to bring back."""
    background().default_value, turn().default_value = 3.3, (0.1, 0.2, 2.5)
    for number, kind in enumerate(KINDS):
        light = bpy.data.objects[kind.title()]
        data = light.data
        data.energy, data.color, data.exposure = 7.0 + number, (0.1, 0.3 + 0.1 * number, 0.7), 0.7
        data.use_temperature, data.temperature = True, 3100.0
        light.hide_render, light.hide_viewport = bool(number % 2), not number % 2
        light.location, light.scale = (9.0, -number, 0.3), (1.5, 1.0, 0.4)
        light.rotation_mode = ("XYZ", "QUATERNION", "AXIS_ANGLE", "ZXY")[number]
        light.rotation_euler, light.rotation_quaternion = (0.3, 0.2, 0.1), (0.5, 0.5, -0.5, 0.5)
        light.rotation_axis_angle = (0.4, 0.0, 1.0, 0.0)
    bpy.data.lights["Spot"].spot_size, bpy.data.lights["Spot"].spot_blend = 0.4, 0.9
    bpy.data.lights["Spot"].shadow_soft_size = bpy.data.lights["Point"].shadow_soft_size = 0.77
    bpy.data.lights["Sun"].angle = 0.3
    area = bpy.data.lights["Area"]
    area.shape, area.size, area.size_y, area.spread = "ELLIPSE", 3.0, 0.2, 1.0


def differences(before: list[str], after: list[str]) -> list[str]:
    return sorted(set(before) ^ set(after))


def test_everything_comes_back_to_the_bit(lit: bpy.types.Scene) -> None:
    """By two reads, and by every property of every data-block: nothing else moves either."""
    before, first = light_state.read_lighting(lit), user_data_lines()
    change_everything()
    assert len(differences(first, user_data_lines())) > 60
    second = light_state.read_lighting(lit)
    notes = light_state.write_lighting(lit, json.loads(json.dumps(before)))
    assert notes == [] and light_state.read_lighting(lit) == before
    assert differences(first, user_data_lines()) == []
    assert light_state.write_lighting(lit, second) == []
    assert light_state.read_lighting(lit) == second


def test_worlds_of_all_kinds(lit: bpy.types.Scene) -> None:
    """No World, a plain colour, an image without Mapping, a strength by a Value node, a sky: each as it was."""
    plain, valued, sky = (bpy.data.worlds.new(name) for name in ("Plain", "Valued", "Sky texture"))
    plain.node_tree.nodes["Background"].inputs["Color"].default_value = (0.1, 0.2, 0.3, 1.0)
    value = valued.node_tree.nodes.new("ShaderNodeValue")
    value.outputs[0].default_value = 2.5
    valued.node_tree.links.new(value.outputs[0], valued.node_tree.nodes["Background"].inputs["Strength"])
    texture = sky.node_tree.nodes.new("ShaderNodeTexSky")
    sky.node_tree.links.new(texture.outputs[0], sky.node_tree.nodes["Background"].inputs["Color"])
    texture.sun_rotation = 1.0
    image = lit.world.copy()
    image.node_tree.nodes.remove(image.node_tree.nodes["Mapping"])
    states = []
    for world in (None, plain, valued, sky, image):
        lit.world = world
        states.append(light_state.read_lighting(lit))
    plain.node_tree.nodes["Background"].inputs["Color"].default_value = (0.9, 0.9, 0.9, 1.0)
    value.outputs[0].default_value, texture.sun_rotation = 0.0, 2.0
    image.node_tree.nodes["Environment Texture"].image = hdri("other", (1.0, 0.0, 0.0))
    for world, state in zip((None, plain, valued, sky, image), states, strict=True):
        assert light_state.write_lighting(lit, state) == []
        assert lit.world == world and light_state.read_lighting(lit) == state
    assert value.outputs[0].default_value == 2.5 and texture.sun_rotation == 1.0


def test_what_is_gone_is_said_and_the_rest_is_applied(lit: bpy.types.Scene) -> None:
    state = light_state.read_lighting(lit)
    change_everything()
    bpy.data.objects["Sun"].name = "Moon"
    bpy.data.objects.remove(bpy.data.objects["Area"])
    nodes = lit.world.node_tree.nodes
    nodes.remove(nodes["Mapping"])
    notes = light_state.write_lighting(lit, state)
    assert len(notes) == 3, notes
    assert {note.partition(":")[0] for note in notes} == {"Sun", "Area", "Sky"}
    after = light_state.read_lighting(lit)
    assert after["lights"]["Point"] == state["lights"]["Point"]
    assert after["lights"]["Moon"] != state["lights"]["Sun"]
    assert background().default_value == 1.0


def test_linked_lights_are_said_and_stay(lit: bpy.types.Scene, tmp_path: Path) -> None:
    """A light linked from another file can't be written; one that need not be written is no matter."""
    path = tmp_path / "library.blend"
    bpy.data.libraries.write(str(path), {bpy.data.objects["Point"]})
    bpy.data.objects.remove(bpy.data.objects["Point"])
    with bpy.data.libraries.load(str(path), link=True) as (_, taken):
        taken.objects = ["Point"]
    lit.collection.objects.link(taken.objects[0])
    state = light_state.read_lighting(lit)
    assert light_state.write_lighting(lit, state) == []
    name = taken.objects[0].name_full
    state["lights"][name]["data"]["energy"], state["lights"]["Spot"]["data"]["energy"] = 5.0, 6.0
    notes = light_state.write_lighting(lit, state)
    assert notes == ["Point: linked from another file, so it stays as it is"]
    assert bpy.data.lights["Spot"].energy == 6.0 and taken.objects[0].data.energy != 5.0


def test_lights_that_share_data(lit: bpy.types.Scene) -> None:
    twin = add_light("Twin", "POINT", bpy.data.lights["Point"])
    shared, before = light_state.read_lighting(lit), user_data_lines()
    change_everything()
    assert light_state.write_lighting(lit, shared) == [] and differences(before, user_data_lines()) == []
    twin.data = twin.data.copy()  # no more shared: each gets the same values
    change_everything()
    assert light_state.write_lighting(lit, shared) == []
    assert twin.data.energy == bpy.data.lights["Point"].energy == shared["lights"]["Point"]["data"]["energy"]
    apart = light_state.read_lighting(lit)
    apart["lights"]["Twin"]["data"]["energy"] = 99.0
    twin.data = bpy.data.lights["Point"]  # two stored values, one light
    notes = light_state.write_lighting(lit, apart)
    assert len(notes) == 1 and notes[0].startswith("Twin: it shares")


def test_a_changed_kind_comes_back(lit: bpy.types.Scene) -> None:
    state = light_state.read_lighting(lit)
    bpy.data.objects["Spot"].data.type = "AREA"
    assert light_state.write_lighting(lit, state) == []
    assert light_state.read_lighting(lit) == state


def test_presets_by_operators_survive_saving_and_appending(lit: bpy.types.Scene, tmp_path: Path) -> None:
    """Two presets with different Worlds: the one not in use is saved, and comes along when the scene is appended."""
    assert bpy.ops.prt.light_preset_add(name="Day") == {"FINISHED"}
    day = light_state.read_lighting(lit)
    change_everything()
    lit.world = hdri_world("Night sky")
    assert bpy.ops.prt.light_preset_add(name="Day") == {"FINISHED"}
    night = light_state.read_lighting(lit)
    assert [p.name for p in lit.prt_light.presets] == ["Day", "Day.001"]
    lit.prt_light.presets[1].name = "Night"
    path = tmp_path / "saved.blend"
    bpy.ops.wm.save_as_mainfile(filepath=str(path))
    for append in (False, True):
        if append:
            bpy.ops.wm.read_homefile(use_empty=True)
            bpy.ops.wm.append(directory=f"{path}/Scene/", filename="Scene")
            scene = next(s for s in bpy.data.scenes if len(s.prt_light.presets))
            bpy.context.window.scene = scene
        else:
            bpy.ops.wm.open_mainfile(filepath=str(path))
            scene = bpy.context.scene
        for name, state in (("Day", day), ("Night", night), ("Day", day)):
            assert bpy.ops.prt.light_preset_apply(name=name) == {"FINISHED"}
            found = light_state.read_lighting(scene)
            assert found == state, (append, name)
            assert scene.prt_light.chosen().name == name and not scene.prt_light.modified
        scene.objects["Point"].data.energy += 1.0
        assert scene.prt_light.modified
    bpy.ops.prt.light_preset_update(name="Night")
    assert json.loads(scene.prt_light.presets["Night"].state)["lights"]["Point"]["data"]["energy"] == \
        scene.objects["Point"].data.energy
    bpy.ops.prt.light_preset_remove(name="Day")
    assert [p.name for p in scene.prt_light.presets] == ["Night"] and scene.prt_light.chosen().name == "Night"
    with pytest.raises(RuntimeError, match="no such light preset"):
        bpy.ops.prt.light_preset_apply(name="Day")


def test_undo(lit: bpy.types.Scene) -> None:
    """Applying, removing and solo are one step each."""
    bpy.ops.prt.light_preset_add(name="A")
    first = light_state.read_lighting(bpy.context.scene)
    change_everything()
    second = light_state.read_lighting(bpy.context.scene)
    if bpy.ops.ed.undo_push(message="change") != {"FINISHED"}:
        pytest.skip("no undo here")
    for act, after in ((lambda: bpy.ops.prt.light_preset_apply(name="A"), first),
                       (lambda: bpy.ops.prt.light_solo(name="Spot"), None)):
        act()
        bpy.ops.ed.undo_push(message="act")
        assert light_state.read_lighting(bpy.context.scene) == after if after else bpy.context.scene.prt_light.soloing
        bpy.ops.ed.undo()
        assert light_state.read_lighting(bpy.context.scene) == second
        assert not bpy.context.scene.prt_light.soloing


def test_solo_puts_back_exactly_what_was(lit: bpy.types.Scene) -> None:
    bpy.data.objects["Area"].hide_render = True  # off before, and to be off again
    background().default_value = 0.7
    before = light_state.read_lighting(lit)
    assert bpy.ops.prt.light_solo(name="Area") == {"FINISHED"}
    assert [o.name for o in light_state.lights_of(lit) if not o.hide_render] == ["Area"]
    assert background().default_value == 0.0 and lit.prt_light.solo.name == "Area"
    bpy.ops.prt.light_solo(name="Sun")  # straight on to the next one
    assert [o.name for o in light_state.lights_of(lit) if not o.hide_render] == ["Sun"]
    bpy.data.objects["Spot"].name = "Renamed"
    bpy.ops.prt.light_solo(name="Sun")
    bpy.data.objects["Renamed"].name = "Spot"
    assert light_state.read_lighting(lit) == before and not lit.prt_light.soloing
    bpy.ops.prt.light_solo(name="")
    assert all(o.hide_render for o in light_state.lights_of(lit)) and background().default_value == pytest.approx(0.7)
    bpy.ops.prt.light_solo(name="")
    assert light_state.read_lighting(lit) == before
    with pytest.raises(RuntimeError, match="no light of this name"):
        bpy.ops.prt.light_solo(name="Nobody")


def test_a_preset_keeps_its_solo(lit: bpy.types.Scene) -> None:
    """A preset stored during a solo brings it back, and ending it then gives what it would have been without."""
    before = light_state.read_lighting(lit)
    bpy.ops.prt.light_solo(name="Spot")
    bpy.ops.prt.light_preset_add(name="Alone")
    bpy.ops.prt.light_solo(name="Spot")
    bpy.ops.prt.light_preset_add(name="All")
    bpy.ops.prt.light_preset_apply(name="Alone")
    assert lit.prt_light.soloing and background().default_value == 0.0
    bpy.ops.prt.light_preset_apply(name="All")
    assert not lit.prt_light.soloing and light_state.read_lighting(lit) == before
    bpy.ops.prt.light_preset_apply(name="Alone")
    bpy.ops.prt.light_solo(name="Spot")
    assert light_state.read_lighting(lit) == before


def test_keyframes_bring_each_light_back_at_its_frame(lit: bpy.types.Scene) -> None:
    lit.frame_set(1)
    first = light_state.read_lighting(lit)
    assert bpy.ops.prt.keyframe_light() == {"FINISHED"}
    lit.frame_set(20)
    change_everything()
    for light in light_state.lights_of(lit):
        light.rotation_mode = "XYZ"  # which channels turn a light can't be animated
        light.rotation_quaternion, light.rotation_axis_angle = (1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 1.0, 0.0)
    for name in ("Spot", "Point"):
        bpy.data.lights[name].shadow_soft_size = 0.1  # nor is a light's shape keyed
    second = light_state.read_lighting(lit)
    bpy.ops.prt.keyframe_light()
    for frame, state in ((1, first), (20, second)):
        lit.frame_set(frame)
        found = light_state.read_lighting(lit)
        assert found["world"] == state["world"]
        for name, values in state["lights"].items():
            got = found["lights"][name]
            assert got["object"] == values["object"], (frame, name)
            for part in ("energy", "color", "exposure"):
                assert got["data"][part] == values["data"][part], (frame, name, part)
    assert background().id_data.animation_data.action and bpy.data.lights["Sun"].animation_data.action


def test_keyframes_of_chosen_parts_on_the_right_data(lit: bpy.types.Scene) -> None:
    add_light("Twin", "POINT", bpy.data.lights["Point"])
    count, notes = light_keyframes.insert_keyframes(lit, 5.0, {"POWER"})
    assert (count, notes) == (2 * len(KINDS), [])  # shared data once
    assert all(o.animation_data is None for o in lit.objects) and lit.world.node_tree.animation_data is None
    assert light_state.animated_paths(bpy.data.lights["Sun"]) == {"energy", "exposure"}
    light_keyframes.insert_keyframes(lit, 5.0, {"VISIBILITY"}, {"Spot"})
    assert light_state.animated_paths(bpy.data.objects["Spot"]) == {"hide_viewport", "hide_render"}
    assert bpy.data.objects["Sun"].animation_data is None


def test_applying_says_that_keyframes_take_over(lit: bpy.types.Scene) -> None:
    state = light_state.read_lighting(lit)
    bpy.data.lights["Sun"].energy, background().default_value = 3.0, 2.0
    light_keyframes.insert_keyframes(lit, 1.0, {"POWER", "WORLD"}, {"Sun"})
    notes = light_state.write_lighting(lit, state)
    assert {note.partition(":")[0] for note in notes} == {"Sun", "Sky"} and all("animated" in n for n in notes), notes


@pytest.fixture
def baked(lit: bpy.types.Scene) -> bpy.types.Object:
    """A made-up bake on a sphere whose material shows the attribute, seen by a camera, in an animated light."""
    sphere = add_smooth_sphere()
    material = bpy.data.materials.new("Shown")
    nodes, links = material.node_tree.nodes, material.node_tree.links
    nodes.clear()
    attribute, emission = nodes.new("ShaderNodeVertexColor"), nodes.new("ShaderNodeEmission")
    attribute.layer_name = "PRT Light"
    links.new(attribute.outputs["Color"], emission.inputs["Color"])
    links.new(emission.outputs[0], nodes.new("ShaderNodeOutputMaterial").inputs["Surface"])
    sphere.data.materials.append(material)
    made = bake_of(sphere)
    made.bases[:, :, :, 0] += 1.0
    made.weights[:], made.cluster[:] = 0.0, 0  # one colour all over
    made.albedo[:] = 0.2, 0.5, 0.4  # the material's own is none
    stored.write_baked(sphere, made)
    camera = bpy.data.objects.new("Camera", bpy.data.cameras.new("Camera"))
    camera.location = (0.0, 0.0, 6.0)
    lit.collection.objects.link(camera)
    lit.camera = camera
    render = lit.render
    render.engine, lit.cycles.samples, lit.cycles.use_denoising = "CYCLES", 1, False
    render.resolution_x = render.resolution_y = 24
    render.image_settings.file_format = "OPEN_EXR"
    lit.frame_start, lit.frame_end = 1, 2
    for frame, strength, angle, energy, hidden in ((1, 0.2, 0.0, 1.0, False), (2, 2.0, 2.0, 5.0, True)):
        lit.frame_set(frame)
        background().default_value, turn().default_value[2] = strength, angle
        bpy.data.lights["Sun"].energy, bpy.data.objects["Sun"].hide_render = energy, hidden
        bpy.ops.prt.keyframe_light()
    lit.frame_set(1)
    return sphere


def colours(sphere: bpy.types.Object) -> np.ndarray:
    attribute = sphere.data.attributes["PRT Light"]
    values = np.empty(4 * len(attribute.data), np.float32)
    attribute.data.foreach_get("color", values)
    return values.reshape(-1, 4)[:, :3]


def rendered(path: Path) -> np.ndarray:
    image = bpy.data.images.load(str(path))
    pixels = np.array(image.pixels[:], np.float32).reshape(24, 24, 4)[..., :3]
    bpy.data.images.remove(image)
    return pixels


def test_the_attribute_follows_frames_as_the_command_relights(baked: bpy.types.Object, tmp_path: Path) -> None:
    scene = bpy.context.scene
    assert "PRT Light" not in baked.data.attributes
    scene.frame_set(2)
    assert "PRT Light" not in baked.data.attributes  # off: nothing happens
    scene.prt_light.follow_frames = True
    assert scene.prt_light.follow_message == ""
    found = {}
    for frame in (1, 2):
        scene.frame_set(frame)
        found[frame] = colours(bpy.data.objects["Sphere"])
        bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / f"{frame}.blend"))
    assert np.abs(found[1] - found[2]).max() > 0.1
    for frame in (1, 2):
        output = tmp_path / f"{frame}.npz"
        assert run("relight", "--input", tmp_path / f"{frame}.blend", "--use-scene-lights", "--output", output) == 0
        with np.load(output) as arrays:
            np.testing.assert_allclose(found[frame], arrays["radiance"], rtol=1e-5, atol=1e-6)


def test_renders_show_the_frame_they_are_of(baked: bpy.types.Object, tmp_path: Path) -> None:
    """Animation and single renders: pixels in the middle are the attribute as frame_set gives it at that frame."""
    scene = bpy.context.scene
    scene.prt_light.follow_frames = True
    expected = {}
    for frame in (1, 2):
        scene.frame_set(frame)
        expected[frame] = colours(baked)[0]
    baked.data.attributes["PRT Light"].data.foreach_set("color", np.zeros(4 * len(baked.data.vertices), np.float32))
    scene.render.filepath = str(tmp_path / "f_")
    bpy.ops.render.render(animation=True)
    pixels = {frame: rendered(tmp_path / f"f_{frame:04d}.exr")[10:14, 10:14].mean(axis=(0, 1)) for frame in (1, 2)}
    for frame in (1, 2):
        np.testing.assert_allclose(pixels[frame], np.maximum(expected[frame], 0.0), rtol=2e-3)
    assert np.abs(pixels[1] - pixels[2]).max() > 0.1
    scene.frame_set(2)
    scene.render.filepath = str(tmp_path / "still.exr")
    bpy.ops.render.render(write_still=True)
    still = rendered(tmp_path / "still.exr")[10:14, 10:14].mean(axis=(0, 1))
    np.testing.assert_allclose(still, pixels[2], rtol=2e-3)


@pytest.mark.parametrize(("harm", "word"), [
    (lambda sphere: sphere.data.transform(((1, 0, 0, 0), (0, 1, 0, 0), (0, 0, 2, 0), (0, 0, 0, 1))), "stale"),
    (lambda sphere: sphere.data.__setitem__("prt_header", "{"), "Sphere"),
    (lambda _: bpy.context.scene.world.node_tree.nodes["Mapping"].inputs["Scale"].__setattr__(
        "default_value", (2.0, 1.0, 1.0)), "Sky"),
])
def test_what_goes_wrong_stops_no_render(harm: Callable, word: str, baked: bpy.types.Object, tmp_path: Path,
                                         capfd: pytest.CaptureFixture) -> None:
    """One line, once; the attribute stays as it was; the frame is rendered."""
    scene = bpy.context.scene
    scene.prt_light.follow_frames = True
    before = colours(baked)
    harm(baked)
    capfd.readouterr()
    scene.render.filepath, scene.frame_start = str(tmp_path / "f_"), 2
    bpy.ops.render.render(animation=True)
    assert [path.name for path in tmp_path.glob("f_*.exr")] == ["f_0002.exr"]
    lines = [line for line in capfd.readouterr().out.splitlines() if line.startswith("prt:")]
    assert len(lines) == 1 and word in lines[0], lines
    assert scene.prt_light.follow_message and np.array_equal(colours(baked), before)


def test_thumbnails_differ_with_the_light(baked: bpy.types.Object) -> None:
    """By the preview's shaders; without a graphics driver presets are stored all the same."""
    from prt.operators.light_icons import from_text

    pictures = []
    for frame in (1, 2):
        bpy.context.scene.frame_set(frame)
        assert bpy.ops.prt.light_preset_add(name=f"Frame {frame}") == {"FINISHED"}
        pictures.append(from_text(bpy.context.scene.prt_light.presets[-1].thumbnail))
    assert not [i.name for i in bpy.data.images if i.name.startswith(("PRT", "thumbnail"))]
    if pictures[0] is None:
        pytest.skip("no graphics driver")
    assert pictures[0].shape == (192, 192, 4) and pictures[0].dtype == np.uint8
    assert np.abs(pictures[0].astype(float) - pictures[1])[60:130, 60:130, :3].mean() > 5.0
