# SPDX-License-Identifier: GPL-3.0-or-later
"""Any World as an equirectangular image: Cycles evaluates it in every pixel's direction.

Cycles' environment bake evaluates the World in the direction of each face corner of a mesh, so no picture is rendered
and the user's Render Result stays. One sample per pixel misses what is smaller than a pixel; where neighbours differ
a lot, pixels are sampled again on a fine grid and averaged, so that the sun of a sky texture keeps its energy.
"""

from __future__ import annotations

import math

import bpy
import numpy as np
from numpy.typing import NDArray

from ..lighting.environment import direction_of_pixel
from .cycles_bake import TEMPORARY, evaluate_corners, scratch_scene
from .nodes import copy_groups

SMALLEST_WIDTH, LARGEST_WIDTH = 1024, 4096
# A sky texture's sun must not slip between pixels. Its disc gives the same light at any size.
SMALLEST_SUN = math.radians(0.545)
AT_ONCE = 1 << 20  # directions per bake: about 200 MB in Blender
# A pixel that can differ from a neighbour by more than `share` of all light is sampled again, with its neighbours, on a
# grid of `steps` by `steps` places; where more ask for it, the `most` with most at stake. The first line serves edges
# and bright windows, the second the rim of a sun that covers two pixels.
REFINEMENTS = ({"share": 1e-5, "most": 4096, "steps": 8}, {"share": 1e-3, "most": 64, "steps": 40})
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
        copy_groups(copy.node_tree, _prepare, groups)
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


def _prepare(tree: bpy.types.NodeTree) -> None:
    """Replace Light Path nodes of a tree of ours by what they would say to diffuse surfaces, and widen small suns.

    Artists use Light Path to show the camera another background than the one that lights the scene.
    """
    for node in tree.nodes:
        if node.bl_idname == "ShaderNodeTexSky":
            node.sun_size = max(node.sun_size, SMALLEST_SUN)
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
    """Average pixels that differ from their neighbours over a grid of places inside them; changes the image.

    All in one evaluation, because Cycles prepares a sky texture anew for each.
    """
    height, width = image.shape[:2]
    steps = _steps_per_pixel(image)
    rows, columns, owners = [], [], []
    for count in np.unique(steps[steps > 0]):
        row, column = np.nonzero(steps == count)
        places = (np.arange(count) + 0.5) / count - 0.5
        rows.append((row[:, None] + np.repeat(places, count)).ravel())
        columns.append((column[:, None] + np.tile(places, count)).ravel())
        owners.append(np.repeat(row * width + column, count * count))
    if not owners:
        return
    fine = _evaluate(scratch, np.concatenate(rows), np.concatenate(columns), height, width)
    pixels, owner = np.unique(np.concatenate(owners), return_inverse=True)
    members = np.bincount(owner)
    for channel in range(3):
        image.reshape(-1, 3)[pixels, channel] = np.bincount(owner, weights=fine[:, channel]) / members


def _steps_per_pixel(image: NDArray[np.float32]) -> NDArray[np.int64]:
    """How finely each pixel (height, width) has to be sampled again; 0 where once was enough."""
    value = image.max(axis=2)
    solid_angle = np.sin(np.pi * (np.arange(len(image)) + 0.5) / len(image))[:, None]
    stake = np.maximum.reduce([np.abs(n - value) for n in _neighbours(value)]) * solid_angle
    total = np.sum(value * solid_angle, dtype=np.float64)
    steps = np.zeros(value.shape, np.int64)
    for refinement in REFINEMENTS:
        chosen = stake > refinement["share"] * total
        if chosen.sum() > refinement["most"]:
            chosen &= stake >= np.partition(stake.ravel(), -refinement["most"])[-refinement["most"]]
        # With the neighbours: what is smoothed out of one pixel must arrive in the next.
        steps[np.logical_or.reduce([chosen, *_neighbours(chosen)])] = refinement["steps"]
    return steps


def _neighbours(values: NDArray) -> list[NDArray]:
    """The values (height, width) to the right, left, below and above; the rows at the poles are their own."""
    return [np.roll(values, 1, axis=1), np.roll(values, -1, axis=1), np.concatenate([values[:1], values[:-1]]),
            np.concatenate([values[1:], values[-1:]])]


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
