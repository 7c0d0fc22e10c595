# SPDX-License-Identifier: GPL-3.0-or-later
"""Cubemap texels against closed forms and against the geometry of the cube."""

import math

import numpy as np
import pytest
from scipy import integrate

from prt_addon.basis import cubemap
from prt_addon.basis.cubemap import (
    bilinear_texels,
    cubemap_directions,
    cubemap_solid_angles,
    sample_directions,
    texel_of,
)

SIZES = (1, 2, 3, 8, 32)
RANDOM = np.random.default_rng(7)


def random_directions(count):
    values = RANDOM.normal(size=(count, 3))
    return values / np.linalg.norm(values, axis=1, keepdims=True)


@pytest.mark.parametrize("r", SIZES)
def test_solid_angles_sum_to_the_sphere(r):
    assert cubemap_solid_angles(r).sum() == pytest.approx(4 * math.pi, rel=1e-14)
    assert cubemap_solid_angles(r).min() > 0


def test_solid_angles_are_the_integral_over_the_face():
    r = 4
    edges = cubemap.texel_edges(r)
    for row, column in ((0, 0), (1, 2), (3, 1)):
        expected, _ = integrate.dblquad(lambda u, v: (1 + u * u + v * v) ** -1.5, edges[row], edges[row + 1],
                                        edges[column], edges[column + 1], epsabs=1e-13)
        assert cubemap_solid_angles(r).reshape(6, r, r)[:, row, column] == pytest.approx(expected, rel=1e-10)


def test_solid_angles_are_the_share_of_random_directions():
    r, count = 2, 400_000
    share = np.bincount(texel_of(random_directions(count), r), minlength=24) / count
    expected = cubemap_solid_angles(r) / (4 * math.pi)
    assert np.abs(share - expected).max() < 5 * np.sqrt(expected.max() / count)


@pytest.mark.parametrize("r", SIZES)
def test_texel_of_is_the_inverse_of_directions(r):
    directions = cubemap_directions(r)
    assert np.allclose(np.linalg.norm(directions, axis=1), 1, atol=1e-15)
    assert np.array_equal(texel_of(directions, r), np.arange(6 * r * r))
    assert np.array_equal(texel_of(1e-9 * directions, r), np.arange(6 * r * r))


def test_face_order_and_axes():
    middle = cubemap_directions(1)
    assert np.array_equal(middle, [[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]])
    # face +Y: the column runs along +Z, the row along +X
    assert texel_of([[0.1, 1, 0.9]], 8)[0] == (2 * 8 + 4) * 8 + 7


def test_samples_lie_in_their_texel_and_their_mean_is_its_middle():
    r = 8
    samples = sample_directions(r, 3)
    assert np.array_equal(texel_of(samples, r), np.repeat(np.arange(6 * r * r)[:, None], 9, axis=1))
    assert np.allclose(samples[:, 4], cubemap_directions(r), atol=1e-15)


@pytest.mark.parametrize("r", (1, 2, 3, 8))
def test_bilinear_weights_sum_to_one_and_hit_texel_centres(r):
    texels, weights = bilinear_texels(random_directions(5000), r)
    assert texels.min() >= 0 and texels.max() < 6 * r * r
    assert weights.min() > -1e-12
    assert np.allclose(weights.sum(axis=1), 1, atol=1e-12)
    texels, weights = bilinear_texels(cubemap_directions(r), r)
    exact = np.sum(np.where(texels == np.arange(6 * r * r)[:, None], weights, 0), axis=1)
    assert np.allclose(exact, 1, atol=1e-12)


def test_bilinear_look_up_is_continuous_over_edges_and_corners():
    r = 4
    values = RANDOM.random(6 * r * r)

    def looked_up(directions):
        texels, weights = bilinear_texels(directions, r)
        return np.sum(values[texels] * weights, axis=1)

    along = np.linspace(-0.999, 0.999, 401)
    for axis in range(3):
        for first in (-1.0, 1.0):
            for second in (-1.0, 1.0):
                points = np.empty((len(along), 3))
                points[:, axis] = along
                points[:, (axis + 1) % 3], points[:, (axis + 2) % 3] = first, second
                near, far = points.copy(), points.copy()
                near[:, (axis + 1) % 3] *= 1 + 1e-9
                far[:, (axis + 2) % 3] *= 1 + 1e-9
                # in the outermost half texel the corner's missing texel makes both sides share three texels
                assert np.abs(looked_up(near) - looked_up(far)).max() < 1e-6


def test_neighbours_across_edges_touch():
    r = 8
    bordered = cubemap._bordered_texels(r)
    directions = cubemap_directions(r)
    inner, outer = bordered[:, 1:-1, 1], bordered[:, 1:-1, 0]
    cosines = np.sum(directions[inner] * directions[outer], axis=-1)
    assert np.arccos(cosines).max() < 1.05 * cubemap.angular_size(r)
    assert (inner // (r * r) != outer // (r * r)).all()


def test_bad_sizes_are_refused():
    for call in (lambda: cubemap_directions(0), lambda: cubemap_solid_angles(-1), lambda: texel_of([[1, 0, 0]], 0)):
        with pytest.raises(ValueError, match="1 texel"):
            call()
