# SPDX-License-Identifier: GPL-3.0-or-later
"""A small picture of a scene's bakes under the light that it has now."""

from __future__ import annotations

import bpy
import numpy as np
from numpy.typing import NDArray

from ..prt_addon.blender.fingerprint import surroundings
from ..prt_addon.blender.image_albedo import surface_textures
from ..prt_addon.blender.lights import environment_picture
from ..prt_addon.blender.stored import baked_objects, read_baked, stale
from ..prt_addon.errors import PRTError
from .relit import relit


def lit_picture(context: bpy.types.Context) -> NDArray[np.uint8] | None:
    """What the scene's camera, else the 3D viewport sees, (height, width, 4), row 0 up; None where nothing is baked.

    Stale bakes are drawn dimmed, as in the viewport. Raises PRTError where the light can't be read or no graphics
    driver is found.
    """
    scene, depsgraph = context.scene, context.evaluated_depsgraph_get()
    around, baked, old = surroundings(depsgraph), {}, set()
    for found in baked_objects(scene):
        try:
            transfer = read_baked(found)
            if transfer is None or found.hide_render:
                continue
            baked[found.name] = transfer
            if stale(found, depsgraph, around):
                old.add(found.name)
        except PRTError:  # the panel of results says what is wrong with it
            baked.pop(found.name, None)
    if not baked:
        return None
    from ..gpu_shaders.render_data import DrawItem  # a machine without a graphics driver has all the rest
    from ..gpu_shaders.thumbnail import draw_thumbnail

    lit = relit(scene, baked, window=scene.prt.window, by_directions=scene.prt.lamps_by_directions)
    items = [DrawItem(name, b, lit.moved[name], lit.light[name], 2.0 ** scene.prt.exposure, name in old,
                      direct=lit.direct[name], textures=surface_textures(scene.objects[name], b, depsgraph))
             for name, b in baked.items()]
    sky = None if scene.render.film_transparent else environment_picture(scene, depsgraph)
    return draw_thumbnail(scene, items, sky, *_viewport(context))


def _viewport(context: bpy.types.Context) -> tuple[bpy.types.Region | None, bpy.types.RegionView3D | None]:
    """The 3D viewport that the user is in, else the first one; None in background mode."""
    areas = [context.area] if context.area is not None else []
    areas += [area for window in context.window_manager.windows for area in window.screen.areas]
    for area in areas:
        if area.type == "VIEW_3D" and not bpy.app.background:
            region = next(r for r in area.regions if r.type == "WINDOW")
            return region, area.spaces.active.region_3d
    return None, None
