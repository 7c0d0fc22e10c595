# SPDX-License-Identifier: GPL-3.0-or-later
"""The form factors that live editing keeps: the gather operator cut to a bounded size and put in the order of points.

Rows hold some 200 to 400 entries, the corners of what 128 rays met. Of each row as many samples as may be stored are
taken at equal steps of its running sum: entries lie along a Morton curve, so that a sample stands for a piece of
neighbouring surface, and the row's sum stays what it was to the last digit: no light is made or lost.
"""

from __future__ import annotations

import numpy as np
from scipy import sparse


def sampled_rows(matrix: sparse.csr_matrix, most: int) -> sparse.csr_matrix:
    """The matrix (r, r) float32 with at most `most` entries in each row, whose sums stay; rows with fewer stay whole.

    columns lie in an order in which neighbours are near to each other.
    """
    counts = np.diff(matrix.indptr)
    long = counts > most
    if not long.any():
        return matrix
    matrix = matrix.sorted_indices()
    running = np.concatenate([[0.0], np.cumsum(matrix.data, dtype=np.float64)])
    start, end = matrix.indptr[:-1][long], matrix.indptr[1:][long]
    low, high = running[start], running[end]
    steps = (np.arange(most) + 0.5) / most
    places = low[:, None] + steps * (high - low)[:, None]
    found = np.searchsorted(running, places.ravel(), side="right") - 1
    found = np.clip(found, np.repeat(start, most), np.repeat(end, most) - 1)
    values = np.repeat((high - low) / most, most)
    keep = np.repeat(~long, counts)
    rows = np.concatenate([np.repeat(np.flatnonzero(long), most), np.repeat(np.arange(len(counts)), counts)[keep]])
    columns = np.concatenate([matrix.indices[found], matrix.indices[keep]])
    data = np.concatenate([values, matrix.data[keep]]).astype(np.float32)
    return sparse.coo_matrix((data, (rows, columns)), matrix.shape).tocsr()
