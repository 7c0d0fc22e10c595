# SPDX-License-Identifier: GPL-3.0-or-later
"""prt.keyframe_light: the present light as keyframes of this frame."""

from __future__ import annotations

import bpy
from bpy.props import BoolProperty, EnumProperty

from ..prt_addon.blender.light_keyframes import PARTS, insert_keyframes
from .properties import redraw

ITEMS = (
    ("WORLD", "World", "Strength, colors and rotation of the HDRI, and a sky's settings", 1),
    ("POWER", "Power", "Power and exposure of the lights", 2),
    ("COLOR", "Color", "Color and temperature of the lights", 4),
    ("VISIBILITY", "On and Off", "The lights' switches in viewports and renders", 8),
    ("TRANSFORM", "Place", "Location, rotation and scale of the lights", 16),
)


class PRT_OT_keyframe_light(bpy.types.Operator):
    """Insert keyframes of the present light at this frame: World strength and rotation, the lights' power, color,
    switches and place. Apply a preset, click, go to another frame, and so on. Costs nothing until frames play"""

    bl_idname = "prt.keyframe_light"
    bl_label = "Keyframe Light"
    bl_options = {"REGISTER", "UNDO"}

    parts: EnumProperty(name="Parts", items=ITEMS, options={"ENUM_FLAG"}, default=set(PARTS),
                        description="What of the light gets keyframes")
    selected: BoolProperty(name="Selected Lights", default=False,
                           description="Keyframes for selected lights alone, in place of all lights")

    def execute(self, context: bpy.types.Context) -> set[str]:
        scene = context.scene
        names = {o.name_full for o in context.selected_objects} if self.selected else None
        count, notes = insert_keyframes(scene, scene.frame_current_final, self.parts, names)
        text = f"{count} channel{'' if count == 1 else 's'} keyed at frame {scene.frame_current_final:g}"
        if not count and not notes:
            notes = ["the scene has no World and no light to key"]
        self.report({"WARNING"} if notes else {"INFO"}, "; ".join([text, *notes]))
        redraw("UI")
        return {"FINISHED"} if count else {"CANCELLED"}
