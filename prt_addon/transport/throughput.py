# SPDX-License-Identifier: GPL-3.0-or-later
"""Throughput factors of subsurface light as rows of a sparse matrix (Carr et al. 2003, eq. 10): which nodes of the
tree a place takes (Jensen & Buhler 2002), and the mean of R_d over each node.

Near field. A sample stands for a disc of its area. Near ones are integrated over their disc. Discs overlap and leave
gaps where cells meet without, and R_d has a peak, so near sums come out too bright by percents where the mean free path
is a third of the spacing, and by any factor where samples crowd. But surface without overlaps gives at most what a
round disc of the same area gives (R_d falls with distance), in closed form: the near samples that face as the place
does, itself among them, are scaled down to that, and those that face the other way (the back of a sheet) apart.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..basis.directions import tangent_frames
from .dipole import (
    Medium,
    Poles,
    diffuse_reflectance,
    disc_integral,
    mean_reflectance,
    slope_and_curvature,
)
from .sample_tree import COLUMNS, ROWS, SampleTree

# Places that share their list of nodes.
GROUP = 32
# Discs whose radius is more than this share of their distance (depth included) are integrated; beyond, R_d's mean to
# second order is within (225/192) (1/3)^4 = 1.5 % of the disc's (R_d falling as r^-3).
NEAR = 1.0 / 3.0
# Points closer than this share of the object's size are one place (the corners of a vertex that a sharp edge splits).
SAME_PLACE = 1e-7
# A rule of degree 5 over the unit disc: its middle with weight 1/4, six points at radius sqrt(2/3) with 1/8 each
# (Abramowitz & Stegun 1964, 25.4.61).
RULE_RADIUS, RULE_MIDDLE, RULE_RING = np.sqrt(2.0 / 3.0), 0.25, 0.125


@dataclass(frozen=True)
class Places:
    """Distinct positions of receivers, lengths in units of the object's size.

    of: (r,) the place of each receiver, in the tree's order; areas: (r,) of the receivers; tree: over the places;
    frames: (p, 3, 3) tangent, bitangent and normal of their discs; kernels: the distinct ones among the channels;
    kernel_of: the kernel of each of the 3 channels; where (c, 3), sizes (c,), covariance (c, 6): of the matrix's
    columns, that is samples and then nodes: centre, area, and covariance of the surface about the centre.
    """

    of: NDArray[np.int64]
    areas: NDArray[np.float64]
    tree: SampleTree
    frames: NDArray[np.float64]
    kernels: tuple[Poles, ...]
    kernel_of: tuple[int, ...]
    where: NDArray[np.float64]
    sizes: NDArray[np.float64]
    covariance: NDArray[np.float32]

    @staticmethod
    def of_receivers(points: NDArray[np.float64], normals: NDArray[np.float64], areas: NDArray[np.float64],
                     medium: Medium) -> Places:
        """points (r, 3) metres, unit normals (r, 3), areas (r,) square metres; at least one receiver."""
        low, high = points.min(axis=0), points.max(axis=0)
        # A single point has no extent: any length near its disc's will do.
        size = float(np.sqrt(np.sum((high - low) ** 2))) or float(np.sqrt(areas.sum())) or 1.0
        located = (points - low) / size
        cell = np.rint(located / SAME_PLACE).astype(np.int64)
        _, chosen, place = np.unique(cell, axis=0, return_index=True, return_inverse=True)
        place = place.reshape(-1)
        together = np.bincount(place, weights=areas / size**2)
        towards = np.stack([np.bincount(place, weights=areas * normals[:, axis]) for axis in range(3)], axis=1)
        length = np.sqrt(np.sum(towards**2, axis=1, keepdims=True))
        # Opposite sides at one place cancel; any disc through it is as good as another.
        towards = np.where(length > 1e-6 * length.max(), towards / np.maximum(length, np.finfo(np.float64).tiny),
                           normals[chosen])
        # A disc of area A has the variance A / 4pi along each of its tangents.
        flat = np.eye(3)[ROWS, COLUMNS] - towards[:, ROWS] * towards[:, COLUMNS]
        tree = SampleTree.over(located[chosen], together, together[:, None] / (4.0 * np.pi) * flat)
        position = np.empty_like(tree.order)
        position[tree.order] = np.arange(len(position))
        poles = [medium.poles(channel, size) for channel in range(3)]
        kernels = tuple(dict.fromkeys(poles))
        frames = tangent_frames(towards)[tree.order]
        discs = tree.areas[:, None] / (4.0 * np.pi) * flat[tree.order]
        return Places(position[place], areas / size**2, tree, frames, kernels, tuple(kernels.index(p) for p in poles),
                      np.concatenate([tree.points, tree.centre]), tree.summed(tree.areas),
                      np.concatenate([discs, tree.covariance]).astype(np.float32))


@dataclass(frozen=True)
class Links:
    """Some rows: a CSR pattern over samples and nodes, and per kernel the mean of R_d over each.

    A place has no link to itself. own: (rows, k) what is left of its own disc, see above.
    """

    rows: NDArray[np.int64]
    indptr: NDArray[np.int64]
    indices: NDArray[np.int32]
    values: list[NDArray[np.float32]]
    own: NDArray[np.float64]


def linked(places: Places, groups: NDArray[np.int64], tolerance: float) -> tuple[list[Links], NDArray[np.float64]]:
    """The rows of some groups (nodes of one level of the tree), and the error bound (groups,) of each group's rows
    for values of at most 1.

    Places of a group take the same nodes, so there is one `Links` with the first place of every group, one with the
    second and so on, all with one pattern.
    """
    tree = places.tree
    group, node, bound = _accepted(places, groups, tolerance)
    order = np.argsort(group, kind="stable")
    group, node = group[order], node[order]
    indices = np.where(tree.count[node] == 1, tree.first[node], len(tree.points) + node).astype(np.int32)
    indptr = np.concatenate([[0], np.cumsum(np.bincount(group, minlength=len(groups)))])
    columns = _Columns.of(places, group, indices)
    first, size = tree.first[groups], tree.count[groups]
    rows = [first + np.minimum(turn, size - 1) for turn in range(size.max())]
    return [Links(r, indptr, indices, *columns.values(r)) for r in rows], bound


def fully_linked(places: Places, rows: NDArray[np.int64]) -> Links:
    """Rows without a hierarchy: every sample on its own."""
    number = len(places.tree.points)
    indices = np.tile(np.arange(number, dtype=np.int32), len(rows))
    columns = _Columns.of(places, np.repeat(np.arange(len(rows)), number), indices)
    return Links(rows, np.arange(len(rows) + 1) * number, indices, *columns.values(rows))


def _accepted(places: Places, groups: NDArray[np.int64], tolerance: float,
              ) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64]]:
    """Pairs (index of the group, node) that make up each group's sum, and the error bound (groups,) of its rows.

    All pairs of a level at once; what is not accepted is replaced by its two children.
    """
    tree = places.tree
    group, node = np.arange(len(groups)), np.zeros(len(groups), np.int64)
    bound = np.zeros((len(places.kernels), len(groups)))
    taken: list[tuple[NDArray[np.int64], NDArray[np.int64]]] = []
    while len(node):
        single = tree.count[node] == 1
        taken.append((group[single], node[single]))
        group, node = group[~single], node[~single]
        enough, error = _judged(places, groups[group], node, tolerance)
        taken.append((group[enough], node[enough]))
        for kernel in range(len(bound)):
            bound[kernel] += np.bincount(group[enough], error[kernel, enough], len(groups))
        group, node = np.repeat(group[~enough], 2), np.repeat(node[~enough] * 2 + 1, 2)
        node[1::2] += 1
    return np.concatenate([t[0] for t in taken]), np.concatenate([t[1] for t in taken]), bound.max(axis=0)


def _judged(places: Places, group: NDArray[np.int64], node: NDArray[np.int64], tolerance: float,
            ) -> tuple[NDArray[np.bool_], NDArray[np.float64]]:
    """Which of n nodes are good enough for the places of a group, and the bound (k, n) of their error.

    With s^2 the surface's variance, light of a node taken at its centre instead of at y is wrong by at most
    |y - centre| (mean at most s) times R_d's steepest slope, and the second-order term adds at most half the largest
    curvature times s^2; times the node's area this bounds the error for any light of at most 1. Every node is allowed
    the same, so that a link more buys about as much wherever it is added: small nodes near the place, one for the
    whole body where light no longer reaches. (On the Buddha half the links of allowing a share of what each node
    gives, at the same error.)
    """
    tree, number = places.tree, len(places.tree.points)
    apart = tree.centre[node] - tree.centre[group]
    distance = np.sqrt(np.sum(apart * apart, axis=1))
    nearest = np.maximum(distance - tree.reach[group] - tree.extent[node], 0.0)
    variance, area = np.sum(tree.covariance[node, :3], axis=1), places.sizes[number + node]
    spread, whole = np.sqrt(variance), tree.areas.sum()
    # A place's own disc is a matter of the receiver (subsurface.py), so no node that holds one of the group is taken.
    enough = (tree.first[node] >= tree.first[group] + tree.count[group]) | (
        tree.first[group] >= tree.first[node] + tree.count[node])
    error = np.empty((len(places.kernels), len(node)))
    for index, poles in enumerate(places.kernels):
        slope, curvature = slope_and_curvature(poles, nearest)
        error[index] = area * (slope * spread + 0.5 * curvature * variance)
        # No surface of this area gives more than a disc of it, which is R unless the body is smaller than the depth.
        enough &= error[index] <= tolerance * float(disc_integral(poles, whole / np.pi))
    return enough, error


@dataclass(frozen=True)
class _Columns:
    """The columns of n links of some rows, gathered once. row: (n,) index of the row; column: (n,); where (3, n),
    covariance (6, n) float32, about `origin` so that single precision resolves what is near; limit: (n,) see NEAR."""

    places: Places
    row: NDArray[np.int64]
    column: NDArray[np.int32]
    origin: NDArray[np.float64]
    where: NDArray[np.float32]
    covariance: NDArray[np.float32]
    spread: NDArray[np.float32]
    limit: NDArray[np.float32]

    @staticmethod
    def of(places: Places, row: NDArray[np.int64], column: NDArray[np.int32]) -> _Columns:
        number = len(places.tree.points)
        # The largest squared distance, depth included, at which a disc is near. Nodes have no disc, and a place
        # without an area gives nothing.
        limit = np.zeros(len(places.sizes), np.float32)
        limit[:number] = places.tree.areas / (np.pi * NEAR * NEAR)
        limit[:number] -= min(poles.real for poles in places.kernels) ** 2
        origin = places.where[column[0]]
        where = (places.where - origin).astype(np.float32)
        covariance = np.ascontiguousarray(places.covariance[column].T)
        return _Columns(places, row, column, origin, np.ascontiguousarray(where[column].T), covariance,
                        covariance[:3].sum(axis=0), limit[column])

    def values(self, rows: NDArray[np.int64]) -> tuple[list[NDArray[np.float32]], NDArray[np.float64]]:
        """The mean of R_d over every column, per kernel, 0 for a row's own place; and `own` of Links."""
        position = (self.places.tree.points[rows] - self.origin).astype(np.float32)
        x, y, z = (position[self.row, axis] - self.where[axis] for axis in range(3))
        squared = x * x + y * y + z * z
        c = self.covariance
        along = x * (c[0] * x + 2.0 * (c[3] * y + c[4] * z)) + y * (c[1] * y + 2.0 * c[5] * z) + c[2] * z * z
        itself = self.column == rows[self.row]
        near = np.flatnonzero((squared < self.limit) & ~itself)
        field = _NearField.of(self.places, rows, self.row[near], self.column[near])
        values, own = [], np.empty((len(rows), len(self.places.kernels)))
        for kernel, poles in enumerate(self.places.kernels):
            value = mean_reflectance(poles, squared, self.spread, along)
            value[itself] = 0.0
            value[near], own[:, kernel] = field.values(poles)
            values.append(value)
        return values, own


