# SPDX-License-Identifier: GPL-3.0-or-later
"""What a bake will do, how long it will take and how much memory: known before the first ray."""

from __future__ import annotations

from dataclasses import dataclass

from ..compression.global_frame import CHUNK, MOST_WIDTH, WIDE
from ..lighting.reference_light import ReferenceLight
from ..scene.needs import Needs, decide
from ..scene.scene_mesh import SceneMesh
from .settings import BakeSettings
from .surfaces import INCIDENT_ORDER, SurfacePlan, plan_surfaces

# Orders of magnitude measured on two cores (benchmarks/tracing.py); used for the forecast and the progress bar only,
# which corrects itself by the time that stages really took.
SHADOW_RAYS_PER_SECOND = 3.5e6
GATHER_RAYS_PER_SECOND = 1.2e6
PATH_RAYS_PER_SECOND = 0.8e6
SECONDS_PER_BOUNCED_VALUE = 2e-8
SECONDS_PER_ENCODED_VALUE = 1.2e-8
SECONDS_PER_GLOSSY_VALUE = 1e-7
SECONDS_PER_SUBSURFACE_VALUE = 2e-6
# A hit of the gather: three entries of the operator with their columns; what a glossy receiver keeps of it; copies of
# the operator while its blocks are joined and its columns renumbered.
BYTES_PER_RAY_HIT, BYTES_PER_KEPT_HIT, GATHER_COPIES = 24, 27, 3
# Blocks of the glossy stage on all threads, bytes. Matrices of a frame's axes, copies of its coordinates, and of a
# block of the signal, that the encoder holds at once.
GLOSSY_BLOCKS, FRAME_MATRICES, COORDINATE_COPIES, BLOCK_COPIES = 6e7, 5, 2, 6
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
    that will run; rays: expected for each; peak_bytes, stored_bytes: expected."""

    needs: Needs
    surfaces: SurfacePlan
    receivers: int
    seconds: dict[str, float]
    rays: dict[str, int]
    peak_bytes: int
    stored_bytes: int


def make_plan(scene: SceneMesh, settings: BakeSettings, light: ReferenceLight | None) -> Plan:
    """The plan of a bake, from counts alone."""
    loose = scene.loose
    receivers = sum(int((~loose[o.points]).sum()) for o in scene.objects if o.is_target)
    shadow, gather = receivers * settings.directions // 2, receivers * settings.gather_directions // 2
    surfaces = plan_surfaces(scene, settings)
    needs = decide(scene, settings.order, settings.bounces, (shadow, gather),
                   light.highest_order(settings.order) if light is not None else None, settings.fit_order_to_light,
                   surfaces.coloured)
    needs.left_out += surfaces.left_out
    needs.hints += surfaces.hints
    columns = needs.order ** 2
    values = receivers * columns * needs.channels
    glossy, translucent = int(surfaces.glossy_points(scene).sum()), int(surfaces.translucent_points(scene).sum())
    seconds, rays = {"prepare": 0.2 + 1e-6 * len(scene.triangles)}, {}
    if needs.bounces:
        rays["gather"] = gather
        seconds["gather"] = gather / GATHER_RAYS_PER_SECOND
    rays["direct"] = shadow if needs.shadow_rays else 0
    seconds["direct"] = rays["direct"] / SHADOW_RAYS_PER_SECOND + 1e-8 * values
    if needs.bounces:
        seconds["interreflection"] = values * settings.gather_directions * 0.02 * SECONDS_PER_BOUNCED_VALUE + 0.05
    if glossy:
        rows = len(surfaces.functions) * columns * needs.channels * glossy
        seconds["glossy"] = 0.1 + rows * SECONDS_PER_GLOSSY_VALUE
        values += rows
    if translucent:
        seconds["subsurface"] = 0.2 + translucent * columns * needs.channels * SECONDS_PER_SUBSURFACE_VALUE
    seconds["encode"] = 0.2 + values * max(1, settings.vectors) * SECONDS_PER_ENCODED_VALUE
    if settings.error_receivers:
        # Diffuse light and highlights are measured apart, each with paths of about two rays.
        rays["errors"] = (4 if glossy else 2) * settings.error_receivers * settings.error_paths
        seconds["errors"] = 0.1 + rays["errors"] / PATH_RAYS_PER_SECOND
    stored = receivers * 4 * (1 + 4 * -(-settings.vectors // 4) + 4) + 4 * settings.clusters * (
        settings.vectors + 1) * columns * needs.channels * (1 + (len(surfaces.functions) if glossy else 0))
    peak = int(2e8 + 150 * len(scene.triangles) + max(_peaks(scene, settings, needs, surfaces).values()))
    return Plan(needs, surfaces, receivers, seconds, rays, peak, int(stored))


def _peaks(scene: SceneMesh, settings: BakeSettings, needs: Needs, surfaces: SurfacePlan) -> dict[str, float]:
    """Bytes that live at the same time in the stages that need most, beside what a process holds anyway."""
    columns, channels = needs.order ** 2, needs.channels
    targets = [(int((~scene.loose[o.points]).sum()), 1 + len(surfaces.functions_of_object(scene, o)))
               for o in scene.objects if o.is_target]
    receivers, glossy = sum(count for count, _ in targets), int(surfaces.glossy_points(scene).sum())
    transfer = 4.0 * receivers * columns * channels
    hits = TYPICAL_HIT_SHARE * settings.gather_directions / 2 if needs.bounces else 0.0
    operator = receivers * hits * BYTES_PER_RAY_HIT + glossy * hits * BYTES_PER_KEPT_HIT
    # The second round of highlights reads the first one's rows while it writes its own.
    rows = 4.0 * glossy * len(surfaces.functions) * columns * channels
    visibility = 4.0 * glossy * ((INCIDENT_ORDER + needs.order - 1) ** 2 + INCIDENT_ORDER ** 2)
    signals = 4.0 * sum(count * row for count, row in targets) * columns * channels
    encoding = max((_encoding_bytes(settings, count, (row, columns, channels)) for count, row in targets), default=0.0)
    return {
        "gather": GATHER_COPIES * operator,
        "interreflection": operator + visibility + 4 * transfer,
        "glossy": operator + visibility + 2 * transfer + (2 if needs.bounces else 1) * rows
        + GLOSSY_BLOCKS * bool(glossy),
        "signals": 2 * transfer + rows + signals,
        "encode": transfer + signals + encoding,
    }


def _encoding_bytes(settings: BakeSettings, receivers: int, shape: tuple[int, int, int]) -> float:
    """Bytes that the encoder adds to an object's signal (see `compression.global_frame`, `compression.encoding`)."""
    values = shape[0] * shape[1] * shape[2]
    width = values if values <= WIDE else min(values, receivers, MOST_WIDTH)
    frame = FRAME_MATRICES * 8.0 * values * width
    coordinates = COORDINATE_COPIES * 4.0 * receivers * width
    blocks = BLOCK_COPIES * 4.0 * min(receivers, CHUNK) * values
    bases = most_clusters(settings, receivers, shape) * (settings.vectors + 1) * (20.0 * values + 8.0 * width)
    return frame + coordinates + max(blocks, bases)


def most_clusters(settings: BakeSettings, receivers: int, shape: tuple[int, int, int]) -> int:
    """Clusters that an object of so many receivers may have; shape: of its matrices, (rows, columns, channels)."""
    most = -(-receivers // RECEIVERS_PER_CLUSTER)
    if shape[0] > 1:  # there the bases are nearly all that is stored
        matrices = min(receivers // RECEIVERS_PER_MATRIX, MOST_BASES // (4 * shape[0] * shape[1] * shape[2]))
        most = min(most, matrices // (settings.vectors + 1))
    return max(1, min(settings.clusters, most))
