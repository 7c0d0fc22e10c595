# SPDX-License-Identifier: GPL-3.0-or-later
"""What a container tells of its materials, so that lamps can be added to it when relighting."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ..relighting.lamp_highlights import LampSurfaces
from ..scene.scene_mesh import SceneMesh, SceneObject
from ..storage.container import BakedTransfer
from ..storage.lamp_surfaces import ENTRY, lamp_surfaces_entry
from ..transport.lamp_kernel import LAMP_ORDER
from .surfaces import SurfacePlan


def with_lamp_surfaces(container: BakedTransfer, scene: SceneMesh, target: SceneObject, plan: SurfacePlan,
                       ) -> BakedTransfer:
    """The container of a target of a bake with local lights, with the kernels of its materials; itself where none has
    a highlight."""
    used, number = np.unique(scene.material[target.points], return_inverse=True)
    parts = [plan.parts[material] for material in used]
    if not container.functions or all(part.lamp_kernel is None for part in parts):
        return container
    functions = len(container.functions)
    channels = max(part.lamp_kernel.shape[2] for part in parts if part.lamp_kernel is not None)
    kernels = np.zeros((len(parts), functions, LAMP_ORDER ** 2, channels), np.float32)
    dimming = np.zeros((len(parts), functions), np.float32)
    for index, part in enumerate(parts):
        if part.lamp_kernel is not None:
            kernels[index] = part.lamp_kernel
            dimming[index] = part.dimming
    share = np.array([part.lamp_share for part in parts], np.float32)
    surfaces = LampSurfaces(number.reshape(-1).astype(np.int32), kernels, share, dimming)
    return replace(container, header={**container.header, ENTRY: lamp_surfaces_entry(surfaces)},
                   lamp_surfaces=surfaces)
