# SPDX-License-Identifier: GPL-3.0-or-later
"""In the sidebar, folded below the bake: whether the preview shall follow materials that are edited later."""

from __future__ import annotations

from typing import ClassVar

import bpy

from .layout import Sidebar


class PRT_PT_live_materials(Sidebar, bpy.types.Panel):
    """Bounced light that follows edits of materials."""

    bl_idname = "PRT_PT_live_materials"
    bl_label = "Live Materials"
    bl_parent_id = "PRT_PT_bake"
    bl_options: ClassVar[set[str]] = {"DEFAULT_CLOSED"}

    def draw_header(self, context: bpy.types.Context) -> None:
        self.layout.prop(context.scene.prt, "live_editing", text="")

    def draw(self, context: bpy.types.Context) -> None:
        settings, column = context.scene.prt, self.layout.column()
        column.use_property_split = True
        column.use_property_decorate = False
        column.active = settings.live_editing and settings.bounces
        column.prop(settings, "live_entries")
        if not settings.bounces:
            column.label(text="Needs Bounces", icon="INFO")
