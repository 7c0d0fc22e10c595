# SPDX-License-Identifier: GPL-3.0-or-later
"""What all panels share: where they stand, and texts that wrap."""

from __future__ import annotations

import textwrap

import bpy

CHARACTERS_PER_WIDTH = 0.15  # of the interface font at scale 1, per pixel of region width
THIN_SPACE = "\u202f"  # between thousands, as in the report
MARGIN = 60  # pixels of a region that hold no text: icon, borders


class Sidebar:
    """What panels of the 3D viewport's sidebar tab "PRT" share."""

    bl_space_type = "VIEW_3D"
    bl_region_type = "UI"
    bl_category = "PRT"


def plural(count: int, what: str, several: str = "") -> str:
    """"1 face", "1 200 faces"; several: where more of it are called otherwise than with an s."""
    return f"{count:,} ".replace(",", THIN_SPACE) + (what if count == 1 else several or f"{what}s")


def wrapped(layout: bpy.types.UILayout, context: bpy.types.Context, text: str, icon: str = "NONE",
            alert: bool = False) -> None:
    """A text over as many lines as the sidebar's width asks for: labels are clipped otherwise."""
    scale = context.preferences.system.ui_scale
    width = max(16, int((context.region.width - MARGIN * scale) * CHARACTERS_PER_WIDTH / scale))
    column = layout.column(align=True)
    column.alert = alert
    for number, line in enumerate(textwrap.wrap(text, width)):
        column.label(text=line, icon=icon if number == 0 else "BLANK1" if icon != "NONE" else "NONE")
