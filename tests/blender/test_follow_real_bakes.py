# SPDX-License-Identifier: GPL-3.0-or-later
"""Frames that follow, on what an artist has: a real bake, whose materials then give way to one that shows the colour
attribute, or to a Material Override, in a render of an animated light."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import bpy
import numpy as np
import pytest

from tests.blender.test_commands import FAST, make_scene, run  # makes the checkout the package `prt`
from tests.blender.test_local_light_bakes import FAST as FAST_LAMPS
from tests.blender.test_local_light_bakes import make_room

SIZE = 24
LOOKED_AT = (1.5, -1.5, 0.0)  # on the floor, in front of the ball


@pytest.fixture(scope="module", autouse=True)
def registered() -> Iterator[None]:
    from prt.operators import follow_frames, light_properties, properties
    from prt.operators.keyframe_light import PRT_OT_keyframe_light

    bpy.ops.wm.read_homefile(use_empty=True)
    classes = (properties.PRTSettings, properties.PRTBakedObject, properties.PRTSession, *light_properties.CLASSES,
               PRT_OT_keyframe_light)
    for cls in classes:
        bpy.utils.register_class(cls)
    for module in (properties, light_properties, follow_frames):
        module.register()
    yield
    for module in (follow_frames, light_properties, properties):
        module.unregister()
    for cls in reversed(classes):
        bpy.utils.unregister_class(cls)


def paint_the_ball_and_add_a_box() -> None:
    """An image through a UV map: the stand-in material then changes what the geometry is told by. The box's flat faces
    need more receivers than it has vertices, so its bake lies on a hidden mesh."""
    image = bpy.data.images.new("Checker", 8, 8)
    image.pixels.foreach_set(np.random.default_rng(1).random(8 * 8 * 4, np.float32))
    image.pack()
    material = bpy.data.materials.new("Painted")
    tree = material.node_tree
    texture = tree.nodes.new("ShaderNodeTexImage")
    texture.image = image
    tree.links.new(texture.outputs["Color"], tree.nodes["Principled BSDF"].inputs["Base Color"])
    bpy.data.objects["Ball"].data.materials.append(material)
    bpy.ops.mesh.primitive_cube_add(size=1.0, location=(-2.0, -1.0, 0.55), rotation=(0.0, 0.0, 0.4))
    bpy.context.object.name = bpy.context.object.data.name = "Box"
    bpy.context.object.data.materials.append(bpy.data.materials.new("Plain"))


@pytest.fixture(scope="module")
def animated(tmp_path_factory: pytest.TempPathFactory, registered: None) -> Path:
    """A baked ball and floor; on frame 2 the Sun is elsewhere, red and stronger and the World darker, and on frame 3
    the Sun is off in renders."""
    folder = tmp_path_factory.mktemp("animated")
    source, output = make_scene(folder / "scene.blend", paint_the_ball_and_add_a_box), folder / "baked.blend"
    assert run("bake", "--input", source, "--output", output, *FAST) == 0
    bpy.ops.wm.open_mainfile(filepath=str(output))
    scene, sun = bpy.context.scene, bpy.data.objects["Sun"]
    bpy.ops.prt.keyframe_light()
    scene.frame_set(2)
    sun.rotation_euler, sun.data.energy, sun.data.color = (-0.8, 0.4, 0.0), 3.0, (1.0, 0.2, 0.1)
    scene.world.node_tree.nodes["Background"].inputs["Strength"].default_value = 0.1
    bpy.ops.prt.keyframe_light()
    scene.frame_set(3)
    sun.hide_render = True
    bpy.ops.prt.keyframe_light()
    prepare(scene)
    bpy.ops.wm.save_as_mainfile(filepath=str(output))
    return output


def prepare(scene: bpy.types.Scene) -> None:
    """Small, exact renders of frames 1 to 3."""
    scene.frame_set(1)
    scene.frame_start, scene.frame_end = 1, 3
    scene.render.engine, scene.cycles.samples, scene.cycles.use_denoising = "CYCLES", 16, False
    scene.render.threads_mode, scene.render.threads = "FIXED", 1
    scene.render.resolution_x = scene.render.resolution_y = SIZE
    scene.render.image_settings.file_format = "OPEN_EXR"


def opened(path: Path) -> bpy.types.Scene:
    bpy.ops.wm.open_mainfile(filepath=str(path))
    return bpy.context.scene


def relit_material() -> bpy.types.Material:
    """A material of the user's that shows the attribute and nothing else."""
    material = bpy.data.materials.new("Relit")
    tree = material.node_tree
    tree.nodes.clear()
    colour, emission, output = (tree.nodes.new(f"ShaderNode{n}") for n in ("VertexColor", "Emission", "OutputMaterial"))
    colour.layer_name = "PRT Light"
    tree.links.new(colour.outputs[0], emission.inputs[0])
    tree.links.new(emission.outputs[0], output.inputs[0])
    return material


