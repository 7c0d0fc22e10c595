# SPDX-License-Identifier: GPL-3.0-or-later
"""The gather operator as a finished stage of a bake keeps it."""

from __future__ import annotations

from dataclasses import fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from ..scene.scene_mesh import SceneMesh
from ..tracing.tracer import Tracer
from ..transport.gather import Gather
from ..transport.hit_record import HitRecord
from ..transport.receiver_set import ReceiverSet

GATHER_NUMBERS = ("hit_share", "back_share", "lost_share", "two_sided")


def numbers_of(found: Any) -> Any:
    """A gather or an interreflection without its large arrays: what the report tells of it."""
    if isinstance(found, Gather):
        return replace(found, receivers=None, matrix=None, hits=None, shown=None)
    return found if found is None else replace(found, transfer=None)


def packed_gather(gathered: Gather) -> dict[str, NDArray]:
    """The arrays of an operator as a stage's file holds them; GATHER_NUMBERS go beside them."""
    matrix, hits = gathered.matrix, gathered.hits
    packed = {"key": gathered.receivers.key, "data": matrix.data, "indices": matrix.indices, "indptr": matrix.indptr,
              "shown": gathered.shown}
    return packed | ({f"hits_{name}": value for name, value in vars(hits).items()} if hits is not None else {})


def unpacked_gather(scene: SceneMesh, tracer: Tracer, arrays: dict[str, NDArray], numbers: dict[str, Any]) -> Gather:
    """A stored operator; its receivers are made anew, in the stored order."""
    key = arrays["key"]
    made = ReceiverSet.of_keys(scene, tracer, key)
    place = np.empty(len(key), np.int64)
    order = np.argsort(made.key)
    place[np.argsort(key)] = order
    receivers = made.taken(place)
    size = (len(key), len(key))
    matrix = sparse.csr_matrix((arrays["data"], arrays["indices"], arrays["indptr"]), shape=size)
    hits = HitRecord(**{field.name: arrays[f"hits_{field.name}"] for field in fields(HitRecord)}) \
        if "hits_first" in arrays else None
    return Gather(receivers, matrix, *(numbers[name] for name in GATHER_NUMBERS), hits, arrays["shown"])
