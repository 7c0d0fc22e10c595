# SPDX-License-Identifier: GPL-3.0-or-later
"""Reflection models against closed forms and plain integration, their matrices against radiance integrated directly."""

from __future__ import annotations

import math
import time
from collections.abc import Callable

import numpy as np
import pytest

from prt_addon.basis import hemisphere
from prt_addon.basis import spherical_harmonics as sh
from prt_addon.basis.hemisphere import functions_of
from prt_addon.scene.surface_material import SurfaceMaterial
from prt_addon.transport import brdf, reflectance
from prt_addon.transport.reflectance import PhongLobe, PrincipledLobe, meridian

WHITE_METAL = {"metallic": 1.0, "base_colour": (1.0, 1.0, 1.0)}
ROUGHNESS = (0.1, 0.2, 0.3, 0.5, 0.8, 1.0)


def grid(heights: int, azimuths: int) -> tuple[np.ndarray, np.ndarray]:
    """Directions of the upper hemisphere and weights, sum 2 pi; written for these tests alone."""
    z, weights = np.polynomial.legendre.leggauss(heights)
    z = (z[:, None] + 1) / 2
    phi = 2 * np.pi * (np.arange(azimuths)[None, :] + 0.25) / azimuths
    radius = np.sqrt(1 - z * z)
    directions = np.stack([radius * np.cos(phi), radius * np.sin(phi), z + 0 * phi], axis=-1).reshape(-1, 3)
    return directions, np.repeat(weights / 2 * 2 * np.pi / azimuths, azimuths)


def ggx(view: np.ndarray, lights: np.ndarray, alpha_x: float, alpha_y: float) -> np.ndarray:
    """Single-bounce GGX without Fresnel, value f (n,), straight from Heitz 2014 (eqs. 72, 85, 86, 99)."""
    half = lights + view
    half /= np.linalg.norm(half, axis=1, keepdims=True)
    density = 1 / (np.pi * alpha_x * alpha_y
                   * ((half[:, 0] / alpha_x) ** 2 + (half[:, 1] / alpha_y) ** 2 + half[:, 2] ** 2) ** 2)

    def masked(d: np.ndarray) -> np.ndarray:
        a = ((d[..., 0] * alpha_x) ** 2 + (d[..., 1] * alpha_y) ** 2) / d[..., 2] ** 2
        return (np.sqrt(1 + a) - 1) / 2

    return density / (1 + masked(view) + masked(lights)) / (4 * view[2] * lights[:, 2])


def smooth_light(directions: np.ndarray) -> np.ndarray:
    return np.exp(1.5 * directions @ np.array([0.5, -0.3, 0.6]))


def norm_over_hemisphere(functions: np.ndarray, coefficients: np.ndarray) -> float:
    matrix = hemisphere.gram_matrix(functions)
    flat = coefficients.reshape(len(functions), -1)
    return math.sqrt(np.sum(flat * (matrix @ flat)))


def turn_about_z(angle: float) -> np.ndarray:
    return np.array([[math.cos(angle), -math.sin(angle), 0], [math.sin(angle), math.cos(angle), 0], [0, 0, 1]])


# ---- models

def test_single_bounce_albedo_has_its_closed_form() -> None:
    """At alpha 1 seen from the normal E = 1 - ln 2: D = 1 / pi and masking is 2 z / (1 + z), integrated by hand."""
    albedo = reflectance.single_bounce_albedo(1.0, np.array([1.0]))
    assert albedo[0] == pytest.approx(1 - math.log(2), abs=1e-9)


@pytest.mark.parametrize(("alpha_x", "alpha_y"), [(0.25, 0.25), (0.6, 0.6), (1.0, 1.0), (0.9, 0.2)])
def test_nodes_integrate_as_a_plain_grid_does(alpha_x: float, alpha_y: float) -> None:
    lights, weights = grid(300, 600)
    for view in np.array([[0.0, 0.0, 1.0], [0.48, 0.36, 0.8], [-0.3, 0.9, math.sqrt(0.1)]]):
        expected = np.sum(weights * ggx(view, lights, alpha_x, alpha_y) * lights[:, 2] * smooth_light(lights))
        facets = reflectance.visible_facets(alpha_x, alpha_y, view[None])
        found = np.sum(facets.unblocked[0] * smooth_light(facets.lights[0]))
        assert found == pytest.approx(expected, rel=3e-4)