def on_the_objects(scene: bpy.types.Scene) -> None:
    for name in ("Ball", "Floor", "Box"):
        bpy.data.objects[name].data.materials[0] = relit_material()


def as_override(scene: bpy.types.Scene) -> None:
    scene.view_layers[0].material_override = relit_material()


def colours(scene: bpy.types.Scene) -> dict[str, np.ndarray]:
    """The attribute (points, 3) of each baked object that has it."""
    from prt.prt_addon.blender.stored import baked_mesh, baked_objects

    found = {}
    for scene_object in baked_objects(scene):
        attribute = baked_mesh(scene_object).attributes.get("PRT Light")
        if attribute is not None:
            values = np.empty(4 * len(attribute.data), np.float32)
            attribute.data.foreach_get("color", values)
            found[scene_object.name] = values.reshape(-1, 4)[:, :3]
    return found


def relit_by_command(source: Path, folder: Path, frame: int) -> dict[str, np.ndarray]:
    """What `prt relight` gives for the file, with its own materials, saved at this frame; by object."""
    scene = opened(source)
    scene.frame_set(frame)
    copy, arrays = folder / f"{frame}.blend", folder / f"{frame}.npz"
    bpy.ops.wm.save_as_mainfile(filepath=str(copy), copy=True)
    assert run("relight", "--input", copy, "--use-scene-lights", "--output", arrays) == 0
    with np.load(arrays) as found:
        return {name: found["radiance"][found["object"] == name] for name in np.unique(found["object"])}


def rendered(scene: bpy.types.Scene, folder: Path) -> dict[int, np.ndarray]:
    """The pictures (SIZE, SIZE, 3), scene-linear, of an animation render without interface, by frame."""
    scene.render.filepath = str(folder / "frame_")
    bpy.ops.render.render(animation=True)
    found = {}
    for frame in range(scene.frame_start, scene.frame_end + 1):
        image = bpy.data.images.load(str(folder / f"frame_{frame:04d}.exr"), check_existing=False)
        found[frame] = np.array(image.pixels[:], np.float32).reshape(SIZE, SIZE, 4)[..., :3]
    return found


@pytest.mark.parametrize("show", [on_the_objects, as_override])
def test_a_render_shows_what_relight_gives_on_each_frame(animated: Path, tmp_path: Path, show) -> None:
    expected = {frame: relit_by_command(animated, tmp_path, frame) for frame in (1, 2, 3)}
    scene = opened(animated)
    show(scene)
    scene.prt_light.follow_frames = True
    assert scene.prt_light.follow_message == "", "a material that shows the bake's own light makes it no stale one"
    for frame in (2, 3, 1):
        scene.frame_set(frame)
        for name, radiance in expected[frame].items():
            assert np.abs(colours(scene)[name] - radiance).max() < 1e-5 * np.abs(radiance).max(), (frame, name)
    pictures = rendered(scene, tmp_path)
    assert scene.prt_light.follow_message == "" and scene.frame_current == 1
    row, column = pixel_of(scene)
    for frame, picture in pictures.items():
        wanted = expected[frame]["Floor"][nearest(scene)]
        assert np.abs(picture[row, column] - wanted).max() < 0.15 * wanted.max(), (frame, picture[row, column], wanted)
    for one, other in ((1, 2), (2, 3), (1, 3)):
        assert np.abs(expected[one]["Floor"] - expected[other]["Floor"]).max() > 0.1
        assert np.abs(pictures[one] - pictures[other]).max() > 0.1, (one, other)


