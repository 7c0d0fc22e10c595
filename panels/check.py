# SPDX-License-Identifier: GPL-3.0-or-later
"""In the sidebar: how right the bakes are, measured with Cycles, and taking them elsewhere."""

from __future__ import annotations

import bpy

from .layout import Sidebar, wrapped


class PRT_PT_check(Sidebar, bpy.types.Panel):
    """Compare with Cycles, read the report, export."""

    bl_idname = "PRT_PT_check"
    bl_label = "Check and Export"

    def draw(self, context: bpy.types.Context) -> None:
        layout, settings, session = self.layout, context.scene.prt, context.window_manager.prt
        layout.use_property_split = True
        layout.use_property_decorate = False
        column = layout.column()
        column.prop(settings, "compare_samples")
        column.prop(settings, "compare_percentage")
        column.operator("prt.compare", icon="CAMERA_STEREO")
        if session.comparison:
            box = layout.box()
            for number, line in enumerate(session.comparison.splitlines()):
                wrapped(box, context, line, "NONE" if number else "INFO")
        row = layout.row(align=True)
        row.operator("prt.show_report", icon="URL")
        row.operator("prt.write_report", icon="FILE_TICK")
        layout.operator("prt.export", icon="EXPORT")
