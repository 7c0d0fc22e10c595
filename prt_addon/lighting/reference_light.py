# SPDX-License-Identifier: GPL-3.0-or-later
"""The whole light of a scene, detail included: what the reference of the error budget is lit by.

Unlike coefficients it is bound to no order, so that what an order leaves out can be measured.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .analytic import sun
from .bright_light import is_sharp
from .environment import band_energies, direction_of_pixel, pixel_of_direction, project

# Width that environments are averaged to for the reference: a pixel then covers 2.8 degrees, still far finer than any
# order to 10 resolves (18 degrees), and a reference of some thousand paths meets every pixel with light in it. Those
# with a sun or the like, which a cubemap shows sharper, keep pixels of 0.7 degrees: the bright ones are sampled.
REFERENCE_WIDTH, SHARP_WIDTH = 128, 512
# A band with less than this share of the light's energy carries nothing: an error of 1e-3 in radiance at most.
NEGLIGIBLE_ENERGY = 1e-6


@dataclass(frozen=True)
class ReferenceLight:
    """image: (h, w, 3) float32 equirectangular radiance, turned by rotation: R (3, 3), f(R^-1 s);
    sun_directions: (s, 3) unit, towards the suns; sun_irradiance: (s, 3) W/m^2 on a facing surface;
    sun_angles: (s,) full angles in radians; description: what it is, for the report."""

    image: NDArray[np.float32]
    sun_directions: NDArray[np.float64]
    sun_irradiance: NDArray[np.float64]
    sun_angles: NDArray[np.float64]
    description: str
    rotation: NDArray[np.float64] = field(default_factory=lambda: np.eye(3))

    @staticmethod
    def of(image: NDArray[np.floating], rotation: NDArray[np.float64] | None,
           suns: list[tuple[NDArray[np.float64], NDArray[np.float64], float]], description: str) -> ReferenceLight:
        """From an equirectangular image (h, w, 3), its rotation R, f(R^-1 s), and suns (direction, irradiance, angle).
        """
        small = reference_image(image)
        directions = np.array([s[0] for s in suns], np.float64).reshape(-1, 3)
        irradiance = np.array([s[1] for s in suns], np.float64).reshape(-1, 3)
        turn = np.eye(3) if rotation is None else np.asarray(rotation, np.float64)
        return ReferenceLight(small, directions, irradiance, np.array([s[2] for s in suns], np.float64), description,
                              turn)

    @property
    def is_black(self) -> bool:
        """Whether there is no light at all."""
        return not (np.any(self.image > 0.0) or np.any(self.sun_irradiance > 0.0))

    def radiance(self, directions: NDArray[np.float64]) -> NDArray[np.float64]:
        """Radiance (n, 3) of the environment, suns left out, in unit directions (n, 3)."""
        return self.looked_up(self.image, directions)

    def coarse(self) -> ReferenceLight:
        """The same with pixels that paths meet by chance, suns among them."""
        return replace(self, image=averaged(self.image, REFERENCE_WIDTH))

    def looked_up(self, image: NDArray[np.float32], directions: NDArray[np.float64]) -> NDArray[np.float64]:
        """Values (n, 3) of an image like the environment's in unit directions (n, 3) of the world."""
        source = np.sum(directions[:, :, None] * self.rotation, axis=1) if self.is_turned else directions
        row, column = pixel_of_direction(source, *image.shape[:2])
        return image[row, column].astype(np.float64)

    @property
    def is_turned(self) -> bool:
        """Whether the environment's rotation is one."""
        return bool(np.abs(self.rotation - np.eye(3)).max() > 1e-7)

    def coefficients(self, order: int) -> NDArray[np.float64]:
        """Coefficients (order^2, 3) of environment and suns together."""
        total = project(self.image, order, self.rotation if self.is_turned else None)
        for direction, irradiance, angle in zip(self.sun_directions, self.sun_irradiance, self.sun_angles, strict=True):
            total = total + sun(direction, irradiance, float(angle), order)
        return total

    def highest_order(self, limit: int) -> int:
        """The smallest order, up to `limit`, above which the light carries (almost) nothing."""
        energies = band_energies(self.coefficients(limit))
        if energies.sum() <= 0.0:
            return limit
        return int(np.flatnonzero(energies > NEGLIGIBLE_ENERGY * energies.sum()).max()) + 1

    def arrays(self) -> dict[str, NDArray[Any]]:
        """What a file needs to hold beside `header`."""
        return {"image": self.image, "sun_directions": self.sun_directions, "sun_irradiance": self.sun_irradiance,
                "sun_angles": self.sun_angles, "rotation": self.rotation}

    def header(self) -> dict[str, Any]:
        """The JSON-able rest."""
        return {"description": self.description}

    @staticmethod
    def from_arrays(arrays: dict[str, NDArray[Any]], header: dict[str, Any]) -> ReferenceLight:
        """The light kept by `arrays` and `header`."""
        return ReferenceLight(**arrays, **header)


def averaged(image: NDArray[np.floating], width: int) -> NDArray[np.float32]:
    """The image with its pixels averaged in blocks to about `width` columns, weighted by solid angle: no light is lost.

    An image whose sides are no multiples keeps its last rows and columns in smaller blocks.
    """
    factor = max(1, -(-image.shape[1] // width))
    if factor == 1:
        return np.ascontiguousarray(image, np.float32)
    height = image.shape[0]
    edges = np.cos(np.arange(height + 1) * np.pi / height)
    solid_angle = edges[:-1] - edges[1:]
    rows, columns = np.arange(0, height, factor), np.arange(0, image.shape[1], factor)
    sums = np.add.reduceat(image * solid_angle[:, None, None], rows, axis=0)
    sums = np.add.reduceat(sums, columns, axis=1)
    share = np.add.reduceat(solid_angle, rows)
    counts = np.diff([*columns, image.shape[1]])
    return (sums / (share[:, None, None] * counts[None, :, None])).astype(np.float32)


def reference_image(image: NDArray[np.floating]) -> NDArray[np.float32]:
    """An environment (h, w, 3) as fine as the reference needs it."""
    return averaged(image, SHARP_WIDTH if is_sharp(image) else REFERENCE_WIDTH)


def stand_in_light() -> ReferenceLight:
    """A clear sky that brightens towards a broad glow, over darker ground: to judge a scene without light under."""
    rows, columns = np.arange(64)[:, None], np.arange(128)[None, :]
    directions = direction_of_pixel(rows, columns, 64, 128)
    glow = np.array([0.6, -0.4, 0.69282])
    height = directions[..., 2]
    sky = np.where(height > 0.0, 0.6 + 0.4 * height, 0.2)
    sky = sky + 3.0 * np.exp(8.0 * (np.sum(directions * glow, axis=-1) - 1.0))
    image = sky[..., None] * np.array([0.9, 1.0, 1.2])
    return ReferenceLight.of(image, None, [], "a stand-in sky")
