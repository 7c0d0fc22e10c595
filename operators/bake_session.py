# SPDX-License-Identifier: GPL-3.0-or-later
"""One bake from a scene to stored data, around the child process: for the operator and for the command alike.

The scene is read here (only Blender's process can), baked in the child, and stored here, only when the child's result
is complete. Whatever ends a bake earlier leaves previous bakes as they are and finished stages in the job folder.
"""

from __future__ import annotations

import os
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, ClassVar

import bpy
import numpy as np
from numpy.typing import NDArray

from ..prt_addon.baking import job as jobs
from ..prt_addon.baking.basis_choice import basis_advice, choose_basis
from ..prt_addon.baking.claims import Claim, discard_if_free
from ..prt_addon.baking.distant_basis import distant_basis
from ..prt_addon.baking.local_lights import fit_to_lamps
from ..prt_addon.baking.memory import memory_warning
from ..prt_addon.baking.plan import make_plan
from ..prt_addon.baking.process import BakeProcess, CompletedBake
from ..prt_addon.baking.recipe import BakeResult, transport_settings
from ..prt_addon.baking.record import JobRecord, note_end, read_record, write_record
from ..prt_addon.baking.settings import BakeSettings
from ..prt_addon.blender.fingerprint import FOLLOWED, fingerprint, surroundings
from ..prt_addon.blender.light_region import light_regions
from ..prt_addon.blender.lights import reference_light
from ..prt_addon.blender.local_lights import read_local_lights
from ..prt_addon.blender.own_colours import drop_own_colours
from ..prt_addon.blender.read_scene import read_objects, selected_names
from ..prt_addon.blender.stored import stale, write_baked
from ..prt_addon.blender.stored_report import store_report
from ..prt_addon.blender.visibility import find_objects, render_visible_objects
from ..prt_addon.errors import BadScene, StorageError
from ..prt_addon.lighting.light_cloud import free_space
from ..prt_addon.reporting.headline import PARTS, headline
from ..prt_addon.reporting.wording import plural
from ..prt_addon.scene.scene_mesh import SceneMesh
from .place import Place
from .tracing_choice import bake_process, left_out, tracing_choice

ROOT_PACKAGE = __package__.rpartition(".")[0]
KEPT_DAYS = 14


def jobs_folder() -> Path:
    """Where job folders lie: the extension's own user folder, or Blender's for a checkout without installation.

    `write_job` makes it: Blender's `create` prints a traceback where it can't, and returns an empty path.
    """
    if ROOT_PACKAGE.startswith("bl_ext."):
        return Path(bpy.utils.extension_path_user(ROOT_PACKAGE, path="jobs"))
    return Path(bpy.utils.user_resource("DATAFILES", path="prt/jobs"))


def chosen_targets(scene: bpy.types.Scene) -> list[str] | None:
    """Names of the objects that the panel's settings choose, as `read_scene` takes them; None leaves it to the
    selection. Raises BadScene where a collection is asked for and gives none."""
    settings = scene.prt
    if settings.targets == "selected":
        return None
    collection = settings.target_collection
    if collection is None:
        raise BadScene("Bake", "no collection is chosen", "Choose one, or bake selected objects")
    visible = {name for layer in scene.view_layers for name in render_visible_objects(layer)}
    names = [o.name_full for o in collection.all_objects if o.type == "MESH" and o.name_full in visible]
    if not names:
        raise BadScene(collection.name, "no mesh in it is shown in renders", "Choose another collection, or enable one")
    return names


def read_scene(depsgraph: bpy.types.Depsgraph, settings: BakeSettings, targets: Sequence[str] | None,
               selected: Sequence[str] | None = None) -> SceneMesh:
    """The scene as it is traced, with what was left out among its warnings. targets, selected: as `read_objects` takes
    them."""
    warnings: list[str] = []
    lamps = np.array([lamp.position for lamp in read_local_lights(depsgraph, [])]).reshape(-1, 3)
    centres = light_regions(depsgraph, settings.cloud_region)[:, :3, 3] if settings.local_light else np.empty((0, 3))
    mesh = SceneMesh.assemble(read_objects(depsgraph, targets, warnings, selected), settings.spacing,
                              np.concatenate([lamps, centres]) if settings.local_light else None,
                              settings.texels, settings.live_editing)
    return replace(mesh, warnings=(*warnings, *mesh.warnings))


