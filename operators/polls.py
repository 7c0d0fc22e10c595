# SPDX-License-Identifier: GPL-3.0-or-later
"""Why an operator can't run now, in words for its button: the same words wherever it is the same reason."""

from __future__ import annotations

import bpy

from ..prt_addon.blender.stored import baked_mesh


def refuse(operator: type[bpy.types.Operator], reason: str) -> bool:
    """Tell the reason on the button; whether there is none, so that `poll` returns it."""
    if reason:
        operator.poll_message_set(reason)
    return not reason


def why_not_read(context: bpy.types.Context) -> str:
    """Why the scene's bakes can't be read; empty where they can."""
    if context.mode != "OBJECT":
        return "Leave edit mode first: the bakes can't be read in it"
    if not any(baked_mesh(o) is not None for o in context.scene.objects):
        return "Nothing is baked: bake an object first"
    return ""


def why_not_drawn(context: bpy.types.Context, what: str) -> str:
    """Why the camera's view of the bakes can't be drawn (what: "drawn", "compared"); empty where it can."""
    unread = why_not_read(context)
    if unread or context.scene.camera is not None:
        return unread
    return f"There is no active camera, whose view could be {what}: add one"
