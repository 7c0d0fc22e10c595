# SPDX-License-Identifier: GPL-3.0-or-later
"""prt.compare: the preview beside Cycles, and how far they are from each other."""

from __future__ import annotations

import bpy

from .arguments import path_of, size_in, size_of
from .compare_session import CompareRequest
from .job_mixin import JobMixin
from .place import Place
from .polls import refuse, why_not_drawn


class PRT_OT_compare(JobMixin, bpy.types.Operator):
    """Render the camera's view under the present light with Cycles, beside Blender, and compare the preview with it.
    Costs about as much as that render; your file, its settings and the last render stay as they are.
    While a bake runs, it waits for it"""

    bl_idname = "prt.compare"
    bl_label = "Compare with Cycles"
    bl_options = {"UNDO"}  # a bake may have its turn after it, and be followed by the same operator

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
        return refuse(cls, why_not_drawn(context, "compared"))

    def make_request(self, context: bpy.types.Context) -> CompareRequest:
        """The camera's view of this scene, with the panel's settings where no others are given."""
        settings = context.scene.prt
        size = size_of(self.size) if self.size else size_in(context.scene, settings.compare_percentage)
        return CompareRequest(Place.of(context), size, self.samples or settings.compare_samples,
                              path_of(self.filepath) if self.filepath else None,
                              path_of(self.report_path) if self.report_path else None)
