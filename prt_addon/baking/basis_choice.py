# SPDX-License-Identifier: GPL-3.0-or-later
"""What an automatic bake holds distant light in: harmonics of an order, or a cubemap in clusters or eigentransport.

Of everything that keeps the asked error under the scene's present light, the cheapest in bytes times seconds. What a
basis loses of the light is measured at some receivers (light_probe.py); what an encoder loses is predicted from that
and three constants, fitted to encodings of three models under nine lights (docs/eigentransport.md: mostly within a
factor of 2):

* d vectors for all receivers hold somewhat more than as many harmonics would: they leave the high bands,
  so a soft light loses nothing and a sun rings;
* clusters leave a little of every band, so that even a uniform sky loses a little, and a sun less than with vectors.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ..lighting.reference_light import ReferenceLight, stand_in_light
from ..reporting.svg_plots import percent
from ..scene.needs import is_lone_convex
from ..scene.scene_mesh import SceneMesh
from ..tracing.tracer import Tracer
from .light_probe import CUBEMAPS, ORDERS, LightProbe, probe_light
from .plan import make_plan
from .settings import AUTO, EIGENTRANSPORT, HIGHEST_ORDER, BakeSettings
from .surfaces import plan_surfaces

# Whether cubemap columns hold highlights and light through bodies, too. Until they do, scenes with these get harmonics.
CUBEMAP_HOLDS_HIGHLIGHTS = False
# Orders below are not chosen, however soft the light is: they cost little and hold the irradiance of any later light.
LEAST_ORDER = 3
VECTORS = (48, 96, 192)
# Of clusters: what they lose of any light, and of what is lost of a light by the highest order that is tried, both for
# 256 clusters of 8 vectors; and the product of vectors and root of clusters that these have.
LOST_ALWAYS, LOST_OF_SHARP, TYPICAL = 0.01, 0.5, 128.0
# Of vectors for all receivers: their error as a share of that of as many harmonics.
VECTORS_TO_HARMONICS = 0.7
# Where nothing keeps the asked error, the cheapest whose error is at most this many times the least one is taken.
NEAR_LEAST = 1.25
# Error goals of the compression from which on clusters are found quickly, and up to which thoroughly: the presets'.
COARSE, FINE = 1e-2, 5e-4
METHOD_WORDS = {EIGENTRANSPORT: "with {} vectors for all receivers (eigentransport)"}


@dataclass(frozen=True)
class Candidate:
    """settings: of the bake; basis_error, encoder_error: predicted relative RMS; stored_bytes, seconds: of its plan."""

    settings: BakeSettings
    basis_error: float
    encoder_error: float
    stored_bytes: int = 0
    seconds: float = 0.0

    @property
    def error(self) -> float:
        """Both together."""
        return math.hypot(self.basis_error, self.encoder_error)

    @property
    def name(self) -> str:
        """As a person reads it."""
        settings = self.settings
        if settings.distant_basis == "sh":
            return f"spherical harmonics of order {settings.order}"
        return f"a cubemap of {settings.cubemap_size} texels " + METHOD_WORDS.get(
            settings.encoder, "in clusters").format(settings.vectors)

    def entry(self) -> dict[str, Any]:
        """For JSON."""
        settings = self.settings
        size = {"order": settings.order} if settings.distant_basis == "sh" else {"cubemap_size": settings.cubemap_size}
        return {"distant_basis": settings.distant_basis, **size, "encoder": settings.encoder,
                "vectors": settings.vectors, "predicted_error": self.error, "basis_error": self.basis_error,
                "encoder_error": self.encoder_error, "stored_bytes": self.stored_bytes, "seconds": self.seconds}


@dataclass(frozen=True)
class BasisChoice:
    """line: what was chosen and why, for a person; facts: the same and what else was tried, JSON-able."""

    line: str
    facts: dict[str, Any]


def choose_basis(scene: SceneMesh, settings: BakeSettings, light: ReferenceLight | None, threads: int | None = None,
                 ) -> tuple[BakeSettings, BasisChoice | None]:
    """Settings without AUTO, and why they are so; None where nothing was left to choose by the light.

    light: None or black for the stand-in sky. threads: of the probe, None for the settings'. The same scene, settings
    and light always give the same.
    """
    if AUTO not in (settings.distant_basis, settings.encoder):
        return settings, None
    clustered = replace(settings, encoder=_clusters(settings)) if settings.encoder == AUTO else settings
    if not settings.distant_light or settings.distant_basis == "sh":
        return replace(clustered, distant_basis="sh"), None
    started = time.perf_counter()
    tracer = Tracer(scene.points, scene.triangles, settings.threads if threads is None else threads)
    if light is None or light.is_black:
        light = stand_in_light()
    probe = probe_light(scene, tracer, light, not is_lone_convex(scene), settings.seed)
    barred = "" if CUBEMAP_HOLDS_HIGHLIGHTS else _what_needs_harmonics(scene, settings)
    found = [_costed(scene, candidate, light) for candidate in _candidates(settings, clustered, probe)]
    chosen = _best(found, settings, bool(barred))
    facts = {"asked": {"distant_basis": settings.distant_basis, "encoder": settings.encoder,
                       "light_error": settings.light_error},
             "chosen": chosen.entry(), "candidates": [candidate.entry() for candidate in found],
             "light": light.description, "needs_harmonics": barred,
             "probe": {"receivers": probe.receivers, "rays": probe.rays, "seconds": time.perf_counter() - started}}
    line = _line(chosen, found, settings, barred)
    return chosen.settings, BasisChoice(line, {"line": line, **facts})


def _clusters(settings: BakeSettings) -> str:
    """How clusters are found for the asked error of the compression."""
    if settings.compression_error >= COARSE:
        return "static"
    return "adaptive" if 0.0 < settings.compression_error <= FINE else "iterative"


def _what_needs_harmonics(scene: SceneMesh, settings: BakeSettings) -> str:
    """What of the scene a cubemap can't hold, with the first material that has it; "" for nothing."""
    if settings.distant_basis != AUTO:
        return ""  # the artist chose it all the same
    surfaces = plan_surfaces(scene, settings)
    for what, points in (("highlights", surfaces.glossy_points(scene)),
                         ("light through bodies", surfaces.translucent_points(scene))):
        if points.any():
            first = scene.materials[int(scene.material[int(np.argmax(points))])].name
            return f"{what} of {first}" if first else what
    return ""


