# SPDX-License-Identifier: GPL-3.0-or-later
"""The bake as a child process, seen from its parent: start, poll, cancel.

The child writes JSON lines into a file in the job folder, which the parent tails: no threads, no blocking reads, and
the same on every system. The child ends by itself when the parent dies, because its standard input then ends.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import IO, Any

import scipy

from ..errors import Cancelled, PRTError
from .leftovers import CANT_WRITE, drop_unfinished

Message = dict[str, Any]

# The closed set of messages and what each carries; anything else in the file is a defect of ours.
MESSAGES: dict[str, frozenset[str]] = {
    "progress": frozenset({"stage", "fraction", "rays", "seconds_left"}),
    "done": frozenset(),
    "error": frozenset({"subject", "cause", "remedy", "exit_code"}),
}
MESSAGE_FILE = "messages.jsonl"
ERROR_FILE = "worker_errors.txt"
FREE_SPACE = "Free some space, or choose a folder that can be written"
WORKER = Path(__file__).with_name("worker.py")
END_SECONDS, KILL_SECONDS = 2.0, 0.4  # that a child has for its own end, and for dying when it is told to


def raise_error(message: Message) -> None:
    """Raise what an "error" message says, as the exception of its exit code."""
    kind = Cancelled if message["exit_code"] == Cancelled.exit_code else PRTError
    error = kind(message["subject"], message["cause"], message["remedy"])
    error.exit_code = message["exit_code"]
    raise error


class BakeProcess:
    """One bake of one job folder in a child process.

    python_command: what starts a Python that has numpy: `[sys.executable, *bpy.app.python_args]`.
    job: the folder made by `job.write_job`. The result is left in it; read it after a "done" message.
    """

    # What a process of another kind (blender/ground_truth.py) calls otherwise.
    subject = "Bake"
    remedy = "The previous bake is untouched; bake again to resume"
    memory_remedy = "Choose a lower order, fewer directions, lights or objects and bake again to resume"
    lost_remedy = "The previous bake is untouched; bake again, and leave the folder alone"
    cancel_remedy = "Bake again to resume where it stopped"

    def __init__(self, python_command: list[str], job: Path) -> None:
        self.python_command = list(python_command)
        self.job = Path(job)
        self.process: subprocess.Popen[bytes] | None = None
        self.finished = False
        self._offset = 0
        self._partial = b""
        self._cancelled = False

    @property
    def returncode(self) -> int | None:
        """The child's exit status; None before its end. Negative: the signal that ended it."""
        return None if self.process is None else self.process.poll()

    def start(self) -> None:
        """Start the child. PRTError when Python itself can't be started."""
        command = [*self.python_command, str(WORKER), str(self.job), "--site", wheels_folder()]
        try:
            with open(self.job / MESSAGE_FILE, "wb") as messages, open(self.job / ERROR_FILE, "wb") as errors:
                self._start(command, messages, errors)
        except OSError as error:
            raise PRTError(str(self.job), f"the job folder can't be written ({error.strerror})", FREE_SPACE) from error

    def _start(self, command: list[str], messages: IO[bytes], errors: IO[bytes]) -> None:
        try:
            self.process = subprocess.Popen(
                command, stdin=subprocess.PIPE, stdout=messages, stderr=errors, env=_environment(),
                creationflags=_creation_flags(),
            )
        except OSError as error:
            raise PRTError(f"{self.subject} process", f"{Path(command[0]).name} could not be started ({error})",
                           "Check the Blender installation") from error

    def poll(self) -> list[Message]:
        """The messages since the last call; never waits. The last one of a bake is "done" or "error"."""
        if self.finished or self.process is None:
            return []
        ended = self.process.poll() is not None  # asked before reading, so that nothing written before is missed
        try:
            messages = list(self._new_messages())
        except OSError:
            return [self._lost_folder()]
        if any(message["type"] != "progress" for message in messages):
            self.finished = True
        elif ended:
            self.finished = True
            messages.append(self._death())
        if self.finished:
            self._close()
        return messages

    def wait(self, interval: float = 0.05) -> Iterator[Message]:
        """All messages until the end, waiting in between: for commands and background mode."""
        while not self.finished:
            messages = self.poll()
            yield from messages
            if not messages:
                time.sleep(interval)

    def cancel(self) -> None:
        """Stop the child now; finished stages stay in the job folder, so the next bake resumes. May be called twice."""
        self._cancelled = True
        if self.process is not None and self.process.poll() is None:
            self.process.terminate()
            self._close(KILL_SECONDS)

    def _close(self, seconds: float = END_SECONDS) -> None:
        """Wait for the child's end, which is due; kill it when it has not come after so many seconds."""
        if self.process is None:
            return
        try:
            self.process.wait(seconds)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()
        if self.process.stdin is not None:
            self.process.stdin.close()  # only now: its end tells a living child that the parent died
        drop_unfinished(self.job)

    def _new_messages(self) -> Iterator[Message]:
        with open(self.job / MESSAGE_FILE, "rb") as file:
            file.seek(self._offset)
            data = file.read()
        self._offset += len(data)
        *lines, self._partial = (self._partial + data).split(b"\n")
        for line in lines:
            message = json.loads(line)
            if set(message) - {"type"} != MESSAGES[message["type"]]:
                raise ValueError(f"malformed message of the bake process: {message}")
            yield message

    def _lost_folder(self) -> Message:
        """End the child whose folder somebody deleted, and the message for it."""
        self.finished = True
        self.cancel()
        return error_message(PRTError(self.subject, "its job folder was deleted while it ran", self.lost_remedy))

    def _death(self) -> Message:
        """The message for a child that ended without saying why."""
        code = self.returncode
        if self._cancelled:
            return error_message(Cancelled(self.subject, "cancelled", self.cancel_remedy))
        if code == CANT_WRITE:
            cause = f"the disk is full, or the job folder {self.job} can't be written"
            return error_message(PRTError(self.subject, cause,
                                          "The previous bake is untouched; free some space and bake again to resume"))
        last = _last_line(self.job / ERROR_FILE)
        if code is not None and code < 0:
            name = signal.Signals(-code).name if -code in set(signal.Signals) else str(-code)
            cause = f"its process was ended by signal {name}"
        else:
            cause = f"its process ended with status {code}" + (f" ({last})" if last else "")
        if code == -9:
            cause += ", most often because memory ran out"
        return error_message(PRTError(self.subject, cause, self.memory_remedy if code == -9 else self.remedy))


