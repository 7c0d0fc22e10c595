# SPDX-License-Identifier: GPL-3.0-or-later
"""Transfer from a part of its elements: dense vertices sampled well, the others woven from them (Huang & Ramamoorthi
2010, Sparsely Precomputing the Light Transport Matrix for Real-Time Rendering).

A quarter of the vertices, chosen over rounds where the local transport has a high rank, is sampled in most directions
(`angular_sampling`). Every other vertex gets some 350 samples, in the directions in which its dense neighbours differ
most, which tell how much of each neighbour it is (`sparse_weights`). The paper's own steps, all on whole arrays; what
is ours: near means near in position and normal, and where known factors (cosine, reflection, solid angle) stand beside
what is sampled, only the latter is interpolated.

It pays only where an element costs much more than a ray (docs/sparse_precomputation.md): nothing chooses it by itself.
"""

from __future__ import annotations

from collections.abc import Generator, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from ..errors import BadArguments
from ..linear_algebra import multiply
from ..scene.object_mesh import bounding_diagonal
from ..scene.receivers import morton_order
from . import sparse_weights
from .angular_sampling import VERTICES as BLOCK
from .angular_sampling import DenseRows, edge_of, quarter_grid, sample_rows
from .column_arrays import column_array
from .elements import Elements
from .sparse_weights import Normal

Single = NDArray[np.float32]
Places = NDArray[np.int64]

# Sparse vertices solved together, and those of them, near each other, whose features are chosen together.
VERTICES, GROUP = 1024, 64
# Neighbours whose rank is taken, and the share of their squared values that the rank must hold.
RANK_NEIGHBOURS, RANK_ENERGY = 16, 0.99


@dataclass(frozen=True)
class SparseSettings:
    """dense: share of dense vertices; rounds: in which they are chosen, the first at random; features: samples of a
    sparse vertex as a share of the columns (350 of 6,144); radius: within which neighbours are looked for, as a share
    of the scene's diagonal; neighbours: most of them; normals: distance in radii that opposite normals count as;
    method: how neighbours are weighed; strength: of `sparse_weights.solve`; adding_up: of `Normal.adding_up`, for
    direct light (measured on a ground plane at strength 0.001: none leaves light 4 % too dark, 3 0.7 %, 20 0.5 %);
    most: share of all elements that may be asked for, dense vertices are left out beyond it; samples_stand: whether
    samples of sparse vertices stand in the result, False to see what weaving alone does; seed: of the random
    choice."""

    dense: float = 0.25
    rounds: int = 5
    features: float = 350 / 6144
    radius: float = 0.035
    neighbours: int = 32
    normals: float = 1.0
    method: sparse_weights.Method = "l1"
    strength: float = sparse_weights.STRENGTH
    adding_up: float = 8.0
    most: float = 1.0
    samples_stand: bool = True
    seed: int = 0

    def __post_init__(self) -> None:
        """Raises BadArguments where a setting makes no sense."""
        for name in ("dense", "features", "most"):
            value = getattr(self, name)
            if not 0.0 < value <= 1.0:
                raise BadArguments(name, f"{value} is not a share", "Use a number above 0 and up to 1")
        if self.rounds < 1 or self.neighbours < 1:
            raise BadArguments("rounds, neighbours", "there is nothing to do with less than one", "Use 1 or more")
        if not (self.radius > 0.0 and self.strength >= 0.0 and self.normals >= 0.0):
            raise BadArguments("radius, strength, normals", "one of them is negative or no number", "Use 0 or more")


@dataclass(frozen=True)
class SparseTransfer:
    """transfer (columns, receivers) float32, columns first; dense (receivers,) bool; rank (receivers,) int16, the local
    rank that dense vertices were chosen by; dense_elements, sparse_elements: asked for; neighbours: mean number of
    each sparse vertex."""

    transfer: Single
    dense: NDArray[np.bool_]
    rank: NDArray[np.int16]
    dense_elements: int
    sparse_elements: int
    neighbours: float

    @property
    def sampled(self) -> float:
        """Share of all elements that was asked for."""
        return (self.dense_elements + self.sparse_elements) / max(1, self.transfer.size)


