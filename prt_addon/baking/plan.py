# SPDX-License-Identifier: GPL-3.0-or-later
"""What a bake will do, how long it will take and how much memory: known before the first ray."""

from __future__ import annotations

import math
import os
from dataclasses import dataclass

from ..compression.global_frame import axes_bytes, rows_at_once
from ..lighting.reference_light import ReferenceLight
from ..scene.needs import Needs, decide
from ..scene.scene_mesh import SceneMesh
from ..transport.column_arrays import COLUMNS_AT_ONCE
from ..transport.incident_light import NUMBERS
from ..transport.interreflection import SLOW_RATIO
from ..transport.live_operator import BYTES_PER_ENTRY
from ..transport.local_lights import COLUMNS
from ..transport.receiver_set import BLOCK
from .distant_basis import array_budget, distant_basis
from .live_links import links_bytes
from .sampling import dense_bytes, forecast_seconds, forecast_share, sampling_hints
from .settings import EIGENTRANSPORT, BakeSettings
from .sparse_choice import TYPICAL_SECONDS, note_sparse, sparse_left_out
from .surface_transfer import MOST_ELEMENTS, NEAR_SURFACES, OUTSIDE
from .surfaces import INCIDENT_ORDER, SurfacePlan, plan_surfaces

# Orders of magnitude measured on two cores (benchmarks/tracing.py); used for the forecast and the progress bar only,
# which corrects itself by the time that stages really took.
SHADOW_RAYS_PER_SECOND = 3.5e6
GATHER_RAYS_PER_SECOND = 1.2e6
PATH_RAYS_PER_SECOND = 0.8e6
SECONDS_PER_BOUNCED_VALUE = 2e-8
SECONDS_PER_ENCODED_VALUE, SECONDS_PER_PROJECTED_VALUE = 1.2e-8, 5e-10
SECONDS_PER_GLOSSY_VALUE = 1e-7
SECONDS_PER_LOCAL_VALUE = 2e-7
# Of highlights of local light, for each value of their rows: filled, and encoded (many more values for each receiver
# than diffuse light has, and the encoder first looks for their leading axes).
SECONDS_PER_LOCAL_ROW, SECONDS_PER_WIDE_VALUE = 1.4e-7, 1e-6
SECONDS_PER_SUBSURFACE_VALUE = 2e-6
# Memory, fitted to the peaks of stages of bakes of 3,000 to 41,000 receivers, diffuse and metal, draft to high: it is
# 1.2 to 1.8 times what they took; PROCESS, the interpreter and its libraries, is half of that here, more in Blender.
PROCESS_BYTES, BYTES_PER_TRIANGLE = 200e6, 150
# What arenas of threads and pages of mapped files add to bakes of local lights, more or less of it from run to run.
LOOSE_LOCAL = 1.2
# Of the operator, per hit of a gather ray: three entries; what glossy receivers remember of a hit; and lists of one
# block while they are sorted into the operator.
BYTES_PER_RAY_HIT, BYTES_PER_KEPT_HIT, BYTES_PER_SORTED_HIT = 24, 30, 75
# The bounces' copies of the transfer in single precision, those of the Krylov solver in double (as twice as many), and
# copies of the operator besides its own then; of bases, in double precision twice and in single once.
COPIES_OF_SERIES, COPIES_OF_KRYLOV, BYTES_PER_BASE_VALUE = 5, 24, 20
# How often the encoder holds its rows at once, and the most axes that it looks for (see global_frame.py).
COPIES_OF_ROWS, MOST_AXES = 4, 1024
# Local lights: the share that is left of them after merging; of what is solved at once, copies of one channel; of
# blocks of what highlights see of it, the largest temporary array, of which each thread has a few.
TYPICAL_MERGED_SHARE, LEAST_MERGED_SHARE, COPIES_OF_SOLVED, COPIES_OF_BLOCK = 0.5, 0.2, 6, 3
# How much more the forecast of memory may say than what is taken.
MOST_OVERRATED = 2.0
# Smaller clusters cost more in bases, and in constants at each light change, than their points save.
RECEIVERS_PER_CLUSTER = 24
# Of matrices (highlights): receivers for each one in a basis, so that what is stored shrinks to half at most, and bytes
# of an object's bases.
RECEIVERS_PER_MATRIX, MOST_BASES = 2, 1 << 26
# The part of a hemisphere that shows surfaces, before anything is traced: between an open statue and a room.
TYPICAL_HIT_SHARE = 0.5


