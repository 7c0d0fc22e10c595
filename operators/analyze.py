# SPDX-License-Identifier: GPL-3.0-or-later
"""prt.analyze: what a bake would need, leave out and cost."""

from __future__ import annotations

import bpy

from ..prt_addon.errors import PRTError
from .arguments import settings_of, targets_of
from .bake_session import analysis_lines, analyze_scene
from .properties import assign, session


class PRT_OT_analyze(bpy.types.Operator):
    """Tell what a bake would need, what it can leave out and about how long it takes. Changes nothing"""

    bl_idname = "prt.analyze"
    bl_label = "Analyze"

    preset: bpy.props.StringProperty(options={"HIDDEN", "SKIP_SAVE"}, description="As of prt.bake")
    lighting: bpy.props.StringProperty(options={"HIDDEN", "SKIP_SAVE"}, description="As of prt.bake")
    objects: bpy.props.StringProperty(options={"HIDDEN", "SKIP_SAVE"}, description="As of prt.bake")
    overrides: bpy.props.StringProperty(options={"HIDDEN", "SKIP_SAVE"}, description="As of prt.bake")

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        if context.mode != "OBJECT":
            cls.poll_message_set("Leave edit mode first: the bake reads finished meshes")
            return False
        return True

    def execute(self, context: bpy.types.Context) -> set[str]:
        try:
            settings = settings_of(context.scene, self.preset, self.lighting, self.overrides)
            analysis = analyze_scene(context.evaluated_depsgraph_get(), settings,
                                     targets_of(context.scene, self.objects))
        except PRTError as error:
            assign(session(context), analysis="", message=str(error), failed=True)
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        lines = analysis_lines(analysis)
        assign(session(context), analysis="\n".join(lines), message="", failed=False)
        self.report({"INFO"}, lines[0])
        return {"FINISHED"}
