# SPDX-License-Identifier: GPL-3.0-or-later
"""Light as the mean radiance of cubemap texels: coefficients of cubemap columns.

A column's transfer holds the texel's solid angle, so its light is a radiance. No light is ever lost: the sum of
radiance times solid angle is that of the source, however small and bright it is, at any rotation.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.sparse import csr_array

from ..basis.cubemap import (
    angular_size,
    bilinear_texels,
    cubemap_directions,
    cubemap_solid_angles,
    texel_count,
    texel_of,
)
from ..basis.directions import disc_directions, tangent_frames
from ..basis.point_sets import fibonacci_square
from ..linear_algebra import sparse_multiply
from .bright_light import bright_pixels
from .environment import direction_of_pixel

Array = NDArray[np.float64]

# Parts of a pixel are at most this share of the smallest texel wide: a texel has some 150 to 750 of them.
_PART = 1.0 / 12.0
_MOST_PARTS = 64  # along a pixel: of pictures a few pixels wide
_PIXELS_AT_ONCE = 1 << 18
# Samples of a sun's disc for each texel that it covers, and at most.
_DISC_SAMPLES, _MOST_DISC_SAMPLES = 64, 1 << 14
# Sweeps that even out a turn's weights: rows then add up to within 2 %, columns exactly.
_SWEEPS = 6


def environment_texels(image: NDArray[np.floating], r: int, rotation: ArrayLike | None = None) -> Array:
    """Mean radiance (6 r r, 3) of an equirectangular image (height, width, 3) in every texel.

    Each pixel is cut into parts of equal azimuth and polar angle, much smaller than a texel, and a texel averages all
    parts whose middle lies in it, by their exact solid angles: a box filter, so nothing aliases, and a constant stays
    one. The parts in a texel do not quite add up to its solid angle (2 %), so means times solid angles are not quite
    the image's flux; what is missing is shared by the texels in proportion to how much each may have lost, which gives
    a bright pixel back its own. Pixels of a sun are shared bilinearly between the texels around them instead, as
    `sun_texels` does: in a box a sun would stand in its texel's middle, up to 6 degrees off at r = 8, which made errors
    of relit scenes 15 to 30 % larger (benchmarks/all_frequency.py). rotation: R (3, 3) of the environment,
    f(R^-1 s).
    """
    _check_image(image)
    turn = np.eye(3) if rotation is None else np.asarray(rotation, np.float64)
    rest, directions, flux = _without_suns(image)
    texels = _box_filtered(rest, r, None if rotation is None else turn)
    return _with_suns(texels, directions, flux, r, turn)


def _without_suns(image: NDArray[np.floating]) -> tuple[NDArray[np.floating], Array, Array]:
    """The image without the pixels of suns, and the directions (k, 3) and fluxes (k, 3) of these."""
    bright, rest = bright_pixels(image, np.eye(3), 0)
    if bright is None:
        return rest, np.empty((0, 3)), np.empty((0, 3))
    directions, solid_angles = bright.place(bright.cells, np.full((len(bright.cells), 2), 0.5))
    return rest, directions, bright.radiance * solid_angles[:, None]


def _with_suns(texels: Array, directions: Array, flux: Array, r: int, turn: Array) -> Array:
    """Texels (6 r r, 3) and the suns' pixels, turned by R (3, 3)."""
    if not len(flux):
        return texels
    turned = np.sum(directions[:, None, :] * turn, axis=2)
    return texels + shared(turned, flux, r) / cubemap_solid_angles(r)[:, None]


@dataclass(frozen=True)
class EnvironmentTexels:
    """An environment's texels, made once, that turn within milliseconds: what is broad by `Turn`, the pixels of suns
    themselves, so that no turn blurs their shadows.

    r: texels along an edge; broad: (6 r r, 3); directions, flux: (k, 3) of the suns' pixels.
    """

    r: int
    broad: Array
    directions: Array
    flux: Array

    @staticmethod
    def of(image: NDArray[np.floating], r: int) -> EnvironmentTexels:
        """Of an equirectangular image (height, width, 3). Raises ValueError where it has another shape."""
        _check_image(image)
        rest, directions, flux = _without_suns(image)
        return EnvironmentTexels(r, _box_filtered(rest, r, None), directions, flux)

    def turned(self, rotation: ArrayLike | None = None) -> Array:
        """Mean radiance (6 r r, 3) of f(R^-1 s)."""
        turn = np.eye(3) if rotation is None else np.asarray(rotation, np.float64)
        straight = np.abs(turn - np.eye(3)).max() < 1e-7
        broad = self.broad if straight else Turn(self.r, turn)(self.broad)
        return _with_suns(broad, self.directions, self.flux, self.r, turn)


