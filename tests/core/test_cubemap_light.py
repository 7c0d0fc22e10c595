# SPDX-License-Identifier: GPL-3.0-or-later
"""Light in cubemap texels: no flux lost, constants constant, rotations right and quick."""

import itertools
import math
import time

import numpy as np
import pytest

from prt_addon.basis.cubemap import angular_size, cubemap_directions, cubemap_solid_angles, texel_of
from prt_addon.basis.directions import random_rotation
from prt_addon.basis.spherical_harmonics import evaluate
from prt_addon.lighting import analytic, environment
from prt_addon.lighting.cubemap_light import (
    EnvironmentTexels,
    Turn,
    bilinear_look_up,
    constant_texels,
    environment_texels,
    sun_texels,
    total_flux,
)
from prt_addon.linear_algebra import multiply

RANDOM = np.random.default_rng(3)


def flux_of(image):
    height, width = image.shape[:2]
    edges = np.cos(np.arange(height + 1) * math.pi / height)
    return (image * ((edges[:-1] - edges[1:]) * 2 * math.pi / width)[:, None, None]).sum(axis=(0, 1))


@pytest.mark.parametrize("size", [(1, 2), (16, 32), (128, 256), (100, 37)])
@pytest.mark.parametrize("r", [2, 8])
def test_flux_of_an_environment_is_kept(size, r):
    image = RANDOM.random((*size, 3))
    image[size[0] // 3, size[1] // 2] = 1e6  # a sun of one pixel
    for rotation in (None, random_rotation(1, 2)):
        assert np.allclose(total_flux(environment_texels(image, r, rotation), r), flux_of(image), rtol=1e-9)


def test_a_constant_environment_is_constant_and_black_is_black():
    assert np.allclose(environment_texels(np.full((32, 64, 3), 0.7), 8), 0.7, rtol=1e-14)
    assert np.array_equal(environment_texels(np.zeros((4, 8, 3)), 2), np.zeros((24, 3)))
    assert np.array_equal(Turn(4, random_rotation(1, 1))(np.zeros((96, 3))), np.zeros((96, 3)))
    assert np.array_equal(sun_texels([0, 0, 1], [0, 0, 0], 0.1, 4), np.zeros((96, 3)))


def test_texels_hold_the_mean_radiance_of_a_smooth_light():
    r, order = 16, 3
    coefficients = RANDOM.normal(size=(order * order, 3)) + np.array([9.0] + [0] * 8)[:, None]
    rows, columns = np.arange(256)[:, None], np.arange(512)[None]
    directions = environment.direction_of_pixel(rows, columns, 256, 512)
    image = multiply(evaluate(order, directions.reshape(-1, 3)), coefficients).reshape(256, 512, 3)
    expected = multiply(evaluate(order, cubemap_directions(r)), coefficients)
    found = environment_texels(image, r)
    assert np.sqrt(np.mean((found - expected) ** 2) / np.mean(expected ** 2)) < 4e-3


def test_a_bright_pixel_is_where_the_environment_says_at_any_rotation():
    image = np.zeros((64, 128, 3))
    image[20, 37] = [1e6, 2e6, 3e6]
    direction = environment.direction_of_pixel(20, 37, 64, 128)
    for rotation in (np.eye(3), environment.world_rotation(70.0), random_rotation(4, 4)):
        texels = environment_texels(image, 8, rotation)
        mean = (texels * cubemap_solid_angles(8)[:, None]).sum(axis=1) @ cubemap_directions(8)
        assert np.arccos(mean @ (rotation @ direction) / np.linalg.norm(mean)) < 0.5 * angular_size(8)


@pytest.mark.parametrize("r", [8, 16])
def test_a_sun_of_a_few_pixels_keeps_its_place_within_a_texel(r):
    # What a lit surface feels of a sun is its flux times its direction: as a lamp's, not the texel's middle.
    for row, column in ((17, 3), (40, 77), (29, 101), (55, 60)):
        image = np.full((128, 256, 3), 0.2)
        image[row, column] = 1e4
        found = environment_texels(image, r) - environment_texels(np.full((128, 256, 3), 0.2), r)
        direction = environment.direction_of_pixel(row, column, 128, 256)
        lamp = sun_texels(direction, [1.0, 1.0, 1.0], 0.0, r)
        assert np.allclose(found / found.sum(), lamp / lamp.sum(), atol=1e-3)
        moment = (found[:, 0] * cubemap_solid_angles(r)) @ cubemap_directions(r)
        assert np.arccos(moment @ direction / np.linalg.norm(moment)) < 0.05 * angular_size(r)


def test_a_turn_blurs_no_sun_and_is_nearly_the_turned_image():
    r, image = 16, np.full((64, 128, 3), 0.2)
    image[20, 37] = 5e3
    direction = environment.direction_of_pixel(20, 37, 64, 128)
    kept = EnvironmentTexels.of(image, r)
    for rotation in (None, environment.world_rotation(33.0), random_rotation(2, 2)):
        turned, exact = kept.turned(rotation), environment_texels(image, r, rotation)
        assert np.allclose(total_flux(turned, r), flux_of(image), rtol=1e-9)
        assert np.abs(turned - exact).max() < 0.01 * exact.max()
        place = direction if rotation is None else rotation @ direction
        lamp = sun_texels(place, [1.0, 1.0, 1.0], 0.0, r)
        assert (turned[:, 0] > 1.0).sum() == (lamp[:, 0] > 1e-3).sum() <= 4
        blurred = Turn(r, np.eye(3) if rotation is None else rotation)(kept.turned())
        assert rotation is None or (blurred[:, 0] > 1.0).sum() > 4


def test_environment_texels_agree_with_the_harmonics_of_the_image():
    image = np.abs(RANDOM.normal(size=(40, 80, 3))) ** 4
    rotation = random_rotation(2, 9)
    r = 32
    texels = environment_texels(image, r, rotation) * cubemap_solid_angles(r)[:, None]
    found = multiply(np.ascontiguousarray(evaluate(3, cubemap_directions(r)).T), texels)
    expected = environment.project(image, 3, rotation)
    assert np.linalg.norm(found - expected) < 3e-3 * np.linalg.norm(expected)


@pytest.mark.parametrize("angle", [0.0, 0.0093, 0.3, math.pi])
def test_a_sun_keeps_its_flux_and_place(angle):
    r, irradiance = 16, np.array([1.0, 2.0, 3.0])
    for direction in ([0, 0, 1], [1, 1, 1], [1.0, -0.999, 0.2], [-0.3, 0.4, -2.0]):
        texels = sun_texels(direction, irradiance, angle, r)
        assert np.allclose(total_flux(texels, r), irradiance * 2 / (1 + math.cos(angle / 2)), rtol=1e-12)
        assert texels.min() >= 0
        weighted = texels * cubemap_solid_angles(r)[:, None]
        found = multiply(np.ascontiguousarray(evaluate(2, cubemap_directions(r)).T), weighted)
        expected = analytic.sun(direction, irradiance, angle, 2)
        assert np.linalg.norm(found - expected) < 1e-2 * np.linalg.norm(expected)


def test_a_sun_moves_smoothly_over_the_whole_cube():
    r, steps = 8, 20000
    turn = np.linspace(0, 2 * math.pi, steps)
    path = np.stack([np.cos(turn), np.sin(turn), 0.7 * np.cos(3 * turn)], axis=1)
    last, largest = None, 0.0
    for direction in path[::40]:
        shares = sun_texels(direction, np.ones(3), 0.0, r)[:, 0] * cubemap_solid_angles(r)
        if last is not None:
            largest = max(largest, np.abs(shares - last).sum())
        last = shares
    # Two thirds of a texel's width a step at most: the shares that move are twice that.
    step = np.linalg.norm(np.diff(path[::40], axis=0), axis=1).max()
    assert largest < 4.0 * step / angular_size(r) * 3 ** 0.5


def cube_rotations():
    for permutation in itertools.permutations(range(3)):
        for signs in itertools.product((1, -1), repeat=3):
            matrix = np.zeros((3, 3))
            matrix[range(3), permutation] = signs
            if np.linalg.det(matrix) > 0:
                yield matrix


def test_quarter_turns_permute_texels_exactly():
    r = 4
    texels = RANDOM.random((6 * r * r, 3)) * 1e3
    rotations = list(cube_rotations())
    assert len(rotations) == 24
    for rotation in rotations:
        place = texel_of(cubemap_directions(r) @ rotation, r)
        assert sorted(place) == list(range(6 * r * r))
        assert np.allclose(Turn(r, rotation)(texels), texels[place], rtol=1e-9)
        assert np.allclose(bilinear_look_up(texels, r, rotation), texels[place], rtol=1e-9)


@pytest.mark.parametrize("r", [1, 2, 8, 32])
def test_turns_keep_constants_and_flux(r):
    for index in range(3):
        turn = Turn(r, random_rotation(8, index))
        assert np.allclose(turn(constant_texels([1, 2, 3], r)), [1, 2, 3], rtol=1e-13)
        texels = RANDOM.random((6 * r * r, 3))
        texels[RANDOM.integers(6 * r * r)] = 1e6
        turned = turn(texels)
        assert np.allclose(total_flux(turned, r), total_flux(texels, r), rtol=1e-11)
        assert turned.min() >= 0


def test_a_turned_sun_is_where_it_turned_to_and_the_plain_look_up_loses_it():
    r = 16
    lost = []
    for index in range(20):
        rotation = random_rotation(5, index)
        texels = np.zeros((6 * r * r, 3))
        source = RANDOM.integers(6 * r * r)
        texels[source] = 1e6
        turned = Turn(r, rotation)(texels)[:, 0] * cubemap_solid_angles(r)
        mean = turned @ cubemap_directions(r)
        wanted = rotation @ cubemap_directions(r)[source]
        assert np.arccos(min(1.0, mean @ wanted / np.linalg.norm(mean))) < 0.5 * angular_size(r)
        plain = total_flux(bilinear_look_up(texels, r, rotation), r)[0] / total_flux(texels, r)[0]
        lost.append(abs(plain - 1))
    assert max(lost) > 0.2


def test_a_smooth_light_turns_as_its_harmonics_do():
    r, order = 32, 4
    coefficients = RANDOM.normal(size=(order * order, 1)).repeat(3, axis=1)
    texels = multiply(evaluate(order, cubemap_directions(r)), coefficients)
    rotation = random_rotation(6, 6)
    exact = multiply(evaluate(order, cubemap_directions(r) @ rotation), coefficients)
    turned = Turn(r, rotation)(texels)
    assert np.sqrt(np.mean((turned - exact) ** 2) / np.mean(exact ** 2)) < 0.02


def test_a_turn_and_its_projection_take_few_milliseconds():
    # The bound is 5 ms on a free machine (benchmarks/eigentransport.py --turns prints it); this one is shared.
    r = 32
    texels = RANDOM.random((6 * r * r, 3))
    bases = RANDOM.random((193, 6 * r * r)).astype(np.float32)
    least = math.inf
    for index in range(6):
        started = time.perf_counter()
        multiply(bases, Turn(r, random_rotation(9, index))(texels).astype(np.float32))
        least = min(least, time.perf_counter() - started)
    assert least < 0.05


def test_impossible_lights_are_refused():
    with pytest.raises(ValueError, match="height, width"):
        environment_texels(np.zeros((4, 4)), 4)
    with pytest.raises(ValueError, match="direction"):
        sun_texels([0, 0, 0], np.ones(3), 0.0, 4)
    with pytest.raises(ValueError, match="angle"):
        sun_texels([0, 0, 1], np.ones(3), 4.0, 4)
    with pytest.raises(ValueError, match="rotation"):
        Turn(4, np.eye(4))
