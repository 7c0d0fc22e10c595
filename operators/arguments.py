# SPDX-License-Identifier: GPL-3.0-or-later
"""Arguments that commands and operators take alike, as text."""

from __future__ import annotations

from pathlib import Path

import bpy

from ..prt_addon.baking.settings import PRESETS, BakeSettings, make_settings, parse_overrides
from ..prt_addon.errors import BadArguments
from .bake_session import chosen_targets

KINDS = ("environment", "local")


def names_of(text: str) -> list[str]:
    """Object names "A,B" (no commas in them). Raises BadArguments where there is none."""
    names = [name.strip() for name in text.split(",") if name.strip()]
    if not names:
        raise BadArguments("objects", "no object names given", "Give names with commas between them")
    return names


def lighting_of(text: str) -> str:
    """Kinds of lighting in their order, whatever the order given. Raises BadArguments."""
    kinds = {kind.strip() for kind in text.split(",")}
    chosen = [kind for kind in KINDS if kind in kinds]
    if len(chosen) != len(kinds):
        raise BadArguments("lighting", f"{text!r} is not environment, local or environment,local", "Give one of them")
    return ",".join(chosen)


def size_of(text: str) -> tuple[int, int]:
    """Width and height of "640x400". Raises BadArguments."""
    width, _, height = text.lower().partition("x")
    if not (width.isdecimal() and height.isdecimal() and int(width) and int(height)):
        raise BadArguments("size", f"{text!r} is not WIDTHxHEIGHT in pixels", "Give, for example, 640x400")
    return int(width), int(height)


def size_in(scene: bpy.types.Scene, percentage: float = 100.0) -> tuple[int, int]:
    """Width and height that the scene's output settings ask for, times a percentage."""
    share = scene.render.resolution_percentage * percentage / 1e4
    return max(1, round(scene.render.resolution_x * share)), max(1, round(scene.render.resolution_y * share))


def path_of(text: str) -> Path:
    """A path as Blender writes it ("//" is the file's folder)."""
    return Path(bpy.path.abspath(text))


def settings_of(scene: bpy.types.Scene, preset: str = "", lighting: str = "", overrides: str = "") -> BakeSettings:
    """Settings of a bake. A preset means what it means to the commands; without one the panel's settings count, and
    what else is given comes before them. Raises PRTError."""
    if preset and preset not in PRESETS:
        raise BadArguments("preset", f"{preset!r} is none of {', '.join(PRESETS)}", "Give one of them")
    changed = {} if preset else scene.prt.overrides()
    if lighting:
        changed["lighting"] = lighting_of(lighting)
    return make_settings(preset or scene.prt.preset, changed | parse_overrides(overrides))


def targets_of(scene: bpy.types.Scene, objects: str = "") -> list[str] | None:
    """Names of objects to bake: those given, else what the panel says; None leaves it to the selection."""
    return names_of(objects) if objects else chosen_targets(scene)
