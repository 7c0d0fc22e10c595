# SPDX-License-Identifier: GPL-3.0-or-later
"""Transfer of lit surfaces: what patches send on, and the few columns that lamps need of it.

The responses of all patches at all receivers (receivers x patches x channels) go to disk as they are made. What lamps
at many places, near to surfaces, in the open and outside, do by at least one bounce is put together from them; its
leading axes become the columns. They come scaled by how much lamps differ along them, so that the encoder, which knows
squared differences only, spends its vectors on what lamps show (as the hemisphere's metric does for rows): measured on
the paper's Cornell box, 256 columns and 12 vectors, 0.8 % instead of 3.5 % of error.
"""

from __future__ import annotations

import tempfile
from collections.abc import Generator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..lighting.light_visibility import surroundings
from ..lighting.lit_surfaces import LitSurfaces, lit_elements, make_patches, triangle_areas
from ..lighting.local_lights import LocalLight
from ..linear_algebra import multiply, symmetric_eigenpairs
from ..relighting.lamp_light import unit_lamp
from ..relighting.surface_light import SurfaceLight
from ..scene.scene_mesh import SceneMesh
from ..tracing.tracer import Tracer
from ..transport.gather import Gather
from ..transport.glossy import reflected_light
from ..transport.incident_light import DiffuseRadiance, IndirectLight
from ..transport.local_lights import LightSolver
from .leftovers import RESPONSES
from .lit_highlights import LitHighlights

Single = NDArray[np.float32]
# Triangles at most that stand for all surfaces: each costs a shadow ray for every lamp that moves.
MOST_ELEMENTS = 16384
# Lamps to learn from: for each place in the open so many near to surfaces and outside of the scene; how near, in
# fractions of the diagonal, and how far outside, from the middle in diagonals.
NEAR_SURFACES, OUTSIDE = 2.0, 0.5
NEAREST, FARTHEST, OUTSIDE_FROM, OUTSIDE_TO = 0.005, 0.1, 0.4, 2.5
# Cones of the spots among them, degrees: half of the lamps.
NARROWEST, WIDEST, BLEND = 30.0, 120.0, 0.3
# Columns whose part in what lamps differ is below this share of the first one's are not kept.
LEAST = 1e-4
# Patches are parted so many times where walls cross them; rays between members run above the surface by this share of
# their distance.
PARTINGS, ABOVE = 4, 0.2
# Patches carried through the operator at once, and how the progress is shared: learning, patches, highlights.
BLOCK, LEARNT, CARRIED = 256, 0.25, 0.85


@dataclass(frozen=True)
class SurfaceColumns:
    """surfaces: the basis; transfer: (keys, columns, channels) float32; patterns: (r, columns) the direct field of the
    gather's receivers that each column stands for; left: share of the lamps' bounced light beyond the columns (relative
    RMS); lamps: that it was learnt from."""

    surfaces: LitSurfaces
    transfer: Single
    patterns: Single
    left: float
    lamps: int


def surface_columns(tracer: Tracer, scene: SceneMesh, solver: LightSolver, rows: NDArray[np.int64],
                    open_places: NDArray[np.float64], patches: int, columns: int, seed: int, folder: Path | None,
                    ) -> Generator[float, None, SurfaceColumns]:
    """Yield progress, return the columns.

    rows: (k,) the solver's receivers whose transfer is kept; open_places: (n, 3) of lamps; patches, columns: at most;
    folder: where large files may lie.
    """
    patch, surfaces = _surfaces(tracer, scene, solver.gathered, patches, seed)
    count = surfaces.axes.shape[1]
    lamps = training_lamps(tracer, surfaces, open_places, seed)
    light = SurfaceLight(surfaces, tracer)
    lit = np.zeros((count, 2 * len(lamps)), np.float32)
    for number, (point, spot) in enumerate(lamps):
        flux = light.flux(point)
        lit[:, number], lit[:, len(lamps) + number] = light.mean(flux), light.mean(light.aimed(flux, spot))
        yield LEARNT * (number + 1) / len(lamps)
    channels = solver.albedo.shape[1]
    with tempfile.TemporaryDirectory(dir=folder, prefix=RESPONSES) as place:
        responses = np.lib.format.open_memmap(Path(place) / "patches.npy", "w+", np.float32,
                                              (count, len(rows) * channels))
        learnt = np.zeros((lit.shape[1], len(rows) * channels), np.float32)
        for start in range(0, count, BLOCK):
            chosen = slice(start, min(start + BLOCK, count))
            fields = (patch[:, None] == np.arange(chosen.start, chosen.stop)).astype(np.float32)

            def take(_: slice, response: Single, chosen: slice = chosen) -> None:
                block = np.ascontiguousarray(response[rows].transpose(1, 0, 2)).reshape(chosen.stop - chosen.start, -1)
                responses[chosen] = block
                multiply(np.ascontiguousarray(lit[chosen].T), block, out=learnt, accumulate=True)

            for done in solver.solve_fields(fields, take):
                yield LEARNT + (CARRIED - LEARNT) * (start + done * (chosen.stop - start)) / count
        axes, scale, mix, left = _leading(learnt, columns)
        projection = np.zeros((len(scale), count), np.float32)
        for start in range(0, count, BLOCK):
            projection[:, start:start + BLOCK] = multiply(axes, np.array(responses[start:start + BLOCK]).T)
            yield CARRIED
    projection /= scale[:, None]
    axes *= scale[:, None]
    transfer = np.ascontiguousarray(axes.reshape(len(scale), len(rows), channels).transpose(1, 0, 2))
    pattern = multiply(lit, mix)  # (patches, columns)
    patterns = np.where((patch >= 0)[:, None], pattern[patch], np.float32(0.0))
    yield 1.0
    return SurfaceColumns(LitSurfaces(surfaces.corners, surfaces.patch, projection), transfer, patterns, left,
                          lit.shape[1])


