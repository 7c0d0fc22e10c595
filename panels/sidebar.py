# SPDX-License-Identifier: GPL-3.0-or-later
"""The 3D viewport's sidebar tab "PRT": what to bake, how it goes, what came out."""

from __future__ import annotations

import textwrap
from typing import ClassVar

import bpy

CHARACTERS_PER_WIDTH = 0.15  # of the interface font at scale 1, per pixel of region width
MARGIN = 60  # pixels of a region that hold no text: icon, borders
ROWS = 20  # of results: more make the sidebar slow and nobody reads them


class _Sidebar:
    bl_space_type = "VIEW_3D"
    bl_region_type = "UI"
    bl_category = "PRT"


class PRT_PT_bake(_Sidebar, bpy.types.Panel):
    """Targets, settings, the bake and its progress."""

    bl_idname = "PRT_PT_bake"
    bl_label = "Bake"

    def draw(self, context: bpy.types.Context) -> None:
        layout, settings, session = self.layout, context.scene.prt, context.window_manager.prt
        layout.use_property_split = True
        layout.use_property_decorate = False
        layout.label(text=_targets(context), icon="MESH_DATA")
        column = layout.column()
        column.enabled = not session.running
        column.prop(settings, "preset")
        column.prop(settings, "lighting")
        distant = column.column()
        distant.active = settings.lighting != "local"  # lamps of a cloud know no order
        distant.prop(settings, "order")
        column.prop(settings, "bounces")
        if session.running:
            layout.label(text=session.stage)
            layout.progress(factor=session.fraction, text=_progress(session))
            layout.operator("prt.cancel", icon="CANCEL")
        else:
            row = layout.row(align=True)
            row.operator("prt.bake", text="Bake", icon="RENDER_STILL")
            row.operator("prt.analyze", icon="VIEWZOOM")
        if session.message:
            wrapped(layout, context, session.message, "ERROR" if session.failed else "INFO", session.failed)
        if session.analysis:
            box = layout.box()
            for line in session.analysis.splitlines():
                wrapped(box, context, line)


class _Expert(_Sidebar):
    """A folded part of the bake's panel: what a preset has filled in, to be changed."""

    bl_parent_id = "PRT_PT_bake"
    bl_options: ClassVar[set[str]] = {"DEFAULT_CLOSED"}

    def column(self, context: bpy.types.Context) -> bpy.types.UILayout:
        """A column for settings, greyed while a bake runs."""
        self.layout.use_property_split = True
        self.layout.use_property_decorate = False
        column = self.layout.column()
        column.enabled = not context.window_manager.prt.running
        return column


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


class PRT_PT_preview(_Sidebar, bpy.types.Panel):
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
        column.prop(context.scene.prt, "exposure")
        column.prop(context.scene.prt, "window")
        for line in session.preview_message.splitlines():
            wrapped(layout, context, line, "ERROR" if "outside the light cloud" in line else "INFO")
        for line in session.viewport_message.splitlines():
            wrapped(layout, context, line, "INFO")
        layout.operator("prt.relight", icon="GROUP_VCOL")


class PRT_PT_results(_Sidebar, bpy.types.Panel):
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
            row = column.row()
            row.label(text=line.name, icon="ERROR" if line.stale else "CHECKMARK")
            row.label(text=_plural(line.points, "receiver") if line.points else "not readable")
            for details in _details(line):
                column.label(text=details, icon="BLANK1")
            if line.stale:
                wrapped(column, context, line.stale[0].upper() + line.stale[1:], "BLANK1", alert=True)
        if len(session.objects) > ROWS:
            column.label(text=f"and {len(session.objects) - ROWS} more", icon="BLANK1")
        layout.operator("prt.clear", icon="TRASH")


def _details(line: bpy.types.PropertyGroup) -> list[str]:
    """What came out for one object, in short lines."""
    lines = [_plural(line.clusters, "cluster")] * bool(line.clusters)
    errors = ((line.error, "diffuse"), (line.highlight_error, "highlight"), (line.lamp_error, "lamps'"),
              (line.lamp_highlight_error, "lamps' highlight"))
    lines += [f"{part} error {100.0 * value:.2f} %" for value, part in errors if value >= 0.0]
    if line.overdraw > 0.0:
        lines.append(f"overdraw {line.overdraw_before:.2f} to {line.overdraw:.2f}")
        lines.append(f"for {100.0 * line.error_spent:.1f} % of squared error")
    return lines


def _plural(count: int, what: str) -> str:
    return f"{count:,} {what}{'' if count == 1 else 's'}"


def _targets(context: bpy.types.Context) -> str:
    count = sum(o.type == "MESH" for o in context.selected_objects)
    return "All visible meshes" if count == 0 else f"{count} selected mesh{'' if count == 1 else 'es'}"


def _progress(session: bpy.types.PropertyGroup) -> str:
    text = f"{100.0 * session.fraction:.0f} %"
    return text if session.seconds_left < 0.0 else f"{text}, {session.seconds_left:.0f} s left"


def wrapped(layout: bpy.types.UILayout, context: bpy.types.Context, text: str, icon: str = "NONE",
             alert: bool = False) -> None:
    """A text over as many lines as the sidebar's width asks for: labels are clipped otherwise."""
    scale = context.preferences.system.ui_scale
    width = max(16, int((context.region.width - MARGIN * scale) * CHARACTERS_PER_WIDTH / scale))
    column = layout.column(align=True)
    column.alert = alert
    for number, line in enumerate(textwrap.wrap(text, width)):
        column.label(text=line, icon=icon if number == 0 else "BLANK1" if icon != "NONE" else "NONE")
