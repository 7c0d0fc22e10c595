# SPDX-License-Identifier: GPL-3.0-or-later
"""prt.bake, prt.cancel, prt.cancel_all, and prt.follow_bakes for the window that takes over."""

from __future__ import annotations

import bpy

from .arguments import settings_of, targets_of
from .bake_request import BakeRequest
from .job_mixin import JobMixin


class PRT_OT_bake(JobMixin, bpy.types.Operator):
    """Bake how the selected meshes (all visible ones when none is selected), or those of a collection, respond to
    light. Blender stays usable meanwhile; the previous bake is replaced only by a complete new one.
    While a bake runs, the next one waits for it: with the selection and the settings of now, but with the meshes,
    materials and places that are found when its turn comes. Reading the scene, at its start, can't be cancelled"""

    bl_idname = "prt.bake"
    bl_label = "Bake Light Transfer"
    bl_options = {"UNDO"}

    preset: bpy.props.StringProperty(
        name="Preset", options={"HIDDEN", "SKIP_SAVE"},
        description="draft, standard or high, in place of all of the panel's settings; empty takes the panel's",
    )
    lighting: bpy.props.StringProperty(
        name="Lighting", options={"HIDDEN", "SKIP_SAVE"},
        description="environment, local or environment,local; empty takes the panel's",
    )
    objects: bpy.props.StringProperty(
        name="Objects", options={"HIDDEN", "SKIP_SAVE"},
        description="Names of the objects to bake, with commas between; empty takes those that the panel says",
    )
    overrides: bpy.props.StringProperty(
        name="Overrides", options={"HIDDEN", "SKIP_SAVE"},
        description="Any setting by name, as --set of the command line takes it: \"directions=4096, vectors=12\". "
                    "They count before the panel's",
    )

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        if context.mode != "OBJECT":
            cls.poll_message_set("Leave edit mode first: the bake reads finished meshes")
            return False
        if not any(o.type == "MESH" for o in context.scene.objects):
            cls.poll_message_set("The scene has no mesh object to bake")
            return False
        return True

    def make_request(self, context: bpy.types.Context) -> BakeRequest:
        """The selection or collection, and the settings, of now, or those that the arguments name."""
        settings = settings_of(context.scene, self.preset, self.lighting, self.overrides)
        return BakeRequest.of_choice(context, settings, targets_of(context.scene, self.objects))


class PRT_OT_follow_bakes(JobMixin, bpy.types.Operator):
    """Follow the running bakes in this window, after the one that they were started in was closed"""

    bl_idname = "prt.follow_bakes"
    bl_label = "Follow Bakes"
    bl_options = {"UNDO", "INTERNAL"}

    @classmethod
    def poll(cls, _context: bpy.types.Context) -> bool:
        return JobMixin.active

    def invoke(self, context: bpy.types.Context, _event: bpy.types.Event) -> set[str]:
        return self.follow(context)


class PRT_OT_cancel(bpy.types.Operator):
    """Stop this bake. Finished stages are kept, so that baking again resumes; previous bakes stay"""

    bl_idname = "prt.cancel"
    bl_label = "Cancel Bake"

    waiting: bpy.props.IntProperty(
        name="Waiting", default=-1, min=-1, options={"HIDDEN", "SKIP_SAVE"},
        description="Which waiting bake, counted from 0; -1 is the running one",
    )

    @classmethod
    def poll(cls, _context: bpy.types.Context) -> bool:
        return _something_runs(cls)

    def execute(self, _context: bpy.types.Context) -> set[str]:
        if self.waiting < 0:
            JobMixin.request_cancel()
        else:
            JobMixin.cancel_waiting(self.waiting)
        return {"FINISHED"}


class PRT_OT_cancel_all(bpy.types.Operator):
    """Stop the running bake and drop all that wait. Finished stages are kept; previous bakes stay"""

    bl_idname = "prt.cancel_all"
    bl_label = "Cancel All Bakes"

    @classmethod
    def poll(cls, _context: bpy.types.Context) -> bool:
        return _something_runs(cls)

    def execute(self, _context: bpy.types.Context) -> set[str]:
        JobMixin.cancel_waiting()
        JobMixin.request_cancel()
        return {"FINISHED"}


def _something_runs(operator: type[bpy.types.Operator]) -> bool:
    if JobMixin.active or JobMixin.running is not None:
        return True
    operator.poll_message_set("No bake is running")
    return False
