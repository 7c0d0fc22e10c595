# SPDX-License-Identifier: GPL-3.0-or-later
"""Links of subsurface light for drawing it live (Carr, Hall & Hart 2003, section 4.2): each receiver gathers from K
nodes of a pyramid over the surface,

    B_i = sum_k F_ik E_k,     F_ik = area_k * mean over node k of R_d(|x_i - y|),     E_k = mean irradiance of node k,

so that a light that moves costs three short passes. (`subsurface.py` sums with a fixed error and as many links as that
takes, for the columns of a bake; here their number is fixed, and so are cost and memory.)

Which nodes: all of one level (the paper's fixed links, which it drew with), or a cut through the tree that starts with
the root and replaces the link that stands first in line by its four children, until there are K (best-first). First in
line is the largest throughput factor (the paper's rule), or that times how much R_d varies over the node ("spread"): a
far large node has a large factor and needs no refinement.

Then every receiver's tree is refined further, to `resolved` nodes, and each link's factor is the sum over the nodes
that came of it: a coarse link still carries the right light for even irradiance. What the paper leaves as seams is the
part of a node that a receiver sees best: a few links per texel show blocks where the cut changes. So a link also
remembers where in the node its light comes from, the mean g of (y - centre) weighted by the factor, and takes the
irradiance there, by the plane that fits the node's texels best,

    E_k(g) = mean E + shift . moment,     moment = mean of (y - centre) (E - mean E),     shift = covariance^-1 g.

Moments rise through the pyramid with the means. (On the bunny 16 such links are as near as 64 without.)

Two facts bound the sums: a surface
without overlaps that faces as the receiver does gives no more than a flat one, R; so does what faces the other way
(the far side of a sheet); and both together no more than 1.

Areas and energy: R_d is scaled so that a half-space returns R (dipole.py), so Fresnel's transmission in and out is
normalised; what a highlight takes is a share on the irradiance.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .dipole import Medium, Poles, disc_integral, mean_reflectance, plane_integral
from .surface_pyramid import SurfacePyramid

Single = NDArray[np.float32]
# Receivers linked at once: their lists of nodes stay in the cache.
BLOCK = 1024
# A node is integrated to second order where its variance is at most this share of the squared distance, depth included;
# beyond, it is taken as a disc about the receiver's foot.
WIDE = 0.3
# Nodes to which a receiver's sum is resolved, for each of its links, and at least.
RESOLVED, LEAST_RESOLVED = 4, 64
RULES = ("factor", "spread")
# Variance, as a share of all of it, that is taken for granted across a node's surface: a flat one says nothing of how
# light changes there.
FLATTEST = 0.02


@dataclass(frozen=True)
class Links:
    """K links of r receivers. node: (r, K) int32 of the pyramid; factor: (r, K, 3) float32, 0 where a receiver has
    fewer; shift: (r, K, 3) float32, see above, per unit of the pyramid's size; bounded: (3,) share of the light under
    even irradiance that the bounds took, 0..1."""

    node: NDArray[np.int32]
    factor: Single
    shift: Single
    bounded: NDArray[np.float64]

    def gathered(self, means: Single, moments: Single | None = None) -> Single:
        """B (r, 3) of means (m, 3) of the pyramid's nodes, and their moments (m, 3, 3); None for the paper's links."""
        light = means[self.node]
        if moments is not None:
            for axis in range(3):
                light += self.shift[..., axis, None] * moments[self.node, axis]
        return np.sum(self.factor * light, axis=1)

    def of(self, rows: NDArray[np.integer]) -> Links:
        """The links of some receivers."""
        return Links(self.node[rows], self.factor[rows], self.shift[rows], self.bounded)

    @property
    def sums(self) -> Single:
        """(r, 3) what each receiver gives under irradiance 1 everywhere."""
        return self.factor.sum(axis=1)


def adaptive_links(pyramid: SurfacePyramid, places: NDArray[np.integer], medium: Medium, links: int = 16,
                   rule: str = "spread", resolved: int | None = None, body: int = 0, threads: int = 1) -> Links:
    """Best-first links of the texels at places (r,) of level 0, all of which must lie in the body; rule: see above.
    Neighbouring places side by side are faster."""
    if rule not in RULES:
        raise ValueError(f"{rule} is none of the rules {RULES}")
    return _linked(pyramid, places, medium, np.array([pyramid.roots[body]]), links, rule, resolved, threads)


def level_links(pyramid: SurfacePyramid, places: NDArray[np.integer], medium: Medium, below: int = 2,
                resolved: int | None = None, body: int = 0, threads: int = 1) -> Links:
    """Links to all nodes that lie so many levels below the body's root: at most 4^below."""
    nodes = pyramid.level_nodes(int(pyramid.roots[body]), below)
    return _linked(pyramid, places, medium, nodes, len(nodes), "spread", resolved, threads)


