# SPDX-License-Identifier: GPL-3.0-or-later
"""Subsurface light against closed forms and the plain double sum."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import integrate

from prt_addon.errors import BadArguments
from prt_addon.transport.dipole import (
    Medium,
    Poles,
    boundary_factor,
    diffuse_reflectance,
    disc_integral,
    internal_reflectance,
    mean_reflectance,
    plane_integral,
    slope_and_curvature,
    total_reflectance,
    x_of_reflectance,
)
from prt_addon.transport.sample_tree import SampleTree
from prt_addon.transport.subsurface import subsurface_transfer
from tests.core.shapes import drain, sphere

COLOUR = (0.2, 0.5, 0.9)


def medium_of(colour=COLOUR, path=0.01, ior=1.4):
    """A medium by its half-space's colour and its mean free path (metres)."""
    return Medium(x_of_reflectance(np.broadcast_to(colour, 3), boundary_factor(ior)),
                  np.broadcast_to(np.asarray(path, float), 3), boundary_factor(ior))


def square(cells, size=1.0, height=0.0, up=1.0):
    """Middles of the cells of a square: points, normals, areas."""
    line = ((np.arange(cells) + 0.5) / cells - 0.5) * size
    x, y = np.meshgrid(line, line, indexing="ij")
    points = np.stack([x.ravel(), y.ravel(), np.full(x.size, height)], axis=1)
    return points, np.tile([0.0, 0.0, up], (x.size, 1)), np.full(x.size, (size / cells) ** 2)


def ball(subdivisions=4, radius=1.0):
    """Points, normals and areas of an icosphere, the areas scaled to the sphere's."""
    mesh = sphere(radius=radius, subdivisions=subdivisions)
    corners = mesh.positions[mesh.triangles]
    face = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    areas = np.bincount(mesh.triangles.ravel(), np.repeat(face, 3))
    return mesh.positions, mesh.positions / radius, areas * 4.0 * np.pi * radius**2 / areas.sum()


def solve(body, light, medium, **options):
    light = np.asarray(light, np.float32)
    return drain(subsurface_transfer(*body, light.reshape(len(body[0]), -1, 1) if light.ndim < 3 else light, medium,
                                     **options))


def smooth_light(points, columns=4):
    """Some smooth functions of the place, of both signs."""
    return np.stack([np.sin((c + 1) * points[:, c % 3] + c) for c in range(columns)], axis=1)


# The dipole.

@pytest.mark.parametrize("ior", [1.0, 1.3, 1.5])
@pytest.mark.parametrize("colour", [0.05, 0.5, 0.99])
def test_the_integral_of_the_dipole_is_its_closed_form(ior, colour):
    medium = medium_of(colour, 0.3, ior)
    poles = medium.poles(0, 1.0)

    def ring(radius):
        return 2.0 * np.pi * radius * diffuse_reflectance(poles, np.array([radius * radius]))[0]

    for radius in (1e-3, 0.2, 5.0):
        assert disc_integral(poles, radius**2) == pytest.approx(integrate.quad(ring, 0.0, radius)[0], rel=1e-7)
    # The tail of a pole is z/d exp(-sigma d): exact beyond where quad stops.
    assert plane_integral(poles) == pytest.approx(float(disc_integral(poles, 1e24)), rel=1e-9)
    assert plane_integral(poles) == pytest.approx(float(total_reflectance(medium.x, medium.boundary)[0]), rel=1e-12)
    assert plane_integral(poles) == pytest.approx(colour, rel=1e-9)


def test_a_tiny_disc_keeps_its_precision():
    poles = medium_of(0.5, 100.0).poles(0, 1.0)
    at = diffuse_reflectance(poles, np.zeros(1))[0]
    assert float(disc_integral(poles, 1e-14)) == pytest.approx(np.pi * 1e-14 * at, rel=1e-9)


def test_the_colour_is_inverted_over_its_whole_range():
    colours = np.concatenate([[0.0, 1e-9, 1e-4], np.linspace(0.01, 0.99, 50), [1.0 - 1e-6, 1.0 - 1e-12, 1.0]])
    for ior in (1.0, 1.4, 2.0):
        x = x_of_reflectance(colours, boundary_factor(ior))
        assert np.abs(total_reflectance(x, boundary_factor(ior)) - colours).max() < 1e-13
        assert (np.diff(x) < 0.0).all() and x[0] == np.sqrt(3.0) and x[-1] == 0.0


