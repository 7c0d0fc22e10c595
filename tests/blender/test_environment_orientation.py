# SPDX-License-Identifier: GPL-3.0-or-later
"""The mapping of directions to the picture and the sign of the Mapping node, against Cycles.

Cycles bakes the irradiance of white facets that face all ways; ours is the projected environment convolved with the
clamped cosine at an order high enough to be compared. The pictures go through real files, so row order is proven too.
"""

from __future__ import annotations

import math
from pathlib import Path

import bpy
import numpy as np
import OpenEXR
import pytest
from mathutils import Euler

from prt_addon.basis.directions import spherical_fibonacci
from prt_addon.basis.spherical_harmonics import evaluate, zonal_cosine
from prt_addon.lighting.environment import (
    apply_bands,
    direction_of_pixel,
    load_equirectangular,
    project,
    world_rotation,
)
from tests.blender.cycles import add_white_facets, baked_irradiance, use_cycles

ORDER = 24  # the clamped cosine is then known to a thousandth
NORMALS = spherical_fibonacci(60)


def set_world(world: bpy.types.World, path: Path, rotation: tuple[float, float, float] | None) -> None:
    """Background <- Environment Texture, and with a rotation (radians) <- Mapping (Point) <- Generated coordinates."""
    tree = world.node_tree
    texture = tree.nodes.new("ShaderNodeTexEnvironment")
    texture.image = bpy.data.images.load(str(path))
    tree.links.new(texture.outputs["Color"], tree.nodes["Background"].inputs["Color"])
    if rotation is None:
        return
    mapping, coordinates = tree.nodes.new("ShaderNodeMapping"), tree.nodes.new("ShaderNodeTexCoord")
    mapping.vector_type = "POINT"
    mapping.inputs["Rotation"].default_value = rotation
    tree.links.new(coordinates.outputs["Generated"], mapping.inputs["Vector"])
    tree.links.new(mapping.outputs["Vector"], texture.inputs["Vector"])


def write_image(path: Path, image: np.ndarray) -> Path:
    with OpenEXR.File({}, {"RGB": image.astype(np.float32)}) as file:
        file.write(str(path))
    return path


def our_irradiance(path: Path, rotation: np.ndarray | None) -> np.ndarray:
    light = project(load_equirectangular(path), ORDER, rotation)
    return evaluate(ORDER, NORMALS) @ apply_bands(light, zonal_cosine(ORDER))


def brightest_direction(irradiance: np.ndarray) -> np.ndarray:
    """Of a small far light: irradiance is a cosine of the normal, fitted where it clearly faces the light."""
    facing = irradiance > 0.25 * irradiance.max()
    direction = np.linalg.lstsq(NORMALS[facing], irradiance[facing], rcond=None)[0]
    return direction / np.linalg.norm(direction)


@pytest.mark.parametrize(("row", "column", "degrees"), [(9, 14, None), (9, 14, 40.0), (22, 51, -100.0)])
@pytest.mark.usefixtures("scene")
def test_one_bright_pixel_lights_from_where_cycles_says(tmp_path: Path, row: int, column: int,
                                                        degrees: float | None) -> None:
    image = np.zeros((32, 64, 3))
    image[row, column] = (50, 100, 200)
    path = write_image(tmp_path / "pixel.exr", image)
    rotation = None if degrees is None else world_rotation(degrees)
    set_world(use_cycles(512), path, None if degrees is None else (0, 0, math.radians(degrees)))
    theirs, ours = baked_irradiance(add_white_facets(NORMALS)), our_irradiance(path, rotation)
    expected = direction_of_pixel(row, column, 32, 64)
    expected = expected if rotation is None else rotation @ expected
    found = brightest_direction(theirs[:, 1])
    assert math.degrees(math.acos(min(found @ expected, 1))) < 1  # a pixel is 5.6 degrees wide

    # Cycles blurs between pixels, which changes the irradiance a little.
    assert np.abs(ours - theirs).max() < 0.01 * theirs.max()
    np.testing.assert_allclose(theirs.sum(axis=0), ours.sum(axis=0), rtol=5e-3)


def smooth_image() -> np.ndarray:
    """No symmetry, colours that differ, softer than Cycles' blur between pixels."""
    rows, columns = np.mgrid[:64, :128]
    directions = direction_of_pixel(rows, columns, 64, 128)
    toward = np.array([[0.36, 0.48, 0.8], [-0.8, 0.6, 0], [0.0, -0.6, -0.8]])
    return np.stack([0.2 + 3 * np.exp(4 * (directions @ t - 1)) for t in toward], axis=2)


@pytest.mark.parametrize("rotation", [None, (0.0, 0.0, 0.9), (0.4, -0.7, 1.1)])
@pytest.mark.usefixtures("scene")
def test_a_coloured_sky_gives_cycles_irradiance(tmp_path: Path, rotation: tuple[float, float, float] | None) -> None:
    """And any rotation M of the Mapping node (type Point) turns the environment by the inverse of M."""
    path = write_image(tmp_path / "sky.exr", smooth_image())
    turned = None if rotation is None else np.array(Euler(rotation).to_matrix()).T
    set_world(use_cycles(512), path, rotation)
    theirs, ours = baked_irradiance(add_white_facets(NORMALS)), our_irradiance(path, turned)
    relative = np.sqrt(((ours - theirs) ** 2).mean() / (theirs**2).mean())
    assert relative < 0.008
    if rotation is not None and rotation[:2] == (0.0, 0.0):
        np.testing.assert_allclose(turned, world_rotation(math.degrees(rotation[2])), atol=1e-6)


@pytest.mark.usefixtures("scene")
def test_bpys_pixels_are_the_file_upside_down(tmp_path: Path) -> None:
    image = smooth_image()
    path = write_image(tmp_path / "sky.exr", image)
    loaded = bpy.data.images.load(str(path))
    pixels = np.empty(4 * 64 * 128, np.float32)
    loaded.pixels.foreach_get(pixels)
    np.testing.assert_allclose(pixels.reshape(64, 128, 4)[::-1, :, :3], image, rtol=1e-3)