def _candidates(settings: BakeSettings, clustered: BakeSettings, probe: LightProbe) -> Iterable[Candidate]:
    """All that the settings leave to choose from."""
    if settings.distant_basis == AUTO:
        # Eigentransport of few columns is these columns again: harmonics are always in clusters unless asked otherwise.
        for order in range(LEAST_ORDER, HIGHEST_ORDER + 1):
            yield Candidate(replace(clustered, distant_basis="sh", order=order), probe.harmonics[order - 1], 0.0)
    sizes = CUBEMAPS if settings.distant_basis == AUTO else (settings.cubemap_size,)
    for size in sizes:
        lost = probe.cubemaps[min(CUBEMAPS, key=lambda r, size=size: abs(math.log(r / size)))]
        taken = replace(clustered, distant_basis="cubemap", cubemap_size=size)
        if settings.encoder != EIGENTRANSPORT:
            yield Candidate(taken, lost, clusters_error(probe, taken.clusters, taken.vectors))
        if settings.encoder == EIGENTRANSPORT:
            yield Candidate(taken, lost, vectors_error(probe, taken.vectors))
        elif settings.encoder == AUTO and not settings.local_light:  # columns of lamps have clusters
            for vectors in VECTORS:
                yield Candidate(replace(taken, encoder=EIGENTRANSPORT, vectors=vectors), lost,
                                vectors_error(probe, vectors))


def vectors_error(probe: LightProbe, vectors: int) -> float:
    """Predicted error under the probe's light of eigentransport with so many vectors."""
    order = min(max(math.sqrt(max(vectors, 1)), 1.0), float(ORDERS))
    return VECTORS_TO_HARMONICS * float(np.interp(order, np.arange(1, ORDERS + 1), probe.harmonics))


def clusters_error(probe: LightProbe, clusters: int, vectors: int) -> float:
    """The same of clusters with so many vectors each."""
    finer = math.sqrt(TYPICAL / (max(vectors, 1) * math.sqrt(max(clusters, 1))))
    return finer * math.hypot(LOST_ALWAYS, LOST_OF_SHARP * probe.harmonics[-1])


def _costed(scene: SceneMesh, candidate: Candidate, light: ReferenceLight) -> Candidate:
    plan = make_plan(scene, candidate.settings, light)
    return replace(candidate, stored_bytes=plan.stored_bytes, seconds=sum(plan.seconds.values()))


def _best(found: list[Candidate], settings: BakeSettings, harmonics_only: bool) -> Candidate:
    """The cheapest that keeps the asked error, else the cheapest near the least error; where only harmonics will do and
    none keeps it, those of the settings' order, since highlights cost time and data with every column."""
    if harmonics_only:
        found = [candidate for candidate in found if candidate.settings.distant_basis == "sh"]
    limit, least = settings.light_error, min(candidate.error for candidate in found)
    if least > limit:
        if harmonics_only:
            return min(found, key=lambda candidate: abs(candidate.settings.order - settings.order))
        limit = NEAR_LEAST * least
    fitting = [candidate for candidate in found if candidate.error <= limit]
    return min(fitting, key=lambda candidate: candidate.stored_bytes * candidate.seconds)


def _line(chosen: Candidate, found: list[Candidate], settings: BakeSettings, barred: str) -> str:
    """The choice and its reason."""
    asked = percent(settings.light_error)
    text = f"Sky by {chosen.name}"
    if barred:
        text += f", because {barred} {'need' if barred.startswith('highlights') else 'needs'} harmonics"
    text += f": about {percent(chosen.error)} of the light's shadows lost, "
    text += f"{asked} asked" if chosen.error <= settings.light_error else f"more than the {asked} asked"
    others = [c for c in found if c.settings.distant_basis != chosen.settings.distant_basis]
    if not others:
        return text
    other = min(others, key=lambda candidate: candidate.error)
    if chosen.settings.distant_basis == "cubemap" and other.error > settings.light_error:
        return f"{text}; {other.name} would lose {percent(other.error)}"
    if chosen.settings.distant_basis == "sh" and chosen.error > settings.light_error:
        return f"{text}; {other.name} would lose {percent(other.error)}"
    return text
