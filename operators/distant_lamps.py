# SPDX-License-Identifier: GPL-3.0-or-later
"""Lamps on bakes of distant light alone, where that is asked for: kept from one light to the next by the viewport."""

from __future__ import annotations

from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass, field

import bpy
import numpy as np
from numpy.typing import NDArray

from ..prt_addon.blender.local_lights import read_local_lights
from ..prt_addon.blender.read_scene import read_objects
from ..prt_addon.blender.visibility import render_visible_objects
from ..prt_addon.lighting.local_lights import LocalLight
from ..prt_addon.relighting.distant_lamps import AREA_POINTS, distant_lamp_radiance
from ..prt_addon.relighting.lamp_light import lamp_shape
from ..prt_addon.relighting.moved_light import lamp_in
from ..prt_addon.relighting.nearest_directions import Hull
from ..prt_addon.reporting.wording import plural
from ..prt_addon.storage.container import BakedTransfer

Move = NDArray[np.float64] | None
INSIDE = ("{}: inside the hull of the scene, where a bake of distant light can't show it. Move it out, or bake with "
          "Lighting: Both")
UNLIT = ("{}: baked without lamps, which light the rest. Bake all with Lighting: Both, or switch Lamps from Afar on")


def unlit_bakes(baked: Mapping[str, BakedTransfer], lamps: Sequence[LocalLight]) -> list[str]:
    """A warning where lamps light some bakes and not others, which without it would only look dark."""
    dark = [name for name, b in baked.items() if b.cloud is None]
    if not lamps or not dark or len(dark) == len(baked):
        return []
    others = f" and {plural(len(dark) - 1, 'other', 'others')}" if len(dark) > 1 else ""
    return [UNLIT.format(f"{dark[0]}{others}")]


@dataclass
class DistantLamps:
    """What depends on geometry is kept until `forget_geometry`, a lamp's light while it stays as it is."""

    _hull: Hull | None = None
    _kept: dict[str, tuple[BakedTransfer, Hashable, NDArray[np.float32]]] = field(default_factory=dict)

    def forget_geometry(self) -> None:
        """Something moved or changed its shape."""
        self._hull = None
        self._kept.clear()

    def step(self, baked: Mapping[str, BakedTransfer], depsgraph: bpy.types.Depsgraph, warnings: list[str],
             owners: Mapping[str, str] | None = None) -> list[LocalLight]:
        """The lamps that can light bakes without columns of local light: those outside the hull of all that casts
        shadows; the others are named in warnings. owners: full names of the scene's objects that show the bakes, where
        these are others. Empty where no such bake is shown."""
        distant = [name for name, b in baked.items() if b.cloud is None]
        visible = {found.name for found in render_visible_objects(depsgraph.view_layer).values()}
        casting = list(dict.fromkeys(owner for name in distant if (owner := (owners or {}).get(name, name)) in visible))
        if not casting:
            return []
        lamps = read_local_lights(depsgraph, warnings)
        if lamps and self._hull is None:
            meshes = read_objects(depsgraph, casting, [])
            self._hull = Hull(np.concatenate([mesh.positions for mesh in meshes]))
        usable = []
        for lamp in lamps:
            if self._hull.inside(lamp.points(AREA_POINTS)[0]).any():
                warnings.append(INSIDE.format(lamp.name))
            else:
                usable.append(lamp)
        return usable

    def direct(self, name: str, baked: BakedTransfer, lamps: Sequence[LocalLight], window: bool = False,
               moved: Move = None) -> NDArray[np.float32] | None:
        """Exit radiance (points, rows, 3) that these lamps add to a bake, moved since as told; None without lamps, or
        where the bake has columns of its own for them."""
        if baked.cloud is not None or not lamps:
            return None
        seen = lamps if moved is None else [lamp_in(lamp, moved) for lamp in lamps]
        key = window, tuple((lamp_shape(lamp), lamp.power.tobytes()) for lamp in seen)
        held = self._kept.get(name)
        if held is None or held[0] is not baked or held[1] != key:
            held = self._kept[name] = baked, key, distant_lamp_radiance(baked, seen, window)
        return held[2]
