# SPDX-License-Identifier: GPL-3.0-or-later
"""Keyframes of the lighting as it is set now, on the data-blocks that hold it."""

from __future__ import annotations

from collections.abc import Collection, Iterator

import bpy

from .light_state import ROTATIONS, SWITCHES, animated_sockets, lights_of, sky_settings

PARTS = ("WORLD", "POWER", "COLOR", "VISIBILITY", "TRANSFORM")
Keyed = tuple[bpy.types.bpy_struct, str]  # who has the property, and its name


def insert_keyframes(scene: bpy.types.Scene, frame: float, parts: Collection[str],
                     names: Collection[str] | None = None) -> tuple[int, list[str]]:
    """Keyframes of the chosen parts (of PARTS) at a frame; how many channels, and lines about what can't be keyed.

    names: full names of the lights; None for all. The World belongs to WORLD alone: strength, colour, the Mapping's
    rotation and a sky texture's settings. Blender can't animate which image it shows.
    """
    count, notes, seen = 0, [], set()
    for owner, subject, holder, name in _keyed(scene, parts, names):
        key = owner.as_pointer(), holder.as_pointer(), name
        if key in seen:  # lights that share their data
            continue
        seen.add(key)
        if not owner.is_editable:
            notes.append(f"{subject}: linked from another file, so it gets no keyframes")
            continue
        try:
            count += bool(holder.keyframe_insert(name, frame=frame))
        except (TypeError, RuntimeError) as error:
            notes.append(f"{subject}: {name} can't be keyed ({str(error).strip().splitlines()[-1].rstrip('.')})")
    return count, list(dict.fromkeys(notes))


def _keyed(scene: bpy.types.Scene, parts: Collection[str], names: Collection[str] | None,
           ) -> Iterator[tuple[bpy.types.ID, str, bpy.types.bpy_struct, str]]:
    """Owner, its name for the user, and what of it is to be keyed."""
    world = scene.world
    if "WORLD" in parts and world is not None:
        yield from ((world, world.name, holder, name) for holder, name in _of_world(world))
    for light in lights_of(scene):
        if names is not None and light.name_full not in names:
            continue
        for holder, name in _of_light(light, parts):
            yield holder, light.name, holder, name


def _of_world(world: bpy.types.World) -> Iterator[Keyed]:
    if world.node_tree is None:
        yield world, "color"
        return
    yield from ((socket, "default_value") for socket in animated_sockets(world))
    yield from sky_settings(world)


def _of_light(light: bpy.types.Object, parts: Collection[str]) -> Iterator[Keyed]:
    data = light.data
    if "POWER" in parts:
        yield from ((data, name) for name in ("energy", "exposure"))
    if "COLOR" in parts:
        yield data, "color"
        if data.use_temperature:
            yield data, "temperature"
    if "VISIBILITY" in parts:
        yield from ((light, name) for name in SWITCHES)
    if "TRANSFORM" in parts:
        yield from ((light, name) for name in ("location", ROTATIONS.get(light.rotation_mode, "rotation_euler"),
                                               "scale"))
