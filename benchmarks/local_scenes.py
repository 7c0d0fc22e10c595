# SPDX-License-Identifier: GPL-3.0-or-later
"""The scenes of Kristensen et al. 2005 (section 7) as Blender scenes: Cornell box, the same with a hole in a wall, a
bunny between coloured walls, a maze. Every panel has vertices of its own, so that edges of a room stay sharp."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import bpy
import numpy as np
from common import mesh_path
from numpy.typing import ArrayLike, NDArray

WHITE, RED, GREEN, BLUE = (0.75, 0.75, 0.75), (0.63, 0.065, 0.05), (0.14, 0.45, 0.09), (0.1, 0.15, 0.6)

# Roughness of the bunny: the paper's Phong exponent n = 12 as GGX, alpha^2 = 2 / (n + 2), alpha = roughness^2.
GLOSS = (2.0 / 14.0) ** 0.25


@dataclass(frozen=True)
class Panel:
    """A grid of quads: corner (3,), its two sides (3,) with the face towards side_u x side_v, cells along each,
    colour; holes: cells (i, j) left out."""

    corner: ArrayLike
    side_u: ArrayLike
    side_v: ArrayLike
    cells: tuple[int, int]
    colour: tuple[float, float, float]
    holes: frozenset[tuple[int, int]] = frozenset()


def build(name: str, panels: Sequence[Panel]) -> bpy.types.Object:
    """One mesh object of the panels, flat-shaded, a diffuse material for each colour."""
    points, faces, colours = [], [], []
    for panel in panels:
        first = sum(len(p) for p in points)
        points.append(_grid(panel))
        u, v = panel.cells
        for i in range(u):
            for j in range(v):
                if (i, j) not in panel.holes:
                    place = first + i * (v + 1) + j
                    faces.append((place, place + v + 1, place + v + 2, place + 1))
                    colours.append(panel.colour)
    mesh = bpy.data.meshes.new(name)
    mesh.from_pydata(np.concatenate(points).tolist(), [], faces)
    known = {colour: number for number, colour in enumerate(dict.fromkeys(colours))}
    for colour in known:
        mesh.materials.append(diffuse(f"{name} {colour}", colour))
    mesh.polygons.foreach_set("material_index", [known[colour] for colour in colours])
    mesh.validate()
    made = bpy.data.objects.new(name, mesh)
    bpy.context.scene.collection.objects.link(made)
    return made


def _grid(panel: Panel) -> NDArray[np.float64]:
    """Vertices of a panel, row by row."""
    u, v = (np.linspace(0.0, 1.0, n + 1) for n in panel.cells)
    corner, side_u, side_v = (np.asarray(x, np.float64) for x in (panel.corner, panel.side_u, panel.side_v))
    return (corner + u[:, None, None] * side_u + v[None, :, None] * side_v).reshape(-1, 3)


def diffuse(name: str, colour: Sequence[float]) -> bpy.types.Material:
    """A purely diffuse material."""
    material = bpy.data.materials.new(name)
    if material.node_tree is None:
        material.use_nodes = True
    nodes, links = material.node_tree.nodes, material.node_tree.links
    nodes.clear()
    shader, output = nodes.new("ShaderNodeBsdfDiffuse"), nodes.new("ShaderNodeOutputMaterial")
    shader.inputs["Color"].default_value = (*colour, 1.0)
    links.new(shader.outputs["BSDF"], output.inputs["Surface"])
    return material


def room(low: ArrayLike, high: ArrayLike, cells: int, colours: dict[str, tuple[float, float, float]],
         holes: frozenset[tuple[int, int]] = frozenset()) -> list[Panel]:
    """The inside of a box, faces inwards; colours of -x, +x, +y (back), -y (front), floor, ceiling, where given; holes:
    of the wall at -x."""
    (x, y, z), (u, v, w) = np.asarray(low, np.float64), np.asarray(high, np.float64) - np.asarray(low, np.float64)
    n = (cells, cells)
    sides = {
        "-x": Panel((x, y, z), (0, v, 0), (0, 0, w), n, colours.get("-x", WHITE), holes),
        "+x": Panel((x + u, y, z), (0, 0, w), (0, v, 0), n, colours.get("+x", WHITE)),
        "back": Panel((x, y + v, z), (u, 0, 0), (0, 0, w), n, colours.get("back", WHITE)),
        "front": Panel((x, y, z), (0, 0, w), (u, 0, 0), n, colours.get("front", WHITE)),
        "floor": Panel((x, y, z), (u, 0, 0), (0, v, 0), n, colours.get("floor", WHITE)),
        "ceiling": Panel((x, y, z + w), (0, v, 0), (u, 0, 0), n, colours.get("ceiling", WHITE)),
    }
    return [panel for side, panel in sides.items() if side in colours]


def block(centre: ArrayLike, size: ArrayLike, turn: float, cells: int,
          colour: tuple[float, float, float]) -> list[Panel]:
    """The outside of a box that stands on the floor, turned about z (radians): no bottom."""
    half = 0.5 * np.asarray(size, np.float64)
    across = np.array([np.cos(turn), np.sin(turn), 0.0])
    along = np.array([-np.sin(turn), np.cos(turn), 0.0])
    up, base = np.array([0.0, 0.0, 2.0 * half[2]]), np.asarray(centre, np.float64)
    a, b = across * half[0], along * half[1]
    n = (cells, cells)
    return [Panel(base - a - b, 2 * a, up, n, colour), Panel(base + a - b, 2 * b, up, n, colour),
            Panel(base + a + b, -2 * a, up, n, colour), Panel(base - a + b, -2 * b, up, n, colour),
            Panel(base - a - b + up, 2 * a, 2 * b, n, colour)]


CORNELL = {"-x": RED, "+x": GREEN, "back": WHITE, "floor": WHITE, "ceiling": WHITE}
BLOCKS = (((-0.35, 0.35, 0.0), (0.6, 0.6, 1.2), 0.3), ((0.35, -0.25, 0.0), (0.6, 0.6, 0.6), -0.3))


def cornell() -> tuple[bpy.types.Object, NDArray[np.float64]]:
    """The Cornell box of about 4k triangles, open in front, and the corners (2, 3) of where lights move."""
    panels = room((-1, -1, 0), (1, 1, 2), 18, CORNELL)
    panels += [p for place, size, turn in BLOCKS for p in block(place, size, turn, 8, WHITE)]
    return build("Cornell", panels), np.array([[-1, -1, 0], [1, 1, 2]], float)


def cornell_with_hole() -> tuple[bpy.types.Object, NDArray[np.float64]]:
    """The closed box with a hole in its left wall, lit through it from open space at its left; about 5k triangles."""
    hole = frozenset((i, j) for i in range(7, 12) for j in range(8, 14))
    panels = room((-1, -1, 0), (1, 1, 2), 18, {**CORNELL, "front": WHITE}, hole)
    panels += [p for place, size, turn in BLOCKS for p in block(place, size, turn, 8, WHITE)]
    panels += [Panel((-3, -1, 0), (2, 0, 0), (0, 2, 0), (12, 12), WHITE)]  # the ground outside
    return build("Cornell with a hole", panels), np.array([[-2.5, -1, 0], [1, 1, 2]], float)


def maze(cells: int = 6, seed: int = 3) -> tuple[bpy.types.Object, NDArray[np.float64]]:
    """A maze of corridors a metre wide and high, walls on both sides of each closed border, about 43k triangles."""
    generator = np.random.default_rng(seed)
    open_x, open_y = _carved(cells, generator)
    n, thick = 12, 0.06
    panels = []
    for i in range(cells):
        for j in range(cells):
            panels.append(Panel((i, j, 0), (1, 0, 0), (0, 1, 0), (n, n), WHITE))
    tones = [WHITE, RED, GREEN, BLUE]
    for i in range(cells + 1):
        for j in range(cells):
            if not (0 < i < cells and open_x[i - 1, j]):
                tone = tones[int(generator.integers(4))]
                panels.append(Panel((i + thick, j, 0), (0, 1, 0), (0, 0, 1), (n, n), tone))
                panels.append(Panel((i - thick, j, 0), (0, 0, 1), (0, 1, 0), (n, n), tone))
    for i in range(cells):
        for j in range(cells + 1):
            if not (0 < j < cells and open_y[i, j - 1]):
                tone = tones[int(generator.integers(4))]
                panels.append(Panel((i, j + thick, 0), (0, 0, 1), (1, 0, 0), (n, n), tone))
                panels.append(Panel((i, j - thick, 0), (1, 0, 0), (0, 0, 1), (n, n), tone))
    return build("Maze", panels), np.array([[0.1, 0.1, 0.1], [cells - 0.1, cells - 0.1, 1.4]], float)


def _carved(cells: int, generator: np.random.Generator) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Openings between neighbours in x (cells - 1, cells) and y (cells, cells - 1) of a maze without loops."""
    open_x, open_y = np.zeros((cells - 1, cells), bool), np.zeros((cells, cells - 1), bool)
    seen, stack = {(0, 0)}, [(0, 0)]
    while stack:
        i, j = stack[-1]
        steps = [(i + a, j + b) for a, b in ((1, 0), (-1, 0), (0, 1), (0, -1))
                 if 0 <= i + a < cells and 0 <= j + b < cells and (i + a, j + b) not in seen]
        if not steps:
            stack.pop()
            continue
        following = steps[int(generator.integers(len(steps)))]
        a, b = following
        if a != i:
            open_x[min(a, i), j] = True
        else:
            open_y[i, min(b, j)] = True
        seen.add(following)
        stack.append(following)
    return open_x, open_y


