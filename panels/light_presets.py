# SPDX-License-Identifier: GPL-3.0-or-later
"""In the sidebar: light presets with their thumbnails, the lights beside each other, and relighting animations."""

from __future__ import annotations

from typing import ClassVar

import bpy

from .layout import Sidebar, wrapped

THUMBNAIL_SCALE = 5.5
NARROW = 230  # pixels of a region below which thumbnails stand below each other
MOST_LIGHTS = 40  # rows: more make the sidebar slow


class PRT_PT_light_presets(Sidebar, bpy.types.Panel):
    """Named light set-ups, each applied by one click."""

    bl_idname = "PRT_PT_light_presets"
    bl_label = "Light Presets"

    def draw(self, context: bpy.types.Context) -> None:
        layout, lighting = self.layout, context.scene.prt_light
        if not lighting.presets:
            wrapped(layout, context, "Set the light up, then store it: a click brings it back", "LIGHT")
        scale = context.preferences.system.ui_scale
        columns = 1 if context.region.width < NARROW * scale else 2
        grid = layout.grid_flow(row_major=True, columns=columns, even_columns=True, even_rows=False, align=False)
        chosen = lighting.presets[lighting.active] if 0 <= lighting.active < len(lighting.presets) else None
        modified = chosen is not None and lighting.modified
        for preset in lighting.presets:
            _thumbnail(grid.box().column(align=True), preset, preset == chosen, modified)
        row = layout.row(align=True)
        row.operator("prt.light_preset_add", text="Add", icon="ADD")
        if lighting.presets:
            row.operator("prt.light_preset_update", text="Update", icon="FILE_REFRESH")
            row.operator("prt.light_preset_remove", text="", icon="REMOVE")
        if chosen is not None:
            layout.prop(chosen, "name", text="", icon="GREASEPENCIL")


class _Part(Sidebar):
    """A folded part of the light presets' panel."""

    bl_parent_id = "PRT_PT_light_presets"
    bl_options: ClassVar[set[str]] = {"DEFAULT_CLOSED"}


class PRT_PT_lights(_Part, bpy.types.Panel):
    """Every light in a row: alone, on or off, color, power."""

    bl_idname = "PRT_PT_lights"
    bl_label = "Lights"
    bl_options: ClassVar[set[str]] = set()

    def draw(self, context: bpy.types.Context) -> None:
        scene, lighting = context.scene, context.scene.prt_light
        if scene.world is not None:
            _world(self.layout.column(align=True), scene.world, lighting)
        lights = [found for found in scene.objects if found.type == "LIGHT"]
        column = self.layout.column(align=True)
        for light in lights[:MOST_LIGHTS]:
            _light(column.row(align=True), light, lighting)
        if len(lights) > MOST_LIGHTS:
            column.label(text=f"and {len(lights) - MOST_LIGHTS} more")
        if not lights and scene.world is None:
            self.layout.label(text="The scene has no light", icon="INFO")
        if lighting.soloing:
            self.layout.operator("prt.light_solo_end", icon="LOOP_BACK")


class PRT_PT_light_animation(_Part, bpy.types.Panel):
    """Keyframes of the light, and colors that follow them."""

    bl_idname = "PRT_PT_light_animation"
    bl_label = "Animation"

    def draw(self, context: bpy.types.Context) -> None:
        layout, scene = self.layout, context.scene
        layout.operator("prt.keyframe_light", icon="KEY_HLT")
        layout.prop(scene.prt_light, "follow_frames")
        if not scene.prt_light.follow_frames:
            return
        column = layout.column()
        column.prop(scene.render, "use_lock_interface")
        if not scene.render.use_lock_interface:
            wrapped(column, context, "Renders out of this window leave the colors as they are until it is on", "INFO")
        if scene.prt_light.follow_message:
            wrapped(column, context, scene.prt_light.follow_message, "ERROR", alert=True)


def _thumbnail(column: bpy.types.UILayout, preset: bpy.types.PropertyGroup, is_chosen: bool, modified: bool) -> None:
    """A preset's picture over the button that applies it."""
    if preset.icon:
        column.template_icon(icon_value=preset.icon, scale=THUMBNAIL_SCALE)
    else:
        empty = column.row()
        empty.alignment, empty.scale_y = "CENTER", THUMBNAIL_SCALE
        empty.label(text="No preview", icon="LIGHT")
    text = f"{preset.name} *" if is_chosen and modified else preset.name
    column.operator("prt.light_preset_apply", text=text, depress=is_chosen).name = preset.name


def _world(column: bpy.types.UILayout, world: bpy.types.World, lighting: bpy.types.PropertyGroup) -> None:
    """The World's row: alone, strength, rotation of its HDRI."""
    row = column.row(align=True)
    alone = lighting.soloing and lighting.solo is None
    row.operator("prt.light_solo", text="", icon="SOLO_ON" if alone else "SOLO_OFF", depress=alone).name = ""
    row.label(text=world.name, icon="WORLD")
    if world.node_tree is None:
        row.prop(world, "color", text="")
        return
    background, mapping = world.node_tree.nodes.get(lighting.background), world.node_tree.nodes.get(lighting.mapping)
    if background is not None and not background.inputs["Strength"].is_linked:
        if not background.inputs["Color"].is_linked:
            colour = row.row(align=True)
            colour.ui_units_x = 1.5
            colour.prop(background.inputs["Color"], "default_value", text="")
        row.prop(background.inputs["Strength"], "default_value", text="")
    if mapping is not None and not mapping.inputs["Rotation"].is_linked:
        column.prop(mapping.inputs["Rotation"], "default_value", index=2, text="HDRI Rotation")


def _light(row: bpy.types.UILayout, light: bpy.types.Object, lighting: bpy.types.PropertyGroup) -> None:
    """A light's row: alone, on or off, name, color, power."""
    alone = lighting.soloing and lighting.solo == light
    row.operator("prt.light_solo", text="", icon="SOLO_ON" if alone else "SOLO_OFF",
                 depress=alone).name = light.name_full
    row.operator("prt.light_switch", text="", depress=not light.hide_render,
                 icon="OUTLINER_OB_LIGHT" if not light.hide_render else "LIGHT_DATA").name = light.name_full
    values = row.row(align=True)
    values.active = not light.hide_render
    values.label(text=light.name)
    colour = values.row(align=True)
    colour.ui_units_x = 1.5
    colour.prop(light.data, "color", text="")
    values.prop(light.data, "energy", text="")
