# SPDX-License-Identifier: GPL-3.0-or-later
"""What the preview shows in place of light, and what is marked in the scene: clusters, errors, vectors, lights of a
cloud, patches of surfaces that lamps shine on.

Everything is made once for what is shown and then only handed out: it is asked for on every redraw.
"""

from __future__ import annotations

import math
import operator
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ..gpu_shaders.overlay import NOTHING, Legend, Marks, Overlay
from ..gpu_shaders.render_data import FalseColours, heat_colours, used_vectors
from ..prt_addon.lighting.light_cloud import LightCloud
from ..prt_addon.lighting.lit_surfaces import LitSurfaces, LocalBasis
from ..prt_addon.storage.container import BakedTransfer
from .scene_lamps import cloud_key

RELIT, CLUSTERS, ERROR, VECTORS = "relit", "clusters", "error", "vectors"
HUES = 12  # tones that neighbours choose from
UNKNOWN = (0.3, 0.3, 0.3)  # scene-linear, where there is nothing to show: no heat, and not the background
# Of the receivers, how many may be beyond the legend's end: a few bad ones must not make all others dark.
BEYOND = 0.002
LEGEND_STEPS = 64
LEAST, MOST = 0.15, 0.8  # of the heat that vectors are shown in
DENSE, MERGED, BOX = (0.75, 0.75, 0.75, 0.6), 7.0, (0.9, 0.9, 0.9, 0.6)
PATCH_ALPHA = 0.8

Shown = Mapping[str, BakedTransfer]  # by object; another bake is another BakedTransfer


@dataclass
class Display:
    """What was made for one scene, and for what."""

    mode: str = RELIT
    made_of: tuple[BakedTransfer, ...] = ()
    colours: dict[str, FalseColours] = field(default_factory=dict)
    legend: Legend | None = None
    marked: tuple[BakedTransfer, ...] = ()
    overlays: dict[str, tuple[Overlay, ...]] = field(default_factory=dict)  # by the first object of each cloud

    def colours_of(self, mode: str, shown: Shown) -> dict[str, FalseColours]:
        """False colours by object; none where light is shown."""
        if mode != self.mode or not _same(self.made_of, shown):
            self.mode, self.made_of = mode, tuple(shown.values())
            self.colours, self.legend = MAKERS[mode](shown) if mode in MAKERS and shown else ({}, None)
        return self.colours

    def marks(self, shown: Shown, moves: Mapping[str, NDArray[np.float64] | None], show_cloud: bool) -> Marks:
        """The legend, and the lights or patches of each cloud once, moved as the first object of it is."""
        if not show_cloud:
            self.marked, self.overlays = (), {}
        elif not _same(self.marked, shown):
            self.marked, first = tuple(shown.values()), {}
            for name, baked in shown.items():
                if baked.cloud is not None:
                    first.setdefault(cloud_key(baked), name)
            self.overlays = {name: cloud_overlays(shown[name].cloud) for name in first.values()}
        if not self.overlays and self.legend is None:
            return NOTHING
        placed = [(overlay, np.eye(4) if moves.get(name) is None else moves[name])
                  for name, overlays in self.overlays.items() for overlay in overlays]
        return Marks(tuple(placed), self.legend)


def _same(bakes: tuple[BakedTransfer, ...], shown: Shown) -> bool:
    """Whether these are the very bakes that are shown, in order."""
    return len(bakes) == len(shown) and all(map(operator.is_, bakes, shown.values()))


def _clusters(bakes: Mapping[str, BakedTransfer]) -> tuple[dict[str, FalseColours], Legend]:
    colours = {}
    for name, baked in bakes.items():
        pairs = [baked.cluster[baked.triangles[:, sides]] for sides in ((0, 1), (1, 2), (2, 0))]
        palette = distinct_colours(np.concatenate(pairs), baked.bases.shape[0])
        colours[name] = FalseColours(to_linear(palette)[baked.cluster])
    count = sum(baked.bases.shape[0] for baked in bakes.values())
    return colours, Legend(f"{count:,} cluster{'' if count == 1 else 's'}, a colour each")


def _errors(bakes: Mapping[str, BakedTransfer]) -> tuple[dict[str, FalseColours], Legend]:
    known = {name: baked.error for name, baked in bakes.items() if baked.error is not None}
    if not known:
        return {name: _unknown(baked) for name, baked in bakes.items()}, Legend("No errors stored: bake again")
    end = nice_end(float(np.quantile(np.concatenate(list(known.values())), 1.0 - BEYOND)))
    colours = {name: FalseColours(heat_colours(known[name] / end)) if name in known else _unknown(baked)
               for name, baked in bakes.items()}
    labels = tuple(f"{100.0 * end * share:.3g} %" for share in (0.0, 0.5, 1.0))
    return colours, Legend("Error of each receiver", _bar(), labels)


def _vectors(bakes: Mapping[str, BakedTransfer]) -> tuple[dict[str, FalseColours], Legend]:
    counts = {name: used_vectors(baked.bases) for name, baked in bakes.items()}
    most = max(1, max(int(count.max(initial=0)) for count in counts.values()))
    # Many clusters have them all: neither white nor black, which would hide their shape.
    colours = {name: FalseColours(heat_colours(LEAST + (MOST - LEAST) * counts[name][baked.cluster] / most))
               for name, baked in bakes.items()}
    return colours, Legend("Vectors of each cluster", _bar(LEAST, MOST), ("0", str(most)))


MAKERS = {CLUSTERS: _clusters, ERROR: _errors, VECTORS: _vectors}


def _unknown(baked: BakedTransfer) -> FalseColours:
    return FalseColours(np.tile(np.array(UNKNOWN, np.float32), (len(baked.cluster), 1)))


