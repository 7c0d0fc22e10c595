# SPDX-License-Identifier: GPL-3.0-or-later
"""Light as a bake sees it whose whole set was moved since: the bake stays where it was, the light goes the other way.

Only similar moves keep a bake valid: turns, shifts and even scales. Distant light does not change with shift and scale.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..lighting.distant_light import DistantColumns, DistantLight
from ..lighting.local_lights import LocalLight

# Relative deviation from a right-angled frame that single precision leaves in a product of a few transforms.
TOLERANCE = 1e-3
# Turns below this, as the largest difference of a matrix' entries, show nothing.
UNTURNED = 1e-5


def similarity(moved: ArrayLike) -> tuple[float, NDArray[np.float64]] | None:
    """Scale and turn (3, 3) of a (4, 4) move; None where it shears, mirrors or scales unevenly."""
    linear = np.array(moved, np.float64)[:3, :3]
    lengths = np.sqrt(np.sum(linear ** 2, axis=0))
    scale = float(lengths.mean())
    if not np.isfinite(scale) or scale <= 0.0:
        return None
    turn = linear / scale
    if np.abs(turn.T @ turn - np.eye(3)).max() > TOLERANCE or np.linalg.det(turn) < 0.0:  # small
        return None
    return scale, turn


def is_turned(moved: ArrayLike) -> bool:
    """Whether distant light has to be turned for it: false for other than similar moves, too."""
    found = similarity(moved)
    return found is not None and bool(np.abs(found[1] - np.eye(3)).max() > UNTURNED)


def distant_light_in(light: DistantLight, columns: DistantColumns, moved: ArrayLike) -> NDArray[np.float64] | None:
    """Distant light (n, 3) in a bake's columns as the bake sees it; as it is for other than similar moves, None where
    there is none."""
    return light.in_columns(columns, similarity(moved)[1].T if is_turned(moved) else None)


def lamp_in(lamp: LocalLight, moved: ArrayLike) -> LocalLight:
    """A lamp as the bake sees it; as it is for other than similar moves.

    Irradiance is power over a squared length, so in a bake that has grown s times the lamp has 1 / s^2 of its power.
    """
    found = similarity(moved)
    if found is None or np.array_equal(moved, np.eye(4)):
        return lamp
    scale = found[0]
    return replace(lamp, matrix=np.linalg.inv(np.asarray(moved, np.float64)) @ lamp.matrix,  # small
                   power=lamp.power / scale ** 2, radius=lamp.radius / scale)


def points_in(points: NDArray[np.floating], moved: ArrayLike) -> NDArray[np.float64]:
    """World points (n, 3) of now as the bake sees them; as they are for other than similar moves."""
    if similarity(moved) is None or np.array_equal(moved, np.eye(4)):
        return np.asarray(points, np.float64)
    return moved_points(points, np.linalg.inv(np.asarray(moved, np.float64)))  # small


def moved_points(points: NDArray[np.floating], matrix: ArrayLike) -> NDArray[np.float64]:
    """Points (n, 3) through a (4, 4) transform."""
    x, y, z = np.asarray(points, np.float64).T
    matrix = np.asarray(matrix, np.float64)
    return np.stack([x * row[0] + y * row[1] + z * row[2] + row[3] for row in matrix[:3]], axis=1)


def moved_normals(normals: NDArray[np.floating], moved: ArrayLike) -> NDArray[np.float64]:
    """Unit normals (n, 3) through a similar move; as they are for any other."""
    found, turn = similarity(moved), np.eye(4)
    if found is not None:
        turn[:3, :3] = found[1]
    return moved_points(normals, turn)