def full_sum(pyramid: SurfacePyramid, places: NDArray[np.integer], medium: Medium, means: Single,
             body: int = 0) -> Single:
    """B (r, 3) of means (m, 3) by the sum over all texels of the body: what links are measured against."""
    table, places = _Table.of(pyramid, medium), np.asarray(places, np.int32)
    leaves = _leaves(pyramid, body)
    result = np.empty((len(places), 3), np.float32)
    for start in range(0, len(places), 8):
        rows = places[start:start + 8]
        nodes = np.broadcast_to(leaves, (len(rows), len(leaves)))
        factor, facing = table.factors(rows, nodes)[::2]
        table.bound(factor, facing)
        for channel, kernel in enumerate(table.kernel_of):
            result[start:start + 8, channel] = np.sum(factor[..., kernel] * means[leaves, channel], axis=1)
    return result


def _leaves(pyramid: SurfacePyramid, body: int) -> NDArray[np.int32]:
    """The nodes of level 0 with surface below a body's root."""
    root = int(pyramid.roots[body])
    level = int(np.searchsorted(pyramid.start, root, side="right")) - 1
    first = (root - int(pyramid.start[level])) * 4 ** level
    leaves = np.arange(first, min(first + 4 ** level, int(pyramid.start[1])))
    return leaves[pyramid.area[leaves] > 0.0].astype(np.int32)


def _linked(pyramid: SurfacePyramid, places: NDArray[np.integer], medium: Medium, first: NDArray[np.int64],
            links: int, rule: str, resolved: int | None, threads: int) -> Links:
    """Links of all receivers, block by block. first: nodes that each receiver starts with."""
    table, places = _Table.of(pyramid, medium), np.asarray(places, np.int32)
    limit = max(LEAST_RESOLVED, RESOLVED * links) if resolved is None else max(resolved, links)
    result = Links(np.zeros((len(places), links), np.int32), *np.zeros((2, len(places), links, 3), np.float32),
                   np.zeros(3))
    before, after = np.zeros((2, len(table.kernels)))
    blocks = [slice(start, start + BLOCK) for start in range(0, len(places), BLOCK)]
    work = _each(lambda block: _link_block(table, places[block], first, links, rule, limit), blocks, threads)
    for block, (node, factor, shift, sums) in zip(blocks, work, strict=True):
        result.node[block], result.shift[block] = node, shift
        result.factor[block] = factor[:, :, list(table.kernel_of)]
        before, after = before + sums, after + factor.sum(axis=(0, 1), dtype=np.float64)
    taken = np.divide(before - after, before, out=np.zeros_like(before), where=before > 0.0)
    result.bounded[:] = np.maximum(taken, 0.0)[list(table.kernel_of)]
    return result


def _each[Item, Result](work: Callable[[Item], Result], items: list[Item], threads: int) -> Iterator[Result]:
    """Results in order; without threads where one would do (Blender's own process starts none)."""
    if threads <= 1 or len(items) < 2:
        yield from map(work, items)
        return
    with ThreadPoolExecutor(threads) as pool:
        yield from pool.map(work, items)


def _link_block(table: _Table, places: NDArray[np.int32], first: NDArray[np.int64], links: int, rule: str,
                limit: int) -> tuple[NDArray[np.int32], Single, Single, NDArray[np.float64]]:
    """Nodes (b, links), factors (b, links, kernels), shifts (b, links, 3) and the sum of the factors before their
    bounds (kernels,)."""
    cut = _Cut.starting(table, places, first, limit)
    cut.refine(links, rule, 0.0)
    chosen, number = cut.nodes[:, :links].copy(), len(places)
    cut.owner[:, :links] = np.arange(links)
    # What is left to gain below a ten-thousandth of R is not worth its time.
    cut.refine(limit, "spread", 1e-4 * float(np.mean(table.flat[list(table.kernel_of)])))
    factor, nodes = cut.factor[:, :limit], cut.nodes[:, :limit]
    before = factor.sum(axis=(0, 1), dtype=np.float64)
    table.bound(factor, cut.facing[:, :limit])
    slot = np.arange(number)[:, None] * links + cut.owner[:, :limit]

    def summed(values: Single) -> NDArray[np.float64]:
        return np.bincount(slot.ravel(), values.ravel(), number * links).reshape(number, links)

    weight = factor.sum(axis=2)
    whole = np.maximum(summed(weight), np.finfo(np.float32).tiny)
    centre = table.packed[nodes, :3] - table.packed[places, None, :3]  # about the receiver: precise where it is near
    foot = table.packed[chosen, :3] - table.packed[places, None, :3]
    apart = np.stack([summed(weight * centre[..., axis]) / whole for axis in range(3)], axis=2) - foot
    apart[summed(weight) == 0.0] = 0.0
    sums = np.stack([summed(factor[..., kernel]) for kernel in range(factor.shape[2])], axis=2)
    return chosen, sums.astype(np.float32), table.shifts(chosen, apart), before