def test_grazing_views_of_smooth_lobes() -> None:
    """The hardest nodes (three crossings of the horizon): against sixteen times as many of them."""
    z = np.array([0.02, 0.05, 0.1, 0.3])
    for alpha in (0.0025, 0.01, 0.04, 0.1, 0.3):
        fine = reflectance.visible_facets(alpha, alpha, meridian(z), 320, 320).unblocked.sum(axis=1)
        np.testing.assert_allclose(reflectance.single_bounce_albedo(alpha, z), fine, atol=1e-3)


def test_kernel_at_the_nodes_is_the_brdf_and_reciprocal() -> None:
    views, _ = grid(4, 5)
    facets = reflectance.visible_facets(0.5, 0.2, views, 6, 8)
    for view, lights, kernel in zip(views, facets.lights, facets.kernel, strict=True):
        above = lights[:, 2] > 1e-6
        expected = ggx(view, lights[above], 0.5, 0.2)
        np.testing.assert_allclose(kernel[above] / lights[above, 2], expected, rtol=1e-9)
        back = [ggx(light, view[None], 0.5, 0.2)[0] for light in lights[above]]
        np.testing.assert_allclose(expected, back, rtol=1e-9)


@pytest.mark.parametrize("lobe", [PhongLobe(20.0), PrincipledLobe(SurfaceMaterial(roughness=0.6, **WHITE_METAL), False),
                                  PrincipledLobe(SurfaceMaterial(roughness=0.6, specular_level=0.5, anisotropic=0.6,
                                                                 specular_tint=(1.0, 0.6, 0.3)), False)])
def test_reciprocity_of_the_matrices(lobe: reflectance.Lobe) -> None:
    """The integral of y_i(v) cos(v) f cos(s) y_j(s) is symmetric where f is reciprocal.

    Only without compensation: as in Cycles, what several bounces bring back is a factor of the view alone.
    """
    reflection = brdf.reflection_of(lobe, 6)
    functions = np.arange(36)
    tilted = brdf.Reflection(reflection.views, 6, reflection.radiance * reflection.views.directions[:, 2, None, None],
                             reflection.squares, 0.0)
    matrix = tilted.integrals(functions)
    assert np.abs(matrix - matrix.transpose(1, 0, 2)).max() < 1e-4 * np.abs(matrix).max()
    assert np.abs(reflection.integrals(functions) - reflection.integrals(functions).transpose(1, 0, 2)).max() > 1e-3


@pytest.mark.parametrize("exponent", [1.0, 10.0, 100.0])
def test_phong_has_its_closed_form_at_the_normal(exponent: float) -> None:
    """From the normal the lobe is cos^n(s): radiance of z^k is (n + 2) / (n + k + 2), and (f cos)^2 integrates to
    (n + 2)^2 / (2 pi (2 n + 3))."""
    scattered = PhongLobe(exponent).scatter(np.array([[0.0, 0.0, 1.0]]))
    z = scattered.directions[0, :, 2]
    for power in (0, 1, 5):
        found = np.sum(scattered.weights[0, :, 0] * z ** power)
        assert found == pytest.approx((exponent + 2) / (exponent + power + 2), rel=1e-4)
    squares = np.sum(scattered.weights * scattered.kernel)
    assert squares == pytest.approx((exponent + 2) ** 2 / (2 * math.pi * (2 * exponent + 3)), rel=1e-4)


def test_phong_matrix_against_plain_integration() -> None:
    """B of transfer.md: both hemispheres on a grid, no use of symmetry."""
    exponent = 12.0
    views, view_weights = grid(24, 40)
    lights, light_weights = grid(60, 80)
    cosines = np.maximum(views * np.array([-1, -1, 1]) @ lights.T, 0)
    kernel = (exponent + 2) / (2 * math.pi) * cosines ** exponent * lights[:, 2] * light_weights
    rows = hemisphere.evaluate(functions_of(24), views) * view_weights[:, None]
    expected = rows.T @ kernel @ sh.evaluate(5, lights)
    found = brdf.reflection_of(PhongLobe(exponent), 5).integrals(functions_of(24))[:, :, 0]
    np.testing.assert_allclose(found, expected, atol=2e-4 * np.abs(expected).max())


