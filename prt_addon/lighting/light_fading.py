# SPDX-License-Identifier: GPL-3.0-or-later
"""Lights of a cloud fade in and out where walls show or hide them from a moving lamp (Kristensen et al. 2005, 6.1).

Without that the indirect light would jump as a lamp passes a door.
"""

from __future__ import annotations

from collections.abc import Hashable, Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .light_interpolation import CloudInterpolator, CloudWeights

FADE_SECONDS = 0.3


class FadingWeights:
    """The weights of lamps that move in time.

    Each lamp remembers how far every light around it has faded in. A light that becomes its neighbour has no weight
    yet, so it starts as visible or hidden as it is, and so does all at a lamp's first step or after a leap.
    """

    def __init__(self, interpolator: CloudInterpolator, fade_seconds: float = FADE_SECONDS) -> None:
        self.interpolator = interpolator
        self.fade_seconds = fade_seconds
        self._fades: dict[Hashable, NDArray[np.float32]] = {}
        self.settled = True

    def step(self, seconds: float, lamps: Sequence[Hashable], positions: ArrayLike) -> CloudWeights:
        """The weights for lamps (n names) at positions (n, 3) so many seconds after the last step. `settled` says
        afterwards whether a further step without a move would change nothing. Lamps that are not named are forgotten.
        """
        near = self.interpolator.neighbours(positions)
        lights = len(self.interpolator.cloud.positions)
        unknown = np.full(lights + 1, np.nan, np.float32)  # the last one stands for no light
        before = np.stack([self._fades.get(lamp, unknown) for lamp in lamps]) if len(lamps) else unknown[None, :][:0]
        flat = near.index.reshape(len(before), -1)
        target = near.visible.reshape(flat.shape).astype(np.float32)
        known = np.take_along_axis(before, flat, axis=1)
        most = np.float32(max(seconds, 0.0) / self.fade_seconds if self.fade_seconds > 0.0 else 1.0)
        fade = np.where(np.isnan(known), target, known + np.clip(target - known, -most, most))
        after = np.full(before.shape, np.nan, np.float32)
        np.put_along_axis(after, flat, fade, axis=1)
        after[:, -1] = np.nan
        self._fades = dict(zip(lamps, after, strict=True))
        self.settled = bool(np.array_equal(fade[flat >= 0], target[flat >= 0]))
        return self.interpolator.weigh(near, fade.reshape(near.index.shape).astype(np.float64))