@dataclass
class _Scene:
    """Where receivers are. places (n, 6): position in units of the radius and scaled normal; morton: their order;
    dense: vertices sampled so far; rows: room for one of each receiver, of which the first len(dense) are filled."""

    elements: Elements
    settings: SparseSettings
    places: NDArray[np.float64]
    morton: Places
    rows: DenseRows
    dense: Places = field(default_factory=lambda: np.zeros(0, np.int64))

    @staticmethod
    def of(elements: Elements, positions: NDArray[np.float64], normals: NDArray[np.float64],
           settings: SparseSettings, budget: int | None, folder: Path | None) -> _Scene:
        radius = settings.radius * (bounding_diagonal([positions]) or 1.0)
        # Opposite normals are 2 apart.
        places = np.concatenate([positions / radius, normals * (0.5 * settings.normals)], axis=1)
        # Pages of rows that nobody fills are never touched, on the disk neither.
        size = len(elements), elements.columns, budget, folder
        rows = DenseRows(column_array(*size), column_array(*size, bool))
        return _Scene(elements, settings, places, morton_order(positions), rows)

    def add(self, vertices: Places) -> Iterator[None]:
        """Sample more dense vertices, block by block."""
        for start in range(0, len(vertices), BLOCK):
            block = vertices[start:start + BLOCK]
            sample_rows(self.elements, block, self.rows, len(self.dense))
            self.dense = np.concatenate([self.dense, block])
            yield

    def near(self, vertices: Places, count: int) -> tuple[Places, NDArray[np.float64]]:
        """Of each vertex the nearest dense ones (n, count) within the radius, as numbers of rows, and their distances
        in radii; -1 and inf where there are fewer."""
        tree = KDTree(self.places[self.dense])
        distances, found = tree.query(self.places[vertices], k=np.arange(1, count + 1), distance_upper_bound=1.0)
        return np.where(np.isfinite(distances), found, -1), distances


def sparse_transfer(elements: Elements, positions: NDArray[np.float64], normals: NDArray[np.float64],
                    settings: SparseSettings | None = None, budget: int | None = None, folder: Path | None = None,
                    ) -> Generator[float, None, SparseTransfer]:
    """Yield progress, return the transfer of all receivers at positions (n, 3) with normals (n, 3).

    budget, folder: of `column_array`, for the result and for the rows of dense vertices, 5 bytes an element of theirs.
    The same seed gives the same result, whatever the threads.
    """
    settings = settings or SparseSettings()
    edge_of(elements.columns)
    scene = _Scene.of(elements, positions, normals, settings, budget, folder)
    asked = elements.asked
    rank = np.ones(len(elements), np.int16)
    most = max(1.0, settings.dense * len(elements))
    for number in range(settings.rounds):
        chosen = _next_dense(scene, rank, number)
        for _ in scene.add(chosen):
            yield 0.5 * min(1.0, len(scene.dense) / most)
        if len(chosen):
            rank = _local_ranks(scene)
    for _ in _add_lonely(scene):
        yield 0.5
    dense_elements = elements.asked - asked
    result = column_array(elements.columns, len(elements), budget, folder)
    for start in range(0, len(scene.dense), VERTICES):
        part = scene.dense[start:start + VERTICES]
        result[:, part] = (scene.rows.values[start:start + len(part)] * elements.factor(part)).T
    is_dense = np.zeros(len(elements), bool)
    is_dense[scene.dense] = True
    sparse = scene.morton[~is_dense[scene.morton]]
    used = 0
    for start in range(0, len(sparse), VERTICES):
        part = sparse[start:start + VERTICES]
        values, number = _reconstruct(scene, part)
        used += number
        values *= elements.factor(part)
        result[:, part] = values.T
        yield 0.5 + 0.5 * (start + len(part)) / len(sparse)
    return SparseTransfer(result, is_dense, rank, dense_elements, elements.asked - asked - dense_elements,
                          used / max(1, len(sparse)))


