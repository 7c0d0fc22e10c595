# SPDX-License-Identifier: GPL-3.0-or-later
"""Boxes of the bake's panel: what bakes now and what waits, what ended before, and what can be resumed."""

from __future__ import annotations

import bpy

from .layout import wrapped


def draw_interrupted(layout: bpy.types.UILayout, context: bpy.types.Context) -> None:
    """Bakes that a crash or a kill interrupted, each with what can be done about it."""
    for line in context.window_manager.prt.interrupted.splitlines():
        job, _, text = line.partition("\t")
        box = layout.box()
        wrapped(box, context, text, "RECOVER_LAST")
        row = box.row(align=True)
        row.operator("prt.resume", icon="PLAY").job = job
        row.operator("prt.discard_interrupted", icon="TRASH").job = job


def draw_jobs(layout: bpy.types.UILayout, context: bpy.types.Context) -> None:
    """The running bake with its progress, and those that wait, each with its cancel."""
    session = context.window_manager.prt
    if not session.running:
        return
    box = layout.box()
    box.label(text=session.title or "Bake", icon="RENDER_STILL")
    wrapped(box, context, session.stage)
    row = box.row(align=True)
    row.progress(factor=session.fraction, text=_progress(session))
    row.operator("prt.cancel", text="", icon="X")
    waiting = session.waiting.splitlines()
    for number, title in enumerate(waiting):
        row = box.row(align=True)
        row.label(text=title, icon="SORTTIME")
        row.operator("prt.cancel", text="", icon="X").waiting = number
    if waiting:
        box.operator("prt.cancel_all", icon="CANCEL")


def draw_messages(layout: bpy.types.UILayout, context: bpy.types.Context) -> None:
    """How earlier bakes of the queue ended, and the last one."""
    session = context.window_manager.prt
    for line in session.ended.splitlines():
        wrapped(layout, context, line[1:], "ERROR" if line[0] == "!" else "INFO", line[0] == "!")
    if session.message:
        wrapped(layout, context, session.message, "ERROR" if session.failed else "INFO", session.failed)


def _progress(session: bpy.types.PropertyGroup) -> str:
    text = f"{100.0 * session.fraction:.0f} %"
    return text if session.seconds_left < 0.0 else f"{text}, {session.seconds_left:.0f} s left"