@pytest.mark.parametrize("ior", [1.2, 1.33, 1.5, 2.0])
def test_internal_reflectance_is_near_the_fresnel_integral(ior):
    def fresnel(cosine):
        sine = ior * np.sqrt(1.0 - cosine * cosine)
        if sine >= 1.0:
            return 2.0 * cosine
        other = np.sqrt(1.0 - sine * sine)
        parallel = (cosine - ior * other) / (cosine + ior * other)
        across = (ior * cosine - other) / (ior * cosine + other)
        return cosine * (parallel**2 + across**2)

    expected = integrate.quad(fresnel, 0.0, 1.0, points=[np.sqrt(1.0 - 1.0 / ior**2)])[0]
    assert internal_reflectance(ior) == pytest.approx(expected, abs=0.002)


def test_means_are_right_to_second_order():
    poles = medium_of(0.6, 0.05).poles(0, 1.0)
    rng = np.random.default_rng(1)
    centre = np.array([0.2, -0.1, 0.15])
    for size, limit in ((0.04, 2e-2), (0.02, 1.5e-3), (0.01, 2e-4)):
        cloud = rng.normal(size=(20_000, 3)) * (1.0, 0.5, 0.1) * size
        cloud = np.concatenate([cloud, -cloud])  # no skew
        truth = diffuse_reflectance(poles, np.sum((centre + cloud) ** 2, axis=1)).mean()
        variance = np.mean(cloud**2, axis=0)
        covariance = np.mean(cloud[:, :, None] * cloud[:, None, :], axis=0)
        mean = mean_reflectance(poles, np.array([centre @ centre]), np.array([variance.sum()]),
                                np.array([centre @ covariance @ centre]))[0]
        assert mean == pytest.approx(truth, rel=limit)


def test_slope_and_curvature_are_bounds():
    distance = np.linspace(0.0, 3.0, 30_001)
    for colour, path in ((0.1, 0.3), (0.9, 0.1), (1.0, 0.5)):
        poles = medium_of(colour, path).poles(0, 1.0)
        value = diffuse_reflectance(poles, distance**2)
        first = np.gradient(value, distance)
        second = np.abs(np.gradient(first, distance))
        across = np.abs(first[1:] / distance[1:])
        slope, curvature = slope_and_curvature(poles, distance)
        assert (slope[1:-1] >= np.maximum.accumulate(np.abs(first)[::-1])[::-1][1:-1] * (1 - 1e-5)).all()
        hessian = np.maximum(second[2:-2], across[1:-2])
        assert (curvature[2:-2] >= np.maximum.accumulate(hessian[::-1])[::-1] * (1 - 1e-4)).all()


def test_papers_coefficients_give_the_papers_reflectance():
    # Jensen et al. 2001, figure 5: skin1, sigma_s' and sigma_a per mm, diffuse reflectance 0.44 0.22 0.13.
    medium = Medium.of_coefficients((0.74e3, 0.88e3, 1.01e3), (0.032e3, 0.17e3, 0.48e3), 1.3)
    assert np.abs(medium.total() - (0.44, 0.22, 0.13)).max() < 0.02


def test_the_radius_means_what_cycles_makes_of_it():
    walk = Medium.of_principled(COLOUR, (1.0, 0.2, 0.1), 1.4)
    assert np.allclose(walk.depth, np.array([1.0, 0.2, 0.1]) / (4.0 * np.pi))
    skin = Medium.of_principled(COLOUR, (1.0, 0.2, 0.1), 1.4, "RANDOM_WALK_SKIN")
    assert np.allclose([1.0 / skin.poles(c, 1.0).decay for c in range(3)], (1.0, 0.2, 0.1))
    assert np.allclose(walk.total(), COLOUR) and np.allclose(skin.total(), COLOUR)


@pytest.mark.parametrize("arguments", [((np.nan, 0, 0), 1.0), (COLOUR, -1.0), (COLOUR, np.inf), (COLOUR, 1.0, 9.0),
                                       (COLOUR, 1.0, 1.4, "DISC")])
def test_media_that_make_no_sense_are_refused(arguments):
    with pytest.raises(BadArguments):
        Medium.of_principled(*arguments)


