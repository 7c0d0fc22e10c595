# SPDX-License-Identifier: GPL-3.0-or-later
"""Lamps on bakes of distant light: like a sun from afar, like rays outside the hull, in both kinds of columns."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from prt_addon.baking.recipe import bake, exhaust
from prt_addon.baking.settings import BakeSettings
from prt_addon.basis.spherical_harmonics import expand_bands
from prt_addon.lighting.analytic import sun
from prt_addon.lighting.cubemap_light import sun_texels
from prt_addon.lighting.local_lights import LocalLight
from prt_addon.lighting.windowing import remove_ringing
from prt_addon.relighting.direct_light import LitReceivers, direct_local_light
from prt_addon.relighting.distant_lamps import distant_lamp_radiance
from prt_addon.relighting.exit_radiance import baked_constants, exit_radiance
from prt_addon.relighting.lamp_light import unit_lamp
from prt_addon.relighting.nearest_directions import Hull, inside_hull
from prt_addon.scene.scene_mesh import SceneMesh
from prt_addon.scene.surface_material import SurfaceMaterial
from prt_addon.tracing.tracer import Tracer
from tests.core.shapes import plane, sphere

QUICK = BakeSettings(order=6, directions=1024, gather_directions=32, bounces=0, encoder="static", clusters=32,
                     vectors=8, spacing=0.0, error_receivers=0, glossy_rows=9, threads=1)
KINDS = {"harmonics": {}, "cubemap": {"distant_basis": "cubemap", "cubemap_size": 8},
         "eigentransport": {"distant_basis": "cubemap", "cubemap_size": 16, "encoder": "eigentransport",
                            "vectors": 128}}
PLACE = np.array([1.5, 2.0, 4.0])


def still_life(metal=False):
    ball = sphere(centre=(0, 0, 0.9), radius=0.8, subdivisions=3)
    if metal:
        gold = SurfaceMaterial(metallic=1.0, roughness=0.5, base_colour=(0.9, 0.7, 0.3))
        ball = replace(ball, corner_albedo=np.zeros_like(ball.corner_albedo), materials=(gold,),
                       material_index=np.zeros(len(ball.triangles), np.int32))
    return SceneMesh.assemble([plane(size=4.0, cells=20), ball])


@pytest.fixture(scope="module", params=KINDS)
def baked(request):
    return exhaust(bake(still_life(), replace(QUICK, **KINDS[request.param]))).objects


def rms(found, truth):
    return float(np.sqrt(np.sum((found - truth) ** 2) / np.sum(truth ** 2)))


def rows_under(container, light):
    return exit_radiance(container.cluster, container.weights, baked_constants(container, light))


def lamp_at(place, power=4.0 * math.pi, **more):
    return replace(unit_lamp(np.asarray(place)), power=np.full(3, power) * (1.0, 0.5, 0.25), **more)


def truth(lamp):
    scene = still_life()
    tracer = Tracer(scene.points, scene.triangles, 1)
    receivers = LitReceivers.of_points(tracer, scene.points, scene.normals)
    return direct_local_light(tracer, receivers, [lamp], 64), scene


def all_of(baked, lamps):
    return np.concatenate([distant_lamp_radiance(container, lamps)[:, 0] for container in baked.values()])


def test_from_afar_a_lamp_is_a_sun(baked):
    far, towards = 1e4, PLACE / np.linalg.norm(PLACE)
    for container in baked.values():
        size = container.lighting_basis.cubemap
        light = sun_texels(towards, np.ones(3), 0.0, size) if size else sun(towards, np.ones(3), 0.0, 6)
        found = distant_lamp_radiance(container, [lamp_at(far * towards, 4.0 * math.pi * far ** 2)])
        expected = rows_under(container, light.astype(np.float32)) * (1.0, 0.5, 0.25)
        assert rms(found, expected) < 2e-3


def test_outside_the_hull_it_is_as_rays_say_within_the_columns_resolution(baked):
    exact, scene = truth(lamp_at(PLACE))
    assert not inside_hull(scene.points, PLACE)[0]
    found = all_of(baked, [lamp_at(PLACE)])
    assert rms(found, exact) < 0.16 and abs(found.sum() / exact.sum() - 1.0) < 0.03
    swapped = all_of(baked, [lamp_at(PLACE * (-1.0, 1.0, 1.0))])
    assert rms(swapped, exact) > 0.3


def test_spots_and_areas_shine_as_they_do(baked):
    down = np.eye(4)
    down[:3, 3] = (0.8, 0.0, 5.0)
    for lamp in (LocalLight("Spot", "spot", down, np.full(3, 100.0), spot_angle=0.7, spot_blend=0.5),
                 LocalLight("Area", "area", down, np.full(3, 100.0), size=(2.0, 2.0))):
        exact, _ = truth(lamp)
        assert rms(all_of(baked, [lamp]), exact) < 0.13, lamp.kind


def test_lamps_add_up_and_none_gives_nothing(baked):
    one, other = lamp_at(PLACE), lamp_at(PLACE * (-1.0, 1.0, 1.0))
    for container in baked.values():
        both = distant_lamp_radiance(container, [one, other])
        parts = distant_lamp_radiance(container, [one]) + distant_lamp_radiance(container, [other])
        assert np.allclose(both, parts, atol=1e-5 * np.abs(parts).max())
        assert not distant_lamp_radiance(container, []).any()


def test_numbers_out_of_reach_stay_numbers(baked):
    for place, power in (((0.0, 0.0, 1e30), 1e30), ((0.0, 0.0, 4.0), 1e300), (tuple(still_life().points[0]), 1.0)):
        for container in baked.values():
            with np.errstate(over="ignore", invalid="ignore"):
                assert not np.isnan(distant_lamp_radiance(container, [lamp_at(place, power)])).any()


def test_highlights_follow_the_lamp():
    """In rows of the view, too: as a sun from the same side, softened alike."""
    objects = exhaust(bake(still_life(metal=True), QUICK)).objects
    container = next(c for c in objects.values() if c.bases.shape[2] > 1)
    far, towards = 1e4, PLACE / np.linalg.norm(PLACE)
    found = distant_lamp_radiance(container, [lamp_at(far * towards, 4.0 * math.pi * far ** 2)])
    expected = rows_under(container, sun(towards, np.ones(3), 0.0, 6).astype(np.float32)) * (1.0, 0.5, 0.25)
    assert found.shape[1] == 10 and rms(found[:, 1:], expected[:, 1:]) < 0.02


def test_ringing_is_softened_as_that_of_a_sun():
    container = exhaust(bake(still_life(), QUICK)).objects["plane"]
    plain, soft = (distant_lamp_radiance(container, [lamp_at(PLACE)], window)[:, 0] for window in (False, True))
    assert plain.min() < -1e-3 and soft.min() > 0.3 * plain.min()
    far, towards = 1e4, PLACE / np.linalg.norm(PLACE)
    light = sun(towards, np.ones(3), 0.0, 6)
    softened = (light * expand_bands(remove_ringing(light).factors)[:, None]).astype(np.float32)
    found = distant_lamp_radiance(container, [lamp_at(far * towards, 4.0 * math.pi * far ** 2)], True)
    assert rms(found, rows_under(container, softened) * (1.0, 0.5, 0.25)) < 0.02


def test_a_hull_answers_as_often_as_asked():
    hull = Hull(still_life().points)
    assert list(hull.inside([[0.0, 0.0, 1.0], [0.0, 0.0, 1.8], [1.9, 1.9, 1.0]])) == [True, False, False]
    assert not Hull(np.zeros((2, 3))).inside([[0.0, 0.0, 0.0]])[0]
