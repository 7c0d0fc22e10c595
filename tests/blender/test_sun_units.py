# SPDX-License-Identifier: GPL-3.0-or-later
"""The Sun lamp's units, disc and direction against Cycles on white planes.

Compared at an order far above the baked one, where the light's truncation is a thousandth, so that the units
themselves are tested; one test says what order 10 makes of it.
"""

from __future__ import annotations

import math

import bpy
import numpy as np
import pytest

from prt_addon.basis.spherical_harmonics import evaluate, zonal_cosine
from prt_addon.lighting.analytic import sun
from prt_addon.lighting.environment import apply_bands
from tests.blender.cycles import add_white_facets, baked_irradiance, use_cycles

# A plane that looks up, planes tilted by 45 and 60 degrees, and one that faces away from a lamp overhead.
NORMALS = np.array([[0, 0, 1], [math.sqrt(0.5), 0, math.sqrt(0.5)], [0, -math.sqrt(0.75), 0.5], [0, 0.6, -0.8]])


def add_sun(strength: float, angle: float, tilt: tuple[float, float, float], normalize: bool) -> bpy.types.Object:
    lamp = bpy.data.lights.new("Sun", "SUN")
    lamp.energy, lamp.angle, lamp.color, lamp.normalize = strength, angle, (1.0, 0.5, 0.25), normalize
    placed = bpy.data.objects.new("Sun", lamp)
    placed.rotation_euler = tilt
    bpy.context.scene.collection.objects.link(placed)
    bpy.context.view_layer.update()
    return placed


def our_irradiance(placed: bpy.types.Object, order: int) -> np.ndarray:
    lamp = placed.data
    direction = np.array(placed.matrix_world.to_3x3())[:, 2]  # a lamp shines along its -Z
    light = sun(direction, lamp.energy * np.array(lamp.color), lamp.angle, order, lamp.normalize)
    return evaluate(order, NORMALS) @ apply_bands(light, zonal_cosine(order))


@pytest.mark.parametrize("normalize", [True, False])
@pytest.mark.parametrize("degrees", [0.0, 0.526, 40.0, 120.0, 180.0])
@pytest.mark.usefixtures("scene")
def test_units_and_angle_equal_cycles(degrees: float, normalize: bool) -> None:
    use_cycles(1024 if degrees > 1 else 64)
    # Strengths so that the plane below is lit by about 1 either way.
    placed = add_sun(3.0, math.radians(degrees), (0.0, 0.0, 0.0), normalize)
    theirs, ours = baked_irradiance(add_white_facets(NORMALS)), our_irradiance(placed, 80)
    np.testing.assert_allclose(ours[:3], theirs[:3], rtol=5e-3)
    np.testing.assert_allclose(ours[3], theirs[3], atol=5e-3 * theirs.max())


@pytest.mark.usefixtures("scene")
def test_direction_of_a_turned_lamp_and_what_order_10_makes_of_it() -> None:
    use_cycles(64)
    placed = add_sun(5.0, 0.009, (0.9, 0.3, -0.5), True)
    theirs = baked_irradiance(add_white_facets(NORMALS))
    np.testing.assert_allclose(our_irradiance(placed, 80), theirs, atol=5e-3 * theirs.max())
    np.testing.assert_allclose(our_irradiance(placed, 10), theirs, atol=2.5e-2 * theirs.max())
