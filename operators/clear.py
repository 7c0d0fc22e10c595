# SPDX-License-Identifier: GPL-3.0-or-later
"""prt.clear: remove baked data."""

from __future__ import annotations

import bpy

from ..prt_addon.blender.light_images import drop_light_images
from ..prt_addon.blender.own_colours import drop_own_colours
from ..prt_addon.blender.stored import baked_objects, clear_baked, clear_orphans
from ..prt_addon.blender.stored_report import clear_report
from ..prt_addon.blender.visibility import find_objects
from ..prt_addon.errors import PRTError
from . import live_preview
from .arguments import names_of
from .properties import assign, session


class PRT_OT_clear(bpy.types.Operator):
    """Remove the baked data of the selected objects (of all objects when none of the selected is baked).
    Meshes, materials and lights are not touched"""

    bl_idname = "prt.clear"
    bl_label = "Clear Bake"
    bl_options = {"UNDO"}

    objects: bpy.props.StringProperty(
        name="Objects", options={"HIDDEN", "SKIP_SAVE"},
        description="Names of the objects to clear, with commas between; empty takes the selection",
    )

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        if session(context).running:
            cls.poll_message_set("A bake is running: cancel it first")
            return False
        if not session(context).objects and not bpy.app.background:
            cls.poll_message_set("Nothing is baked")
            return False
        return True

    def execute(self, context: bpy.types.Context) -> set[str]:
        try:
            baked = baked_objects(context.scene)
            named = find_objects(names_of(self.objects), context.scene) if self.objects else None
            chosen = [o for o in baked if (o in named if named else o.select_get())] or ([] if named else baked)
            for baked_object in chosen:
                drop_own_colours(baked_object)
                drop_light_images(baked_object)
                clear_baked(baked_object)
            if len(chosen) == len(baked):
                clear_report(context.scene)
            if chosen is baked:
                clear_orphans(context.scene)
        except PRTError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        text = f"Cleared the bake of {len(chosen)} object{'' if len(chosen) == 1 else 's'}"
        assign(session(context), message=text, failed=False)
        live_preview.bakes_changed()
        self.report({"INFO"}, text)
        return {"FINISHED"}