def test_an_object_whose_bake_is_on_a_hidden_mesh_shows_it_too(animated: Path, tmp_path: Path) -> None:
    """Each corner of the Box has the colour of the receiver at its place that faces its way; renders show them, and a
    new bake, which under the same materials is no stale one, starts without them."""
    from prt.prt_addon.blender.fingerprint import surroundings
    from prt.prt_addon.blender.stored import baked_mesh, read_baked, stale

    expected = {frame: relit_by_command(animated, tmp_path, frame)["Box"] for frame in (1, 2)}
    scene = opened(animated)
    box = bpy.data.objects["Box"]
    on_the_objects(scene)
    assert baked_mesh(box) != box.data and "PRT Light" not in box.data.attributes
    scene.prt_light.follow_frames = True
    receivers = read_baked(box)
    for frame in (1, 2):
        scene.frame_set(frame)
        assert scene.prt_light.follow_message == ""
        found = np.empty((len(box.data.loops), 4), np.float32)
        box.data.attributes["PRT Light"].data.foreach_get("color", found.ravel())
        for loop, colour in zip(box.data.loops, found[:, :3], strict=True):
            place = np.array(box.matrix_world @ box.data.vertices[loop.vertex_index].co)
            normal = np.array(box.matrix_world.to_3x3() @ box.data.corner_normals[loop.index].vector)
            there = (np.abs(receivers.positions - place).max(axis=1) < 1e-4) & (receivers.normals @ normal > 0.999)
            assert there.sum() == 1 and np.allclose(expected[frame][there][0], colour, atol=1e-5)
    pictures = rendered(scene, tmp_path)
    row, column = pixel_of(scene, tuple(box.matrix_world.translation + box.matrix_world.to_3x3().col[2] * 0.5))
    assert pictures[1][row, column].min() > 0.02, "the box is black"
    assert np.abs(pictures[1][row, column] - pictures[2][row, column]).max() > 0.05
    scene.prt_light.follow_frames = False
    source, output = tmp_path / "lit.blend", tmp_path / "again.blend"
    bpy.ops.wm.save_as_mainfile(filepath=str(source))
    assert run("bake", "--input", source, "--output", output, *FAST) == 0
    opened(output)
    box, depsgraph = bpy.data.objects["Box"], bpy.context.evaluated_depsgraph_get()
    assert "PRT Light" not in box.data.attributes
    assert stale(box, depsgraph, surroundings(depsgraph)) is None


def pixel_of(scene: bpy.types.Scene, looked_at: tuple[float, ...] = LOOKED_AT) -> tuple[int, int]:
    """Row from the bottom and column of the place that is looked at."""
    from bpy_extras.object_utils import world_to_camera_view
    from mathutils import Vector

    place = world_to_camera_view(scene, scene.camera, Vector(looked_at))
    return int(place.y * SIZE), int(place.x * SIZE)


def nearest(scene: bpy.types.Scene) -> int:
    """The Floor's receiver nearest to that place."""
    from prt.prt_addon.blender.stored import read_baked

    return int(np.argmin(((read_baked(scene.objects["Floor"]).positions - LOOKED_AT) ** 2).sum(axis=1)))


