# SPDX-License-Identifier: GPL-3.0-or-later
"""The gather operator: which receivers each receiver sees, as one sparse matrix for all coefficients.

G[p, q] is the share of p's cosine-weighted hemisphere that shows the surface at q (a point-to-point form factor), so
one bounce of every lighting column at once is a sparse product (design/performance.md), where path tracing each
element of the transfer would take hours. Receivers are added on demand: a point that nobody sees, and that is no
target, is never traced.
"""

from __future__ import annotations

from collections.abc import Generator, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from ..linear_algebra import multiply
from ..scene.receivers import adjacent_faces
from ..scene.scene_mesh import SceneMesh
from ..tracing.tracer import Hits, Tracer
from .hit_record import HitRecord, HitRecorder, KeptHits
from .receiver_set import Block, ReceiverSet, blocks, facing_cosines, rotated

CHUNK = 16
# Receivers of this many generations are traced for what they see; what the last of them sees beyond is counted as lost.
GENERATIONS = 4
# Back sides of surfaces are followed only if they fill more of the mean target's hemisphere than this. Below, they
# are the few rays that slip into a closed mesh through a self-intersection, and following them would double the work
# to light the inside (Buddha: 0.05 %; bunny, through its holes: 0.2 %). The share is reported.
BACKS_IGNORED = 0.005


@dataclass(frozen=True)
class Gather:
    """matrix: (r, r) float32 CSR over `receivers`, rows sum to the share of the hemisphere that is not sky.

    hit_share: mean share of a target's hemisphere that is not sky; back_share: of it the share showing backs of
    surfaces; lost_share: share of the whole operator that met receivers beyond the last generation or ignored backs
    (treated as black); two_sided: backs were followed. shown: (r,) float32 share of each receiver's hemisphere that
    shows surfaces, whatever becomes of their light: without face shares, lost ones included.
    """

    receivers: ReceiverSet
    matrix: sparse.csr_matrix
    hit_share: float
    back_share: float
    lost_share: float
    two_sided: bool
    hits: HitRecord | None = None
    shown: NDArray[np.float32] | None = None


@dataclass(frozen=True)
class _Task:
    """first: the number of the first direction in the block's; solid_angles: (d,) the quadrature's weights; weights:
    (d, b) the same, normalised for each receiver; face_shares: of the scene; wanted: (b,) bool, whose hits are kept
    (None: nobody's)."""

    block: Block
    first: int
    directions: NDArray[np.float32]
    solid_angles: NDArray[np.float64]
    weights: NDArray[np.float32]
    face_shares: NDArray[np.float32]
    wanted: NDArray[np.bool_] | None
    last_of_block: bool


@dataclass
class _Entries:
    """Entries of a block of rows, before duplicates are summed. shown: (b,) sum of a row without face shares."""

    row: list[NDArray[np.int64]]
    key: list[NDArray[np.int64]]
    value: list[NDArray[np.float32]]
    kept: list[KeptHits]
    shown: NDArray[np.float64] | float = 0.0


def gather_operator(tracer: Tracer, scene: SceneMesh, keys: NDArray[np.int64], directions: NDArray[np.float64],
                    weights: NDArray[np.float64], group: int = 0, seed: int = 0,
                    wanted: NDArray[np.bool_] | None = None) -> Generator[float, None, Gather]:
    """Yield progress, return the operator over the receivers `keys` and all those that they see in turn.

    directions, weights: a quadrature of the sphere; each receiver uses the part in its hemisphere, normalised so that
    the cosine integrates to one (a closed room has row sums of exactly one: no energy is made or lost). wanted:
    (2 * points,) bool by key, whose hits are kept (glossy receivers', for their indirect light).
    """
    recorder = None if wanted is None else HitRecorder(wanted)
    sets: list[ReceiverSet] = []
    rows: list[sparse.csr_matrix] = []
    shown: list[NDArray[np.float32]] = []
    count = len(scene.points)
    known = np.zeros(2 * count, bool)
    new = np.unique(keys)
    hit_share = back_share = 0.0
    for generation in range(GENERATIONS):
        known[new] = True
        receivers = ReceiverSet.of_keys(scene, tracer, new)
        part, filled = yield from _trace(tracer, scene, receivers, directions, weights, group, seed + generation,
                                         generation == 0, recorder)
        sets.append(receivers)
        rows.append(part)
        shown.append(filled)
        seen = np.zeros(len(known), bool)
        seen[part.indices] = True
        if generation == 0:
            hit_share = float(part.data.sum(dtype=np.float64)) / max(1, len(receivers))
            back_share = float(part.data[part.indices >= count].sum(dtype=np.float64)) / max(1, len(receivers))
        if back_share <= BACKS_IGNORED:
            seen[count:] = False
        new = np.flatnonzero(seen & ~known)
        if not len(new):
            break
    receivers = ReceiverSet.joined(sets)
    matrix, lost_share = _square(receivers.key, sparse.vstack(rows, format="csr"))
    return Gather(receivers, matrix, hit_share, back_share, lost_share, back_share > BACKS_IGNORED,
                  None if recorder is None else recorder.result(), np.concatenate(shown))


