# SPDX-License-Identifier: GPL-3.0-or-later
"""Suns of a few pixels or texels in the reference: found by shadow rays, right on average, and nearly without noise."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from prt_addon.baking.distant_basis import DistantBasis
from prt_addon.baking.recipe import bake, exhaust
from prt_addon.baking.settings import BakeSettings
from prt_addon.basis.cubemap import cubemap_solid_angles, texel_of
from prt_addon.basis.directions import random_rotation
from prt_addon.lighting.bright_light import bright_pixels, bright_texels, is_sharp
from prt_addon.lighting.cubemap_light import EnvironmentTexels, sun_texels
from prt_addon.lighting.environment import direction_of_pixel, pixel_of_direction, project, world_rotation
from prt_addon.lighting.reference_light import ReferenceLight
from prt_addon.scene.scene_mesh import SceneMesh
from prt_addon.tracing.tracer import Tracer
from prt_addon.transport.path_reference import DistantSuns, reference_radiance
from prt_addon.transport.receiver_set import ReceiverSet
from tests.core.shapes import drain, make, plane, sphere

NO_SUNS = DistantSuns(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0))


def disc(radius, height, corners=256):
    """A round occluder that faces down, its middle above the origin."""
    turn = 2.0 * math.pi * np.arange(corners) / corners
    rim = np.stack([radius * np.cos(turn), radius * np.sin(turn), np.full(corners, height)], axis=1)
    positions = np.concatenate([[[0.0, 0.0, height]], rim])
    ring = np.arange(corners)
    triangles = np.stack([np.zeros(corners, int), 1 + (ring + 1) % corners, 1 + ring], axis=1)
    return make("disc", positions, triangles, albedo=(0.0, 0.0, 0.0))


def one_pixel_sun(size, row, column, radiance=1e6, sky=0.0):
    image = np.full((*size, 3), sky)
    image[row, column] = radiance * np.array([1.0, 0.5, 0.25])
    return image


def flux_over_pi(size, row, radiance):
    """Of one pixel on a surface that faces up: radiance times the integral of the cosine, over pi."""
    polar = math.pi * np.array([row, row + 1]) / size[0]
    return radiance * 0.5 * float(np.diff(np.sin(polar) ** 2)[0]) * (2.0 * math.pi / size[1]) / math.pi


def reference(scene, keys, albedo, emission, paths, bounces, bright, seed=1):
    tracer = Tracer(scene.points, scene.triangles, 1)
    receivers = ReceiverSet.of_keys(scene, tracer, np.asarray(keys))
    steps = reference_radiance(tracer, scene, receivers, albedo, emission, NO_SUNS, paths, bounces, seed, bright)
    return drain(steps), receivers


@pytest.mark.parametrize("rotation", [np.eye(3), random_rotation(5, 2)])
def test_samples_of_pixels_lie_in_them_and_stand_for_their_solid_angle(rotation):
    size = (32, 64)
    image = one_pixel_sun(size, 5, 11, sky=0.1)
    image[20, 63] = 4e5
    bright, rest = bright_pixels(image, rotation, 1)
    assert list(bright.cells) == [5 * 64 + 11, 20 * 64 + 63] and rest[5, 11].max() == rest[20, 63].max() == 0.0
    assert (rest[image[..., 0] == 0.1] == 0.1).all() and bright.value == 1
    numbers = np.random.default_rng(1).random((200_000, 3))
    directions, brought = bright.sample(numbers)
    row, column = pixel_of_direction(directions @ rotation, *size)  # R^-1 s
    assert set(zip(row.tolist(), column.tolist(), strict=True)) == {(5, 11), (20, 63)}
    edges = np.cos(np.arange(33) * math.pi / 32)
    solid_angles = (edges[:-1] - edges[1:]) * 2.0 * math.pi / 64
    expected = image[5, 11] * solid_angles[5] + image[20, 63] * solid_angles[20]
    assert np.allclose(brought.mean(axis=0), expected, rtol=0.01)
    # The mean of the cosine over a pixel, in closed form, by the samples that fall in it.
    first = row == 5
    up = (directions @ rotation)[first, 2].mean()
    polar = math.pi * np.array([5, 6]) / 32
    assert up == pytest.approx(0.5 * np.diff(np.sin(polar) ** 2)[0] / -np.diff(np.cos(polar))[0], rel=1e-4)


def test_samples_of_texels_lie_in_them_and_stand_for_their_solid_angle():
    r = 4
    texels = np.full((96, 3), 0.1)
    texels[[3, 40]] = [[1e4, 2e4, 0.0], [3e4, 0.0, 1e4]]
    bright, rest = bright_texels(texels, r, 0)
    assert list(bright.cells) == [3, 40] and rest[[3, 40]].max() == 0.0 and texels[3, 1] == 2e4
    directions, brought = bright.sample(np.random.default_rng(1).random((200_000, 3)))
    found = texel_of(directions, r)
    assert set(found.tolist()) == {3, 40}
    assert np.allclose(np.linalg.norm(directions, axis=1), 1.0, atol=1e-12)
    solid_angles = cubemap_solid_angles(r)
    for cell in (3, 40):
        expected = texels[cell] * solid_angles[cell]
        assert np.allclose(brought[found == cell].sum(axis=0) / len(brought), expected, rtol=0.02)


def test_what_is_even_or_black_has_nothing_bright():
    for image in (np.zeros((8, 16, 3)), np.full((8, 16, 3), 3.0)):
        assert bright_pixels(image, np.eye(3), 0) == (None, image) and not is_sharp(image)
    assert bright_texels(np.ones((24, 3)), 2, 0)[0] is None
    assert is_sharp(one_pixel_sun((64, 128), 3, 3))


def test_a_sun_over_a_plane_with_a_disc_is_the_closed_form():
    # A sun of one pixel around the zenith's side: lit points see all of it, points deep in the disc's shadow nothing.
    size, row, column, radiance = (64, 128), 10, 40, 1e5
    image = one_pixel_sun(size, row, column, radiance)
    bright, rest = bright_pixels(image, np.eye(3), 0)
    assert not rest.any()
    towards = direction_of_pixel(row, column, *size)
    ground = plane(size=8.0, cells=40)
    scene = SceneMesh.assemble([ground, disc(1.0, 1.5)])
    points = scene.points[:41 * 41]
    across = np.linalg.norm(points[:, :2] + 1.5 * towards[:2] / towards[2], axis=1)  # from the shadow's middle
    lit, dark = np.flatnonzero(across > 1.2), np.flatnonzero(across < 0.8)
    assert len(lit) > 1000 and len(dark) > 30
    keys = np.concatenate([lit[::20], dark])
    halves, receivers = reference(scene, np.sort(keys), scene.albedo, lambda d: np.zeros((len(d), 1, 1)), 1024, 0,
                                  [bright])
    is_dark = np.isin(receivers.key, dark)
    assert np.abs(halves[:, is_dark]).max() == 0.0
    expected = flux_over_pi(size, row, radiance) * np.array([1.0, 0.5, 0.25])
    assert np.abs(halves[:, ~is_dark, 0] / expected - 1.0).max() < 2e-3
    by_chance, _ = reference(scene, np.sort(keys), scene.albedo, lambda d: ReferenceLight.of(
        image, None, [], "").radiance(d)[:, None], 1024, 0, [])
    noise = np.std(by_chance[:, ~is_dark, 0] / expected)
    assert noise > 100.0 * np.std(halves[:, ~is_dark, 0] / expected)


def test_penumbra_of_a_round_sun_is_the_covered_share():
    # The rim of the disc halves the sun's pixels where it passes their middle.
    size = (64, 128)
    image = one_pixel_sun(size, 12, 70)
    bright, _ = bright_pixels(image, np.eye(3), 0)
    towards = direction_of_pixel(12, 70, *size)
    height = 2.0
    centre = -height * towards / towards[2]
    scene = SceneMesh.assemble([plane(size=0.02, cells=1, centre=(centre[0], centre[1])), make(
        "half", [[0, -50, height], [0, 50, height], [50, 50, height], [50, -50, height]], [[0, 1, 2], [0, 2, 3]])])
    halves, _ = reference(scene, [0], scene.albedo, lambda d: np.zeros((len(d), 1, 1)), 1 << 15, 0, [bright])
    # Of sunlight on this point the part with x below that of the edge arrives: counted on a grid of the pixel.
    v, u = (np.stack(np.meshgrid(*[(np.arange(400) + 0.5) / 400] * 2, indexing="ij")).reshape(2, -1))
    seen, weight = bright.place(np.full(len(u), bright.cells[0]), np.stack([v, u], axis=1))
    start = scene.points[0]
    passes = start[0] + seen[:, 0] / seen[:, 2] * (height - start[2]) < 0.0
    expected = np.mean(passes * seen[:, 2] * weight) * 1e6 / math.pi
    assert 0.05 < passes.mean() < 0.95
    assert np.abs(halves[:, 0, 0, 0] / expected - 1.0).max() < 0.02


def test_bounced_sun_agrees_with_paths_that_hit_it_by_chance():
    # A texel wide enough that chance finds it too: the same mean, less noise, direct and bounced.
    r = 4
    texels = np.full((96, 3), 0.2)
    texels[texel_of(np.array([[0.5, 0.3, 0.8]]), r)[0]] = 30.0
    bright, rest = bright_texels(texels, r, 0)
    assert bright is not None
    scene = SceneMesh.assemble([plane(size=4.0, cells=4, albedo=(0.8,) * 3), sphere(
        centre=(0, 0, 0.9), radius=0.8, subdivisions=2, albedo=(0.8, 0.4, 0.2))])
    keys = np.flatnonzero(~scene.loose)[::6]
    plain, receivers = reference(scene, keys, scene.albedo, lambda d: texels[texel_of(d, r)][:, None], 4096, 3, [])
    sampled, _ = reference(scene, keys, scene.albedo, lambda d: rest[texel_of(d, r)][:, None], 4096, 3, [bright])
    noise = [np.sqrt(np.mean((h[0] - h[1]) ** 2) / 2.0) for h in (plain, sampled)]
    assert noise[1] < 0.5 * noise[0]
    difference = plain.mean(axis=0) - sampled.mean(axis=0)
    assert np.sqrt(np.mean(difference ** 2)) < 1.5 * np.hypot(*noise) / math.sqrt(2.0)
    assert abs(np.mean(difference)) < 6.0 * noise[0] / math.sqrt(2.0 * difference.size / 3.0)
    assert len(receivers) == len(keys)


def test_a_turned_reference_is_the_turned_image_and_its_texels_are_those_drawn():
    image = np.random.default_rng(3).random((64, 128, 3))
    image[9, 30] = 900.0
    rotation = world_rotation(50.0)
    light = ReferenceLight.of(image, rotation, [], "turned")
    directions = np.random.default_rng(4).normal(size=(500, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    straight = ReferenceLight.of(image, None, [], "straight")
    assert np.array_equal(light.radiance(directions), straight.radiance(directions @ rotation))
    assert np.allclose(light.coefficients(4), project(image.astype(np.float32), 4, rotation), rtol=1e-5, atol=1e-5)
    drawn = EnvironmentTexels.of(image.astype(np.float32), 8).turned(rotation)
    assert np.allclose(DistantBasis(0, 8).coefficients(light), drawn, rtol=1e-9)
    again = ReferenceLight.from_arrays(light.arrays(), light.header())
    assert np.array_equal(again.rotation, rotation) and np.array_equal(again.image, light.image)


def test_the_budget_under_a_hard_sun_is_steady():
    # Few paths and many, from the same receivers, say the same. Found by chance the sun was met by one path of 3,000.
    scene = SceneMesh.assemble([plane(size=4.0, albedo=(0.8,) * 3), sphere(centre=(0, 0, 0.9), radius=0.8)], 0.06)
    image = one_pixel_sun((256, 512), 60, 200, 2e4, sky=0.3)
    light = ReferenceLight.of(image, None, [], "a sky with a sun")
    assert light.image.shape == (256, 512, 3)
    settings = BakeSettings(distant_basis="cubemap", cubemap_size=8, directions=1024, gather_directions=128, vectors=64,
                            encoder="eigentransport", compression_error=1e-3, error_receivers=48, threads=1, bounces=1)
    few, many = (exhaust(bake(scene, replace(settings, error_paths=paths), light=light)).report["errors"]
                 for paths in (512, 16384))
    for name in ("basis", "total"):
        assert few[name]["relative_rms"] == pytest.approx(many[name]["relative_rms"], rel=0.1)
    assert few["sampling"]["relative_rms"] < 0.02 and many["basis"]["relative_rms"] > 0.02


def test_a_sun_lamp_in_texels_is_sampled_too():
    texels = sun_texels([0.3, 0.2, 0.9], [3.0, 3.0, 3.0], 0.0, 16) + 0.2
    bright, rest = bright_texels(texels, 16, 0)
    mean = np.average(texels[:, 0], weights=cubemap_solid_angles(16))
    assert 1 <= len(bright.cells) <= 4 and rest.max() <= 8.0 * mean