# The tree.

@pytest.mark.parametrize("number", [1, 2, 3, 17, 256, 1000])
def test_nodes_hold_all_samples_once(number):
    rng = np.random.default_rng(number)
    points, areas = rng.random((number, 3)), rng.random(number)
    tree = SampleTree.over(points, areas, np.zeros((number, 6)))
    assert sorted(tree.order) == list(range(number))
    for level in range(tree.depth + 1):
        nodes = slice(2**level - 1, 2 ** (level + 1) - 1)
        assert tree.count[nodes].sum() == number and (np.diff(tree.first[nodes]) == tree.count[nodes][:-1]).all()
    sums = tree.summed(tree.areas)
    for node in range(2**tree.depth - 1):
        run = slice(tree.first[node], tree.first[node] + tree.count[node])
        assert sums[number + node] == pytest.approx(tree.areas[run].sum())
        centre = np.average(tree.points[run], axis=0, weights=tree.areas[run])
        assert np.allclose(tree.centre[node], centre)
        moment = np.average((tree.points[run] - centre) ** 2, axis=0, weights=tree.areas[run])
        assert np.allclose(tree.covariance[node, :3], moment)
        assert tree.reach[node] == pytest.approx(np.linalg.norm(tree.points[run] - centre, axis=1).max())


# Energy.

@pytest.mark.parametrize("path", [1e-5, 1e-4, 1e-3, 2e-3, 4e-3, 8e-3])
def test_a_dense_plane_under_uniform_light_returns_its_colour(path):
    cells = 60
    body = square(cells)
    middle = np.abs(body[0][:, :2]).max(axis=1) < 1.5 / cells
    result = solve(body, np.ones(cells * cells), medium_of(path=path))
    # Of the infinite plane the part beyond the square is missing: at most what lies beyond its inner circle.
    poles = [medium_of(path=path).poles(c, 1.0) for c in range(3)]
    missing = np.array([plane_integral(p) - float(disc_integral(p, 0.47**2)) for p in poles])
    found = result.transfer[middle, 0].mean(axis=0)
    assert (found <= np.array(COLOUR) * 1.01).all()
    assert (found >= np.array(COLOUR) * 0.99 - missing).all()


@pytest.mark.parametrize("path", [1e-4, 1e-2, 3e-2, 0.1, 0.3, 1.0, 10.0, 100.0])
def test_a_sphere_has_the_closed_form_at_any_mean_free_path(path):
    # On a sphere dA = 2 pi d dd with d the chord, so the integral over it is that over a disc as wide as its diameter.
    body = ball()
    medium = medium_of(path=path)
    result = solve(body, np.ones(len(body[0])), medium)
    expected = [float(disc_integral(medium.poles(c, 1.0), 4.0)) for c in range(3)]
    assert np.abs(result.transfer[:, 0] / expected - 1.0).max() < 0.01
    assert np.allclose(result.energy, expected, rtol=0.01)


def test_a_short_path_is_diffuse_reflection():
    body = ball(3)
    light = smooth_light(body[0])
    result = solve(body, light, medium_of(path=1e-7))
    assert np.abs(result.transfer - light[:, :, None] * np.array(COLOUR)).max() < 1e-5
    radiusless = solve(body, light, Medium.of_principled(COLOUR, 0.0))
    assert np.abs(radiusless.transfer - light[:, :, None] * np.array(COLOUR)).max() < 1e-5


def test_corners_of_a_vertex_share_their_place():
    # Three faces of a cube meet in its corners: three receivers at one place, each with light of its own.
    points, normals, areas = square(10)
    turned = [np.roll(points, axis, axis=1) for axis in range(3)]
    points = np.concatenate([*turned, np.zeros((3, 3))])
    normals = np.concatenate([*(np.roll(normals, axis, axis=1) for axis in range(3)), np.eye(3)])
    areas = np.concatenate([areas, areas, areas, np.full(3, 0.01)])
    light = np.arange(len(points), dtype=float)
    short = solve((points, normals, areas), light, medium_of(path=1e-6))
    assert np.abs(short.transfer[:, 0] / (light[:, None] + 1e-30) / COLOUR - 1.0)[1:].max() < 1e-3
    assert short.places == len(points) - 2
    # Where light goes far, all three give the same.
    far = solve((points, normals, areas), light, medium_of(path=1.0))
    assert np.ptp(far.transfer[-3:, 0], axis=0).max() < 1e-3 * far.transfer[-3:, 0].min()