def _square(key: NDArray[np.int64], wide: sparse.csr_matrix) -> tuple[sparse.csr_matrix, float]:
    """Columns renumbered from keys to receivers; entries that meet no receiver are dropped, their share is returned."""
    number = np.full(wide.shape[1], -1, np.int64)
    number[key] = np.arange(len(key))
    columns = number[wide.indices]
    lost = columns < 0
    total = float(wide.data.sum(dtype=np.float64))
    lost_share = float(wide.data[lost].sum(dtype=np.float64)) / total if total > 0.0 else 0.0
    matrix = sparse.csr_matrix((np.where(lost, np.float32(0.0), wide.data), np.where(lost, 0, columns).astype(np.int32),
                                wide.indptr), shape=(len(key), len(key)))
    matrix.eliminate_zeros()
    return matrix, lost_share


def _trace(tracer: Tracer, scene: SceneMesh, receivers: ReceiverSet, directions: NDArray[np.float64],
           weights: NDArray[np.float64], group: int, seed: int, report: bool, recorder: HitRecorder | None,
           ) -> Generator[float, None, tuple[sparse.csr_matrix, NDArray[np.float32]]]:
    """The operator's rows of these receivers, with keys as columns: (r, 2 points), and their sums `shown`."""
    finished: list[sparse.csr_matrix] = []
    shown = np.zeros(len(receivers), np.float32)
    entries = _Entries([], [], [], [])
    done, total = 0, max(1, len(receivers) * len(directions))

    def trace(task: _Task) -> tuple[_Entries, int]:
        return _hits(tracer, scene, receivers, task)

    wanted = None if recorder is None else recorder.wanted[receivers.key]
    tasks = _tasks(receivers, directions, weights, group, seed, face_shares(scene), wanted)
    for task, (found, rays) in tracer.map_in_order(trace, tasks):
        entries.row += found.row
        entries.key += found.key
        entries.value += found.value
        entries.kept += found.kept
        entries.shown = entries.shown + found.shown
        tracer.rays += rays
        done += (task.block.receivers.stop - task.block.receivers.start) * len(task.directions)
        if task.last_of_block:
            rows = task.block.receivers.stop - task.block.receivers.start
            finished.append(_block_matrix(entries, rows, 2 * len(scene.points)))
            shown[task.block.receivers] = entries.shown
            if recorder is not None:
                turned = rotated(directions, task.block.rotation).astype(np.float32)
                recorder.add_block(task.block, turned, entries.kept)
            entries = _Entries([], [], [], [])
        if report:
            yield done / total
    whole = sparse.vstack(finished, format="csr") if finished else sparse.csr_matrix((0, 2 * len(scene.points)))
    return whole, shown


def face_shares(scene: SceneMesh) -> NDArray[np.float32]:
    """(t, 3) what the surface at a triangle's corner sends back, over the mean of all triangles around that corner.

    A receiver's transfer is the mean over its faces of what each one's own horizon leaves of the hemisphere about the
    shading normal. What is seen of a rough surface is rather the faces that stand out, which their horizons hide less.
    Of a hemisphere's cosine a horizon tilted by b leaves (1 + cos b) / 2 (a lune of the unit disc); the shares' mean
    around a corner, weighted as the receiver weighs its faces, is 1. Without them all bounces on the Buddha lose 3 % of
    their light.
    """
    corners = scene.points[scene.triangles]
    face = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    face /= np.maximum(np.sqrt(np.sum(face ** 2, axis=1, keepdims=True)), np.finfo(np.float64).tiny)
    left = 0.5 * (1.0 + np.sum(scene.normals[scene.triangles] * face[:, None, :], axis=2))
    faces, weights = adjacent_faces(scene.points, scene.triangles, scene.faces)
    mean = np.sum(weights * 0.5 * (1.0 + np.sum(faces * scene.normals[:, None, :], axis=2)), axis=1)
    shares = (left / np.maximum(mean, 1e-3)[scene.triangles]).astype(np.float32)
    if scene.faces is not None:  # a texel has one face, whatever triangles join it to others
        shares[scene.faces.any(axis=1)[scene.triangles]] = 1.0
    return shares


