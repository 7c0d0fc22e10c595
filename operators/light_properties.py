# SPDX-License-Identifier: GPL-3.0-or-later
"""Light presets of a scene, what a solo has switched off, and the switch to follow frames: Scene.prt_light.

Saved with the scene. Worlds and images are held by pointers besides the names in the state: they survive renaming, and
a World that only a preset uses is saved.
"""

from __future__ import annotations

import json

import bpy
from bpy.props import BoolProperty, CollectionProperty, IntProperty, PointerProperty, StringProperty

from ..prt_addon.blender.light_state import node_named, read_lighting
from . import follow_frames
from .light_icons import icon_of


def _follow_switched(lighting: PRTLighting, _context: bpy.types.Context) -> None:
    """Switched on, the colours shall be those of this frame at once."""
    follow_frames.switched(lighting.id_data)


def _renamed(preset: PRTLightPreset, _context: bpy.types.Context) -> None:
    """Two presets of one name could not be told apart by scripts."""
    others = [p.name for p in preset.id_data.prt_light.presets if p != preset]
    if not preset.name.strip() or preset.name in others:
        preset.name = unique_name(preset.name.strip() or "Light", others)


def unique_name(wanted: str, others: list[str]) -> str:
    """The name, with a number where it is taken."""
    if wanted not in others:
        return wanted
    stem = wanted[:-4] if wanted[-4:-3] == "." and wanted[-3:].isdigit() else wanted
    return next(name for number in range(1, len(others) + 2) if (name := f"{stem}.{number:03d}") not in others)


# Blender evaluates annotations on its own: a lambda in one of them would not find this module's names.
def _icon(preset: PRTLightPreset) -> int:
    return icon_of(preset.thumbnail)


def _follow_message(_lighting: PRTLighting) -> str:
    return follow_frames.message()


def _background(lighting: PRTLighting) -> str:
    return node_named(lighting.id_data.world, "ShaderNodeBackground")


def _mapping(lighting: PRTLighting) -> str:
    return node_named(lighting.id_data.world, "ShaderNodeMapping")


def _differs(lighting: PRTLighting) -> bool:
    """Whether the scene's light is not the active preset's any more. Some milliseconds for a hundred lights."""
    preset = lighting.chosen()
    if preset is None:
        return False
    try:
        state = json.loads(preset.state)
    except ValueError:
        return False
    now = read_lighting(lighting.id_data)
    return any(now[part] != state.get(part) for part in ("world", "lights"))


class PRTLightImage(bpy.types.PropertyGroup):
    """An image that a preset's World shows. `name` is the name that it had then."""

    image: PointerProperty(type=bpy.types.Image)


class PRTLightPreset(bpy.types.PropertyGroup):
    """The lighting of a scene under a name."""

    name: StringProperty(name="Name", update=_renamed, description="Name of this light preset")
    state: StringProperty()
    thumbnail: StringProperty()
    world: PointerProperty(type=bpy.types.World)
    images: CollectionProperty(type=PRTLightImage)
    icon: IntProperty(get=_icon)


class PRTSoloLight(bpy.types.PropertyGroup):
    """A light's switches as they were before a solo."""

    light: PointerProperty(type=bpy.types.Object)
    hide_viewport: BoolProperty()
    hide_render: BoolProperty()


class PRTLighting(bpy.types.PropertyGroup):
    """Scene.prt_light."""

    presets: CollectionProperty(type=PRTLightPreset)
    active: IntProperty(default=-1)
    soloing: BoolProperty()
    solo: PointerProperty(type=bpy.types.Object)
    solo_before: CollectionProperty(type=PRTSoloLight)
    solo_world: PointerProperty(type=bpy.types.World)
    solo_strengths: StringProperty()
    follow_frames: BoolProperty(
        name="Follow Frames", update=_follow_switched, default=False,
        description="At each new frame, write the light of all bakes into their color attribute \"PRT Light\", so that "
                    "playback and renders show it in materials that read it. Costs one relighting per frame, and "
                    "nothing when off",
    )
    follow_message: StringProperty(get=_follow_message)
    modified: BoolProperty(get=_differs)
    background: StringProperty(get=_background)
    mapping: StringProperty(get=_mapping)

    def chosen(self) -> PRTLightPreset | None:
        """The preset that was stored or applied last."""
        return self.presets[self.active] if 0 <= self.active < len(self.presets) else None


CLASSES = (PRTLightImage, PRTLightPreset, PRTSoloLight, PRTLighting)


def register() -> None:
    """Attach the group; its classes are registered by the root."""
    bpy.types.Scene.prt_light = PointerProperty(type=PRTLighting)


def unregister() -> None:
    """Detach the group. Values in scenes stay as plain data and return with the extension."""
    del bpy.types.Scene.prt_light
