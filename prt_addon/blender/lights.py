# SPDX-License-Identifier: GPL-3.0-or-later
"""The light that an environment bake can show, as one set of coefficients: the World or a file, and Suns."""

from __future__ import annotations

from collections.abc import Hashable, Iterable
from dataclasses import dataclass
from os import PathLike
from typing import Any

import bpy
import numpy as np
from numpy.typing import NDArray

from ..basis.spherical_harmonics import rotate
from ..lighting.analytic import sun
from ..lighting.cubemap_light import sun_texels
from ..lighting.distant_light import DistantLight
from ..lighting.environment import apply_bands, band_energies, world_rotation
from ..lighting.reference_light import ReferenceLight
from ..lighting.windowing import remove_ringing
from ..storage.columns import Columns
from ..storage.digests import digest_arrays
from .nodes import constant_of, source_of
from .visibility import render_visible_objects
from .world import EnvironmentSource, check_strength, read_environment, read_environment_file


@dataclass(frozen=True)
class Light:
    """coefficients: (order^2, 3) float64, radiance in linear Rec.709.

    parts: per source name, kind, energy (integral of squared radiance that the coefficients hold) and truncation (the
    share 0..1 that they do not hold; None for a Sun, where nearly all of it is out of reach of any order). warnings:
    what gives no light and why. signature: equal exactly if the coefficients are.
    """

    coefficients: NDArray[np.float64]
    parts: list[dict[str, Any]]
    warnings: list[str]
    signature: Hashable


@dataclass(frozen=True)
class SunLight:
    """A Sun: direction (3,) to it, irradiance (3,) W/m^2 on a facing surface, full angle of its disc in radians."""

    name: str
    direction: NDArray[np.float64]
    irradiance: NDArray[np.float64]
    angle: float


def light_coefficients(scene: bpy.types.Scene, depsgraph: bpy.types.Depsgraph, order: int,
                       environment_override: str | PathLike[str] | None = None, rotate_degrees: float = 0.0,
                       use_scene_lights: bool = True, window: bool = False, name_lamps: bool = True) -> Light:
    """The scene's light up to `order` (1 to 10).

    environment_override: an equirectangular file in place of the World. rotate_degrees: a further Z rotation, as the
    World's Mapping node (type Point) means it; Suns do not turn along. use_scene_lights: with Suns. window: take the
    ringing out where the light rings. name_lamps: warn of lamps near the scene, which are no part of this.
    Raises PRTError naming a missing or broken image.
    """
    environment = _environment(scene, depsgraph, environment_override)
    warnings = list(environment.warnings)
    rotation = world_rotation(rotate_degrees) @ environment.rotation  # small
    coefficients = rotate(environment.projected.coefficients[:order * order], rotation) * environment.scale
    parts = [_part(environment.name, environment.kind, coefficients, environment.projected.truncation(order))]
    for lamp in read_suns(depsgraph, warnings, name_lamps) if use_scene_lights else ():
        added = sun(lamp.direction, lamp.irradiance, lamp.angle, order)
        parts.append(_part(lamp.name, "sun", added, None))
        coefficients = coefficients + added
    if window:
        windowing = remove_ringing(coefficients)
        if windowing.rings:
            coefficients = apply_bands(coefficients, windowing.factors)
            parts.append({"name": "window", "kind": "window", "cost": windowing.cost, "strength": windowing.strength})
    coefficients = np.ascontiguousarray(coefficients, np.float64)
    return Light(coefficients, parts, warnings, digest_arrays(coefficients))


def light_texels(scene: bpy.types.Scene, depsgraph: bpy.types.Depsgraph, size: int,
                 environment_override: str | PathLike[str] | None = None, rotate_degrees: float = 0.0,
                 use_scene_lights: bool = True, name_lamps: bool = True) -> Light:
    """The scene's light as mean radiance (6 size^2, 3) of a cubemap's texels. Arguments and errors as for
    `light_coefficients`; nothing rings, so there is no window, and no part is truncated: what is finer than a texel is
    averaged over it."""
    environment = _environment(scene, depsgraph, environment_override)
    warnings = list(environment.warnings)
    rotation = world_rotation(rotate_degrees) @ environment.rotation  # small
    texels = environment.projected.texels(size).turned(rotation) * environment.scale
    for lamp in read_suns(depsgraph, warnings, name_lamps) if use_scene_lights else ():
        texels = texels + sun_texels(lamp.direction, lamp.irradiance, lamp.angle, size)
    texels = np.ascontiguousarray(texels, np.float64)
    return Light(texels, [], warnings, digest_arrays(texels))


def distant_light(scene: bpy.types.Scene, depsgraph: bpy.types.Depsgraph, columns: Iterable[Columns],
                  environment_override: str | PathLike[str] | None = None, rotate_degrees: float = 0.0,
                  use_scene_lights: bool = True, window: bool = False, name_lamps: bool = True,
                  ) -> tuple[DistantLight, list[str], Hashable]:
    """The scene's distant light for bakes of all these columns, warnings, and a signature that is equal exactly if the
    light is. Arguments and errors as for `light_coefficients`."""
    columns = list(columns)
    order = max((found.order for found in columns), default=0)
    sizes = sorted({found.cubemap for found in columns} - {0})
    rest = (environment_override, rotate_degrees, use_scene_lights)
    harmonics = light_coefficients(scene, depsgraph, order, *rest, window, name_lamps) if order else None
    texels = {size: light_texels(scene, depsgraph, size, *rest, name_lamps) for size in sizes}
    all_found = [found for found in (harmonics, *texels.values()) if found is not None]
    warnings = dict.fromkeys(line for found in all_found for line in found.warnings)
    light = DistantLight(None if harmonics is None else harmonics.coefficients,
                         {size: found.coefficients for size, found in texels.items()})
    return light, list(warnings), (order, *sizes, *(found.signature for found in all_found))


