# SPDX-License-Identifier: GPL-3.0-or-later
"""The camera's view rendered by Cycles in a child process: what baked light is compared with.

The child works on a copy of the file as it is at this moment. Blender stays usable, and neither the file, its settings
nor the render result that the artist looks at are touched.
"""

from __future__ import annotations

import json
import shutil
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

import bpy
import numpy as np
from numpy.typing import NDArray

from ..baking.process import ERROR_FILE, MESSAGE_FILE, BakeProcess, Message
from ..errors import PRTError, StorageError

WORKER = Path(__file__).with_name("cycles_worker.py")
MOST_PARTS = 6  # of a render, for its progress: each costs the start of one


def parts_of(samples: int) -> tuple[int, int]:
    """In how many renders, an even number, about so many samples are taken; and how many these are in all."""
    parts = max(2, min(MOST_PARTS, samples // 16 * 2))
    return parts, -(-samples // parts) * parts


@dataclass(frozen=True)
class GroundTruth:
    """Pictures with row 0 on top; h, w: height and width.

    halves: two independent renders (h, w, 3) float32, scene-linear; objects: (h, w) int32, the place plus 1 in the list
    that was asked for of what the centre of each pixel shows, 0 for anything else; depth: (h, w) float32; alpha:
    (h, w, 1) float32, 0 where the sky is seen; samples: of both together; seconds: that they took.
    """

    halves: tuple[NDArray[np.float32], NDArray[np.float32]]
    objects: NDArray[np.int32]
    depth: NDArray[np.float32]
    alpha: NDArray[np.float32]
    samples: int
    seconds: float


class RenderProcess(BakeProcess):
    """One render in a child process. Its folder goes with it, but for a result that is still to be read."""

    subject = "Compare"
    remedy = "Nothing was changed; check that a render with Cycles works"
    memory_remedy = "Choose a smaller size"
    lost_remedy = "Compare again, and leave the folder alone"
    cancel_remedy = "Compare again when you like"
    done = False

    def start(self) -> None:
        """Start the child. PRTError when Blender can't be started once more."""
        (self.job / MESSAGE_FILE).touch()  # the child appends to it: stdout has Blender's own chatter
        with open(self.job / ERROR_FILE, "wb") as chatter:
            self._start([*self.python_command, str(WORKER), "--", str(self.job)], chatter, chatter)

    def poll(self) -> list[Message]:
        """See `BakeProcess.poll`."""
        messages = super().poll()
        self.done = self.done or any(message["type"] == "done" for message in messages)
        return messages

    def cancel(self) -> None:
        """Stop the child now; nothing of it is worth keeping, but what is done. May be called twice."""
        if self.process is not None and self.process.poll() is None:
            self.process.kill()  # a render in the middle of a sample takes its time to end politely
        super().cancel()
        self._close()
        self.finished = True
        if not self.done:
            self.discard()

    def discard(self) -> None:
        """Drop the folder."""
        shutil.rmtree(self.job, ignore_errors=True)


def start_render(scene: bpy.types.Scene, view_layer: bpy.types.ViewLayer, names: list[str], size: tuple[int, int],
                 parts: int, samples: int, seed: int = 0) -> RenderProcess:
    """Begin to render the active camera's view, size (width, height), with so many samples in each pixel, in so many
    parts (`parts_of`).

    names: of the objects that `GroundTruth.objects` tells apart. Poll the result until it is finished, then
    `read_render` it. Raises PRTError where Cycles is missing, StorageError where the copy can't be written.
    """
    if not hasattr(scene, "cycles"):
        raise PRTError("Cycles", "it is switched off, and it is what bakes are compared with",
                       "Enable the Cycles Render Engine in Preferences, Add-ons")
    job = Path(tempfile.mkdtemp(prefix="prt-compare-", dir=bpy.app.tempdir or None))
    try:
        bpy.ops.wm.save_as_mainfile(filepath=str(job / "scene.blend"), copy=True, check_existing=False, compress=False)
        request = {"scene": scene.name, "view_layer": view_layer.name, "objects": names, "size": list(size),
                   "samples": samples, "parts": parts, "seed": seed}
        (job / "request.json").write_text(json.dumps(request), "utf-8")
        process = RenderProcess(blender_command(), job)
        process.start()
        return process
    except (RuntimeError, OSError) as error:
        shutil.rmtree(job, ignore_errors=True)
        text = " ".join(str(error).removeprefix("Error:").split()).rstrip(".")
        raise StorageError("Compare", f"a copy of the file can't be written to {job.parent} ({text})",
                           "Free some space, or set another temporary folder in Preferences, File Paths") from error
    except BaseException:
        shutil.rmtree(job, ignore_errors=True)
        raise


def read_render(process: RenderProcess, samples: int) -> GroundTruth:
    """What a finished render left. Raises StorageError where it is missing."""
    try:
        with np.load(process.job / "result.npz", allow_pickle=False) as arrays:
            first, second = arrays["half_0"], arrays["half_1"]
            return GroundTruth((first[..., :3], second[..., :3]), arrays["objects"], arrays["depth"],
                               0.5 * (first[..., 3:] + second[..., 3:]), samples, float(arrays["seconds"]))
    except (OSError, ValueError, KeyError) as error:
        raise StorageError("Compare", f"the render left no picture ({error})", "Compare again") from error


def blender_command() -> list[str]:
    """What starts Blender once more, without a window and without anybody's preferences; a script's path follows."""
    if bpy.app.module:
        return [sys.executable]
    return [bpy.app.binary_path, "--background", "--factory-startup", "--disable-autoexec", "--python-exit-code", "1",
            "--python"]
