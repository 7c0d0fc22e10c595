# SPDX-License-Identifier: GPL-3.0-or-later
"""A room of a dozen quads: receivers at texels against receivers at vertices of the same room subdivided, at equal
bytes and so nearly of receivers, both against Cycles. Needs the bpy wheel and a graphics driver.

    python benchmarks/texel_room.py [--samples 256] [--size 320] [--pictures FOLDER]
    python benchmarks/texel_room.py --seams

The picture of the camera, drawn by the viewport's shaders, is compared with Cycles pixel by pixel; silhouettes, where
pixels mix surfaces, are left out. Cycles is rendered twice with other seeds: the mean of (ours - a)(ours - b) is the
squared error without its noise. The light is a grey sky through the open half of the ceiling and the open front, which
one coefficient holds exactly: what differs is the receivers' spacing, sampling and compression.

--seams: a smooth signal (the receiver's own place through a sine of 1 m) at both sides of each edge where two charts
meet: the largest and RMS difference, relative to the signal's RMS, and that of the bake's own light.
"""

from __future__ import annotations

import argparse
import os
import sys
import types
from dataclasses import replace
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as in the bake's process; before numpy loads

import bpy
import numpy as np
from common import ROOT, print_table
from numpy.typing import NDArray

package = types.ModuleType("prt")  # gpu_shaders imports the core relatively, as in the installed extension
package.__path__ = [str(ROOT)]
sys.modules["prt"] = package
from prt.gpu_shaders import offscreen
from prt.gpu_shaders.render_data import DrawItem
from prt.prt_addon.baking.recipe import bake, exhaust
from prt.prt_addon.baking.settings import PRESETS
from prt.prt_addon.blender import ground_truth
from prt.prt_addon.blender.read_scene import read_objects
from prt.prt_addon.reporting.comparison import compare, inner_pixels
from prt.prt_addon.scene.scene_mesh import SceneMesh
from prt.prt_addon.scene.texel_receivers import TexelChoice
from prt.prt_addon.storage.container import BakedTransfer

from tests.blender.cycles import diffuse_material, use_cycles

SETTINGS = replace(PRESETS["standard"], order=2, directions=2048, gather_directions=512, clusters=64, vectors=12,
                   compression_error=1e-3, error_receivers=0)
NAMES = ["room", "block"]
SPACINGS = (1 / 11, 1 / 16, 1 / 22.7, 1 / 32, 1 / 45.3)
SKY = 1.0
PER_VERTEX, PER_TEXEL = 4 + 4 * SETTINGS.vectors, 8  # bytes of a receiver, and what a texel needs beside


def add(name: str, points: list, faces: list, materials: list, numbers: list[int]) -> None:
    """One object of quads."""
    mesh = bpy.data.meshes.new(name)
    mesh.from_pydata(points, [], faces)
    for material in materials:
        mesh.materials.append(material)
    mesh.polygons.foreach_set("material_index", numbers)
    bpy.context.scene.collection.objects.link(bpy.data.objects.new(name, mesh))


def make_room() -> None:
    """Eleven quads: floor, three walls, half a ceiling, a turned block without its bottom."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    use_cycles(16)
    colours = ((0.75, 0.75, 0.75, 1), (0.7, 0.15, 0.1, 1), (0.15, 0.55, 0.2, 1))
    materials = [diffuse_material(f"m{number}", colour) for number, colour in enumerate(colours)]
    points = [(-2, -2, 0), (2, -2, 0), (2, 2, 0), (-2, 2, 0), (-2, -2, 3), (2, -2, 3), (2, 2, 3), (-2, 2, 3),
              (-2, 0.3, 3), (2, 0.3, 3)]
    add("room", points, [(0, 1, 2, 3), (7, 6, 9, 8), (3, 2, 6, 7), (0, 3, 7, 4), (2, 1, 5, 6)], materials,
        [0, 0, 0, 1, 2])
    turn = np.array([[np.cos(0.4), -np.sin(0.4)], [np.sin(0.4), np.cos(0.4)]])
    corners = [(x, y, z) for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (0.0, 1.2)]
    placed = [(*(turn @ corner[:2] + (0.6, 0.4)), corner[2]) for corner in corners]  # small
    add("block", placed, [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (1, 5, 7, 3)], materials, [0] * 5)
    background = bpy.context.scene.world.node_tree.nodes["Background"]
    background.inputs["Color"].default_value = (SKY, SKY, SKY, 1.0)
    camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
    camera.data.lens, camera.location, camera.rotation_euler = 26.0, (0.0, -6.0, 1.9), (1.5, 0.0, 0.0)
    bpy.context.scene.collection.objects.link(camera)
    bpy.context.scene.camera = camera
    bpy.context.view_layer.update()


def truth(size: tuple[int, int], samples: int) -> ground_truth.GroundTruth:
    """The camera's view by Cycles."""
    parts, samples = ground_truth.parts_of(samples)
    scene = bpy.context.scene
    process = ground_truth.start_render(scene, bpy.context.view_layer, NAMES, size, parts, samples)
    for message in process.wait():
        if message["type"] == "error":
            raise RuntimeError(message["cause"])
    found = ground_truth.read_render(process, samples)
    process.discard()
    return found


