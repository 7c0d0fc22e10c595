# SPDX-License-Identifier: GPL-3.0-or-later
"""The one modal job and its queue: timer, Esc, status text, progress and cancel of every operator that bakes.

From the user interface the first operator becomes modal and follows all bakes that are asked for meanwhile, one after
the other; Blender stays responsive. Called as a script or in background mode an operator blocks until its own bake's
end. Both read the same messages.
"""

from __future__ import annotations

from typing import ClassVar

import bpy

from ..prt_addon.baking.process import Message, raise_error
from ..prt_addon.baking.record import CANCELLED, FAILED
from ..prt_addon.errors import Cancelled, PRTError
from . import live_preview
from .bake_request import BakeRequest
from .bake_session import BakeSession
from .compare_session import CompareRequest, CompareSession
from .properties import assign, session
from .tracing_choice import MeasureRequest, MeasureSession

Request = BakeRequest | CompareRequest | MeasureRequest
Job = BakeSession | CompareSession | MeasureSession
POLL_SECONDS = 0.2  # each tick redraws the sidebar
ENDED_LINES = 6  # of earlier bakes of a queue that the panel shows


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
    "measure": "Measuring ray tracing",
}


def progress_text(message: Message) -> str:
    """A progress message in words: "Shadows: 42 %, 12 s left"."""
    text = f"{STAGES.get(message['stage'], message['stage'])}: {100.0 * message['fraction']:.0f} %"
    return text if message["seconds_left"] is None else f"{text}, {message['seconds_left']:.0f} s left"