def environment_picture(scene: bpy.types.Scene, depsgraph: bpy.types.Depsgraph,
                        environment_override: str | PathLike[str] | None = None, rotate_degrees: float = 0.0,
                        ) -> tuple[NDArray[np.float32], NDArray[np.float64]]:
    """What stands behind the scene: the environment averaged to a small equirectangular picture (h, w, 3), and its
    rotation (3, 3). Arguments and errors as for `light_coefficients`."""
    environment = _environment(scene, depsgraph, environment_override)
    picture = environment.projected.small * environment.scale.astype(np.float32)
    return picture, world_rotation(rotate_degrees) @ environment.rotation  # small


def reference_light(depsgraph: bpy.types.Depsgraph) -> ReferenceLight | None:
    """The scene's whole light for the error budget; None where there is none. Raises PRTError as above."""
    environment = read_environment(depsgraph.scene, depsgraph)
    suns = read_suns(depsgraph, [])
    if environment.is_black and not suns:
        return None
    image = environment.projected.small * environment.scale.astype(np.float32)
    names = [] if environment.is_black else [environment.name]
    return ReferenceLight.of(image, environment.rotation, [(s.direction, s.irradiance, s.angle) for s in suns],
                             ", ".join(names + [s.name for s in suns]))


def _environment(scene: bpy.types.Scene, depsgraph: bpy.types.Depsgraph,
                 override: str | PathLike[str] | None) -> EnvironmentSource:
    return read_environment(scene, depsgraph) if override is None else read_environment_file(override)


def _part(name: str, kind: str, coefficients: NDArray[np.float64], truncation: float | None) -> dict[str, Any]:
    return {"name": name, "kind": kind, "energy": float(band_energies(coefficients).sum()), "truncation": truncation}


def read_suns(depsgraph: bpy.types.Depsgraph, warnings: list[str], name_lamps: bool = True) -> list[SunLight]:
    """Suns that a render shows, instanced ones too; other lights are named in `warnings` where name_lamps."""
    visible = render_visible_objects(depsgraph.view_layer)
    found: list[SunLight] = []
    reached: set[str] = set()
    for instance in depsgraph.object_instances:
        owner = (instance.parent if instance.is_instance else instance.object).original
        source = instance.object.original
        if instance.object.type != "LIGHT" or owner.name_full not in visible or source.hide_render:
            continue
        reached.add(source.name_full)
        if name_lamps or instance.object.data.type == "SUN":
            _add(found, instance.object, np.array(instance.matrix_world, np.float64), warnings)
    for name, lamp in visible.items():
        if lamp.type == "LIGHT" and name not in reached and (name_lamps or lamp.data.type == "SUN"):
            warnings.append(f"{lamp.name}: the viewport hides it, but it lights, because a render shows it")
            _add(found, lamp, np.array(lamp.matrix_world, np.float64), warnings)
    return found


def _add(found: list[SunLight], lamp: bpy.types.Object, matrix: NDArray[np.float64], warnings: list[str]) -> None:
    """Append a lamp if it is a Sun that gives light; say why not otherwise."""
    data = lamp.data
    if data.type != "SUN":
        warnings.append(f"{lamp.name}: a {data.type.title()} light is near the scene, not part of an environment bake")
        return
    if not lamp.visible_diffuse:
        warnings.append(f"{lamp.name}: its ray visibility for diffuse is off, so it gives no light")
        return
    colour = np.array(data.color, np.float64) * data.energy * 2.0 ** data.exposure
    if data.use_temperature:
        colour = colour * np.array(data.temperature_color, np.float64)[:3]
    colour = colour * _emission(data, warnings)
    angle = min(float(data.angle), np.pi)
    if not data.normalize and angle > 0.0:
        # Without normalising the strength is the disc's radiance (lighting/analytic.py).
        colour = colour * np.pi * np.sin(angle / 2.0) ** 2
    check_strength(lamp.name, colour)
    direction = matrix[:3, 2]  # a lamp shines along its own -Z
    length = float(np.sqrt(np.sum(direction ** 2)))
    if 0.0 < length < np.inf and np.any(colour != 0.0):
        found.append(SunLight(lamp.name, direction / length, colour, angle))


def _emission(data: bpy.types.Light, warnings: list[str]) -> NDArray[np.float64]:
    """The factor (3,) of a light's own nodes: an Emission of constant colour and strength."""
    if data.node_tree is None:
        return np.ones(3)
    output = data.node_tree.get_output_node("CYCLES")
    surface = source_of(output.inputs["Surface"]) if output is not None else None
    if surface is None:
        return np.zeros(3)
    if surface.bl_idname == "ShaderNodeEmission" and not surface.mute:
        colour, strength = constant_of(surface.inputs["Color"]), constant_of(surface.inputs["Strength"])
        if colour is not None and strength is not None:
            return np.array(colour[:3], np.float64) * strength
    warnings.append(f"{data.name}: its nodes are more than a constant Emission and are ignored")
    return np.ones(3)