@dataclass(frozen=True)
class Plan:
    """needs: what the scene needs; surfaces: what its materials get; receivers: baked; seconds: expected for each stage
    that will run; rays: expected for each; peak_bytes, stored_bytes: expected; disk_bytes: of finished stages and of
    local lights' responses, while baking."""

    needs: Needs
    surfaces: SurfacePlan
    receivers: int
    seconds: dict[str, float]
    rays: dict[str, int]
    peak_bytes: int
    least_bytes: int
    stored_bytes: int
    disk_bytes: int


def make_plan(scene: SceneMesh, settings: BakeSettings, light: ReferenceLight | None) -> Plan:
    """The plan of a bake, from counts alone."""
    loose = scene.loose
    receivers = sum(int((~loose[o.points]).sum()) for o in scene.objects if o.is_target)
    basis = distant_basis(settings, settings.order)
    shadow, gather = receivers * basis.rays(settings.directions), receivers * settings.gather_directions // 2
    surfaces = plan_surfaces(scene, settings)
    needs = decide(scene, settings.order, settings.bounces, (shadow, gather),
                   light.highest_order(settings.order) if light is not None and not basis.cubemap else None,
                   settings.fit_order_to_light, surfaces.coloured)
    needs.left_out += surfaces.left_out
    needs.hints += surfaces.hints
    needs.hints += sampling_hints(settings)
    columns = distant_basis(settings, needs.order).columns
    if basis.cubemap and needs.shadow_rays and settings.sampling == "automatic":
        rays_each = basis.samples(settings.directions) ** 2
        note_sparse(needs, sparse_left_out(receivers, columns, TYPICAL_SECONDS * rays_each))
    values = receivers * columns * needs.channels
    glossy, translucent = int(surfaces.glossy_points(scene).sum()), int(surfaces.translucent_points(scene).sum())
    seconds, rays = {"prepare": 0.2 + 1e-6 * len(scene.triangles)}, {}
    if needs.bounces:
        rays["gather"] = gather
        seconds["gather"] = gather / GATHER_RAYS_PER_SECOND
    rays["direct"] = int(shadow * forecast_share(settings, glossy > 0)) if needs.shadow_rays else 0
    seconds["direct"] = rays["direct"] / SHADOW_RAYS_PER_SECOND + 1e-8 * values
    seconds["direct"] += forecast_seconds(settings, receivers, columns, glossy > 0)
    if needs.bounces:
        seconds["interreflection"] = values * settings.gather_directions * 0.02 * SECONDS_PER_BOUNCED_VALUE + 0.05
    if glossy and settings.distant_light:
        rows = len(surfaces.functions) * columns * needs.channels * glossy
        seconds["glossy"] = 0.1 + rows * SECONDS_PER_GLOSSY_VALUE
        values += rows
    wide = 0
    if settings.local_light:
        local = receivers * _local_solutions(settings)
        rays["local"] = _local_rays(scene, settings, receivers) if needs.bounces else 0
        seconds["local"] = 0.2 + rays["local"] / SHADOW_RAYS_PER_SECOND + local * SECONDS_PER_LOCAL_VALUE
        wide = receivers * _local_columns(settings) * needs.channels
        if glossy and needs.bounces:  # solved once more, and seen by each of them
            wide += glossy * len(surfaces.functions) * _local_columns(settings) * needs.channels
            seconds["local"] = 2.0 * seconds["local"] + wide * SECONDS_PER_LOCAL_ROW
    if translucent:
        seconds["subsurface"] = 0.2 + translucent * columns * needs.channels * SECONDS_PER_SUBSURFACE_VALUE
    per_value = SECONDS_PER_PROJECTED_VALUE if settings.encoder == EIGENTRANSPORT else SECONDS_PER_ENCODED_VALUE
    seconds["encode"] = (0.2 + values * max(1, settings.vectors) * per_value
                         + wide * SECONDS_PER_WIDE_VALUE)
    if settings.error_receivers:
        # Diffuse light and highlights are measured apart, each with paths of about two rays.
        rays["errors"] = (4 if glossy else 2) * settings.error_receivers * settings.error_paths
        seconds["errors"] = 0.1 + rays["errors"] / PATH_RAYS_PER_SECOND
    peak, disk = _memory(scene, settings, needs, surfaces, receivers)
    least = int(_memory(scene, settings, needs, surfaces, receivers, LEAST_MERGED_SHARE)[0] / MOST_OVERRATED)
    stored = _stored(scene, settings, needs, surfaces)
    return Plan(needs, surfaces, receivers, seconds, rays, peak, least, stored, disk)


