# SPDX-License-Identifier: GPL-3.0-or-later
"""What a bake keeps so that the preview can follow edits of albedo and emission: its form factors, once for all.

The first object's container carries them, the headers of all tell which rows are theirs.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from ..scene.scene_mesh import SceneMesh, SceneObject
from ..storage.container import LIVE_ENTRY, BakedTransfer
from ..storage.digests import digest_arrays
from ..transport.gather import Gather
from ..transport.live_operator import LiveOperator, in_order_of_points, sampled_rows, sampling_error
from .distant_basis import DistantBasis
from .settings import BakeSettings
from .surfaces import SurfacePlan


@dataclass(frozen=True)
class KeptFactors:
    """matrix: (r, r) sampled form factors; key: (r,) of its receivers; error: of the sampling, relative RMS of one
    bounce."""

    matrix: sparse.csr_matrix
    key: NDArray[np.int64]
    error: float


def kept_factors(gathered: Gather | None, albedo: NDArray[np.float32], transfer: NDArray[np.float32],
                 basis: DistantBasis, settings: BakeSettings) -> KeptFactors | None:
    """The form factors of a bake that asks for live editing; None for another, or where nothing sees anything.

    albedo: (points, 3); transfer: (r, columns, channels), for the error in a white world.
    """
    if not settings.live_editing or gathered is None:
        return None
    key, matrix = gathered.receivers.key, gathered.matrix
    sampled = sampled_rows(matrix, settings.live_entries)
    radiosity = (albedo[key % len(albedo)][:, :transfer.shape[2]] * basis.white(transfer)).astype(np.float32)
    return KeptFactors(sampled, key, sampling_error(matrix, sampled, radiosity))


def with_live_editing(objects: dict[str, BakedTransfer], kept: KeptFactors | None, scene: SceneMesh,
                      surfaces: SurfacePlan, albedo: NDArray[np.float32], buried: NDArray[np.int64],
                      ) -> tuple[dict[str, BakedTransfer], dict[str, Any]]:
    """The containers with what live editing needs, and what the report tells of it; as they are without `kept`.

    albedo: (points, 3) that bounces light; buried: keys inside other bodies.
    """
    if kept is None:
        return objects, {}
    targets = [o for o in scene.objects if o.is_target]
    points = np.concatenate([np.arange(o.points.start, o.points.stop) for o in targets])
    matrix, key = in_order_of_points(kept.matrix, kept.key, points, len(scene.points))
    matrix = _past_buried(matrix, key, buried, scene, targets)
    point = key % len(scene.points)
    share = np.array([part.diffuse_share for part in surfaces.parts], np.float32)[scene.material[point]]
    operator = LiveOperator(matrix, np.ascontiguousarray(albedo[point], np.float32), share)
    name = digest_arrays(*operator.arrays().values())
    found, start = {}, 0
    for target in targets:
        entry = {"operator": name, "start": start, "receivers": len(key), "error": kept.error, "bytes": operator.bytes}
        baked = objects[target.name]
        found[target.name] = replace(baked, header={**baked.header, LIVE_ENTRY: entry},
                                     live=operator if start == 0 else None)
        start += target.points.stop - target.points.start
    told = {"bytes": operator.bytes, "entries": int(matrix.nnz), "receivers": len(key), "error": kept.error}
    return {**objects, **found}, {LIVE_ENTRY: told}


def _past_buried(matrix: sparse.csr_matrix, key: NDArray[np.int64], buried: NDArray[np.int64], scene: SceneMesh,
                 targets: list[SceneObject]) -> sparse.csr_matrix:
    """Receivers inside other bodies send nothing, as in the bake, where they are dark; what they are drawn with is
    their neighbours' light (`transport.buried.fill_buried`), so that they take a neighbour's row."""
    if not len(buried):
        return matrix
    hidden = np.isin(key, buried)
    matrix = matrix.copy()
    matrix.data[hidden[matrix.indices]] = 0.0
    matrix.eliminate_zeros()
    place = np.full(len(scene.points), -1, np.int64)
    count = sum(o.points.stop - o.points.start for o in targets)
    place[key[:count]] = np.arange(count)
    row = np.arange(len(key))
    known = ~hidden
    corners = place[scene.triangles]
    edges = np.concatenate([corners[:, [0, 1]], corners[:, [1, 2]], corners[:, [2, 0]]])
    edges = edges[(edges >= 0).all(axis=1)]
    edges = np.concatenate([edges, edges[:, ::-1]])
    for _ in range(2):  # rings, as many as are filled
        rim = edges[~known[edges[:, 0]] & known[edges[:, 1]]]
        row[rim[:, 0]] = row[rim[:, 1]]
        known[rim[:, 0]] = True
    return matrix[row]
