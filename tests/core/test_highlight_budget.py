# SPDX-License-Identifier: GPL-3.0-or-later
"""The reference for highlights against quadratures, and the error budget that is made of it where answers are known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from prt_addon.baking.distant_basis import DistantBasis
from prt_addon.baking.highlight_budget import VIEWS, Measurement, measure
from prt_addon.baking.highlight_reference import ALL_HITS, TrueSurfaces
from prt_addon.baking.highlight_sampling import TrueHighlight, cosine_directions, even_directions, lattice
from prt_addon.baking.recipe import bake, exhaust
from prt_addon.baking.settings import make_settings
from prt_addon.baking.surfaces import plan_surfaces
from prt_addon.basis.hemisphere import functions_of
from prt_addon.basis.spherical_harmonics import evaluate
from prt_addon.lighting.environment import direction_of_pixel
from prt_addon.lighting.reference_light import ReferenceLight
from prt_addon.scene.scene_mesh import SceneMesh
from prt_addon.scene.surface_material import SurfaceMaterial
from prt_addon.tracing.tracer import Tracer
from prt_addon.transport.brdf import reflection_of_material
from prt_addon.transport.glossy import surface_frames
from prt_addon.transport.receiver_set import ReceiverSet
from prt_addon.transport.reflectance import PrincipledLobe
from tests.core.shapes import drain, plane, sphere

METAL = SurfaceMaterial("metal", (1.0, 1.0, 1.0), roughness=0.5, metallic=1.0, specular_level=0.5)
GOLD = replace(METAL, base_colour=(1.0, 0.7, 0.3), roughness=0.35)
BRUSHED = replace(GOLD, anisotropic=0.8, anisotropic_rotation=0.15)
PLASTIC = SurfaceMaterial("plastic", (0.6, 0.6, 0.6), roughness=0.5, specular_level=0.5)
FEW = {"directions": "1024", "spacing": "0", "threads": "1", "clusters": "32", "encoder": "static",
       "compression_error": "0", "error_receivers": "48", "error_paths": "2048"}


def image_of(radiance, height=64):
    """An equirectangular image (height, 2 height, 3) of radiance(directions) -> (..., 3)."""
    rows, columns = np.arange(height)[:, None], np.arange(2 * height)[None, :]
    return radiance(direction_of_pixel(rows, columns, height, 2 * height))


def light_of(radiance, height=64):
    return ReferenceLight.of(image_of(radiance, height), None, [], "a test light")


def noise_light(order, seed=4):
    """Light with equal energy in every coefficient of an order, which no surface may mistake for a lamp."""
    coefficients = np.random.Generator(np.random.PCG64(seed)).standard_normal((order * order, 3))

    def radiance(directions):
        return np.sum(evaluate(order, directions.reshape(-1, 3))[:, :, None] * coefficients,
                      axis=1).reshape(*directions.shape[:-1], 3)

    return light_of(radiance)


def budget(meshes, light, **options):
    scene = SceneMesh.assemble(meshes if isinstance(meshes, list) else [meshes])
    settings = make_settings("standard", FEW | {name: str(value) for name, value in options.items()})
    return exhaust(bake(scene, settings, light=light)).report["highlight_errors"]


def ball(material, **options):
    return replace(sphere(subdivisions=3, albedo=(0, 0, 0), **options), materials=(material,))


@pytest.mark.parametrize("material", [METAL, GOLD, BRUSHED, PLASTIC])
def test_sampled_and_evaluated_highlight_agree_with_the_quadrature(material):
    """The same radiance under a light of order 4 by three ways that share Fresnel's curves alone."""
    lobe, highlight = PrincipledLobe(material), TrueHighlight(material)
    generator = np.random.Generator(np.random.PCG64(5))
    coefficients = generator.standard_normal(16) * 0.3
    coefficients[0] = 3.0
    views = cosine_directions(generator.random((5, 2)))
    own = highlight._turned(views, -lobe.turn)
    scattered = lobe.scatter(own)
    turned = highlight._turned(scattered.directions.reshape(-1, 3), lobe.turn)
    light = np.sum(evaluate(4, turned) * coefficients, axis=1).reshape(scattered.directions.shape[:2])
    expected = np.broadcast_to(np.sum(scattered.weights * light[:, :, None], axis=1), (5, 3))
    count = 1 << 15
    for view, right in zip(views, expected, strict=True):
        many = np.broadcast_to(view, (count, 3))
        directions, weights = highlight.sample(many, lattice(1, count, generator))
        arriving = np.sum(evaluate(4, directions) * coefficients, axis=1)
        np.testing.assert_allclose((weights * arriving[:, None]).mean(axis=0), right, rtol=4e-3)
        even = even_directions(lattice(1, count, generator))
        arriving = 2.0 * np.pi * np.sum(evaluate(4, even) * coefficients, axis=1)
        np.testing.assert_allclose((highlight.evaluate(many, even) * arriving[:, None]).mean(axis=0), right, rtol=2e-2)