def analyze_scene(depsgraph: bpy.types.Depsgraph, settings: BakeSettings,
                  targets: Sequence[str] | None) -> dict[str, Any]:
    """What a bake of the scene would need, leave out and cost, as JSON-able values."""
    scene = read_scene(depsgraph, settings, targets)
    settings, lost = fit_to_lamps(settings, read_local_lights(depsgraph, []))
    light = reference_light(depsgraph)
    # In Blender's own process nothing starts threads (design/architecture.md).
    advice = basis_advice(scene, settings, light, threads=1)
    settings, choice = choose_basis(scene, settings, light, threads=1)
    settings = transport_settings(settings)
    plan = make_plan(scene, settings, light)
    basis = distant_basis(settings, plan.needs.order) if settings.distant_light else None
    try:
        too_much = memory_warning(plan, settings)
    except BadScene as error:  # an analysis tells it and goes on
        too_much = f"{error.cause}. {error.remedy}"
    return {
        "objects": [o.name for o in scene.objects if o.is_target],
        "casters": len(scene.objects),
        "receivers": plan.receivers,
        "triangles": len(scene.triangles),
        "needs": {"shadow_rays": plan.needs.shadow_rays, "bounces": plan.needs.bounces,
                  "channels": plan.needs.channels, **(basis.facts if basis else {})},
        "basis": basis.words if basis else "",
        "choice": None if choice is None else choice.facts,
        "left_out": [*(asdict(item) for item in plan.needs.left_out), *left_out(settings.threads)],
        "tracer": tracing_choice(settings.threads).why,
        "hints": [*([advice] if advice else []), *plan.needs.hints],
        "warnings": [*([f"Bake: {too_much}"] if too_much else []), *scene.warnings, *lost],
        "seconds": sum(plan.seconds.values()),
        "stages": plan.seconds,
        "rays": sum(plan.rays.values()),
        "peak_bytes": plan.peak_bytes,
        "stored_bytes": plan.stored_bytes,
        "disk_bytes": plan.disk_bytes,
    }


def analysis_lines(analysis: dict[str, Any]) -> list[str]:
    """An analysis in a few lines for the panel."""
    lines = [f"About {analysis['seconds']:.0f} s for {plural(analysis['receivers'], 'receiver', 'receivers')}, "
             f"{analysis['peak_bytes'] / 1e6:.0f} MB of memory and {analysis['disk_bytes'] / 1e6:.0f} MB of disk while "
             f"baking, {analysis['stored_bytes'] / 1e6:.1f} MB stored"]
    lines += [f"Left out: {item['what']}, because {item['why']}" for item in analysis["left_out"]]
    told = [line for line in analysis["warnings"] if line.startswith("Bake: ")]  # of memory: first, as it may end it
    rest = [line for line in analysis["warnings"] if line not in told]
    basis = [analysis["choice"]["line"]] if analysis["choice"] else [analysis["basis"]] * bool(analysis["basis"])
    return lines[:1] + told + basis + lines[1:] + analysis["hints"] + rest