@dataclass(frozen=True)
class _NearField:
    """n near pairs of some rows. row: (n,); area, facing: (n,) of the other disc; own: (rows,) areas of the places;
    squared: (7, n) float32 distances from the place to the rule's points on the other disc, the middle first."""

    row: NDArray[np.int64]
    area: NDArray[np.float64]
    facing: NDArray[np.bool_]
    own: NDArray[np.float64]
    squared: NDArray[np.float32]

    @staticmethod
    def of(places: Places, rows: NDArray[np.int64], row: NDArray[np.int64], column: NDArray[np.int32]) -> _NearField:
        tree, place = places.tree, rows[row]
        apart = tree.points[column] - tree.points[place]
        frames = places.frames[column]
        facing = np.sum(frames[:, 2] * places.frames[place, 2], axis=1) >= 0.0
        radius = RULE_RADIUS * np.sqrt(tree.areas[column] / np.pi)
        along = [2.0 * radius * np.sum(apart * frames[:, axis], axis=1) for axis in range(2)]
        squared = np.empty((7, len(row)), np.float32)
        squared[0] = middle = np.sum(apart * apart, axis=1)
        for index in range(6):
            angle = np.pi / 3.0 * index
            # Rounding must not make a squared distance negative.
            squared[index + 1] = np.maximum(
                middle + radius**2 + np.cos(angle) * along[0] + np.sin(angle) * along[1], 0.0)
        return _NearField(row, tree.areas[column], facing, tree.areas[rows], squared)

    def values(self, poles: Poles) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """The mean of R_d over each disc (n,), and what is left of the places' own discs (rows,)."""
        at = diffuse_reflectance(poles, self.squared)
        mean = RULE_MIDDLE * at[0] + RULE_RING * at[1:].sum(axis=0, dtype=np.float64)
        # One disc alone gives at most what it would around the place.
        mean = np.minimum(mean, disc_integral(poles, self.area / np.pi) / self.area)
        front = self._left(poles, mean, self.facing, self.own)
        back = self._left(poles, mean, ~self.facing, np.zeros_like(self.own))
        return mean * np.where(self.facing, front[self.row], back[self.row]), front

    def _left(self, poles: Poles, mean: NDArray[np.float64], chosen: NDArray[np.bool_], own: NDArray[np.float64],
              ) -> NDArray[np.float64]:
        """The factor (rows,), at most 1, that brings the chosen discs and the own one down to a round disc's light."""
        row, area = self.row[chosen], self.area[chosen]
        total = np.bincount(row, area * mean[chosen], len(own)) + disc_integral(poles, own / np.pi)
        largest = disc_integral(poles, (np.bincount(row, area, len(own)) + own) / np.pi)
        return np.divide(largest, total, out=np.ones_like(own), where=total > largest)
