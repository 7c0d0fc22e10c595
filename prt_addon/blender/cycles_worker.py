# SPDX-License-Identifier: GPL-3.0-or-later
"""The child process that renders a copy of the scene with Cycles: run by path, by Blender or by a Python with `bpy`.

    blender --background --factory-startup --python cycles_worker.py -- JOB        python cycles_worker.py -- JOB

JOB holds scene.blend and request.json (ground_truth.py writes both). What is left in it: result.npz with `half_0`,
`half_1` (height, width, 4) float32, scene-linear and premultiplied, of independent random numbers; `objects` (height,
width) int32, the place in the request's list, plus 1, of the object that the centre of each pixel shows, 0 for none of
them; `depth` (height, width) float32, along the view, 0 for nothing; `seconds`, of both halves. Messages are those of
a bake's child (baking/worker.py), in the same file.

The file is a copy that nobody sees, so it is changed at will: the picture is to show exactly what a bake answers for.
"""

from __future__ import annotations

import importlib.util
import json
import shutil
import sys
import time
from pathlib import Path
from types import ModuleType

import bpy
import numpy as np

BOUNCES = 64  # the bake follows light until it is lost; Blender's defaults end it after four
MASK_SHARE = 0.05  # of the progress


def load_worker() -> ModuleType:
    """The bake's child, for its messages and its end with the parent. By its path: no package is loaded here."""
    path = Path(__file__).resolve().parents[1] / "baking" / "worker.py"
    spec = importlib.util.spec_from_file_location("prt_worker", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


worker = load_worker()


def open_copy(job: Path, request: dict) -> bpy.types.Scene:
    """The scene of the request, alone in being rendered, in its own file."""
    bpy.ops.wm.open_mainfile(filepath=str(job / "scene.blend"), load_ui=False, use_scripts=False)
    scene = bpy.data.scenes[request["scene"]]
    for layer in scene.view_layers:
        layer.use = layer.name == request["view_layer"]
        layer.material_override, layer.samples = None, 0
        if hasattr(layer, "world_override"):
            layer.world_override = None
    return scene


def prepare_render(scene: bpy.types.Scene, width: int, height: int) -> None:
    """Light and surfaces as they are, and nothing that is the camera's, the compositor's or an approximation."""
    assign(scene.render, engine="CYCLES", resolution_x=width, resolution_y=height, resolution_percentage=100,
           use_border=False, use_compositing=False, use_sequencer=False, use_multiview=False, use_motion_blur=False,
           film_transparent=True, use_persistent_data=True, use_freestyle=False, use_stamp=False)
    assign(scene.render.image_settings, media_type="IMAGE", file_format="OPEN_EXR", color_mode="RGBA",
           color_depth="32", exr_codec="ZIP", color_management="FOLLOW_SCENE")
    assign(scene.cycles, device="CPU", use_adaptive_sampling=False, use_denoising=False, time_limit=0.0,
           max_bounces=BOUNCES, diffuse_bounces=BOUNCES, glossy_bounces=BOUNCES, transmission_bounces=BOUNCES,
           sample_clamp_direct=0.0, sample_clamp_indirect=0.0, blur_glossy=0.0, light_sampling_threshold=0.0,
           use_fast_gi=False, use_guiding=False, auto_scrambling_distance=False, scrambling_distance=1.0,
           use_sample_subset=False, sample_offset=0, film_exposure=1.0, pixel_filter_type="BOX", filter_width=1.0)
    scene.camera.data.dof.use_dof = False
    for found in scene.objects:
        if found.type == "LIGHT":
            found.visible_camera = False
        for modifier in found.modifiers:  # bakes are of what the viewport shows
            modifier.show_render = modifier.show_viewport
            if hasattr(modifier, "render_levels"):
                modifier.render_levels = modifier.levels


def assign(owner: bpy.types.bpy_struct, **values: object) -> None:
    """Set what this version of Blender knows."""
    for name, value in values.items():
        if hasattr(owner, name):
            setattr(owner, name, value)


def render(scene: bpy.types.Scene, path: Path, samples: int, seed: int) -> np.ndarray:
    """One picture (height, width, 4) float32, the top row first."""
    scene.cycles.samples, scene.cycles.seed = samples, seed
    scene.render.filepath = str(path)
    bpy.ops.render.render(write_still=True, scene=scene.name)
    image = bpy.data.images.load(str(path))
    image.colorspace_settings.name = "Non-Color"
    width, height = image.size
    pixels = np.empty((height, width, 4), np.float32)
    image.pixels.foreach_get(pixels.ravel())
    bpy.data.images.remove(image)
    path.unlink()
    return pixels[::-1]


def render_halves(scene: bpy.types.Scene, job: Path, samples: int, parts: int, seed: int) -> dict[str, np.ndarray]:
    """Two pictures of half the samples each, whose difference is the noise. They are rendered in several parts, as
    Cycles without a window says nothing of how far a render is."""
    started, halves = time.perf_counter(), [0.0, 0.0]
    for number in range(parts):
        halves[number % 2] += render(scene, job / "part.exr", samples // parts, seed + number) / (parts // 2)
        taken, done = time.perf_counter() - started, (number + 1) / parts
        worker.emit("progress", stage="cycles", fraction=MASK_SHARE + (1.0 - MASK_SHARE) * done, rays=0,
                    seconds_left=taken / done * (1.0 - done))
    return {"half_0": np.float32(halves[0]), "half_1": np.float32(halves[1]),
            "seconds": np.array(time.perf_counter() - started)}


def render_mask(scene: bpy.types.Scene, job: Path, names: list[str]) -> dict[str, np.ndarray]:
    """Which object the centre of each pixel shows, and how far it is: colours of a material that all surfaces wear."""
    layer = next(layer for layer in scene.view_layers if layer.use)
    kept = {found: tuple(found.color) for found in scene.objects}
    hidden = [found for found in scene.objects if found.type == "LIGHT" and not found.hide_render]
    world, filter_width = scene.world, scene.cycles.filter_width
    for found in scene.objects:
        number = names.index(found.name) + 1 if found.library is None and found.name in names else 0
        found.color = (float(number), 0.0, 0.0, 1.0)
    for found in hidden:
        found.hide_render = True
    scene.world, scene.cycles.filter_width, layer.material_override = None, 0.01, mask_material()
    try:
        picture = render(scene, job / "mask.exr", 1, 0)
    finally:
        scene.world, scene.cycles.filter_width, layer.material_override = world, filter_width, None
        for found in hidden:
            found.hide_render = False
        for found, colour in kept.items():
            found.color = colour
    shown = picture[..., 3] > 0.5
    return {"objects": np.where(shown, np.rint(picture[..., 0]), 0).astype(np.int32),
            "depth": np.where(shown, picture[..., 1], 0.0).astype(np.float32)}


def mask_material() -> bpy.types.Material:
    """Emits the object's number as red, and the depth as green."""
    material = bpy.data.materials.new("PRT mask")
    tree = material.node_tree
    tree.nodes.clear()
    output, emission, place, split, join, camera = (tree.nodes.new(f"ShaderNode{kind}") for kind in (
        "OutputMaterial", "Emission", "ObjectInfo", "SeparateColor", "CombineColor", "CameraData"))
    for start, end in ((place.outputs["Color"], split.inputs["Color"]), (split.outputs["Red"], join.inputs["Red"]),
                       (camera.outputs["View Z Depth"], join.inputs["Green"]),
                       (join.outputs["Color"], emission.inputs["Color"]),
                       (emission.outputs["Emission"], output.inputs["Surface"])):
        tree.links.new(start, end)
    return material


def run(job: Path) -> int:
    """Render what the request asks for. Returns the exit status."""
    request = json.loads((job / "request.json").read_text("utf-8"))
    worker.emit("progress", stage="cycles", fraction=0.0, rays=0, seconds_left=None)
    try:
        scene = open_copy(job, request)
        prepare_render(scene, *request["size"])
        found = render_mask(scene, job, request["objects"])
        worker.emit("progress", stage="cycles", fraction=MASK_SHARE, rays=0, seconds_left=None)
        found |= render_halves(scene, job, request["samples"], request["parts"], request["seed"])
        with open(job / "result.part", "wb") as stream:
            np.savez(stream, **found)
        (job / "result.part").replace(job / "result.npz")
    except (RuntimeError, OSError, MemoryError) as error:
        worker.emit("error", subject="Cycles", cause=f"it could not render the scene ({' '.join(str(error).split())})",
                    remedy="Check that a render with Cycles works, and that there is room on the disk", exit_code=1)
        return 1
    worker.emit("done")
    return 0


def main() -> int:
    job = Path(sys.argv[sys.argv.index("--") + 1])
    sys.stdout = open(job / "messages.jsonl", "a", encoding="utf-8")  # noqa: SIM115  Blender writes to descriptor 1
    worker.be_polite()
    worker.die_with_parent(lambda: shutil.rmtree(job, ignore_errors=True))
    return run(job)


if __name__ == "__main__":
    sys.exit(main())
