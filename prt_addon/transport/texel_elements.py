# SPDX-License-Identifier: GPL-3.0-or-later
"""Elements of direct light that are means over a texel, as bakes fill cubemap columns: several rays for each element.

With the directions of `cubemap_transfer` an element here is the element there, so that a part of the elements stands
for the same matrix.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ..basis.cubemap import sample_directions, texel_count
from ..linear_algebra import multiply
from ..tracing.tracer import Tracer
from .elements import Places, Single, TracedElements
from .receiver_set import ReceiverSet
from .texel_visibility import part_solid_angles

# Cosines of receivers in all directions in one go: 64 x 6,144 of them are 1.5 MB.
AT_ONCE = 64


@dataclass
class TexelElements(TracedElements):
    """Direct light in cubemap texels, `samples` x `samples` rays through each: value = the share of the texel's
    cosine-weighted solid angle that is seen (0 to 1), factor = that weight over pi, with the receiver's sum over an
    open sky made exact. See `Elements` for what the parts mean."""

    tracer: Tracer
    receivers: ReceiverSet
    r: int
    samples: int = 1
    asked: int = 0
    angular: bool = True
    highest: float = 1.0
    _directions: Single = field(init=False)
    _weights: Single = field(init=False)

    def __post_init__(self) -> None:
        self._directions = np.ascontiguousarray(sample_directions(self.r, self.samples), np.float32)
        weights = (part_solid_angles(self.r, self.samples) / np.pi).astype(np.float32)
        self._weights = weights.reshape(self._directions.shape[:2])

    @property
    def columns(self) -> int:
        """See `Elements`."""
        return texel_count(self.r)

    def _rays_each(self) -> int:
        return self._directions.shape[1]

    def _trace(self, receivers: Places, columns: Places) -> tuple[Single, int]:
        """Values (m,) of elements, and rays."""
        directions = self._directions[columns].transpose(1, 0, 2)  # ray by ray, so that those of near receivers follow
        normals = self.receivers.normals[receivers].astype(np.float32)
        cosines = np.vecdot(directions, normals)  # small
        weights = np.maximum(cosines, np.float32(0.0)) * self._weights[columns].T
        sample, element = np.nonzero(cosines > 0.0)
        towards, place = directions[sample, element], receivers[element]
        seen = np.ones(len(place), np.float32)
        low = np.flatnonzero(cosines[sample, element] < self.receivers.grazing[place])
        seen[low] = self.receivers.above_faces(place[low], towards[low])
        seen[self.tracer.occluded(self.receivers.origins[place], towards)] = 0.0
        values = np.bincount(element, weights[sample, element] * seen, len(receivers)).astype(np.float32)
        values /= np.maximum(weights.sum(axis=0), np.finfo(np.float32).tiny)
        return np.minimum(values, np.float32(1.0)), len(place)

    def unknown(self, receivers: Places) -> NDArray[np.bool_]:
        """Texels of which a ray is above the receiver's horizon."""
        return self._open(receivers) > 0.0

    def factor(self, receivers: Places) -> Single:
        """What an open texel brings, normalised."""
        result = self._open(receivers)
        result /= np.maximum(result.sum(axis=1, keepdims=True), np.finfo(np.float32).tiny)
        return result

    def _open(self, receivers: Places) -> Single:
        """Clamped cosine x solid angle / pi (n, columns) of texels."""
        result = np.empty((len(receivers), self.columns), np.float32)
        directions = self._directions.reshape(-1, 3).T
        for start in range(0, len(receivers), AT_ONCE):
            normals = self.receivers.normals[receivers[start:start + AT_ONCE]].astype(np.float32)
            cosines = np.maximum(multiply(normals, directions), np.float32(0.0))
            cosines *= self._weights.reshape(-1)
            result[start:start + AT_ONCE] = cosines.reshape(len(normals), self.columns, -1).sum(axis=2)
        return result