@dataclass
class BakeSession:
    """A bake under way. Poll `process` until it is finished, then `store` and `discard`; at last `close`, in any case.

    digests: per target by name, and surroundings: of everything, as they were when the scene was read. identities:
    session_uid of every object by the name that it had then, so that a renamed one is found. notes: what else to tell.
    """

    claim: Claim
    process: BakeProcess | CompletedBake
    started: float
    scene: Place
    digests: dict[str, dict[str, str | None]]
    surroundings: dict[str, str]
    identities: dict[str, int]
    notes: list[str] = field(default_factory=list)
    writes_bakes: ClassVar[bool] = True

    @staticmethod
    def start(depsgraph: bpy.types.Depsgraph, settings: BakeSettings, targets: Sequence[str] | None,
              selected: Sequence[str] | None = None) -> BakeSession:
        """Read the scene and start its bake in a child process. targets: None for the selected meshes, or all;
        selected: counts in place of those selected now (`read_objects`).

        Raises PRTError.
        """
        started, asked = time.monotonic(), settings
        if selected is None:
            selected = selected_names(depsgraph.view_layer)
        scene = read_scene(depsgraph, settings, targets, selected)
        settings, lost = fit_to_lamps(settings, read_local_lights(depsgraph, []))
        scene = replace(scene, warnings=(*scene.warnings, *lost))
        names = [o.name for o in scene.objects if o.is_target]
        targets_found = find_objects(names, depsgraph.scene)
        _check_storable(targets_found)
        digests = {name: fingerprint(found, depsgraph, settings.live_editing)
                   for name, found in zip(names, targets_found, strict=True)}
        geometry = {name: digest["geometry"] or "" for name, digest in digests.items()}
        folder = jobs_folder()
        _drop_forgotten(folder)
        regions = _regions(depsgraph, settings, scene) if settings.local_light else None
        around, place = surroundings(depsgraph), Place.of(depsgraph)
        claim = jobs.claim_job(folder, scene, settings, reference_light(depsgraph), geometry, regions)
        try:
            write_record(claim.folder, JobRecord(
                bpy.data.filepath, place.scene, place.view_layer, tuple(names), _tuple(targets), tuple(selected),
                asked.as_dict(), digests, around, os.getpid(), time.time()))
            process = bake_process(claim, settings.threads)
            process.start()
        except BaseException:
            claim.release()
            raise
        return BakeSession(claim, process, started, place, digests, around, _identities(depsgraph.scene))

    @staticmethod
    def of_complete(folder: Path, record: JobRecord, depsgraph: bpy.types.Depsgraph) -> BakeSession | None:
        """An interrupted bake whose result is there, if the scene is as it was when it was read; else None."""
        found = {o.name_full: o for o in depsgraph.scene.objects}
        if not jobs.job_summary(folder)["complete"] or surroundings(depsgraph) != record.surroundings or any(
                name not in found or fingerprint(found[name], depsgraph, FOLLOWED in digest) != digest
                for name, digest in record.digests.items()):
            return None
        claim = Claim.take(folder)
        if claim is None:
            return None
        return BakeSession(claim, CompletedBake(), time.monotonic(), Place.of(depsgraph), record.digests,
                           record.surroundings, _identities(depsgraph.scene))

    @property
    def job(self) -> Path:
        """Its job folder."""
        return self.claim.folder

    def seconds(self, result: BakeResult) -> float:
        """Since the start, reading the scene included; of a bake that was complete before, what it took then."""
        if isinstance(self.process, CompletedBake):
            return float(result.report["seconds"])
        return time.monotonic() - self.started

    def store(self) -> BakeResult:
        """Put the child's complete result into the file's data. Raises PRTError.

        Call it after the "done" message. Every object is looked up before the first is written, so that nothing is
        written where all are gone; what was deleted meanwhile is told in `notes`. The job folder stays, so that nothing
        is lost if the file can't be saved.
        """
        result = jobs.read_result(self.job)
        result.report["left_out"] += left_out(int(result.report["settings"]["threads"]))
        found = self.targets()
        gone = [name for name, target in found.items() if target is None]
        if len(gone) == len(found):
            raise BadScene(", ".join(gone), "deleted while its bake ran, so nothing was stored",
                           "Undo that and bake again: the finished bake is taken up at once")
        for name, target in found.items():
            if target is not None:
                drop_own_colours(target)  # the bake may come to lie on the own mesh, whose colours are one per point
                write_baked(target, result.objects[name], self.digests[name], self.surroundings)
        store_report(self.scene.find(), result.report)
        self.notes += [f"{name} was deleted meanwhile, and its bake dropped" for name in gone]
        return replace(result, objects={name: baked for name, baked in result.objects.items() if name not in gone})

    def targets(self) -> dict[str, bpy.types.Object | None]:
        """The targets as they are in the scene now, by the names that they had. Raises BadScene without the scene."""
        present = {o.session_uid: o for o in self.scene.find().objects}
        return {name: present.get(self.identities[name]) for name in self.digests}

    def note_changes(self) -> None:
        """Have `notes` tell which of the stored bakes is stale already, because the artist went on editing."""
        depsgraph = self.scene.depsgraph()
        around = surroundings(depsgraph)
        for target in filter(None, self.targets().values()):
            why = stale(target, depsgraph, around)
            if why:
                self.notes.append(f"{target.name} is stale already: {why.replace('since the bake', 'meanwhile')}. "
                                  "Bake it again")

    def object_in_use(self) -> str | None:
        """A target that can't be written now, because it is in edit mode or being sculpted or painted."""
        return next((target.name for target in self.targets().values()
                     if target is not None and target.mode != "OBJECT"), None)

    def conclude(self) -> str:
        """`store` the result and leave nothing else; what to tell the user, beside `notes`. Raises PRTError."""
        result = self.store()
        self.note_changes()
        self.discard()
        self.close()
        return baked_message(result, self.seconds(result))

    def discard(self) -> None:
        """Drop the job folder."""
        jobs.discard(self.claim)

    def close(self) -> None:
        """End the child if it lives, and let others have the job folder. May be called twice."""
        self.process.cancel()
        self.claim.release()

    def end(self, state: str) -> None:
        """`close` a bake that was cancelled or failed: nobody shall be asked whether it is to go on."""
        self.process.cancel()
        note_end(self.job, state)
        self.claim.release()

    def file_saved(self) -> None:
        """The file has another name now: an interrupted bake belongs to that one."""
        record = read_record(self.job)
        if record is not None:
            write_record(self.job, replace(record, file=bpy.data.filepath))


