# SPDX-License-Identifier: GPL-3.0-or-later
"""Equirectangular environments: Blender's mapping of directions, exact projection, what an order leaves out.

Images are (height, width, 3), linear, top row first (as in the file; `bpy.types.Image.pixels` is bottom row first).
The convention, proven against Cycles by tests/blender/test_environment_orientation.py: the picture's middle is +X, a
quarter of the width to the left is +Y, the top row is around +Z:

    azimuth = pi (1 - 2 u),   polar angle from +Z = pi v,   u = (column + 1/2) / width,   v = (row + 1/2) / height
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..basis.spherical_harmonics import evaluate, expand_bands, order_of, rotate
from ..errors import PRTError
from ..linear_algebra import multiply
from .image_files import read_image

Array = NDArray[np.float64]
Image = NDArray[np.floating]

_ROWS_AT_ONCE = 64  # a block of a 4096 pixels wide image in double precision is 6 MiB


def load_equirectangular(path: str | Path) -> NDArray[np.float32]:
    """The radiance of an environment file, (height, width, 3) float32 linear, top row first.

    Reads OpenEXR (.exr) and Radiance (.hdr). Raises PRTError naming the file where it is missing, unreadable or has
    values that are not finite.
    """
    image = read_image(Path(path))
    check_finite(image, str(path))
    return image


def check_finite(image: Image, subject: str) -> None:
    """Raises PRTError that counts the pixels with NaN or infinity and names the first; one would spoil all light."""
    wrong = ~np.isfinite(image).all(axis=2)
    count = int(np.count_nonzero(wrong))
    if count:
        row, column = np.unravel_index(int(wrong.argmax()), wrong.shape)
        raise PRTError(subject, f"{count} of its pixels hold NaN or infinity, the first at column {column}, row {row} "
                       "from the top", "Repair these pixels in an image editor, or choose another image")


def direction_of_pixel(row: ArrayLike, column: ArrayLike, height: int, width: int) -> Array:
    """The unit directions (..., 3) of pixel centres; rows count from the top, fractions are allowed."""
    azimuth = math.pi * (1 - 2 * (np.asarray(column, np.float64) + 0.5) / width)
    polar = math.pi * (np.asarray(row, np.float64) + 0.5) / height
    sine = np.sin(polar)
    return np.stack(np.broadcast_arrays(sine * np.cos(azimuth), sine * np.sin(azimuth), np.cos(polar)), axis=-1)


def pixel_of_direction(directions: ArrayLike, height: int, width: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Row from the top and column of the pixel that each direction (..., 3), of any length, falls in."""
    x, y, z = np.moveaxis(np.asarray(directions, np.float64), -1, 0)
    u = 0.5 - np.arctan2(y, x) / (2 * math.pi)
    v = np.arctan2(np.hypot(x, y), z) / math.pi
    row = np.clip((v * height).astype(np.intp), 0, height - 1)
    return row, (u * width).astype(np.intp) % width


def pixel_solid_angles(height: int, width: int) -> Array:
    """(height,) exact solid angle of a pixel of each row, in steradians."""
    edges = np.cos(np.arange(height + 1) * (math.pi / height))
    return (edges[:-1] - edges[1:]) * (2.0 * math.pi / width)


def world_rotation(degrees: float) -> Array:
    """The rotation R (3, 3) of the environment, f(R^-1 s), by a Z rotation in the World's Mapping node (type Point).

    The node turns the direction that looks the image up, f(M s) with M the turn by `degrees`: the picture itself turns
    the other way. Proven against Cycles in tests/blender/test_environment_orientation.py.
    """
    angle = math.radians(degrees)
    cosine, sine = math.cos(angle), math.sin(angle)
    return np.array([[cosine, sine, 0], [-sine, cosine, 0], [0, 0, 1.0]])


def project(image: Image, order: int, rotation: ArrayLike | None = None) -> Array:
    """Coefficients (order^2, 3) of an equirectangular image (height, width, 3) of radiance, float64.

    Each pixel is constant over its area, and the functions are integrated over it, not sampled: in azimuth in closed
    form, in the polar angle by Gauss-Legendre nodes enough for rounding error. So no light is lost, however small and
    bright; a constant image gives exactly its colour times sqrt(4 pi). rotation: 3x3, applied after (`world_rotation`).
    Raises ValueError where the image has another shape.
    """
    _check_shape(image)
    height = len(image)
    azimuthal = _azimuthal_integrals(image, order)  # (height, 3, 2 order - 1), column m + order - 1
    polar = _polar_integrals(order, height)  # (height, order^2)
    coefficients = np.empty((order * order, 3))
    for band in range(order):
        for m in range(-band, band + 1):
            index = band * (band + 1)
            coefficients[index + m] = (polar[:, index + abs(m), None] * azimuthal[:, :, m + order - 1]).sum(axis=0)
    return coefficients if rotation is None else rotate(coefficients, rotation)


