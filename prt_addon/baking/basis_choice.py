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

# What takes more than this many times as long as harmonics of the preset's order is only baked where it is chosen by
# hand: texels in the rows of highlights take minutes to hours, and gigabytes of disk.
MOST_TIMES = 10.0
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
        return {"name": self.name, "distant_basis": settings.distant_basis, **size, "encoder": settings.encoder,
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
    tracer = Tracer.of_scene(scene, settings.threads if threads is None else threads)
    if light is None or light.is_black:
        light = stand_in_light()
    probe = probe_light(scene, tracer, light, not is_lone_convex(scene), settings.seed)
    surfaces = plan_surfaces(scene, settings)
    diffuse = not (surfaces.glossy_points(scene) | surfaces.translucent_points(scene)).any()
    found = [_costed(scene, candidate, light) for candidate in _candidates(settings, clustered, probe, diffuse)]
    limit = _most_seconds(found, settings)
    chosen = _best([candidate for candidate in found if candidate.seconds <= limit], settings.light_error)
    facts = {"asked": {"distant_basis": settings.distant_basis, "encoder": settings.encoder,
                       "light_error": settings.light_error},
             "chosen": chosen.entry(), "candidates": [candidate.entry() for candidate in found],
             "light": light.description, "most_seconds": limit if math.isfinite(limit) else None,
             "probe": {"receivers": probe.receivers, "rays": probe.rays, "seconds": time.perf_counter() - started}}
    line = _line(chosen, found, settings.light_error)
    return chosen.settings, BasisChoice(line, {"line": line, **facts})


def basis_advice(scene: SceneMesh, settings: BakeSettings, light: ReferenceLight | None, threads: int | None = None,
                 ) -> str:
    """What an automatic choice would take where the one made by hand loses more of the present light than is asked; ""
    where it does not, or where there is nothing to say. Arguments as for `choose_basis`."""
    by_hand = not (AUTO in (settings.distant_basis, settings.encoder) or settings.fit_order_to_light)
    if not (by_hand and settings.distant_light) or light is None or light.is_black:
        return ""
    chosen, choice = choose_basis(scene, replace(settings, distant_basis=AUTO), light, threads)
    own, other = Candidate(settings, 0.0, 0.0), Candidate(chosen, 0.0, 0.0)
    lost = {entry["name"]: entry["predicted_error"] for entry in choice.facts["candidates"]} if choice else {}
    if own.name == other.name or lost.get(own.name, 0.0) <= settings.light_error:
        return ""
    return f"about {percent(lost[own.name])} of this light's shadows lost with {own.name}; Sky By: Automatic would " \
           f"take {other.name}, with {percent(lost[other.name])}"


def _clusters(settings: BakeSettings) -> str:
    """How clusters are found for the asked error of the compression."""
    if settings.compression_error >= COARSE:
        return "static"
    return "adaptive" if 0.0 < settings.compression_error <= FINE else "iterative"


def _candidates(settings: BakeSettings, clustered: BakeSettings, probe: LightProbe, diffuse: bool,
                ) -> Iterable[Candidate]:
    """All that the settings leave to choose from. diffuse: whether the scene has nothing else."""
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
        elif settings.encoder == AUTO and diffuse and not settings.local_light:  # rows and lamps have clusters
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


def _most_seconds(found: list[Candidate], settings: BakeSettings) -> float:
    """How long a choice may take."""
    orders = [candidate for candidate in found if candidate.settings.distant_basis == "sh"]
    if not orders:
        return math.inf
    return MOST_TIMES * min(orders, key=lambda candidate: abs(candidate.settings.order - settings.order)).seconds


def _cost(candidate: Candidate) -> float:
    return candidate.stored_bytes * candidate.seconds


def _best(found: list[Candidate], asked: float) -> Candidate:
    """The cheapest that keeps the asked error, else the cheapest near the least error."""
    limit = max(asked, NEAR_LEAST * min(candidate.error for candidate in found)) \
        if all(candidate.error > asked for candidate in found) else asked
    return min((candidate for candidate in found if candidate.error <= limit), key=_cost)


def _line(chosen: Candidate, found: list[Candidate], asked: float) -> str:
    """The choice and its reason: what the other kind of basis would lose, or what it would cost to keep the error."""
    text = f"Sky by {chosen.name}: about {percent(chosen.error)} of the light's shadows lost, "
    text += f"{percent(asked)} asked" if chosen.error <= asked else f"more than the {percent(asked)} asked"
    if chosen.error > asked:
        dearer = [candidate for candidate in found if candidate.error < chosen.error and candidate != chosen]
        keeping = [candidate for candidate in dearer if candidate.error <= asked]
        if dearer:
            other = min(keeping, key=_cost) if keeping else min(dearer, key=lambda candidate: candidate.error)
            text += f"; {other.name} would lose {percent(other.error)} and take {other.seconds / chosen.seconds:.2g}" \
                    " times as long"
        return text
    orders = [candidate.error for candidate in found if candidate.settings.distant_basis == "sh"]
    if chosen.settings.distant_basis == "cubemap" and orders and min(orders) > asked:
        text += f"; spherical harmonics of order {HIGHEST_ORDER} would lose {percent(orders[-1])}"
    return text
