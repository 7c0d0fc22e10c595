# SPDX-License-Identifier: GPL-3.0-or-later
"""The recipe of a bake: scene -> transfer -> encoding -> container and report, as one generator of progress.

Exhausting the generator is a bake, closing it a cancel. With a job folder, each finished stage is written there, and a
later run of the same job starts after the last one.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Generator, Iterator
from concurrent.futures import ThreadPoolExecutor
from concurrent.futures import TimeoutError as StillRunning
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..basis.directions import quadrature
from ..compression.coherence import Coherence, make_coherent
from ..compression.eigentransport import eigentransport
from ..compression.encoding import Encoding, encode
from ..compression.groups import encode_groups
from ..compression.point_errors import point_errors
from ..compression.settings import EncoderSettings
from ..errors import Cancelled
from ..lighting.reference_light import ReferenceLight, stand_in_light
from ..reporting.headline import headline
from ..reporting.stages import StageTimer
from ..reporting.wording import plural
from ..scene.needs import BLACK, GREY_TOLERANCE
from ..scene.scene_mesh import SceneMesh, SceneObject
from ..storage.container import BakedTransfer
from ..storage.files import intact, save_arrays, save_json
from ..tracing.tracer import Tracer
from ..transport.buried import buried_receivers, fill_buried, past_buried
from ..transport.direct import direct_transfer
from ..transport.energy_balance import balanced
from ..transport.gather import Gather, gather_operator
from ..transport.glossy import GlossySurfaces, glossy_transfer, surface_frames
from ..transport.hemisphere_visibility import HemisphereVisibility, VisibilityCoefficients
from ..transport.hit_record import HitRecord
from ..transport.incident_light import DiffuseRadiance, GlossyRadiance, IndirectLight, SumOfRadiances
from ..transport.interreflection import Interreflection, interreflect, limited_albedo
from ..transport.receiver_set import ReceiverSet
from ..transport.texel_visibility import TexelVisibility
from .basis_choice import BasisChoice, choose_basis
from .cubemap import bounced_cubemap, by_point, cubemap_signal, direct_cubemap, is_kept, without_scale
from .distant_basis import distant_basis
from .error_budget import BakedSample, choose_receivers, error_budget
from .gather_stage import GATHER_NUMBERS, numbers_of, packed_gather, unpacked_gather
from .highlight_budget import HighlightSample, highlight_budget
from .highlight_reference import TrueSurfaces
from .lamp_surfaces import with_lamp_surfaces
from .lit_highlights import LitHighlights
from .live_editing import kept_factors, with_live_editing
from .live_links import with_subsurface_links
from .local_budget import local_budget
from .local_highlight_budget import local_highlight_budget
from .local_lights import LocalTransfer, local_transfer, packed_local, unpacked_local
from .memory import memory_warning
from .plan import Plan, make_plan, most_clusters
from .results import (
    LocalColumns,
    lamps_covered,
    object_container,
    report_of,
    stability_of,
    surface_checks,
    white_world_checks,
)
from .sampling import SampledDirect, can_start_dense, dense_points, encode_from_dense, sampling_checks
from .settings import EIGENTRANSPORT, BakeSettings
from .signals import GlossyRows, decoded, energy
from .sparse_choice import note_sparse
from .surfaces import CONSTANT, INCIDENT_ORDER, WhiteWorld, row_metric, white_world
from .texel_highlights import (
    columns_through_bodies,
    receiver_array,
    sent_by_surfaces,
    texel_rows,
    texel_signal,
    texel_visibility,
)
from .translucency import BodyLight, light_through_bodies, packed_bodies, unpacked_bodies

POLL_SECONDS = 0.05
STAGES_FILE = "stages.json"  # in the job folder: the names of this bake's stages, in order
# Shadow rays of a bake for local lights alone without highlights, where distant light only checks the scene.
DIRECTIONS_OF_CHECKS = 256
# Receivers whose layers leave less of the diffuse one than this say nothing about its error.
LEAST_DIFFUSE = 0.05
# Share of glossy surfaces among what glossy receivers see from which on their light is followed by its direction.
LEAST_GLOSSY_HITS = 0.01


@dataclass(frozen=True)
class Progress:
    """stage: its name; fraction: of the whole bake, 0..1; rays: traced so far; seconds_left: None while unknown."""

    stage: str
    fraction: float
    rays: int
    seconds_left: float | None


@dataclass(frozen=True)
class BakeResult:
    """objects: the container of each target by name; report: see design/contract.md."""

    objects: dict[str, BakedTransfer]
    report: dict[str, Any]


Steps = Generator[Progress, None, Any]


def bake(scene: SceneMesh, settings: BakeSettings, job_folder: Path | None = None,
         light: ReferenceLight | None = None, digests: dict[str, str] | None = None,
         regions: NDArray[np.float64] | None = None,
         make_tracer: Callable[..., Tracer] = Tracer) -> Generator[Progress, None, BakeResult]:
    """Yield progress and return the result.

    light: the scene's light, for the error budget (None: a stand-in sky). digests: of geometry by object name, kept
    in the headers. regions: (b, 4, 4) boxes in which local lights will move, cubes [-1, 1]^3 transformed (None: the
    scene's free space). make_tracer: of points, triangles, a number of threads and the surface of texels (None:
    none). Raises PRTError for what a user can mend; leaves only whole files in job_folder.
    """
    settings, choice = choose_basis(scene, settings, light)
    settings = transport_settings(settings)
    regions = np.empty((0, 4, 4)) if regions is None else regions
    return (yield from _Bake(scene, settings, job_folder, light, digests or {}, regions, choice, make_tracer).run())


def transport_settings(settings: BakeSettings) -> BakeSettings:
    """What the stages of distant light are asked for where only local light is baked: a white sky of one coefficient
    still tells what is buried, dark, or brighter than it can be. A cubemap's columns know no order."""
    if not settings.distant_light:
        return replace(settings, order=1, subsurface=False)
    if settings.distant_basis == "cubemap":
        return replace(settings, order=1)
    return settings