def _local_solutions(settings: BakeSettings) -> int:
    """Fields of local light that the operator carries at most."""
    if settings.lamp_basis == "surfaces":
        return settings.surface_patches
    return settings.cloud_lights * max(1, settings.cloud_emission) ** 2


def _local_rays(scene: SceneMesh, settings: BakeSettings, receivers: int) -> int:
    """Shadow rays to the lights of a cloud, or to the lamps that lit surfaces are learnt from."""
    if settings.lamp_basis == "surfaces":
        lamps = settings.cloud_lights * (1.0 + NEAR_SURFACES + OUTSIDE)
        return int(lamps * min(MOST_ELEMENTS, len(scene.triangles)))
    return receivers * settings.cloud_lights


def _local_columns(settings: BakeSettings, share: float = TYPICAL_MERGED_SHARE) -> int:
    """Columns of local lights, if a share of them is left after merging; all functions of a spot's emission count."""
    if not settings.local_light:
        return 0
    if settings.lamp_basis == "surfaces":
        return settings.surface_columns
    kept = 1.0 if settings.merge_response == 0.0 or settings.merge_distance == 0.0 else share
    return math.ceil(kept * settings.cloud_lights) * max(1, settings.cloud_emission) ** 2


def _shapes(scene: SceneMesh, settings: BakeSettings, needs: Needs, surfaces: SurfacePlan,
            share: float = TYPICAL_MERGED_SHARE) -> list[tuple[int, tuple[int, int, int]]]:
    """Of each target, its receivers and the shape of their matrices (rows, columns, channels). share: of lights that
    is left after merging."""
    distant = distant_basis(settings, needs.order).columns if settings.distant_light else 0
    columns = distant + _local_columns(settings, share)
    return [(int((~scene.loose[o.points]).sum()),
             (1 + len(surfaces.functions_of_object(scene, o)), columns, needs.channels))
            for o in scene.objects if o.is_target]


