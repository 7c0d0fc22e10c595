# SPDX-License-Identifier: GPL-3.0-or-later
"""Cycles as an evaluator of shaders: one sample per face corner of a mesh of ours, in a scene of ours.

The user's scenes, selection, mode, render settings and data are not touched: everything happens in a temporary scene
that is removed whatever happens.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Literal

import bpy
import numpy as np
from numpy.typing import NDArray

from ..errors import PRTError

ATTRIBUTE = "prt_evaluated"
TEMPORARY = "PRT temporary"


@contextmanager
def scratch_scene(like: bpy.types.Scene) -> Iterator[bpy.types.Scene]:
    """An empty scene at the frame of `like` for Cycles on the CPU, one sample. Raises PRTError without Cycles."""
    if not hasattr(like, "cycles"):
        raise PRTError("Cycles", "it is switched off, and node trees are evaluated with it",
                       "Enable the Cycles Render Engine in Preferences, Add-ons")
    scratch = bpy.data.scenes.new(TEMPORARY)
    try:
        scratch.frame_current = like.frame_current
        scratch.render.engine = "CYCLES"
        scratch.cycles.device = "CPU"
        scratch.cycles.samples = 1
        scratch.cycles.use_adaptive_sampling = False
        scratch.cycles.use_denoising = False
        scratch.cycles.shading_system = like.cycles.shading_system
        scratch.render.use_simplify = False
        scratch.render.bake.use_clear = True
        scratch.render.bake.view_from = "ABOVE_SURFACE"
        yield scratch
    finally:
        bpy.data.scenes.remove(scratch)


def evaluate_corners(scratch: bpy.types.Scene, mesh: bpy.types.Mesh, matrix: NDArray[np.float64],
                     kind: Literal["DIFFUSE", "ENVIRONMENT"]) -> NDArray[np.float32]:
    """RGB (corners, 3) float32, scene-linear, that Cycles evaluates at each face corner of a mesh of ours.

    DIFFUSE: the diffuse albedo of its materials. ENVIRONMENT: the world's radiance in the direction from the origin to
    the corner. The mesh must belong to the caller: it gets an attribute. matrix: (4, 4), object to world.
    """
    target = mesh.color_attributes.new(ATTRIBUTE, "FLOAT_COLOR", "CORNER")
    mesh.color_attributes.active_color = target
    name = target.name
    carrier = bpy.data.objects.new(TEMPORARY, mesh)
    try:
        scratch.collection.objects.link(carrier)
        view_layer = scratch.view_layers[0]
        carrier.matrix_world = matrix.T.tolist()
        carrier.select_set(True, view_layer=view_layer)
        view_layer.objects.active = carrier
        with bpy.context.temp_override(scene=scratch, view_layer=view_layer, object=carrier, active_object=carrier,
                                       selected_objects=[carrier], selected_editable_objects=[carrier]):
            bpy.ops.object.bake(type=kind, pass_filter={"COLOR"}, target="VERTEX_COLORS", use_clear=True)
        colours = np.empty((len(mesh.loops), 4), np.float32)
        mesh.color_attributes[name].data.foreach_get("color", colours.ravel())
    except RuntimeError as error:
        raise PRTError("Cycles", f"it could not evaluate the node tree ({str(error).strip()})",
                       "Check that a render with Cycles works") from error
    finally:
        bpy.data.objects.remove(carrier)
    return np.nan_to_num(colours[:, :3], posinf=0.0, neginf=0.0)
