# SPDX-License-Identifier: GPL-3.0-or-later
"""How far the two sides of a line where charts meet differ: what is seen as a seam."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .texel_surface import TexelSurface

ALONG = (0.1, 0.3, 0.5, 0.7, 0.9)  # places on an edge


@dataclass(frozen=True)
class Seams:
    """places: compared; largest, rms: differences over them, relative to the signal's RMS on the surface."""

    places: int
    largest: float
    rms: float


def chart_edges(surface: TexelSurface) -> NDArray[np.int64]:
    """(e, 4) of edges where two triangles of different charts meet by position: triangle and its edge (corner k to
    k + 1) on one side, and on the other, where it runs the other way."""
    triangles = len(surface.triangles)
    _, place = np.unique(surface.points, axis=0, return_inverse=True)
    welded = place.ravel()[surface.triangles].astype(np.int64)
    start, end = welded.ravel(), np.roll(welded, -1, axis=1).ravel()
    count = int(welded.max()) + 1
    forward, backward = start * count + end, end * count + start
    order = np.argsort(forward, kind="stable")
    found = np.minimum(np.searchsorted(forward[order], backward), 3 * triangles - 1)
    twin = order[found]
    met = np.flatnonzero((forward[twin] == backward) & (np.arange(3 * triangles) < twin))
    corners = surface.places.astype(np.float64).reshape(-1, 2)
    following = np.roll(surface.places.astype(np.float64), -1, axis=1).reshape(-1, 2)
    other = twin[met]
    # One chart goes on across an edge whose places in the atlas agree.
    same = np.abs(corners[met] - following[other]).max(axis=1) + np.abs(following[met] - corners[other]).max(axis=1)
    apart = same > 1e-3
    met, other = met[apart], other[apart]
    return np.stack([met // 3, met % 3, other // 3, other % 3], axis=1)


def across_seams(surface: TexelSurface, values: NDArray[np.floating]) -> Seams:
    """Differences of values (n, k) of the texels, filtered bilinearly from either side of all edges between charts."""
    edges = chart_edges(surface)
    scale = float(np.sqrt(np.mean(np.square(values, dtype=np.float64)))) or 1.0
    if not len(edges):
        return Seams(0, 0.0, 0.0)
    found = []
    for along in ALONG:
        first = surface.layout.sample(values, edges[:, 0], *_weights(edges[:, 1], along))
        found.append(first - surface.layout.sample(values, edges[:, 2], *_weights(edges[:, 3], 1.0 - along)))
    gaps = np.concatenate(found)
    return Seams(len(gaps), float(np.abs(gaps).max()) / scale, float(np.sqrt(np.mean(gaps ** 2))) / scale)


def _weights(edge: NDArray[np.integer], share: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Weights of corners 1 and 2 at a share of the way along edges (corner k to k + 1)."""
    weights = np.zeros((len(edge), 3))
    rows = np.arange(len(edge))
    weights[rows, edge], weights[rows, (edge + 1) % 3] = 1.0 - share, share
    return weights[:, 1], weights[:, 2]
