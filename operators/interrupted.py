# SPDX-License-Identifier: GPL-3.0-or-later
"""prt.resume, prt.discard_interrupted, and the handlers that find bakes which a crash, a kill, quitting or loading
another file interrupted."""

from __future__ import annotations

import os
from pathlib import Path

import bpy
from bpy.app.handlers import persistent

from ..prt_addon.baking import record as records
from ..prt_addon.baking.claims import discard_if_free
from ..prt_addon.baking.record import JobRecord
from ..prt_addon.errors import BadScene, PRTError, StorageError
from .bake_request import BakeRequest, title_of
from .bake_session import jobs_folder
from .job_mixin import STAGES, JobMixin
from .properties import assign, session

LOOK_SECONDS = 0.2  # after a start or a load: then the file's data is there

_ended_by_load: list[str] = []  # titles of the bakes that loading another file ended


def offered() -> dict[Path, JobRecord]:
    """Interrupted bakes of the open file, the newest first."""
    return {folder: record for folder, record in records.interrupted(jobs_folder()).items() if _is_here(record)}


def offer_text(folder: Path, record: JobRecord) -> str:
    """"A bake of Statue, Floor was interrupted after Shadows (3 of 6 stages)"."""
    stage, place, count = records.reached(folder)
    what = f"A bake of {title_of(record.objects)} was"
    if count and place == count:
        return f"{what} done, but not stored: Resume stores it at once"
    if not place:
        return f"{what} interrupted before its first stage was done"
    return f"{what} interrupted after {STAGES.get(stage, stage)} ({place} of {count} stages)"


def look() -> None:
    """Have the panel offer what can be resumed."""
    found = offered()
    assign(session(), interrupted="\n".join(f"{folder.name}\t{offer_text(folder, record)}"
                                            for folder, record in found.items()))


def _is_here(record: JobRecord) -> bool:
    """Whether a bake is of the open file: the same path, and some of its objects are there."""
    if _real(record.file) != _real(bpy.data.filepath):
        return False
    scene = bpy.data.scenes.get(record.scene)
    return scene is not None and any(name in scene.objects for name in record.objects)


def _real(path: str) -> str:
    return os.path.normcase(os.path.realpath(path)) if path else ""


class PRT_OT_resume(JobMixin, bpy.types.Operator):
    """Bake the same objects with the same settings again, from the last finished stage on.
    Costs only the stages that are left, where the scene is as it was; else it bakes afresh, and says so"""

    bl_idname = "prt.resume"
    bl_label = "Resume"
    bl_options = {"UNDO"}

    job: bpy.props.StringProperty(name="Job", options={"HIDDEN", "SKIP_SAVE"},
                                  description="Name of the job's folder; empty is the newest of this file")

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        if context.mode != "OBJECT":
            cls.poll_message_set("Leave edit mode first: the bake reads finished meshes")
            return False
        return True

    def make_request(self, context: bpy.types.Context) -> BakeRequest:
        """As it was asked for then."""
        request = BakeRequest.of_interrupted(*_chosen(self.job))
        left = [line for line in session(context).interrupted.splitlines()
                if line.partition("\t")[0] != request.resumes[0].name]
        assign(session(context), interrupted="\n".join(left))
        return request

    def execute(self, context: bpy.types.Context) -> set[str]:
        return self._offered_again(JobMixin.execute(self, context))

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        return self._offered_again(JobMixin.invoke(self, context, event))

    def _offered_again(self, outcome: set[str]) -> set[str]:
        """What could not even begin stays on offer."""
        if outcome == {"CANCELLED"}:
            look()
        return outcome


class PRT_OT_discard_interrupted(bpy.types.Operator):
    """Drop an interrupted bake and its finished stages. Frees their disk space; stored bakes stay"""

    bl_idname = "prt.discard_interrupted"
    bl_label = "Discard"

    job: bpy.props.StringProperty(name="Job", options={"HIDDEN", "SKIP_SAVE"},
                                  description="Name of the job's folder; empty is the newest of this file")

    def execute(self, _context: bpy.types.Context) -> set[str]:
        try:
            folder, record = _chosen(self.job)
            if not discard_if_free(folder):
                raise StorageError(title_of(record.objects), "another Blender goes on with its bake",
                                   "Cancel it there")
        except PRTError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        finally:
            look()
        self.report({"INFO"}, f"Discarded the interrupted bake of {title_of(record.objects)}")
        return {"FINISHED"}


def _chosen(name: str) -> tuple[Path, JobRecord]:
    """Folder and record of an interrupted bake of this file. Raises BadScene where there is none."""
    found = {folder.name: (folder, record) for folder, record in offered().items()}
    if not found or (name and name not in found):
        raise BadScene("Resume", "no interrupted bake of this file is left", "Bake again")
    return found[name or next(iter(found))]


def _look_later() -> None:
    if not bpy.app.background and not bpy.app.timers.is_registered(look):
        bpy.app.timers.register(look, first_interval=LOOK_SECONDS, persistent=True)


@persistent
def _on_load_pre(*_arguments: object) -> None:
    """The data that a bake is for is about to go: end it, so that it can be resumed."""
    _ended_by_load[:] = JobMixin.stop_now()


@persistent
def _on_load_post(*_arguments: object) -> None:
    """Tell what the load has ended, and look for what can be resumed."""
    assign(session(), running=False, waiting="", ended="")
    if _ended_by_load:
        error = PRTError(_ended_by_load[0], "its bake ended because a file was loaded",
                         "Open its file again to resume it")
        assign(session(), message=str(error), failed=True)
        _ended_by_load.clear()
    _look_later()


@persistent
def _on_save_post(*_arguments: object) -> None:
    """A file saved under another name takes its running bake along."""
    if JobMixin.running is not None:
        try:
            JobMixin.running.file_saved()
        except PRTError:
            return  # the folder can't be written: the bake itself will say so


HANDLERS = (
    (bpy.app.handlers.load_pre, _on_load_pre),
    (bpy.app.handlers.load_post, _on_load_post),
    (bpy.app.handlers.load_post_fail, _on_load_post),
    (bpy.app.handlers.save_post, _on_save_post),
)


def register() -> None:
    """Attach the handlers, and look soon."""
    for handlers, handler in HANDLERS:
        handlers.append(handler)
    _look_later()


def unregister() -> None:
    """Leave no handler or timer behind."""
    for handlers, handler in HANDLERS:
        handlers.remove(handler)
    if bpy.app.timers.is_registered(look):
        bpy.app.timers.unregister(look)
