# SPDX-License-Identifier: GPL-3.0-or-later
"""An atlas: a surface cut into charts, laid into one picture, and what lies at each of the picture's texels.

API (all arrays whole, no Blender):

    atlas = make_atlas(name, points, normals, triangles, texel=0.05)       # or side=256; tangents=, gutter=, align=
    atlas.width, atlas.height                                              # of the picture, in texels
    atlas.places                     # (t, 3, 2) of each triangle's corners in the picture, in texels
    atlas.texels.positions / normals / tangents / areas / triangle / barycentric / chart / column / row   # (n, ...)
    atlas.picture(values)            # (n, k) -> (height, width, k), 0 where there is no texel;  atlas.mask() its mask
    atlas.dilated(picture, mask, rings)                                    # filled beyond charts' rims
    atlas.sample(values, triangle, u, v)                                   # bilinear, as a GPU filters the picture
    atlas.cells                      # (c, 4) texels around each square between texels: lower left, right, upper l., r.

Place (column, row) is the *centre* of that texel, row 0 the lowest; a GPU's coordinate is (place + 0.5) / size.

Filtering is complete: every square between four texel centres that a triangle touches has all its four texels, so a
bilinear sample anywhere on the surface reads only texels of its own chart. Where a centre lies beyond its chart, its
texel stands for the nearest place on the chart. Each chart is stretched (by less than a texel) so that its box ends on
texel centres: a rectangle's rim then lies on texels, and two walls meet without a seam.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..errors import BadScene
from .atlas_cells import AtlasCells
from .charts import Charts, Double, extents, face_normals, parted
from .tangents import quiet_pole, smooth_tangents, tangent_frame
from .unwrapping import SECONDS, make_charts

MOST_TEXELS = 4_000_000
LARGEST_SIDE = 16384  # of a GPU's picture
AT_ONCE = 2 ** 20  # pairs of triangles and squares that are looked at in one go
TOUCH = 1e-7  # texels by which a triangle must reach into a square to touch it
TRIED = (0.37, 0.61)  # where in a square it is tried whether several triangles lie over each other
STEPS = 40  # of the search for the finest texels that fit


@dataclass(frozen=True)
class Texels:
    """n texels. positions: (n, 3) float64 on the surface; normals: (n, 3) float64 unit shading normals; tangents:
    (n, 3) float64, unit, orthogonal to them; faces: (n, 3) float64 unit normals of their triangles; areas: (n,)
    float64 square metres that each stands for (their sum is the surface's); triangle: (n,) int64; barycentric: (n, 3)
    float64 of that triangle's corners; chart: (n,) int64; column, row: (n,) int64; outside: (n,) float64, how many
    texels their centre lies beyond the chart."""

    positions: Double
    normals: Double
    tangents: Double
    faces: Double
    areas: Double
    triangle: NDArray[np.int64]
    barycentric: Double
    chart: NDArray[np.int64]
    column: NDArray[np.int64]
    row: NDArray[np.int64]
    outside: Double

    def __len__(self) -> int:
        return len(self.triangle)


@dataclass(frozen=True)
class Atlas(AtlasCells):
    """chart: (t,) int64, -1 for triangles without area; height: in texels; texel: metres; method: of the charts."""

    height: int
    texel: float
    texels: Texels
    chart: NDArray[np.int64]
    method: str

    @property
    def charts(self) -> int:
        """How many charts there are."""
        return int(self.chart.max(initial=-1)) + 1

    @property
    def fill(self) -> float:
        """The part of the picture that texels fill."""
        return len(self.texels) / (self.width * self.height)

    def mask(self) -> NDArray[np.bool_]:
        """(height, width) where the picture has texels."""
        result = np.zeros((self.height, self.width), bool)
        result[self.texels.row, self.texels.column] = True
        return result

    def picture(self, values: NDArray) -> NDArray:
        """Values (n, ...) of the texels as (height, width, ...), zero elsewhere; row 0 is the lowest."""
        result = np.zeros((self.height, self.width, *values.shape[1:]), values.dtype)
        result[self.texels.row, self.texels.column] = values
        return result

    @staticmethod
    def dilated(picture: NDArray[np.floating], mask: NDArray[np.bool_], rings: int) -> NDArray[np.floating]:
        """A picture (h, w, k) whose texels outside the mask (h, w), up to `rings` beyond it, are the mean of their
        neighbours: for pictures that others filter with mip maps."""
        picture, mask = picture.copy(), mask.copy()
        for _ in range(rings):
            total, count = np.zeros(picture.shape, np.float64), np.zeros(mask.shape)
            for rows, columns in ((r, c) for r in (-1, 0, 1) for c in (-1, 0, 1) if r or c):
                inner = (slice(max(rows, 0), mask.shape[0] + min(rows, 0)),
                         slice(max(columns, 0), mask.shape[1] + min(columns, 0)))
                outer = (slice(max(-rows, 0), mask.shape[0] + min(-rows, 0)),
                         slice(max(-columns, 0), mask.shape[1] + min(-columns, 0)))
                total[inner] += picture[outer] * mask[outer][..., None]
                count[inner] += mask[outer]
            new = ~mask & (count > 0)
            picture[new] = total[new] / count[new][:, None]
            mask |= new
        return picture


def make_atlas(name: str, points: Double, normals: Double, triangles: NDArray[np.integer], *,
               texel: float = 0.0, side: int = 0, tangents: Double | None = None, method: str = "projection",
               seconds: float = SECONDS, gutter: int = 2, align: int = 1) -> Atlas:
    """The atlas of an object's points (p, 3), their unit normals (p, 3) and triangles (t, 3).

    texel: metres between texels; side: the atlas's longest side in texels instead (the finest that fit), or both:
    texels are coarser than `texel` where they would not fit. tangents: (p, 3) unit, for texels' own; None makes smooth
    ones. method, seconds: see `make_charts`. gutter: empty texels between charts; align: charts start at multiples of
    it, and their squares end there (2^levels keeps charts apart in mip maps). Raises BadScene, naming the object, where
    no triangle has an area or there are too many texels; PRTError where it does not unwrap.
    """
    if not (texel > 0.0 or side > 0):
        raise ValueError("a texel size or a side is needed")
    charts = make_charts(name, points, triangles, method, seconds)
    if not charts.count:
        raise BadScene(name, "no face has an area to lay texels on", "Give its faces an area, or bake at its vertices")
    asked = texel
    for _ in range(2):
        texel = _texel_size(name, charts, asked, side, gutter, align)
        places, width, height = _packed(charts, texel, gutter, align)
        owner, key = _touched(places, charts.chart, width)
        if not (over := overlapping(places, charts.chart, owner, key, width)).any():
            break
        charts = parted(charts, over)
    cell_key, cell_of = np.unique(key, return_inverse=True)
    fallback = np.full(len(triangles), -1, np.int64)
    fallback[owner[::-1]] = cell_of.ravel()[::-1]
    corner_key = cell_key[:, None] + np.array([0, 1, width, width + 1])
    texel_key, cells = np.unique(corner_key, return_inverse=True)
    if len(texel_key) > MOST_TEXELS:
        raise BadScene(name, f"it needs {len(texel_key):,} texels, more than {MOST_TEXELS:,}",
                       "Choose larger texels, or bake it at its vertices")
    cells = cells.reshape(-1, 4)
    nearest = _nearest(places, owner, cells[cell_of.ravel()], texel_key, width)
    made = _texels(points, normals, tangents, triangles, charts, nearest, texel_key, width)
    made = _with_areas(made, cells, points, triangles, charts)
    return Atlas(width, places, cells, cell_key, fallback, height, texel, made, charts.chart, charts.method)


def overlapping(places: Double, chart: NDArray[np.int64], owner: NDArray[np.int64], key: NDArray[np.int64],
                width: int) -> NDArray[np.bool_]:
    """(charts,) whether a chart lies over itself, as a spiral ramp seen from above does.

    owner, key: triangles and the squares that they touch. Of a place in each square only one triangle may lie below.
    """
    at = np.stack([key % width, key // width], axis=1) + TRIED
    corners = places[owner]
    edge = np.roll(corners, -1, axis=1) - corners
    away = at[:, None] - corners
    height = edge[..., 0] * away[..., 1] - edge[..., 1] * away[..., 0]
    deep = TOUCH * 100.0 * np.sqrt(np.sum(edge ** 2, axis=2))
    inside = np.flatnonzero((height > deep).all(axis=1) | (height < -deep).all(axis=1))
    _, place, covered = np.unique(key[inside], return_inverse=True, return_counts=True)
    result = np.zeros(int(chart.max(initial=-1)) + 1, bool)
    result[chart[owner[inside[covered[place.ravel()] > 1]]]] = True
    return result


def _texel_size(name: str, charts: Charts, texel: float, side: int, gutter: int, align: int) -> float:
    """Metres between texels: as asked for, or coarser so that the atlas fits a side."""
    low, high = extents(charts.flat, charts.chart)
    size = high - low
    if texel > 0.0 and not side:
        side = LARGEST_SIDE
        if float(np.prod(size / texel, axis=1).sum()) > 4.0 * MOST_TEXELS:
            raise BadScene(name, f"texels of {texel:.3g} m are more than {MOST_TEXELS:,} on it",
                           "Choose larger texels, or bake it at its vertices")
    finest = max(texel, float(size.max()) / max(side - 1, 1), np.finfo(np.float64).tiny)
    if max(_layout(size, finest, gutter, align)[1:]) <= side:
        return finest
    coarse = max(float(size.max()), finest)
    while max(_layout(size, coarse, gutter, align)[1:]) > side:
        if coarse > 4.0 * float(size.max()):
            raise BadScene(name, f"its {len(size):,} charts do not fit an atlas of {side} x {side} texels",
                           "Choose a larger atlas, or bake it at its vertices")
        coarse *= 2.0
    for _ in range(STEPS):
        middle = np.sqrt(finest * coarse)
        if max(_layout(size, middle, gutter, align)[1:]) <= side:
            coarse = middle
        else:
            finest = middle
    return coarse


def _steps(size: Double, texel: float) -> NDArray[np.int64]:
    """How many texels' widths (charts, 2) each chart's box is stretched to: whole ones, at least one."""
    return np.maximum(np.ceil(size / texel - 1e-3), 1.0).astype(np.int64)


def _layout(size: Double, texel: float, gutter: int, align: int) -> tuple[NDArray[np.int64], int, int]:
    """Lower left texels (charts, 2), width and height: charts on shelves, the highest first."""
    box = _steps(size, texel) + 1
    spaced = -(-(box + gutter) // align) * align
    order = np.lexsort((np.arange(len(box)), -spaced[:, 0], -spaced[:, 1]))
    wide, high = spaced[order].T
    longest = int(max(wide.max(), np.ceil(np.sqrt(1.05 * float(np.sum(wide * high))))))
    ends = np.cumsum(wide)
    origin = np.zeros((len(box), 2), np.int64)
    start, base, used = 0, 0, 0
    while start < len(order):  # one turn for each shelf
        before = ends[start] - wide[start]
        stop = max(start + 1, int(np.searchsorted(ends, before + longest, side="right")))
        shelf = order[start:stop]
        origin[shelf, 0] = ends[start:stop] - wide[start:stop] - before
        origin[shelf, 1] = base
        used = max(used, int(ends[stop - 1] - before))
        base += int(high[start])
        start = stop
    if align == 1:  # nothing lies behind the last gutter
        used, base = int((origin + box)[:, 0].max()), int((origin + box)[:, 1].max())
    return origin, used, base


def _packed(charts: Charts, texel: float, gutter: int, align: int) -> tuple[Double, int, int]:
    """Places (t, 3, 2) of corners in the atlas, its width and height."""
    low, high = extents(charts.flat, charts.chart)
    size = np.maximum(high - low, np.finfo(np.float64).tiny)
    origin, width, height = _layout(high - low, texel, gutter, align)
    steps = _steps(high - low, texel)
    of = np.maximum(charts.chart, 0)
    inside = np.clip((charts.flat - low[of][:, None]) / size[of][:, None], 0.0, 1.0)
    return origin[of][:, None] + inside * steps[of][:, None], width, height


def _touched(places: Double, chart: NDArray[np.int64], width: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Pairs of a triangle (n,) and the key (n,) of a square between texels that it reaches into."""
    low = np.floor(places.min(axis=1) + TOUCH).astype(np.int64)
    high = np.maximum(np.ceil(places.max(axis=1) - TOUCH).astype(np.int64), low + 1)
    span = high - low
    count = np.where(chart >= 0, span[:, 0] * span[:, 1], 0)
    total = np.cumsum(count)
    owners, keys = [], []
    start = 0
    while start < len(count):  # blocks of triangles, so that memory stays bounded
        stop = max(start + 1, int(np.searchsorted(total, (total[start - 1] if start else 0) + AT_ONCE, side="right")))
        owner = np.repeat(np.arange(start, stop), count[start:stop])
        number = np.arange(len(owner)) - np.repeat(np.cumsum(count[start:stop]) - count[start:stop], count[start:stop])
        column = low[owner, 0] + number % span[owner, 0]
        row = low[owner, 1] + number // span[owner, 0]
        kept = _reaches_into(places[owner], np.stack([column, row], axis=1) + 0.5)
        owners.append(owner[kept])
        keys.append(row[kept] * width + column[kept])
        start = stop
    return np.concatenate(owners), np.concatenate(keys)


def _reaches_into(corners: Double, middle: Double) -> NDArray[np.bool_]:
    """Whether triangles (n, 3, 2), whose boxes overlap them, reach into unit squares about their middles (n, 2): no
    edge has the whole square on its outer side."""
    edge = np.roll(corners, -1, axis=1) - corners
    normal = np.stack([-edge[..., 1], edge[..., 0]], axis=2)  # inwards, of triangles wound to the left
    length = np.maximum(np.sqrt(np.sum(normal ** 2, axis=2)), np.finfo(np.float64).tiny)
    wound = np.sign(edge[:, 0, 0] * edge[:, 1, 1] - edge[:, 0, 1] * edge[:, 1, 0])
    height = np.sum((middle[:, None] - corners) * normal, axis=2) * np.where(wound == 0.0, 1.0, wound)[:, None]
    reach = height + 0.5 * np.abs(normal).sum(axis=2)
    return (reach > TOUCH * length).all(axis=1) | (wound == 0.0)


@dataclass(frozen=True)
class _Nearest:
    """For each texel the triangle of its chart that is nearest to its centre, the place on it, and how far it is."""

    triangle: NDArray[np.int64]
    barycentric: Double
    distance: Double


def _nearest(places: Double, owner: NDArray[np.int64], corner_texels: NDArray[np.int64], texel_key: NDArray[np.int64],
             width: int) -> _Nearest:
    """owner (n,), corner_texels (n, 4): triangles and the texels around the squares that they touch."""
    # A texel's own triangles come four times; each pair is looked at once.
    pair = np.sort(np.repeat(owner, 4) * len(texel_key) + corner_texels.ravel())
    pair = pair[np.concatenate([[True], pair[1:] != pair[:-1]])]
    triangle, texel = pair // len(texel_key), pair % len(texel_key)
    best = np.full(len(texel_key), np.inf)
    result = _Nearest(np.zeros(len(texel_key), np.int64), np.zeros((len(texel_key), 3)), best)
    for start in range(0, len(pair), AT_ONCE):
        tri, tex = triangle[start:start + AT_ONCE], texel[start:start + AT_ONCE]
        centre = np.stack([texel_key[tex] % width, texel_key[tex] // width], axis=1).astype(np.float64)
        barycentric, distance = nearest_in_triangles(centre, places[tri])
        order = np.lexsort((tri, distance, tex))
        first = order[np.concatenate([[True], tex[order[1:]] != tex[order[:-1]]])]
        better = first[distance[first] < best[tex[first]]]
        result.triangle[tex[better]], result.barycentric[tex[better]] = tri[better], barycentric[better]
        best[tex[better]] = distance[better]
    return result


def nearest_in_triangles(at: Double, corners: Double) -> tuple[Double, Double]:
    """Barycentric weights (n, 3) of the points of flat triangles (n, 3, 2) nearest to places (n, 2), and how far they
    are; 0 inside."""
    edge = np.roll(corners, -1, axis=1) - corners
    double = edge[:, 0, 0] * edge[:, 1, 1] - edge[:, 0, 1] * edge[:, 1, 0]
    away = at[:, None] - corners
    cross = edge[..., 0] * away[..., 1] - edge[..., 1] * away[..., 0]  # of edge k, opposite to corner k + 2
    usable = np.abs(double) > 1e-12
    inner = cross[:, [1, 2, 0]] / np.where(usable, double, 1.0)[:, None]
    inside = usable & (inner >= -1e-9).all(axis=1)
    along = np.clip(np.sum(away * edge, axis=2) / np.maximum(np.sum(edge ** 2, axis=2), 1e-30), 0.0, 1.0)
    gap = np.sqrt(np.sum((away - along[..., None] * edge) ** 2, axis=2))
    side = gap.argmin(axis=1)
    rows = np.arange(len(at))
    rim = np.zeros((len(at), 3))
    rim[rows, side] = 1.0 - along[rows, side]
    rim[rows, (side + 1) % 3] = along[rows, side]
    barycentric = np.where(inside[:, None], np.maximum(inner, 0.0), rim)
    return barycentric / barycentric.sum(axis=1, keepdims=True), np.where(inside, 0.0, gap[rows, side])


def _texels(points: Double, normals: Double, tangents: Double | None, triangles: NDArray[np.integer], charts: Charts,
            nearest: _Nearest, texel_key: NDArray[np.int64], width: int) -> Texels:
    """What lies at the texels; areas come later."""
    corner, weights = triangles[nearest.triangle], nearest.barycentric[:, :, None]
    faces, _ = face_normals(points, triangles)
    face = faces[nearest.triangle]
    normal = np.sum(weights * normals[corner], axis=1)
    length = np.sqrt(np.sum(normal ** 2, axis=1, keepdims=True))
    normal = np.where(length > 1e-6, normal / np.maximum(length, 1e-6), face)
    tangent = (smooth_tangents(normal, quiet_pole(normal)) if tangents is None else
               tangent_frame(np.sum(weights * tangents[corner], axis=1), normal, quiet_pole(normal)))
    return Texels(np.sum(weights * points[corner], axis=1), normal, tangent, face, np.zeros(len(normal)),
                  nearest.triangle, nearest.barycentric, charts.chart[nearest.triangle], texel_key % width,
                  texel_key // width, nearest.distance)


def _with_areas(texels: Texels, cells: NDArray[np.int64], points: Double, triangles: NDArray[np.integer],
                charts: Charts) -> Texels:
    """Areas: a quarter of each cell around a texel, as it lies in space, scaled to the chart's own area."""
    a, b, c, d = (texels.positions[cells[:, k]] for k in range(4))
    halves = [np.sqrt(np.sum(np.cross(p - a, q - a) ** 2, axis=1)) for p, q in ((b, d), (d, c))]
    own = np.bincount(cells.ravel(), np.repeat(0.125 * (halves[0] + halves[1]), 4), len(texels))
    own = np.maximum(own, 1e-6 * float(own.max(initial=0.0)) + np.finfo(np.float64).tiny)
    inside = charts.chart >= 0
    surface = np.bincount(charts.chart[inside], face_normals(points, triangles)[1][inside], charts.count)
    laid = np.bincount(texels.chart, own, charts.count)
    areas = own * (surface / np.maximum(laid, np.finfo(np.float64).tiny))[texels.chart]
    return Texels(texels.positions, texels.normals, texels.tangents, texels.faces, areas, texels.triangle,
                  texels.barycentric, texels.chart, texels.column, texels.row, texels.outside)