@pytest.mark.parametrize("path", [1e-3, 1e-2, 0.1, 1.0])
def test_a_thin_sheet_makes_no_energy(path):
    front, back = square(40), square(40, height=-1e-3, up=-1.0)
    body = tuple(np.concatenate(pair) for pair in zip(front, back, strict=True))
    one_sided = solve(front, np.ones(1600), medium_of((0.3, 0.8, 1.0), path))
    result = solve(body, np.ones(3200), medium_of((0.3, 0.8, 1.0), path), tolerance=0.0)
    assert result.transfer.min() > 0.0 and result.transfer.max() <= 1.0 + 1e-5
    # Both sides give the same, and no less than one alone.
    assert np.abs(result.transfer[:1600] - result.transfer[1600:]).max() < 1e-3
    assert (result.energy >= one_sided.energy * 0.999).all()
    if path == 1e-2:
        assert result.energy[0] == pytest.approx(2.0 * one_sided.energy[0], rel=0.02)  # not bent where allowed
        assert result.reduced[2] > 0.2 and result.reduced[0] < 1e-5


def test_scaled_rows_stay_reciprocal():
    front, back = square(12), square(12, height=-1e-2, up=-1.0)
    points, normals, areas = (np.concatenate(pair) for pair in zip(front, back, strict=True))
    areas = areas * 1.0
    result = solve((points, normals, areas), np.eye(288), medium_of(1.0, 0.05), tolerance=0.0)
    flux = areas[:, None] * result.transfer[:, :, 0]
    assert result.reduced[0] > 0.1
    assert np.abs(flux - flux.T).max() < 0.05 * np.sort(flux.ravel())[-289]
    # Light that enters at one place: no more leaves than went in.
    assert (flux.sum(axis=0) / areas).max() < 1.05


def test_an_open_mesh_loses_light_only():
    points, normals, areas = ball()
    upper = points[:, 2] > 0.0
    whole = solve((points, normals, areas), np.ones(len(points)), medium_of(path=0.1))
    half = solve((points[upper], normals[upper], areas[upper]), np.ones(upper.sum()), medium_of(path=0.1))
    assert half.transfer.min() > 0.0
    assert (half.transfer[:, 0] <= whole.transfer[upper, 0] * 1.002).all()
    assert (half.energy < whole.energy).all()


# The operator.

@pytest.mark.parametrize("path", [0.2, 0.6])
def test_the_hierarchy_is_the_plain_double_sum_over_a_finer_mesh(path):
    # Four samples for each of ours: a plain sum of points is right there, since R_d is smooth at their spacing.
    body, (points, _, areas) = ball(4), ball(5)
    medium, checked = medium_of(path=path), np.arange(0, len(body[0]), 20)
    result = solve(body, smooth_light(body[0]), medium, tolerance=0.003).transfer[checked]
    squared = np.sum((body[0][checked, None] - points) ** 2, axis=2)
    for channel in range(3):
        expected = (diffuse_reflectance(medium.poles(channel, 1.0), squared) * areas) @ smooth_light(points)
        assert np.abs(result[:, :, channel] - expected).max() < 0.01 * np.abs(expected).max()


def test_a_smaller_tolerance_means_a_smaller_error():
    body = ball()
    rng = np.random.default_rng(2)
    light = smooth_light(body[0]) + rng.normal(size=(len(body[0]), 4)) * 0.3
    results = [solve(body, light, medium_of(path=0.02), tolerance=t, checked=200) for t in (0.3, 0.1, 0.03, 0.01, 0.0)]
    errors, links = [r.error for r in results], [r.links for r in results]
    assert all(np.diff(errors) < 0.0) and all(np.diff(links) > 0.0)
    assert errors[0] < 0.05 and errors[3] < 0.01 and errors[4] < 1e-6
    assert results[4].bound == 0.0 and links[4] == len(body[0])
    full = results[4].transfer
    for result in results[:4]:
        assert np.abs(result.transfer - full).max() <= result.bound * np.abs(light).max()
        assert result.error == pytest.approx(np.sqrt(np.mean((result.transfer - full) ** 2) / np.mean(full**2)), rel=.2)


