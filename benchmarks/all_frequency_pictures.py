# SPDX-License-Identifier: GPL-3.0-or-later
"""A contact sheet of light of all frequencies: a mesh on a ground under an HDRI with a hard sun, by Cycles and relit.

    python benchmarks/all_frequency.py --folder DIR --part 32            first: fills the columns that this one takes
    python benchmarks/all_frequency_pictures.py --folder DIR --picture docs/pictures/all_frequency.png

Every picture is a Cycles render through the same camera and view transform; relit ones show vertex colours as emission,
so that what differs is the representation, and the ground's grid. Radiance is kept in the folder.
"""

from __future__ import annotations

import argparse
import tempfile
from dataclasses import replace
from pathlib import Path

import all_frequency as measured
import bpy
import numpy as np
from against_cycles import use_world
from common import ROOT
from mathutils import Vector
from numpy.typing import NDArray

from prt_addon.baking.distant_basis import DistantBasis
from prt_addon.baking.recipe import bake, exhaust
from prt_addon.blender.pictures import lettered, read_picture, write_picture
from prt_addon.linear_algebra import multiply
from prt_addon.scene.scene_mesh import SceneMesh
from prt_addon.storage.files import intact
from tests.blender.cycles import use_cycles

SUN = measured.SUNS[1]
CUBEMAP, WIDTH, HEIGHT, GAP, LINE = 32, 272, 204, 8, 24
PAPER, INK, TEXT = 28, (0.9, 0.9, 0.9), 16
Double = NDArray[np.float64]


def add_camera(size: float) -> None:
    """Looking down at the mesh and its shadow."""
    camera = bpy.data.objects.new("Camera", bpy.data.cameras.new("Camera"))
    bpy.context.scene.collection.objects.link(camera)
    camera.location, camera.data.lens = Vector((0.3, -1.9, 2.0)) * size, 42.0
    camera.rotation_euler = (Vector((0.25, 0.05, 0.25)) * size - camera.location).to_track_quat("-Z", "Y").to_euler()
    scene = bpy.context.scene
    scene.camera = camera
    scene.render.resolution_x, scene.render.resolution_y, scene.render.resolution_percentage = WIDTH, HEIGHT, 100
    scene.view_settings.view_transform = "Standard"
    scene.view_settings.exposure = -0.6
    scene.render.threads = 2


def rendered(samples: int) -> NDArray[np.uint8]:
    """The camera's view (h, w, 3)."""
    scene = bpy.context.scene
    scene.cycles.samples = samples
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "view.png"
        scene.render.filepath, scene.render.image_settings.file_format = str(path), "PNG"
        bpy.ops.render.render(write_still=True)
        return read_picture(path)


def show_colours(things: list[bpy.types.Object], colours: list[Double]) -> None:
    """Make the vertices' radiance (v, 3) what each object emits."""
    for thing, values in zip(things, colours, strict=True):
        mesh = thing.data
        attribute = mesh.color_attributes.get("relit") or mesh.color_attributes.new("relit", "FLOAT_COLOR", "POINT")
        flat = np.ones((len(mesh.vertices), 4), np.float32)
        flat[:, :3] = values
        attribute.data.foreach_set("color", flat.ravel())
        material = bpy.data.materials.get("relit")
        if material is None:
            material = bpy.data.materials.new("relit")
            if material.node_tree is None:
                material.use_nodes = True
            tree = material.node_tree
            tree.nodes.clear()
            output, emission = tree.nodes.new("ShaderNodeOutputMaterial"), tree.nodes.new("ShaderNodeEmission")
            colour = tree.nodes.new("ShaderNodeVertexColor")
            colour.layer_name = "relit"
            tree.links.new(colour.outputs["Color"], emission.inputs["Color"])
            tree.links.new(emission.outputs[0], output.inputs["Surface"])
        mesh.materials.clear()
        mesh.materials.append(material)


def whole(scene: SceneMesh, folder: Path, light: Double) -> list[Double]:
    """Radiance by all columns, uncompressed."""
    job = folder / f"job{CUBEMAP}"
    key = intact(job / "gather.npz")[0]["key"]
    stored = intact(job / "interreflection.npz")[0]["transfer"][:, :, 0]
    front = np.flatnonzero(key < len(scene.points))
    lit = np.zeros((len(scene.points), 3))
    lit[key[front]] = multiply(np.ascontiguousarray(stored[front]), light.astype(np.float32))
    return [lit[found.points] for found in scene.objects]