@dataclass(frozen=True)
class _Table:
    """What factors are made of. packed: (m, 16) float32 centre, area, covariance, normal: a cache line per node;
    inverse: (m, 6) of the covariance, 0 at level 0; cap: (m, kernels) R_d's integral over a disc of the node's area;
    flat: (kernels,) R of a half-space."""

    pyramid: SurfacePyramid
    packed: Single
    inverse: Single
    cap: Single
    kernels: tuple[Poles, ...]
    kernel_of: tuple[int, ...]
    flat: NDArray[np.float64]

    @staticmethod
    def of(pyramid: SurfacePyramid, medium: Medium) -> _Table:
        poles = [medium.poles(channel, pyramid.size) for channel in range(3)]
        kernels = tuple(dict.fromkeys(poles))
        packed = np.zeros((len(pyramid.area), 16), np.float32)
        packed[:, :3], packed[:, 3], packed[:, 4:10] = pyramid.centre, pyramid.area, pyramid.covariance
        packed[:, 10:13] = pyramid.normal
        cap = np.stack([disc_integral(p, pyramid.area.astype(np.float64) / np.pi) for p in kernels], axis=1)
        inverse = np.zeros((len(pyramid.area), 6), np.float32)
        above = slice(int(pyramid.start[1]), None)
        inverse[above] = _inverse(pyramid.covariance[above])
        return _Table(pyramid, packed, inverse, cap.astype(np.float32), kernels, tuple(kernels.index(p) for p in poles),
                      np.array([plane_integral(p) for p in kernels]))

    def factors(self, places: NDArray[np.int32], nodes: NDArray[np.int32],
                ) -> tuple[Single, Single, NDArray[np.bool_]]:
        """Factors (b, k, kernels) of nodes (b, k) at the texels at places (b,), how much R_d varies over each (b, k)
        from 0 to 1, and whether it faces as the texel does."""
        own, data = self.packed[places], self.packed[nodes]
        x, y, z = (own[:, None, axis] - data[..., axis] for axis in range(3))
        squared = x * x + y * y + z * z
        c = [data[..., 4 + index] for index in range(6)]
        spread = c[0] + c[1] + c[2]
        along = x * (c[0] * x + 2.0 * (c[3] * y + c[4] * z)) + y * (c[1] * y + 2.0 * c[5] * z) + c[2] * z * z
        facing = sum(own[:, None, axis] * data[..., axis] for axis in (10, 11, 12)) >= 0.0
        variation = np.zeros_like(squared)
        result = np.empty((*nodes.shape, len(self.kernels)), np.float32)
        itself = nodes == places[:, None]
        for kernel, poles in enumerate(self.kernels):
            depth = np.float32(poles.real * poles.real)
            share = spread / (squared + depth)
            variation = np.maximum(variation, share)
            cap = self.cap[nodes, kernel]
            value = data[..., 3] * mean_reflectance(poles, squared, spread, along)
            wide = share > WIDE
            if wide.any():
                reach = np.sqrt(squared[wide] / np.maximum(2.0 * spread[wide], np.finfo(np.float32).tiny))
                value[wide] = cap[wide] * np.clip(1.0 - 0.5 * reach, 0.3, 1.0)
            value = np.minimum(value, cap)
            value[itself] = cap[itself]
            result[..., kernel] = value
        return result, np.minimum(variation, 1.0), facing

    def shifts(self, nodes: NDArray[np.int32], apart: NDArray[np.float64]) -> Single:
        """covariance^-1 apart (b, k, 3) of nodes (b, k)."""
        c, (x, y, z) = self.inverse[nodes], np.moveaxis(apart, -1, 0)
        return np.stack([c[..., 0] * x + c[..., 3] * y + c[..., 4] * z, c[..., 3] * x + c[..., 1] * y + c[..., 5] * z,
                         c[..., 4] * x + c[..., 5] * y + c[..., 2] * z], axis=-1).astype(np.float32)

    def bound(self, factor: Single, facing: NDArray[np.bool_]) -> None:
        """Scale factors (b, k, kernels) down, in place, to what surfaces can give."""
        for kernel, flat in enumerate(self.flat):
            mine = factor[..., kernel]
            front, whole = np.sum(mine, axis=1, where=facing), np.sum(mine, axis=1)
            scale = [flat / np.maximum(v, flat) for v in (front, whole - front)]
            total = front * scale[0] + (whole - front) * scale[1]
            last = 1.0 / np.maximum(total, 1.0)
            mine *= np.where(facing, (scale[0] * last)[:, None], (scale[1] * last)[:, None])


