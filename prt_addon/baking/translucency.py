# SPDX-License-Identifier: GPL-3.0-or-later
"""The subsurface stage: each translucent material of each object is a body of its own."""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..scene.scene_mesh import SceneMesh, SceneObject
from ..transport.column_arrays import column_blocks
from ..transport.dipole import Medium, total_reflectance
from ..transport.subsurface import Subsurface, subsurface_transfer
from .surfaces import SurfacePlan

# A channel that returns less of the light than this has none to lose.
DARKEST = 1e-3


@dataclass(frozen=True)
class BodyLight:
    """target: the object's name; points: (k,) places among its points; material: its name; light: of the medium, for
    a subsurface weight of 1, without its transfer; transfer: (k, columns, 3) float32 exit radiance, weight included;
    lost: largest share, of the channels, of what a thick body of the medium returns of uniform light that this one does
    not return."""

    target: str
    points: NDArray[np.int64]
    material: str
    light: Subsurface
    transfer: NDArray[np.float32]
    lost: float


def light_through_bodies(scene: SceneMesh, surfaces: SurfacePlan, translucent: NDArray[np.bool_],
                         transfer: NDArray[np.float32], threads: int, seed: int, at_once: int = 0,
                         ) -> Generator[float, None, list[BodyLight]]:
    """Yield progress, return the light of every body.

    translucent: (p,) points that show it; transfer: (p, columns, channels) unit-albedo irradiance transfer. at_once:
    columns that go through a body together, 0 for all; the links are found anew for each such block.
    """
    bodies = [(target, number) for target in scene.objects if target.is_target
              for number in np.unique(scene.material[target.points][translucent[target.points]])]
    result = []
    for index, (target, number) in enumerate(bodies):
        start = target.points.start
        points = np.flatnonzero(translucent[target.points] & (scene.material[target.points] == number))
        material = surfaces.parts[number].material
        medium = Medium.of_principled(material.base_colour, material.subsurface_radius)
        where = start + points
        body = scene.points[where], scene.normals[where], point_areas(scene, target)[points]
        parts = list(column_blocks(transfer.shape[1], at_once or transfer.shape[1]))
        found = []
        for number_of_part, part in enumerate(parts):
            block = np.ascontiguousarray(transfer[where, part])
            steps = subsurface_transfer(*body, block, medium, threads=threads, seed=seed)
            try:
                while True:
                    yield (index + (number_of_part + next(steps)) / len(parts)) / len(bodies)
            except StopIteration as end:
                found.append(end.value)
        light = _joined(found)
        weight = np.float32(surfaces.parts[number].subsurface_share)
        numbers = replace(light, transfer=light.transfer[:0])
        result.append(BodyLight(target.name, points, material.name, numbers, light.transfer * weight,
                                _lost(medium, light)))
    return result


def _joined(parts: list[Subsurface]) -> Subsurface:
    """Blocks of columns side by side, with the worst of their errors."""
    if len(parts) == 1:
        return parts[0]
    worst = {name: max(getattr(part, name) for part in parts) for name in ("error", "worst", "bound")}
    return replace(parts[0], transfer=np.concatenate([part.transfer for part in parts], axis=1), **worst)


def _lost(medium: Medium, light: Subsurface) -> float:
    """Of uniform light, the share of a half-space's that the body does not return; the largest of the channels."""
    thick = total_reflectance(medium.x, medium.boundary)
    return float(np.max(1.0 - light.energy / np.maximum(thick, DARKEST), where=thick > DARKEST, initial=0.0))


def point_areas(scene: SceneMesh, target: SceneObject) -> NDArray[np.float64]:
    """Area (n,) in square metres that each point of an object stands for: a third of its triangles'."""
    triangles = scene.triangles[target.triangles]
    corners = scene.points[triangles]
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = 0.5 * np.sqrt(np.sum(across ** 2, axis=1))
    count = target.points.stop - target.points.start
    return np.bincount(triangles.ravel() - target.points.start, np.repeat(area / 3.0, 3), minlength=count)


# The arrays and the numbers of a Subsurface that are stored with an interrupted bake.
_ARRAYS, _NUMBERS = ("energy", "reduced"), ("places", "links", "error", "worst", "bound", "checked")


def packed_bodies(bodies: list[BodyLight]) -> tuple[dict[str, NDArray], dict[str, Any]]:
    """Arrays and header of a finished stage."""
    arrays: dict[str, NDArray] = {}
    for index, body in enumerate(bodies):
        arrays |= {f"{index}_points": body.points, f"{index}_transfer": body.transfer}
        arrays |= {f"{index}_{name}": getattr(body.light, name) for name in _ARRAYS}
    return arrays, {"bodies": [{"target": body.target, "material": body.material, "lost": body.lost}
                               | {name: getattr(body.light, name) for name in _NUMBERS} for body in bodies]}


def unpacked_bodies(arrays: dict[str, NDArray], header: dict[str, Any]) -> list[BodyLight]:
    """What `packed_bodies` took apart."""
    result = []
    for index, entry in enumerate(header["bodies"]):
        transfer = arrays[f"{index}_transfer"]
        light = Subsurface(transfer[:0], **{name: entry[name] for name in _NUMBERS},
                           **{name: arrays[f"{index}_{name}"] for name in _ARRAYS})
        result.append(BodyLight(entry["target"], arrays[f"{index}_points"], entry["material"], light, transfer,
                                entry["lost"]))
    return result