class CompletedBake:
    """Stands for the process of a bake that was complete before: its result lies in the job folder already."""

    finished = False
    subject, cancel_remedy = BakeProcess.subject, BakeProcess.cancel_remedy

    def poll(self) -> list[Message]:
        """The end, at once."""
        self.finished = True
        return [{"type": "done"}]

    def wait(self, _interval: float = 0.0) -> Iterator[Message]:
        """As `poll`."""
        yield from self.poll()

    def cancel(self) -> None:
        """Nothing runs."""


def error_message(error: PRTError) -> Message:
    """The "error" message that stands for a PRTError."""
    return {"type": "error", "subject": error.subject, "cause": error.cause, "remedy": error.remedy,
            "exit_code": error.exit_code}


def wheels_folder() -> str:
    """Where the extension's wheels lie: an isolated Python does not look there by itself."""
    return str(Path(scipy.__file__).resolve().parents[1])


def _environment() -> dict[str, str]:
    """The child's environment: BLAS on one thread, as the bake's own threads already fill the machine."""
    return {"OPENBLAS_NUM_THREADS": "1", **os.environ, "PYTHONIOENCODING": "utf-8"}


def _creation_flags() -> int:
    """Windows: no console window, and a lower priority (elsewhere the child lowers its own)."""
    if sys.platform != "win32":
        return 0
    return subprocess.CREATE_NO_WINDOW | subprocess.BELOW_NORMAL_PRIORITY_CLASS


def _last_line(path: Path) -> str:
    lines = path.read_text("utf-8", "replace").strip().splitlines()
    return lines[-1].strip()[:200] if lines else ""
