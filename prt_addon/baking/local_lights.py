# SPDX-License-Identifier: GPL-3.0-or-later
"""Transfer of a local light cloud's lights: placed, solved, merged zone by zone (Kristensen et al. 2005, sections 4, 5).

The responses of all lights at all receivers are the largest thing of such a bake (receivers x lights x channels), so
they go to disk as they are made, one file per zone, and one zone at a time comes back.
"""

from __future__ import annotations

import tempfile
from collections.abc import Generator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..lighting.light_cloud import LightCloud, PlacedLights, free_space, place_lights
from ..lighting.light_clustering import MergedLights, merge_lights
from ..lighting.local_lights import LocalLight
from ..lighting.zones import split_zones
from ..scene.scene_mesh import SceneMesh
from ..tracing.tracer import Tracer
from ..transport.gather import Gather
from ..transport.local_lights import local_responses
from .settings import BakeSettings

# Parts of the progress that end with: the first solutions, merging (the rest: solutions at the merged places).
SOLVED, MERGED = 0.6, 0.7
# Order of directional emission where the scene has lamps that need one: a 45 degree spot keeps a soft direction.
ORDER_OF_SPOTS = 3


@dataclass(frozen=True)
class LocalTransfer:
    """cloud: with every zone's lights; zone: (points,) int32 of the scene's points, 0 where nothing is baked;
    transfer: (points, columns, channels) float32, what reaches a point of the lights of its zone by at least one
    bounce, for unit albedo, zero beyond the zone's last light; facts: for the report."""

    cloud: LightCloud
    zone: NDArray[np.int32]
    transfer: NDArray[np.float32]
    facts: dict[str, Any]


def fit_to_lamps(settings: BakeSettings, lamps: Sequence[LocalLight]) -> tuple[BakeSettings, tuple[str, ...]]:
    """The settings that a scene with these lamps asks for, and what is left out because it has none, a line each."""
    left_out: tuple[str, ...] = ()
    if settings.lighting == "environment,local" and not lamps and not settings.cloud_region:
        settings = replace(settings, lighting="environment")
        left_out = ("local lights are left out: the scene has no lamp, and no region for lamps is named",)
    if settings.local_light and not settings.cloud_emission:
        directed = any(lamp.kind != "point" for lamp in lamps)
        settings = replace(settings, cloud_emission=ORDER_OF_SPOTS if directed else 1)
    return settings, left_out


def local_transfer(tracer: Tracer, scene: SceneMesh, gathered: Gather | None, albedo: NDArray[np.float32] | None,
                   keys: NDArray[np.int64], regions: NDArray[np.float64], settings: BakeSettings,
                   folder: Path | None) -> Generator[float, None, LocalTransfer]:
    """Yield progress, return the transfer.

    gathered, albedo (r, channels) of its receivers: None where no light bounces; keys: points whose transfer is kept;
    regions: (b, 4, 4) boxes of the lights, none for the scene's free space; folder: where large files may lie. Raises
    BadScene where no light fits.
    """
    order = max(1, settings.cloud_emission)
    lights = _placed(tracer, scene, regions, settings)
    zones = split_zones(scene.points[keys], settings.zone_receivers or max(1, len(keys)))
    zone = np.zeros(len(scene.points), np.int32)
    zone[keys] = zones.zone
    if gathered is None:
        return _without_bounces(lights, zone, len(scene.points), order, settings)
    members = [np.sort(keys[inside]) for inside in zones.members()]
    solver = _Solver(tracer, gathered, albedo, settings, order)
    with tempfile.TemporaryDirectory(dir=folder, prefix="responses-") as place:
        store = _Responses(Path(place), members, gathered, len(lights), order, albedo.shape[1])
        yield from _part(solver.solve(lights.positions, store.write), 0.0, SOLVED)
        merged = []
        for number in range(len(members)):
            merged.append(_merged(tracer, scene, lights, store.of_zone(number), settings))
            yield SOLVED + (MERGED - SOLVED) * (number + 1) / len(members)
        cloud = LightCloud.of_zones([m.positions for m in merged], lights.positions, lights.spacing, order,
                                    settings.cloud_radius)
        transfer = np.zeros((len(scene.points), cloud.columns, albedo.shape[1]), np.float32)
        again = []
        for number, found in enumerate(merged):
            kept = found.responses is not None
            if kept:
                transfer[members[number], :found.responses.shape[1]] = found.responses
            again += [(number, light) for light in range(len(found.positions)) if not kept]
        yield MERGED
        yield from _part(_solve_again(solver, cloud, again, members, gathered, transfer), MERGED, 1.0)
    facts = {"lights": len(lights), "spacing": float(lights.spacing), "inside_bodies": lights.inside,
             "near_surfaces": lights.near, "emission_order": order, "zones": len(members),
             "merged": [len(m.positions) for m in merged], "warnings": list(lights.warnings),
             "merged_response": settings.merged_response, "columns": cloud.columns}
    return LocalTransfer(cloud, zone, transfer, facts)
