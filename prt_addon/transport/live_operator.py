# SPDX-License-Identifier: GPL-3.0-or-later
"""The form factors that live editing keeps: the gather operator cut to a bounded size and put in the order of points.

Rows hold some 200 to 400 entries, the corners of what 128 rays met. Of each row as many samples as may be stored are
taken at equal steps of its running sum: entries lie along a Morton curve, so that a sample stands for a piece of
neighbouring surface, and the row's sum stays what it was: no light is made or lost.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from ..linear_algebra import sparse_multiply

BYTES_PER_ENTRY = 8  # a column and a value


@dataclass(frozen=True)
class LiveOperator:
    """n receivers: the points of the baked objects, object after object, then whatever else these see.

    matrix: (n, n) float32 form factors, row = receiver that gathers; albedo: (n, 3) float32, what each sent back of the
    light when it was baked; share: (n,) float32, of its diffuse layer that the layers above leave.
    """

    matrix: sparse.csr_matrix
    albedo: NDArray[np.float32]
    share: NDArray[np.float32]

    def arrays(self) -> dict[str, NDArray]:
        """Flat arrays, from which `of_arrays` makes it again."""
        return {"counts": np.diff(self.matrix.indptr).astype(np.int32),
                "indices": self.matrix.indices.astype(np.int32), "values": self.matrix.data.astype(np.float32),
                "surfaces": np.concatenate([self.albedo, self.share[:, None]], axis=1).astype(np.float32).ravel()}

    @staticmethod
    def of_arrays(arrays: dict[str, NDArray]) -> LiveOperator:
        """Of what `arrays` gave. Raises ValueError where it can't be that."""
        counts, indices = (np.asarray(arrays[name], np.int64) for name in ("counts", "indices"))
        values, surfaces = (np.asarray(arrays[name], np.float32) for name in ("values", "surfaces"))
        size = len(counts)
        if counts.min(initial=0) < 0 or counts.sum() != len(indices) or len(values) != len(indices) \
                or len(surfaces) != 4 * size:
            raise ValueError("its arrays do not belong together")
        if len(indices) and not (indices.min() >= 0 and indices.max() < size):
            raise ValueError("a receiver's number is out of range")
        if not (np.isfinite(values).all() and np.isfinite(surfaces).all()):
            raise ValueError("it holds values that are not finite")
        starts = np.concatenate([[0], np.cumsum(counts)]).astype(np.int32)
        surfaces = surfaces.reshape(size, 4)
        matrix = sparse.csr_matrix((values, indices.astype(np.int32), starts), shape=(size, size))
        return LiveOperator(matrix, np.ascontiguousarray(surfaces[:, :3]), np.ascontiguousarray(surfaces[:, 3]))

    @property
    def bytes(self) -> int:
        """What it takes to store."""
        return BYTES_PER_ENTRY * self.matrix.nnz + 20 * len(self.albedo)


def sampled_rows(matrix: sparse.csr_matrix, most: int) -> sparse.csr_matrix:
    """The matrix (r, r) float32 with at most `most` entries in each row, whose sums stay; rows with fewer stay whole.

    Columns lie in an order in which neighbours are near to each other.
    """
    counts = np.diff(matrix.indptr)
    long = counts > most
    if not long.any():
        return matrix
    matrix = matrix.sorted_indices()
    running = np.concatenate([[0.0], np.cumsum(matrix.data, dtype=np.float64)])
    start, end = matrix.indptr[:-1][long], matrix.indptr[1:][long]
    low, high = running[start], running[end]
    places = low[:, None] + ((np.arange(most) + 0.5) / most) * (high - low)[:, None]
    found = np.searchsorted(running, places.ravel(), side="right") - 1
    found = np.clip(found, np.repeat(start, most), np.repeat(end, most) - 1)
    keep = np.repeat(~long, counts)
    rows = np.concatenate([np.repeat(np.flatnonzero(long), most), np.repeat(np.arange(len(counts)), counts)[keep]])
    columns = np.concatenate([matrix.indices[found], matrix.indices[keep]])
    values = np.concatenate([np.repeat((high - low) / most, most), matrix.data[keep]]).astype(np.float32)
    return sparse.coo_matrix((values, (rows, columns)), matrix.shape).tocsr()


def sampling_error(matrix: sparse.csr_matrix, sampled: sparse.csr_matrix, radiosity: NDArray[np.floating]) -> float:
    """Relative RMS of the light gathered from a radiosity (r, channels) by the sampled rows, against all entries."""
    exact = sparse_multiply(matrix, radiosity)
    wrong = sparse_multiply(sampled, radiosity) - exact
    size = float(np.sum(np.square(exact, dtype=np.float64)))
    return float(np.sqrt(np.sum(np.square(wrong, dtype=np.float64)) / size)) if size > 0.0 else 0.0


def in_order_of_points(matrix: sparse.csr_matrix, key: NDArray[np.int64], points: NDArray[np.int64],
                       count: int) -> tuple[sparse.csr_matrix, NDArray[np.int64]]:
    """The matrix with the fronts of `points` first, whether they are receivers or not, then all other receivers.

    key: (r,) of the matrix's receivers, point + side * count. Returns the matrix (n, n) and the keys (n,) of its rows;
    points that are no receivers have empty rows.
    """
    position = np.full(2 * count, -1, np.int64)
    position[points] = np.arange(len(points))
    others = position[key] < 0
    position[key[others]] = len(points) + np.arange(int(others.sum()))
    entries = matrix.tocoo()
    place = position[key]
    keys = np.concatenate([points, key[others]])
    size = (len(keys), len(keys))
    return sparse.coo_matrix((entries.data, (place[entries.row], place[entries.col])), size).tocsr(), keys
