# SPDX-License-Identifier: GPL-3.0-or-later
"""What of an object's materials live editing does not follow, as a digest: all but the base colour of what is no metal
and no translucent body, and emission."""

from __future__ import annotations

from dataclasses import replace

import bpy

from ..storage.digests import digest_json
from .materials import constant_albedo
from .nodes import signature
from .surfaces import SurfaceReader

EMISSION_INPUTS = frozenset({"Emission Color", "Emission Strength"})
BLACK = (0.0, 0.0, 0.0)


def followed_digest(materials: list[bpy.types.Material | None]) -> str:
    """Text that changes when the materials of an object's slots change in a way that live editing does not follow."""
    reader = SurfaceReader([])
    return digest_json([_fixed_part(material, reader) for material in materials])


def _fixed_part(material: bpy.types.Material | None, reader: SurfaceReader) -> list[str]:
    """What of a material a bake depends on beyond its colour and emission. A metal's colour, and that of what lies
    below a translucent surface, is in its highlight and in its subsurface light, which stay as they were baked."""
    surface = reader.of(material)
    kept = replace(surface.material, name="")
    if kept.metallic == 0.0 and kept.subsurface_weight == 0.0:
        kept = replace(kept, base_colour=BLACK)
    varies = constant_albedo(material) is None
    return [repr(kept), repr(surface.tangent),
            repr(signature(material.node_tree, False, EMISSION_INPUTS)) if varies else ""]
