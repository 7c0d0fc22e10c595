# SPDX-License-Identifier: GPL-3.0-or-later
"""Lamps that shine through translucent bodies in the viewport: on the graphics card where that was faster."""

from __future__ import annotations

from collections.abc import Container, Mapping, Sequence
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from ..gpu_shaders.render_data import LampScattering
from ..prt_addon.lighting.local_lights import LocalLight
from ..prt_addon.reporting.wording import plural
from ..prt_addon.storage.container import BakedTransfer
from .scene_lamps import SceneLamps


class ShownBake(Protocol):
    """What is read of an object that the viewport shows."""

    baked: BakedTransfer
    moved: NDArray[np.float64] | None


def lamp_light(scene_lamps: SceneLamps, name: str, shown: ShownBake, lamps: Sequence[LocalLight],
               moving: Container[str]) -> tuple[NDArray[np.float32] | None, LampScattering | None]:
    """The lamps' direct light on an object, and what is left to be done to it on the graphics card."""
    if shown.baked.links is None or not lamps:
        return scene_lamps.direct(name, shown.baked, lamps, moving, shown.moved), None
    live = scene_lamps.scattering(name, shown.baked)
    direct = scene_lamps.direct(name, shown.baked, lamps, moving, shown.moved, scattered=not live.prefers_card)
    if not live.prefers_card:
        return direct, LampScattering(live)
    return direct, LampScattering(live, scene_lamps.bounced(shown.baked, shown.moved), on_card=True)


def body_lines(scene_lamps: SceneLamps, shown: Mapping[str, ShownBake]) -> list[str]:
    """Short lines for the panel: the bodies that lamps shine through, what their links take, and where they are run."""
    lines = []
    for name, entry in shown.items():
        links = entry.baked.links
        if links is None:
            continue
        points, count = links.texels.shape[:2]
        lines.append(f"{name} is translucent to lamps")
        each = f"{plural(points, 'point', 'points')} of {plural(count, 'link', 'links')}"
        lines.append(f"{each}: {links.size / 1e6:.1f} MB")
        live = scene_lamps.known_scattering(name)
        if live is not None and np.isfinite(live.seconds):
            where, seconds = ("graphics card", live.card_seconds) if live.prefers_card else ("processor", live.seconds)
            lines.append(f"{1e3 * seconds:.1f} ms on the {where}")
    return lines
