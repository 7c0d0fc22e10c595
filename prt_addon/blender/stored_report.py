# SPDX-License-Identifier: GPL-3.0-or-later
"""The report of a scene's last bake, kept with the scene, so that it can be read after the file was closed.

A custom property of JSON text, of some kilobytes. Undo takes it back along with the bake that it is of.
"""

from __future__ import annotations

import json
from typing import Any

import bpy

from ..errors import StorageError
from ..reporting.report_file import problem_of

PROPERTY = "prt_report"


def store_report(scene: bpy.types.Scene, report: dict[str, Any]) -> None:
    """Keep a report in place of the previous one; a scene of another file keeps none."""
    if scene.library is None:
        scene[PROPERTY] = json.dumps(report)


def stored_report(scene: bpy.types.Scene) -> dict[str, Any] | None:
    """The report of the scene's last bake; None without one. Raises StorageError where it was tampered with."""
    return read_stored_report(scene.get(PROPERTY), scene.name)


def read_stored_report(text: object, scene_name: str) -> dict[str, Any] | None:
    """The report that a property's value holds; None where it is missing or empty. Raises StorageError."""
    if text is None or text == "":
        return None
    try:
        report = json.loads(text)
    except (TypeError, ValueError) as error:
        raise StorageError(scene_name, "the report of its last bake is no JSON text", "Bake again") from error
    problem = problem_of(report)
    if problem is not None:
        raise StorageError(scene_name, f"the report of its last bake is not readable ({problem})", "Bake again")
    return report


def clear_report(scene: bpy.types.Scene) -> None:
    """Drop the report."""
    if PROPERTY in scene:
        del scene[PROPERTY]