def _identities(scene: bpy.types.Scene) -> dict[str, int]:
    return {o.name_full: o.session_uid for o in scene.objects}


def _tuple(names: Sequence[str] | None) -> tuple[str, ...] | None:
    return None if names is None else tuple(names)


def _regions(depsgraph: bpy.types.Depsgraph, settings: BakeSettings, scene: SceneMesh) -> NDArray[np.float64]:
    """Where lamps will move: the region that is named, else the scene's free space, with the lamps that are there."""
    if settings.cloud_region:
        return light_regions(depsgraph, settings.cloud_region)
    lamps = np.array([lamp.position for lamp in read_local_lights(depsgraph, [])]).reshape(-1, 3)
    return free_space(scene.points[np.unique(scene.triangles)], lamps)[None]


def _check_storable(targets: list[bpy.types.Object]) -> None:
    """Raise StorageError, before the work, for a target whose data another file owns."""
    for target in targets:
        if target.library is not None or target.override_library is not None:
            raise StorageError(target.name, "it is linked from another file, so its bake can't be stored here",
                               "Make it local, select other objects, or bake it in its own file")


def _drop_forgotten(folder: Path) -> None:
    """Remove jobs that nobody resumed: an interrupted bake of a scene since edited would lie there for ever."""
    for job in folder.glob("bake-*"):
        try:
            age = time.time() - job.stat().st_mtime
        except OSError:  # another Blender has just removed it
            continue
        if age > KEPT_DAYS * 86400:
            discard_if_free(job)


def baked_message(result: BakeResult, seconds: float) -> str:
    """What came out, in a line for the artist."""
    names, report = list(result.objects), result.report
    what = names[0] if len(names) == 1 else f"{len(names)} objects"
    text = f"Baked {what} in {seconds:.1f} s, {plural(report['clusters']['count'], 'cluster', 'clusters')}"
    if any(report.get(key) for key in PARTS.values()):
        text += f". {headline(report)}"
    for part, key in PARTS.items():
        errors = {name: entry["relative_rms"] for name, entry in (report.get(key) or {}).items()}
        if errors.get("basis", 0.0) > 0.5 * errors.get("total", 0.0):
            if key == "local_errors" or report["settings"]["lighting"] == "local":
                return f"{text}, mostly because lamps are put together from few columns"
            subject = "" if part == "diffuse" else ", in highlights"
            limit = "cubemap" if report["settings"].get("distant_basis") == "cubemap" else "order"
            return f"{text}, mostly because the light is sharper than the {limit} can show{subject}"
    return text