def test_it_is_linear():
    body = ball(3)
    light = smooth_light(body[0], 3)
    together = solve(body, light @ np.array([2.0, -1.0, 0.5]), medium_of(path=0.1)).transfer[:, 0]
    apart = solve(body, light, medium_of(path=0.1)).transfer
    assert np.abs(together - np.einsum("rcx,c->rx", apart, [2.0, -1.0, 0.5])).max() < 1e-5


@pytest.mark.parametrize("factor", [1e-3, 1e3])
def test_size_and_place_do_not_matter(factor):
    points, normals, areas = ball(3)
    light = smooth_light(points)
    here = solve((points, normals, areas), light, medium_of(path=0.05))
    there = solve((points * factor + 7.0 * factor, normals, areas * factor**2), light, medium_of(path=0.05 * factor))
    assert np.abs(here.transfer - there.transfer).max() < 2e-3 * np.abs(here.transfer).max()


def test_colours_are_three_greys():
    body = ball(3)
    light = np.stack([smooth_light(body[0]) + c for c in range(3)], axis=2)
    paths = (0.02, 0.3, 0.02)
    coloured = solve(body, light, medium_of(COLOUR, paths), tolerance=0.0)
    for channel in range(3):
        grey = solve(body, light[:, :, channel], medium_of(COLOUR[channel], paths[channel]), tolerance=0.0)
        # Which discs count as near is one decision for all channels.
        assert np.abs(grey.transfer - coloured.transfer[:, :, channel, None]).max() < 2e-4


def test_threads_and_order_do_not_matter():
    body = ball(4)
    light = smooth_light(body[0])
    one, two = (solve(body, light, medium_of(path=0.02), threads=t) for t in (1, 2))
    assert (one.transfer == two.transfer).all() and one.links == two.links
    order = np.random.default_rng(0).permutation(len(light))
    other = solve(tuple(part[order] for part in body), light[order], medium_of(path=0.02))
    assert np.abs(other.transfer - one.transfer[order]).max() < 5e-3


@pytest.mark.parametrize("colour", [0.0, 1.0])
@pytest.mark.parametrize("path", [0.0, 1e-12, 1e-3, 1.0, 1e6])
def test_black_white_and_extreme_paths_stay_finite(colour, path):
    body = ball(2)
    result = solve(body, np.ones(len(body[0])), medium_of(colour, path))
    assert np.isfinite(result.transfer).all() and result.transfer.min() >= 0.0
    assert result.transfer.max() <= colour * (1.0 + 1e-4)
    if path < 1e-9:
        assert result.transfer.min() == pytest.approx(colour, abs=1e-5)


def test_few_receivers_and_no_area():
    one = solve((np.zeros((1, 3)), np.array([[0.0, 0.0, 1.0]]), np.ones(1)), np.ones(1), medium_of(path=1e-6))
    assert np.allclose(one.transfer[0, 0], COLOUR, rtol=1e-4) and one.places == 1
    same = solve((np.zeros((2, 3)), np.eye(3)[:2], np.ones(2)), np.array([1.0, 2.0]), medium_of(path=1e-6))
    assert np.allclose(same.transfer[:, 0, 1], [0.5, 1.0], rtol=1e-4)
    none = solve((np.random.default_rng(0).random((5, 3)), np.eye(3)[[0, 1, 2, 0, 1]], np.zeros(5)), np.ones(5),
                 medium_of())
    assert (none.transfer == 0.0).all()
    empty = solve((np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0)), np.zeros((0, 2, 1)), medium_of())
    assert empty.transfer.shape == (0, 2, 3)


def test_what_is_not_finite_is_refused():
    points, normals, areas = ball(1)
    with pytest.raises(ValueError, match="finite"):
        solve((points, normals, areas), np.full(len(points), np.nan), medium_of())
    with pytest.raises(ValueError, match="shapes"):
        solve((points, normals, areas[:-1]), np.ones(len(points)), medium_of())


def test_poles_are_shared_by_equal_channels():
    assert medium_of(0.5, 0.1).poles(0, 1.0) == medium_of(0.5, 0.1).poles(2, 1.0)
    assert isinstance(medium_of().poles(1, 2.0), Poles)
