# SPDX-License-Identifier: GPL-3.0-or-later
"""How much of which lights of a cloud stands for a lamp at any position (Kristensen et al. 2005, section 6.1).

All lamps, all zones and all their shadow rays are handled in one go: 16 lamps in 16 zones take a few milliseconds.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree

from ..linear_algebra import multiply
from ..tracing.tracer import Tracer
from .light_cloud import LightCloud
from .light_visibility import visible_between

Interpolation = Literal["linear", "published"]

# Lights of a zone, on the average, that a lamp is interpolated between.
NEAREST = 12
# Exponent of the paper's kernel, (1 - d/r)^4.
EXPONENT = 4
# Visible lights around a lamp are weighed by 1 - d^2/r^2 and r grows until the sum is this share of `nearest`: over a
# ball evenly filled with lights the mean of that weight is 2/5.
SHARE = 0.4
# Nearest lights per wanted one that are looked at: if a wall hides half of them, enough are left.
CANDIDATES = 2
# Variance of the lights' offsets, in squares of r, that counts as no extent at all: 1 % of r across. In a direction in
# which lights hardly spread, the slope of the response can't be told.
RIDGE = 1e-4
# Most that negative weights may sum to. A lamp beyond the last layer of lights is extrapolated; half a spacing, as far
# as a cloud's region reaches beyond its lights, takes 1.5 and -0.5. More would only magnify errors, and could
# make its light negative.
MOST_NEGATIVE = 0.5
# A lamp is outside if no light of the dense cloud within this many spacings is visible from it. Half the diagonal of a
# cell is 0.87 spacings; the rest is for places left out near surfaces.
OUTSIDE = 1.75
# Lights of the dense cloud that are looked at for that.
DENSE_NEIGHBOURS = 8
# A lone light whose weight 1 - d^2/R^2 among all candidates is below this fades: beyond them it is not known.
FAINT = 0.2


@dataclass(frozen=True)
class Neighbours:
    """What n lamps have around them in z zones: their k nearest lights, nearest first.

    index: (n, z, k) into cloud.positions, -1 where a zone has fewer lights; offset: (n, z, k, 3) from lamp to
    light, metres; distance: (n, z, k), inf where there is none; limit: (n, z) distance of the next light after these,
    inf where there is none; visible: (n, z, k) from the lamp; outside: (n,) no light of the dense cloud is in sight.
    """

    index: NDArray[np.int64]
    offset: NDArray[np.float64]
    distance: NDArray[np.float64]
    limit: NDArray[np.float64]
    visible: NDArray[np.bool_]
    outside: NDArray[np.bool_]


@dataclass(frozen=True)
class CloudWeights:
    """weights: (n, zones, most lights of a zone) float64, of each lamp; a zone's sum is 1, or 0 where no light that a
    lamp could be interpolated from is visible: then unlit, (n, zones) bool. outside: (n,) bool, see Neighbours: such a
    lamp's weights are no better than a guess."""

    weights: NDArray[np.float64]
    unlit: NDArray[np.bool_]
    outside: NDArray[np.bool_]

    def light(self, emission: NDArray[np.floating]) -> NDArray[np.float32]:
        """Light (zones, columns, 3) of all lamps together, as relighting takes it. emission: (n, functions, 3), W/sr,
        in the functions that the cloud's lights emit: (n, 1, 3) radiant intensities for isotropic lights."""
        lamps, zones, lights = self.weights.shape
        emission = np.asarray(emission, np.float64)
        if emission.ndim != 3 or len(emission) != lamps:
            raise ValueError(f"emission of shape {emission.shape} for {lamps} lamps")
        total = multiply(self.weights.reshape(lamps, -1).T, emission.reshape(lamps, -1))
        return total.reshape(zones, -1, emission.shape[2]).astype(np.float32)