def _stored(scene: SceneMesh, settings: BakeSettings, needs: Needs, surfaces: SurfacePlan) -> int:
    """Bytes in the .blend file: cluster, weights and colour of each receiver, links, and the bases."""
    per_receiver = 4 * (1 + 4 * -(-settings.vectors // 4) + 4)
    if settings.live_editing:
        per_receiver += BYTES_PER_ENTRY * settings.live_entries
    return links_bytes(scene, settings) + sum(
        count * per_receiver + 4 * most_clusters(settings, count, shape) * (settings.vectors + 1) * math.prod(shape)
        for count, shape in _shapes(scene, settings, needs, surfaces))


def _memory(scene: SceneMesh, settings: BakeSettings, needs: Needs, surfaces: SurfacePlan, receivers: int,
            share: float = 1.0) -> tuple[int, int]:
    """Bytes at the peak of the largest stage, and on disk at the end of the last one. share: of lights that is left
    after merging, which nobody knows before."""
    glossy = int(surfaces.glossy_points(scene).sum())
    hits_each = settings.gather_directions / 2 * TYPICAL_HIT_SHARE if needs.bounces else 0.0
    operator, kept = receivers * hits_each * BYTES_PER_RAY_HIT, glossy * hits_each * BYTES_PER_KEPT_HIT
    basis = distant_basis(settings, needs.order)
    transfer = whole = solved = 4 * receivers * basis.columns * needs.channels
    if basis.cubemap:  # solved in blocks, and on disk beyond the budget
        solved = transfer * min(1.0, COLUMNS_AT_ONCE / basis.columns)
        transfer = min(transfer, array_budget(settings) or transfer)
        solved += transfer / COPIES_OF_SERIES
    rows = on_disk = 4 * glossy * len(surfaces.functions) * basis.columns * needs.channels
    visibility = 4 * glossy * ((INCIDENT_ORDER + needs.order - 1) ** 2 + INCIDENT_ORDER ** 2)
    if basis.cubemap:  # a byte for each direction, and rows on disk beyond the budget
        visibility = glossy * (2 * basis.rays(settings.directions) + 4 * INCIDENT_ORDER ** 2)
        rows = min(rows, array_budget(settings) or rows)
    known = operator + kept + visibility
    # A series of bounces is slow only where surfaces send back more than its ratio.
    slow = float(surfaces.bounce_albedo(scene).max(initial=0.0)) > SLOW_RATIO
    copies, second = (COPIES_OF_KRYLOV, 1.5 * operator) if slow else (COPIES_OF_SERIES, 0.5 * operator)
    if not settings.distant_light:
        rows = on_disk = 0
    local = _local_memory(settings, needs, receivers, glossy, len(surfaces.functions), share)
    shapes = _shapes(scene, settings, needs, surfaces, share)
    stages = [known + transfer + dense_bytes(settings, receivers, basis.columns),
              known + min(receivers, BLOCK) * hits_each * BYTES_PER_SORTED_HIT,
              known + second + copies * solved,
              known + transfer + 2 * rows,  # twice: light between glossy surfaces goes once more
              known + transfer + rows + local.kept + max(local.zone, second + local.solving),
              _encoding(settings, shapes, rows + local.kept, transfer)]
    disk = operator + kept + visibility + 2 * whole + 2 * on_disk + local.kept + local.responses
    loose = LOOSE_LOCAL if settings.local_light else 1.0
    return int(PROCESS_BYTES + BYTES_PER_TRIANGLE * len(scene.triangles) + loose * max(stages)), int(disk)


@dataclass(frozen=True)
class _LocalMemory:
    """Bytes of local lights: kept, of their transfer and highlights; responses, on disk; zone, while one of them merges
    its lights; solving, while some lights are solved and seen by highlights."""

    kept: float = 0.0
    responses: float = 0.0
    zone: float = 0.0
    solving: float = 0.0


def _local_memory(settings: BakeSettings, needs: Needs, receivers: int, glossy: int, functions: int,
                  share: float) -> _LocalMemory:
    """What local lights take. share: of them that is left after merging."""
    if not settings.local_light:
        return _LocalMemory()
    columns, channels = _local_columns(settings, share), needs.channels
    if not needs.bounces:
        return _LocalMemory(4 * receivers)
    kept = 4 * receivers * columns * channels + 4 * glossy * functions * columns * channels
    responses = 4 * receivers * _local_solutions(settings) * channels
    in_zone = min(1.0, (settings.zone_receivers or receivers) / max(1, receivers))
    at_once = min(COLUMNS, columns)
    solving = 4 * receivers * at_once * (channels + COPIES_OF_SOLVED)
    if glossy:
        seen = min(NUMBERS, glossy * INCIDENT_ORDER ** 2 * at_once * channels)
        threads = settings.threads or os.cpu_count() or 1
        solving += 4 * (receivers + in_zone * glossy * functions) * at_once * channels \
            + 4 * COPIES_OF_BLOCK * threads * seen
    if settings.lamp_basis == "surfaces":  # the lamps' light at all receivers, and once more of equal weight
        learnt = 8 * receivers * channels * 2 * settings.cloud_lights * (1.0 + NEAR_SURFACES + OUTSIDE)
        return _LocalMemory(kept, responses, learnt, solving + 0.5 * learnt)
    return _LocalMemory(kept, responses, 2 * responses * in_zone, solving)


def _encoding(settings: BakeSettings, shapes: list[tuple[int, tuple[int, int, int]]], rows: int,
              transfer: int) -> float:
    """Bytes while signals are made and encoded, object by object."""
    signals = sum(4 * count * math.prod(shape) for count, shape in shapes)
    if settings.distant_light and settings.distant_basis == "cubemap":
        signals = min(signals, transfer)
    largest = 0.0
    for count, shape in shapes:
        values = math.prod(shape)
        bases = most_clusters(settings, count, shape) * (settings.vectors + 1) * values * BYTES_PER_BASE_VALUE
        held = min(4 * count * values, signals)
        turned = 4 * count * min(values, MOST_AXES) + axes_bytes(count, values) \
            + 4 * COPIES_OF_ROWS * min(count, rows_at_once(values)) * values
        largest = max(largest, held + turned + bases)
    return transfer + signals + max(rows, largest)


def most_clusters(settings: BakeSettings, receivers: int, shape: tuple[int, int, int]) -> int:
    """Clusters that an object of so many receivers may have; shape: of its matrices, (rows, columns, channels)."""
    if settings.encoder == EIGENTRANSPORT:
        return 1
    most = -(-receivers // RECEIVERS_PER_CLUSTER)
    # There the bases are nearly all that is stored.
    if shape[0] > 1 or (settings.distant_light and settings.distant_basis == "cubemap"):
        matrices = min(receivers // RECEIVERS_PER_MATRIX, MOST_BASES // (4 * shape[0] * shape[1] * shape[2]))
        most = min(most, matrices // (settings.vectors + 1))
    return max(1, min(settings.clusters, most))
