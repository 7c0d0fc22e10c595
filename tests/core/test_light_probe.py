# SPDX-License-Identifier: GPL-3.0-or-later
"""What each basis would lose of a scene's shadows, against closed forms and against the error budgets of real bakes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from prt_addon.baking.light_probe import ORDERS, probe_light
from prt_addon.baking.recipe import bake, exhaust
from prt_addon.baking.settings import BakeSettings
from prt_addon.basis.spherical_harmonics import zonal_cosine
from prt_addon.lighting.reference_light import ReferenceLight
from prt_addon.scene.scene_mesh import SceneMesh
from prt_addon.tracing.tracer import Tracer
from tests.core.shapes import plane, sphere

UP = np.array([0.0, 0.0, 1.0])
SLANT = np.array([0.5, 0.3, 0.8]) / np.linalg.norm([0.5, 0.3, 0.8])


def still_life():
    return SceneMesh.assemble([plane(size=4.0, cells=40), sphere(centre=(0, 0, 0.9), radius=0.8, subdivisions=4)])


def light_of(sky=0.0, suns=()):
    return ReferenceLight.of(np.full((64, 128, 3), sky, np.float32), None, list(suns), "test")


def sun(direction=SLANT, angle=0.01, power=3.0):
    return direction, np.full(3, power), angle


def probe(scene, light, threads=1):
    return probe_light(scene, Tracer(scene.points, scene.triangles, threads), light)


def test_an_open_plane_under_a_sun_loses_what_the_cosine_has_beyond_each_order():
    """Irradiance of a sun overhead on a plane is its own cosine; an order holds the partial sums of its series."""
    found = probe(SceneMesh.assemble([plane(size=1.0, cells=8)]), light_of(suns=[sun(UP, 0.0)]))
    # max(cos, 0) = sum over l of A_l (2 l + 1) / (4 pi) P_l(cos); coefficients are those over pi.
    sums = np.cumsum(zonal_cosine(ORDERS) * (2 * np.arange(ORDERS) + 1) / 4.0)
    assert np.isclose(sums[-1], 1.0, atol=0.05)
    assert np.allclose(found.harmonics, np.abs(sums - 1.0), atol=0.012)


def test_a_uniform_sky_loses_nothing_whatever_the_shadows():
    found = probe(still_life(), light_of(1.0))
    assert max(*found.harmonics, *found.cubemaps.values()) < 5e-3


def test_no_light_has_no_error():
    found = probe(still_life(), light_of())
    assert set(found.harmonics) == {0.0} and set(found.cubemaps.values()) == {0.0}


def test_threads_change_nothing_and_rays_are_counted():
    scene, light = still_life(), light_of(0.3, [sun()])
    one, two = probe(scene, light, 1), probe(scene, light, 2)
    assert np.allclose(one.harmonics, two.harmonics, rtol=1e-6) and one.rays == two.rays
    assert one.receivers == 384 and 384 * 2000 < one.rays < 384 * 8000


@pytest.mark.parametrize("name", ["sun and sky", "one bright pixel", "a lamp-lit room of sky"])
def test_it_foretells_what_bakes_then_measure(name):
    """The budget's own error of the basis, path traced with all bounces under the same light, at other receivers."""
    image = np.full((64, 128, 3), 0.3, np.float32)
    suns = [sun()] if name == "sun and sky" else []
    if name == "one bright pixel":
        image[12, 50] = 2000.0
    if name == "a lamp-lit room of sky":
        image[8:20, 20:40] = 8.0
        image[30:34, 90:100] = 15.0
    light = ReferenceLight.of(image, None, suns, name)
    scene = still_life()
    found = probe(scene, light)
    settings = BakeSettings(directions=2048, gather_directions=64, clusters=16, vectors=6, encoder="static",
                            spacing=0.0, error_receivers=96, error_paths=4096, threads=1, order=4)
    for foretold, more in ((found.harmonics[3], {}), (found.cubemaps[8], {"distant_basis": "cubemap",
                                                                          "cubemap_size": 8})):
        basis = exhaust(bake(scene, replace(settings, **more), light=light)).report["errors"]["basis"]
        assert 0.4 * foretold < basis["relative_rms"] < 1.5 * foretold, (more, foretold, basis)
