# SPDX-License-Identifier: GPL-3.0-or-later
"""One bake from a scene to stored data, around the child process: for the operator and for the command alike.

The scene is read here (only Blender's process can), baked in the child, and stored here, only when the child's result
is complete. Whatever ends a bake earlier leaves previous bakes as they are and finished stages in the job folder.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import bpy

from ..prt_addon.baking import job as jobs
from ..prt_addon.baking.process import BakeProcess
from ..prt_addon.baking.recipe import BakeResult, analyze
from ..prt_addon.baking.settings import BakeSettings
from ..prt_addon.blender.read_scene import read_objects
from ..prt_addon.blender.stored import write_baked
from ..prt_addon.errors import BadScene
from ..prt_addon.scene.scene_mesh import SceneMesh

ROOT_PACKAGE = __package__.rpartition(".")[0]


def jobs_folder() -> Path:
    """Where job folders lie: the extension's own user folder, or Blender's for a checkout without installation."""
    if ROOT_PACKAGE.startswith("bl_ext."):
        return Path(bpy.utils.extension_path_user(ROOT_PACKAGE, path="jobs", create=True))
    return Path(bpy.utils.user_resource("DATAFILES", path="prt/jobs", create=True))


def read_scene(scene: bpy.types.Scene, settings: BakeSettings, targets: Sequence[str] | None) -> SceneMesh:
    """The scene as it is traced. targets: names of the objects to bake, None for every visible mesh."""
    names = None if targets is None else list(targets)
    return SceneMesh.assemble(read_objects(scene, names), settings.spacing)


def analyze_scene(scene: bpy.types.Scene, settings: BakeSettings, targets: Sequence[str] | None) -> dict[str, Any]:
    """What a bake of the scene would need, leave out and cost: see `baking.recipe.analyze`."""
    return analyze(read_scene(scene, settings, targets), settings)


@dataclass
class BakeSession:
    """A bake under way. Poll `process` until it is finished, then `finish`."""

    job: Path
    process: BakeProcess
    started: float

    @staticmethod
    def start(scene: bpy.types.Scene, settings: BakeSettings, targets: Sequence[str] | None) -> BakeSession:
        """Read the scene and start its bake in a child process. Raises PRTError."""
        started = time.monotonic()
        job = jobs.write_job(jobs_folder(), read_scene(scene, settings, targets), settings)
        process = BakeProcess([sys.executable, *bpy.app.python_args], job)
        process.start()
        return BakeSession(job, process, started)

    @property
    def seconds(self) -> float:
        """Since the start, reading the scene included."""
        return time.monotonic() - self.started

    def finish(self) -> BakeResult:
        """Store the child's complete result in the file's data and drop the job folder. Raises PRTError.

        Call it after the "done" message. Every object is looked up before the first is written, so that either all
        are replaced or none.
        """
        result = jobs.read_result(self.job)
        objects = {name: bpy.data.objects.get(name) for name in result.objects}
        missing = [name for name, found in objects.items() if found is None]
        if missing:
            raise BadScene(missing[0], "it was removed or renamed while its bake ran", "Undo that, or bake again")
        for name, baked in result.objects.items():
            write_baked(objects[name], baked)
        jobs.discard(self.job)
        return result
