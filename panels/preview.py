# SPDX-License-Identifier: GPL-3.0-or-later
"""In the sidebar: the viewport's picture under the present light."""

from __future__ import annotations

import bpy

from .layout import Sidebar, wrapped

LOUD = ("outside the light cloud", "inside the hull")  # of lamps that light less than they seem to


class PRT_PT_preview(Sidebar, bpy.types.Panel):
    """The viewport's picture under the present light."""

    bl_idname = "PRT_PT_preview"
    bl_label = "Preview"

    def draw(self, context: bpy.types.Context) -> None:
        layout, session = self.layout, context.window_manager.prt
        layout.use_property_split = True
        layout.use_property_decorate = False
        layout.operator("prt.toggle_preview", text="Relight in Viewport", icon="SHADING_RENDERED",
                        depress=session.preview)
        column = layout.column()
        column.active = session.preview
        column.prop(context.scene.prt, "display")
        _explain(column, context)
        column.prop(context.scene.prt, "exposure")
        column.prop(context.scene.prt, "window")
        column.prop(context.scene.prt, "lamps_by_directions")
        row = column.row()
        row.active = bool(session.cloud)
        row.prop(context.scene.prt, "show_cloud")
        for line in session.preview_message.splitlines():
            wrapped(layout, context, line, "ERROR" if any(part in line for part in LOUD) else "INFO")
        if session.live_materials:
            wrapped(layout, context, session.live_materials, "MATERIAL")
        for line in session.viewport_message.splitlines():
            wrapped(layout, context, line, "INFO")
        layout.operator("prt.relight", icon="GROUP_VCOL")
        layout.operator("prt.light_images", icon="TEXTURE")


def _explain(layout: bpy.types.UILayout, context: bpy.types.Context) -> None:
    """Say what is missing for what is to be shown."""
    if context.scene.prt.display == "error":
        without = [line.name for line in context.window_manager.prt.objects if line.points and not line.receiver_errors]
        if without:
            more = f" and {len(without) - 1} more" if len(without) > 1 else ""
            wrapped(layout, context, f"{without[0]}{more}: baked before errors were kept, bake again to see them",
                    "INFO")