def _inverse(covariance: Single) -> NDArray[np.float64]:
    """Inverses (n, 6) of covariances (n, 6), each with FLATTEST of its trace added along all axes; 0 of 0."""
    xx, yy, zz, xy, xz, yz = covariance.T.astype(np.float64)
    trace = xx + yy + zz
    xx, yy, zz = (value + FLATTEST * trace for value in (xx, yy, zz))
    adjugate = np.stack([yy * zz - yz * yz, xx * zz - xz * xz, xx * yy - xy * xy, xz * yz - xy * zz, xy * yz - xz * yy,
                         xy * xz - xx * yz], axis=1)
    determinant = xx * adjugate[:, 0] + xy * adjugate[:, 3] + xz * adjugate[:, 4]
    return np.divide(adjugate, determinant[:, None], out=np.zeros_like(adjugate), where=determinant[:, None] > 0.0)


@dataclass(frozen=True)
class _Cut:
    """Cuts through the trees of b receivers, in arrays with one column more than they hold: what falls away is written
    there. count: (b,) nodes of each; priority: (b, k) of their refinement."""

    table: _Table
    places: NDArray[np.int32]
    count: NDArray[np.int64]
    nodes: NDArray[np.int32]
    factor: Single
    variation: Single
    facing: NDArray[np.bool_]
    owner: NDArray[np.int32]

    @staticmethod
    def starting(table: _Table, places: NDArray[np.int32], first: NDArray[np.int64], limit: int) -> _Cut:
        number, given, room = len(places), len(first), max(limit, len(first)) + 1
        cut = _Cut(table, places, np.full(number, given), np.zeros((number, room), np.int32),
                   np.zeros((number, room, len(table.kernels)), np.float32), np.zeros((number, room), np.float32),
                   np.ones((number, room), bool), np.zeros((number, room), np.int32))
        cut.nodes[:, :given] = first
        found = table.factors(places, cut.nodes[:, :given])
        cut.factor[:, :given], cut.variation[:, :given], cut.facing[:, :given] = found
        return cut

    def refine(self, limit: int, rule: str, least: float) -> None:
        """Replace the node that stands first in line by its children, until there are `limit` or none stands above
        `least`."""
        first_child, area = self.table.pyramid.first_child, self.table.pyramid.area
        weights = np.bincount(self.table.kernel_of, minlength=len(self.table.kernels)).astype(np.float32) / 3.0

        def priorities(factor: Single, variation: Single, nodes: NDArray[np.int32]) -> Single:
            value = np.sum(factor * weights, axis=-1)
            value *= variation if rule == "spread" else 1.0
            return np.where(first_child[nodes] >= 0, value, 0.0)

        priority = priorities(self.factor, self.variation, self.nodes)
        priority[:, self.nodes.shape[1] - 1] = 0.0
        every, last = np.arange(len(self.places)), self.nodes.shape[1] - 1
        while True:
            pick = priority.argmax(axis=1)
            active = np.flatnonzero((priority[every, pick] > least) & (self.count + 3 <= limit))
            if not len(active):
                return
            pick, row = pick[active], active[:, None]
            children = first_child[self.nodes[active, pick]][:, None] + np.arange(4, dtype=np.int32)
            there = area[children] > 0.0
            rank = np.cumsum(there, axis=1) - 1
            slot = np.where(there, np.where(rank == 0, pick[:, None], self.count[row] + rank - 1), last)
            found = self.table.factors(self.places[active], children)
            self.owner[row, slot] = self.owner[active, pick][:, None]
            self.nodes[row, slot] = children
            self.factor[row, slot], self.variation[row, slot], self.facing[row, slot] = found
            priority[row, slot] = priorities(found[0], found[1], children)
            priority[:, last] = 0.0
            self.count[active] += there.sum(axis=1) - 1
