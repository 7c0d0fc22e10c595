# SPDX-License-Identifier: GPL-3.0-or-later
"""prt.write_report and prt.show_report: how right the last bake is, and where its time went."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import bpy

from ..prt_addon.blender.stored_report import PROPERTY, stored_report
from ..prt_addon.errors import BadArguments, BadScene, PRTError
from ..prt_addon.reporting.html_report import render
from ..prt_addon.reporting.report_file import write_report
from ..prt_addon.storage.files import write_atomically
from .arguments import path_of

PAGES = (".html", ".htm")


def save_report(path: Path, report: dict[str, Any]) -> None:
    """Write a report as a page or as JSON, as the name asks for. Raises BadArguments, StorageError."""
    if path.suffix.lower() in PAGES:
        page = render(report).encode()
        write_atomically(path, lambda stream: stream.write(page) and None)
    elif path.suffix.lower() == ".json":
        write_report(path, report)
    else:
        raise BadArguments(str(path), "the name does not end in .html or .json", "Give a fitting name")


class _Report:
    """What both operators need: the report of the scene's last bake."""

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        if PROPERTY not in context.scene:
            cls.poll_message_set("No bake of this scene has left a report: bake first")
            return False
        return True

    def save(self, context: bpy.types.Context, path: Path) -> bool:
        """Write it to a path; whether that worked."""
        try:
            report = stored_report(context.scene)
            if report is None:
                raise BadScene(context.scene.name, "no bake has left a report", "Bake it")
            save_report(path, report)
        except PRTError as error:
            self.report({"ERROR"}, str(error))
            return False
        return True


class PRT_OT_write_report(_Report, bpy.types.Operator):
    """Save the report of the last bake: as a page to read (.html) or as numbers for scripts (.json). Costs nothing"""

    bl_idname = "prt.write_report"
    bl_label = "Save Report"

    filepath: bpy.props.StringProperty(
        name="File", subtype="FILE_PATH", options={"SKIP_SAVE"}, description="A name that ends in .html or .json",
    )
    filter_glob: bpy.props.StringProperty(default="*.html;*.json", options={"HIDDEN", "SKIP_SAVE"})
    check_existing: bpy.props.BoolProperty(default=True, options={"HIDDEN", "SKIP_SAVE"})

    def invoke(self, context: bpy.types.Context, _event: bpy.types.Event) -> set[str]:
        if not self.filepath:
            self.filepath = str(Path(bpy.data.filepath or "scene.blend").with_suffix(".html"))
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    def execute(self, context: bpy.types.Context) -> set[str]:
        path = path_of(self.filepath)
        if not self.save(context, path):
            return {"CANCELLED"}
        self.report({"INFO"}, f"Saved {path}")
        return {"FINISHED"}


class PRT_OT_show_report(_Report, bpy.types.Operator):
    """Open the report of the last bake in the web browser: errors, stages and what was left out. Costs nothing"""

    bl_idname = "prt.show_report"
    bl_label = "Show Report"

    def execute(self, context: bpy.types.Context) -> set[str]:
        path = Path(bpy.app.tempdir or tempfile.gettempdir()) / "prt_report.html"
        if not self.save(context, path):
            return {"CANCELLED"}
        if not bpy.app.background:
            bpy.ops.wm.url_open(url=path.as_uri())
        self.report({"INFO"}, f"The report is {path}")
        return {"FINISHED"}