def _check_image(image: NDArray[np.floating]) -> None:
    if image.ndim != 3 or image.shape[2] != 3 or 0 in image.shape:
        raise ValueError(f"an environment must be a (height, width, 3) array, not {image.shape}")


def _box_filtered(image: NDArray[np.floating], r: int, turn: Array | None) -> Array:
    """`environment_texels` of an image without a sun."""
    flux, area = _counted(image, r, turn)
    solid_angles = cubemap_solid_angles(r)
    mean = flux / np.maximum(area, np.finfo(np.float64).tiny)[:, None]
    doubtful = np.abs(mean) * np.abs(area - solid_angles)[:, None]
    missing = flux.sum(axis=0) - np.sum(mean * solid_angles[:, None], axis=0)
    doubt = doubtful.sum(axis=0)
    return mean + doubtful / solid_angles[:, None] * np.divide(missing, doubt, out=np.zeros(3), where=doubt > 0.0)


def _counted(image: NDArray[np.floating], r: int, turn: Array | None) -> tuple[Array, Array]:
    """Flux (6 r r, 3) and solid angle (6 r r,) of the parts of pixels that lie in every texel."""
    height, width = image.shape[:2]
    parts = _parts_along(height, width, r)
    flux, area = np.zeros((texel_count(r), 3)), np.zeros(texel_count(r))
    columns = (np.arange(width * parts) + 0.5) / parts - 0.5
    rows_at_once = max(1, _PIXELS_AT_ONCE // (width * parts))
    for start in range(0, height * parts, rows_at_once):
        row = np.arange(start, min(start + rows_at_once, height * parts))
        edges = np.cos(np.append(row, row[-1] + 1) * (math.pi / (height * parts)))
        share = np.repeat((edges[:-1] - edges[1:]) * (2 * math.pi / (width * parts)), width * parts)
        directions = direction_of_pixel(((row + 0.5) / parts - 0.5)[:, None], columns[None], height, width)
        if turn is not None:
            directions = np.sum(directions[..., None, :] * turn, axis=-1)
        texels = texel_of(directions, r).ravel()
        area += np.bincount(texels, share, len(area))
        values = np.repeat(image[row // parts].astype(np.float64), parts, axis=1).reshape(-1, 3)
        for channel in range(3):
            flux[:, channel] += np.bincount(texels, values[:, channel] * share, len(area))
    return flux, area


def _parts_along(height: int, width: int, r: int) -> int:
    """Into how many parts pixels are cut along each side."""
    smallest = angular_size(r) / 3.0 ** 0.75  # in a face's corner, as the root of its solid angle
    pixel = max(math.pi / height, 2 * math.pi / width)
    return min(_MOST_PARTS, max(1, math.ceil(pixel / (_PART * smallest))))


def sun_texels(direction_to_light: ArrayLike, irradiance: ArrayLike, angle: float, r: int) -> Array:
    """Mean radiance (6 r r, 3) of a Sun: `irradiance` (3,) on a facing surface, full angle of its disc in radians.

    The disc's flux, irradiance times 2 / (1 + cos(angle / 2)) as in `analytic.sun`, is shared bilinearly between the
    texels around each of its samples, so that it moves smoothly; none is lost. Raises ValueError for a direction of no
    length or an angle outside 0..pi.
    """
    direction = np.asarray(direction_to_light, np.float64)
    length = float(np.sqrt(np.square(direction).sum()))
    if direction.shape != (3,) or not 0 < length < math.inf:
        raise ValueError("the direction to a sun must be 3 finite numbers, not all zero")
    if not 0 <= angle <= math.pi + 1e-6:
        raise ValueError(f"the angle of a sun must lie in 0..pi, not {angle}")
    angle = min(angle, math.pi)
    flux = 2 / (1 + math.cos(angle / 2))
    samples = direction[None] / length
    if angle > 0:
        count = _DISC_SAMPLES * math.ceil((angle / angular_size(r)) ** 2)
        numbers = (fibonacci_square(min(count, _MOST_DISC_SAMPLES)) + 1.0) * 0.5
        samples, _ = disc_directions(tangent_frames(samples)[0], angle, numbers)
    share = shared(samples, np.full((len(samples), 1), 1.0 / len(samples)), r)
    return (flux * share / cubemap_solid_angles(r)[:, None]) * np.asarray(irradiance, np.float64)


def shared(directions: Array, values: Array, r: int) -> Array:
    """Values (n, k) in directions (n, 3), shared bilinearly between the texels around: (6 r r, k)."""
    texels, weights = bilinear_texels(directions, r)
    return np.stack([np.bincount(texels.ravel(), (weights * column[:, None]).ravel(), texel_count(r))
                     for column in values.T], axis=1)


def constant_texels(colour: ArrayLike, r: int) -> Array:
    """The same radiance (3,) from everywhere: (6 r r, 3)."""
    return np.tile(np.asarray(colour, np.float64), (texel_count(r), 1))


def total_flux(texels: ArrayLike, r: int) -> Array:
    """Radiance times solid angle, summed over the sphere: (3,) of texels (6 r r, 3)."""
    return np.sum(np.asarray(texels, np.float64) * cubemap_solid_angles(r)[:, None], axis=0)


class Turn:
    """A rotation of light in texels: f(R^-1 s), quick enough for every frame of a drag.

    As Nowrouzezahrai et al. (2007), section 5, the lattice turned by the inverse rotation looks the light up
    bilinearly, across the faces' edges. That alone misses or doubles a light of one texel, since texels differ in size
    (0 to 2.2 times its flux is left: benchmarks/eigentransport.py --turns). So the weights are the mean of that look-up
    and of the reverse, where each source texel spreads its flux around the place that it turns to, evened out by
    alternate scaling of both sides (Sinkhorn 1964): every source's flux arrives in full, and constants stay constant.
    """

    def __init__(self, r: int, rotation: ArrayLike) -> None:
        matrix = np.asarray(rotation, np.float64)
        if matrix.shape != (3, 3):
            raise ValueError(f"a rotation must be a (3, 3) matrix, not {matrix.shape}")
        directions, self._solid_angles = cubemap_directions(r), cubemap_solid_angles(r)
        self._looked_up = _spread(np.sum(directions[:, :, None] * matrix, axis=1), r, self._solid_angles)
        self._spread = _spread(np.sum(directions[:, None, :] * matrix, axis=2), r, self._solid_angles)
        self._even_out()

    def _even_out(self) -> None:
        looked_up_back, spread_back = self._looked_up.T, self._spread.T
        self._target = np.ones(len(self._solid_angles))
        self._source = np.ones(len(self._solid_angles))
        for _ in range(_SWEEPS):
            self._target = self._solid_angles / (sparse_multiply(self._looked_up, self._source)
                                                 + sparse_multiply(spread_back, self._source))
            self._source = self._solid_angles / (sparse_multiply(looked_up_back, self._target)
                                                 + sparse_multiply(self._spread, self._target))

    def __call__(self, texels: ArrayLike) -> Array:
        """Turned light (6 r r, 3) of light (6 r r, 3); what is nowhere negative stays so."""
        texels = np.asarray(texels, np.float64)
        floor = texels.min(axis=0)
        scaled = (texels - floor) * self._source[:, None]
        flux = sparse_multiply(self._looked_up, scaled) + sparse_multiply(self._spread.T, scaled)
        return floor + flux * (self._target / self._solid_angles)[:, None]


def _spread(directions: Array, r: int, solid_angles: Array) -> csr_array:
    """Bilinear weights (n, 6 r r) of a lattice's turned directions, times the solid angles of its texels."""
    texels, weights = bilinear_texels(directions, r)
    starts = np.arange(0, 4 * len(texels) + 1, 4, dtype=np.int32)
    return csr_array(((weights * solid_angles[:, None]).ravel(), texels.ravel().astype(np.int32), starts),
                     shape=(len(texels), len(texels)))


def bilinear_look_up(texels: ArrayLike, r: int, rotation: ArrayLike) -> Array:
    """Turned light as published, by the look-up alone: to compare with."""
    directions = np.sum(cubemap_directions(r)[:, :, None] * np.asarray(rotation, np.float64), axis=1)
    places, weights = bilinear_texels(directions, r)
    return np.sum(np.asarray(texels, np.float64)[places] * weights[:, :, None], axis=1)