def _bar(low: float = 0.0, high: float = 1.0) -> tuple[tuple[float, float, float], ...]:
    """The colours of heat from low to high as the display shows them."""
    return tuple(map(tuple, to_display(heat_colours(np.linspace(low, high, LEGEND_STEPS))).tolist()))


def nice_end(value: float) -> float:
    """The least of 1, 2, 5, 10, ... times a power of ten that is not below a value; 1e-6 at least."""
    value = max(value, 1e-6)
    power = 10.0 ** math.floor(math.log10(value))
    return next(step * power for step in (1.0, 2.0, 5.0, 10.0, 20.0) if step * power >= value * (1.0 - 1e-9))


def distinct_colours(neighbours: NDArray[np.integer], count: int) -> NDArray[np.float32]:
    """(count, 3) display colours, the same for the same input, all different. neighbours: (n, 2) pairs of numbers that
    are to be told apart: they get different tones as long as there are enough."""
    pairs = np.unique(np.sort(np.asarray(neighbours, np.int64), axis=1), axis=0)
    pairs = pairs[pairs[:, 0] != pairs[:, 1]]
    both = np.concatenate([pairs, pairs[:, ::-1]])
    both = both[np.argsort(both[:, 0], kind="stable")]
    starts = np.searchsorted(both[:, 0], np.arange(count + 1))
    tone = np.full(count, -1)
    for number in range(count):  # clusters, not points
        around = tone[both[starts[number]:starts[number + 1], 1]]
        preferred = (5 * number) % HUES  # far from that of the last one
        used = np.bincount(around[around >= 0], minlength=HUES)
        tone[number] = min(range(HUES), key=lambda hue: (used[hue], (hue - preferred) % HUES))
    # Members of a tone differ in lightness and saturation, by steps that never repeat.
    order = np.arange(count) * 0.6180339887 % 1.0
    hue = tone / HUES + 0.03 * (order - 0.5)
    value, saturation = 0.95 - 0.4 * order, 0.55 + 0.4 * (np.arange(count) * 0.7548776662 % 1.0)
    turns = (hue[:, None] * 6.0 + np.array([0.0, 4.0, 2.0])) % 6.0
    pure = np.clip(np.abs(turns - 3.0) - 1.0, 0.0, 1.0)
    return (value[:, None] * (1.0 - saturation[:, None] * (1.0 - pure))).astype(np.float32)


def to_linear(display: NDArray[np.floating]) -> NDArray[np.float32]:
    """Display (sRGB) colours as scene-linear ones."""
    return np.where(display <= 0.04045, display / 12.92, ((display + 0.055) / 1.055) ** 2.4).astype(np.float32)


def to_display(linear: NDArray[np.floating]) -> NDArray[np.float32]:
    """Scene-linear colours in 0..1 as display (sRGB) ones."""
    return np.where(linear <= 0.0031308, linear * 12.92, 1.055 * np.maximum(linear, 0.0) ** (1.0 / 2.4) - 0.055,
                    ).astype(np.float32)


def cloud_overlays(cloud: LocalBasis) -> tuple[Overlay, ...]:
    """Marks of the lights of a cloud, or of the patches of surfaces that lamps shine on."""
    return _patches(cloud) if isinstance(cloud, LitSurfaces) else _lights(cloud)


def _lights(cloud: LightCloud) -> tuple[Overlay, ...]:
    """The box around all lights, the lights before merging in grey, and each zone's in a colour of its own."""
    zone = np.repeat(np.arange(cloud.zones), np.diff(cloud.zone_starts))
    chain = np.stack([np.arange(cloud.zones - 1), np.arange(1, cloud.zones)], axis=1)  # zones in number are near
    colours = _opaque(distinct_colours(chain, cloud.zones)[zone])
    marks = [Overlay("POINTS", cloud.positions.astype(np.float32), colours, MERGED, in_front=True)]
    if len(cloud.dense):
        low = cloud.dense.min(axis=0) - 0.5 * cloud.spacing
        high = cloud.dense.max(axis=0) + 0.5 * cloud.spacing
        corners = np.array([[(low, high)[k >> axis & 1][axis] for axis in range(3)] for k in range(8)], np.float32)
        edges = [(k, k | 1 << axis) for k in range(8) for axis in range(3) if not k >> axis & 1]
        marks = [Overlay("LINES", corners[np.ravel(edges)], np.tile(np.float32(BOX), (24, 1))),
                 Overlay("POINTS", cloud.dense.astype(np.float32), np.tile(np.float32(DENSE), (len(cloud.dense), 1)),
                         4.0, in_front=True), *marks]
    return tuple(marks)


def _patches(lit: LitSurfaces) -> tuple[Overlay, ...]:
    """Every corner's third of every triangle, in the colour of its patch."""
    pairs = np.concatenate([lit.patch[:, sides] for sides in ((0, 1), (1, 2), (2, 0))])
    palette = distinct_colours(pairs[(pairs >= 0).all(axis=1)], lit.axes.shape[1])
    corner = lit.corners
    middle, ahead = corner.mean(axis=1, keepdims=True), 0.5 * (corner + np.roll(corner, -1, axis=1))
    behind = np.roll(ahead, 1, axis=1)
    middle = np.broadcast_to(middle, corner.shape)
    parts = np.stack([corner, ahead, middle, corner, middle, behind], axis=2)[lit.patch >= 0]
    colours = _opaque(palette[lit.patch[lit.patch >= 0]], PATCH_ALPHA)
    return (Overlay("TRIS", parts.reshape(-1, 3), np.repeat(colours, 6, axis=0)),)


def _opaque(colours: NDArray[np.float32], alpha: float = 1.0) -> NDArray[np.float32]:
    return np.concatenate([colours, np.full((len(colours), 1), alpha, np.float32)], axis=1)
