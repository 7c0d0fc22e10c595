# SPDX-License-Identifier: GPL-3.0-or-later
"""Transfer of a light cloud's lights: placed, solved, merged zone by zone (Kristensen et al. 2005, sections 4, 5).

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
from ..lighting.light_clustering import (
    default_weights,
    largest_response,
    merge_lights,
    merged_positions,
    merged_response,
    mutual_visibility,
)
from ..lighting.lit_surfaces import LitSurfaces, LocalBasis
from ..lighting.local_lights import LocalLight
from ..lighting.zones import split_zones
from ..scene.scene_mesh import SceneMesh
from ..tracing.tracer import Tracer
from ..transport.gather import Gather
from ..transport.glossy import reflected_light
from ..transport.incident_light import DiffuseRadiance, IndirectLight
from ..transport.local_lights import LightSolver
from .leftovers import RESPONSES, drop_responses
from .lit_highlights import LitHighlights
from .local_budget import Probes, probe_positions
from .settings import BakeSettings
from .surface_transfer import surface_columns, surface_highlights

# Parts of the progress that end with: the first solutions, merging (the rest: solutions at the merged places).
SOLVED, MERGED, PROBED = 0.6, 0.7, 0.95
# Order of directional emission where the scene has lamps that need one: it costs four times an isotropic cloud, and
# tells a spot's light before it from that behind it.
ORDER_OF_SPOTS = 2


@dataclass(frozen=True)
class LocalTransfer:
    """cloud: with every zone's lights, or the lit surfaces that columns stand for; zone: (points,) int32 of the scene's
    points, 0 where nothing is baked; transfer: (points, columns, channels) float32, what reaches a point of the lights
    of its zone by at least one bounce, for unit albedo, zero beyond the zone's last light; facts: for the report;
    points: (g,) of the scene that have highlights; rows: (g, functions, columns, 1 or 3) float32, what these reflect of
    the surfaces that the lights shine on. None without highlights; probes: for the error budget."""

    cloud: LocalBasis
    zone: NDArray[np.int32]
    transfer: NDArray[np.float32]
    facts: dict[str, Any]
    points: NDArray[np.int64] | None = None
    rows: NDArray[np.float32] | None = None
    probes: Probes | None = None


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
                   folder: Path | None, highlights: LitHighlights | None = None,
                   ) -> Generator[float, None, LocalTransfer]:
    """Yield progress, return the transfer.

    gathered, albedo (r, channels) of its receivers: None where no light bounces; keys: points whose transfer is kept;
    regions: (b, 4, 4) boxes of the lights, none for the scene's free space; folder: where large files may lie;
    highlights: of receivers whose hits the gather kept. Raises BadScene where no light fits.
    """
    if folder is not None:
        drop_responses(folder)  # of a bake of this job that was killed
    lights = _placed(tracer, scene, regions, settings)
    if settings.lamp_basis == "surfaces":
        return (yield from _by_surfaces(tracer, scene, gathered, albedo, keys, lights, settings, folder, highlights))
    zones = split_zones(scene.points[keys], settings.zone_receivers or max(1, len(keys)))
    zone = np.zeros(len(scene.points), np.int32)
    zone[keys] = zones.zone
    order = max(1, settings.cloud_emission)
    if gathered is None:
        cloud = LightCloud.of_zones([lights.positions[:1]] * len(zones), lights.positions, lights.spacing, order)
        nothing = np.zeros((len(zone), cloud.columns, 1), np.float32)
        return LocalTransfer(cloud, zone, nothing, _facts(lights, cloud, settings))
    members = [keys[inside] for inside in zones.members()]
    solver = LightSolver(tracer, scene, gathered, albedo, settings.bounce_error, settings.bounces, order,
                         settings.cloud_radius)
    solved, merging = (SOLVED, MERGED) if highlights is None else (0.5 * SOLVED, 0.5 * MERGED)
    values = order ** 2 * albedo.shape[1]
    with tempfile.TemporaryDirectory(dir=folder, prefix=RESPONSES) as place:
        store = _Responses(Path(place), members, gathered, len(lights), values)
        yield from _part(solver.solve(lights.positions, store.take), 0.0, solved)
        found = []
        for number in range(len(members)):
            found.append(_merge(tracer, lights, store.of_zone(number), settings, albedo.shape[1]))
            yield solved + (merging - solved) * (number + 1) / len(members)
    cloud = LightCloud.of_zones([positions for positions, _ in found], lights.positions, lights.spacing, order,
                                settings.cloud_radius)
    transfer = np.zeros((len(scene.points), cloud.columns, albedo.shape[1]), np.float32)
    missing = []
    for number, (_, responses) in enumerate(found):
        for light, response in enumerate(responses):
            if response is None:
                missing.append((number, light))
            else:
                columns = cloud.columns_of(number, light)
                transfer[members[number], columns] = response.reshape(len(response), order ** 2, -1)
    del found
    yield merging
    shiny = np.unique(zone[highlights.points]) if highlights is not None else ()
    plain = [(number, light) for number, light in missing if number not in shiny]
    middle = PROBED if highlights is None else merging + (PROBED - merging) * len(plain) / max(1, len(missing))
    yield from _part(_solve_again(solver, cloud, plain, members, gathered, transfer), merging, middle)
    facts = _facts(lights, cloud, settings)
    points = rows = probes = None
    if highlights is not None:
        points = highlights.points
        rows = yield from _part(_solve_highlights(solver, cloud, set(missing), zone, members, highlights, transfer),
                                middle, PROBED)
    if settings.error_receivers:
        probes = yield from _part(_probes(solver, lights, gathered, len(transfer), order, settings.seed), PROBED, 1.0)
    return LocalTransfer(cloud, zone, transfer, facts, points, rows, probes)


def _by_surfaces(tracer: Tracer, scene: SceneMesh, gathered: Gather | None, albedo: NDArray[np.float32] | None,
                 keys: NDArray[np.int64], lights: PlacedLights, settings: BakeSettings, folder: Path | None,
                 highlights: LitHighlights | None) -> Generator[float, None, LocalTransfer]:
    """`local_transfer` in columns of lit surfaces; the lights of the cloud are some of the lamps that it learns from.
    One zone and nothing merged: a column means the same everywhere."""
    zone = np.zeros(len(scene.points), np.int32)
    if gathered is None:
        nothing = LitSurfaces(np.zeros((0, 3, 3), np.float32), np.zeros((0, 3), np.int32), np.zeros((1, 1), np.float32))
        return LocalTransfer(nothing, zone, np.zeros((len(zone), 1, 1), np.float32),
                             _surface_facts(lights, nothing, 0.0, 0))
    solver = LightSolver(tracer, scene, gathered, albedo, settings.bounce_error, settings.bounces)
    rows = _rows_of_points(gathered, len(zone))[keys]
    end = MERGED if highlights is not None else PROBED
    found = yield from _part(surface_columns(
        tracer, scene, solver, rows, lights.positions, settings.surface_patches, settings.surface_columns,
        settings.seed, folder), 0.0, end)
    transfer = np.zeros((len(zone), found.surfaces.columns, albedo.shape[1]), np.float32)
    transfer[keys] = found.transfer
    points = shown = probes = None
    if highlights is not None:
        points = highlights.points
        shown = yield from _part(surface_highlights(solver, found, highlights), end, PROBED)
    if settings.error_receivers:
        probes = yield from _part(_probes(solver, lights, gathered, len(zone), 1, settings.seed), PROBED, 1.0)
    return LocalTransfer(found.surfaces, zone, transfer,
                         _surface_facts(lights, found.surfaces, found.left, found.lamps), points, shown, probes)


def _surface_facts(lights: PlacedLights, surfaces: LitSurfaces, left: float, lamps: int) -> dict[str, Any]:
    """What the report tells."""
    return {"basis": "surfaces", "patches": int(surfaces.axes.shape[1]), "triangles": len(surfaces.corners),
            "columns": surfaces.columns, "left": left, "lamps": lamps, "warnings": list(lights.warnings)}


def packed_local(local: LocalTransfer) -> tuple[dict[str, NDArray], dict[str, Any]]:
    """Arrays and header of a finished stage."""
    cloud = local.cloud
    if isinstance(cloud, LitSurfaces):
        arrays = {"corners": cloud.corners, "patch": cloud.patch, "axes": cloud.axes}
        known = {}
    else:
        arrays = {"positions": cloud.positions, "zone_starts": cloud.zone_starts, "dense": cloud.dense}
        known = {"emission_order": cloud.emission_order, "spacing": cloud.spacing, "radius": cloud.radius}
    arrays |= {"zone": local.zone, "transfer": local.transfer}
    if local.probes is not None:
        arrays |= {"probe_positions": local.probes.positions, "probe_responses": local.probes.responses}
    if local.rows is not None:
        arrays |= {"points": local.points, "rows": local.rows}
    return arrays, {"facts": local.facts, **known}


def unpacked_local(arrays: dict[str, NDArray], header: dict[str, Any]) -> LocalTransfer:
    """A finished stage."""
    cloud: LocalBasis
    if "axes" in arrays:
        cloud = LitSurfaces(arrays["corners"], arrays["patch"], arrays["axes"])
    else:
        cloud = LightCloud(arrays["positions"], arrays["zone_starts"], header["emission_order"], arrays["dense"],
                           header["spacing"], header["radius"])
    probes = Probes(arrays["probe_positions"], arrays["probe_responses"]) if "probe_positions" in arrays else None
    return LocalTransfer(cloud, arrays["zone"], arrays["transfer"], header["facts"], arrays.get("points"),
                         arrays.get("rows"), probes)


def _placed(tracer: Tracer, scene: SceneMesh, regions: NDArray[np.float64], settings: BakeSettings) -> PlacedLights:
    """The lights of the dense cloud."""
    boxes = list(regions) if len(regions) else [free_space(scene.points[np.unique(scene.triangles)])]
    return place_lights(tracer, boxes, settings.cloud_spacing, settings.cloud_lights, radius=settings.cloud_radius)


def _facts(lights: PlacedLights, cloud: LightCloud, settings: BakeSettings) -> dict[str, Any]:
    """What the report tells."""
    return {"basis": "cloud", "lights": len(lights), "spacing": float(lights.spacing), "inside_bodies": lights.inside,
            "near_surfaces": lights.near, "emission_order": cloud.emission_order, "zones": cloud.zones,
            "merged": [int(n) for n in np.diff(cloud.zone_starts)], "columns": cloud.columns,
            "merged_response": settings.merged_response, "warnings": list(lights.warnings)}


class _Responses:
    """Responses of all lights on disk, (receivers of the zone, lights, values) for each zone."""

    def __init__(self, folder: Path, members: list[NDArray[np.int64]], gathered: Gather, lights: int,
                 values: int) -> None:
        row = np.full(int(gathered.receivers.key.max(initial=0)) + 1, -1, np.int64)
        row[gathered.receivers.key] = np.arange(len(gathered.receivers))
        self._rows = [row[points] for points in members]
        self._files = [np.lib.format.open_memmap(folder / f"zone_{number}.npy", "w+", np.float32,
                                                 (len(points), lights, values))
                       for number, points in enumerate(members)]

    def take(self, part: slice, response: NDArray[np.float32]) -> None:
        """Write some lights' responses (r, lights * functions, channels)."""
        for rows, file in zip(self._rows, self._files, strict=True):
            file[:, part] = response[rows].reshape(len(rows), part.stop - part.start, -1)

    def of_zone(self, number: int) -> NDArray[np.float32]:
        """One zone's responses, in memory; its file is let go."""
        file, self._files[number] = self._files[number], None
        return np.array(file)