@dataclass
class _Bake:
    """The state of one bake, stage by stage."""

    scene: SceneMesh
    settings: BakeSettings
    folder: Path | None
    light: ReferenceLight | None
    digests: dict[str, str]
    regions: NDArray[np.float64]
    choice: BasisChoice | None = None
    make_tracer: Callable[..., Tracer] = Tracer
    resumed: list[str] = field(default_factory=list)
    shapes: dict[str, tuple[int, int, int]] = field(default_factory=dict)
    coherence: dict[str, Coherence] = field(default_factory=dict)
    point_errors: dict[str, NDArray[np.float32]] = field(default_factory=dict)
    cluster_zone: dict[str, NDArray[np.int32]] = field(default_factory=dict)
    dense: NDArray[np.bool_] | None = None
    sampling: dict[str, Any] = field(default_factory=dict)
    buried: NDArray[np.int64] | None = None
    local: LocalTransfer | None = None
    local_scale: float = 1.0
    local_sample: tuple[NDArray[np.int64], NDArray[np.float64]] | None = None
    local_errors: dict[str, Any] = field(default_factory=dict)
    local_highlight_errors: dict[str, Any] = field(default_factory=dict)

    def run(self) -> Generator[Progress, None, BakeResult]:
        """All stages in order."""
        self.started = time.perf_counter()
        self.rays_resumed = 0
        self.tracer: Tracer | None = None
        self.plan: Plan = make_plan(self.scene, self.settings, self.light)
        self.basis = distant_basis(self.settings, self.plan.needs.order)
        self.memory_warning = memory_warning(self.plan, self.settings)
        self.timer = StageTimer(lambda: self.tracer.rays if self.tracer else 0)
        self.stage_order = list(self.plan.seconds)
        if self.folder:
            save_json(self.folder / STAGES_FILE, self.stage_order)
        with self.timer.stage("prepare"):
            yield self._progress("prepare", 0.0)
            self._prepare()
        gathered, bounced = None, None
        if self.plan.needs.bounces:
            with self.timer.stage("gather"):
                gathered = yield from self._gather()
        with self.timer.stage("direct"):
            receivers, transfer, visibility = yield from self._direct(gathered)
        if gathered is not None:
            with self.timer.stage("interreflection"):
                # The few shadow rays of a bake for lamps alone know less of what a receiver sees than its gather rays.
                if self.settings.distant_light:
                    gathered = balanced(gathered, self.basis.white(transfer[:, :, None])[:, 0] / np.sqrt(4.0 * np.pi))
                bounced = yield from self._interreflection(gathered, transfer)
        transfer = transfer[:, :, None] if bounced is None else bounced.transfer
        self.receivers = receivers
        self.kept_factors = kept_factors(gathered, self.albedo, transfer, self.basis, self.settings)
        glossy, subsurface = None, []
        if visibility is not None and self.settings.distant_light:
            with self.timer.stage("glossy"):
                glossy = yield from self._glossy(receivers, transfer, visibility, gathered)
        local = None
        if self.settings.local_light:
            with self.timer.stage("local"):
                yield self._progress("local", 0.0)
                self._find_buried(self._by_point(receivers, transfer))
                local = yield from self._local(gathered, visibility)
        # What later stages do not read is large: rays' hits, visibility, the operator.
        gathered, bounced, visibility = numbers_of(gathered), numbers_of(bounced), None
        transfer = self._by_point(receivers, transfer)
        if self.translucent.any():
            with self.timer.stage("subsurface"):
                subsurface = yield from self._subsurface(transfer)
        with self.timer.stage("encode"):
            yield self._progress("encode", 0.0)
            self._find_buried(transfer)
            signals = self._signals(transfer, glossy, subsurface)
            self._join_local(signals, local)
            self._choose_local_highlights(local, signals)
            local = None
            self._choose_highlights(glossy, signals)
            glossy = None
            self._fill_buried(signals)
            encodings = yield from self._encode(signals)
        errors: dict[str, Any] = {}
        highlights: dict[str, Any] = {}
        if self.settings.error_receivers and len(self.open_keys):
            with self.timer.stage("errors"):
                if self.settings.distant_light:
                    errors = yield from self._errors(transfer, encodings)
                    highlights = yield from self._highlight_errors(encodings)
                self.local_errors = yield from self._local_errors(encodings)
                self.local_highlight_errors = yield from self._local_highlight_errors(encodings)
        return self._result(gathered, bounced, transfer, encodings, (errors, highlights), subsurface)

    def _progress(self, stage: str, fraction: float) -> Progress:
        seconds = self.plan.seconds
        before = sum(seconds[name] for name in self.stage_order[:self.stage_order.index(stage)])
        overall = min(1.0, (before + min(max(fraction, 0.0), 1.0) * seconds[stage]) / sum(seconds.values()))
        elapsed = time.perf_counter() - self.started
        left = elapsed * (1.0 - overall) / overall if overall > 0.02 and elapsed > 0.5 else None
        return Progress(stage, overall, self.tracer.rays if self.tracer else 0, left)

    def _follow(self, stage: str, steps: Generator[float, None, Any], first: float = 0.0, last: float = 1.0) -> Steps:
        """Pass a fill's progress on, as the part of the stage from first to last, and return its result."""
        yield self._progress(stage, first)
        try:
            while True:
                yield self._progress(stage, first + (last - first) * next(steps))
        except StopIteration as end:
            return end.value
        finally:
            steps.close()

    def _follow_slow(self, stage: str, steps: Generator[float, None, Any]) -> Steps:
        """As `_follow`, for few long steps: between them the fraction creeps on by what the last two were apart.

        A thread takes one step after the other; a cancel waits for the end of the present one.
        """
        reached, width, seconds = 0.0, 0.0, np.inf
        yield self._progress(stage, 0.0)
        with ThreadPoolExecutor(1) as pool:
            try:
                while True:
                    started = time.perf_counter()
                    future = pool.submit(_next_or_end, steps)
                    while True:
                        try:
                            fraction, result = future.result(POLL_SECONDS)
                            break
                        except StillRunning:
                            share = (time.perf_counter() - started) / seconds
                            yield self._progress(stage, reached + width * share / (1.0 + share))
                    if fraction is None:
                        return result
                    seconds = time.perf_counter() - started
                    width, reached = max(fraction - reached, 0.0), max(fraction, reached)
                    yield self._progress(stage, reached)
            finally:
                pool.shutdown()
                steps.close()

    def _load(self, stage: str) -> tuple[dict[str, NDArray], dict[str, Any]] | None:
        path = self.folder / f"{stage}.npz" if self.folder else None
        if path is None or not path.exists():
            return None
        found = intact(path)
        if found is not None:
            self.resumed.append(stage)
        return found

    def _save(self, stage: str, arrays: dict[str, NDArray], header: dict[str, Any] | None = None) -> None:
        if self.folder:
            save_arrays(self.folder / f"{stage}.npz", arrays, header or {})

    def _prepare(self) -> None:
        settings = self.settings
        self.tracer = self.make_tracer(*self.scene.shape, settings.threads, self.scene.traced)
        self.gather_directions = quadrature(settings.gather_directions, 4)
        self.surfaces = self.plan.surfaces
        self.albedo = limited_albedo(self.surfaces.bounce_albedo(self.scene))
        self.glossy = self.surfaces.glossy_points(self.scene)
        directions = settings.directions
        if not settings.distant_light and not self.glossy.any():
            directions = min(directions, DIRECTIONS_OF_CHECKS)
        self.directions = quadrature(directions, self.plan.needs.order)
        self.translucent = self.surfaces.translucent_points(self.scene)
        keep = np.zeros(len(self.scene.points), bool)
        for target in self.targets:
            keep[target.points] = True
        self.keys = np.flatnonzero(keep & ~self.scene.loose)

    @property
    def targets(self) -> list[SceneObject]:
        """The objects whose transfer is stored."""
        return [o for o in self.scene.objects if o.is_target]

    def _gather(self) -> Generator[Progress, None, Gather | None]:
        """The gather operator, or None where no receiver sees a surface."""
        stored = self._load("gather")
        if stored is not None:
            gathered = unpacked_gather(self.scene, self.tracer, *stored)
        else:
            gathered = yield from self._follow("gather", gather_operator(
                self.tracer, self.scene, self.keys, *self.gather_directions, self.settings.rotation_group,
                self.settings.seed, self._wanted_hits()))
            self._save("gather", packed_gather(gathered), {n: getattr(gathered, n) for n in GATHER_NUMBERS})
        return gathered if gathered.matrix.nnz else None

    def _wanted_hits(self) -> NDArray[np.bool_] | None:
        """By key, whose hits the glossy stage needs again."""
        return np.concatenate([self.glossy, np.zeros_like(self.glossy)]) if self.glossy.any() else None

    def _direct(self, gathered: Gather | None) -> Generator[
            Progress, None, tuple[ReceiverSet, NDArray[np.float32], VisibilityCoefficients | None]]:
        """The receivers, their shadowed transfer (r, columns), and from the same rays the visibility of glossy ones."""
        order = self.plan.needs.order
        receivers = gathered.receivers if gathered else ReceiverSet.of_keys(self.scene, self.tracer, self.keys)
        stored = self._load("direct")
        if stored is not None:
            found = stored[0]
            if self.basis.cubemap:
                self._sampled(receivers, SampledDirect.unpacked(*stored))
            visibility = VisibilityCoefficients(found["rows"], found["visible"], found.get("blocked")) \
                if "rows" in found else None
            return receivers, found["transfer"], visibility
        plain = None
        front = receivers.key < len(self.scene.points)
        chosen = front & self.glossy[receivers.key % len(self.scene.points)]
        if self.basis.cubemap:
            plain = texel_visibility(chosen, self.basis, self.settings, gathered is not None)
            sampled = yield from self._follow("direct", direct_cubemap(
                self.tracer, self.scene, receivers, self.basis, self.settings, self.plan.needs.shadow_rays, self.light,
                self.folder, plain))
            transfer = self._sampled(receivers, sampled)
            return receivers, transfer, self._visibility(receivers, transfer, plain, *sampled.kept())
        if chosen.any():
            plain = HemisphereVisibility(chosen, INCIDENT_ORDER + order - 1, INCIDENT_ORDER if gathered else 0)
        transfer = yield from self._follow("direct", direct_transfer(
            self.tracer, receivers, *self.directions, order, self.settings.rotation_group, self.settings.seed,
            self.plan.needs.shadow_rays, plain))
        return receivers, transfer, self._visibility(receivers, transfer, plain)

    def _visibility(self, receivers: ReceiverSet, transfer: NDArray[np.float32],
                    plain: HemisphereVisibility | TexelVisibility | None, arrays: dict[str, NDArray] | None = None,
                    header: dict[str, Any] | None = None) -> VisibilityCoefficients | None:
        """What was collected for highlights, once the stage is kept."""
        visibility = plain.result(receivers.normals) if plain else None
        extra = {name: value for name, value in vars(visibility).items() if value is not None} if visibility else {}
        if is_kept(transfer, self.settings) or not self.basis.cubemap:
            self._save("direct", {"transfer": transfer, **extra, **(arrays or {})}, header)
        return visibility

    def _sampled(self, receivers: ReceiverSet, found: SampledDirect) -> NDArray[np.float32]:
        """Keep what the report tells of how direct light was sampled, and which points the encoder starts from."""
        self.dense, self.sampling = dense_points(self.scene, receivers, found.dense), found.facts
        note_sparse(self.plan.needs, found.left_out)
        return found.transfer

    def _glossy(self, receivers: ReceiverSet, transfer: NDArray[np.float32], visibility: VisibilityCoefficients,
                gathered: Gather | None) -> Generator[Progress, None, GlossyRows]:
        """Rows of highlights.

        transfer: (r, columns, channels) of the receivers, with all bounces.
        """
        scene = self.scene
        points = receivers.key[visibility.rows]
        # In the first round, and so from the second bounce on, glossy surfaces send to each other as much, but evenly.
        self.glossy_bounce = gathered is not None and gathered.hits is not None and \
            self._share_of_glossy_hits(gathered.hits) > LEAST_GLOSSY_HITS
        stored = self._load("glossy")
        if stored is not None:
            return GlossyRows(points, stored[0]["rows"])
        surfaces = self._glossy_surfaces(points)
        frames = surfaces.frames
        indirect = self._indirect(gathered, receivers, transfer, visibility, self.albedo, None)
        first_round = 0.3 if self.glossy_bounce else 1.0
        found = yield from self._follow("glossy", self._rows(surfaces, receivers, visibility, indirect), 0.0,
                                        first_round)
        if self.glossy_bounce:
            # Once more, with what was just found as the light that glossy surfaces send to each other.
            bounce = GlossyRadiance(gathered.hits, scene, points, frames, found, self.surfaces.functions)
            albedo = self.surfaces.diffuse_albedo(scene)
            indirect = self._indirect(gathered, receivers, transfer, visibility, albedo, bounce)
            found = yield from self._follow("glossy", self._rows(surfaces, receivers, visibility, indirect),
                                            first_round, 1.0)
        for place, number in enumerate(np.unique(scene.material[points])):
            window = self.surfaces.parts[number].window
            if window is not None:
                found[surfaces.material == place] *= window[:found.shape[2], None].astype(np.float32)
        if is_kept(found, self.settings) or not self.basis.cubemap:
            self._save("glossy", {"rows": found})
        return GlossyRows(points, found)

    def _rows(self, surfaces: GlossySurfaces, receivers: ReceiverSet, visibility: VisibilityCoefficients,
              indirect: IndirectLight | None) -> Generator[float, None, NDArray[np.float32]]:
        """Fill the rows of highlights, in the columns of distant light."""
        if self.basis.cubemap:
            return texel_rows(self.tracer, surfaces, visibility, receivers, self.basis, self.settings, indirect,
                              self.folder)
        return glossy_transfer(self.tracer, surfaces, self.plan.needs.order, visibility.visible, indirect)

    def _glossy_surfaces(self, points: NDArray[np.int64]) -> GlossySurfaces:
        """What reflects at these points."""
        scene = self.scene
        used = np.unique(scene.material[points])
        kernels = tuple(self.surfaces.parts[number].kernel for number in used)
        width = max(kernel.shape[2] for kernel in kernels)
        kernels = tuple(np.broadcast_to(kernel, (*kernel.shape[:2], width)) for kernel in kernels)
        return GlossySurfaces(surface_frames(scene.normals[points], scene.tangents[points]),
                              np.searchsorted(used, scene.material[points]), kernels, self.surfaces.functions)

    def _indirect(self, gathered: Gather | None, receivers: ReceiverSet, transfer: NDArray[np.float32],
                  visibility: VisibilityCoefficients, albedo: NDArray[np.float32], bounce: GlossyRadiance | None,
                  ) -> IndirectLight | None:
        """What glossy receivers get from surfaces: diffuse light of an albedo (p, 3) and a glossy bounce."""
        if gathered is None or gathered.hits is None:
            return None
        channels = transfer.shape[2] if bounce is None else self.plan.needs.channels
        albedo = albedo[receivers.key % len(self.scene.points)][:, None, :channels]
        sent = sent_by_surfaces(albedo, transfer, self.settings, self.folder) if self.basis.cubemap \
            else albedo * transfer
        source = DiffuseRadiance(gathered.hits, self.scene, receivers, sent)
        return IndirectLight(gathered.hits, source if bounce is None else SumOfRadiances((source, bounce)),
                             visibility.rows, visibility.blocked)

    def _share_of_glossy_hits(self, hits: HitRecord) -> float:
        """Which part of what glossy receivers see of surfaces is glossy itself."""
        glossy = self.glossy[self.scene.triangles[hits.triangle]].any(axis=1) & hits.front
        return float(np.mean(glossy)) if len(glossy) else 0.0

    def _subsurface(self, transfer: NDArray[np.float32]) -> Generator[Progress, None, list[BodyLight]]:
        """Light that travels through each object's translucent materials. transfer: (p, columns, channels)."""
        stored = self._load("subsurface")
        if stored is not None:
            return unpacked_bodies(*stored)
        bodies = yield from self._follow("subsurface", light_through_bodies(
            self.scene, self.surfaces, self.translucent, transfer, self.tracer.threads, self.settings.seed,
            columns_through_bodies(int(self.translucent.sum()), self.basis, self.settings)))
        if not self.basis.cubemap or all(is_kept(body.transfer, self.settings) for body in bodies):
            self._save("subsurface", *packed_bodies(bodies))
        return bodies

    def _local(self, gathered: Gather | None, visibility: VisibilityCoefficients | None,
               ) -> Generator[Progress, None, LocalTransfer]:
        """The transfer of local lights, by point."""
        stored = self._load("local")
        if stored is not None:
            return unpacked_local(*stored)
        albedo = highlights = None
        if gathered is not None:
            gathered = replace(gathered, matrix=past_buried(gathered.matrix, gathered.receivers.key, self.scene,
                                                            self.buried))
            albedo = self.albedo[gathered.receivers.key % len(self.scene.points)][:, :self.plan.needs.channels]
            if visibility is not None and len(visibility.rows) and gathered.hits is not None:
                points = gathered.receivers.key[visibility.rows]
                highlights = LitHighlights(points, visibility.rows, self._glossy_surfaces(points), visibility.blocked)
        local = yield from self._follow("local", local_transfer(
            self.tracer, self.scene, gathered, albedo, self.keys, self.regions, self.settings, self.folder,
            highlights))
        self._save("local", *packed_local(local))
        return local

    def _join_local(self, signals: dict[str, NDArray[np.float32]], local: LocalTransfer | None) -> None:
        """Put the columns of local lights behind those of distant light, or in their place where that is not baked.

        One encoding holds both. Distant light is radiance, a cloud's light 1 W/sr from metres away: numbers of very
        different size, so that a scale makes both parts weigh the same, taken out of the bases again.
        """
        self.local = local
        if local is None:
            return
        if local.probes is not None and len(self.open_keys):
            keys = choose_receivers(self.open_keys, self.settings.error_receivers, self.settings.seed)
            self.local_sample = keys, local.transfer[keys].astype(np.float64)
        columns, distant, near = 0, 0.0, 0.0
        for target in self.targets:
            before = signals[target.name]
            columns = before.shape[2] if self.settings.distant_light else 0
            shape = (*before.shape[:2], columns + local.transfer.shape[1], before.shape[3])
            joined = receiver_array(shape, self.settings, self.folder) if self.basis.cubemap \
                else np.zeros(shape, np.float32)
            joined[:, :, :columns] = before[:, :, :columns]
            self._write_local(joined[:, :, columns:], target, local)
            signals[target.name] = joined
            metric = row_metric(self.surfaces.functions_of_object(self.scene, target), self.scene.albedo[target.points])
            distant += energy(joined[:, :, :columns], metric)
            near += energy(joined[:, :, columns:], metric)
        if distant > 0.0 and near > 0.0:
            self.local_scale = np.sqrt(distant / near)
            for signal in signals.values():
                signal[:, :, columns:] *= np.float32(self.local_scale)
        self.local = replace(local, transfer=None, rows=None)

    def _write_local(self, signal: NDArray[np.float32], target: SceneObject, local: LocalTransfer) -> None:
        """A target's light of the cloud (p, rows, columns, channels), into zeros. Bodies are not translucent to it:
        their subsurface light stays in the diffuse layer (`SurfacePart.lamp_share`)."""
        share = np.array([part.lamp_share for part in self.surfaces.parts], np.float32)
        material, diffuse = self.scene.material[target.points], local.transfer[target.points]
        signal[:, 0] = diffuse * share[material, None, None]
        if local.rows is not None and signal.shape[1] == 1 + local.rows.shape[1]:
            GlossyRows(local.points, local.rows).write(signal[:, 1:], target.points)
            self._add_dimming(signal, material, diffuse, self.scene.albedo[target.points])

    def _signals(self, transfer: NDArray[np.float32], glossy: GlossyRows | None,
                 subsurface: list[BodyLight]) -> dict[str, NDArray[np.float32]]:
        """Each target's M_p (p, rows, columns, channels): the diffuse row, then those of the view direction."""
        scene, channels = self.scene, self.plan.needs.channels
        share = np.array([part.diffuse_share for part in self.surfaces.parts], np.float32)
        signals = {}
        for target in self.targets:
            rows, points = 1 + len(self.surfaces.functions_of_object(scene, target)), target.points
            bodies = [entry for entry in subsurface if entry.target == target.name]

            def write(signal: NDArray[np.float32], part: slice, first: int = points.start,
                      bodies: list[BodyLight] = bodies) -> None:
                place = slice(first + part.start, first + part.stop)
                material, diffuse = scene.material[place], transfer[place]
                signal[:, 0] = diffuse * share[material, None, None]
                if glossy is not None and signal.shape[1] == 1 + glossy.rows.shape[1]:
                    glossy.write(signal[:, 1:], place)
                    self._add_dimming(signal, material, diffuse, scene.albedo[place])
                for entry in bodies:
                    inside = (entry.points >= part.start) & (entry.points < part.stop)
                    signal[entry.points[inside] - part.start, 1] += entry.transfer[inside] / np.float32(CONSTANT)

            count = points.stop - points.start
            shape = (count, rows, transfer.shape[1], channels)
            if not self.basis.cubemap:
                signals[target.name] = np.zeros(shape, np.float32)
                write(signals[target.name], slice(0, count))
            elif rows > 1:
                signals[target.name] = texel_signal(shape, self.basis, self.settings, self.folder, write)
            else:
                signals[target.name] = cubemap_signal(transfer[points], share[scene.material[points]], channels,
                                                      self.basis, self.settings, self.folder)
        return signals

    def _add_dimming(self, signal: NDArray[np.float32], material: NDArray[np.int32], diffuse: NDArray[np.float32],
                     albedo: NDArray[np.float32]) -> None:
        """Add how the layers above dim the diffuse light over views, to rows 1, 2, ... in place.

        Its colour is the albedo's, so without channels for that it is left out (its mean over views is in row 0).
        """
        if signal.shape[3] == 1 and float(np.ptp(albedo, axis=1).max(initial=0.0)) > GREY_TOLERANCE:
            return
        colour = albedo[:, None, :signal.shape[3]]
        for number in np.unique(material):
            part = self.surfaces.parts[number]
            if part.kernel is not None and part.dimming.any():
                chosen = np.flatnonzero(material == number)
                reflected = colour[chosen] * diffuse[chosen]
                for row, factor in enumerate(part.dimming.astype(np.float32)):
                    signal[chosen, 1 + row] += factor * reflected

    def _interreflection(self, gathered: Gather, direct: NDArray[np.float32],
                         ) -> Generator[Progress, None, Interreflection]:
        stored = self._load("interreflection")
        if stored is not None:
            return Interreflection(stored[0]["transfer"], **stored[1])
        point, settings = gathered.receivers.key % len(self.scene.points), self.settings
        albedo = self.albedo[point][:, :self.plan.needs.channels]
        bounced = yield from self._follow_slow("interreflection", (
            bounced_cubemap(gathered.matrix, albedo, direct, settings, self.folder) if self.basis.cubemap else
            interreflect(gathered.matrix, albedo, direct, settings.bounce_error, settings.bounces)))
        if self.basis.cubemap and not is_kept(bounced.transfer, settings):
            return bounced
        numbers = {k: v for k, v in vars(bounced).items() if k != "transfer"}
        self._save("interreflection", {"transfer": bounced.transfer}, numbers)
        return bounced

    def _by_point(self, receivers: ReceiverSet, transfer: NDArray[np.float32]) -> NDArray[np.float32]:
        """Transfer (points, columns, channels) in the order of the scene's points, zero where there is none."""
        if self.basis.cubemap:
            return by_point(receivers.key, transfer, len(self.scene.points), self.settings, self.folder)
        result = np.zeros((len(self.scene.points), *transfer.shape[1:]), np.float32)
        front = receivers.key < len(result)
        result[receivers.key[front]] = transfer[front]
        return result

    def _find_buried(self, transfer: NDArray[np.float32]) -> None:
        """What lies inside other bodies, once. It is kept out of the error budget: nobody sees it."""
        if self.buried is not None:
            return
        receivers = self.receivers.taken(np.flatnonzero(np.isin(self.receivers.key, self.keys)))
        white = self.basis.white(transfer)[receivers.key].max(axis=1)
        self.buried = buried_receivers(self.tracer, self.scene, receivers, white)
        self.open_keys = np.setdiff1d(self.keys, self.buried, assume_unique=True)

    def _fill_buried(self, signals: dict[str, NDArray[np.float32]]) -> None:
        """Replace what lies inside other bodies."""
        self.filled, buried = 0, self.buried
        for target in self.targets:
            place = target.points
            inside = buried[(buried >= place.start) & (buried < place.stop)] - place.start
            if len(inside):
                triangles = self.scene.triangles[target.triangles] - place.start
                self.filled += fill_buried(triangles, self.scene.loose[place], inside, signals[target.name])

    def _choose_highlights(self, glossy: GlossyRows | None, signals: dict[str, NDArray[np.float32]]) -> None:
        """Keep of random glossy receivers what the error budget needs once the rest is encoded and gone."""
        self.highlights: tuple[NDArray, ...] | None = None
        if glossy is None or not self.settings.error_receivers:
            return
        keys = choose_receivers(self.open_keys[self.glossy[self.open_keys]], self.settings.error_receivers,
                                self.settings.seed)
        if len(keys):
            functions, columns = glossy.rows.shape[1:3]  # columns of lamps may follow those of distant light
            before = np.concatenate([signals[t.name][keys[(keys >= t.points.start) & (keys < t.points.stop)]
                                                     - t.points.start, 1:, :columns] for t in self.targets
                                     if signals[t.name].shape[1] == 1 + functions])
            scale = self.basis.scale()
            before = before if scale is None else before / scale[:, None]
            self.highlights = keys, glossy.at(keys), before

    def _choose_local_highlights(self, local: LocalTransfer | None, signals: dict[str, NDArray[np.float32]]) -> None:
        """The same of highlights under lamps, from the columns of the light cloud."""
        self.local_highlights: tuple[NDArray, ...] | None = None
        if local is None or local.rows is None or local.probes is None:
            return
        keys = choose_receivers(self.open_keys[self.glossy[self.open_keys]], self.settings.error_receivers,
                                self.settings.seed)
        if len(keys):
            functions, columns = local.rows.shape[1:3]
            before = np.concatenate([signals[t.name][keys[(keys >= t.points.start) & (keys < t.points.stop)]
                                                     - t.points.start, 1:, -columns:] for t in self.targets
                                     if signals[t.name].shape[1] == 1 + functions])
            self.local_highlights = keys, GlossyRows(local.points, local.rows).at(keys), before

    def _encode(self, signals: dict[str, NDArray[np.float32]]) -> Generator[Progress, None, dict[str, Encoding]]:
        """Each target's encoding; a thread encodes while this one reports, so that a bake can be cancelled."""
        encodings: dict[str, Encoding] = {}
        targets = self.targets
        for number, target in enumerate(targets):
            solid = ~self.scene.loose[target.points]
            signal = signals.pop(target.name)
            self.shapes[target.name] = signal.shape[1:]
            signal = (signal if solid.all() else signal[solid]).reshape(int(solid.sum()), -1)
            metric = row_metric(self.surfaces.functions_of_object(self.scene, target),
                                self.scene.albedo[target.points][solid])
            settings = self._encoder_settings(len(signal), self.shapes[target.name])
            state = _EncodeState()
            yield self._progress("encode", number / len(targets))
            with ThreadPoolExecutor(1) as pool:
                future = pool.submit(self._encode_one, target, signal, settings, metric, state)
                try:
                    while True:
                        try:
                            encodings[target.name] = future.result(POLL_SECONDS)
                            break
                        except StillRunning:
                            yield self._progress("encode", (number + state.fraction) / len(targets))
                finally:
                    state.cancelled = True
        return encodings

    def _encode_one(self, target: SceneObject, signal: NDArray[np.float32], settings: EncoderSettings,
                    metric: NDArray[np.float64] | None, state: _EncodeState) -> Encoding:
        """One target's encoding, made coherent where that is asked for."""
        if self.local is None and self.settings.encoder == EIGENTRANSPORT and metric is None:
            encoding = eigentransport(signal, settings.vectors, target_error=settings.target_error,
                                      seed=settings.seed, progress=state.report).encoding
        elif self.local is None and self.dense is not None and metric is None and can_start_dense(
                dense := self.dense[target.points][~self.scene.loose[target.points]], settings.method):
            positions = self.scene.points[target.points][~self.scene.loose[target.points]]
            encoding = encode_from_dense(signal, dense, positions, settings, state.report)
        elif self.local is None:
            encoding = encode(signal, settings, metric, state.report)
        else:
            zone = self.local.zone[target.points][~self.scene.loose[target.points]]
            encoding, self.cluster_zone[target.name] = encode_groups(signal, zone, settings, metric, state.report)
        if self.settings.coherence > 0.0 and self.local is None:  # it would move points out of their zones
            place = np.cumsum(~self.scene.loose[target.points]) - 1
            triangles = place[self.scene.triangles[target.triangles] - target.points.start]
            encoding, self.coherence[target.name] = make_coherent(
                encoding, triangles, signal, self.settings.coherence, metric, self.shapes[target.name][0],
                tick=lambda: state.report(state.fraction))
        self.point_errors[target.name] = point_errors(signal, encoding, metric)
        return without_scale(encoding, self.basis, self.shapes[target.name])

    def _encoder_settings(self, receivers: int, shape: tuple[int, int, int]) -> EncoderSettings:
        settings = self.settings
        target = settings.compression_error ** 2 if settings.compression_error > 0.0 else None
        clusters = most_clusters(settings, receivers, shape)
        method = "static" if settings.encoder == EIGENTRANSPORT else settings.encoder
        return EncoderSettings(clusters, settings.vectors, method, settings.seed, target_error=target,
                               threads=settings.threads,
                               vectors_limit=24 if settings.encoder == "adaptive" else None)

    def _errors(self, transfer: NDArray[np.float32], encodings: dict[str, Encoding],
                ) -> Generator[Progress, None, dict[str, Any]]:
        """The error budget of the diffuse rows. transfer: (p, columns, channels) before compression."""
        settings, channels = self.settings, self.plan.needs.channels
        share = np.array([part.diffuse_share for part in self.surfaces.parts])[self.scene.material]
        shown = share > LEAST_DIFFUSE
        shown &= ~self.glossy | (self.scene.albedo.max(axis=1) > BLACK)  # a metal's diffuse row is never drawn
        keys = choose_receivers(self.open_keys[shown[self.open_keys]], settings.error_receivers, settings.seed)
        if not len(keys):
            return {}
        shape = (1, self.basis.columns, channels)
        compressed = self._compressed(keys, encodings, slice(0, 1), shape)[:, 0] / share[keys, None, None]
        before = np.broadcast_to(transfer[keys], compressed.shape).astype(np.float64)
        sample = BakedSample(keys, before, compressed, *self._objects_of(keys))
        steps = error_budget(self.tracer, self.scene, self.albedo, sample, self.light or stand_in_light(),
                             self.basis, settings.bounces, settings.error_paths, settings.seed)
        last = 1.0 if self.highlights is None else 0.5
        return (yield from self._follow("errors", steps, 0.0, last))

    def _highlight_errors(self, encodings: dict[str, Encoding]) -> Generator[Progress, None, dict[str, Any]]:
        """The error budget of the rows of highlights."""
        if self.highlights is None:
            return {}
        settings = self.settings
        keys, rows, before = self.highlights
        rows = np.broadcast_to(rows, before.shape).astype(np.float64)  # one channel serves all three
        # Subsurface light and the dimming of the diffuse layer are in the encoded rows too, with the same error.
        compressed = rows + self._compressed(keys, encodings, slice(1, None), before.shape[1:]) - before
        surfaces = TrueSurfaces.of(self.tracer, self.scene, self.surfaces, self.albedo)
        sample = HighlightSample(keys, rows, compressed, self.surfaces.functions, *self._objects_of(keys))
        return (yield from self._follow("errors", highlight_budget(
            surfaces, sample, self.light or stand_in_light(), self.basis, settings.bounces,
            int(self.glossy_bounce), settings.error_paths, settings.seed, settings.glossy_window), 0.5, 1.0))

    def _local_errors(self, encodings: dict[str, Encoding]) -> Generator[Progress, None, dict[str, Any]]:
        """The error budget of lamps' bounced light."""
        if self.local is None or self.local_sample is None or not len(self.local.probes.positions):
            return {}
        settings, (keys, before) = self.settings, self.local_sample
        share = np.array([part.lamp_share for part in self.surfaces.parts])[self.scene.material[keys]]
        compressed = np.zeros_like(before)
        for target in self.targets:
            inside = np.flatnonzero((keys >= target.points.start) & (keys < target.points.stop))
            if len(inside):
                place = np.cumsum(~self.scene.loose[target.points]) - 1
                values = decoded(encodings[target.name], place[keys[inside] - target.points.start])
                compressed[inside] = values.reshape(len(inside), *self.shapes[target.name])[:, 0, -before.shape[1]:]
        compressed /= self.local_scale * np.maximum(share, LEAST_DIFFUSE)[:, None, None]
        return (yield from self._follow("errors", local_budget(
            self.tracer, self.scene, self.albedo, keys, self.local.cloud, self.local.zone[keys], self.local.probes,
            before, compressed, settings.bounces, settings.error_paths, settings.seed, *self._objects_of(keys))))

    def _local_highlight_errors(self, encodings: dict[str, Encoding]) -> Generator[Progress, None, dict[str, Any]]:
        """The error budget of what highlights show of lamps' bounced light."""
        if self.local_highlights is None or not len(self.local.probes.positions):
            return {}
        settings, (keys, rows, before) = self.settings, self.local_highlights
        rows = np.broadcast_to(rows, before.shape).astype(np.float64)
        columns = before.shape[2]
        decoded_rows = self._compressed(keys, encodings, slice(1, None), before.shape[1:], slice(-columns, None))
        compressed = rows + (decoded_rows - before) / self.local_scale
        surfaces = TrueSurfaces.of(self.tracer, self.scene, self.surfaces, self.albedo)
        sample = HighlightSample(keys, rows, compressed, self.surfaces.functions, *self._objects_of(keys))
        return (yield from self._follow("errors", local_highlight_budget(
            surfaces, sample, self.local.cloud, self.local.zone[keys], self.local.probes.positions, settings.bounces,
            settings.error_paths, settings.seed)))

    def _objects_of(self, keys: NDArray[np.int64]) -> tuple[NDArray[np.int64], tuple[str, ...]]:
        """The number of each receiver's target, and the targets' names."""
        numbers = np.zeros(len(keys), np.int64)
        for number, target in enumerate(self.targets):
            numbers[(keys >= target.points.start) & (keys < target.points.stop)] = number
        return numbers, tuple(target.name for target in self.targets)

    def _compressed(self, keys: NDArray[np.int64], encodings: dict[str, Encoding], rows: slice,
                    shape: tuple[int, ...], columns: slice | None = None) -> NDArray[np.float64]:
        """Some decoded rows (k, rows, columns, channels) of the receivers `keys`; shape: without k; columns: None for
        the first ones, those of distant light."""
        result = np.zeros((len(keys), *shape))
        for target in self.targets:
            inside = np.flatnonzero((keys >= target.points.start) & (keys < target.points.stop))
            if len(inside):
                place = np.cumsum(~self.scene.loose[target.points]) - 1
                values = decoded(encodings[target.name], place[keys[inside] - target.points.start])
                values = values.reshape(len(inside), *self.shapes[target.name])
                result[inside] = values[:, rows, slice(shape[1]) if columns is None else columns]
        return result

    def _result(self, gathered: Gather | None, bounced: Interreflection | None, transfer: NDArray[np.float32],
                encodings: dict[str, Encoding], errors: tuple[dict[str, Any], dict[str, Any]],
                bodies: list[BodyLight]) -> BakeResult:
        """errors: the budget of diffuse light and that of highlights."""
        stability = stability_of(self.scene, transfer, self.keys, gathered, bounced, self.settings, self.basis)
        stability += surface_checks(self.surfaces, bodies) + sampling_checks(self.sampling)
        if self.settings.distant_light:
            stability += white_world_checks(self._white_worlds(encodings))
        report = report_of(self.scene, self.settings, self.plan, self.timer, encodings, self.coherence, *errors,
                           stability, gathered, bounced, self.light, self.resumed,
                           time.perf_counter() - self.started)
        report["basis"] = self.basis.words if self.settings.distant_light else ""
        report["choice"] = None if self.choice is None else self.choice.facts
        report["tracer"] = self.tracer.facts
        if self.local is not None:
            report["local"] = self.local.facts
            report["local_errors"] = self.local_errors
            report["local_highlight_errors"] = self.local_highlight_errors
            if not self.settings.distant_light:
                report["errors"], report["local_errors"] = self.local_errors, {}
            report["headline"] = headline(report)
            if self.local_errors:
                report["covers"] += lamps_covered(self.local_highlight_errors)
            report["scene"]["warnings"] += self.local.facts["warnings"]
        report["sampling"] = self.sampling
        if self.memory_warning:
            report["scene"]["warnings"].append(f"Bake: {self.memory_warning}")
        if self.filled:
            note = (f"{plural(self.filled, 'receiver', 'receivers')} inside other objects"
                    f" {'takes its' if self.filled == 1 else 'take their'} neighbours' light")
            report["scene"]["warnings"].append(note)
        objects = {
            target.name: object_container(self.scene, target, encodings[target.name], self.shapes[target.name],
                                          self.surfaces.functions_of_object(self.scene, target), self.settings, report,
                                          self.digests.get(target.name, ""), self.basis,
                                          self._local_columns(target.name),
                                          self.point_errors.get(target.name))
            for target in self.targets
        }
        if self.local is not None:
            objects = {target.name: with_lamp_surfaces(objects[target.name], self.scene, target, self.surfaces)
                       for target in self.targets}
            objects = {target.name: with_subsurface_links(objects[target.name], self.scene, target,
                                                          self.settings.subsurface_links, self.tracer.threads)
                       for target in self.targets}
        objects, told = with_live_editing(objects, self.kept_factors, self.scene, self.surfaces, self.albedo,
                                          self.buried)
        report |= told
        return BakeResult(objects, report)

    def _white_worlds(self, encodings: dict[str, Encoding]) -> dict[str, WhiteWorld]:
        """Exit radiance of each object with highlights in a white world."""
        found = {}
        for target in self.targets:
            functions = self.surfaces.functions_of_object(self.scene, target)
            if len(functions) > 1:
                solid = ~self.scene.loose[target.points]
                found[target.name] = white_world(encodings[target.name], self.shapes[target.name], functions,
                                                 self.scene.albedo[target.points][solid], self.basis.white_light())
        return found

    def _local_columns(self, name: str) -> LocalColumns | None:
        """What a container tells of its local lights."""
        if self.local is None:
            return None
        return LocalColumns(self.local.cloud, self.cluster_zone[name], self.local_scale)


def _next_or_end(steps: Generator[float, None, Any]) -> tuple[float | None, Any]:
    """The next fraction, or None and the result."""
    try:
        return next(steps), None
    except StopIteration as end:
        return None, end.value


class _EncodeState:
    """What the encoding thread and the reporting one tell each other."""

    def __init__(self) -> None:
        self.fraction = 0.0
        self.cancelled = False

    def report(self, fraction: float) -> None:
        """Keep the fraction; raise Cancelled where the bake was closed."""
        self.fraction = fraction
        if self.cancelled:
            raise Cancelled("bake", "cancelled while encoding", "Bake again to go on from the finished stages")


def exhaust(steps: Iterator[Progress]) -> BakeResult:
    """Run a bake to its end in this process (tests and scripts)."""
    while True:
        try:
            next(steps)
        except StopIteration as end:
            return end.value
