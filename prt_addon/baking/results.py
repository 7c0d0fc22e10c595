# SPDX-License-Identifier: GPL-3.0-or-later
"""What a bake leaves: the container of each object, and the report with its checks."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..basis.hemisphere import Indices, hemisphere_basis
from ..compression.coherence import Coherence, overdraw
from ..compression.encoding import Encoding
from ..lighting.lit_surfaces import LitSurfaces, LocalBasis
from ..lighting.reference_light import ReferenceLight
from ..lighting.windowing import remove_ringing
from ..reporting.headline import PARTS, headline, object_errors
from ..reporting.stages import StageTimer
from ..reporting.wording import plural
from ..scene.needs import LeftOut
from ..scene.scene_mesh import SceneMesh, SceneObject
from ..scene.texel_surface import TexelSurface
from ..storage.columns import columns_entry, surfaces_entry
from ..storage.container import CONSTANT_ROWS, BakedTransfer, hemisphere_rows, make_header
from ..storage.digests import digest_json
from ..storage.texels import ENTRY as ATLAS_ENTRY
from ..storage.texels import atlas_entry
from ..transport.gather import Gather
from ..transport.interreflection import LARGEST_ALBEDO, Interreflection
from .distant_basis import DistantBasis, distant_basis
from .plan import Plan, most_clusters
from .settings import EIGENTRANSPORT, BakeSettings
from .surfaces import SurfacePlan, WhiteWorld
from .translucency import BodyLight

REPORT_SCHEMA = 1
# A white unit environment can light a surface to 1 at most. Sky and surfaces of a receiver fill its hemisphere exactly
# (transport/energy_balance.py), whatever the numbers of directions; what is left above 1 is light that is seen twice at
# interpolated corners and horizons. Measured at most 1.0002 at draft and standard, albedo 0.8 and 0.99, where 128
# gather_directions without that balance gave 1.058.
ENERGY_LIMIT, LOOSE_ENERGY_LIMIT = 1.005, 1.1
# Few functions of the view overshoot a highlight's edge by up to a seventh; what they undershoot is bounded at black.
DARKEST_VIEW, BRIGHTEST_VIEW = 0.01, 1.15
# Receivers whose transfer is looked at in one go.
KEYS_AT_ONCE = 4096
# An object most of whose receivers see no sky and no surface that does is probably wound inwards.
DARK_LIMIT = 0.5
# The dipole is a half-space's: a body that loses more of its light by its sides looks like another material.
LOST_LIMIT = 0.25


def object_container(scene: SceneMesh, target: SceneObject, encoding: Encoding, shape: tuple[int, int, int],
                     functions: Indices, settings: BakeSettings, report: dict[str, Any], geometry_digest: str,
                     basis: DistantBasis, local: LocalColumns | None = None,
                     error: NDArray[np.float32] | None = None) -> BakedTransfer:
    """The container of one target. shape: (rows, columns, channels); functions: of rows 1, 2, ...; basis: of distant
    light; local: what is to be known of columns of local lights; error: (p,) of the points that are not loose. Loose
    points join cluster 0 with no weights."""
    bases = encoding.bases.reshape(*encoding.bases.shape[:2], *shape)
    count, solid = target.points.stop - target.points.start, ~scene.loose[target.points]
    cluster = np.zeros(count, np.int32)
    weights = np.zeros((count, encoding.weights.shape[1]), np.float32)
    cluster[solid], weights[solid] = encoding.cluster, encoding.weights
    point_error = None if error is None else np.zeros(count, np.float32)
    if point_error is not None:
        point_error[solid] = error
    if local is None:
        columns = columns_entry(basis.entry())
    else:
        columns = local.entry(basis if settings.distant_light else DistantBasis(0))
        bases[:, :, :, shape[1] - local.cloud.columns:] /= np.float32(local.scale)
    texels = _texels_of(scene, target)
    header = make_header(
        bases.shape,
        columns,
        hemisphere_rows(functions) if len(functions) else CONSTANT_ROWS,
        object=target.name,
        vectors_per_cluster=[int(v) for v in encoding.vectors_per_cluster],
        digests={"geometry": geometry_digest, "settings": digest_json(settings.as_dict())},
        source={"object": target.name, "points": target.source_points, "on_source_mesh": target.matches_source},
        matrix=[float(v) for v in np.asarray(target.matrix).ravel()],
        settings=settings.as_dict(),
        errors={name: entry["relative_rms"] for name, entry in report["errors"].items()},
        highlight_errors={name: entry["relative_rms"] for name, entry in report["highlight_errors"].items()},
        local_errors={name: entry["relative_rms"] for name, entry in (report.get("local_errors") or {}).items()},
        local_highlight_errors={name: entry["relative_rms"]
                                for name, entry in (report.get("local_highlight_errors") or {}).items()},
        own_errors={part: errors[target.name] for part in PARTS
                    if target.name in (errors := object_errors(report, part))},
        coherence=report["clusters"]["objects"][target.name].get("coherence"),
        seconds=report["seconds"],
        **({} if texels is None else {ATLAS_ENTRY: atlas_entry(texels)}),
    )
    points = target.points
    triangles = (scene.triangles[target.triangles] - points.start).astype(np.int32)
    return BakedTransfer(header, cluster, weights, np.ascontiguousarray(bases, np.float32),
                         np.ascontiguousarray(scene.albedo[points], np.float32),
                         scene.points[points].astype(np.float32), scene.normals[points].astype(np.float32), triangles,
                         scene.tangents[points].astype(np.float32) if len(functions) else None,
                         None if local is None else local.cloud,
                         source=None if scene.source is None else scene.source[target.triangles], error=point_error,
                         texels=texels)


def _texels_of(scene: SceneMesh, target: SceneObject) -> TexelSurface | None:
    """The surface under a target's texels; None where its points are vertices."""
    return dict(zip((o.name for o in scene.objects), scene.surfaces, strict=False)).get(target.name)