def baked(spacing: float, receivers: str) -> tuple[int, dict[str, BakedTransfer]]:
    """How many receivers there are, and the bakes."""
    objects = read_objects(bpy.context.evaluated_depsgraph_get(), NAMES)
    scene = SceneMesh.assemble(objects, spacing, None, TexelChoice(receivers))
    return len(scene.points), exhaust(bake(scene, SETTINGS)).objects


def texels_of(count: int) -> float:
    """The spacing of texels that gives at most so many receivers."""
    objects = read_objects(bpy.context.evaluated_depsgraph_get(), NAMES)
    fine, coarse = 1 / 400, 1 / 4
    for _ in range(24):
        middle = np.sqrt(fine * coarse)
        over = len(SceneMesh.assemble(objects, middle, None, TexelChoice("texels")).points) > count
        fine, coarse = (middle, coarse) if over else (fine, middle)
    return coarse


def light(columns: int) -> NDArray[np.float32]:
    """A grey sky."""
    values = np.zeros((columns, 3), np.float32)
    values[0] = SKY * np.sqrt(4.0 * np.pi)
    return values


def stored_bytes(objects: dict[str, BakedTransfer]) -> int:
    """Of what a bake keeps: clusters, weights, bases, and where texels are."""
    total = sum(b.cluster.nbytes + b.weights.nbytes + b.bases.nbytes for b in objects.values())
    return total + sum(PER_TEXEL * len(b.cluster) for b in objects.values() if b.texels is not None)


def room(arguments: argparse.Namespace) -> None:
    """The table."""
    make_room()
    size = arguments.size, arguments.size * 3 // 4
    shown = truth(size, arguments.samples)
    inner = inner_pixels(shown.objects, shown.depth)
    rows = []
    for spacing in (0.0, *SPACINGS):
        count, vertices = baked(spacing, "vertices")
        rows.append([count, *measured("vertices", vertices, shown, inner, size, arguments.pictures)])
        if not spacing:
            continue
        texels, at_texels = baked(texels_of(int(count * PER_VERTEX / (PER_VERTEX + PER_TEXEL))), "texels")
        rows.append([texels, *measured("texels", at_texels, shown, inner, size, arguments.pictures)])
    headings = ["receivers", "at", "stored kB", "relative RMS %", "of it the room's %", "the block's %", "bias %",
                "Cycles' noise (removed) %"]
    print_table(headings, rows)


def measured(kind: str, objects: dict[str, BakedTransfer], shown: ground_truth.GroundTruth, inner: NDArray[np.bool_],
             size: tuple[int, int], pictures: Path | None) -> list:
    """One row of the table, without the receivers."""
    items = [DrawItem(name, b, np.eye(4), light(b.columns)) for name, b in objects.items()]
    drawn = offscreen.draw_items(bpy.context.scene, items, *size, samples=4)
    if pictures is not None:
        count = sum(len(b.cluster) for b in objects.values())
        offscreen.write_png(pictures / f"{kind}_{count}.png", drawn, bpy.context.scene)
    found = compare(drawn[..., :3], shown.halves, shown.objects, inner, NAMES)
    parts = [100.0 * part["relative_rms"] for part in found["objects"]]
    return [kind, stored_bytes(objects) / 1e3, 100.0 * found["relative_rms"], *parts, 100.0 * found["bias"],
            100.0 * found["noise"]]


def seams(_arguments: argparse.Namespace) -> None:
    """Differences across the rims of charts."""
    from prt.prt_addon.scene.atlas_seams import across_seams

    from tests.core import shapes

    rows = []
    for name, mesh in (("cube", shapes.box()), ("sphere", shapes.sphere(subdivisions=4)),
                       ("flat grid", shapes.plane(cells=16, size=2.0))):
        for method in ("projection", "xatlas"):
            for side in (64, 128, 256):
                scene = SceneMesh.assemble([mesh_of(mesh)], 0.0, None, TexelChoice("texels", side, method))
                surface = scene.surfaces[0]
                signal = 2.0 + np.sin(2.0 * np.pi * scene.points)
                found = across_seams(surface, signal)
                rows.append([name, method, side, surface.charts, len(scene.points), found.places,
                             100.0 * found.largest, 100.0 * found.rms])
    print_table(["mesh", "charts by", "atlas", "charts", "texels", "places", "largest %", "RMS %"], rows)


def mesh_of(mesh: object) -> object:
    """A mesh of the tests as the package `prt` knows it."""
    from prt.prt_addon.scene.object_mesh import ObjectMesh

    return ObjectMesh(mesh.name, mesh.positions, mesh.triangles, mesh.corner_normals, mesh.corner_albedo, True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--samples", type=int, default=256)
    parser.add_argument("--size", type=int, default=320, help="width of the picture")
    parser.add_argument("--pictures", type=Path)
    parser.add_argument("--seams", action="store_true")
    arguments = parser.parse_args()
    (seams if arguments.seams else room)(arguments)


if __name__ == "__main__":
    main()
