# SPDX-License-Identifier: GPL-3.0-or-later
"""Light of lamps through translucent bodies, live: the three passes of Carr et al. 2003 on the CPU, which say what the
shaders (gpu_shaders/subsurface_*.glsl) must give.

    1. what lamps and the scene send to each receiver, times the share that enters: level 0 of the pyramid, and the
       levels above it;
    2. every texel gathers from the nodes that it is linked to;
    3. what was gathered goes to the row of the constant function of the view, and the diffuse row keeps the rest.

Distant light needs none of this: it went through the body when it was baked.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from ..transport.surface_pyramid import SurfacePyramid
from .exit_radiance import Baked, cluster_constants, exit_radiance
from .subsurface_texels import unpacked_links

Single = NDArray[np.float32]
# The constant function y_0, through which subsurface light leaves (Sloan 2003, section 3).
CONSTANT = 0.5 / np.sqrt(np.pi)
# Albedo below which a surface without view-dependent rows can't show what went through it.
DARKEST = 1e-3
# Texels gathered at once: what they read stays in the cache.
BLOCK = 2048


@dataclass(frozen=True)
class SubsurfaceLinks:
    """What a bake keeps. places: (n, 4) float32, per texel of level 0 the receiver that it stands for (-1: none), the
    factor on what went through the body, the share of the diffuse light that goes through it, and its area in square
    metres; texels: (used, K, 4) float32, of the places with a receiver in their order, see `subsurface_texels`; levels:
    of the pyramid."""

    places: Single
    texels: Single
    levels: int

    @property
    def size(self) -> int:
        """Bytes."""
        return self.places.nbytes + self.texels.nbytes


class LinkedBake(Baked, Protocol):
    """What live scattering reads of storage's BakedTransfer."""

    positions: Single
    links: SubsurfaceLinks | None


class LiveScattering:
    """The passes for one bake with links."""

    def __init__(self, baked: LinkedBake) -> None:
        links = baked.links
        self.links, self._points = links, len(baked.positions)
        self.receiver = links.places[:, 0].astype(np.int64)
        self.used = np.flatnonzero(self.receiver >= 0)
        mine = self.receiver[self.used]
        areas = np.zeros(self._points)
        areas[mine] = links.places[self.used, 3]
        self.pyramid = SurfacePyramid.of_places(self.receiver, baked.positions, baked.normals, areas, links.levels)
        self._unpacked = unpacked_links(links.texels)
        self.row = 1 if baked.functions else 0
        self.factor = np.zeros((self._points, 3), np.float32)  # on what was scattered, per receiver
        self.factor[mine] = links.places[self.used, 1, None]
        if self.row:
            self.factor /= np.float32(CONSTANT)
        else:  # the diffuse row is drawn times the albedo, which is in the medium already
            albedo = np.asarray(baked.albedo, np.float32)
            self.factor *= np.where(albedo > DARKEST, 1.0 / np.maximum(albedo, DARKEST), 0.0)
        self.through = np.zeros(self._points, np.float32)
        self.through[mine] = links.places[self.used, 2]

    def scattered(self, light: Single) -> Single:
        """Passes one and two: radiance (p, 3) that leaves each receiver for E / pi (p, 3) that enters; 0 where a
        receiver is not translucent."""
        means = self.pyramid.means(light)
        moments, links = self.pyramid.moments(means), self._unpacked
        result = np.zeros((self._points, 3), np.float32)
        for start in range(0, len(self.used), BLOCK):
            part = slice(start, start + BLOCK)
            some = type(links)(links.node[part], links.factor[part], links.shift[part], links.bounded)
            result[self.receiver[self.used[part]]] = some.gathered(means, moments)
        return result

    def added(self, direct: Single, bounced: Single | None) -> Single:
        """Pass three: what is to be added to the exit radiance, (p, rows, 3), for the direct light of lamps (p, rows,
        3), with their bounced light (p, 3), which is in the diffuse row already, or None."""
        light = direct[:, 0] if bounced is None else direct[:, 0] + bounced
        result = direct.copy()
        result[:, 0] -= self.through[:, None] * light
        result[:, self.row] += self.factor * self.scattered(light)
        return result


def bounced_light(baked: Baked, light: Single | None) -> Single | None:
    """E / pi (p, 3) that lamps send by way of the scene. light: (zones, cloud columns, 3) weights; None for none."""
    if light is None or not light.any():
        return None
    distant = baked.lighting_basis.distant
    rows = np.ascontiguousarray(baked.bases[:, :, :1, distant:])
    constants = cluster_constants(rows, light, baked.cluster_zone)
    return exit_radiance(baked.cluster, baked.weights, constants)[:, 0]
