# SPDX-License-Identifier: GPL-3.0-or-later
"""All baked objects of a scene under the light that it has now, once: for commands and operators alike."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import bpy
import numpy as np
from numpy.typing import NDArray

from ..prt_addon.blender.fingerprint import surroundings
from ..prt_addon.blender.image_albedo import surface_textures
from ..prt_addon.blender.lights import distant_light
from ..prt_addon.blender.stored import baked_objects, read_baked, stale, transform_since_bake
from ..prt_addon.blender.visibility import find_objects
from ..prt_addon.errors import BadScene
from ..prt_addon.relighting.exit_radiance import view_radiance
from ..prt_addon.relighting.moved_light import distant_light_in, moved_normals, moved_points
from ..prt_addon.relighting.scene_light import joined_light
from ..prt_addon.storage.container import BakedTransfer
from .distant_lamps import unlit_bakes
from .scene_lamps import SceneLamps


@dataclass(frozen=True)
class Lit:
    """By name of the baked object: light in its columns, and direct light of lamps (None for none), both as the bake
    sees them; moved: (4, 4) from where it was baked to where it is now; warnings for the user, each once."""

    light: dict[str, NDArray[np.float32]]
    direct: dict[str, NDArray[np.float32] | None]
    moved: dict[str, NDArray[np.float64]]
    warnings: tuple[str, ...]

    def radiance(self, name: str, baked: BakedTransfer) -> NDArray[np.float32]:
        """(points, 3) that leaves an object's receivers, towards their normals where the view counts."""
        return view_radiance(baked, self.light[name], baked.normals, self.direct[name])


def read_all(scene: bpy.types.Scene, subject: str) -> dict[str, BakedTransfer]:
    """The baked data of all objects by full name. Raises where there is none, or where it is stale: never silently
    used."""
    depsgraph = bpy.context.evaluated_depsgraph_get()
    around = surroundings(depsgraph)
    found: dict[str, BakedTransfer] = {}
    for baked_object in baked_objects(scene):
        transfer = read_baked(baked_object)
        if transfer is None:
            continue
        why = stale(baked_object, depsgraph, around)
        if why:
            raise BadScene(baked_object.name, f"its bake is stale: {why}", "Bake it again")
        found[baked_object.name_full] = transfer
    if not found:
        raise BadScene(subject, "no object in it is baked", "Bake it first with `prt bake`")
    return found


def relit(scene: bpy.types.Scene, baked: dict[str, BakedTransfer], environment: Path | None = None,
          rotate: float = 0.0, use_scene_lights: bool = True, window: bool = False,
          scene_lamps: SceneLamps | None = None, by_directions: bool = False) -> Lit:
    """The light of the scene on its bakes; arguments as those of `light_coefficients`.

    scene_lamps: kept by the caller from one light to the next, who tells it when geometry changes. by_directions:
    lamps light bakes of distant light, too, by the nearest directions.
    """
    depsgraph = bpy.context.evaluated_depsgraph_get()
    distant, warnings, _ = distant_light(scene, depsgraph, (b.lighting_basis for b in baked.values()), environment,
                                         rotate, use_scene_lights, window,
                                         not by_directions and all(b.cloud is None for b in baked.values()))
    objects = find_objects(list(baked), scene)
    moved = {name: transform_since_bake(found, baked[name].header) for name, found in zip(baked, objects, strict=True)}
    scene_lamps = SceneLamps() if scene_lamps is None else scene_lamps
    lamps = scene_lamps.step(baked, depsgraph, warnings, moves=moved) if use_scene_lights else []
    outside = scene_lamps.far.step(baked, depsgraph, warnings) if by_directions and use_scene_lights else []
    warnings += [] if by_directions else unlit_bakes(baked, lamps)
    light, direct = {}, {}
    for name, b in baked.items():
        seen = distant_light_in(distant, b.lighting_basis, moved[name])
        light[name] = joined_light(b.lighting_basis, seen, scene_lamps.cloud_light(b, moved[name]) if lamps else None)
        direct[name] = scene_lamps.direct(name, b, lamps, moved=moved[name]) if lamps else None
        if outside and b.cloud is None:
            direct[name] = scene_lamps.far.direct(name, b, outside, window, moved[name])
    return Lit(light, direct, moved, tuple(dict.fromkeys(warnings)))


def radiance_arrays(baked: dict[str, BakedTransfer], lit: Lit) -> dict[str, NDArray]:
    """What `prt relight` writes: radiance, position, normal, albedo (points, 3) float32 and object (points,) text."""
    moved = lit.moved
    return {
        "radiance": np.concatenate([lit.radiance(n, b) for n, b in baked.items()]).astype(np.float32),
        "position": np.concatenate([moved_points(b.positions, moved[n]) for n, b in baked.items()]).astype(np.float32),
        "normal": np.concatenate([moved_normals(b.normals, moved[n]) for n, b in baked.items()]).astype(np.float32),
        "albedo": np.concatenate([b.albedo for b in baked.values()]),
        "object": np.concatenate([np.full(len(b.cluster), name) for name, b in baked.items()]),
    }


def draw_lit(scene: bpy.types.Scene, baked: dict[str, BakedTransfer], lit: Lit, width: int, height: int,
             background: NDArray[np.float32] | None = None, samples: int = 2) -> NDArray[np.float32]:
    """The active camera's picture of all of them, through the viewport's shaders: as `offscreen.draw_items` gives it,
    which also says what is raised."""
    from ..gpu_shaders import offscreen  # a machine without a graphics driver can do all else
    from ..gpu_shaders.render_data import DrawItem

    depsgraph = bpy.context.evaluated_depsgraph_get()
    items = [DrawItem(name, b, lit.moved[name], lit.light[name], direct=lit.direct[name],
                      textures=surface_textures(scene.objects[name], b, depsgraph)) for name, b in baked.items()]
    return offscreen.draw_items(scene, items, width, height, background, samples)
