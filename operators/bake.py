# SPDX-License-Identifier: GPL-3.0-or-later
"""prt.bake and prt.cancel."""

from __future__ import annotations

import bpy

from ..prt_addon.baking.settings import make_settings, parse_overrides
from . import live_preview
from .bake_session import BakeSession, baked_message, chosen_targets
from .job_mixin import JobMixin


class PRT_OT_bake(JobMixin, bpy.types.Operator):
    """Bake how the selected meshes (all visible ones when none is selected), or those of a collection, respond to
    light. Blender stays usable meanwhile; the previous bake is replaced only by a complete new one"""

    bl_idname = "prt.bake"
    bl_label = "Bake Light Transfer"
    bl_options = {"UNDO"}

    overrides: bpy.props.StringProperty(
        name="Overrides", options={"HIDDEN", "SKIP_SAVE"},
        description="Any setting by name, as --set of the command line takes it: \"directions=4096, vectors=12\". "
                    "They count before the panel's",
    )

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        if JobMixin.running is not None:
            cls.poll_message_set("A bake is running: wait for its end, or cancel it")
            return False
        if context.mode != "OBJECT":
            cls.poll_message_set("Leave edit mode first: the bake reads finished meshes")
            return False
        if not any(o.type == "MESH" for o in context.scene.objects):
            cls.poll_message_set("The scene has no mesh object to bake")
            return False
        return True

    def start_job(self, context: bpy.types.Context) -> BakeSession:
        settings = make_settings(context.scene.prt.preset,
                                 context.scene.prt.overrides() | parse_overrides(self.overrides))
        return BakeSession.start(context.evaluated_depsgraph_get(), settings, chosen_targets(context.scene))

    def finish_job(self, context: bpy.types.Context, job: BakeSession) -> str:
        result = job.store()
        job.discard()
        live_preview.bakes_changed()
        return baked_message(result, job.seconds)


class PRT_OT_cancel(bpy.types.Operator):
    """Stop the running bake. Finished stages are kept, so that baking again resumes; previous bakes stay"""

    bl_idname = "prt.cancel"
    bl_label = "Cancel Bake"

    @classmethod
    def poll(cls, _context: bpy.types.Context) -> bool:
        if JobMixin.running is None:
            cls.poll_message_set("No bake is running")
            return False
        return True

    def execute(self, _context: bpy.types.Context) -> set[str]:
        JobMixin.request_cancel()
        return {"FINISHED"}
