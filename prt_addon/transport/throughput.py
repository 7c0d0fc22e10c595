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
from .dipole import Medium, Poles, diffuse_reflectance, disc_integral, plane_integral, steepest
from .sample_tree import SampleTree

# Places that share their list of nodes.
GROUP = 8
# Discs whose radius is more than this share of their distance (depth included) are integrated; beyond, the middle of
# the disc is within 9/8 (1/6)^2 = 3 % of R_d's mean, and little light comes from there where that matters (z < radius).
NEAR = 1.0 / 6.0
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
    kernel_of: the kernel of each of the 3 channels; where (3, c), sizes (c,): the matrix's columns, that is samples
    and then nodes, and their areas.
    """

    of: NDArray[np.int64]
    areas: NDArray[np.float64]
    tree: SampleTree
    frames: NDArray[np.float64]
    kernels: tuple[Poles, ...]
    kernel_of: tuple[int, ...]
    where: NDArray[np.float64]
    sizes: NDArray[np.float64]

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
        tree = SampleTree.over(located[chosen], np.bincount(place, weights=areas / size**2))
        towards = np.stack([np.bincount(place, weights=areas * normals[:, axis]) for axis in range(3)], axis=1)
        length = np.sqrt(np.sum(towards**2, axis=1, keepdims=True))
        # Opposite sides at one place cancel; any disc through it is as good as another.
        towards = np.where(length > 1e-6 * length.max(), towards / np.maximum(length, np.finfo(np.float64).tiny),
                           normals[chosen])
        position = np.empty_like(tree.order)
        position[tree.order] = np.arange(len(position))
        poles = [medium.poles(channel, size) for channel in range(3)]
        kernels = tuple(dict.fromkeys(poles))
        where = np.ascontiguousarray(np.concatenate([tree.points, tree.centre]).T)
        return Places(position[place], areas / size**2, tree, tangent_frames(towards)[tree.order], kernels,
                      tuple(kernels.index(p) for p in poles), where, tree.summed(tree.areas))


@dataclass(frozen=True)
class Links:
    """A block of rows: a CSR pattern over samples and nodes, and per kernel the mean of R_d over each.

    A place has no link to itself. own: (rows, k) what is left of its own disc, see above. bound: (rows,) no row's sum
    with values of at most 1 is further off than this.
    """

    rows: NDArray[np.int64]
    indptr: NDArray[np.int64]
    indices: NDArray[np.int32]
    values: list[NDArray[np.float32]]
    own: NDArray[np.float64]
    bound: NDArray[np.float64]


def linked(places: Places, groups: NDArray[np.int64], tolerance: float) -> Links:
    """The rows of some adjacent groups (nodes of one level of the tree)."""
    tree = places.tree
    group, node, bound = _accepted(places, groups, tolerance)
    column = np.where(tree.count[node] == 1, tree.first[node], len(tree.points) + node).astype(np.int32)
    column = column[np.argsort(group, kind="stable")]
    links = np.bincount(group, minlength=len(groups))
    owner = np.repeat(np.arange(len(groups)), tree.count[groups])
    rows = tree.first[groups[0]] + np.arange(len(owner))
    indptr = np.concatenate([[0], np.cumsum(links[owner])])
    shift = (np.cumsum(links) - links)[owner] - indptr[:-1]
    indices = column[np.arange(indptr[-1]) + np.repeat(shift, links[owner])]
    return Links(rows, indptr, indices, *_values(places, rows, indptr, indices), bound[owner])


def fully_linked(places: Places, rows: NDArray[np.int64]) -> Links:
    """Rows without a hierarchy: every sample on its own."""
    number = len(places.tree.points)
    indptr = np.arange(len(rows) + 1) * number
    indices = np.tile(np.arange(number, dtype=np.int32), len(rows))
    return Links(rows, indptr, indices, *_values(places, rows, indptr, indices), np.zeros(len(rows)))


def _accepted(places: Places, groups: NDArray[np.int64], tolerance: float,
              ) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64]]:
    """Pairs (index of the group, node) that make up each group's sum, and the error bound (groups,) of its rows.

    All pairs of a level at once; what is not accepted is replaced by its two children.
    """
    tree, sizes = places.tree, places.sizes[len(places.tree.points):]
    group, node = np.arange(len(groups)), np.zeros(len(groups), np.int64)
    bound = np.zeros((len(places.kernels), len(groups)))
    taken: list[tuple[NDArray[np.int64], NDArray[np.int64]]] = []
    while len(node):
        single = tree.count[node] == 1
        taken.append((group[single], node[single]))
        group, node = group[~single], node[~single]
        error, allowed = _errors(places, groups[group], node, tolerance)
        enough = (error <= allowed).all(axis=0)
        taken.append((group[enough], node[enough]))
        for kernel in range(len(bound)):
            bound[kernel] += np.bincount(group[enough], error[kernel, enough] * sizes[node[enough]], len(groups))
        group, node = np.repeat(group[~enough], 2), np.repeat(node[~enough] * 2 + 1, 2)
        node[1::2] += 1
    return np.concatenate([t[0] for t in taken]), np.concatenate([t[1] for t in taken]), bound.max(axis=0)


def _errors(places: Places, group: NDArray[np.int64], node: NDArray[np.int64], tolerance: float,
            ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Bound of the error of R_d, and what is allowed of it, for n pairs of nodes, per kernel (k, n).

    Light of a node taken at its centre instead of at y is wrong by at most |y - centre| times R_d's steepest slope;
    the mean of |y - centre| is at most the spread. Half of the allowance is in proportion to what the node gives, half
    to its area, so that over all nodes the error is at most tolerance times the half-space's R: small nodes near the
    receiver, one for the whole body where light no longer reaches.
    """
    tree, whole = places.tree, places.sizes[len(places.tree.points)]
    apart = tree.centre[node] - tree.centre[group]
    distance = np.sqrt(np.sum(apart * apart, axis=1))
    nearest = np.maximum(distance - tree.reach[group] - tree.extent[node], 0.0)
    furthest = (distance + tree.reach[group] + tree.extent[node]) ** 2
    error, allowed = np.empty((2, len(places.kernels), len(node)))
    for index, poles in enumerate(places.kernels):
        # A body far smaller than the depth returns far less than R, at most its area times R_d(0).
        floor = min(plane_integral(poles) / whole, float(diffuse_reflectance(poles, np.zeros(1))[0]))
        error[index] = tree.spread[node] * steepest(poles, nearest)
        allowed[index] = 0.5 * tolerance * (diffuse_reflectance(poles, furthest) + floor)
    return error, allowed


