# SPDX-License-Identifier: GPL-3.0-or-later
"""The bright cells of distant light (a sun of a few pixels, a texel that holds one), taken out to be sampled by shadow
rays: paths that leave a scene at random would hit them too seldom to say how bright they are.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..basis.cubemap import cubemap_solid_angles, face_points
from .environment import pixel_solid_angles

Double = NDArray[np.float64]
Cells = NDArray[np.int64]

# A cell so many times as bright as the mean over the sphere is sampled for itself. What is left then varies so little
# that some thousand paths know its mean to a percent.
BRIGHT = 8.0


@dataclass(frozen=True)
class BrightCells:
    """Cells whose light is brought by `sample` alone.

    value: of the emission's values, the one that they belong to; cells: (k,) their numbers; radiance: (k, 3); chance:
    (k,) with which each is chosen, in proportion to its flux; place: directions (n, 3) in cells (n,) by numbers (n, 2)
    in [0, 1), and the solid angles (n,) that these stand for.
    """

    value: int
    cells: Cells
    radiance: Double
    chance: Double
    place: Callable[[Cells, Double], tuple[Double, Double]]

    def sample(self, numbers: Double) -> tuple[Double, Double]:
        """Directions (n, 3) by numbers (n, 3) in [0, 1), and what each brings: (n, 3) radiance times solid angle over
        its probability, so that the mean of what is visible is the integral over all cells."""
        ends = np.cumsum(self.chance)
        which = np.minimum(np.searchsorted(ends, numbers[:, 0] * ends[-1], side="right"), len(ends) - 1)
        directions, solid_angles = self.place(self.cells[which], numbers[:, 1:])
        return directions, self.radiance[which] * (solid_angles / self.chance[which])[:, None]


def bright_pixels(image: NDArray[np.floating], rotation: Double, value: int,
                  ) -> tuple[BrightCells | None, NDArray[np.floating]]:
    """The bright pixels of an equirectangular image (h, w, 3), turned by R (3, 3), f(R^-1 s), and the image without
    them; None and the image itself where none is bright."""
    height, width = image.shape[:2]
    edges = np.cos(np.arange(height + 1) * (math.pi / height))
    solid_angles = np.repeat(pixel_solid_angles(height, width), width)

    def place(cells: Cells, numbers: Double) -> tuple[Double, Double]:
        row, column = np.divmod(cells, width)
        z = edges[row] + numbers[:, 0] * (edges[row + 1] - edges[row])  # even in solid angle
        azimuth = math.pi * (1.0 - 2.0 * (column + numbers[:, 1]) / width)
        sine = np.sqrt(np.maximum(1.0 - z * z, 0.0))
        local = np.stack([sine * np.cos(azimuth), sine * np.sin(azimuth), z], axis=1)
        return np.sum(local[:, None, :] * rotation, axis=2), solid_angles[cells]

    bright, rest = _split(image.reshape(-1, 3), solid_angles, value, place)
    return bright, image if bright is None else rest.reshape(image.shape).astype(image.dtype, copy=False)


def bright_texels(texels: Double, r: int, value: int) -> tuple[BrightCells | None, Double]:
    """The bright texels of light (6 r r, 3) in a cubemap, and the light without them; None where none is bright."""
    def place(cells: Cells, numbers: Double) -> tuple[Double, Double]:
        face, within = np.divmod(cells, r * r)
        row, column = np.divmod(within, r)
        u, v = (2.0 * (position + number) / r - 1.0 for position, number in ((column, numbers[:, 0]),
                                                                             (row, numbers[:, 1])))
        points = face_points(face, u, v)
        distance = np.sqrt(np.sum(points ** 2, axis=1))
        # Even on the face: a part of it shrinks with the cube of its distance.
        return points / distance[:, None], 4.0 / (r * r) / distance ** 3

    return _split(texels, cubemap_solid_angles(r), value, place)


def is_sharp(image: NDArray[np.floating]) -> bool:
    """Whether an equirectangular image (h, w, 3) has bright pixels, without copies of it: it may have many."""
    brightness = image.max(axis=2)
    rows = brightness.sum(axis=1, dtype=np.float64) * pixel_solid_angles(*image.shape[:2])
    return float(brightness.max()) > BRIGHT * float(rows.sum()) / (4.0 * math.pi) > 0.0


def _split(light: NDArray[np.floating], solid_angles: Double, value: int,
           place: Callable[[Cells, Double], tuple[Double, Double]]) -> tuple[BrightCells | None, Double]:
    """Cells of light (n, 3) much brighter than the mean, by their brightest channel, and the rest."""
    brightness = light.max(axis=1).astype(np.float64)
    mean = float(np.sum(brightness * solid_angles)) / (4.0 * math.pi)
    cells = np.flatnonzero(brightness > BRIGHT * mean) if mean > 0.0 else np.empty(0, np.int64)
    if not len(cells):
        return None, light
    rest = np.array(light)
    rest[cells] = 0.0
    flux = brightness[cells] * solid_angles[cells]
    return BrightCells(value, cells, light[cells].astype(np.float64), flux / flux.sum(), place), rest
