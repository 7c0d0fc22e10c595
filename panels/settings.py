# SPDX-License-Identifier: GPL-3.0-or-later
"""In the sidebar, folded below the bake: every setting that a preset fills in or a scene may need."""

from __future__ import annotations

from typing import ClassVar

import bpy

from .layout import Sidebar


class _Expert(Sidebar):
    """A folded part of the bake's panel: what a preset has filled in, to be changed."""

    bl_parent_id = "PRT_PT_bake"
    bl_options: ClassVar[set[str]] = {"DEFAULT_CLOSED"}

    def column(self, _context: bpy.types.Context) -> bpy.types.UILayout:
        """A column for settings: of the next bake, while one runs."""
        self.layout.use_property_split = True
        self.layout.use_property_decorate = False
        return self.layout.column()


class PRT_PT_rays(_Expert, bpy.types.Panel):
    """How exactly shadows and bounces are found."""

    bl_idname = "PRT_PT_rays"
    bl_label = "Rays"

    def draw(self, context: bpy.types.Context) -> None:
        settings, column = context.scene.prt, self.column(context)
        column.prop(settings, "directions")
        bounced = column.column()
        bounced.active = settings.bounces
        bounced.prop(settings, "gather_directions")
        bounced.prop(settings, "bounce_error")
        column.prop(settings, "receivers")
        texels = column.column()
        texels.active = settings.receivers != "vertices"
        texels.prop(settings, "atlas_size")
        column.prop(settings, "spacing")
        distant = column.column()
        distant.active = settings.lighting != "local"
        if settings.distant_basis != "sh":
            distant.prop(settings, "sampling")
            distant.prop(settings, "memory_budget")
        if settings.distant_basis == "sh":
            distant.prop(settings, "fit_order_to_light")
        column.prop(settings, "threads")
        column.prop(settings, "seed")
        self.layout.operator("prt.measure_tracing", icon="SORTTIME")


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
        lamps = column.column()
        lamps.active = settings.lighting != "environment"
        lamps.prop(settings, "subsurface_links")


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
            column.prop(settings, "surface_patches")
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
            column.prop(settings, "cloud_emission")
            column.prop(settings, "merge_response")
            column.prop(settings, "zone_receivers")


class PRT_PT_compression(_Expert, bpy.types.Panel):
    """How much data is kept, and how its error is measured."""

    bl_idname = "PRT_PT_compression"
    bl_label = "Compression and Error"

    def draw(self, context: bpy.types.Context) -> None:
        settings, column = context.scene.prt, self.column(context)
        column.prop(settings, "encoder")
        if settings.encoder == "auto" and settings.distant_basis == "cubemap":
            column.prop(settings, "light_error")  # what it chooses by; the other panel shows the cubemap's size
        column.prop(settings, "clusters")
        column.prop(settings, "vectors")
        column.prop(settings, "compression_error")
        coherent = column.column()
        coherent.active = settings.lighting == "environment"  # it would move receivers out of their zones
        coherent.prop(settings, "coherence")
        measured = self.layout.column(heading="Measure the Error at")
        measured.prop(settings, "error_receivers")
        paths = measured.column()
        paths.active = settings.error_receivers > 0
        paths.prop(settings, "error_paths")