def _merge(tracer: Tracer, lights: PlacedLights, responses: NDArray[np.float32], settings: BakeSettings, channels: int,
           ) -> tuple[NDArray[np.float64], list[NDArray[np.float32] | None]]:
    """A zone's merged lights: positions (n, 3) and their responses (receivers, values), None where one is to be found
    by a new solution."""
    positions = lights.positions
    if settings.merge_response == 0.0 or settings.merge_distance == 0.0:
        return positions, [responses[:, light] for light in range(len(positions))]
    w1, w2 = default_weights(tracer.diagonal, largest_response(responses), settings.merge_distance,
                             settings.merge_response)
    labels = merge_lights(positions, responses, mutual_visibility(tracer, positions), w1, w2)
    places = merged_positions(tracer, positions, labels)
    sizes = np.bincount(labels)
    if settings.merged_response != "solution":
        merged = merged_response(responses, labels, settings.merged_response, channels)
        return places, [merged[:, cluster] for cluster in range(len(places))]
    first = np.array([np.flatnonzero(labels == cluster)[0] for cluster in range(len(places))])
    return places, [np.array(responses[:, first[c]]) if sizes[c] == 1 else None for c in range(len(places))]


def _solve_again(solver: LightSolver, cloud: LightCloud, missing: list[tuple[int, int]],
                 members: list[NDArray[np.int64]], gathered: Gather, transfer: NDArray[np.float32],
                 ) -> Generator[float]:
    """New solutions at merged places, written into the transfer of their zones (4.1: "for higher quality")."""
    row = _rows_of_points(gathered, len(transfer))
    functions = cloud.emission_order ** 2

    def take(part: slice, response: NDArray[np.float32]) -> None:
        for offset, (number, light) in enumerate(missing[part]):
            values = response[row[members[number]], offset * functions:(offset + 1) * functions]
            transfer[members[number], cloud.columns_of(number, light)] = values

    places = np.array([cloud.lights_of(number)[light] for number, light in missing]).reshape(-1, 3)
    yield from solver.solve(places, take)