def _values(places: Places, rows: NDArray[np.int64], indptr: NDArray[np.int64], indices: NDArray[np.int32],
            ) -> tuple[list[NDArray[np.float32]], NDArray[np.float64]]:
    """The mean of R_d over every column of some rows, per kernel, 0 for a place's own column; and `own` of Links."""
    per_row = np.diff(indptr)
    squared = np.zeros(len(indices))
    for axis in range(3):
        apart = np.repeat(places.where[axis, rows], per_row)
        apart -= np.take(places.where[axis], indices)
        apart *= apart
        squared += apart
    squared = squared.astype(np.float32)
    row = np.repeat(np.arange(len(rows), dtype=np.int32), per_row)
    itself = np.flatnonzero(rows[row] == indices)
    squared[itself] = 1e30  # not near
    near = _near(places, indices, squared)
    field = _NearField.of(places, rows, row[near], indices[near])
    values, own = [], np.empty((len(rows), len(places.kernels)))
    for kernel, poles in enumerate(places.kernels):
        value = diffuse_reflectance(poles, squared)
        value[itself] = 0.0
        value[near], own[:, kernel] = field.values(poles)
        values.append(value)
    return values, own


def _near(places: Places, indices: NDArray[np.int32], squared: NDArray[np.float32]) -> NDArray[np.int64]:
    """The pairs whose disc is large against its distance, see NEAR."""
    number = len(places.tree.points)
    # Nodes have no disc, and a place without an area gives nothing.
    limit = np.zeros(len(places.sizes), np.float32)
    limit[:number] = places.tree.areas / (np.pi * NEAR * NEAR)
    shallowest = min(poles.real for poles in places.kernels)
    return np.flatnonzero(np.take(limit, indices) > squared + np.float32(shallowest**2))


@dataclass(frozen=True)
class _NearField:
    """n near pairs of some rows. row: (n,); area, facing: (n,) of the other disc; own: (rows,) areas of the places;
    squared: (7, n) float32 distances from the place to the rule's points on the other disc, the middle first."""

    row: NDArray[np.int32]
    area: NDArray[np.float64]
    facing: NDArray[np.bool_]
    own: NDArray[np.float64]
    squared: NDArray[np.float32]

    @staticmethod
    def of(places: Places, rows: NDArray[np.int64], row: NDArray[np.int32], column: NDArray[np.int32]) -> _NearField:
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
