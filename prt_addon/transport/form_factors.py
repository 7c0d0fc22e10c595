# SPDX-License-Identifier: GPL-3.0-or-later
"""Form factors between receivers, as the gather operator holds them, and what is to be known before solving with them.

F[p, q] is the share of p's cosine-weighted hemisphere that shows the surface at q: the form factor from a point to
the patch around q (Carr et al. 2003, equation 1, with receivers for patches). One matrix serves all channels, as
reflectance is kept apart from it: that is what lets a material's colour change without another ray.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from ..errors import BadScene
from ..linear_algebra import sparse_multiply, sparse_multiply_few
from ..scene.scene_mesh import SceneMesh

# A receiver loses light where less than 1 - LEAST_LOSS of it comes back: below, single precision can't tell.
LEAST_LOSS = 1e-6
RADIUS_STEPS = 12  # products of the power iteration; each one's ratio bounds the next


def receiver_areas(scene: SceneMesh) -> NDArray[np.float64]:
    """(p,) m^2: of each point a third of its triangles."""
    corners = scene.points[scene.triangles]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = 0.5 * np.sqrt(np.sum(normal ** 2, axis=1))
    return np.bincount(scene.triangles.ravel(), np.repeat(area / 3.0, 3), len(scene.points))


def form_factor(matrix: sparse.csr_matrix, areas: NDArray[np.float64], start: NDArray[np.bool_],
                end: NDArray[np.bool_]) -> float:
    """The form factor from one surface to another: share of the light leaving `start` that arrives at `end`.

    areas, start, end: (r,) of the operator's receivers; start and end say which lie on the surfaces.
    """
    seen = sparse_multiply(matrix, end.astype(np.float64))
    return float(np.sum(areas[start] * seen[start]) / np.sum(areas[start]))


def row_sums(matrix: sparse.csr_matrix) -> NDArray[np.float64]:
    """(r,) share of each receiver's hemisphere that shows surfaces: 1 in a closed room."""
    return np.asarray(matrix.sum(axis=1, dtype=np.float64)).ravel()


def radius_bound(matrix: sparse.csr_matrix, albedo: NDArray[np.floating],
                 sums: NDArray[np.float64] | None = None) -> float:
    """An upper bound of the spectral radius of rho F: the largest share of light that a receiver sends back. sums: of
    the rows, where they are known."""
    return float(((row_sums(matrix) if sums is None else sums)[:, None] * albedo).max(initial=0.0))


def spectral_radius(matrix: sparse.csr_matrix, albedo: NDArray[np.floating], steps: int = RADIUS_STEPS) -> float:
    """An estimate of the spectral radius of rho F, by power iteration in all channels at once.

    Light dies out with a bounce by this factor. From below; of disconnected rooms the slowest counts, as each has its
    own share of the start.
    """
    values = np.ones(albedo.shape, matrix.dtype)
    rho, estimate = albedo.astype(matrix.dtype), 0.0
    for _ in range(steps):
        following = rho * sparse_multiply_few(matrix, values)
        size = np.sqrt(np.sum(np.square(following, dtype=np.float64), axis=0))
        before = np.sqrt(np.sum(np.square(values, dtype=np.float64), axis=0))
        estimate = float((size / np.maximum(before, 1e-300)).max(initial=0.0))
        if not size.any():
            return 0.0
        values = (following / np.maximum(size, 1e-300)).astype(matrix.dtype)
    return min(estimate, radius_bound(matrix, albedo))


def check_exits(matrix: sparse.csr_matrix, albedo: NDArray[np.floating],
                sums: NDArray[np.float64] | None = None) -> None:
    """Raise BadScene where light is caught for ever: among surfaces that reflect all of it and see nothing else.

    An albedo of 1 is harmless where the light finds a way to the sky or to a darker surface, however far. sums: of
    the rows, where they are known.
    """
    sums = row_sums(matrix) if sums is None else sums
    sent = sums[:, None] * albedo
    if float(sent.max(initial=0.0)) < 1.0 - LEAST_LOSS:
        return
    pattern = sparse.csr_matrix((np.ones_like(matrix.data), matrix.indices, matrix.indptr), matrix.shape)
    for channel in range(albedo.shape[1]):
        escapes = sent[:, channel] < 1.0 - LEAST_LOSS
        while True:  # as many steps as the light's longest way out has bounces
            reached = escapes | (sparse_multiply(pattern, escapes.astype(matrix.dtype)) > 0.0)
            if np.array_equal(reached, escapes):
                break
            escapes = reached
        caught = int(np.sum(~escapes))
        if caught:
            raise BadScene("Bounced light", f"{caught} receivers reflect all light and see no way out for it, so it "
                           "would grow without end", "Lower the albedo of that room's materials below 1")