def surface_highlights(solver: LightSolver, columns: SurfaceColumns, highlights: LitHighlights,
                       ) -> Generator[float, None, Single]:
    """Yield progress, return rows (g, functions, columns, channels) of the receivers with highlights: what they reflect
    of the surfaces that a column's light falls on, direct light included."""
    gathered, kernels = solver.gathered, highlights.surfaces.kernels
    channels = max(kernels[0].shape[2], solver.albedo.shape[1])
    result = np.zeros((len(highlights.points), kernels[0].shape[0], columns.patterns.shape[1], channels), np.float32)

    def nothing(part: slice, response: Single) -> None:
        """Diffuse transfer is known."""

    def view(part: slice, radiance: Single) -> Generator[float]:
        source = DiffuseRadiance(gathered.hits, solver.scene, gathered.receivers, radiance)
        indirect = IndirectLight(gathered.hits, source, highlights.places, highlights.blocked)
        rows = yield from reflected_light(solver.tracer, highlights.surfaces, part.stop - part.start, indirect)
        result[:, :, part] = rows

    yield from solver.solve_fields(columns.patterns, nothing, view)
    return result


def training_lamps(tracer: Tracer, surfaces: LitSurfaces, open_places: NDArray[np.float64], seed: int,
                   ) -> list[tuple[LocalLight, LocalLight]]:
    """Points of 1 W/sr in the open, near to surfaces and outside, from which columns are learnt, each with a spot."""
    generator = np.random.Generator(np.random.PCG64([seed, 84]))
    corners = surfaces.corners.astype(np.float64)
    upright = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.sqrt(np.sum(upright ** 2, axis=1))
    near = np.zeros((0, 3))
    wanted = int(NEAR_SURFACES * len(open_places))
    if len(corners):
        chosen = generator.choice(len(corners), 3 * wanted, p=area / area.sum())
        share = generator.dirichlet((1.0, 1.0, 1.0), len(chosen))
        height = tracer.diagonal * np.exp(generator.uniform(np.log(NEAREST), np.log(FARTHEST), len(chosen)))
        near = np.sum(share[:, :, None] * corners[chosen], axis=1) + height[:, None] * (
            upright[chosen] / area[chosen][:, None])
        near = near[~surroundings(tracer, near).inside][:wanted]
    direction = generator.normal(size=(int(OUTSIDE * len(open_places)), 3))
    direction /= np.sqrt(np.sum(direction ** 2, axis=1))[:, None]
    far = tracer.diagonal * np.exp(generator.uniform(np.log(OUTSIDE_FROM), np.log(OUTSIDE_TO), len(direction)))
    middle = corners.reshape(-1, 3).mean(axis=0) if len(corners) else np.zeros(3)
    places = np.concatenate([open_places, near, middle + far[:, None] * direction])
    return [(unit_lamp(place), _spot(place, generator)) for place in places]


def _spot(position: NDArray[np.float64], generator: np.random.Generator) -> LocalLight:
    """A spot of 1 W/sr that looks anywhere."""
    frame = np.eye(4)
    frame[:3, :3] = np.linalg.qr(generator.normal(size=(3, 3)))[0]  # small
    frame[:3, 3] = position
    return LocalLight("", "spot", frame, np.full(3, 4.0 * np.pi), spot_blend=BLEND,
                      spot_angle=float(np.radians(generator.uniform(NARROWEST, WIDEST))))