def test_fresnel_of_the_layers() -> None:
    cosines = np.linspace(0, 1, 2001)
    layer = reflectance.dielectric_of(SurfaceMaterial(ior=1.5, specular_level=0.5))
    assert layer is not None
    curve = layer.reflectance(cosines)
    np.testing.assert_allclose(curve[-1], 0.04, atol=1e-12)  # ((1.5 - 1) / (1.5 + 1))^2
    np.testing.assert_allclose(curve[0], 1.0, atol=1e-12)
    np.testing.assert_allclose(curve[:, 0], reflectance.dielectric_fresnel(cosines, 1.5), atol=1e-12)
    brewster = math.cos(math.atan(1.5))  # parallel light is not reflected: half of ((n^2 - 1) / (n^2 + 1))^2
    assert reflectance.dielectric_fresnel(np.array([brewster]), 1.5)[0] == pytest.approx((1.25 / 3.25) ** 2 / 2)
    # Cycles' fit of the mean is this good.
    np.testing.assert_allclose(layer.mean(), np.trapezoid(2 * cosines[:, None] * curve, cosines, axis=0), atol=3e-3)
    doubled = reflectance.dielectric_of(SurfaceMaterial(specular_level=1.0, specular_tint=(1.0, 0.5, 0.0)))
    assert doubled is not None
    np.testing.assert_allclose(doubled.reflectance(np.array([1.0]))[0], [0.08, 0.04, 0.0], atol=1e-12)
    assert reflectance.dielectric_of(SurfaceMaterial(specular_level=0.0)) is None
    assert reflectance.dielectric_of(SurfaceMaterial(ior=1.0, specular_level=0.5)) is None
    metal = reflectance.metal_of(SurfaceMaterial(base_colour=(0.9, 0.6, 0.2), specular_tint=(1.0, 0.8, 0.5)))
    np.testing.assert_allclose(metal.reflectance(np.array([1.0]))[0], [0.9, 0.6, 0.2])
    at_82 = metal.f0 + (1 - metal.f0) * (6 / 7) ** 5
    np.testing.assert_allclose(metal.reflectance(np.array([1 / 7]))[0], at_82 * np.array([1.0, 0.8, 0.5]))
    curve = metal.reflectance(cosines)
    np.testing.assert_allclose(metal.mean(), np.trapezoid(2 * cosines[:, None] * curve, cosines, axis=0), atol=1e-6)


# ---- energy

@pytest.mark.parametrize("roughness", ROUGHNESS)
def test_white_furnace(roughness: float) -> None:
    """A white metal in a white surrounding can't be seen, from any view; the albedo that one bounce loses is taken
    from plain integration, not from the nodes that the compensation itself uses."""
    material = SurfaceMaterial(roughness=roughness, **WHITE_METAL)
    matrix = brdf.outgoing_matrix(brdf.reflection_of_material(material, 5), functions_of(24))
    views, weights = grid(8, 8)
    exit_radiance = hemisphere.evaluate(functions_of(24), views) @ matrix[:, 0, 0] * math.sqrt(4 * math.pi)
    assert np.abs(exit_radiance - 1).max() < 0.01 and abs(np.sum(weights * exit_radiance) / (2 * np.pi) - 1) < 0.002
    if roughness < 0.3:
        return  # too narrow for the grid
    lights, light_weights = grid(300, 600)
    lobe = PrincipledLobe(material)
    for view in meridian(np.array([0.2, 0.6, 0.95])):
        single = np.sum(light_weights * ggx(view, lights, roughness ** 2, roughness ** 2) * lights[:, 2])
        compensation = lobe.scatter(view[None]).weights.sum() / single
        assert compensation * single == pytest.approx(1, abs=1e-3)
        assert PrincipledLobe(material, False).scatter(view[None]).weights.sum() == pytest.approx(single, abs=1e-3)