class JobMixin:
    """Base of operators that bake, or compare with Cycles. A subclass gives `make_request(context) -> Request`, which
    raises PRTError.

    The state is on the class, because Blender makes a new operator instance per call, and any of them may follow the
    queue: `active` while one does.
    """

    active: ClassVar[bool] = False
    running: ClassVar[Job | None] = None
    title: ClassVar[str] = ""
    waiting: ClassVar[list[Request]] = []
    cancel_requested: ClassVar[bool] = False
    timer: ClassVar[bpy.types.Timer | None] = None
    status_shown: ClassVar[set[str]] = set()  # workspaces whose status bar shows our text
    follower: ClassVar[int] = 0  # number of the operator instance that follows: only one does
    number = 0
    stored = False  # something that no undo step holds yet

    @classmethod
    def request_cancel(cls) -> None:
        """Ask the running bake to end; it does so at the next tick."""
        JobMixin.cancel_requested = True

    @classmethod
    def cancel_waiting(cls, number: int | None = None) -> None:
        """Drop a waiting bake, or all of them."""
        del JobMixin.waiting[slice(None) if number is None else slice(number, number + 1)]
        _show_waiting()

    @classmethod
    def stop_now(cls) -> list[str]:
        """End all at once, as the file or the extension is about to go away; the running bake can be resumed. Returns
        the titles of what was ended."""
        titles = [JobMixin.title] * (JobMixin.running is not None) + [request.title for request in JobMixin.waiting]
        if JobMixin.running is not None:
            JobMixin.running.close()
        JobMixin.running, JobMixin.active = None, False
        JobMixin.waiting.clear()
        _let_go(bpy.context)
        return titles

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Block until the end: scripts and background mode."""
        if JobMixin.active:
            self._tell(PRTError("Bake", "another one runs, and a script has to wait for its own",
                                "Wait for its end, or call prt.bake with INVOKE_DEFAULT to queue"))
            return {"CANCELLED"}
        try:
            self._begin(context, self.make_request(context))
            for message in JobMixin.running.process.wait():
                self._show(context, message)
            self._complete(context, JobMixin.running)
        except PRTError as error:
            self._fail(error)
        finally:
            if JobMixin.running is not None:
                JobMixin.running.close()
                JobMixin.running = None
            assign(session(context), running=False)
        return {"FINISHED"} if self.stored else {"CANCELLED"}

    def invoke(self, context: bpy.types.Context, _event: bpy.types.Event) -> set[str]:
        """Start the child and return to Blender, where `modal` follows it; or wait in the queue."""
        if bpy.app.background:
            return self.execute(context)
        try:
            request = self.make_request(context)
        except PRTError as error:
            self._tell(error)
            return {"CANCELLED"}
        JobMixin.waiting.append(request)
        if JobMixin.active:
            _show_waiting()
            self.report({"INFO"}, f"{request.title}: its turn comes after what is under way")
            return {"INTERFACE"}  # nothing has changed that could be undone
        assign(session(context), ended="")
        JobMixin.cancel_requested = False
        if not self._start_next(context):
            self._end(context)
            return {"CANCELLED"}
        return self.follow(context)

    def follow(self, context: bpy.types.Context) -> set[str]:
        """Become the operator that follows the queue, in this window."""
        JobMixin.active = True
        JobMixin.follower += 1
        self.number = JobMixin.follower
        JobMixin.timer = context.window_manager.event_timer_add(POLL_SECONDS, window=context.window)
        context.window_manager.modal_handler_add(self)
        context.window_manager.progress_begin(0.0, 1.0)
        return {"RUNNING_MODAL"}

    def modal(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        """Follow the child on timer events; let everything else through but Esc."""
        if not JobMixin.active or self.number != JobMixin.follower:  # `stop_now` was called, for a load that failed
            return {"CANCELLED"}
        if event.type == "ESC" and event.value == "PRESS":
            JobMixin.cancel_requested = True
        elif event.type != "TIMER":
            return {"PASS_THROUGH"}
        under_way = False
        try:
            if JobMixin.running is not None:
                self._follow_running(context)
            under_way = JobMixin.running is not None or self._start_next(context)
        finally:
            if not under_way:
                self._end(context)
        if under_way:
            return {"PASS_THROUGH"}
        return {"FINISHED"} if self.stored else {"CANCELLED"}

    def cancel(self, context: bpy.types.Context) -> None:
        """Blender drops the operator because its window closes: another window follows the bake from now on. Where a
        file is loaded or Blender quits, `stop_now` was called before, or is about to be."""
        _let_go(context)
        if JobMixin.active and not bpy.app.timers.is_registered(_follow_elsewhere):
            bpy.app.timers.register(_follow_elsewhere, first_interval=0.0)

    def _start_next(self, context: bpy.types.Context) -> bool:
        """Start the first waiting bake that can be; False once none is left."""
        while JobMixin.waiting:
            request = JobMixin.waiting[0]
            in_use = request.object_in_use()
            if JobMixin.cancel_requested:
                JobMixin.waiting.pop(0)
                JobMixin.cancel_requested = False
            elif in_use is not None:
                assign(session(context), running=True, stage=f"Waits until {in_use} leaves Edit Mode", fraction=0.0,
                       seconds_left=-1.0)
                self._show_status(context, f"waits until {in_use} leaves Edit Mode")
                return True
            else:
                try:
                    self._begin(context, JobMixin.waiting.pop(0))
                    return True
                except PRTError as error:
                    self._fail(error)
        return False

    def _begin(self, context: bpy.types.Context, request: Request) -> None:
        """Start a bake; what the one before it left as a message moves up."""
        state = session(context)
        ended = state.ended
        if state.message and JobMixin.active:
            ended = "\n".join([*ended.splitlines(), f"{'!' if state.failed else ' '}{state.message}"][-ENDED_LINES:])
        assign(state, running=True, title=request.title, stage="Reading the scene", fraction=0.0, seconds_left=-1.0,
               message="", failed=False, analysis="", ended=ended)
        _show_waiting()
        JobMixin.title, JobMixin.cancel_requested = request.title, False
        JobMixin.running = request.start()

    def _follow_running(self, context: bpy.types.Context) -> None:
        """One tick of the running bake; afterwards `running` is None if it ended, well or not."""
        job = JobMixin.running
        try:
            if JobMixin.cancel_requested:
                raise Cancelled(job.process.subject, "cancelled, nothing was changed", job.process.cancel_remedy)
            for message in job.process.poll()[-1:]:  # the last says it all: it alone can be an end
                self._show(context, message)
            if not job.process.finished:
                return
            in_use = job.object_in_use()
            if in_use is not None:
                assign(session(context), stage=f"Done. Stored once {in_use} is in Object Mode", fraction=1.0,
                       seconds_left=-1.0)
                self._show_status(context, f"done, and stored once {in_use} is in Object Mode")
                return
            self._complete(context, job)
            if JobMixin.waiting:  # after the last one Blender does it
                bpy.ops.ed.undo_push(message=f"Bake {JobMixin.title}" if job.writes_bakes else JobMixin.title)
                self.stored = False
        except PRTError as error:
            self._fail(error)
        except BaseException:
            job.end(FAILED)
            JobMixin.running = None
            raise
        JobMixin.running, JobMixin.cancel_requested = None, False

    def _show(self, context: bpy.types.Context, message: Message) -> None:
        """Pass a message on to status bar, cursor and panel; raises what an error message says."""
        if message["type"] == "error":
            raise_error(message)
        if message["type"] != "progress":
            return
        left = message["seconds_left"]
        assign(session(context), stage=STAGES.get(message["stage"], message["stage"]), fraction=message["fraction"],
               seconds_left=-1.0 if left is None else left)
        if JobMixin.active:
            context.window_manager.progress_update(message["fraction"])
            self._show_status(context, progress_text(message))

    def _show_status(self, context: bpy.types.Context, text: str) -> None:
        """A line in the status bar, with what Esc does."""
        if not JobMixin.active or context.workspace is None:
            return
        count = len(JobMixin.waiting)
        more = f"Esc cancels this bake, {count} more wait{'s' if count == 1 else ''}" if count else "Esc cancels"
        context.workspace.status_text_set(f"PRT: {text} ({more})")
        JobMixin.status_shown.add(context.workspace.name)

    def _complete(self, context: bpy.types.Context, job: Job) -> None:
        """Store a finished bake and say what came out."""
        text = ". ".join([job.conclude(), *job.notes])
        self.stored = True
        if job.writes_bakes:
            live_preview.bakes_changed()
        assign(session(context), message=text, failed=False)
        self.report({"WARNING" if job.notes else "INFO"}, text)

    def _fail(self, error: PRTError) -> None:
        """End what is left of a bake without a result, and say why."""
        if JobMixin.running is not None:
            JobMixin.running.end(CANCELLED if isinstance(error, Cancelled) else FAILED)
        JobMixin.running = None
        self._tell(error)

    def _tell(self, error: PRTError) -> None:
        """Say what went wrong, or that it was cancelled."""
        cancelled = isinstance(error, Cancelled)
        assign(session(), message=str(error), failed=not cancelled)
        self.report({"WARNING" if cancelled else "ERROR"}, str(error))

    def _end(self, context: bpy.types.Context) -> None:
        """Leave nothing behind: child, timer, status text, progress."""
        JobMixin.stop_now()
        JobMixin.cancel_requested = False
        _let_go(context)
        assign(session(context), running=False, waiting="")


def _show_waiting() -> None:
    """Have the panel list what waits."""
    assign(session(), waiting="\n".join(request.title for request in JobMixin.waiting))


def _let_go(context: bpy.types.Context) -> None:
    """Take timer, progress and status texts back."""
    if context.window_manager is None:  # Blender is about to end
        return
    if JobMixin.timer is not None:
        context.window_manager.event_timer_remove(JobMixin.timer)
        JobMixin.timer = None
        context.window_manager.progress_end()
    for name in JobMixin.status_shown:
        workspace = bpy.data.workspaces.get(name)
        if workspace is not None:
            with context.temp_override(workspace=workspace):
                workspace.status_text_set(None)
    JobMixin.status_shown.clear()


def _follow_elsewhere() -> None:
    """Have a window that is left follow the bakes."""
    windows = bpy.context.window_manager.windows
    if not JobMixin.active:
        return
    if not windows:
        JobMixin.stop_now()
        return
    with bpy.context.temp_override(window=windows[0]):
        bpy.ops.prt.follow_bakes("INVOKE_DEFAULT")