def _surfaces(tracer: Tracer, scene: SceneMesh, gathered: Gather, most: int, seed: int,
              ) -> tuple[NDArray[np.int32], LitSurfaces]:
    """The patch (r,) of each receiver of the gather, and patches without axes yet."""
    key, count = gathered.receivers.key, len(scene.points)
    row = np.full(2 * count, -1, np.int64)
    row[key] = np.arange(len(key))
    corners = scene.points[scene.triangles]
    own = np.bincount(scene.triangles.ravel(), np.repeat(triangle_areas(corners) / 3.0, 3), count)[key % count]
    receivers = gathered.receivers
    # Where rays start is pulled into the receiver's own faces: two floors that meet under a wall are told apart.
    places, normals = receivers.origins.astype(np.float64), receivers.normals.astype(np.float64)
    patch = make_patches(places, normals, own, 1.0, most)
    patch = _parted(tracer, places, normals, patch)
    sides, patches = [], []
    for side in (0, 1):
        rows = row[scene.triangles + side * count]
        sides.append(corners if side == 0 else corners[:, ::-1])
        found = np.where(rows >= 0, patch[rows], -1)
        patches.append(found if side == 0 else found[:, ::-1])
    elements = lit_elements(np.concatenate(sides), np.concatenate(patches).astype(np.int32), MOST_ELEMENTS, seed)
    total = int(patch.max(initial=0)) + 1
    return patch, LitSurfaces(*elements, np.zeros((1, total), np.float32))


def _parted(tracer: Tracer, places: NDArray[np.float64], normals: NDArray[np.float64], patch: NDArray[np.int32],
            ) -> NDArray[np.int32]:
    """Patches (r,) whose members see their middle one; the others of a patch become patches of their own, again and
    again. A patch on both sides of a wall would carry light through it.

    places: (r, 3) in tracing space. Rays run above the surface, so that a bulge does not part a patch.
    """
    patch = patch.copy()
    unsure = np.flatnonzero(patch >= 0)
    for _ in range(PARTINGS):
        if not len(unsure):
            break
        total = int(patch.max()) + 1
        members = np.bincount(patch[unsure], minlength=total)
        mean = np.stack([np.bincount(patch[unsure], places[unsure, k], total) for k in range(3)], axis=1)
        mean /= np.maximum(members, 1)[:, None]
        away = np.sum((places[unsure] - mean[patch[unsure]]) ** 2, axis=1)
        order = np.lexsort((unsure, away, patch[unsure]))
        first = np.unique(patch[unsure][order], return_index=True)[1]
        middle = np.full(total, -1)
        middle[patch[unsure][order][first]] = unsure[order][first]
        to = middle[patch[unsure]]
        height = ABOVE * np.sqrt(np.sum((places[unsure] - places[to]) ** 2, axis=1))[:, None]
        start = places[unsure] + height * normals[unsure]
        towards = places[to] + height * normals[to] - start
        hidden = tracer.occluded(start.astype(np.float32), towards.astype(np.float32),
                                 np.ones(len(start), np.float32)) & (to != unsure)
        unsure = unsure[hidden]
        number = np.unique(patch[unsure], return_inverse=True)[1]
        patch[unsure] = total + number
    return patch


def _leading(learnt: Single, most: int) -> tuple[Single, Single, Single, float]:
    """Orthonormal axes (k, n) of the rows (l, n), each row of equal weight; their scale (k,), the root mean square of
    the rows along them; mix (l, k) of the rows that makes axes times scale; and what is left, relative RMS."""
    length = np.sqrt(np.sum(np.square(learnt, dtype=np.float64), axis=1))
    used = length > 1e-9 * max(float(length.max(initial=0.0)), 1e-300)
    weight = np.divide(1.0, length, out=np.zeros_like(length), where=used) / np.sqrt(max(1, int(used.sum())))
    rows = learnt * weight.astype(np.float32)[:, None]
    energy, turn = symmetric_eigenpairs(multiply(rows, np.ascontiguousarray(rows.T)).astype(np.float64))
    energy = np.maximum(energy, 0.0)
    kept = np.flatnonzero(energy > LEAST ** 2 * max(float(energy[0]), 1e-300))[:most]
    if len(kept) == 0:  # nothing bounces: one column of nothing
        return (np.zeros((1, learnt.shape[1]), np.float32), np.ones(1, np.float32),
                np.zeros((len(learnt), 1), np.float32), 0.0)
    scale = np.sqrt(energy[kept])
    axes = multiply(np.ascontiguousarray((turn[:, kept] / scale).T, np.float32), rows)
    left = float(np.sqrt(max(0.0, energy.sum() - energy[kept].sum()) / energy.sum()))
    return axes, scale.astype(np.float32), (turn[:, kept] * weight[:, None]).astype(np.float32), left
