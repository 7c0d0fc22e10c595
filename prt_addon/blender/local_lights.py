# SPDX-License-Identifier: GPL-3.0-or-later
"""Blender's Point, Spot and Area lights as `LocalLight`, as a render of Cycles shows them.

Units found by baking with Cycles of Blender 5.2.3 (tests/blender/test_local_light_units.py): without `normalize` a
lamp's power counts for each square metre of its surface, of a Point or Spot without radius four times. Cycles does not
read the lamps' `diffuse_factor`, a Spot's `use_square` or the custom distance (these are EEVEE's).
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import bpy
import numpy as np
from numpy.typing import NDArray

from ..lighting.local_lights import LocalLight
from .lights import _emission as node_emission
from .nodes import reachable
from .visibility import render_visible_objects
from .world import check_strength

LOCAL = {"POINT": "point", "SPOT": "spot", "AREA": "area"}
# Light bounces at most this often before what is left is invisible; a lamp's own limit below it is worth a word.
FEW_BOUNCES = 8
# Cosine between an Area's axes from which on it counts as sheared.
SHEARED = 1e-3


def read_local_lights(depsgraph: bpy.types.Depsgraph, warnings: list[str]) -> list[LocalLight]:
    """Point, Spot and Area lights that a render shows, instanced ones too, in the file's order; Suns are left alone.

    warnings: gets a line for every lamp that gives no light or another light than in a render, saying what is done
    instead. Raises PRTError naming a lamp whose strength is no number.
    """
    found = (_local_light(key, lamp, matrix, warnings) for key, lamp, matrix in _lamps(depsgraph, warnings))
    return [light for light in found if light is not None]


def _lamps(depsgraph: bpy.types.Depsgraph, warnings: list[str],
           ) -> Iterator[tuple[str, bpy.types.Object, NDArray[np.float64]]]:
    """Lamps near the scene that a render shows: a key that stays from frame to frame, the object, its matrix."""
    visible = render_visible_objects(depsgraph.view_layer)
    reached: set[str] = set()
    for instance in depsgraph.object_instances:
        if instance.object.type != "LIGHT" or instance.object.data.type not in LOCAL:
            continue
        owner = (instance.parent if instance.is_instance else instance.object).original
        source = instance.object.original
        if owner.name_full not in visible or source.hide_render:
            continue
        reached.add(source.name_full)
        key = source.name_full
        if instance.is_instance:
            key = f"{owner.name_full}/{key}/{'.'.join(map(str, instance.persistent_id))}"
        yield key, instance.object, np.array(instance.matrix_world, np.float64)
    for name, lamp in visible.items():
        if lamp.type == "LIGHT" and lamp.data.type in LOCAL and name not in reached:
            warnings.append(f"{lamp.name}: the viewport hides it, but it lights, because a render shows it")
            yield name, lamp, np.array(lamp.matrix_world, np.float64)


def _local_light(key: str, lamp: bpy.types.Object, matrix: NDArray[np.float64],
                 warnings: list[str]) -> LocalLight | None:
    """One lamp, or None where it gives no light; what is not done is said."""
    data, name = lamp.data, lamp.name
    if not lamp.visible_diffuse:
        warnings.append(f"{name}: its ray visibility for diffuse is off, so it gives no light")
        return None
    if data.type == "AREA" and data.cycles.is_portal:
        warnings.append(f"{name}: a portal gives no light of its own, so it is left out")
        return None
    if not np.all(np.isfinite(matrix)):
        warnings.append(f"{name}: its position is no number, so it gives no light")
        return None
    colour = _colour(data, warnings)
    if not np.any(colour != 0.0):
        return None
    _say_what_is_not_done(lamp, warnings)
    if data.type == "AREA":
        return _area(key, lamp, matrix, colour, warnings)
    radius = float(data.shadow_soft_size)
    if not data.normalize:
        colour = colour * (4.0 * math.pi * radius ** 2 if radius > 0.0 else 4.0)
    check_strength(name, colour)
    cone = {"spot_angle": min(float(data.spot_size), math.pi), "spot_blend": float(data.spot_blend)} \
        if data.type == "SPOT" else {}
    return LocalLight(name, LOCAL[data.type], matrix, colour, key, radius, bool(data.use_soft_falloff),
                      shadow=bool(data.use_shadow), **cone)


def _area(key: str, lamp: bpy.types.Object, matrix: NDArray[np.float64], colour: NDArray[np.float64],
          warnings: list[str]) -> LocalLight | None:
    """An Area light; its power is spread over the face that its scale makes of its size."""
    data = lamp.data
    height = data.size_y if data.shape in {"RECTANGLE", "ELLIPSE"} else data.size
    light = LocalLight(lamp.name, "area", matrix, colour, key,
                       shape="ellipse" if data.shape in {"DISK", "ELLIPSE"} else "rectangle",
                       size=(float(data.size), float(height)), spread=float(data.spread), shadow=bool(data.use_shadow))
    if not light.area > 0.0:
        warnings.append(f"{lamp.name}: an Area light without any area gives no light")
        return None
    first, second = light.half_axes
    if abs(float(np.sum(first * second))) > SHEARED * math.sqrt(float(np.sum(first ** 2) * np.sum(second ** 2))):
        warnings.append(f"{lamp.name}: a parent shears it; it shines as the parallelogram that it has become, where "
                        "Cycles makes it brighter or darker")
    if data.normalize:
        check_strength(lamp.name, colour)
        return light
    check_strength(lamp.name, colour * light.area)
    return LocalLight(light.name, light.kind, matrix, colour * light.area, key, shape=light.shape, size=light.size,
                      spread=light.spread, shadow=light.shadow)


def _colour(data: bpy.types.Light, warnings: list[str]) -> NDArray[np.float64]:
    """Power times colour, exposure, temperature and constant nodes: (3,) W."""
    colour = np.array(data.color, np.float64) * data.energy * 2.0 ** data.exposure
    if data.use_temperature:
        colour = colour * np.array(data.temperature_color, np.float64)[:3]
    if data.node_tree is not None:
        output = data.node_tree.get_output_node("CYCLES")
        kinds = {node.bl_idname for node in reachable(output)} if output is not None else set()
        if "ShaderNodeTexIES" in kinds:
            warnings.append(f"{data.name}: its IES profile is left out, it shines by its power and shape alone")
        if "ShaderNodeLightFalloff" in kinds:
            warnings.append(f"{data.name}: its Light Falloff node is left out, its light falls off with the square of "
                            "the distance")
    return colour * node_emission(data, warnings)


def _say_what_is_not_done(lamp: bpy.types.Object, warnings: list[str]) -> None:
    """Options of a lamp that shine otherwise in a render."""
    data, linking = lamp.data, lamp.light_linking
    if linking.receiver_collection is not None:
        warnings.append(f"{lamp.name}: light linking is left out, it lights every object")
    if linking.blocker_collection is not None:
        warnings.append(f"{lamp.name}: shadow linking is left out, every object hides it")
    if not data.use_shadow:
        warnings.append(f"{lamp.name}: it casts no shadow: its direct light passes through everything, its bounced "
                        "light does not")
    if data.cycles.max_bounces < FEW_BOUNCES:
        warnings.append(f"{lamp.name}: its limit of {data.cycles.max_bounces} bounces is left out")