def test_no_material_returns_more_than_it_receives() -> None:
    for roughness in (0.05, 0.4, 1.0):
        for extra in ({"metallic": 1.0, "base_colour": (0.9, 0.5, 0.1)}, {"specular_level": 1.0, "ior": 2.0},
                      {"metallic": 0.5, "specular_level": 0.5}):
            material = SurfaceMaterial(roughness=roughness, **extra)
            views = meridian(np.linspace(0.01, 1, 30))
            albedo = PrincipledLobe(material).scatter(views).weights.sum(axis=1)
            assert albedo.max() <= 1 + 1e-3 and albedo.min() > 0
            if material.metallic == 0:  # with the diffuse layer below it, a white plastic stays below 1 too
                total = albedo[:, 0] + PrincipledLobe(material).dimming(views)
                assert total.max() <= 1.02 and total.min() > 0.97


def test_extremes_give_numbers() -> None:
    for roughness in (0.0, 1e-3, 1.0):
        for anisotropic in (0.0, 1.0):
            material = SurfaceMaterial(roughness=roughness, anisotropic=anisotropic, specular_level=50.0, metallic=0.5)
            reflection = brdf.reflection_of_material(material, 3)
            assert np.isfinite(reflection.radiance).all() and np.isfinite(reflection.squares).all()


# ---- matrices

@pytest.mark.parametrize(("roughness", "anisotropic"), [(0.05, 0.0), (0.2, 0.0), (0.5, 0.0), (1.0, 0.0), (0.2, 0.8)])
def test_nodes_are_enough(roughness: float, anisotropic: float) -> None:
    material = SurfaceMaterial(roughness=roughness, anisotropic=anisotropic, **WHITE_METAL)
    lobe, functions = PrincipledLobe(material), functions_of(25)
    found = brdf.outgoing_matrix(brdf.reflection_of(lobe, 10), functions)
    views = brdf.views_for(lobe.isotropic, 32, 12)
    fine = brdf.outgoing_matrix(brdf.reflection_of(lobe, 10, 72, 72, views), functions)
    assert norm_over_hemisphere(functions, found - fine) < 5e-4 * norm_over_hemisphere(functions, fine)


def test_isotropic_short_cut_equals_the_general_way() -> None:
    """The meridian with its equal azimuths against the quarter circle that knows mirror symmetry alone."""
    lobe = PrincipledLobe(SurfaceMaterial(roughness=0.5, specular_level=0.5, metallic=0.3, base_colour=(0.9, 0.5, 0.2)))
    quarter = brdf.views_for(False, brdf.VIEW_HEIGHTS, 12)
    short, general = brdf.reflection_of(lobe, 6), brdf.reflection_of(lobe, 6, views=quarter)
    functions = functions_of(25)
    np.testing.assert_allclose(short.integrals(functions), general.integrals(functions), atol=1e-4)
    assert short.held_by_light() == pytest.approx(general.held_by_light(), abs=1e-4)
    assert short.held_by_rows(functions) == pytest.approx(general.held_by_rows(functions), abs=1e-4)
    turn = sh.rotation(6, turn_about_z(0.7))
    for channel in range(3):  # isotropic: commutes with turns about the normal
        matrix = brdf.outgoing_matrix(short, functions)[:, :, channel]
        np.testing.assert_allclose(turn[:25, :25] @ matrix, matrix @ turn, atol=1e-11 * np.abs(matrix).max())


def test_a_quarter_turn_swaps_the_axes_of_an_anisotropic_lobe() -> None:
    functions = functions_of(24)
    common = {"roughness": 0.5, "anisotropic": 0.7, **WHITE_METAL}
    along = brdf.reflection_of_material(SurfaceMaterial(**common), 6)
    turned = brdf.outgoing_matrix(
        brdf.reflection_of_material(SurfaceMaterial(**common, anisotropic_rotation=0.25), 6), functions)
    lobe = PrincipledLobe(SurfaceMaterial(**common))
    lobe.alpha_x, lobe.alpha_y = lobe.alpha_y, lobe.alpha_x
    swapped = brdf.outgoing_matrix(brdf.reflection_of(lobe, 6), functions)
    scale = norm_over_hemisphere(functions, swapped)
    assert norm_over_hemisphere(functions, turned - swapped) < 1e-3 * scale
    assert norm_over_hemisphere(functions, brdf.outgoing_matrix(along, functions) - swapped) > 0.1 * scale


