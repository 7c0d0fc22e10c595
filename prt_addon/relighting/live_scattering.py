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

import time
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from ..linear_algebra import sparse_multiply
from ..transport.subsurface_links import Links
from ..transport.surface_pyramid import SurfacePyramid
from .exit_radiance import Baked, cluster_constants, exit_radiance
from .subsurface_texels import unpacked_links

Single = NDArray[np.float32]
# The constant function y_0, through which subsurface light leaves (Sloan 2003, section 3).
CONSTANT = 0.5 / np.sqrt(np.pi)
# Albedo below which a surface without view-dependent rows can't show what went through it.
DARKEST = 1e-3


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
        self._matrices: list[csr_array] = []
        # How long a change of light takes here and, once that was measured, on the graphics card (inf: it can't).
        self.seconds, self.card_seconds = np.inf, None
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
        self._prepare()
        values = np.concatenate([means[:, None], self.pyramid.moments(means)], axis=1).reshape(-1, 3)
        result = np.zeros((self._points, 3), np.float32)
        for channel, matrix in enumerate(self._matrices):
            light = np.ascontiguousarray(values[:, channel, None])
            result[self.receiver[self.used], channel] = sparse_multiply(matrix, light)[:, 0]
        return result

    def added(self, direct: Single, bounced: Single | None) -> Single:
        """Pass three: what is to be added to the exit radiance, (p, rows, 3), for the direct light of lamps (p, rows,
        3), with their bounced light (p, 3), which is in the diffuse row already, or None."""
        self._prepare()
        started = time.perf_counter()
        light = direct[:, 0] if bounced is None else direct[:, 0] + bounced
        result = direct.copy()
        result[:, 0] -= self.through[:, None] * light
        result[:, self.row] += self.factor * self.scattered(light)
        self.seconds = min(self.seconds, time.perf_counter() - started)
        return result

    def _prepare(self) -> None:
        """The matrices, which nothing needs where a graphics card gathers from the first."""
        if not self._matrices:
            self._matrices = _matrices(unpacked_links(self.links.texels), len(self.pyramid.area))

    @property
    def prefers_card(self) -> bool:
        """Whether the graphics card was measured to be faster."""
        return self.card_seconds is not None and self.card_seconds < self.seconds


def _matrices(links: Links, nodes: int) -> list[csr_array]:
    """Per channel the links (r, K) as a matrix (r, 4 nodes): four numbers of each node, its mean and its moments."""
    weights = np.concatenate([np.ones((*links.node.shape, 1), np.float32), links.shift], axis=2)
    column = 4 * links.node[..., None] + np.arange(4, dtype=np.int32)
    kept = (weights != 0.0) & links.factor.any(axis=2)[..., None]
    starts = np.concatenate([[0], np.cumsum(kept.sum(axis=(1, 2)))]).astype(np.int32)
    indices = column[kept]
    return [csr_array(((links.factor[..., channel, None] * weights)[kept], indices, starts),
                      shape=(len(links.node), 4 * nodes)) for channel in range(3)]


def bounced_light(baked: Baked, light: Single | None) -> Single | None:
    """E / pi (p, 3) that lamps send by way of the scene. light: (zones, cloud columns, 3) weights; None for none."""
    if light is None or not light.any():
        return None
    distant = baked.lighting_basis.distant
    rows = np.ascontiguousarray(baked.bases[:, :, :1, distant:])
    constants = cluster_constants(rows, light, baked.cluster_zone)
    return exit_radiance(baked.cluster, baked.weights, constants)[:, 0]