def test_real_edits_make_it_stale_all_the_same(animated: Path) -> None:
    """Whatever material is shown, a moved vertex or a new UV map of a painted ball counts; so does another material
    that does not show the attribute."""
    from prt.prt_addon.blender.stored import stale

    scene = opened(animated)
    ball = bpy.data.objects["Ball"]

    def why() -> str | None:
        bpy.context.view_layer.update()
        return stale(ball, bpy.context.evaluated_depsgraph_get())

    assert why() is None
    on_the_objects(scene)
    assert why() is None
    ball.data.uv_layers[0].uv[0].vector.x += 0.25
    assert "mesh" in why()
    ball.data.uv_layers[0].uv[0].vector.x -= 0.25
    ball.data.vertices[3].co.x += 0.1
    ball.data.update()
    assert "mesh" in why()
    ball.data.vertices[3].co.x -= 0.1
    ball.data.materials[0] = bpy.data.materials.new("Other")
    assert "materials" in why() or "mesh" in why()


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory, registered: None) -> Path:
    """A room baked for lamps, one of its walls painted by nodes that only Cycles can evaluate; the Lamp moves."""
    folder = tmp_path_factory.mktemp("room")
    source = make_room(folder / "room.blend")
    tree = bpy.data.objects["Back"].data.materials[0].node_tree
    noise, shader = tree.nodes.new("ShaderNodeTexNoise"), next(n for n in tree.nodes if n.type.startswith("BSDF"))
    tree.links.new(noise.outputs["Color"], shader.inputs[0])
    bpy.ops.wm.save_as_mainfile(filepath=str(source))
    output = folder / "baked.blend"
    assert run("bake", "--input", source, "--output", output, "--lighting", "local", "--set", "cloud_region=Region",
               *FAST_LAMPS, "--set", "cloud_lights=27") == 0
    bpy.ops.wm.open_mainfile(filepath=str(output))
    scene, lamp = bpy.context.scene, bpy.data.objects["Lamp"]
    bpy.ops.prt.keyframe_light()
    scene.frame_set(2)
    lamp.location.x, lamp.data.energy = -0.4, 40.0
    bpy.ops.prt.keyframe_light()
    camera = bpy.data.objects.new("Camera", bpy.data.cameras.new("Camera"))
    camera.location, camera.rotation_euler = (0.0, -3.0, 1.0), (np.pi / 2, 0.0, 0.0)
    scene.collection.objects.link(camera)
    scene.camera = camera
    prepare(scene)
    scene.frame_end = 2
    bpy.ops.wm.save_as_mainfile(filepath=str(output))
    return output


def test_lamps_move_in_a_render_without_cycles_in_the_way(room: Path, tmp_path: Path,
                                                          capfd: pytest.CaptureFixture[str]) -> None:
    """A fresh file, as `blender --background FILE --render-anim` has it: nothing was read before the render began."""
    expected = {frame: relit_by_command(room, tmp_path, frame) for frame in (1, 2)}
    scene = opened(room)
    as_override(scene)
    scene.prt_light.follow_frames = True
    path = tmp_path / "ready.blend"
    bpy.ops.wm.save_as_mainfile(filepath=str(path))
    scene = opened(path)
    scenes = len(bpy.data.scenes)
    assert scene.prt_light.follow_frames
    written = {}

    def note(shown: bpy.types.Scene, _depsgraph: object = None) -> None:
        written[shown.frame_current] = {name: found.copy() for name, found in colours(shown).items()}

    bpy.app.handlers.render_post.append(note)
    try:
        pictures = rendered(scene, tmp_path)
    finally:
        bpy.app.handlers.render_post.remove(note)
    assert not [line for line in capfd.readouterr().out.splitlines() if line.startswith("prt:")]
    assert scene.prt_light.follow_message == "" and len(bpy.data.scenes) == scenes
    for frame in (1, 2):
        for name, radiance in expected[frame].items():
            assert np.abs(written[frame][name] - radiance).max() < 1e-4 * np.abs(radiance).max(), (frame, name)
    assert np.abs(pictures[1] - pictures[2]).max() > 0.05
