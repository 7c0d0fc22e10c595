# SPDX-License-Identifier: GPL-3.0-or-later
"""In the properties editor, where artists look: an object's own bake, and what relighting takes from a World."""

from __future__ import annotations

from typing import ClassVar

import bpy

from .layout import wrapped
from .results import draw_object


class _Properties:
    bl_space_type = "PROPERTIES"
    bl_region_type = "WINDOW"
    bl_options: ClassVar[set[str]] = {"DEFAULT_CLOSED"}


class PRT_PT_object(_Properties, bpy.types.Panel):
    """Whether the active object is baked, how well, and whether that still holds."""

    bl_idname = "PRT_PT_object"
    bl_label = "Relighting"
    bl_context = "object"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return context.object is not None and context.object.type == "MESH"

    def draw(self, context: bpy.types.Context) -> None:
        layout, session = self.layout, context.window_manager.prt
        line = session.objects.get(context.object.name)
        if line is None:
            layout.label(text="Not baked", icon="INFO")
        else:
            draw_object(layout.column(align=True), context, line)
        if context.object.hide_render:
            wrapped(layout, context, "Hidden in renders: not baked, and without shadow or bounced light", "ERROR")
        bake = layout.operator("prt.bake", text="Bake Again" if line else "Bake", icon="RENDER_STILL")
        bake.objects = context.object.name


class PRT_PT_world(_Properties, bpy.types.Panel):
    """What the bakes get from this World, and how sharp it may be."""

    bl_idname = "PRT_PT_world"
    bl_label = "Relighting"
    bl_context = "world"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return context.world is not None

    def draw(self, context: bpy.types.Context) -> None:
        layout, session, settings = self.layout, context.window_manager.prt, context.scene.prt
        layout.use_property_split = True
        layout.use_property_decorate = False
        layout.operator("prt.toggle_preview", text="Relight in Viewport", icon="SHADING_RENDERED",
                        depress=session.preview)
        layout.prop(settings, "window")
        names = (context.world.name, f"World {context.world.name}")
        for text in session.preview_message.splitlines():
            if text.partition(": ")[0] in names:
                wrapped(layout, context, text.partition(": ")[2], "INFO")
