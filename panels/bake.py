# SPDX-License-Identifier: GPL-3.0-or-later
"""In the sidebar: what to bake, with which settings, and how the bake goes."""

from __future__ import annotations

import bpy

from .jobs import draw_interrupted, draw_jobs, draw_messages
from .layout import Sidebar, plural, wrapped

CASTING = "more mesh casts shadows and bounces", "more meshes cast shadows and bounce"  # one, several
SIZES = {"sh": "order", "cubemap": "cubemap_size", "auto": "light_error"}  # what a kind of sky is made finer by
NAMES = 3  # of objects that are told
TOLD_AS = {"Left out:": "REMOVE", "Bake:": "ERROR"}  # icons of an analysis' lines by how they start


class PRT_PT_bake(Sidebar, bpy.types.Panel):
    """Targets, settings, the bake and its progress."""

    bl_idname = "PRT_PT_bake"
    bl_label = "Bake"

    def draw(self, context: bpy.types.Context) -> None:
        layout, settings, session = self.layout, context.scene.prt, context.window_manager.prt
        layout.use_property_split = True
        layout.use_property_decorate = False
        draw_interrupted(layout, context)
        column = layout.column()
        column.prop(settings, "targets")
        if settings.targets == "collection":
            column.prop(settings, "target_collection")
        told = layout.column(align=True)
        for line, icon in _what_is_baked(context):
            wrapped(told, context, line, icon)
        column = layout.column()
        column.prop(settings, "preset")
        column.prop(settings, "lighting")
        for line in _light_warnings(context):
            wrapped(column, context, line, "ERROR")
        distant = column.column()
        distant.active = settings.lighting != "local"  # columns of lamps know no order
        distant.prop(settings, "distant_basis")
        distant.prop(settings, SIZES[settings.distant_basis])
        column.prop(settings, "bounces")
        row = layout.row(align=True)
        row.operator("prt.bake", text="Bake Next" if session.running else "Bake", icon="RENDER_STILL")
        row.operator("prt.analyze", icon="VIEWZOOM")
        draw_jobs(layout, context)
        draw_messages(layout, context)
        if session.analysis:
            box = layout.box()
            for number, line in enumerate(session.analysis.splitlines()):
                icon = next((i for start, i in TOLD_AS.items() if line.startswith(start)), "INFO")
                wrapped(box, context, line[0].upper() + line[1:], "TIME" if number == 0 else icon)


def _what_is_baked(context: bpy.types.Context) -> list[tuple[str, str]]:
    """What gets transfer, and what only casts shadows and bounces light: lines and their icons."""
    settings = context.scene.prt
    shown = [o for o in context.scene.objects if o.type == "MESH" and not o.hide_render]
    if settings.targets == "collection":
        if settings.target_collection is None:
            return [("Choose a collection", "ERROR")]
        chosen = [o for o in settings.target_collection.all_objects if o.type == "MESH" and not o.hide_render]
        if not chosen:
            return [(f"No mesh of {settings.target_collection.name} is shown in renders", "ERROR")]
    else:
        chosen = [o for o in context.selected_objects if o.type == "MESH"] or shown
    if not chosen:
        return [("No mesh is shown in renders", "ERROR")]
    names = ", ".join(o.name for o in chosen[:NAMES]) + (f" and {len(chosen) - NAMES} more" * (len(chosen) > NAMES))
    others = len(shown) - len(chosen)
    if others <= 0:
        return [(names, "MESH_DATA")]
    return [(names, "MESH_DATA"), (f"{plural(others, *CASTING)} light", "LIGHT_SUN")]


def _light_warnings(context: bpy.types.Context) -> list[str]:
    """What is missing for the chosen kind of lighting."""
    settings = context.scene.prt
    if settings.lighting == "environment":
        return []
    lamps = any(o.type == "LIGHT" and o.data.type != "SUN" and not o.hide_render for o in context.scene.objects)
    if lamps or settings.cloud_region is not None or settings.cloud_collection is not None:
        return []
    return ["No lamp is in the scene: add one, or choose the region where lamps will move"]


def _progress(session: bpy.types.PropertyGroup) -> str:
    text = f"{100.0 * session.fraction:.0f} %"
    return text if session.seconds_left < 0.0 else f"{text}, {session.seconds_left:.0f} s left"