class CloudInterpolator:
    """Finds a cloud's lights around lamps and weighs them.

    nearest: lights of a zone that a lamp is interpolated between: as many as that in "published", about as many in
    "linear". interpolation: "published", the paper's kernel (1 - d/r)^4, r the distance to the farthest of the m
    nearest; or "linear", the same kernel, corrected so that responses that are linear in position are exact
    (`_linear`), with an r that never jumps (`_radius_squared`).
    """

    def __init__(self, cloud: LightCloud, tracer: Tracer, nearest: int = NEAREST,
                 interpolation: Interpolation = "linear") -> None:
        if nearest < 1 or interpolation not in ("linear", "published"):
            raise ValueError(f"CloudInterpolator: nearest {nearest}, interpolation {interpolation!r}")
        self.cloud, self.tracer, self.nearest, self.interpolation = cloud, tracer, nearest, interpolation
        counts = np.diff(cloud.zone_starts)
        self.count = int(min(nearest * (CANDIDATES if interpolation == "linear" else 1), max(cloud.most_lights, 1)))
        self._zone = np.repeat(np.arange(cloud.zones), counts)
        self._low, self._high = _bounds(cloud)
        # A fourth coordinate, the zone's, so far apart that no light of another zone is nearer than one of the same:
        # one tree answers for all zones at once.
        self._apart = 16.0 * max(float(np.sqrt(np.sum((self._high - self._low) ** 2))), np.finfo(np.float32).tiny)
        self._tree = cKDTree(np.column_stack([cloud.positions, self._apart * self._zone])) if len(self._zone) else None
        self._dense = cKDTree(cloud.dense) if len(cloud.dense) else None

    def weights(self, positions: ArrayLike) -> CloudWeights:
        """The weights for lamps at positions (n, 3), or (3,) for one, metres, world space."""
        return self.weigh(self.neighbours(positions))

    def neighbours(self, positions: ArrayLike) -> Neighbours:
        """The lights around lamps at positions (n, 3) and which of them are visible, in one batch of shadow rays."""
        positions = np.asarray(positions, np.float64).reshape(-1, 3)
        if not np.isfinite(positions).all():
            raise ValueError("CloudInterpolator: positions must be finite")
        # From far outside all lights lie in about the same direction: a place nearer by has the same neighbours and
        # keeps the arithmetic within range.
        reach = self._high - self._low
        near = np.clip(positions, self._low - reach, self._high + reach)
        index, distance, limit = self._nearest(near)
        found = index >= 0
        offset = np.where(found[..., None], self.cloud.positions[index] - near[:, None, None], 0.0) if len(
            self._zone) else np.zeros((*index.shape, 3))
        dense = self._near_dense(positions)
        lamp = np.nonzero(found)[0]
        starts = np.concatenate([positions[lamp], positions[dense[0]]])
        ends = np.concatenate([self.cloud.positions[index[found]], self.cloud.dense[dense[1]]])
        seen = visible_between(self.tracer, starts, ends)
        visible = np.zeros(index.shape, bool)
        visible[found] = seen[:len(lamp)]
        outside = np.ones(len(positions), bool)
        outside[dense[0][seen[len(lamp):]]] = False
        return Neighbours(index, offset, distance, limit, visible, outside)

    def weigh(self, near: Neighbours, fade: NDArray[np.float64] | None = None) -> CloudWeights:
        """Weights of lamps. fade: (n, z, k) from 0 to 1, how far each neighbour counts as visible; None: it does if it
        is. Weights are continuous in fade and in the lamp's position, whichever lights become neighbours or cease to be
        ("published": but where all neighbours are equally far)."""
        fade = near.visible.astype(np.float64) if fade is None else np.where(near.index >= 0, fade, 0.0)
        squared = np.where(near.index >= 0, near.distance, 0.0) ** 2
        if self.interpolation == "published":
            own, strength = _published(near.distance, near.index >= 0, fade)
        else:
            own, strength = _linear(near.offset, squared, near.limit ** 2, fade, self.nearest)
        lamps, zones, _ = near.index.shape
        result = np.zeros((lamps, zones, self.cloud.most_lights))
        lamp, zone, place = np.nonzero(near.index >= 0)
        light = near.index[lamp, zone, place]
        result[lamp, zone, light - self.cloud.zone_starts[zone]] = (own * strength[..., None])[lamp, zone, place]
        return CloudWeights(result, strength <= 0.0, near.outside)

    def _nearest(self, positions: NDArray[np.float64]) -> tuple[NDArray[np.int64], NDArray[np.float64],
                                                                NDArray[np.float64]]:
        """index, distance and limit of Neighbours."""
        lamps, zones = len(positions), self.cloud.zones
        shape = (lamps, zones, self.count + 1)
        index, distance = np.full(shape, -1), np.full(shape, np.inf)
        if self._tree is not None and lamps:
            query = np.concatenate([np.repeat(positions, zones, axis=0),
                                    np.tile(self._apart * np.arange(zones), lamps)[:, None]], axis=1)
            far, light = self._tree.query(query, np.arange(1, self.count + 2))
            own = far < 0.5 * self._apart  # else it is another zone's, or none
            index = np.where(own, light, -1).reshape(shape)
            distance = np.where(own, far, np.inf).reshape(shape)
        return index[..., :-1], distance[..., :-1], distance[..., -1]

    def _near_dense(self, positions: NDArray[np.float64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Pairs of a lamp and a light of the dense cloud within OUTSIDE spacings of it."""
        if self._dense is None or not len(positions):
            return np.zeros(0, np.int64), np.zeros(0, np.int64)
        # A single light at a point has no spacing; a lamp just there is within it.
        reach = max(OUTSIDE * self.cloud.spacing, np.finfo(np.float32).tiny)
        far, light = self._dense.query(positions, np.arange(1, DENSE_NEIGHBOURS + 1), distance_upper_bound=reach)
        lamp, place = np.nonzero(np.isfinite(far))
        return lamp, light[lamp, place]


def _bounds(cloud: LightCloud) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Corners of the box around a cloud's lights, at least a spacing wide."""
    places = cloud.positions if len(cloud.positions) else np.zeros((1, 3))
    low, high = places.min(axis=0), places.max(axis=0)
    margin = 0.5 * np.maximum(max(cloud.spacing, np.finfo(np.float32).tiny) - (high - low), 0.0)
    return low - margin, high + margin


def _published(distance: NDArray[np.float64], found: NDArray[np.bool_], fade: NDArray[np.float64],
               ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Weights (n, z, k) by the paper's kernel and their sum (n, z), 1, or less where the last lights fade.

    The farthest of the nearest has weight 0. Where all that have a weight are hidden, or all are equally far
    (a 1-light cloud, the middle of a grid's cell), the visible ones count alike.
    """
    distance = np.where(found, distance, 0.0)
    radius = np.maximum(distance.max(axis=-1, keepdims=True), np.finfo(np.float64).tiny)
    kernel = fade * (1.0 - distance / radius) ** EXPONENT
    total = kernel.sum(axis=-1, keepdims=True)
    kernel = np.where(total > 0.0, kernel, fade)
    total = kernel.sum(axis=-1, keepdims=True)
    return kernel / np.where(total > 0.0, total, 1.0), fade.max(axis=-1, initial=0.0)


def _linear(offset: NDArray[np.float64], squared: NDArray[np.float64], limit: NDArray[np.float64],
            fade: NDArray[np.float64], nearest: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Weights (n, z, k) that reproduce linear functions of position, and their sum (n, z), 1, or less where the last
    lights fade. squared: (n, z, k) distances; limit: (n, z), both squared.

    Moving least squares of degree 1 (Lancaster and Salkauskas 1981): the plane fitted to the lights' responses under
    the kernel's weights k_i, read at the lamp: k_i (1 - c_i . C^-1 m), m the weighted mean of the offsets o_i,
    c_i = o_i - m, C = sum k_i c_i c_i^T. Weights turn negative where a lamp is beyond its neighbours; then the
    correction is scaled back until they sum to -MOST_NEGATIVE at least.
    """
    share = np.maximum(1.0 - squared / limit[..., None], 0.0)
    radius = np.sqrt(_radius_squared(squared, share, fade, nearest))[..., None]
    kernel = fade * np.maximum(1.0 - np.sqrt(squared) / radius, 0.0) ** EXPONENT
    total = kernel.sum(axis=-1, keepdims=True)
    kernel /= np.where(total > 0.0, total, 1.0)
    # Lights beyond r have no weight; in units of r they could be beyond all range, so they are held at it.
    scaled = np.where(kernel[..., None] > 0.0, offset / radius[..., None], 0.0)
    mean = np.sum(kernel[..., None] * scaled, axis=-2)
    centred = scaled - mean[..., None, :]
    spread = np.matmul((kernel[..., None] * centred).swapaxes(-1, -2), centred) + RIDGE * np.eye(3)  # small
    slope = np.linalg.solve(spread, mean[..., None])  # small
    change = -kernel * np.matmul(centred, slope)[..., 0]  # small
    negative = -np.minimum(kernel + change, 0.0).sum(axis=-1, keepdims=True)
    # The sum of negative parts is concave in the scale and 0 at 0, so scaling it so keeps it within the limit.
    kernel += change * (MOST_NEGATIVE / np.maximum(negative, MOST_NEGATIVE))
    strength = np.max(fade * np.minimum(share / FAINT, 1.0), axis=-1, initial=0.0)
    return kernel, strength


def _radius_squared(squared: NDArray[np.float64], share: NDArray[np.float64], fade: NDArray[np.float64],
                    nearest: int) -> NDArray[np.float64]:
    """The kernel's r squared (n, z): the sum over lights of fade (1 - d^2/r^2), where positive, is SHARE * nearest, or
    half of what it is over all candidates where that is less (small clouds, many lights hidden).

    So r follows visibility and distances without jumps, where the distance to the m-th visible light would not. Over
    the i nearest lights the sum is F_i - S_i / r^2, largest over all i for those within r: each i gives an r and the
    least of them is the solution.
    """
    wanted = np.minimum(SHARE * nearest, 0.5 * np.sum(fade * share, axis=-1, keepdims=True))
    number, weighted = np.cumsum(fade, axis=-1), np.cumsum(fade * squared, axis=-1)
    excess = number - wanted
    found = np.where(excess > 0.0, weighted / np.where(excess > 0.0, excess, 1.0), np.inf).min(axis=-1, initial=np.inf)
    return np.where(np.isfinite(found), np.maximum(found, np.finfo(np.float64).tiny), 1.0)
