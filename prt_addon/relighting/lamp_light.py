# SPDX-License-Identifier: GPL-3.0-or-later
"""The light of lamps on a bake: bounced in the columns of its light cloud (Kristensen et al. 2005, section 6), direct
by shadow rays.

Lamps with a surface shine into the cloud from a few points of it, each with the lamp's emission in spherical harmonics
up to the order that the cloud was baked with.
"""

from __future__ import annotations

import math
from collections.abc import Hashable, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from ..lighting.light_cloud import LightCloud
from ..lighting.light_fading import FADE_SECONDS, FadingWeights
from ..lighting.light_interpolation import NEAREST, CloudInterpolator
from ..lighting.lit_surfaces import LitSurfaces, LocalBasis
from ..lighting.local_lights import LocalLight
from ..scene.receivers import morton_order
from ..tracing.tracer import Tracer
from .direct_light import LitReceivers, direct_local_light
from .exit_radiance import Baked
from .lamp_highlights import LampHighlights, LampSurfaces
from .surface_light import SurfaceLight

# Points of a lamp with a surface, at most: its indirect light hardly tells more apart.
MOST_POINTS = 16
# Shadow rays from a receiver to a lamp that throws soft shadows.
SHADOW_SAMPLES = 16
# The same while a lamp is dragged: the penumbra shows four steps, at a quarter of the time.
QUICK_SAMPLES = 4
# Seconds that count as a leap: nothing fades.
AT_ONCE = 1e9


@dataclass(frozen=True)
class CloudLight:
    """values: (zones, columns, 3) float32 of all lamps together; outside: names of lamps from which no light of the
    cloud is in sight: they light without bounces; unlit: names of lamps that some zone can't be interpolated for;
    settled: whether a later step without a move would change nothing."""

    values: NDArray[np.float32]
    outside: tuple[str, ...]
    unlit: tuple[str, ...]
    settled: bool


class LampLight:
    """Lamps in one light cloud, step by step in time.

    tracer: of everything that hides lights from each other.
    """

    def __init__(self, cloud: LightCloud, tracer: Tracer, nearest: int = NEAREST,
                 fade_seconds: float = FADE_SECONDS) -> None:
        self.cloud = cloud
        self._fading = FadingWeights(CloudInterpolator(cloud, tracer, nearest), fade_seconds)

    def step(self, lamps: Sequence[LocalLight], seconds: float = AT_ONCE) -> CloudLight:
        """Their light, so many seconds after the last step; by default as if they had always been where they are."""
        cloud, functions = self.cloud, self.cloud.emission_order ** 2
        shape = (cloud.zones, cloud.columns, 3)
        names, places, emissions, keys = [], [], [], []
        for lamp in lamps:
            positions, shares = lamp.points(self._samples(lamp))
            emission = lamp.emission(cloud.emission_order)
            names += [lamp.name] * len(shares)
            keys += [(lamp.key or lamp.name, number) for number in range(len(shares))]
            places.append(positions)
            emissions.append(shares[:, None, None] * emission[None])
        if not names:
            self._fading.step(AT_ONCE, (), np.empty((0, 3)))
            return CloudLight(np.zeros(shape, np.float32), (), (), True)
        found = self._fading.step(seconds, keys, np.concatenate(places))
        # What no light of the cloud sees is not guessed at.
        emission = np.concatenate(emissions).reshape(len(names), functions, 3) * ~found.outside[:, None, None]
        values = found.light(emission).reshape(shape)
        outside = _named(names, found.outside)
        unlit = tuple(n for n in _named(names, found.unlit.any(axis=1)) if n not in outside)
        return CloudLight(values, outside, unlit, self._fading.settled)

    def _samples(self, lamp: LocalLight) -> int:
        """Points of a lamp: as far apart as the cloud's lights."""
        if lamp.kind != "area" or not lamp.extent > 0.0:
            return 1
        across = 2.0 * lamp.extent / max(self.cloud.spacing, 1e-30)
        return int(min(MOST_POINTS, max(1, math.ceil(min(across, MOST_POINTS) ** 2))))


class SurfaceLamps:
    """Lamps in columns of lit surfaces: right wherever they are, and at once.

    tracer: of everything that casts shadows.
    """

    def __init__(self, surfaces: LitSurfaces, tracer: Tracer) -> None:
        self._light = SurfaceLight(surfaces, tracer)

    def step(self, lamps: Sequence[LocalLight], seconds: float = AT_ONCE) -> CloudLight:
        """Their light; nothing of it depends on what was before."""
        values = self._light.columns(lamps, [lamp_shape(lamp) for lamp in lamps])
        limit = np.finfo(np.float32).max  # 1e300 W are the largest number, not infinity, which spreads NaN
        return CloudLight(np.clip(values, -limit, limit).astype(np.float32)[None], (), (), True)


