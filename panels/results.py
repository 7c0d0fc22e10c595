# SPDX-License-Identifier: GPL-3.0-or-later
"""In the sidebar: what came out of the bakes."""

from __future__ import annotations

from typing import ClassVar

import bpy

from .layout import Sidebar, plural, wrapped

ROWS = 20  # of results: more make the sidebar slow and nobody reads them


class PRT_PT_results(Sidebar, bpy.types.Panel):
    """Baked objects, with a warning where one was edited since."""

    bl_idname = "PRT_PT_results"
    bl_label = "Baked Objects"

    def draw(self, context: bpy.types.Context) -> None:
        layout, session = self.layout, context.window_manager.prt
        if not session.objects:
            layout.label(text="Nothing is baked yet", icon="INFO")
            return
        if session.cloud:
            box = layout.box().column(align=True)
            for number, line in enumerate(session.cloud.splitlines()):
                box.label(text=line, icon="BLANK1" if number else "LIGHT")
        column = layout.box().column(align=True)
        for line in session.objects[:ROWS]:
            draw_object(column, context, line)
        if len(session.objects) > ROWS:
            column.label(text=f"and {len(session.objects) - ROWS} more", icon="BLANK1")
        layout.operator("prt.clear", icon="TRASH")


class PRT_PT_last_bake(Sidebar, bpy.types.Panel):
    """Where the time of the last bake went, how large its errors are, what it left out."""

    bl_idname = "PRT_PT_last_bake"
    bl_label = "Last Bake"
    bl_parent_id = "PRT_PT_results"
    bl_options: ClassVar[set[str]] = {"DEFAULT_CLOSED"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return bool(context.window_manager.prt.last_bake)

    def draw(self, context: bpy.types.Context) -> None:
        column = self.layout.column(align=True)
        for line in context.window_manager.prt.last_bake.splitlines():
            kind, share, text = line.split("\t", 2)
            if kind in ("stage", "error"):
                column.progress(factor=float(share), text=text)
            elif kind == "heading":
                column.separator()
                column.label(text=text)
            else:
                wrapped(column, context, text, "REMOVE" if kind == "left_out" else "TIME")
                column.separator()


def draw_object(column: bpy.types.UILayout, context: bpy.types.Context, line: bpy.types.PropertyGroup) -> None:
    """One baked object in a few rows: how much data, how exact, and whether it still holds."""
    row = column.row()
    row.label(text=line.name, icon="ERROR" if line.stale else "CHECKMARK")
    row.label(text=plural(line.points, "receiver") if line.points else "not readable")
    for details in _details(line):
        column.label(text=details, icon="BLANK1")
    if line.stale:
        wrapped(column, context, line.stale[0].upper() + line.stale[1:], "BLANK1", alert=True)


def _details(line: bpy.types.PropertyGroup) -> list[str]:
    """What came out for one object, in short lines."""
    lines = [plural(line.clusters, "cluster")] * bool(line.clusters)
    errors = ((line.error, "diffuse"), (line.highlight_error, "highlight"), (line.lamp_error, "lamps'"),
              (line.lamp_highlight_error, "lamps' highlight"))
    lines += [f"{part} error {100.0 * value:.2f} %" for value, part in errors if value >= 0.0]
    if line.overdraw > 0.0:
        lines.append(f"overdraw {line.overdraw_before:.2f} to {line.overdraw:.2f}")
        lines.append(f"for {100.0 * line.error_spent:.1f} % of squared error")
    return lines
