# SPDX-License-Identifier: GPL-3.0-or-later
"""A pyramid over texels of a surface: parent k of a level stands for children 4k .. 4k + 3 of the level below.

That is what the mip levels of a texture atlas are, with the texels of level 0 in Morton order (Carr et al. 2003,
section 2.3: each mip texel stands for the cluster of triangles below it). Two ways lead to one:

* `over_points`: any samples of a surface, sorted so that each run of 4^l of them lies close together. This is the
  paper's meshed atlas at the size of its texels: no unwrapping, no charts, no empty texel, and no mesh fails.
* `over_image`: a square atlas of charts, some of its texels empty. Mip texels at charts' borders stand for two places.

Levels lie one after another in one list of nodes, level 0 first, each padded to a multiple of 4 but the last. Several
bodies share a pyramid, each below a node of its own.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

# Which coordinates the six numbers of a symmetric matrix belong to.
ROWS, COLUMNS = [0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]


@dataclass(frozen=True)
class SurfacePyramid:
    """m nodes, lengths in units of `size` metres.

    texel: (n0,) int64, which of the given texels stands at each place of level 0, -1 where none does; start: (levels +
    1,) where each level begins in the list; roots: (bodies,) nodes; first_child: (m,) int32, -1 at level 0. Per node:
    centre (m, 3): area-weighted; area: (m,); covariance: (m, 6) of the surface about its centre, as xx yy zz xy xz yz;
    normal: (m, 3) area-weighted mean, not of unit length.
    """

    texel: NDArray[np.int64]
    start: NDArray[np.int64]
    roots: NDArray[np.int64]
    first_child: NDArray[np.int32]
    centre: NDArray[np.float32]
    area: NDArray[np.float32]
    covariance: NDArray[np.float32]
    normal: NDArray[np.float32]
    size: float

    @staticmethod
    def over_points(points: NDArray[np.floating], normals: NDArray[np.floating], areas: NDArray[np.floating],
                    body: NDArray[np.integer] | None = None) -> SurfacePyramid:
        """points (n, 3) metres, unit normals (n, 3), areas (n,) square metres, n at least 1; body: (n,) of each, from
        0 without gaps: light never goes from one to another."""
        body = np.zeros(len(points), np.int64) if body is None else np.asarray(body, np.int64)
        counts = np.bincount(body)
        heights = [_height(count) for count in counts]
        places, roots, end = [], np.zeros(len(counts), np.int64), 0
        # The largest body first: each begins at a multiple of what its root stands for, and the next after all of it.
        for number in np.argsort(-counts, kind="stable"):
            members = np.flatnonzero(body == number)
            step = 4 ** heights[number]
            begin = -(-end // step) * step
            roots[number], end = begin // step, begin + step
            filled = np.full(step, -1, np.int64)
            filled[:len(members)] = members[quadtree_order(np.asarray(points)[members])]
            places += [np.full(begin - sum(map(len, places)), -1, np.int64), filled]
        texel = np.concatenate(places)
        texel = texel[:int(np.flatnonzero(texel >= 0)[-1]) + 1]
        return _pyramid(texel, points, normals, areas, max(heights), (np.array(heights), roots))

    @staticmethod
    def over_image(points: NDArray[np.floating], normals: NDArray[np.floating], areas: NDArray[np.floating],
                   ) -> SurfacePyramid:
        """A square atlas: points, normals (side, side, 3), areas (side, side), 0 where a texel is empty; side a power
        of two. Texels are numbered row by row."""
        side = areas.shape[0]
        height = side.bit_length() - 1
        if areas.shape != (side, side) or side != 1 << height or not side:
            raise ValueError(f"an atlas of {areas.shape} texels: its side must be a power of two")
        texel = morton_texels(side)
        texel = np.where(areas.ravel()[texel] > 0.0, texel, -1)
        return _pyramid(texel, points.reshape(-1, 3), normals.reshape(-1, 3), areas.ravel(), height,
                        (np.array([height]), np.zeros(1, np.int64)))

    @staticmethod
    def of_places(texel: NDArray[np.integer], points: NDArray[np.floating], normals: NDArray[np.floating],
                  areas: NDArray[np.floating], levels: int) -> SurfacePyramid:
        """A pyramid of so many levels whose level 0 is known, `texel`; without roots."""
        return _pyramid(np.asarray(texel, np.int64), points, normals, areas, levels - 1,
                        (np.zeros(0, np.int64), np.zeros(0, np.int64)))

    @property
    def levels(self) -> int:
        """Their number, level 0 among them."""
        return len(self.start) - 1

    def place(self, texels: int) -> NDArray[np.int64]:
        """(texels,) the node of level 0 of each given texel, -1 where it has none."""
        result = np.full(texels, -1, np.int64)
        used = np.flatnonzero(self.texel >= 0)
        result[self.texel[used]] = used
        return result

    def level_nodes(self, root: int, below: int) -> NDArray[np.int64]:
        """The nodes with surface that lie so many levels below one."""
        nodes = np.array([root])
        for _ in range(below):
            inside = nodes[self.first_child[nodes] >= 0]
            nodes = (self.first_child[inside][:, None] + np.arange(4)).ravel()
            nodes = nodes[self.area[nodes] > 0.0]
        return nodes

    def means(self, values: NDArray[np.floating]) -> NDArray[np.float32]:
        """Values (texels, ...) of the given texels as area-weighted means of all nodes, (m, ...) float32; 0 where there
        is no surface."""
        result = np.zeros((len(self.area), *values.shape[1:]), np.float32)
        used = np.flatnonzero(self.texel >= 0)
        result[used] = values[self.texel[used]]
        weight = self.area.reshape(-1, *[1] * (values.ndim - 1))
        for level in range(1, self.levels):
            below = slice(self.start[level - 1], self.start[level])
            count = (below.stop - below.start) // 4
            mine = slice(self.start[level], self.start[level] + count)
            sums = (result[below] * weight[below]).reshape(count, 4, *values.shape[1:]).sum(axis=1)
            np.divide(sums, weight[mine], out=result[mine], where=weight[mine] > 0.0)
        return result

    def moments(self, means: NDArray[np.float32]) -> NDArray[np.float32]:
        """Of means (m, 3), the mean over each node of (y - centre) (E - mean E): (m, 3, 3) float32 by axis and channel,
        lengths in units of `size`; 0 at level 0."""
        result = np.zeros((len(means), 3, 3), np.float32)
        for level in range(1, self.levels):
            below = slice(self.start[level - 1], self.start[level])
            count = (below.stop - below.start) // 4
            mine = slice(self.start[level], self.start[level] + count)
            share = np.divide(self.area[below].reshape(count, 4), self.area[mine, None],
                              out=np.zeros((count, 4), np.float32), where=self.area[mine, None] > 0.0)
            apart = self.centre[below].reshape(count, 4, 3) - self.centre[mine, None]
            light = means[below].reshape(count, 4, 3) - means[mine, None]
            values = result[below].reshape(count, 4, 3, 3) + apart[:, :, :, None] * light[:, :, None]
            result[mine] = np.sum(share[:, :, None, None] * values, axis=1)
        return result


def _height(count: int) -> int:
    """Levels above level 0 until one node stands for so many texels."""
    height = 0
    while 4 ** height < count:
        height += 1
    return height


def quadtree_order(points: NDArray[np.floating]) -> NDArray[np.int64]:
    """Indices (n,) that sort points so that each aligned run of 4^l lies close together.

    Level by level each run is cut where its first aligned half ends, across its longest side: runs are full but for the
    last one. One sort per level, of all runs at once.
    """
    number = len(points)
    depth = 2 * _height(number)
    order = np.arange(number)
    for level in range(depth):
        run = np.arange(number) >> (depth - level)
        first = np.flatnonzero(np.diff(run, prepend=-1))
        inside = points[order]
        low, high = np.minimum.reduceat(inside, first), np.maximum.reduceat(inside, first)
        axis = np.argmax(high - low, axis=1)
        rank = np.arange(len(first))
        base, length = low[rank, axis], np.maximum((high - low)[rank, axis], np.finfo(np.float64).tiny)
        index = np.cumsum(np.diff(run, prepend=0) > 0)
        along = (inside[np.arange(number), axis[index]] - base[index]) / length[index]
        order = order[np.argsort(index + 0.999 * along, kind="stable")]
    return order


def morton_texels(side: int) -> NDArray[np.int64]:
    """(side^2,) the texels, numbered row by row, in Morton order: x has the even bits."""
    number = np.arange(side * side, dtype=np.int64)
    x, y = np.zeros_like(number), np.zeros_like(number)
    for bit in range(max(side.bit_length() - 1, 0)):
        x |= ((number >> (2 * bit)) & 1) << bit
        y |= ((number >> (2 * bit + 1)) & 1) << bit
    return y * side + x


def _pyramid(texel: NDArray[np.int64], points: NDArray[np.floating], normals: NDArray[np.floating],
             areas: NDArray[np.floating], height: int, bodies: tuple[NDArray[np.int64], NDArray[np.int64]],
             ) -> SurfacePyramid:
    """The levels above texels. bodies: height of the root of each, and its number in its level."""
    points, normals, areas = (np.asarray(v, np.float64) for v in (points, normals, areas))
    texel = _padded(texel, -1) if height else texel
    used = texel >= 0
    low, high = points[texel[used]].min(axis=0), points[texel[used]].max(axis=0)
    size = float(np.sqrt(np.sum((high - low) ** 2))) or float(np.sqrt(areas[texel[used]].sum())) or 1.0
    middle = 0.5 * (low + high)
    area = np.where(used, areas[texel], 0.0) / size**2
    centre = np.where(used[:, None], (points[texel] - middle) / size, 0.0)
    normal = np.where(used[:, None], normals[texel], 0.0)
    flat = np.eye(3)[ROWS, COLUMNS] - normal[:, ROWS] * normal[:, COLUMNS]
    # A disc of area A has the variance A / 4pi along each of its tangents.
    found = [(centre, area, area[:, None] / (4.0 * np.pi) * flat * used[:, None], normal)]
    for level in range(height):
        found.append(_above(*found[-1], padded=level + 1 < height))
    start = np.concatenate([[0], np.cumsum([len(level[1]) for level in found])])
    first_child = np.full(start[-1], -1, np.int32)
    for level in range(1, len(found)):
        count = (start[level] - start[level - 1]) // 4
        first_child[start[level]:start[level] + count] = start[level - 1] + 4 * np.arange(count)
    heights, numbers = bodies
    joined = [np.concatenate([level[i] for level in found]).astype(np.float32) for i in range(4)]
    return SurfacePyramid(texel, start, start[heights] + numbers, first_child, *joined, size)


def _padded(values: NDArray, fill: float) -> NDArray:
    """Values (n, ...) with as many more as make n a multiple of 4."""
    return np.concatenate([values, np.full((-len(values) % 4, *values.shape[1:]), fill, values.dtype)])


def _above(centre: NDArray[np.float64], area: NDArray[np.float64], covariance: NDArray[np.float64],
           normal: NDArray[np.float64], padded: bool) -> tuple[NDArray[np.float64], ...]:
    """The level above one."""
    def grouped(values: NDArray[np.float64]) -> NDArray[np.float64]:
        return values.reshape(-1, 4, *values.shape[1:])

    total = area.reshape(-1, 4).sum(axis=1)
    share = np.divide(area.reshape(-1, 4), total[:, None], out=np.zeros((len(total), 4)), where=total[:, None] > 0.0)
    share = share[:, :, None]
    middle = (grouped(centre) * share).sum(axis=1)
    apart = grouped(centre) - middle[:, None]
    spread = ((grouped(covariance) + apart[:, :, ROWS] * apart[:, :, COLUMNS]) * share).sum(axis=1)
    found = middle, total, spread, (grouped(normal) * share).sum(axis=1)
    return tuple(_padded(values, 0.0) for values in found) if padded else found
