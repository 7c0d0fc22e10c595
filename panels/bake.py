# SPDX-License-Identifier: GPL-3.0-or-later
"""In the sidebar: what to bake, with which settings, and how the bake goes."""

from __future__ import annotations

from typing import ClassVar

import bpy

from .jobs import draw_interrupted, draw_jobs, draw_messages
from .layout import Sidebar, wrapped


class PRT_PT_bake(Sidebar, bpy.types.Panel):
    """Targets, settings, the bake and its progress."""

    bl_idname = "PRT_PT_bake"
    bl_label = "Bake"

    def draw(self, context: bpy.types.Context) -> None:
        layout, settings, session = self.layout, context.scene.prt, context.window_manager.prt
        layout.use_property_split = True
        layout.use_property_decorate = False
        draw_interrupted(layout, context)
        layout.label(text=_targets(context), icon="MESH_DATA")
        column = layout.column()
        column.prop(settings, "preset")
        column.prop(settings, "lighting")
        distant = column.column()
        distant.active = settings.lighting != "local"  # lamps of a cloud know no order
        distant.prop(settings, "order")
        column.prop(settings, "bounces")
        row = layout.row(align=True)
        row.operator("prt.bake", text="Bake Next" if session.running else "Bake", icon="RENDER_STILL")
        row.operator("prt.analyze", icon="VIEWZOOM")
        draw_jobs(layout, context)
        draw_messages(layout, context)
        if session.analysis:
            box = layout.box()
            for line in session.analysis.splitlines():
                wrapped(box, context, line)


class _Expert(Sidebar):
    """A folded part of the bake's panel: what a preset has filled in, to be changed."""

    bl_parent_id = "PRT_PT_bake"
    bl_options: ClassVar[set[str]] = {"DEFAULT_CLOSED"}

    def column(self, _context: bpy.types.Context) -> bpy.types.UILayout:
        """A column for settings: of the next bake, while one runs."""
        self.layout.use_property_split = True
        self.layout.use_property_decorate = False
        return self.layout.column()


class PRT_PT_highlights(_Expert, bpy.types.Panel):
    """What shiny and translucent materials get."""

    bl_idname = "PRT_PT_highlights"
    bl_label = "Highlights"

    def draw(self, context: bpy.types.Context) -> None:
        settings, column = context.scene.prt, self.column(context)
        column.prop(settings, "glossy_rows")
        shiny = column.column()
        shiny.active = settings.glossy_rows != "0"
        shiny.prop(settings, "glossy_albedo")
        shiny.prop(settings, "glossy_window")
        column.prop(settings, "subsurface")
        coherent = column.column()
        coherent.active = settings.lighting == "environment"  # it would move receivers out of their zones
        coherent.prop(settings, "coherence")


class PRT_PT_local_lights(_Expert, bpy.types.Panel):
    """The cloud of lights that stands for lamps that move."""

    bl_idname = "PRT_PT_local_lights"
    bl_label = "Local Lights"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return context.scene.prt.lighting != "environment"

    def draw(self, context: bpy.types.Context) -> None:
        settings, column = context.scene.prt, self.column(context)
        column.prop(settings, "lamp_basis")
        by_cloud = settings.lamp_basis == "cloud"
        if not by_cloud:
            column.prop(settings, "surface_columns")
        column.prop(settings, "cloud_region")
        several = column.column()
        several.active = settings.cloud_region is None
        several.prop(settings, "cloud_collection")
        lights = column.column()
        lights.active = settings.cloud_spacing == 0.0
        lights.prop(settings, "cloud_lights")
        column.prop(settings, "cloud_spacing")
        if by_cloud:
            column.prop(settings, "merge_response")
            column.prop(settings, "zone_receivers")


def _targets(context: bpy.types.Context) -> str:
    count = sum(o.type == "MESH" for o in context.selected_objects)
    return "All visible meshes" if count == 0 else f"{count} selected mesh{'' if count == 1 else 'es'}"
