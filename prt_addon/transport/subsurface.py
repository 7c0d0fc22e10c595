# SPDX-License-Identifier: GPL-3.0-or-later
"""Light that enters a translucent body elsewhere and leaves at the receiver, of all lighting columns at once.

    B(x_o) = integral over the surface of R_d(|x_i - x_o|) E(x_i) dA      (Jensen et al. 2001; Carr et al. 2003, eq. 7)

is linear in E, so with E the unit-albedo transfer (irradiance / pi) of every receiver B is exit radiance transfer, and
feeds the constant exit function only (Sloan et al. 2003, section 3). The sum over samples is hierarchical (Jensen &
Buhler 2002): far samples act as one. Which nodes a receiver takes does not depend on E, so they make a sparse matrix
(the throughput factors of Carr et al. 2003, eq. 10), built for a block of receivers, multiplied with all columns and
dropped.

A receiver's own disc, of the area it stands for, is integrated in closed form, so a mean free path far below the
samples' spacing ends in diffuse reflection with the medium's colour (near ones: throughput.py).

Energy. R_d is scaled so that a half-space returns its reflectance R, that is: Fresnel transmission in and out is
normalised (what is thrown back outside belongs to the material's highlight). R_d knows distance only, so a thin sheet
gets its reflectance twice, once from each side. Two times R is right below 1 (a thin sheet absorbs less than a
half-space), and impossible above: rows whose sum exceeds 1 are scaled by s_i s_j, which keeps R_d symmetric
(reciprocity), and then, where neighbours differ, the row alone to at most 1. Folds that face each other across air are
linked like a sheet's sides: the Buddha returns more than its colour for that. Nothing is scaled up: what leaves a small
body by its sides is lost in the dipole. Both show in the reported energy.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from ..linear_algebra import sparse_multiply
from .dipole import Medium, disc_integral
from .throughput import GROUP, Links, Places, fully_linked, linked

# Error that one node may make, relative to the half-space's R (less for a body smaller than the mean free path), if
# light changed its sign from sample to sample. Errors of nodes mostly cancel: the measured error of the whole transfer
# is less than this (benchmarks/subsurface.py), and more tolerance saves little time.
TOLERANCE = 0.01
# Groups of places linked at once, and rows of full sums: some 1e5 links, whose numbers stay in the cache.
GROUPS_AT_ONCE = 128
ROWS_IN_FULL = 8
# Row sums are added in single precision.
ROUNDING = 1e-5


@dataclass(frozen=True)
class Subsurface:
    """transfer: (r, columns, 3) float32; places: distinct positions; links: mean number of nodes per place; error,
    worst: against the full sum at `checked` random receivers, root mean square over that of the transfer, and largest
    over the largest; bound: no receiver is further off than this times a column's largest |irradiance|; energy: (3,)
    mean exit radiance under uniform unit irradiance (a half-space has the medium's reflectance); reduced: (3,) share
    of the energy that thin parts had to lose."""

    transfer: NDArray[np.float32]
    places: int
    links: float
    error: float
    worst: float
    bound: float
    energy: NDArray[np.float64]
    reduced: NDArray[np.float64]
    checked: int


def subsurface_transfer(points: NDArray[np.float64], normals: NDArray[np.float64], areas: NDArray[np.float64],
                        irradiance: NDArray[np.float32], medium: Medium, tolerance: float = TOLERANCE,
                        threads: int = 1, checked: int = 64, seed: int = 0) -> Generator[float, None, Subsurface]:
    """Yield progress, return B of one body.

    points: (r, 3) metres; normals: (r, 3) unit; areas: (r,) square metres that each receiver stands for; irradiance:
    (r, columns, channels) float32 unit-albedo transfer, channels 1 or 3; tolerance: see TOLERANCE, 0 for the full sum.
    Receivers of one call share one body: light goes from each to each. Results do not depend on threads.
    Raises ValueError where shapes do not fit or something is not finite.
    """
    _check(points, normals, areas, irradiance)
    if not len(points):
        none = np.zeros(3)
        return Subsurface(np.zeros((0, irradiance.shape[1], 3), np.float32), 0, 0.0, 0.0, 0.0, 0.0, none, none, 0)
    places = Places.of_receivers(points, normals, areas, medium)
    body = _Body.of(places, irradiance, np.ones((len(places.tree.points), len(places.kernels))))
    found = yield from _gathered(body, tolerance, threads, 0.0)
    before = found.sums
    if (before > 1.0 + ROUNDING).any():
        body = _Body.of(places, irradiance, np.minimum(1.0, np.maximum(before, 1.0) ** -0.5))
        found = yield from _gathered(body, tolerance, threads, 0.5)
    error, worst, count = _measured_error(body, found, checked, seed)
    weights = places.tree.areas[:, None] / max(places.tree.areas.sum(), np.finfo(np.float64).tiny)
    energy, plain = (np.sum(weights * sums, axis=0)[list(places.kernel_of)] for sums in (found.energy, before))
    reduced = np.where(plain > 0.0, 1.0 - energy / np.maximum(plain, np.finfo(np.float64).tiny), 0.0)
    return Subsurface(found.transfer, len(places.tree.points), found.links, error, worst, found.bound, energy,
                      np.maximum(reduced, 0.0), count)


def _check(points: NDArray[np.float64], normals: NDArray[np.float64], areas: NDArray[np.float64],
           irradiance: NDArray[np.float32]) -> None:
    number = len(points)
    if points.shape != (number, 3) or normals.shape != (number, 3) or areas.shape != (number,) \
            or irradiance.ndim != 3 or len(irradiance) != number or irradiance.shape[2] not in (1, 3):
        raise ValueError(f"subsurface: shapes {points.shape}, {normals.shape}, {areas.shape} and {irradiance.shape} "
                         "do not fit")
    if not all(np.isfinite(values).all() for values in (points, normals, areas, irradiance)) or (areas < 0.0).any():
        raise ValueError("subsurface: points, normals, areas and irradiance must be finite, areas not negative")


@dataclass(frozen=True)
class _Body:
    """Places, their light and what each receiver does on its own.

    scale: (p, k) s of every place and kernel; light: per pair of kernel and channel of the irradiance, the flux of
    every matrix column (c, columns + 1) float32, s A E, with s A alone as the last column; own, ring: (r, k) the
    integral of R_d over the receiver's own disc, and its mean over what others at the same place add around it.
    """

    places: Places
    irradiance: NDArray[np.float32]
    scale: NDArray[np.float64]
    light: dict[tuple[int, int], NDArray[np.float32]]
    own: NDArray[np.float64]
    ring: NDArray[np.float64]

    @staticmethod
    def of(places: Places, irradiance: NDArray[np.float32], scale: NDArray[np.float64]) -> _Body:
        together, others = places.tree.areas[places.of], np.zeros(len(places.of))
        np.subtract(together, places.areas, out=others, where=together > places.areas * (1.0 + ROUNDING))
        own = np.stack([disc_integral(poles, places.areas / np.pi) for poles in places.kernels], axis=1)
        ring = np.stack([disc_integral(poles, together / np.pi) for poles in places.kernels], axis=1) - own
        ring = np.divide(ring, others[:, None], out=np.zeros_like(ring), where=others[:, None] > 0.0)
        body = _Body(places, irradiance, scale, {}, own, ring)
        for channel in range(3):
            body.light.setdefault(body.pair(channel), body._flux(*body.pair(channel)))
        return body

    def pair(self, channel: int) -> tuple[int, int]:
        """Kernel, and channel of the irradiance."""
        return self.places.kernel_of[channel], min(channel, self.irradiance.shape[2] - 1)

    def _flux(self, kernel: int, source: int) -> NDArray[np.float32]:
        places, columns = self.places, self.irradiance.shape[1]
        flux = np.zeros((len(places.tree.points), columns + 1), np.float32)
        # Receivers of one place add up: rounds of one receiver per place, few where few share one.
        order = np.argsort(places.of, kind="stable")
        sorted_places = places.of[order]
        rank = np.arange(len(order)) - np.searchsorted(sorted_places, sorted_places)
        weight = (places.areas * self.scale[places.of, kernel]).astype(np.float32)
        for turn in range(rank.max() + 1):
            chosen = order[rank == turn]
            flux[places.of[chosen], :columns] += weight[chosen, None] * self.irradiance[chosen, :, source]
            flux[places.of[chosen], columns] += weight[chosen]
        return places.tree.summed(flux)

    def products(self, links: Links) -> dict[tuple[int, int], NDArray[np.float32]]:
        """What links gather of each kind of light: (rows, columns + 1)."""
        shape = (len(links.rows), len(self.places.sizes))
        matrices = [csr_array((values, links.indices, links.indptr), shape=shape) for values in links.values]
        return {pair: sparse_multiply(matrices[pair[0]], flux) for pair, flux in self.light.items()}

    def gathered(self, groups: NDArray[np.int64], tolerance: float) -> _Rows:
        """What the places of adjacent groups gather."""
        tree = self.places.tree
        first, last = tree.first[groups[0]], tree.first[groups[-1]] + tree.count[groups[-1]]
        turns, bound = linked(self.places, groups, tolerance)
        own = np.empty((last - first, len(self.places.kernels)))
        products = {pair: np.empty((last - first, flux.shape[1]), np.float32) for pair, flux in self.light.items()}
        count = 0
        for turn, links in enumerate(turns):
            there = tree.count[groups] > turn
            row = links.rows[there] - first
            own[row] = links.own[there]
            for pair, product in self.products(links).items():
                products[pair][row] = product[there]
            count += int(np.diff(links.indptr)[there].sum())
        return _Rows(np.arange(first, last), own, products, count, float(bound.max()))

    def sums(self, rows: NDArray[np.int64], own: NDArray[np.float64],
             products: dict[tuple[int, int], NDArray[np.float32]]) -> NDArray[np.float64]:
        """Row sums (rows, k): what leaves each place under uniform unit irradiance, before its own factor."""
        gathered = {kernel: product[:, -1] for (kernel, _), product in products.items()}
        own = own * self.scale[rows]
        squared = self.places.tree.areas[rows] / np.pi
        return np.stack([gathered[kernel] + own[:, kernel] * disc_integral(poles, squared)
                         for kernel, poles in enumerate(self.places.kernels)], axis=1)

    def exit(self, receivers: NDArray[np.int64], row: NDArray[np.int64], own: NDArray[np.float64],
             factors: NDArray[np.float64], products: dict[tuple[int, int], NDArray[np.float32]]) -> NDArray[np.float32]:
        """B (m, columns, 3) of some receivers. row (m,): into the products and `own` of Links; factors (p, k): of
        the places."""
        result = np.empty((len(receivers), self.irradiance.shape[1], 3), np.float32)
        place = self.places.of[receivers]
        for channel in range(3):
            kernel, source = pair = self.pair(channel)
            ring, area = own[row, kernel] * self.ring[receivers, kernel], self.places.areas[receivers]
            alone = self.scale[place, kernel] * (own[row, kernel] * self.own[receivers, kernel] - ring * area)
            value = products[pair][row, :-1]
            value += _column(ring) * self.light[pair][place, :-1]
            value += _column(alone) * self.irradiance[receivers, :, source]
            value *= _column(factors[place, kernel])
            result[:, :, channel] = value
        return result


@dataclass(frozen=True)
class _Rows:
    """What a block of places gathers: products, `own` of Links, number of links, largest error bound."""

    rows: NDArray[np.int64]
    own: NDArray[np.float64]
    products: dict[tuple[int, int], NDArray[np.float32]]
    links: int
    bound: float


def _column(values: NDArray[np.float64]) -> NDArray[np.float32]:
    return values.astype(np.float32)[:, None]


@dataclass(frozen=True)
class _Gathered:
    """transfer: (r, columns, 3); factors: (p, k) last factor of every place; sums, energy: (p, k) row sums before and
    after it; links: mean per place; bound: largest."""

    transfer: NDArray[np.float32]
    factors: NDArray[np.float64]
    sums: NDArray[np.float64]
    energy: NDArray[np.float64]
    links: float
    bound: float


def _gathered(body: _Body, tolerance: float, threads: int, progress: float) -> Generator[float, None, _Gathered]:
    """All rows, block by block."""
    places, tree = body.places, body.places.tree
    groups = tree.level(GROUP)
    blocks = [groups[start:start + GROUPS_AT_ONCE] for start in range(0, len(groups), GROUPS_AT_ONCE)]
    transfer = np.empty((*body.irradiance.shape[:2], 3), np.float32)
    sums, factors = np.empty((2, *body.scale.shape))
    members = np.argsort(places.of, kind="stable")
    first = np.searchsorted(places.of[members], np.arange(len(tree.points) + 1))
    count, bound = 0, 0.0

    for block in _in_order(lambda groups: body.gathered(groups, tolerance), blocks, threads):
        rows = block.rows
        sums[rows] = body.sums(rows, block.own, block.products)
        factors[rows] = np.minimum(body.scale[rows], 1.0 / np.maximum(sums[rows], 1.0))
        receivers = members[first[rows[0]]:first[rows[-1] + 1]]
        transfer[receivers] = body.exit(receivers, places.of[receivers] - rows[0], block.own, factors, block.products)
        count += block.links
        bound = max(bound, block.bound)
        yield progress + 0.5 * (rows[-1] + 1) / len(tree.points)
    return _Gathered(transfer, factors, sums, sums * factors, count / len(tree.points), bound)


def _in_order[Result](work: Callable[[NDArray[np.int64]], Result], items: Iterable[NDArray[np.int64]], threads: int,
                      ) -> Iterator[Result]:
    """Results of `work` in the items' order, at most two per thread in flight."""
    if threads <= 1:
        yield from map(work, items)
        return
    with ThreadPoolExecutor(threads) as pool:
        pending: list[Future[Result]] = []
        try:
            for item in items:
                pending.append(pool.submit(work, item))
                if len(pending) >= 2 * threads:
                    yield pending.pop(0).result()
            while pending:
                yield pending.pop(0).result()
        finally:
            for future in pending:
                future.cancel()


def _measured_error(body: _Body, found: _Gathered, checked: int, seed: int) -> tuple[float, float, int]:
    """Root mean square and largest error, both relative, against the full sum at random receivers, and how many."""
    number = len(body.places.of)
    receivers = np.random.default_rng(seed).choice(number, min(checked, number), replace=False)
    squared = reference = worst = brightest = 0.0
    for start in range(0, len(receivers), ROWS_IN_FULL):
        part = receivers[start:start + ROWS_IN_FULL]
        links = fully_linked(body.places, body.places.of[part])
        products = body.products(links)
        full = body.exit(part, np.arange(len(part)), links.own, found.factors, products).astype(np.float64)
        off = np.abs(found.transfer[part] - full)
        squared += float(np.sum(off**2))
        reference += float(np.sum(full**2))
        worst, brightest = max(worst, float(off.max())), max(brightest, float(np.abs(full).max()))
    if not reference:
        return 0.0, 0.0, len(receivers)
    return float(np.sqrt(squared / reference)), worst / brightest, len(receivers)
