# SPDX-License-Identifier: GPL-3.0-or-later
"""prt.measure_tracing: whether this computer's graphics driver traces rays faster than its processor."""

from __future__ import annotations

import bpy

from .job_mixin import JobMixin
from .tracing_choice import MeasureRequest


class PRT_OT_measure_tracing(JobMixin, bpy.types.Operator):
    """Measure once on this computer whether its graphics card traces rays faster than its processor: some ten seconds,
    beside Blender. Bakes use the card only where it was measured faster"""

    bl_idname = "prt.measure_tracing"
    bl_label = "Measure Ray Tracing"

    def make_request(self, _context: bpy.types.Context) -> MeasureRequest:
        """Nothing is asked for but the measurement."""
        return MeasureRequest()
