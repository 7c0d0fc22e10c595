# SPDX-License-Identifier: GPL-3.0-or-later
"""Who traces a bake's rays: Embree alone, or the graphics driver beside it where it was measured faster.

The measurement is kept in the extension's user folder, one for each machine and driver. Where none was made, or the
driver was not faster, a bake is the same child process as ever and never touches a graphics driver.
"""

from __future__ import annotations

import os
import shutil
import sys
import tempfile
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import bpy

from ..prt_addon.baking.claims import Claim
from ..prt_addon.baking.process import ERROR_FILE, MESSAGE_FILE, BakeProcess, Message, wheels_folder
from ..prt_addon.blender.ground_truth import blender_command
from ..prt_addon.errors import StorageError
from ..prt_addon.storage.files import write_atomically
from ..prt_addon.tracing.ray_cost import Calibration, TracerChoice, choose_tracer
from .side_job import SideJob

ROOT_PACKAGE = __package__.rpartition(".")[0]
WORKER = Path(__file__).resolve().parents[1] / "gpu_shaders" / "tracing_worker.py"
WHAT, SAVED = "Ray tracing on the GPU", "time: Embree is faster here"


def calibration_file() -> Path:
    """Where this machine's measurement is kept: the extension's user folder, or Blender's for a checkout."""
    if ROOT_PACKAGE.startswith("bl_ext."):
        return Path(bpy.utils.extension_path_user(ROOT_PACKAGE)) / "ray_engine.json"
    return Path(bpy.utils.user_resource("DATAFILES", path="prt")) / "ray_engine.json"


def stored_calibration() -> Calibration | None:
    """This machine's measurement, or None where there is none that can be used."""
    try:
        return Calibration.from_json(calibration_file().read_text("utf-8"))
    except (OSError, UnicodeDecodeError):
        return None


def tracing_choice(threads: int = 0) -> TracerChoice:
    """Who traces, and why. threads: of the bake, 0 for one on each core."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return choose_tracer(stored_calibration(), threads or cores)


def left_out(threads: int = 0) -> list[dict[str, str]]:
    """The GPU as an entry of a report's left-out list, if it was measured and is left out, with its numbers."""
    choice = tracing_choice(threads)
    return [{"what": WHAT, "why": choice.left_out, "saved": SAVED}] if choice.left_out else []


def bake_process(claim: Claim, threads: int) -> BakeProcess:
    """The child that will bake the job."""
    if tracing_choice(threads).gpu:
        return TracingProcess(blender_command(), claim.folder)
    return BakeProcess([sys.executable, *bpy.app.python_args], claim.folder)


class TracingProcess(BakeProcess):
    """A bake in a Blender of its own that has the graphics driver. A driver that falls is not asked again."""

    verb: ClassVar[str] = "bake"

    def start(self) -> None:
        """Start the child, on the same graphics library as this Blender. PRTError when that can't be started."""
        try:
            (self.job / MESSAGE_FILE).write_bytes(b"")  # the child appends to it: stdout has Blender's own chatter
            with open(self.job / ERROR_FILE, "wb") as chatter:
                command = with_backend(self.python_command)
                self._start([*command, str(WORKER), "--", self.verb, str(self.job), wheels_folder()], chatter, chatter)
        except OSError as error:
            raise StorageError(str(self.job), f"the job folder can't be written ({error.strerror})",
                               "Free some space, or choose a folder that can be written") from error

    def _death(self) -> Message:
        """A child that ended without a word: the next bake goes without the driver."""
        message = super()._death()
        if not self._cancelled:
            with suppress(OSError):  # of a folder that can't be written: its measurement stays
                calibration_file().unlink(missing_ok=True)
            message["remedy"] = "Bake again: it resumes, with rays traced by Embree alone"
        return message


def with_backend(command: list[str]) -> list[str]:
    """The command that starts Blender, with the graphics library that this one was started with."""
    option = "--gpu-backend"
    if bpy.app.module or "--background" not in command:
        return command
    chosen = sys.argv[sys.argv.index(option) + 1] if option in sys.argv[:-1] else \
        bpy.context.preferences.system.gpu_backend.lower()
    return [command[0], option, chosen, *command[1:]]


class MeasureProcess(TracingProcess):
    """A measurement of the graphics driver. Its folder goes with it."""

    verb = "measure"
    subject = WHAT
    remedy = "Bakes go on without it: Embree traces them"
    memory_remedy = lost_remedy = remedy
    cancel_remedy = "Measure again when you like"

    def _death(self) -> Message:
        return {**super()._death(), "remedy": self.remedy}

    def cancel(self) -> None:
        """Stop the child now and drop its folder. May be called twice."""
        super().cancel()
        self.finished = True
        shutil.rmtree(self.job, ignore_errors=True)


@dataclass(frozen=True)
class MeasureRequest:
    """One press on Measure, until its turn comes."""

    title: ClassVar[str] = "Speed of ray tracing"

    def start(self) -> MeasureSession:
        """Begin. Raises PRTError."""
        job = Path(tempfile.mkdtemp(prefix="prt-measure-", dir=bpy.app.tempdir or None))
        process = MeasureProcess(blender_command(), job)
        try:
            process.start()
        except BaseException:
            shutil.rmtree(job, ignore_errors=True)
            raise
        return MeasureSession(process)

    def object_in_use(self) -> None:
        """No object is touched."""


@dataclass
class MeasureSession(SideJob):
    """A measurement under way: poll `process` until it is finished, then `conclude`."""

    process: MeasureProcess
    notes: tuple[str, ...] = ()

    def conclude(self) -> str:
        """Keep the result; what to tell the user. Raises StorageError."""
        try:
            text = (self.process.job / "calibration.json").read_text("utf-8")
        except OSError as error:
            raise StorageError(WHAT, f"the measurement left no result ({error.strerror})", "Measure again") from error
        finally:
            self.close()
        path = calibration_file()
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise StorageError(str(path.parent), f"can't be made ({error.strerror})",
                               "Make room for it, or let this folder be written") from error
        write_atomically(path, lambda stream: stream.write(text.encode()))
        return f"Rays are traced by {tracing_choice().why}"