@dataclass(frozen=True)
class LocalColumns:
    """cloud: whose lights, or what surfaces, the last columns belong to; cluster_zone: (clusters,) int32; scale: factor
    that these columns were encoded with."""

    cloud: LocalBasis
    cluster_zone: NDArray[np.int32]
    scale: float

    def entry(self, distant: DistantBasis) -> dict[str, Any]:
        """`columns` of a header, those of distant light first."""
        cloud = self.cloud
        basis = distant.entry(cloud.columns)
        if isinstance(cloud, LitSurfaces):
            return surfaces_entry(basis, len(cloud.corners), cloud.axes.shape[1], len(self.cluster_zone))
        return columns_entry(basis, cloud.emission_order, float(cloud.spacing), float(cloud.radius),
                             tuple(np.diff(cloud.zone_starts)), tuple(self.cluster_zone))


def _check(check: str, value: float, limit: float, good: str, bad: str) -> dict[str, Any]:
    """One line of the stability table: the value may be at most the limit."""
    return {"check": check, "value": float(value), "limit": float(limit), "verdict": good if value <= limit else bad}


def stability_of(scene: SceneMesh, transfer: NDArray[np.float32], keys: NDArray[np.int64], gathered: Gather | None,
                 bounced: Interreflection | None, settings: BakeSettings, basis: DistantBasis) -> list[dict[str, Any]]:
    """Checks that hold for every physically possible bake, with what it means where they do not."""
    wrong = sum(int((~np.isfinite(transfer[keys[start:start + KEYS_AT_ONCE]])).sum())
                for start in range(0, len(keys), KEYS_AT_ONCE))
    checks = [_check("values that are not finite", float(wrong), 0.0, "ok", "broken: please report this scene")]
    white = basis.white(transfer)[keys].max(axis=1, initial=0.0)
    # Where only lamps are baked, few shadow rays check the scene, and the operator is not balanced with them.
    limit = ENERGY_LIMIT if settings.distant_light else LOOSE_ENERGY_LIMIT
    checks.append(_check("brightest receiver in a white unit environment", float(white.max(initial=0.0)), limit,
                         "ok", "more light than there is: raise directions and gather_directions"))
    for target in scene.objects:
        if target.is_target:
            mine = (keys >= target.points.start) & (keys < target.points.stop)
            dark = float(np.mean(white[mine] < 1e-3)) if mine.any() else 0.0
            checks.append(_check(f"receivers of {target.name} that no light reaches", dark, DARK_LIMIT, "ok",
                                 "in the dark, or its normals point inwards: recalculate them"))
    if gathered is not None:
        checks.append(_check("bounce rays that met receivers left out", gathered.lost_share, 0.02, "ok",
                             "bounced light is missing there: surfaces seen from behind, or many mirrors of backs"))
    if bounced is not None:
        limit = max(settings.bounce_error, 1e-12) if settings.bounces < 0 else 1.0
        checks.append(_check(f"energy left after {bounced.steps} bounce products ({bounced.method})", bounced.residual,
                             limit, "ok", "did not converge: lower the albedo of closed rooms"))
        largest = float(scene.albedo.max(initial=0.0))
        checks.append(_check("largest albedo", largest, LARGEST_ALBEDO, "ok",
                             f"limited to {LARGEST_ALBEDO}: a closed room of it would never grow dark"))
    return checks