def relit_by(scene: SceneMesh, names: list[str], changes: dict[str, object], folder: Path | None) -> list[Double]:
    """Unit-albedo radiance of both objects by one bake."""
    settings = measured.settings_of(**({"order": 10, "clusters": 256, "vectors": 16} if folder is None else {
        "distant_basis": "cubemap", "cubemap_size": CUBEMAP, "directions": 4096}))
    result = exhaust(bake(scene, replace(settings, **changes), folder))
    basis = DistantBasis(int(settings.order)) if folder is None else DistantBasis(0, CUBEMAP)
    image = measured.sky_and_sun(SUN)
    light = measured.environment_texels(image, CUBEMAP) if basis.cubemap else measured.project(image, basis.order)
    return [measured.relit(result.objects[name], light) for name in names]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--mesh", default="spot.obj")
    parser.add_argument("--cells", type=int, default=96)
    parser.add_argument("--samples", type=int, default=128)
    parser.add_argument("--folder", type=Path, default=Path(tempfile.gettempdir()) / "prt-all-frequency")
    parser.add_argument("--picture", type=Path, default=Path("docs/pictures/all_frequency.png"))
    options = parser.parse_args()
    things = measured.make_scene(options.mesh, options.cells)
    names, greys = [thing.name for thing in things], (0.7, 0.5)
    use_cycles(options.samples)
    add_camera(max(things[0].dimensions))
    scene = SceneMesh.assemble(measured.read_objects(bpy.context.evaluated_depsgraph_get(), names), 0.0)
    light = measured.environment_texels(measured.sky_and_sun(SUN), CUBEMAP)
    with tempfile.TemporaryDirectory() as folder:
        use_world(measured.sky_and_sun(SUN), 0.0, folder)
        views = [("Cycles", rendered(options.samples))]
    job = options.folder / f"job{CUBEMAP}"
    cases = [("all 6,144 columns", lambda: whole(scene, options.folder, light)),
             ("256 clusters x 8", lambda: relit_by(scene, names, {"clusters": 256, "vectors": 8}, job)),
             ("eigentransport, d = 192", lambda: relit_by(
                 scene, names, {"encoder": "eigentransport", "vectors": 192}, job)),
             ("eigentransport, d = 48", lambda: relit_by(
                 scene, names, {"encoder": "eigentransport", "vectors": 48}, job)),
             ("harmonics of order 10", lambda: relit_by(scene, names, {}, None))]
    world = bpy.data.worlds.new("behind")  # what lies below the horizon; the image of the other is gone
    if world.node_tree is None:
        world.use_nodes = True
    world.node_tree.nodes["Background"].inputs["Color"].default_value = (0.12, 0.15, 0.195, 1.0)
    bpy.context.scene.world = world
    for number, (caption, found) in enumerate(cases):
        kept = options.folder / f"picture{number}.npz"
        if not kept.exists():
            np.savez(kept, *found())
        radiance = list(np.load(kept).values())
        least = min(float(part.min()) for part in radiance)
        print(f"{caption}: least radiance {least:.3f}", flush=True)
        show_colours(things, [grey * part for grey, part in zip(greys, radiance, strict=True)])
        views.append((caption, rendered(8)))
    save_sheet(ROOT / options.picture, views)


def save_sheet(path: Path, views: list[tuple[str, NDArray[np.uint8]]]) -> None:
    """Three pictures in a row, captions under them."""
    rows = -(-len(views) // 3)
    sheet = np.full((GAP + rows * (HEIGHT + LINE + GAP), 4 * GAP + 3 * WIDTH, 3), PAPER, np.uint8)
    texts = []
    for number, (caption, view) in enumerate(views):
        top, left = GAP + number // 3 * (HEIGHT + LINE + GAP), GAP + number % 3 * (WIDTH + GAP)
        sheet[top:top + HEIGHT, left:left + WIDTH] = view
        texts.append((caption, left, top + HEIGHT + LINE - 6, TEXT))
    write_picture(path, lettered(sheet, texts, INK))
    small = bpy.data.images.load(str(path))
    small.colorspace_settings.name = "Non-Color"
    bpy.context.scene.view_settings.view_transform = "Raw"
    bpy.context.scene.view_settings.exposure = 0.0
    bpy.context.scene.render.image_settings.compression = 100
    bpy.context.scene.render.image_settings.color_mode = "RGB"
    small.save_render(str(path))


if __name__ == "__main__":
    main()
