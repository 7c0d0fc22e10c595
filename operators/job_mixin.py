# SPDX-License-Identifier: GPL-3.0-or-later
"""The one modal job: timer, Esc, status text, progress and cancel of every operator that works in a child process.

From the user interface the operator is modal and Blender stays responsive; called as a script or in background mode it
blocks until the end. Both read the same messages.
"""

from __future__ import annotations

from typing import ClassVar

import bpy

from ..prt_addon.baking.process import Message, raise_error
from ..prt_addon.errors import Cancelled, PRTError
from .bake_session import BakeSession
from .properties import assign, session

POLL_SECONDS = 0.2  # each tick redraws the sidebar


# What the stages of the recipe are called on the screen.
STAGES = {
    "prepare": "Preparing",
    "gather": "Finding surfaces that light each other",
    "direct": "Shadows",
    "interreflection": "Bounced light",
    "glossy": "Highlights",
    "local": "Local lights",
    "subsurface": "Light through bodies",
    "encode": "Compressing",
    "errors": "Measuring the error",
    "cycles": "Rendering with Cycles",
}


def progress_text(message: Message) -> str:
    """A progress message in words: "Shadows: 42 %, 12 s left"."""
    text = f"{STAGES.get(message['stage'], message['stage'])}: {100.0 * message['fraction']:.0f} %"
    return text if message["seconds_left"] is None else f"{text}, {message['seconds_left']:.0f} s left"


class JobMixin:
    """Base of operators whose work is a BakeSession, or another job with such a `process`.

    A subclass gives `start_job(context) -> job`, which raises PRTError for bad input, and
    `finish_job(context, job) -> str`, which stores the result and returns what to tell the user.
    """

    # One job at a time; on the class, because Blender makes a new operator instance per call and `prt.cancel` asks.
    running: ClassVar[BakeSession | None] = None
    cancel_requested: ClassVar[bool] = False
    subject: ClassVar[str] = "Bake"
    cancel_remedy: ClassVar[str] = "Bake again to resume where it stopped"
    _timer: bpy.types.Timer | None = None

    @classmethod
    def request_cancel(cls) -> None:
        """Ask the running job to end; it does so at its next tick."""
        JobMixin.cancel_requested = True

    @classmethod
    def stop_now(cls) -> None:
        """End the child at once: the file or the extension is about to go away."""
        if JobMixin.running is not None:
            JobMixin.running.process.cancel()
            JobMixin.running = None

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Block until the end: scripts and background mode."""
        try:
            job = self._begin(context)
            try:
                for message in job.process.wait():
                    self._show(context, message)
            finally:
                job.process.cancel()
            return self._complete(context, job)
        except PRTError as error:
            return self._fail(context, error)
        finally:
            self._end(context)

    def invoke(self, context: bpy.types.Context, _event: bpy.types.Event) -> set[str]:
        """Start the child and return to Blender; `modal` follows it."""
        if bpy.app.background:
            return self.execute(context)
        try:
            self._begin(context)
        except PRTError as error:
            return self._fail(context, error)
        finally:
            if JobMixin.running is None:
                self._end(context)
        self._timer = context.window_manager.event_timer_add(POLL_SECONDS, window=context.window)
        context.window_manager.modal_handler_add(self)
        context.window_manager.progress_begin(0.0, 1.0)
        return {"RUNNING_MODAL"}

    def modal(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        """Follow the child on timer events; let everything else through but Esc."""
        job = JobMixin.running
        if event.type == "ESC" and event.value == "PRESS":
            JobMixin.cancel_requested = True
        elif event.type != "TIMER":
            return {"PASS_THROUGH"}
        under_way = False
        try:
            if job is None or JobMixin.cancel_requested:
                raise Cancelled(self.subject, "cancelled, nothing was changed", self.cancel_remedy)
            for message in job.process.poll()[-1:]:  # the last says it all: it alone can be an end
                self._show(context, message)
            under_way = not job.process.finished
            return {"PASS_THROUGH"} if under_way else self._complete(context, job)
        except PRTError as error:
            return self._fail(context, error)
        finally:
            if not under_way:
                self._end(context)

    def cancel(self, context: bpy.types.Context) -> None:
        """Blender drops the operator: a window closes, a file is loaded."""
        self._end(context)

    def _begin(self, context: bpy.types.Context) -> BakeSession:
        """Start the job. That no other one runs is the subclass's `poll` to see to."""
        JobMixin.cancel_requested = False
        assign(session(context), running=True, stage="Reading the scene", fraction=0.0, seconds_left=-1.0, message="",
               failed=False, analysis="")
        JobMixin.running = self.start_job(context)
        return JobMixin.running

    def _show(self, context: bpy.types.Context, message: Message) -> None:
        """Pass a message on to status bar, cursor and panel; raises what an error message says."""
        if message["type"] == "error":
            raise_error(message)
        if message["type"] != "progress":
            return
        left = message["seconds_left"]
        assign(session(context), stage=STAGES.get(message["stage"], message["stage"]), fraction=message["fraction"],
               seconds_left=-1.0 if left is None else left)
        if self._timer is not None:
            context.window_manager.progress_update(message["fraction"])
            context.workspace.status_text_set(f"PRT: {progress_text(message)} (Esc cancels)")

    def _complete(self, context: bpy.types.Context, job: BakeSession) -> set[str]:
        text = self.finish_job(context, job)
        assign(session(context), message=text, failed=False)
        self.report({"INFO"}, text)
        return {"FINISHED"}

    def _fail(self, context: bpy.types.Context, error: PRTError) -> set[str]:
        cancelled = isinstance(error, Cancelled)
        assign(session(context), message=str(error), failed=not cancelled)
        self.report({"WARNING" if cancelled else "ERROR"}, str(error))
        return {"CANCELLED"}

    def _end(self, context: bpy.types.Context) -> None:
        """Leave nothing behind: child, timer, status text, progress."""
        JobMixin.stop_now()
        JobMixin.cancel_requested = False
        assign(session(context), running=False)
        if self._timer is None:
            return
        context.window_manager.event_timer_remove(self._timer)
        self._timer = None
        context.window_manager.progress_end()
        if context.workspace is not None:
            context.workspace.status_text_set(None)
