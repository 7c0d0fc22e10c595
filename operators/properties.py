# SPDX-License-Identifier: GPL-3.0-or-later
"""What the user sets (saved with the scene) and what panels show of this session (never saved, never undone)."""

from __future__ import annotations

import bpy
from bpy.props import (
    BoolProperty,
    CollectionProperty,
    EnumProperty,
    FloatProperty,
    IntProperty,
    PointerProperty,
    StringProperty,
)

from ..prt_addon.baking.settings import HIGHEST_ORDER, PRESETS

# Explicit numbers: files store them, so that a preset inserted later changes no old file.
PRESET_ITEMS = (
    ("draft", "Draft", "Seconds: soft shadows, a few per cent of error. To see whether the scene works", 0),
    ("standard", "Standard", "A minute or so: what most scenes need", 1),
    ("high", "High", "Several minutes and more memory: sharper shadows, errors below one per cent", 2),
)


def _take_preset(settings: PRTSettings, _context: bpy.types.Context) -> None:
    """Choosing a preset fills in the numbers below it."""
    settings.order = PRESETS[settings.preset].order


def _redraw(_settings: PRTSettings, _context: bpy.types.Context) -> None:
    """What the viewport shows depends on this setting; Blender does not know."""
    redraw("WINDOW")


def _light_changed(_settings: PRTSettings, _context: bpy.types.Context) -> None:
    """The preview's light depends on this setting."""
    from .live_preview import light_changed  # it needs this module to be loaded

    light_changed()


class PRTSettings(bpy.types.PropertyGroup):
    """Settings of the bake and of the preview: Scene.prt."""

    preset: EnumProperty(
        name="Preset", items=PRESET_ITEMS, default="standard", update=_take_preset,
        description="How much time a bake may cost and how exact it gets",
    )
    order: IntProperty(
        name="Order", min=1, max=HIGHEST_ORDER, default=PRESETS["standard"].order,
        description="Bands of the lighting. Higher buys sharper shadows; memory and relighting cost grow with the "
                    "square",
    )
    bounces: BoolProperty(
        name="Bounced Light", default=True,
        description="Light from surface to surface: colours bleed, corners brighten. Costs about as long again as "
                    "the shadows",
    )
    exposure: FloatProperty(
        name="Exposure", update=_redraw, default=0.0, soft_min=-5.0, soft_max=5.0, step=10, precision=2,
        description="Brightens the preview alone, in stops. Costs nothing and changes no baked data",
    )

    window: BoolProperty(
        name="Soften Ringing", update=_light_changed, default=False,
        description="Takes dark ripples around very bright, small lights away. Costs some of the light's detail, and "
                    "nothing where nothing rings",
    )

    def overrides(self) -> dict[str, str]:
        """What these settings change in their preset, by name, as `make_settings` takes it."""
        changed = {"order": str(self.order)} if self.order != PRESETS[self.preset].order else {}
        return changed if self.bounces else {**changed, "bounces": "0"}


class PRTBakedObject(bpy.types.PropertyGroup):
    """A line of the panel's results. `name` is the object's name."""

    clusters: IntProperty()
    points: IntProperty()
    error: FloatProperty(default=-1.0)
    highlight_error: FloatProperty(default=-1.0)
    overdraw: FloatProperty()
    overdraw_before: FloatProperty()
    stale: StringProperty()


class PRTSession(bpy.types.PropertyGroup):
    """What panels show of this session: WindowManager.prt. Written by operators and handlers, never by panels."""

    running: BoolProperty()
    stage: StringProperty()
    fraction: FloatProperty()
    seconds_left: FloatProperty(default=-1.0)
    message: StringProperty()
    failed: BoolProperty()
    preview: BoolProperty()
    preview_message: StringProperty()
    viewport_message: StringProperty()
    objects: CollectionProperty(type=PRTBakedObject)
    analysis: StringProperty()


def session(context: bpy.types.Context | None = None) -> PRTSession:
    """The session's state."""
    return (context or bpy.context).window_manager.prt


def assign(owner: bpy.types.PropertyGroup, **values: object) -> None:
    """Write properties that change, and have the sidebars drawn anew if any did."""
    changed = {name: value for name, value in values.items() if getattr(owner, name) != value}
    for name, value in changed.items():
        setattr(owner, name, value)
    if changed:
        redraw("UI")


def redraw(kind: str) -> None:
    """Have a kind of region (UI: the sidebar, WINDOW: the picture) of every 3D viewport drawn anew."""
    for window in bpy.context.window_manager.windows:
        for area in window.screen.areas:
            if area.type == "VIEW_3D":
                for region in area.regions:
                    if region.type == kind:
                        region.tag_redraw()


def register() -> None:
    """Attach both groups; their classes are registered by the root."""
    bpy.types.Scene.prt = PointerProperty(type=PRTSettings)
    bpy.types.WindowManager.prt = PointerProperty(type=PRTSession)


def unregister() -> None:
    """Detach both groups. Values in scenes stay as plain data and return with the extension."""
    del bpy.types.WindowManager.prt
    del bpy.types.Scene.prt