def _next_dense(scene: _Scene, rank: NDArray[np.int16], number: int) -> Places:
    """The dense vertices of a round, in Morton order: drawn with probabilities proportional to the rank, evenly along
    the Morton curve, so that they don't clump."""
    settings, count = scene.settings, len(scene.elements)
    wanted = round(settings.dense * count * (number + 1) / settings.rounds) - len(scene.dense)
    wanted = max(wanted, 1 if number == 0 and count else 0)
    if len(scene.dense) and settings.most < 1.0:  # what a dense vertex has cost so far against what is left
        cost = scene.elements.asked / len(scene.dense)
        rest = settings.features * scene.elements.columns
        affordable = (settings.most * count * scene.elements.columns - rest * count) / max(cost - rest, 1.0)
        wanted = min(wanted, int(affordable) - len(scene.dense))
    free = np.ones(count, bool)
    free[scene.dense] = False
    order = scene.morton[free[scene.morton]]
    wanted = min(wanted, len(order))
    if wanted <= 0:
        return np.zeros(0, np.int64)
    shares = np.cumsum(rank[order], dtype=np.float64)
    offset = np.random.default_rng((settings.seed, number)).random()
    steps = (np.arange(wanted) + offset) * (shares[-1] / wanted)
    return order[np.unique(np.minimum(np.searchsorted(shares, steps), len(order) - 1))]


def _local_ranks(scene: _Scene) -> NDArray[np.int16]:
    """Local rank (receivers,) of the transport (section 4.1): of each dense vertex that of the matrix of its dense
    neighbours' first-pass samples; of every other vertex its nearest dense one's."""
    order = np.argsort(np.argsort(scene.morton)[scene.dense])
    found, _ = scene.near(scene.dense, RANK_NEIGHBOURS)
    grid = quarter_grid(edge_of(scene.elements.columns))
    ranks = np.ones(len(scene.dense), np.int16)
    for start in range(0, len(order), GROUP):
        group = order[start:start + GROUP]
        rows, local = _local(found[group])
        gram = np.zeros((len(rows) + 1, len(rows) + 1))
        block = scene.rows.values[rows][:, grid]
        gram[:-1, :-1] = multiply(block, block.T)
        # The empty slot's number is the last row, of zeros.
        values = gram[local[:, :, None], local[:, None, :]]
        ranks[group] = _ranks(values)
    _, nearest = KDTree(scene.places[scene.dense]).query(scene.places)
    return ranks[nearest]


def _ranks(gram: NDArray[np.float64]) -> NDArray[np.int64]:
    """How many directions hold RANK_ENERGY of the squares of matrices with Gram matrices (n, k, k); at least one."""
    squares = np.maximum(sparse_weights.eigenvalues(gram), 0.0)
    held = np.cumsum(squares, axis=1)
    return np.maximum(1, np.count_nonzero(held < RANK_ENERGY * held[:, -1:], axis=1) + (held[:, -1] > 0.0))


def _local(found: Places) -> tuple[Places, Places]:
    """The rows (u,) that vertices (n, k) have as neighbours, and each neighbour's place among them; u for none."""
    rows = np.unique(found)
    rows = rows[rows >= 0]
    return rows, np.where(found >= 0, np.searchsorted(rows, found), len(rows))


def _add_lonely(scene: _Scene) -> Iterator[None]:
    """Sample vertices without any dense neighbour as dense ones: nothing could be woven from nothing."""
    free = np.ones(len(scene.elements), bool)
    free[scene.dense] = False
    vertices = scene.morton[free[scene.morton]]
    while len(vertices):
        lonely = vertices[scene.near(vertices, 1)[0][:, 0] < 0]
        if not len(lonely):
            return
        # One in several, since lonely vertices may be each other's neighbours.
        yield from scene.add(lonely[::4])
        vertices = np.setdiff1d(lonely, lonely[::4])


