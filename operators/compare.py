# SPDX-License-Identifier: GPL-3.0-or-later
"""prt.compare: the preview beside Cycles, and how far they are from each other."""

from __future__ import annotations

import bpy

from ..prt_addon.blender.pictures import show_image, store_image, write_picture
from ..prt_addon.blender.stored import baked_mesh
from ..prt_addon.storage.files import save_json
from .arguments import path_of, size_in, size_of
from .compare_session import CompareSession
from .job_mixin import JobMixin
from .properties import assign, session

IMAGE = "PRT Comparison"


class PRT_OT_compare(JobMixin, bpy.types.Operator):
    """Render the camera's view under the present light with Cycles, beside Blender, and compare the preview with it.
    Costs about as much as that render; your file, its settings and the last render stay as they are"""

    bl_idname = "prt.compare"
    bl_label = "Compare with Cycles"

    subject = "Compare"
    cancel_remedy = "Compare again when you like"

    samples: bpy.props.IntProperty(
        name="Samples", min=0, options={"SKIP_SAVE"},
        description="Samples of Cycles in each pixel; 0 takes the panel's",
    )
    size: bpy.props.StringProperty(
        name="Size", options={"SKIP_SAVE"}, description="WIDTHxHEIGHT in pixels; empty takes the panel's",
    )
    filepath: bpy.props.StringProperty(
        name="Picture", options={"SKIP_SAVE"}, description="A PNG file to write the picture to; empty writes none",
    )
    report_path: bpy.props.StringProperty(
        name="Report", options={"SKIP_SAVE"}, description="A JSON file to write the numbers to; empty writes none",
    )

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        if JobMixin.running is not None:
            cls.poll_message_set("Something is being baked or compared: wait for its end, or cancel it")
            return False
        if context.mode != "OBJECT":
            cls.poll_message_set("Leave edit mode first: the bakes can't be read in it")
            return False
        if not any(baked_mesh(o) is not None for o in context.scene.objects):
            cls.poll_message_set("Nothing is baked: bake an object first")
            return False
        if context.scene.camera is None:
            cls.poll_message_set("There is no active camera, whose view could be compared: add one")
            return False
        return True

    def start_job(self, context: bpy.types.Context) -> CompareSession:
        settings = context.scene.prt
        size = size_of(self.size) if self.size else size_in(context.scene, settings.compare_percentage)
        return CompareSession.start(context.scene, size, self.samples or settings.compare_samples)

    def finish_job(self, context: bpy.types.Context, job: CompareSession) -> str:
        compared = job.finish()
        shown = show_image(store_image(IMAGE, compared.picture))
        if self.filepath:
            write_picture(path_of(self.filepath), compared.picture)
        if self.report_path:
            save_json(path_of(self.report_path), compared.result)
        lines = compared.lines
        where = "" if shown else f"The picture is the image \"{IMAGE}\": open an Image Editor to see it"
        assign(session(context), comparison="\n".join([*lines, *([where] if where else [])]))
        return lines[0]
