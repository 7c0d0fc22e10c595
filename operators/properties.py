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


# Most functions of the view direction. The numbers are the settings' own, so a file keeps them whatever is added here.
ROW_ITEMS = (
    ("0", "None", "Diffuse light only: metals are drawn black. Costs nothing", 0),
    ("4", "4", "A broad sheen. Costs four times the diffuse data and bake time", 4),
    ("9", "9", "Soft highlights, for rough materials. Costs nine times the diffuse data", 9),
    ("16", "16", "Highlights of roughness 0.5 and above. Costs sixteen times the diffuse data", 16),
    ("24", "24", "Highlights of roughness 0.3 and above. Costs twenty-four times the diffuse data", 24),
    ("25", "25", "As 24 with one function more, which hardly shows", 25),
)
# Settings of the expert panel that are a bake setting of the same name.
EXPERT = ("glossy_rows", "glossy_albedo", "glossy_window", "subsurface", "coherence")


def _take_preset(settings: PRTSettings, _context: bpy.types.Context) -> None:
    """Choosing a preset fills in the numbers below it."""
    preset = PRESETS[settings.preset]
    settings.order = preset.order
    for name in EXPERT:
        value = getattr(preset, name)
        setattr(settings, name, str(value) if name == "glossy_rows" else value)


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
    glossy_rows: EnumProperty(
        name="Highlight Detail", items=ROW_ITEMS, default=str(PRESETS["standard"].glossy_rows),
        description="Most functions of the view direction that a highlight gets. More buys sharper reflections; each "
                    "costs as much data and work as the whole diffuse light. Materials that need fewer get fewer",
    )
    glossy_albedo: FloatProperty(
        name="Least Highlight", min=0.0, max=1.0, default=PRESETS["standard"].glossy_albedo, step=1, precision=2,
        subtype="FACTOR",
        description="Share of the light that a highlight must return to be baked (a plastic returns 0.05 to 0.09, a "
                    "metal most). Lower buys the sheen of plastics, at the cost of all their rows; below it the light "
                    "stays in the diffuse layer",
    )
    glossy_window: BoolProperty(
        name="Soften Highlights", default=True,
        description="Highlights sharper than the order reflect a softer light. Buys highlights without dark rings, "
                    "costs some of their sharpness, and nothing where nothing rings",
    )
    subsurface: BoolProperty(
        name="Subsurface Light", default=True,
        description="Light travels inside translucent materials (subsurface weight). Buys wax, skin and marble that "
                    "glow; costs its own stage of the bake and three colour channels. Off: they are opaque",
    )
    coherence: FloatProperty(
        name="Coherence", min=0.0, max=0.5, default=0.0, soft_max=0.1, step=1, precision=2, subtype="FACTOR",
        description="Share of compression error that may be added so that fewer triangles lie in more than one "
                    "cluster. Buys faster drawing in programs that draw cluster by cluster; the preview gains "
                    "nothing. 0 is off, 0.05 to 0.1 is usual",
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
        preset = PRESETS[self.preset]
        # What a file of an older version has not set is the preset's.
        found = {name: getattr(self, name) for name in EXPERT if self.is_property_set(name)} | {"order": self.order}
        # Blender keeps single precision: 0.3 comes back as 0.30000001.
        texts = {name: f"{value:.6g}" if isinstance(value, float) else str(value) for name, value in found.items()}
        changed = {name: text for name, text in texts.items() if not _same(text, getattr(preset, name))}
        return changed if self.bounces else {**changed, "bounces": "0"}


def _same(text: str, value: object) -> bool:
    """Whether a property's text says the same as a setting's value."""
    return abs(float(text) - value) < 1e-6 if isinstance(value, float) else text == str(value)


class PRTBakedObject(bpy.types.PropertyGroup):
    """A line of the panel's results. `name` is the object's name."""

    clusters: IntProperty()
    points: IntProperty()
    error: FloatProperty(default=-1.0)
    highlight_error: FloatProperty(default=-1.0)
    overdraw: FloatProperty()
    overdraw_before: FloatProperty()
    error_spent: FloatProperty()
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
