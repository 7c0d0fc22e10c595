# SPDX-License-Identifier: GPL-3.0-or-later
"""What a job folder says about itself: whose bake it is, how it was asked for, and how it ended.

A record whose bake neither ended nor runs is of an interrupted one: Blender crashed, was killed, quit, or loaded
another file. It can go on.
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from ..errors import PRTError, StorageError
from ..storage.files import save_json
from .claims import is_free
from .job import job_summary
from .recipe import STAGES_FILE
from .settings import BakeSettings, check

RECORD_FILE = "record.json"
RECORD_SCHEMA = 1
RUNNING, CANCELLED, FAILED = "running", "cancelled", "failed"


@dataclass(frozen=True)
class JobRecord:
    """file: path of the .blend, "" for one never saved; scene, view_layer: names; objects: names of the targets.

    asked, selected: what `BakeSession.start` was given; settings: what was asked for, as `BakeSettings.as_dict`.
    digests, surroundings: of the scene when it was read. process: number of the Blender that bakes; started: the time
    (seconds since 1970). state: RUNNING until the bake is cancelled or fails; a stored bake has no folder any more.
    """

    file: str
    scene: str
    view_layer: str
    objects: tuple[str, ...]
    asked: tuple[str, ...] | None
    selected: tuple[str, ...]
    settings: dict[str, Any]
    digests: dict[str, dict[str, str | None]]
    surroundings: dict[str, str]
    process: int
    started: float
    state: str = RUNNING

    def bake_settings(self) -> BakeSettings:
        """The settings. Raises PRTError where another version wrote them."""
        try:
            return check(BakeSettings(**self.settings))
        except TypeError as error:
            raise StorageError("Bake", "it was begun by another version of the extension", "Bake again") from error


def write_record(folder: Path, record: JobRecord) -> None:
    """Write a folder's record. Raises StorageError."""
    save_json(folder / RECORD_FILE, {"schema": RECORD_SCHEMA, **asdict(record)})


def read_record(folder: Path) -> JobRecord | None:
    """A folder's record; None without one, and for one that is broken or of another version."""
    try:
        values = json.loads((folder / RECORD_FILE).read_text("utf-8"))
        if values.pop("schema") != RECORD_SCHEMA:
            return None
        lists = {name: values[name] if values[name] is None else tuple(values[name])
                 for name in ("objects", "asked", "selected")}
        return JobRecord(**{**values, **lists})
    except (OSError, ValueError, TypeError, KeyError, AttributeError):
        return None


def note_end(folder: Path, state: str) -> None:
    """Note that a bake was cancelled or failed, so that nobody is asked about it. Never raises: its folder may be gone,
    its disk full."""
    record = read_record(folder)
    try:
        if record is not None:
            write_record(folder, replace(record, state=state))
    except PRTError:
        return


def interrupted(root: Path) -> dict[Path, JobRecord]:
    """Interrupted bakes below `root` that can go on, the newest first."""
    found = {}
    for folder in root.glob("bake-*"):
        record = read_record(folder)
        if record is not None and record.state == RUNNING and is_free(folder):
            found[folder] = record
    return dict(sorted(found.items(), key=lambda item: -item[1].started))


def reached(folder: Path) -> tuple[str, int, int]:
    """The last finished stage of a job ("" before the first), its place among the stages counted from 1, and how many
    there are (0: not known yet)."""
    try:
        stages = list(json.loads((folder / STAGES_FILE).read_text("utf-8")))
    except (OSError, ValueError, TypeError):
        return "", 0, 0
    summary = job_summary(folder)
    if summary["complete"]:
        return stages[-1], len(stages), len(stages)
    places = [stages.index(name) for name in summary["finished"] if name in stages]
    last = max(places, default=-1)
    return (stages[last] if places else ""), last + 1, len(stages)