def lamps_in(basis: LocalBasis, tracer: Tracer) -> LampLight | SurfaceLamps:
    """What puts lamps together from the columns of a bake."""
    return SurfaceLamps(basis, tracer) if isinstance(basis, LitSurfaces) else LampLight(basis, tracer)


def unit_lamp(position: NDArray[np.float64], name: str = "") -> LocalLight:
    """A point of 1 W/sr."""
    matrix = np.eye(4)
    matrix[:3, 3] = position
    return LocalLight(name, "point", matrix, np.full(3, 4.0 * math.pi))


def unit_weights(basis: LocalBasis, tracer: Tracer, positions: NDArray[np.float64]) -> NDArray[np.float64]:
    """Weights (places, zones, n) of a point of 1 W/sr at each place (places, 3): of a cloud's lights, each of whose
    first columns is isotropic, or of columns of lit surfaces."""
    if not isinstance(basis, LitSurfaces):
        return CloudInterpolator(basis, tracer).weights(positions).weights
    light = SurfaceLight(basis, tracer)
    found = [light.columns([unit_lamp(place)], [number])[:, 0] for number, place in enumerate(positions)]
    return np.array(found).reshape(len(positions), 1, basis.columns)


def _named(names: Sequence[str], chosen: NDArray[np.bool_]) -> tuple[str, ...]:
    """The names of the chosen ones, each once."""
    return tuple(dict.fromkeys(name for name, taken in zip(names, chosen, strict=True) if taken))


def lamp_shape(lamp: LocalLight) -> Hashable:
    """All that a lamp's light depends on beside its power."""
    return (lamp.kind, lamp.matrix.tobytes(), lamp.radius, lamp.soft_falloff, lamp.spot_angle, lamp.spot_blend,
            lamp.shape, lamp.size, lamp.spread, lamp.shadow)


class LitBake(Baked, Protocol):
    """What direct light reads of storage's BakedTransfer."""

    positions: NDArray[np.float32]
    triangles: NDArray[np.int32]
    lamp_surfaces: LampSurfaces | None

    @property
    def faces(self) -> NDArray[np.float64] | None:
        """(p, 3) unit normals of the triangles that texels lie on; None for vertices."""
        ...


class DirectLight:
    """Direct light of lamps on one bake's receivers.

    tracer: of everything that casts shadows.
    """

    def __init__(self, tracer: Tracer, baked: LitBake, samples: int = SHADOW_SAMPLES) -> None:
        self._tracer, self._samples = tracer, samples
        # Neighbours trace alike: up to a quarter faster than in the mesh's order (benchmarks/direct_light.py).
        self._order = morton_order(baked.positions)
        receivers = LitReceivers.of_mesh(tracer, baked.positions, baked.normals, baked.triangles, baked.faces)
        self._receivers = receivers.taken(self._order)
        self._rows = baked.bases.shape[2]
        self._kept: dict[Hashable, NDArray[np.float32]] = {}
        surfaces = baked.lamp_surfaces
        self._highlights = None if surfaces is None else LampHighlights(
            surfaces, baked.positions, baked.normals, baked.tangents, baked.albedo)

    def of(self, lamps: Sequence[LocalLight], samples: Sequence[int] | None = None) -> NDArray[np.float32]:
        """(points, rows, 3) float32: what they add to the exit radiance, in row 0 for unit albedo.

        samples: shadow rays towards each lamp; None for as many as this was made for. What a lamp gives for each watt
        is kept while it stays among the lamps and as it is, so that only lamps that move cost rays.
        """
        counts = [self._samples] * len(lamps) if samples is None else samples
        keys = [(lamp_shape(lamp), count) for lamp, count in zip(lamps, counts, strict=True)]
        self._kept = {key: self._kept[key] if key in self._kept else self._of_a_watt(lamp, key[1])
                      for key, lamp in zip(keys, lamps, strict=True)}
        result, found = np.zeros((len(self._receivers), self._rows, 3), np.float32), []
        limit = np.finfo(np.float32).max  # as for one lamp: the largest number, not infinity, which spreads NaN
        with np.errstate(over="ignore"):
            for key, lamp in zip(keys, lamps, strict=True):
                light = self._kept[key][:, None] * np.clip(lamp.power, -limit, limit).astype(np.float32)
                found.append((lamp, np.clip(light, -limit, limit, out=light)))
                result[:, 0] += light
        np.clip(result[:, 0], -limit, limit, out=result[:, 0])
        if self._highlights is not None:
            self._highlights.write(result, found)
        return result

    def _of_a_watt(self, lamp: LocalLight, samples: int) -> NDArray[np.float32]:
        """E / pi (points,) of a lamp of 1 W."""
        light = np.empty(len(self._receivers), np.float32)
        lit = direct_local_light(self._tracer, self._receivers, [replace(lamp, power=np.ones(3))], samples)
        light[self._order] = lit[:, 0]
        return light
