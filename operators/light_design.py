# SPDX-License-Identifier: GPL-3.0-or-later
"""Storing and recalling light presets, and solo: between Scene.prt_light and the scene's own lights."""

from __future__ import annotations

import json

import bpy

from ..prt_addon.blender.light_state import (
    lights_of,
    plain,
    read_lighting,
    set_light,
    shown_worlds_images,
    strengths,
    write_lighting,
)
from ..prt_addon.errors import BadArguments, BadScene, PRTError, StorageError
from .light_icons import to_text
from .light_properties import PRTLighting, PRTLightPreset
from .lit_picture import lit_picture

REPLACE = "Update the preset, or remove it and add it again"


def preset_named(scene: bpy.types.Scene, name: str) -> tuple[int, PRTLightPreset]:
    """A preset and its place; without a name the active one. Raises BadArguments."""
    presets, active = scene.prt_light.presets, scene.prt_light.active
    place = presets.find(name) if name else active
    if not 0 <= place < len(presets):
        raise BadArguments(name or f"scene {scene.name}", "there is no such light preset",
                           "Choose one of the list, or add one")
    return place, presets[place]


def store(context: bpy.types.Context, preset: PRTLightPreset) -> list[str]:
    """Put the scene's present light, and a thumbnail where one can be drawn, into a preset; lines for the user."""
    scene = context.scene
    state = read_lighting(scene)
    if scene.prt_light.soloing:
        state["solo"] = _solo_state(scene)
    preset.state, preset.world = json.dumps(state), scene.world
    preset.images.clear()
    for image in dict.fromkeys(shown_worlds_images(scene)):
        kept = preset.images.add()
        kept.name, kept.image = image.name_full, image
    preset.thumbnail = ""
    try:
        pixels = lit_picture(context)
    except PRTError as error:
        return [f"stored without a thumbnail: {error}"]
    preset.thumbnail = "" if pixels is None else to_text(pixels)
    return []


def recall(scene: bpy.types.Scene, preset: PRTLightPreset) -> list[str]:
    """Light the scene as the preset was stored; lines about what could not be set. Raises StorageError."""
    try:
        state = json.loads(preset.state)
        complete = isinstance(state["lights"], dict) and "world" in state
    except (ValueError, KeyError, TypeError):
        complete = False
    if not complete:
        raise StorageError(preset.name, "the preset's data is broken", REPLACE)
    end_solo(scene)
    images = {kept.name: kept.image for kept in preset.images if kept.image is not None}
    notes = write_lighting(scene, state, preset.world, images)
    if "solo" in state:
        _take_solo(scene, state["solo"])
    return notes


def solo(scene: bpy.types.Scene, name: str) -> list[str]:
    """Leave one light on alone, or without a name the World; a second time puts all back as it was.

    name: the light's full name. Lines about what could not be switched; raises BadScene for a light that is not there.
    """
    lighting = scene.prt_light
    chosen = next((light for light in lights_of(scene) if light.name_full == name), None)
    if name and chosen is None:
        raise BadScene(name, "the scene has no light of this name", "Check the spelling and the scene")
    again = lighting.soloing and lighting.solo == chosen
    end_solo(scene)
    if again:
        return []
    _remember(scene, chosen)
    notes: list[str] = []
    for light in lights_of(scene):
        set_light(light, light == chosen, notes)
    if chosen is not None:
        notes += _darken(scene.world)
    return notes


def end_solo(scene: bpy.types.Scene) -> None:
    """Put lights and World back as they were before a solo; does nothing without one."""
    lighting = scene.prt_light
    if not lighting.soloing:
        return
    for kept in lighting.solo_before:
        if kept.light is not None and kept.light.is_editable:
            kept.light.hide_viewport, kept.light.hide_render = kept.hide_viewport, kept.hide_render
    world = lighting.solo_world
    if world is not None and world.is_editable:
        for path, value in json.loads(lighting.solo_strengths or "{}").items():
            _put(world, path, value)
    _forget(lighting)


def _remember(scene: bpy.types.Scene, chosen: bpy.types.Object | None) -> None:
    """Keep what a solo is about to change."""
    lighting = scene.prt_light
    lighting.soloing, lighting.solo, lighting.solo_world = True, chosen, scene.world if chosen is not None else None
    lighting.solo_strengths = json.dumps(_strengths(scene.world) if chosen is not None else {})
    for light in lights_of(scene):
        kept = lighting.solo_before.add()
        kept.light, kept.hide_viewport, kept.hide_render = light, light.hide_viewport, light.hide_render


def _forget(lighting: PRTLighting) -> None:
    lighting.soloing, lighting.solo, lighting.solo_world, lighting.solo_strengths = False, None, None, ""
    lighting.solo_before.clear()


def _strengths(world: bpy.types.World | None) -> dict[str, object]:
    """By path: how strong the World shines; its colour where it has no nodes."""
    if world is None:
        return {}
    if world.node_tree is None:
        return {"color": plain(world.color)}
    return {socket.path_from_id("default_value"): plain(socket.default_value) for socket in strengths(world)}


def _put(world: bpy.types.World, path: str, value: object) -> None:
    if path == "color":
        world.color = value
        return
    holder, _, name = path.rpartition(".")
    try:
        found = world.node_tree.path_resolve(holder)
    except (ValueError, AttributeError):  # the node is gone
        return
    setattr(found, name, value)


def _darken(world: bpy.types.World | None) -> list[str]:
    """Switch a World off; lines about one that can't be."""
    if world is None:
        return []
    found = _strengths(world)
    if not world.is_editable:
        return [f"{world.name}: linked from another file, so it stays on"]
    if not found:
        return [f"{world.name}: its strength is computed by nodes, so it stays on"]
    for path, value in found.items():
        _put(world, path, 0.0 if not isinstance(value, list) else [0.0] * len(value))
    return []


def _solo_state(scene: bpy.types.Scene) -> dict:
    """A solo as a preset keeps it."""
    lighting = scene.prt_light
    return {"light": "" if lighting.solo is None else lighting.solo.name_full,
            "before": {kept.light.name_full: [kept.hide_viewport, kept.hide_render]
                       for kept in lighting.solo_before if kept.light is not None},
            "strengths": lighting.solo_strengths}


def _take_solo(scene: bpy.types.Scene, state: dict) -> None:
    """The solo of a preset becomes the scene's, so that ending it restores what the preset would have without it."""
    lighting = scene.prt_light
    by_name = {light.name_full: light for light in lights_of(scene)}
    if state["light"] and state["light"] not in by_name:
        return
    lighting.soloing, lighting.solo = True, by_name.get(state["light"])
    lighting.solo_world, lighting.solo_strengths = (scene.world if state["light"] else None), state["strengths"]
    for name, (hide_viewport, hide_render) in state["before"].items():
        if name in by_name:
            kept = lighting.solo_before.add()
            kept.light, kept.hide_viewport, kept.hide_render = by_name[name], hide_viewport, hide_render