def _reconstruct(scene: _Scene, vertices: Places) -> tuple[Single, int]:
    """Values (n, columns) of sparse vertices and how many neighbours they have together."""
    settings, elements = scene.settings, scene.elements
    found, distances = scene.near(vertices, settings.neighbours)
    used = np.flatnonzero((found >= 0).any(axis=0))
    found, distances = found[:, used], distances[:, used]
    unknown = elements.unknown(vertices)
    count = max(1, round(settings.features * elements.columns))
    chosen, worth = _features(scene, found, unknown, count)
    samples = np.zeros(chosen.shape, np.float32)
    if settings.method != "radius":
        row, place = np.nonzero(worth)
        order = np.argsort(chosen[row, place], kind="stable")
        row, place = row[order], place[order]
        samples[row, place] = elements.evaluate(vertices[row], chosen[row, place])
    weights = _weights(scene, found, distances, chosen, worth, samples)
    values = np.empty(unknown.shape, np.float32)
    for start in range(0, len(vertices), GROUP):
        part = slice(start, start + GROUP)
        rows, local = _local(found[part])
        spread = np.zeros((len(local), len(rows) + 1), np.float32)
        np.put_along_axis(spread, local, weights[part].astype(np.float32), axis=1)
        multiply(np.ascontiguousarray(spread[:, :-1]), scene.rows.values[rows], out=values[part])
    np.clip(values, 0.0, elements.highest, out=values)
    row, place = np.nonzero(worth)
    if settings.method != "radius" and settings.samples_stand:
        values[row, chosen[row, place]] = samples[row, place]
    return values, int(np.count_nonzero(found >= 0))


def _features(scene: _Scene, found: Places, unknown: NDArray[np.bool_], count: int,
              ) -> tuple[Places, NDArray[np.bool_]]:
    """Directions (n, count) worth a sample at each vertex, by the variance among its dense neighbours times the number
    of those that have a feature there (section 5.2), and which of them are worth anything."""
    candidates = np.arange(unknown.shape[1])
    if not scene.elements.angular:  # elsewhere even dense vertices are interpolated
        candidates = quarter_grid(edge_of(len(candidates)))
    count = min(count, len(candidates))
    chosen = np.empty((len(found), count), np.int64)
    worth = np.empty((len(found), count), bool)
    for start in range(0, len(found), GROUP):
        part = slice(start, start + GROUP)
        rows, local = _local(found[part])
        features = scene.rows.features[rows]
        some = candidates[features.any(axis=0)[candidates]]
        if len(some) < count:
            some = np.concatenate([some, np.setdiff1d(candidates, some)[:count - len(some)]])
        values = scene.rows.values[np.ix_(rows, some)]
        share = np.zeros((len(local), len(rows) + 1), np.float32)
        np.put_along_axis(share, local, np.float32(1.0), axis=1)
        share = np.ascontiguousarray(share[:, :-1])
        number = np.maximum(share.sum(axis=1, keepdims=True), 1.0)
        mean = multiply(share, values) / number
        variance = np.maximum(multiply(share, values * values) / number - mean * mean, 0.0)
        variance[variance < 1e-6 * (mean * mean)] = 0.0  # rounding
        weight = variance * multiply(share, features[:, some].astype(np.float32)) * unknown[part][:, some]
        best = np.argpartition(-weight, count - 1, axis=1)[:, :count] if count < len(some) else \
            np.broadcast_to(np.arange(count), (len(local), count))
        chosen[part] = some[best]
        worth[part] = np.take_along_axis(weight, best, axis=1) > 0.0
    return chosen, worth


def _weights(scene: _Scene, found: Places, distances: NDArray[np.float64], chosen: Places, worth: NDArray[np.bool_],
             samples: Single) -> NDArray[np.float64]:
    """Weights (n, k) of neighbours; of vertices without any direction worth a sample, whose neighbours are all alike,
    those by distance."""
    weights = sparse_weights.by_distance(distances, 1.0)
    if scene.settings.method == "radius":
        return weights
    for start in range(0, len(found), GROUP):
        part = slice(start, start + GROUP)
        rows, local = _local(found[part])
        values = np.concatenate([scene.rows.values[rows], np.zeros((1, scene.elements.columns), np.float32)])
        features = values[local[:, :, None], chosen[part][:, None, :]]
        features *= worth[part][:, None, :]
        normal = Normal.of(features, samples[part])
        if scene.elements.angular:  # indirect light may be brighter than all neighbours'
            normal = normal.adding_up(scene.settings.adding_up)
        solved = sparse_weights.solve(normal, scene.settings.strength) if scene.settings.method == "l1" else \
            sparse_weights.least_squares(normal)
        told = worth[part].any(axis=1)
        weights[part][told] = solved[told]
    return weights