def test_diffuse_layer_below_a_highlight_is_dimmed_as_the_lobe_says():
    views = cosine_directions(np.random.Generator(np.random.PCG64(1)).random((200, 2)))
    np.testing.assert_allclose(TrueHighlight(PLASTIC).diffuse_left(views), PrincipledLobe(PLASTIC).dimming(views),
                               atol=2e-3)


def test_a_white_metal_in_a_white_world_shows_no_error_of_light_or_bounces():
    errors = budget(ball(METAL), light_of(lambda d: np.ones((*d.shape[:-1], 3))))
    assert set(errors) == {"sampling", "rows", "basis", "bounces", "compression", "total"}
    assert errors["bounces"]["relative_rms"] == 0.0  # nothing is met
    assert errors["basis"]["relative_rms"] < 1e-3
    assert errors["total"]["relative_rms"] < 0.01


@pytest.mark.parametrize("rows", [4, 9, 16])
def test_error_of_the_rows_is_what_the_basis_can_not_hold(rows):
    """Against the quadrature of the lobe: 1 - the squared error over pixels and lights of the order."""
    errors = budget(ball(GOLD), noise_light(5), glossy_rows=rows, glossy_window="false", error_receivers=96)
    missing = np.sqrt(1.0 - reflection_of_material(GOLD, 5).held_by_rows(functions_of(rows)))
    assert errors["rows"]["relative_rms"] == pytest.approx(missing, rel=0.1)
    assert errors["basis"]["relative_rms"] < 0.03  # the light has no more (its image has pixels)
    assert errors["sampling"]["relative_rms"] < 0.2 * missing + 0.02


def test_light_above_the_order_is_missed_and_said_so():
    errors = budget(ball(replace(METAL, roughness=0.3)), noise_light(8), order=4, glossy_window="false")
    low, high = errors["basis"]["interval"]
    assert 0.3 < low < high < 0.9
    assert errors["total"]["relative_rms"] == pytest.approx(
        np.sqrt(sum(errors[name]["relative_rms"] ** 2 for name in ("sampling", "rows", "basis"))), rel=0.2)


def test_bounces_between_sharp_metals_are_missed_only_where_they_are_not_recorded():
    """Two mirrors-to-be face each other: what a path meets first is recorded, what it meets then is taken as even."""
    meshes = [replace(plane("low", size=3.0, cells=6, albedo=(0, 0, 0)), materials=(GOLD,)),
              replace(plane("high", size=3.0, cells=6, height=0.8, up=False, albedo=(0, 0, 0)), materials=(GOLD,))]
    errors = budget(meshes, None)
    assert errors["bounces"]["interval"][0] > 0.02
    assert set(errors["total"]["objects"]) == {"low", "high"}
    assert budget(meshes, None, bounces=0)["bounces"]["relative_rms"] == 0.0
    assert budget(meshes, None, bounces=1)["bounces"]["relative_rms"] == 0.0


def measured_highlights(light, material=GOLD):
    """True highlights (2, k, views, 3) of a ball."""
    scene = SceneMesh.assemble([ball(material)])
    tracer = Tracer(scene.points, scene.triangles, 1)
    plan = plan_surfaces(scene, make_settings("standard"))
    keys = np.arange(0, 640, 16)
    receivers = ReceiverSet.of_keys(scene, tracer, keys)
    receivers = receivers.taken(np.argsort(receivers.key))
    frames = surface_frames(scene.normals[keys], scene.tangents[keys])
    views = cosine_directions(lattice(len(keys), VIEWS, np.random.Generator(np.random.PCG64(2)))).reshape(-1, VIEWS, 3)
    surfaces = TrueSurfaces.of(tracer, scene, plan, scene.albedo)
    task = Measurement(surfaces, receivers, frames, views, light, DistantBasis(5), -1, (0, ALL_HITS), 4096, 4)
    return drain(measure(task, scene.material[keys])).full


def test_a_sun_gives_the_highlight_of_the_same_disc_in_the_environment():
    towards, angle, irradiance = np.array([0.6, 0.0, 0.8]), 0.7, np.array([3.0, 2.0, 1.0])
    disc = irradiance / (np.pi * np.sin(angle / 2) ** 2)
    black = image_of(lambda d: np.zeros((*d.shape[:-1], 3)))
    by_sun = measured_highlights(ReferenceLight.of(black, None, [(towards, irradiance, angle)], "a sun"))
    inside = light_of(lambda d: np.where((np.sum(d * towards, axis=-1) > np.cos(angle / 2))[..., None], disc, 0.0), 512)
    by_image = measured_highlights(inside)
    difference = np.sum((by_sun - by_image)[0] * (by_sun - by_image)[1]) / np.sum(by_image[0] * by_image[1])
    assert abs(difference) < 0.03 ** 2
    assert by_sun.mean() == pytest.approx(by_image.mean(), rel=0.02)