def _check_shape(image: Image) -> None:
    if image.ndim != 3 or image.shape[2] != 3 or 0 in image.shape:
        raise ValueError(f"an environment must be a (height, width, 3) array, not {image.shape}")


def _azimuthal_integrals(image: Image, order: int) -> Array:
    """Every row times cos(m phi), sin(|m| phi), integrated: (height, 3, 2 order - 1), column m + order - 1.

    Over a pixel of width D around phi: integral of cos(m phi) = cos(m phi) 2 sin(m D / 2) / m, and D for m = 0.
    """
    height, width = image.shape[:2]
    azimuth = math.pi * (1 - 2 * (np.arange(width) + 0.5) / width)
    functions = np.empty((width, 2 * order - 1))
    functions[:, order - 1] = 2 * math.pi / width
    for m in range(1, order):
        extent = 2 * math.sin(m * math.pi / width) / m
        functions[:, order - 1 + m] = extent * np.cos(m * azimuth)
        functions[:, order - 1 - m] = extent * np.sin(m * azimuth)
    result = np.empty((height, 3, 2 * order - 1))
    for start in range(0, height, _ROWS_AT_ONCE):
        block = np.asarray(image[start:start + _ROWS_AT_ONCE], np.float64).transpose(0, 2, 1)
        flat = np.ascontiguousarray(block).reshape(-1, width)
        result[start:start + len(block)] = multiply(flat, functions).reshape(len(block), 3, -1)
    return result


def _polar_integrals(order: int, height: int) -> Array:
    """The functions at azimuth 0 times sin, integrated over each row's polar angles: (height, order^2), m >= 0 valid.

    The integrand is a trigonometric polynomial of degree `order`. Gauss-Legendre with K nodes over a phase of +-x
    leaves about (x / 2)^2K / (2 K)!, which is below 1e-15 for the K taken here.
    """
    phase = order * math.pi / (2 * height)
    nodes, weights = np.polynomial.legendre.leggauss(6 + math.ceil(1.5 * phase))
    half = math.pi / (2 * height)
    polar = (2 * np.arange(height)[:, None] + 1 + nodes) * half
    sine = np.sin(polar).ravel()
    directions = np.stack([sine, np.zeros_like(sine), np.cos(polar).ravel()], axis=1)
    values = evaluate(order, directions) * sine[:, None]
    return (values.reshape(height, len(nodes), -1) * (half * weights)[:, None]).sum(axis=1)


def total_energy(image: Image) -> float:
    """Integral of the squared radiance over the sphere, summed over the channels."""
    _check_shape(image)
    height, width = image.shape[:2]
    solid_angles, energy = pixel_solid_angles(height, width), 0.0
    for start in range(0, height, _ROWS_AT_ONCE):
        squares = np.square(image[start:start + _ROWS_AT_ONCE], dtype=np.float64).sum(axis=(1, 2))
        energy += float((squares * solid_angles[start:start + len(squares)]).sum())
    return energy


def band_energies(coefficients: ArrayLike) -> Array:
    """Squared coefficients (order^2, channels) summed over each band and the channels: (order,)."""
    coefficients = np.asarray(coefficients, np.float64)
    order = order_of(len(coefficients))
    squares = np.square(coefficients).reshape(len(coefficients), -1).sum(axis=1)
    return np.add.reduceat(squares, np.arange(order) ** 2)


def energy_by_band(image: Image, order: int) -> Array:
    """Energy of an image in each of the first `order` bands: (order,). Their sum tends to `total_energy`."""
    return band_energies(project(image, order))


def truncation(image: Image, coefficients: ArrayLike) -> float:
    """The share 0..1 of the image's energy (squared radiance) that its coefficients do not hold; 0 for a black image.

    coefficients: of `project`, at any rotation, not windowed (a window's cost is reported by itself). The error that a
    finite order makes, before any transfer; the square root is the relative RMS error of the light.
    """
    total = total_energy(image)
    if total <= 0:
        return 0.0
    return min(max(1 - float(band_energies(coefficients).sum()) / total, 0.0), 1.0)


def apply_bands(coefficients: ArrayLike, factors: ArrayLike) -> Array:
    """Coefficients (order^2, ...) with every band multiplied by its factor (order,): windows, convolutions."""
    coefficients = np.asarray(coefficients, np.float64)
    scale = expand_bands(factors)
    return coefficients * scale.reshape(-1, *[1] * (coefficients.ndim - 1))
