# SPDX-License-Identifier: GPL-3.0-or-later
"""What a bake will do, how long it will take and how much memory: known before the first ray."""

from __future__ import annotations

from dataclasses import dataclass

from ..lighting.reference_light import ReferenceLight
from ..scene.needs import Needs, decide
from ..scene.scene_mesh import SceneMesh
from .settings import BakeSettings
from .surfaces import SurfacePlan, plan_surfaces

# Orders of magnitude measured on two cores (benchmarks/tracing.py); used for the forecast and the progress bar only,
# which corrects itself by the time that stages really took.
SHADOW_RAYS_PER_SECOND = 3.5e6
GATHER_RAYS_PER_SECOND = 1.2e6
PATH_RAYS_PER_SECOND = 0.8e6
SECONDS_PER_BOUNCED_VALUE = 2e-8
SECONDS_PER_ENCODED_VALUE = 1.2e-8
SECONDS_PER_GLOSSY_VALUE = 1e-7
SECONDS_PER_LOCAL_VALUE = 2e-7
SECONDS_PER_SUBSURFACE_VALUE = 2e-6
BYTES_PER_RAY_HIT = 24
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
    if settings.local_light:
        local = receivers * settings.cloud_lights * max(settings.cloud_emission, 1) ** 2
        rays["local"] = receivers * settings.cloud_lights if needs.bounces else 0
        seconds["local"] = 0.2 + rays["local"] / SHADOW_RAYS_PER_SECOND + local * SECONDS_PER_LOCAL_VALUE
    if translucent:
        seconds["subsurface"] = 0.2 + translucent * columns * needs.channels * SECONDS_PER_SUBSURFACE_VALUE
    seconds["encode"] = 0.2 + values * max(1, settings.vectors) * SECONDS_PER_ENCODED_VALUE
    if settings.error_receivers:
        rays["errors"] = 2 * settings.error_receivers * settings.error_paths
        seconds["errors"] = 0.1 + rays["errors"] / PATH_RAYS_PER_SECOND
    operator = gather * TYPICAL_HIT_SHARE * BYTES_PER_RAY_HIT if needs.bounces else 0
    stored = receivers * 4 * (1 + 4 * -(-settings.vectors // 4) + 4) + 4 * settings.clusters * (
        settings.vectors + 1) * columns * needs.channels * (1 + (len(surfaces.functions) if glossy else 0))
    peak = int(2e8 + 150 * len(scene.triangles) + operator + 4 * 4 * values)
    return Plan(needs, surfaces, receivers, seconds, rays, peak, int(stored))



def most_clusters(settings: BakeSettings, receivers: int, shape: tuple[int, int, int]) -> int:
    """Clusters that an object of so many receivers may have; shape: of its matrices, (rows, columns, channels)."""
    most = -(-receivers // RECEIVERS_PER_CLUSTER)
    if shape[0] > 1:  # there the bases are nearly all that is stored
        matrices = min(receivers // RECEIVERS_PER_MATRIX, MOST_BASES // (4 * shape[0] * shape[1] * shape[2]))
        most = min(most, matrices // (settings.vectors + 1))
    return max(1, min(settings.clusters, most))
