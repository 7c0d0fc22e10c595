# SPDX-License-Identifier: GPL-3.0-or-later
"""Which objects get texels as receivers, how fine, and what then lies at their points."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..errors import BadScene
from .atlas import make_atlas
from .charts import face_normals
from .part import Part
from .texel_surface import TexelSurface

RECEIVERS = ("vertices", "texels", "auto")
# "auto": texels where triangles are this many times as long as the wanted distance between receivers.
COARSE = 4.0


@dataclass(frozen=True)
class TexelChoice:
    """receivers: "vertices", "texels", or "auto": texels on objects whose triangles are coarse; side: most texels along
    a side of an object's atlas; method: of its charts (`unwrapping.METHODS`)."""

    receivers: str = "vertices"
    side: int = 512
    method: str = "projection"


def wants_texels(choice: TexelChoice, part: Part, spacing: float) -> bool:
    """Whether an object gets texels. spacing: metres between receivers, 0 for the mesh's own."""
    if choice.receivers != "auto":
        return choice.receivers == "texels"
    if not len(part.triangles):
        return False
    areas = face_normals(part.points, part.triangles)[1]
    # As long as the sides of the mean triangle, were it half a square.
    return spacing > 0.0 and float(np.sqrt(2.0 * areas.mean())) > COARSE * spacing


def texel_part(name: str, choice: TexelChoice, part: Part, spacing: float) -> Part:
    """The texels of an object; none for its vertices without a face. spacing: metres between them, 0 for as fine as the
    atlas holds. Raises BadScene and PRTError as `make_atlas` does."""
    atlas = make_atlas(name, part.points, part.normals, part.triangles, texel=spacing, side=choice.side,
                       tangents=part.tangents, method=choice.method)
    texels = atlas.texels
    if not len(texels):
        raise BadScene(name, "no texel lies on it", "Bake it at its vertices")
    corner = part.triangles[texels.triangle]
    albedo = np.sum(texels.barycentric[:, :, None] * part.albedo[corner], axis=1).astype(np.float32)
    triangles = atlas.cell_triangles().astype(np.int32)
    surface = TexelSurface.of_atlas(atlas, part.points, part.normals, part.tangents, part.triangles, part.source)
    return Part(texels.positions, texels.normals, np.clip(albedo, 0.0, 1.0), triangles, part.material[corner[:, 0]],
                texels.tangents, False, part.source[texels.triangle[triangles[:, 0]]], surface)