def surface_checks(surfaces: SurfacePlan, bodies: list[BodyLight]) -> list[dict[str, Any]]:
    """Checks of highlights and of light through bodies."""
    checks = []
    if len(surfaces.functions):
        basis = hemisphere_basis(surfaces.functions)
        checks.append(_check(f"condition of the hemispherical fit ({basis.describe()})", basis.condition_kept, 1e7,
                             "ok", "rounding shows in highlights: use fewer glossy_rows"))
    for body in bodies:
        name = f"{body.material or 'material'} of {body.target}"
        where = plural(body.light.checked, "receiver", "receivers")
        checks.append(_check(f"error of the tree over {name}, at {where}", body.light.error, 0.02, "ok",
                             "light through it is inexact"))
        checks.append(_check(f"energy that thin parts of {name} had to lose", float(body.light.reduced.max()), 0.05,
                             "ok", "thinner than its mean free path: the dipole does not hold there"))
        checks.append(_check(f"light that {name} loses by its sides", body.lost, LOST_LIMIT, "ok",
                             "too dark, small against its mean free path: lower the Subsurface Scale"))
    return checks


def white_world_checks(worlds: dict[str, WhiteWorld]) -> list[dict[str, Any]]:
    """Checks of the exit radiance of objects with highlights, by name, in a white world."""
    checks = []
    for name, world in worlds.items():
        checks.append(_check(f"darkest view of {name} in a white world, below black", max(-float(world.smallest), 0.0),
                             DARKEST_VIEW, "ok", "highlights ring: use more glossy_rows"))
        checks.append(_check(f"brightest view of {name} in a white world", float(world.largest), BRIGHTEST_VIEW, "ok",
                             "highlights ring: use more glossy_rows"))
    return checks


def report_of(scene: SceneMesh, settings: BakeSettings, plan: Plan, timer: StageTimer,
              encodings: dict[str, Encoding], coherence: dict[str, Coherence], errors: dict[str, Any],
              highlight_errors: dict[str, Any], stability: list[dict[str, Any]], gathered: Gather | None,
              bounced: Interreflection | None, light: ReferenceLight | None, resumed: list[str], seconds: float,
              ) -> dict[str, Any]:
    """The report of design/contract.md, with what else a reader may want."""
    left_out = [*plan.needs.left_out, *_left_out_later(plan, settings, gathered, encodings)]
    basis = distant_basis(settings, plan.needs.order)
    windowing = None if basis.cubemap else _windowing(light, plan.needs.order, left_out)
    stages = timer.stages
    rays = sum(int(stage["rays"]) for stage in stages)
    measured = {"errors": errors, "highlight_errors": highlight_errors}
    return {
        "schema": REPORT_SCHEMA,
        "scene": {
            "objects": [o.name for o in scene.objects if o.is_target],
            "casters": len(scene.objects),
            "receivers": plan.receivers,
            "triangles": len(scene.triangles),
            "warnings": list(scene.warnings),
        },
        "settings": settings.as_dict(),
        "seconds": seconds,
        "peak_bytes": max((int(stage["peak_bytes"]) for stage in stages), default=0),
        "rays": rays,
        "rays_per_second": rays / max(seconds, 1e-9),
        "stages": stages,
        "left_out": [asdict(item) for item in left_out],
        "hints": list(plan.needs.hints),
        "headline": headline(measured),
        "covers": _covers(scene, plan, measured),
        **measured,
        "error_metric": "relative RMS of exit radiance over random receivers and channels, under "
                        + (light.description if light is not None else "a stand-in sky (the scene has no light)"),
        "clusters": _clusters(scene, encodings, coherence),
        "bounces": None if bounced is None else {
            "method": bounced.method, "count": bounced.bounces, "products": bounced.steps, "history": bounced.history},
        "stability": stability,
        "windowing": windowing,
        "resumed": list(resumed),
    }


def _covers(scene: SceneMesh, plan: Plan, measured: dict[str, Any]) -> list[str]:
    """What the headline's numbers speak of and what they do not, each for a person to read."""
    found, surfaces = [], plan.surfaces
    if measured["errors"]:
        found.append("Diffuse: light that leaves evenly in all directions, against that light itself; what bounces off "
                     "shiny surfaces is taken as even")
    if measured["highlight_errors"]:
        found.append("Highlights: over random points and views, against the highlights themselves; direct light and "
                     "the bounces that were asked for, between shiny surfaces too")
    if not found:
        return found
    targets = np.concatenate([scene.material[o.points][~scene.loose[o.points]] for o in scene.objects if o.is_target])
    used = [surfaces.parts[number] for number in np.unique(targets)]
    if any(part.translucent for part in used):
        found.append("Light through translucent bodies is not part of it; its own error is among the checks")
    if any(part.kernel is None and part.highlight.max() > 0.0 for part in used):
        found.append("Highlights that were left out are not part of it; what was left out says how much light they "
                     "return")
    return found


