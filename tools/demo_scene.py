# SPDX-License-Identifier: GPL-3.0-or-later
"""Builds the demo's scene from what Blender brings along: Suzanne (CC0), primitives and one of its world HDRIs (CC0).

    python tools/demo_scene.py build/demo/scene.blend [--world courtyard]
"""

from __future__ import annotations

import argparse
import math
import shutil
from collections.abc import Callable
from pathlib import Path

import bpy  # first: in the wheel, the other two exist only after it

# isort: split
import bmesh
from mathutils import Euler, Matrix, Vector

STRENGTH = 1.1  # of the HDRI
Colour = tuple[float, float, float]
Shape = Callable[[bmesh.types.BMesh], object]

WHITE, GREY = (0.62, 0.58, 0.53), (0.36, 0.35, 0.34)
RED, TEAL, BRASS, WAX = (0.56, 0.05, 0.03), (0.01, 0.24, 0.27), (0.95, 0.65, 0.25), (0.80, 0.42, 0.22)


def add_object(name: str, shape: Shape, colour: Colour, placed: Matrix, smooth: bool = False,
               **inputs: float | Colour) -> bpy.types.Object:
    """An object with a mesh that `shape` fills, a Principled material with these inputs, and a place."""
    content = bmesh.new()
    shape(content)
    for face in content.faces:
        face.smooth = smooth
    mesh = bpy.data.meshes.new(name)
    content.to_mesh(mesh)
    content.free()
    material = bpy.data.materials.new(name)
    shader = next(node for node in material.node_tree.nodes if node.type == "BSDF_PRINCIPLED")
    shader.inputs["Base Color"].default_value = (*colour, 1.0)
    for name_of_input, value in {"Roughness": 1.0, "Specular IOR Level": 0.0, **inputs}.items():
        shader.inputs[name_of_input].default_value = value
    mesh.materials.append(material)
    created = bpy.data.objects.new(name, mesh)
    created.matrix_world = placed
    bpy.context.scene.collection.objects.link(created)
    return created


def box(size: Colour, cuts: int) -> Shape:
    """A box with so many cuts along each edge, dense enough for shadows to be stored at its vertices."""

    def fill(content: bmesh.types.BMesh) -> None:
        bmesh.ops.create_cube(content, size=1.0, matrix=Matrix.Diagonal((*size, 1.0)))
        bmesh.ops.subdivide_edges(content, edges=content.edges[:], cuts=cuts, use_grid_fill=True)

    return fill


def ground(size: float, cells: int) -> Shape:
    """A square of this half size whose cells are smaller in the middle, where the shadows fall."""

    def fill(content: bmesh.types.BMesh) -> None:
        bmesh.ops.create_grid(content, x_segments=cells, y_segments=cells, size=1.0)
        for vertex in content.verts:
            vertex.co = [size * (0.6 * u + 0.4 * u ** 5) for u in vertex.co]

    return fill


def pillar(content: bmesh.types.BMesh) -> None:
    """A cylinder with a smooth side and sharp rims; the bake refines its long faces by itself."""
    bmesh.ops.create_cone(content, cap_ends=True, segments=64, radius1=0.42, radius2=0.42, depth=1.5)
    for edge in content.edges:
        edge.smooth = all(len(face.verts) == 4 for face in edge.link_faces)


def placed(x: float, y: float, z: float, turn: Colour = (0.0, 0.0, 0.0), scale: float = 1.0) -> Matrix:
    """Location, rotation in degrees (XYZ) and scale."""
    rotation = Euler([math.radians(angle) for angle in turn]).to_matrix().to_4x4()
    return Matrix.Translation((x, y, z)) @ rotation @ Matrix.Scale(scale, 4)


def add_shapes() -> None:
    """Suzanne, subdivided by a modifier, between coloured things that lend her their colours."""
    add_object("Ground", ground(5.5, 180), GREY, placed(0.0, 1.5, 0.0))
    suzanne = add_object("Suzanne", lambda m: bmesh.ops.create_monkey(m), WHITE,
                         placed(0.0, 0.0, 0.51, (-35.0, 0.0, 10.0)), smooth=True)
    suzanne.modifiers.new("Subdivision", "SUBSURF").levels = 2
    add_object("Red wall", box((0.16, 2.3, 1.9), 20), RED, placed(-1.5, 0.25, 0.951, (0.0, 0.0, -8.0)))
    add_object("Teal pillar", pillar, TEAL, placed(1.7, 0.75, 0.751), smooth=True)
    add_object("Brass ball", lambda m: bmesh.ops.create_icosphere(m, subdivisions=5, radius=0.38), BRASS,
               placed(1.15, -0.75, 0.381), smooth=True, Metallic=1.0, Roughness=0.4)
    add_object("Wax ball", lambda m: bmesh.ops.create_icosphere(m, subdivisions=5, radius=0.3), WAX,
               placed(-0.7, -1.15, 0.301), smooth=True,
               **{"Subsurface Weight": 1.0, "Subsurface Scale": 1.0, "Subsurface Radius": (1.0, 0.4, 0.2)})


def add_camera() -> None:
    """A camera that looks down at Suzanne from the front."""
    camera = bpy.data.objects.new("Camera", bpy.data.cameras.new("Camera"))
    camera.data.lens = 50.0
    camera.location = (0.7, -5.3, 4.1)
    camera.rotation_euler = (Vector((0.05, 0.05, 0.5)) - camera.location).to_track_quat("-Z", "Y").to_euler()
    scene = bpy.context.scene
    scene.collection.objects.link(camera)
    scene.camera = camera
    scene.render.resolution_x, scene.render.resolution_y = 1280, 800


def add_world(name: str, folder: Path) -> None:
    """One of Blender's own HDRIs, copied beside the scene, turned by a Mapping node as artists do."""
    source = Path(bpy.utils.resource_path("LOCAL")) / "datafiles" / "studiolights" / "world" / f"{name}.exr"
    copied = folder / source.name
    shutil.copyfile(source, copied)
    world = bpy.data.worlds.new("World")
    bpy.context.scene.world = world
    tree = world.node_tree
    tree.nodes.clear()
    coordinates, mapping, environment, background, output = (tree.nodes.new(kind) for kind in (
        "ShaderNodeTexCoord", "ShaderNodeMapping", "ShaderNodeTexEnvironment", "ShaderNodeBackground",
        "ShaderNodeOutputWorld"))
    mapping.vector_type = "POINT"
    environment.image = bpy.data.images.load(str(copied))
    background.inputs["Strength"].default_value = STRENGTH
    tree.links.new(coordinates.outputs["Generated"], mapping.inputs["Vector"])
    tree.links.new(mapping.outputs["Vector"], environment.inputs["Vector"])
    tree.links.new(environment.outputs["Color"], background.inputs["Color"])
    tree.links.new(background.outputs["Background"], output.inputs["Surface"])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("output", type=Path)
    parser.add_argument("--world", default="courtyard")
    arguments = parser.parse_args()
    path = arguments.output.absolute()
    path.parent.mkdir(parents=True, exist_ok=True)
    bpy.ops.wm.read_factory_settings(use_empty=True)
    add_shapes()
    add_camera()
    add_world(arguments.world, path.parent)
    bpy.ops.wm.save_as_mainfile(filepath=str(path), relative_remap=True)


if __name__ == "__main__":
    main()
