# SPDX-License-Identifier: GPL-3.0-or-later
"""Precomputed radiance transfer for Blender: bake once, relight at once. This module registers and nothing else."""

from __future__ import annotations

import bpy

from .operators import (
    commands,
    follow_frames,
    interrupted,
    light_icons,
    light_presets,
    light_properties,
    live_preview,
    properties,
)
from .operators.analyze import PRT_OT_analyze
from .operators.bake import PRT_OT_bake, PRT_OT_cancel, PRT_OT_cancel_all, PRT_OT_follow_bakes
from .operators.clear import PRT_OT_clear
from .operators.compare import PRT_OT_compare
from .operators.draw_camera import PRT_OT_draw_camera
from .operators.export import PRT_OT_export
from .operators.interrupted import PRT_OT_discard_interrupted, PRT_OT_resume
from .operators.job_mixin import JobMixin
from .operators.keyframe_light import PRT_OT_keyframe_light
from .operators.light_images import PRT_OT_light_images
from .operators.measure_tracing import PRT_OT_measure_tracing
from .operators.preview import PRT_OT_toggle_preview
from .operators.relight import PRT_OT_relight
from .operators.report import PRT_OT_show_report, PRT_OT_write_report
from .panels.bake import PRT_PT_bake
from .panels.check import PRT_PT_check
from .panels.lamp import PRT_PT_lamp
from .panels.light_presets import PRT_PT_light_animation, PRT_PT_light_presets, PRT_PT_lights
from .panels.live_materials import PRT_PT_live_materials
from .panels.preview import PRT_PT_preview
from .panels.properties_editor import PRT_PT_object, PRT_PT_world
from .panels.results import PRT_PT_last_bake, PRT_PT_results
from .panels.settings import PRT_PT_compression, PRT_PT_highlights, PRT_PT_local_lights, PRT_PT_rays

CLASSES = (
    properties.PRTSettings,
    properties.PRTBakedObject,
    properties.PRTSession,
    *light_properties.CLASSES,
    PRT_OT_analyze,
    PRT_OT_bake,
    PRT_OT_cancel,
    PRT_OT_cancel_all,
    PRT_OT_follow_bakes,
    PRT_OT_resume,
    PRT_OT_discard_interrupted,
    PRT_OT_clear,
    PRT_OT_toggle_preview,
    PRT_OT_relight,
    PRT_OT_light_images,
    *light_presets.CLASSES,
    PRT_OT_keyframe_light,
    PRT_OT_draw_camera,
    PRT_OT_compare,
    PRT_OT_measure_tracing,
    PRT_OT_export,
    PRT_OT_write_report,
    PRT_OT_show_report,
    PRT_PT_bake,
    PRT_PT_rays,
    PRT_PT_highlights,
    PRT_PT_local_lights,
    PRT_PT_compression,
    PRT_PT_live_materials,
    PRT_PT_preview,
    PRT_PT_light_presets,
    PRT_PT_lights,
    PRT_PT_light_animation,
    PRT_PT_results,
    PRT_PT_last_bake,
    PRT_PT_check,
    PRT_PT_lamp,
    PRT_PT_object,
    PRT_PT_world,
)


def register() -> None:
    """Called by Blender when the extension is enabled."""
    for cls in CLASSES:
        bpy.utils.register_class(cls)
    properties.register()
    light_properties.register()
    live_preview.register()
    follow_frames.register()
    interrupted.register()
    commands.register()


def unregister() -> None:
    """Called by Blender when the extension is disabled: nothing stays behind."""
    JobMixin.stop_now()
    commands.unregister()
    follow_frames.unregister()
    interrupted.unregister()
    live_preview.unregister()
    light_icons.unregister()
    light_properties.unregister()
    properties.unregister()
    for cls in reversed(CLASSES):
        bpy.utils.unregister_class(cls)
