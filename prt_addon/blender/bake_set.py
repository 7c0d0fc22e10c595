# SPDX-License-Identifier: GPL-3.0-or-later
"""Whether everything that was there at a bake is still there, and still stands together.

A bake holds as long as all shapes that shadow and light each other keep their places relative to each other: the whole
set may be shifted, turned and evenly scaled. Imports no bpy.
"""

from __future__ import annotations

import base64
import binascii
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

UNKNOWN = ""  # the entry of what the viewport hides: taken to be as it was
SHAPE_CHARACTERS = 32  # of an entry's digest; the place follows
# Rounding of a chain of single precision transforms, relative to the size of the set. A caster that moves by less than
# this changes no light that could be seen.
TOLERANCE = 2e-5


def pack_place(matrix: NDArray[np.floating]) -> str:
    """A transform's upper three rows in single precision, as 64 characters."""
    return base64.b64encode(np.asarray(matrix, np.float64)[:3].astype("<f4").tobytes()).decode()


def unpack_places(entries: Sequence[str]) -> NDArray[np.float64]:
    """Transforms (n, 4, 4) of entries; NaN for those without one. Raises ValueError for text that is none of ours."""
    places = np.full((len(entries), 4, 4), np.nan)
    for number, entry in enumerate(entries):
        if len(entry) > SHAPE_CHARACTERS:
            places[number, :3] = _numbers(entry[SHAPE_CHARACTERS:])
            places[number, 3] = 0.0, 0.0, 0.0, 1.0
    return places


def _numbers(text: str) -> NDArray[np.float32]:
    try:
        return np.frombuffer(base64.b64decode(text, validate=True), "<f4").reshape(3, 4)
    except (binascii.Error, ValueError) as error:
        raise ValueError(f"{text!r} is no place") from error


def changed_piece(then: Mapping[str, str], now: Mapping[str, str], moved: NDArray[np.float64]) -> str | None:
    """The name of a piece that is new, gone, of another shape or elsewhere; None where all came along.

    then, now: entries by name as `fingerprint.surroundings` gives them; moved: (4, 4), from then to now. Names do not
    count: a renamed object casts the same shadow. Raises ValueError for entries that are none of ours.
    """
    unknown = [name for entries in (then, now) for name, entry in entries.items() if entry == UNKNOWN]
    then, now = (_without(entries, unknown) for entries in (then, now))
    if np.array_equal(moved, np.eye(4)):
        known = set(then.values()), set(now.values())
        then = {name: entry for name, entry in then.items() if entry not in known[1]}
        now = {name: entry for name, entry in now.items() if entry not in known[0]}
    if not then and not now:
        return None
    if not then or not now:
        return next(iter(now or then))
    before, after = _points(list(then.values()), list(now.values()), moved)
    for points, others, names in ((after, before, now), (before, after, then)):
        distance, _ = cKDTree(others).query(points, p=np.inf, distance_upper_bound=TOLERANCE)
        missing = np.flatnonzero(~np.isfinite(distance))
        if len(missing):
            return list(names)[missing[0]]
    return None


def _without(entries: Mapping[str, str], unknown: Sequence[str]) -> Mapping[str, str]:
    """The entries but for those of unknown objects and of what these instance."""
    if not unknown:
        return entries
    return {name: entry for name, entry in entries.items()
            if name not in unknown and not name.startswith(tuple(f"{other}/" for other in unknown))}


def _points(then: Sequence[str], now: Sequence[str], moved: NDArray[np.float64],
            ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Entries of then, moved, and of now as points (n, 14) that are near each other where the entries are alike: which
    shape, how it is turned, its size, its position as a share of the farthest."""
    shapes = {shape: float(index) for index, shape in enumerate(
        dict.fromkeys(entry[:SHAPE_CHARACTERS] for entry in (*then, *now)))}
    places = [np.einsum("ij,njk->nik", moved, unpack_places(then)), unpack_places(now)]  # small
    farthest = max([1e-30, *(np.nanmax(np.abs(place[:, :3, 3]), initial=0.0) for place in places)])
    points = []
    for entries, place in zip((then, now), places, strict=True):
        size = np.maximum(np.sqrt(np.sum(place[:, :3, :3] ** 2, axis=(1, 2))), 1e-30)
        numbers = np.array([shapes[entry[:SHAPE_CHARACTERS]] for entry in entries])
        turns = (place[:, :3, :3] / size[:, None, None]).reshape(-1, 9)
        found = np.column_stack([numbers, turns, np.log(size), place[:, :3, 3] / farthest])
        # Entries without a place, of which old bakes have some, lie where nothing of now does.
        points.append(np.where(np.isfinite(found).all(axis=1)[:, None], found, -1.0))
    return points[0], points[1]