def lamps_covered(highlight_errors: dict[str, Any]) -> list[str]:
    """The same for a bake with local lights. highlight_errors: of highlights under lamps, empty if not measured."""
    found = ["Lamps: light that bounced, of a point lamp at places in the open, clear of surfaces. Its direct "
             "light is not baked but found exactly, but for the steps of soft shadows"]
    if highlight_errors:
        found.append("Highlights under lamps: what they show of surfaces that the lamp shines on; the lamp's own "
                     "highlight is measured apart from the total")
    return found


def _windowing(light: ReferenceLight | None, order: int, left_out: list[LeftOut]) -> dict[str, Any] | None:
    """What a window against ringing would do to the scene's present light; None without light.

    A bake holds for any light, so the window is the relighting's choice (off unless asked for); where the present
    light does not ring it is listed as left out.
    """
    if light is None or light.is_black:
        return None
    found = remove_ringing(light.coefficients(order))
    if not found.rings:
        left_out.append(LeftOut("a window against ringing", "the light stays positive at this order",
                                "blur of the light's detail"))
    return {"rings": found.rings, "lowest": found.lowest_before, "cost": found.cost}


def _left_out_later(plan: Plan, settings: BakeSettings, gathered: Gather | None, encodings: dict[str, Encoding],
                    ) -> list[LeftOut]:
    """What turned out not to be needed only after the first rays."""
    found = []
    if plan.needs.bounces and gathered is None:
        found.append(LeftOut("bounces", "no gather ray hit a surface", "the interreflection stage"))
    if gathered is not None and not gathered.two_sided and gathered.back_share > 0.0:
        found.append(LeftOut("light on the backs of surfaces",
                             f"backs fill {gathered.back_share:.2%} of the mean receiver's hemisphere",
                             "a second receiver at each point seen from behind"))
    if settings.encoder == EIGENTRANSPORT:
        return found  # one cluster was asked for
    for name, encoding in encodings.items():
        columns, channels = distant_basis(settings, plan.needs.order).columns, plan.needs.channels
        shape = (encoding.bases.shape[2] // (columns * channels), columns, channels)
        used, most = len(encoding.vectors_per_cluster), most_clusters(settings, len(encoding.cluster), shape)
        if encoding.adaptive_left_out:
            found.append(LeftOut(f"the adaptive pass for {name}", "its clusters' errors are even",
                                 "redistributing vectors among clusters"))
        if used < settings.clusters:
            why = (f"{plural(len(encoding.cluster), 'receiver fills', 'receivers fill')} no more" if used == most else
                   f"the compression error {encoding.relative_error ** 0.5:.1e} is reached without them")
            found.append(LeftOut(f"{settings.clusters - used} of {settings.clusters} clusters of {name}", why,
                                 f"{1 - used / settings.clusters:.0%} of bases and of work per light change"))
    return found


def _clusters(scene: SceneMesh, encodings: dict[str, Encoding], coherence: dict[str, Coherence]) -> dict[str, Any]:
    """The clusters of all objects together, and object by object; coherence: of those where it ran."""
    objects = {}
    for target in scene.objects:
        encoding = encodings.get(target.name) if target.is_target else None
        if encoding is None:
            continue
        cluster = np.zeros(target.points.stop - target.points.start, np.int32)
        cluster[~scene.loose[target.points]] = encoding.cluster
        triangles = scene.triangles[target.triangles] - target.points.start
        objects[target.name] = {
            "count": len(encoding.vectors_per_cluster),
            "vectors_mean": float(encoding.vectors_per_cluster.mean()),
            "squared_error": float(encoding.squared_error),
            "relative_error": float(encoding.relative_error),
            "overdraw": float(overdraw(triangles, cluster)),
            "receivers": len(encoding.cluster),
            "history": [[float(t), stage, float(error)] for t, stage, error in encoding.history],
        }
        if target.name in coherence:
            objects[target.name]["coherence"] = asdict(coherence[target.name])
    count = sum(o["count"] for o in objects.values())
    receivers = max(1, sum(o["receivers"] for o in objects.values()))
    return {
        "count": count,
        "vectors_mean": sum(o["count"] * o["vectors_mean"] for o in objects.values()) / max(1, count),
        "squared_error": sum(o["squared_error"] for o in objects.values()),
        "overdraw": sum(o["overdraw"] * o["receivers"] for o in objects.values()) / receivers,
        "objects": objects,
    }