def test_rotation_turns_the_tangent_about_the_normal() -> None:
    """A turned lobe's radiance is that of the lobe in its own frame, view and light turned back."""
    material = SurfaceMaterial(roughness=0.6, anisotropic=0.8, anisotropic_rotation=0.15, **WHITE_METAL)
    lobe, functions = PrincipledLobe(material), functions_of(25)
    matrix = brdf.outgoing_matrix(brdf.reflection_of(lobe, 6), functions)[:, :, 0]
    light = np.random.default_rng(0).normal(size=36) * sh.expand_bands(1 / (1 + np.arange(6.0)))
    turn = turn_about_z(2 * math.pi * 0.15)
    views, weights = grid(6, 7)
    scattered = lobe.scatter(views @ turn)
    values = sh.evaluate(6, (scattered.directions @ turn.T).reshape(-1, 3)) @ light
    expected = np.sum(scattered.weights[:, :, 0] * values.reshape(len(views), -1), axis=1)
    found = hemisphere.evaluate(functions, views) @ matrix @ light
    assert np.sqrt(np.sum(weights * (found - expected) ** 2) / np.sum(weights * expected ** 2)) < 0.08
    unturned = hemisphere.evaluate(functions, views) @ np.linalg.solve(sh.rotation(5, turn), matrix) @ light
    assert np.sqrt(np.sum(weights * (unturned - expected) ** 2) / np.sum(weights * expected ** 2)) > 0.1


@pytest.mark.parametrize(("material", "bound"), [
    (SurfaceMaterial(roughness=0.3, **WHITE_METAL), 0.01),
    (SurfaceMaterial(roughness=0.8, metallic=1.0, base_colour=(0.9, 0.5, 0.2)), 0.005),
    (SurfaceMaterial(roughness=0.5, specular_level=0.5), 0.06),
    (SurfaceMaterial(roughness=0.5, anisotropic=0.6, **WHITE_METAL), 0.02),
])
def test_radiance_of_the_matrix_equals_direct_integration(material: SurfaceMaterial, bound: float) -> None:
    """K applied to plain hemispherical integrals of a smooth light, over views of the whole hemisphere."""
    functions = functions_of(25)
    reflection = brdf.reflection_of_material(material, 6)
    lights, light_weights = grid(40, 60)
    integrals = sh.evaluate(6, lights).T @ (light_weights * smooth_light(lights))
    views, weights = grid(12, 9)
    scattered = PrincipledLobe(material).scatter(views)
    expected = np.sum(scattered.weights * smooth_light(scattered.directions)[:, :, None], axis=1)
    matrix = brdf.reflection_matrix(reflection, functions)
    assert matrix.shape == (25, 36, reflection.channels)
    found = np.stack([hemisphere.evaluate(functions, views) @ matrix[:, :, c] @ integrals
                      for c in range(reflection.channels)], axis=1)
    pixels = (weights * views[:, 2])[:, None]
    error = math.sqrt(np.sum(pixels * (found - expected) ** 2) / np.sum(pixels * expected ** 2))
    assert error < bound
    # Integrals known to rounding may use all of A^-1; L on plain integrals is the zero-hemisphere projection.
    exact = brdf.reflection_matrix(reflection, functions, smallest_incident=hemisphere.SINGLE_PRECISION)
    full = np.stack([hemisphere.evaluate(functions, views) @ exact[:, :, c] @ integrals
                     for c in range(reflection.channels)], axis=1)
    assert math.sqrt(np.sum(pixels * (full - expected) ** 2) / np.sum(pixels * expected ** 2)) < bound


def test_incident_projections_under_noise() -> None:
    """What the module says of L and K at order 5: K fits better, all of A^-1 makes noise too loud."""
    functions = functions_of(25)
    reflection = brdf.reflection_of_material(SurfaceMaterial(roughness=0.3, **WHITE_METAL), 5)

    def gain(matrix: np.ndarray) -> float:
        return norm_over_hemisphere(functions, matrix)

    plain = gain(brdf.outgoing_matrix(reflection, functions))
    assert gain(brdf.reflection_matrix(reflection, functions)) < 2 * plain
    assert gain(brdf.reflection_matrix(reflection, functions, smallest_incident=1e-7)) > 30 * plain


