# SPDX-License-Identifier: GPL-3.0-or-later
"""prt.toggle_preview: show baked objects under the scene's present light."""

from __future__ import annotations

import bpy

from ..prt_addon.errors import PRTError
from . import live_preview
from .properties import session


class PRT_OT_toggle_preview(bpy.types.Operator):
    """Show baked objects in the viewport as World, Suns and lamps light them now, and follow their changes.
    Costs about as much per frame as a coloured mesh"""

    bl_idname = "prt.toggle_preview"
    bl_label = "Preview"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        if bpy.app.background:
            cls.poll_message_set("There is no viewport in background mode: use the command `prt preview`")
            return False
        if not session(context).preview and not session(context).objects:
            cls.poll_message_set("Nothing is baked: bake an object first")
            return False
        return True

    def execute(self, context: bpy.types.Context) -> set[str]:
        if session(context).preview:
            live_preview.disable()
            return {"FINISHED"}
        try:
            live_preview.enable()
        except PRTError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        return {"FINISHED"}
