# SPDX-License-Identifier: GPL-3.0-or-later
"""In a lamp's own properties: what the preview does not show of it, beside what the artist sets."""

from __future__ import annotations

import bpy

from .layout import wrapped


class PRT_PT_lamp(bpy.types.Panel):
    """What is not as in a render: outside of the light cloud, options left out."""

    bl_idname = "PRT_PT_lamp"
    bl_label = "Relighting"
    bl_space_type = "PROPERTIES"
    bl_region_type = "WINDOW"
    bl_context = "data"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return context.object is not None and context.object.type == "LIGHT" and bool(_notes(context))

    def draw(self, context: bpy.types.Context) -> None:
        for note in _notes(context):
            wrapped(self.layout, context, note[0].upper() + note[1:], "ERROR")


def _notes(context: bpy.types.Context) -> list[str]:
    """The preview's messages about the active lamp."""
    names = (context.object.name, context.object.data.name)
    lines = context.window_manager.prt.preview_message.splitlines()
    return [line.partition(": ")[2] for line in lines if line.partition(": ")[0] in names]