def glossy_bunny() -> tuple[bpy.types.Object, NDArray[np.float64]]:
    """A glossy bunny between a red and a blue wall, about 11k triangles of it; the bunny is the object returned."""
    build("Walls", room((-1, -1, 0), (1, 1, 2), 16, {"-x": RED, "+x": BLUE, "back": WHITE, "floor": WHITE}))
    bpy.ops.wm.obj_import(filepath=str(mesh_path("stanford-bunny.obj")))
    bunny = bpy.context.selected_objects[0]
    bpy.context.view_layer.objects.active = bunny
    bpy.ops.object.transform_apply(rotation=True)
    bpy.ops.object.shade_smooth()
    reduce = bunny.modifiers.new("Fewer", "DECIMATE")
    reduce.ratio = min(1.0, 9000 / max(1, len(bunny.data.polygons)))
    bpy.ops.object.modifier_apply(modifier=reduce.name)
    points = np.array([v.co for v in bunny.data.vertices])
    low, high = points.min(axis=0), points.max(axis=0)
    scale = 1.2 / (high - low).max()
    bunny.scale = (scale,) * 3
    centre = 0.5 * (low + high) * scale
    bunny.location = (-centre[0], -centre[1], -low[2] * scale)
    bunny.name = "Bunny"
    material = bpy.data.materials.new("Gloss")
    if material.node_tree is None:
        material.use_nodes = True
    shader = material.node_tree.nodes["Principled BSDF"]
    shader.inputs["Base Color"].default_value = (0.8, 0.8, 0.8, 1.0)
    shader.inputs["Metallic"].default_value, shader.inputs["Roughness"].default_value = 1.0, GLOSS
    bunny.data.materials.clear()
    bunny.data.materials.append(material)
    return bunny, np.array([[-1, -1, 0], [1, 1, 2]], float)


SCENES = {"cornell": cornell, "hole": cornell_with_hole, "bunny": glossy_bunny, "maze": maze}