def _tasks(receivers: ReceiverSet, directions: NDArray[np.float64], weights: NDArray[np.float64], group: int,
           seed: int, face_shares: NDArray[np.float32], wanted: NDArray[np.bool_] | None) -> Iterator[_Task]:
    for block in blocks(len(receivers), group, seed):
        turned = np.ascontiguousarray(rotated(directions, block.rotation), np.float32)
        # In double, for normalised rows: the sum over the hemisphere is the same whatever the chunk.
        cosines = np.zeros(block.receivers.stop - block.receivers.start)
        for start in range(0, len(turned), CHUNK):
            part = facing_cosines(turned[start:start + CHUNK], receivers.normals[block.receivers])
            cosines += multiply(weights[None, start:start + CHUNK], part.astype(np.float64))[0]
        scale = (1.0 / np.maximum(cosines, np.finfo(np.float64).tiny)).astype(np.float32)
        for start in range(0, len(turned), CHUNK):
            chunk = slice(start, start + CHUNK)
            yield _Task(block, start, turned[chunk], weights[chunk],
                        weights[chunk, None].astype(np.float32) * scale, face_shares,
                        None if wanted is None else wanted[block.receivers], start + CHUNK >= len(turned))


def _hits(tracer: Tracer, scene: SceneMesh, receivers: ReceiverSet, task: _Task) -> tuple[_Entries, int]:
    """Entries of one chunk of directions: three per hit, the barycentric weights of the corners."""
    place = task.block.receivers
    cosines = facing_cosines(task.directions, receivers.normals[place])
    which, row, hits = tracer.nearest_where(receivers.origins[place], task.directions, cosines > 0.0)
    rays = len(row)
    met = np.flatnonzero(hits.triangle >= 0)
    which, row = which[met], row[met]
    share = cosines[which, row]
    above = np.ones(len(met), np.float32)
    low = np.flatnonzero(share < receivers.grazing[place][row])
    above[low] = receivers.above_faces(row[low] + place.start, task.directions[which[low]])
    share *= above * task.weights[which, row]
    seen = np.flatnonzero(share)
    met, which, row, share, above = met[seen], which[seen], row[seen], share[seen], above[seen]
    side = np.where(hits.front[met], 0, len(scene.points))
    corner = scene.triangles[hits.triangle[met]].astype(np.int64) + side[:, None]
    u, v = hits.u[met], hits.v[met]
    value = (np.stack([1.0 - u - v, u, v], axis=1) * share[:, None]).astype(np.float32)
    value *= np.take(task.face_shares, hits.triangle[met], axis=0)
    kept = [] if task.wanted is None or not task.wanted.any() else _kept(task, hits, met, which, row, share, above)
    return _Entries([np.repeat(row, 3)], [corner.ravel()], [value.ravel()], kept,
                    np.bincount(row, share, cosines.shape[1])), rays


def _kept(task: _Task, hits: Hits, met: NDArray[np.int64], which: NDArray[np.int64], row: NDArray[np.int64],
          share: NDArray[np.float32], above: NDArray[np.float32]) -> list[KeptHits]:
    """The hits (numbers `met` of the rays, in directions `which` from receivers `row`) of the wanted receivers. above:
    share of the receiver's faces below the direction."""
    chosen = np.flatnonzero(task.wanted[row])
    met, which, row = met[chosen], which[chosen], row[chosen]
    solid_angle = (above[chosen] * task.solid_angles[which]).astype(np.float32)
    return [KeptHits(row, which + task.first, hits.triangle[met], hits.u[met], hits.v[met], hits.front[met],
                     solid_angle, share[chosen])]


def _block_matrix(entries: _Entries, rows: int, columns: int) -> sparse.csr_matrix:
    """The entries of a block as CSR with duplicates summed."""
    place = (np.concatenate(entries.row), np.concatenate(entries.key))
    return sparse.coo_matrix((np.concatenate(entries.value), place), shape=(rows, columns)).tocsr()
