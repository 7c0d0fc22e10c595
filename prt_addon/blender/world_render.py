# SPDX-License-Identifier: GPL-3.0-or-later
"""Any World as an equirectangular image: Cycles evaluates it in every pixel's direction.

Cycles' environment bake evaluates the World in the direction of each face corner of a mesh, so no picture is rendered
and the user's Render Result stays. One sample per pixel misses what is smaller than a pixel; where neighbours differ
a lot, pixels are sampled again on a fine grid and averaged, so that the sun of a sky texture keeps its energy.
"""

from __future__ import annotations

import bpy
import numpy as np
from numpy.typing import NDArray

from ..lighting.environment import direction_of_pixel
from .cycles_bake import TEMPORARY, evaluate_corners, scratch_scene
from .nodes import copy_groups

SMALLEST_WIDTH, LARGEST_WIDTH = 1024, 4096
AT_ONCE = 1 << 20  # directions per bake: about 200 MB in Blender
CONTRAST = 0.25  # pixels that differ from a neighbour by more than this share of the larger value are refined,
SHARE = 1e-6  # if they could hold more than this share of all light,
REFINED = 20_000  # the brightest first, at most this many,
STEPS = 8  # each sampled on a grid of this many by this many places
# What a Light Path node says to a diffuse surface that looks for light; all other outputs are zero.
SEEN_BY_DIFFUSE = {"Is Diffuse Ray": 1.0, "Is Reflection Ray": 1.0, "Ray Depth": 1.0, "Diffuse Depth": 1.0,
                   "Ray Length": 1e10}


def render_world(scene: bpy.types.Scene, world: bpy.types.World, image_width: int = 0) -> NDArray[np.float32]:
    """The World's radiance (height, width, 3) float32, linear, top row first, as diffuse surfaces receive it.

    image_width: of the widest image in its nodes, 0 without; the result is at least 1024 and at most 4096 wide. Raises
    PRTError where Cycles is missing or fails.
    """
    width = min(max(image_width, SMALLEST_WIDTH), LARGEST_WIDTH) // 2 * 2
    height = width // 2
    copy = world.copy()
    groups: list[bpy.types.NodeTree] = []
    try:
        copy_groups(copy.node_tree, _answer_as_diffuse, groups)
        with scratch_scene(scene) as scratch:
            scratch.world = copy
            rows, columns = np.divmod(np.arange(height * width), width)
            image = _evaluate(scratch, rows, columns, height, width).reshape(height, width, 3)
            _refine(scratch, image)
    finally:
        bpy.data.worlds.remove(copy)
        for group in groups:
            bpy.data.node_groups.remove(group)
    return image


def _answer_as_diffuse(tree: bpy.types.NodeTree) -> None:
    """Replace Light Path nodes of a tree of ours by what they would say to diffuse surfaces.

    Artists use them to show the camera another background than the one that lights the scene.
    """
    for node in [n for n in tree.nodes if n.bl_idname == "ShaderNodeLightPath"]:
        for socket in node.outputs:
            targets = [link.to_socket for link in socket.links]
            if targets:
                value = tree.nodes.new("ShaderNodeValue")
                value.outputs[0].default_value = SEEN_BY_DIFFUSE.get(socket.name, 0.0)
                for target in targets:
                    tree.links.new(value.outputs[0], target)
        tree.nodes.remove(node)


def _refine(scratch: bpy.types.Scene, image: NDArray[np.float32]) -> None:
    """Average pixels that differ from their neighbours over a grid of places inside them, in place."""
    height, width = image.shape[:2]
    value = image.max(axis=2)
    solid_angle = np.sin(np.pi * (np.arange(height) + 0.5) / height)[:, None]
    largest, smallest = value.copy(), value.copy()
    for neighbour in (np.roll(value, 1, axis=1), np.roll(value, -1, axis=1),
                      np.concatenate([value[:1], value[:-1]]), np.concatenate([value[1:], value[-1:]])):
        np.maximum(largest, neighbour, out=largest)
        np.minimum(smallest, neighbour, out=smallest)
    light = largest * solid_angle
    chosen = (largest - smallest > CONTRAST * largest) & (light > SHARE * np.sum(value * solid_angle, dtype=np.float64))
    index = np.flatnonzero(chosen)
    if len(index) > REFINED:
        index = index[np.argsort(light.ravel()[index], kind="stable")[-REFINED:]]
    if not len(index):
        return
    rows, columns = np.divmod(index, width)
    steps = (np.arange(STEPS) + 0.5) / STEPS - 0.5
    down, right = (grid.ravel() for grid in np.meshgrid(steps, steps, indexing="ij"))
    fine = _evaluate(scratch, (rows[:, None] + down).ravel(), (columns[:, None] + right).ravel(), height, width)
    image[rows, columns] = fine.reshape(len(index), -1, 3).mean(axis=1)


def _evaluate(scratch: bpy.types.Scene, rows: NDArray, columns: NDArray, height: int,
              width: int) -> NDArray[np.float32]:
    """Radiance (n, 3) in the directions of pixels (n,), fractions allowed."""
    parts = []
    for start in range(0, len(rows), AT_ONCE):
        chosen = slice(start, start + AT_ONCE)
        directions = direction_of_pixel(rows[chosen], columns[chosen], height, width)
        mesh = _mesh_of_directions(directions.astype(np.float32))
        try:
            parts.append(evaluate_corners(scratch, mesh, np.eye(4), "ENVIRONMENT")[:len(directions)])
        finally:
            bpy.data.meshes.remove(mesh)
    return np.concatenate(parts)


def _mesh_of_directions(directions: NDArray[np.float32]) -> bpy.types.Mesh:
    """A mesh whose corners, in order, are the directions (n, 3), filled up to whole triangles."""
    count = -(-len(directions) // 3) * 3
    corners = np.concatenate([directions, directions[-1:].repeat(count - len(directions), axis=0)])
    mesh = bpy.data.meshes.new(TEMPORARY)
    mesh.vertices.add(count)
    mesh.vertices.foreach_set("co", corners.ravel())
    mesh.loops.add(count)
    mesh.loops.foreach_set("vertex_index", np.arange(count, dtype=np.int32))
    mesh.polygons.add(count // 3)
    mesh.polygons.foreach_set("loop_start", np.arange(0, count, 3, dtype=np.int32))
    mesh.update(calc_edges=True)
    return mesh