def test_rows_of_24_and_fewer_incident_functions() -> None:
    reflection = brdf.reflection_of_material(SurfaceMaterial(roughness=0.5, **WHITE_METAL), 5)
    assert brdf.reflection_matrix(reflection, functions_of(24), functions_of(24)).shape == (24, 24, 1)
    assert brdf.reflection_matrix(reflection, functions_of(9), functions_of(16)).shape == (9, 16, 1)


@pytest.mark.parametrize("anisotropic", [0.0, 0.5])
def test_a_material_is_built_well_below_a_second(anisotropic: float) -> None:
    material = SurfaceMaterial(roughness=0.3, metallic=0.5, specular_level=0.5, anisotropic=anisotropic,
                               base_colour=(0.9, 0.5, 0.2))
    start = time.process_time()
    brdf.reflection_matrix(brdf.reflection_of_material(material, 10), functions_of(25))
    assert time.process_time() - start < 2.0  # measured 0.1 and 0.6; a busy machine may take longer


# ---- decisions

def test_explained_grows_with_roughness_rows_and_order() -> None:
    def share(roughness: float, rows: int, order: int) -> float:
        return brdf.explained(SurfaceMaterial(roughness=roughness, **WHITE_METAL), functions_of(rows), order)

    by_roughness = [share(r, 25, 5) for r in ROUGHNESS]
    assert all(np.diff(by_roughness[:-1]) > 0) and by_roughness[0] < 0.02 and by_roughness[-1] > 0.98
    assert share(0.5, 9, 5) < share(0.5, 16, 5) < share(0.5, 25, 5) < share(0.5, 25, 10) < 1


def test_explained_is_one_minus_the_squared_error_under_random_small_lights() -> None:
    """A lobe seen under one small light from anywhere: kernel against its fit, on a grid of views and lights."""
    material = SurfaceMaterial(roughness=0.7, **WHITE_METAL)
    lobe, functions = PrincipledLobe(material), functions_of(16)
    reflection = brdf.reflection_of(lobe, 5)
    views, view_weights = grid(24, 1)
    lights, light_weights = grid(80, 160)
    compensation = lobe.scatter(views).weights.sum(axis=(1, 2)) / PrincipledLobe(material, False).scatter(
        views).weights.sum(axis=(1, 2))
    kernel = np.stack([c * ggx(view, lights, 0.49, 0.49) * lights[:, 2]
                       for c, view in zip(compensation, views, strict=True)])
    fit = hemisphere.evaluate(functions, views) @ brdf.outgoing_matrix(reflection, functions)[:, :, 0] @ sh.evaluate(
        5, lights).T
    # The fit lives on the whole sphere of lights (the kernel is 0 below the horizon there): add what it wrongly has.
    below = hemisphere.evaluate(functions, views) @ brdf.outgoing_matrix(reflection, functions)[:, :, 0] @ sh.evaluate(
        5, lights * np.array([1, 1, -1])).T
    pixels = (view_weights * views[:, 2])[:, None] * light_weights
    error = np.sum(pixels * ((kernel - fit) ** 2 + below ** 2)) / np.sum(pixels * kernel ** 2)
    assert brdf.explained(material, functions, 5) == pytest.approx(1 - error, abs=2e-3)


@pytest.mark.parametrize(("material", "kind"), [
    (SurfaceMaterial(), "diffuse"), (SurfaceMaterial(specular_level=0.001), "diffuse"),
    (SurfaceMaterial(roughness=0.0, metallic=1.0), "mirror"),
    (SurfaceMaterial(roughness=0.1, specular_level=0.5), "mirror"),
    (SurfaceMaterial(roughness=0.3, metallic=1.0), "glossy"),
    (SurfaceMaterial(roughness=0.3, specular_level=0.5), "glossy"),
])
def test_choice_of_rows(material: SurfaceMaterial, kind: str) -> None:
    choice = brdf.choose_rows(material, 5)
    assert choice.kind == kind and (choice.rows > 0) == (kind == "glossy") and len(choice.functions) == choice.rows
    assert "\n" not in choice.why and choice.why
    if kind == "mirror":
        assert "mirror" in choice.why and choice.explained < brdf.MIRROR