def _probes(solver: LightSolver, lights: PlacedLights, gathered: Gather, points: int, order: int, seed: int,
            ) -> Generator[float, None, Probes]:
    """Solutions at places between the cloud's lights. order: of the solver's emission."""
    positions = probe_positions(solver.tracer, lights.positions, lights.spacing, seed)
    responses = np.zeros((points, len(positions), solver.albedo.shape[1]), np.float32)
    front = gathered.receivers.key < points
    step = order ** 2

    def take(part: slice, response: NDArray[np.float32]) -> None:
        responses[gathered.receivers.key[front], part] = response[front][:, ::step]

    yield from solver.solve(positions, take)
    return Probes(positions, responses)


def _rows_of_points(gathered: Gather, points: int) -> NDArray[np.int64]:
    """(points,) the gather's receiver on the front of each point; -1 without."""
    row = np.full(points, -1, np.int64)
    front = gathered.receivers.key < points
    row[gathered.receivers.key[front]] = np.flatnonzero(front)
    return row


def _solve_highlights(solver: LightSolver, cloud: LightCloud, missing: set[tuple[int, int]], zone: NDArray[np.int32],
                      members: list[NDArray[np.int64]], highlights: LitHighlights, transfer: NDArray[np.float32],
                      ) -> Generator[float, None, NDArray[np.float32]]:
    """Rows (g, functions, columns, channels) of the highlights, zone by zone: a glossy receiver reflects what the
    lights of its own zone do to all surfaces that it sees, near and far, direct light included.

    Glossy surfaces send to each other as much as they get, but evenly (they are in the solver's albedo). Lights are
    solved once more for this, because their field at all receivers is too large to be kept from the first time
    (receivers x lights x channels), each place once for all zones; the merged lights of `missing` get their diffuse
    transfer on the way.
    """
    gathered, functions = solver.gathered, cloud.emission_order ** 2
    row, of_receiver = _rows_of_points(gathered, len(zone)), zone[highlights.points]
    kernels = highlights.surfaces.kernels
    channels = max(kernels[0].shape[2], solver.albedo.shape[1])
    result = np.zeros((len(highlights.points), kernels[0].shape[0], cloud.columns, channels), np.float32)
    which = {int(number): np.flatnonzero(of_receiver == number) for number in np.unique(of_receiver)}
    mine = {number: highlights.of(receivers) for number, receivers in which.items()}
    places, users = _places_of(cloud, list(which))

    def take(part: slice, response: NDArray[np.float32]) -> None:
        for offset, lights in enumerate(users[part]):
            for number, light in lights:
                if (number, light) in missing:
                    inside, columns = members[number], slice(offset * functions, (offset + 1) * functions)
                    transfer[inside, cloud.columns_of(number, light)] = response[row[inside], columns]

    def view(part: slice, radiance: NDArray[np.float32]) -> Generator[float]:
        for done, number in enumerate(which):
            here = [(offset, light) for offset, lights in enumerate(users[part]) for n, light in lights if n == number]
            if not here:
                continue
            offset, light = np.array(here).T
            order = np.arange(functions)
            source = DiffuseRadiance(gathered.hits, solver.scene, gathered.receivers,
                                     radiance[:, (offset[:, None] * functions + order).ravel()])
            indirect = IndirectLight(gathered.hits, source, mine[number].places, mine[number].blocked)
            rows = yield from _part(reflected_light(solver.tracer, mine[number].surfaces, len(here) * functions,
                                                    indirect), done / len(which), (done + 1) / len(which))
            for column, target in enumerate((light[:, None] * functions + order).ravel()):
                result[which[number], :, target] = rows[:, :, column]

    yield from solver.solve(places, take, view)
    return result


def _places_of(cloud: LightCloud, zones: list[int]) -> tuple[NDArray[np.float64], list[list[tuple[int, int]]]]:
    """The places (n, 3) of these zones' lights, each once, and who has a light there: (zone, light) pairs. Lights that
    did not merge are the same in all zones."""
    users: dict[bytes, list[tuple[int, int]]] = {}
    for number in zones:
        for light, place in enumerate(cloud.lights_of(number)):
            users.setdefault(np.ascontiguousarray(place).tobytes(), []).append((number, light))
    places = np.array([np.frombuffer(key, np.float64) for key in users]).reshape(-1, 3)
    return places, list(users.values())


def _part(steps: Generator[float, None, Any], first: float, last: float) -> Generator[float, None, Any]:
    """Progress as a part of the whole; the result."""
    while True:
        try:
            yield first + (last - first) * next(steps)
        except StopIteration as end:
            return end.value
