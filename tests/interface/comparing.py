# SPDX-License-Identifier: GPL-3.0-or-later
"""Screenshots against the core's own relighting on the CPU, vertex by vertex and through Blender's view transform.

Whatever the viewport shows (perspective, orthographic, a camera, objects moved since their bake): the pixel at each
vertex in sight against the radiance that leaves it towards the eye.
"""

from __future__ import annotations

import subprocess
import tempfile
import time
from collections.abc import Generator
from importlib import import_module
from pathlib import Path

import bpy
import numpy as np
from driving import MODULE, area, region, shoot
from mathutils import Vector

# Levels of 255 that the picture may differ from the oracle in the mean, and all but a hundredth of the vertices: it is
# rounded to levels, and bends at a vertex within a pixel.
MEAN_LEVELS, MOST_LEVELS = 0.6, 4.0
PATIENCE = 15.0  # seconds
RIM = 0.35  # cosine to the eye below which a curved rim is narrower than a pixel
AROUND = 2.0  # pixels around a vertex in which nothing else may be seen
HEIGHT = 1000  # of the screen
STALE_DIMMING = 0.3


def core(name: str) -> object:
    """A module of the installed extension."""
    return import_module(f"{MODULE}.{name}")


def levels(picture: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Levels (n, 3) of a picture at places (n, 2), row and column, blended between the middles of pixels."""
    first = np.floor(places - 0.5).astype(int)
    row, column = (places - 0.5 - first).T[:, :, None]
    top, left = first.T
    values = picture.astype(float)
    upper = values[top, left] * (1.0 - column) + values[top, left + 1] * column
    lower = values[top + 1, left] * (1.0 - column) + values[top + 1, left + 1] * column
    return upper * (1.0 - row) + lower * row


def to_eye(positions: np.ndarray, view: bpy.types.RegionView3D) -> np.ndarray:
    """Directions (n, 3) from positions (n, 3) towards whoever looks through this view."""
    placed = np.array(view.view_matrix.inverted())
    if view.is_perspective:
        return placed[:3, 3] - positions
    return np.broadcast_to(placed[:3, 2], positions.shape)


def oracle(view: bpy.types.RegionView3D, names: set[str]) -> dict[str, tuple[np.ndarray, ...]]:
    """By full name: positions and normals (p, 3) of now, and radiance (p, 3) towards the eye, from the CPU alone;
    dimmed where the panel says stale."""
    stored, relighting = core("prt_addon.blender.stored"), core("prt_addon.relighting.exit_radiance")
    moves, relit = core("prt_addon.relighting.moved_light"), core("operators.relit").relit
    scene = bpy.context.scene
    baked = {o.name_full: stored.read_baked(o) for o in stored.baked_objects(scene) if o.name in names}
    lit, stale = relit(scene, baked), {line.name for line in bpy.context.window_manager.prt.objects if line.stale}
    result = {}
    for name, transfer in baked.items():
        moved = lit.moved[name]
        positions = moves.moved_points(transfer.positions, moved)
        back = np.linalg.inv(moved)
        views = to_eye(positions, view) @ back[:3, :3].T
        radiance = relighting.view_radiance(transfer, lit.light[name], views, lit.direct[name])
        dimming = STALE_DIMMING if name in stale else 1.0
        result[name] = (positions, moves.moved_normals(transfer.normals, moved),
                        np.maximum(radiance, 0.0) * 2.0 ** scene.prt.exposure * dimming)
    return result


def in_sight(found: str, positions: np.ndarray, normals: np.ndarray, box: bpy.types.Region,
             view: bpy.types.RegionView3D, clear: tuple[int, int, int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Which of an object's positions are seen with nothing else near them, and where (n, 2): row and column.

    clear: pixels at the left, right, top and bottom of the region on which something else is drawn.
    """
    matrix, depsgraph = np.array(view.perspective_matrix), bpy.context.evaluated_depsgraph_get()
    clip = np.c_[positions, np.ones(len(positions))] @ matrix.T
    place = 0.5 * clip[:, :2] / clip[:, 3:] + 0.5
    across, up = place[:, 0] * box.width, place[:, 1] * box.height
    eye = to_eye(positions, view)
    facing = np.sum(eye * normals, axis=1) / np.linalg.norm(eye, axis=1)
    left, right, top, bottom = clear
    seen = (clip[:, 3] > 0.0) & (facing > RIM) & (across > left) & (across < box.width - right) & (
        up > bottom) & (up < box.height - top)
    inverse = np.linalg.inv(matrix)
    for index in np.flatnonzero(seen):
        seen[index] = all(_hits(depsgraph, found, positions[index], across[index] + dx, up[index] + dy, box, inverse)
                          for dx, dy in ((0, 0), (AROUND, AROUND), (AROUND, -AROUND), (-AROUND, AROUND),
                                         (-AROUND, -AROUND)))
    return seen, np.stack([HEIGHT - (box.y + up), box.x + across], axis=1)[seen]


def _hits(depsgraph: bpy.types.Depsgraph, found: str, position: np.ndarray, across: float, up: float,
          box: bpy.types.Region, inverse: np.ndarray) -> bool:
    """Whether the object is what is seen at these pixels, near to the position."""
    ends = []
    for depth in (-1.0, 1.0):
        end = inverse @ (2.0 * across / box.width - 1.0, 2.0 * up / box.height - 1.0, depth, 1.0)
        ends.append(Vector(end[:3] / end[3]))
    ray = ends[1] - ends[0]
    hit, where, _, _, thing, _ = bpy.context.scene.ray_cast(depsgraph, ends[0], ray.normalized(), distance=ray.length)
    return hit and thing.name_full == found and (where - Vector(position)).length < 0.12


def displayed(radiance: np.ndarray, shading: bpy.types.View3DShading) -> np.ndarray:
    """Levels (n, 3) of scene-linear values (n, 3) as Blender shows them in this shading: solid always by the Standard
    transform, the material preview by the scene's without look and exposure, the rendered view by all of it."""
    scene, own = bpy.context.scene, bpy.data.scenes.new("displayed")
    image = bpy.data.images.new("displayed", len(radiance), 1, alpha=True, float_buffer=True)
    try:
        settings, shown = own.view_settings, scene.view_settings
        own.render.dither_intensity, settings.view_transform = 0.0, "Standard"
        if shading.type != "SOLID":
            settings.view_transform = shown.view_transform
        if shading.type == "RENDERED":
            settings.look, settings.exposure, settings.gamma = shown.look, shown.exposure, shown.gamma
        output = own.render.image_settings
        output.file_format, output.color_mode, output.color_depth = "PNG", "RGB", "8"
        image.pixels.foreach_set(np.c_[radiance, np.ones(len(radiance))].astype(np.float32).ravel())
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "displayed.png"
            image.save_render(str(path), scene=own)
            raw = subprocess.run(["convert", str(path), "-depth", "8", "rgb:-"], check=True, capture_output=True,
                                 timeout=30)
        return np.frombuffer(raw.stdout, np.uint8).reshape(-1, 3).astype(float)
    finally:
        bpy.data.images.remove(image)
        bpy.data.scenes.remove(own)


def differences(picture: np.ndarray, names: set[str], box: bpy.types.Region, view: bpy.types.RegionView3D,
                shading: bpy.types.View3DShading, clear: tuple[int, int, int, int]) -> np.ndarray:
    """Levels (n, 3) by which a screenshot is brighter than the oracle at these objects' vertices in sight."""
    places, radiances = [np.empty((0, 2))], [np.empty((0, 3))]
    for name, (positions, normals, radiance) in oracle(view, names).items():
        seen, where = in_sight(name, positions, normals, box, view, clear)
        places.append(where)
        radiances.append(radiance[seen])
    return levels(picture, np.concatenate(places)) - displayed(np.concatenate(radiances), shading)


def check_view(name: str, names: set[str], least: int = 100, most: float = MOST_LEVELS, mean: float = MEAN_LEVELS,
               at: tuple[bpy.types.Region, bpy.types.RegionView3D] | None = None,
               clear: tuple[int, int, int, int] = (60, 350, 60, 30)) -> Generator[float, None, np.ndarray]:
    """A screenshot NAME.png that shows what the oracle says, soon: software drawing on a loaded machine takes its time.

    names: of the objects looked at; least: vertices in sight; most, mean: levels off; at: region and view, the
    viewport's as a rule.
    """
    started, live, space = time.monotonic(), core("operators.live_preview"), area().spaces.active
    box, view = at or (region(), space.region_3d)
    while True:
        settled = live.settled()
        yield 0.4
        if not settled and time.monotonic() - started < PATIENCE:
            continue  # the oracle reads the scene as a render has it, which Blender takes for changes of hidden objects
        picture = shoot(name)
        off = differences(picture, names, box, view, space.shading, clear)
        far = float(np.percentile(np.abs(off).max(axis=1), 99.0)) if len(off) else 0.0
        middle, seconds = float(np.abs(off).mean()) if len(off) else 0.0, time.monotonic() - started
        right = settled and middle < mean and far < most
        if right or seconds > PATIENCE:
            break
    print(f"{name}: {len(off)} vertices, {middle:.2f} levels, 99 % below {far:.1f}, after {seconds:.1f} s", flush=True)
    assert len(off) >= least, f"{name}: only {len(off)} vertices in sight"
    assert right, f"{name}: {middle:.2f} levels off in the mean, a hundredth {far:.1f} or more, settled: {settled}"
    return picture