def test_rougher_needs_fewer_rows() -> None:
    rows = [brdf.choose_rows(SurfaceMaterial(roughness=r, **WHITE_METAL), 5).rows for r in (0.3, 0.8, 1.0)]
    assert rows[0] >= 24 and rows[0] > rows[1] > rows[2] >= 1
    assert brdf.choose_rows(SurfaceMaterial(roughness=0.3, **WHITE_METAL), 5, most=16).rows == 16


def test_what_the_dielectric_leaves_of_the_diffuse_layer() -> None:
    material = SurfaceMaterial(roughness=0.5, specular_level=0.5)
    left = brdf.diffuse_left(material, functions_of(25))
    views = meridian(np.linspace(0.05, 1, 40))
    expected = PrincipledLobe(material).dimming(views)
    found = left.mean + hemisphere.evaluate(functions_of(25), views) @ left.coefficients
    np.testing.assert_allclose(found, expected, atol=0.01)
    assert 0.9 < left.mean < 0.96 and brdf.diffuse_left(SurfaceMaterial(), functions_of(9)).mean == 1.0


def test_results_do_not_depend_on_the_blocks(monkeypatch: pytest.MonkeyPatch) -> None:
    material = SurfaceMaterial(roughness=0.4, specular_level=0.5, anisotropic=0.3)

    def build() -> np.ndarray:
        return brdf.outgoing_matrix(brdf.reflection_of_material(material, 5), functions_of(24))

    whole: Callable[[], np.ndarray] = build
    first = whole()
    monkeypatch.setattr(brdf, "_BLOCK", 5000)
    np.testing.assert_allclose(whole(), first, rtol=0, atol=1e-12 * np.abs(first).max())


@pytest.mark.parametrize("roughness", [0.2, 0.35, 0.5])
def test_a_windowed_highlight_has_no_dark_rings(roughness):
    """A small bright light seen in the highlight along the normal, all around the hemisphere: nowhere below nought."""
    material = SurfaceMaterial("metal", (1.0, 1.0, 1.0), roughness, 1.0, specular_level=0.5)
    order = 5
    reflection = brdf.reflection_of_material(material, order)
    bands = brdf.ringing_window(reflection, order)
    assert bands[0] == 1.0 and (np.diff(bands) <= 0.0).all()
    straight = int(np.argmax(reflection.views.directions[:, 2]))
    angles = np.linspace(0.0, np.pi, 400)
    lights = np.stack([np.sin(angles), np.zeros_like(angles), np.cos(angles)], axis=1)
    shown = sh.evaluate(order, lights) * reflection.radiance[straight, :, 0]
    plain, windowed = shown.sum(axis=1), (shown * sh.expand_bands(bands)).sum(axis=1)
    assert windowed.min() > -0.031 * windowed.max()
    assert plain.min() < -0.031 * plain.max() or bands[-1] == 1.0


def test_a_rough_highlight_needs_no_window():
    material = SurfaceMaterial("metal", (1.0, 1.0, 1.0), 1.0, 1.0, specular_level=0.5)
    np.testing.assert_array_equal(brdf.ringing_window(brdf.reflection_of_material(material, 7), 7), np.ones(7))


def test_white_surroundings_are_reflected_exactly_whatever_is_cut_from_the_incident_side():
    material = SurfaceMaterial("metal", (1.0, 1.0, 1.0), 0.3, 1.0, specular_level=0.5)
    reflection, functions = brdf.reflection_of_material(material, 7), hemisphere.functions_of(24)
    matrix = brdf.reflection_matrix(reflection, functions, smallest_incident=0.1)
    integrals = hemisphere.gram_matrix(np.arange(49))[0] * np.sqrt(4 * np.pi)  # of unit radiance over H
    z = np.linspace(0.05, 1.0, 20)
    views = hemisphere.evaluate(functions, hemisphere.meridian(z))
    radiance = views @ (matrix[:, :, 0] @ integrals)
    np.testing.assert_allclose(radiance, 1.0, atol=0.01)
