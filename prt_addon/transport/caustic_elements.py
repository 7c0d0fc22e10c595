# SPDX-License-Identifier: GPL-3.0-or-later
"""Light that reaches diffuse receivers over glossy surfaces (caustics), in cubemap texels, in two ways.

    T(x, j) = (1 / pi) integral over the hemisphere of cos(w) L_j(x, w) dw,  L_j: what glossy surfaces seen in direction
    w reflect, after one or more glossy reflections, of texel j's unit light

`CausticElements` traces single elements: paths to glossy surfaces, and at each a shadow ray towards the texel, as
element-wise path tracing must. The texel must not be much smaller than the lobe: of a perfect mirror no path could be
led to a given texel. `gathered_caustics` follows the same paths on along the lobe to whichever texel they escape to:
every ray serves all columns.
"""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ..basis.cubemap import cubemap_solid_angles, sample_directions, texel_count, texel_of
from ..basis.directions import cosine_hemisphere, tangent_frames
from ..linear_algebra import row_squares
from ..scene.scene_mesh import SceneMesh
from ..tracing.tracer import Tracer
from .elements import RAYS, PathTracedElements, Places, Single
from .path_reference import surface_at
from .receiver_set import ReceiverSet
from .reflectance import PrincipledLobe

Array = NDArray[np.float64]

# Points along a texel's edge that shadow rays of different paths aim at.
AIMS = 4


@dataclass(frozen=True)
class GlossySurfaces:
    """lobe: of all glossy surfaces, isotropic; points: (scene points,) bool, which are glossy: triangles all of whose
    corners are."""

    lobe: PrincipledLobe
    points: NDArray[np.bool_]


@dataclass(frozen=True)
class _Hits:
    """Glossy surfaces met by some paths. which: of the rays; origins, faces (n, 3); frames (n, 3, 3): shading frames, z
    last; views (n, 3): back along the ray, in these."""

    which: Places
    origins: Single
    faces: Array
    frames: Array
    views: Array


def _meet(tracer: Tracer, scene: SceneMesh, glossy: GlossySurfaces, origins: Single, towards: Single,
          ) -> tuple[_Hits, NDArray[np.bool_]]:
    """What rays meet of glossy surfaces, and which rays escape."""
    hits = tracer.nearest(origins, towards)
    met = np.flatnonzero(hits.triangle >= 0)
    met = met[glossy.points[scene.triangles[hits.triangle[met]]].all(axis=1)]
    found = surface_at(tracer, scene, hits, met)
    frames = tangent_frames(found.normals)
    views = -np.sum(frames * towards[met][:, None, :], axis=2)
    up = views[:, 2] > 1e-4
    return _Hits(met[up], found.origins[up], found.faces[up], frames[up], views[up]), hits.triangle < 0


def sampled_lights(alpha: float, views: Array, numbers: Array) -> tuple[Array, Array]:
    """Directions (n, 3) drawn by numbers (n, 2) in [0, 1) from the facets that views (n, 3) see, and the density of
    each (n,): Dupuy & Benyoub, Sampling Visible GGX Normals with Spherical Caps (2023)."""
    stretched = views * [alpha, alpha, 1.0]
    stretched /= np.sqrt(row_squares(stretched))[:, None]
    angle = 2.0 * np.pi * numbers[:, 0]
    height = (1.0 - numbers[:, 1]) * (1.0 + stretched[:, 2]) - stretched[:, 2]
    wide = np.sqrt(np.maximum(1.0 - height ** 2, 0.0))
    facets = (np.stack([wide * np.cos(angle), wide * np.sin(angle), height], axis=1) + stretched) * [alpha, alpha, 1.0]
    facets /= np.maximum(np.sqrt(row_squares(facets)), 1e-300)[:, None]
    lights = 2.0 * np.sum(facets * views, axis=1)[:, None] * facets - views
    length = row_squares(facets[:, :2]) / alpha ** 2 + facets[:, 2] ** 2
    slope = alpha ** 2 * row_squares(views[:, :2]) / views[:, 2] ** 2
    seen = 2.0 / (1.0 + np.sqrt(1.0 + slope))
    return lights, seen / (np.pi * alpha ** 2 * length ** 2 * 4.0 * views[:, 2])


def _reflect(glossy: GlossySurfaces, hits: _Hits, numbers: Array) -> tuple[Single, Array]:
    """Where paths go on from hits (n, 3), world space, and by what they are dimmed (n,), 0 where they go under."""
    lights, density = sampled_lights(glossy.lobe.alpha_x, hits.views, numbers)
    towards = np.sum(lights[:, :, None] * hits.frames, axis=1)
    above = (lights[:, 2] > 1e-6) & (np.sum(hits.faces * towards, axis=1) > 0.0)
    dimmed = np.zeros(len(lights))
    kernel = glossy.lobe.kernel(hits.views[above], lights[above][:, None, :])[:, 0].mean(axis=1)
    dimmed[above] = kernel / density[above]
    return towards.astype(np.float32), dimmed


@dataclass
class CausticElements(PathTracedElements):
    """See the module and `Elements`. Per element `paths` paths with up to `bounces` glossy reflections; value: mean
    over paths of what they carry per steradian of the texel, factor: its solid angle. All elements use the same local
    directions, and an element is the same whenever it is asked for."""

    tracer: Tracer
    scene: SceneMesh
    receivers: ReceiverSet
    glossy: GlossySurfaces
    r: int
    paths: int = 128
    bounces: int = 2
    seed: int = 0
    asked: int = 0
    angular: bool = False
    highest: float = np.inf
    _aims: Single = field(init=False)
    _local: Array = field(init=False)
    _numbers: Array = field(init=False)

    def __post_init__(self) -> None:
        self._aims = np.ascontiguousarray(sample_directions(self.r, AIMS), np.float32)
        self._local = cosine_hemisphere(self.paths)
        self._numbers = np.random.default_rng(self.seed).random((self.bounces, self.paths, 2))

    @property
    def columns(self) -> int:
        """See `Elements`."""
        return texel_count(self.r)

    def factor(self, receivers: Places) -> Single:
        """Solid angles."""
        return np.broadcast_to(cubemap_solid_angles(self.r).astype(np.float32), (len(receivers), self.columns))

    def _trace(self, receivers: Places, columns: Places) -> tuple[Array, int]:
        """Values (m,) of elements and the rays traced for them."""
        owner = np.repeat(np.arange(len(receivers)), self.paths)
        path = np.tile(np.arange(self.paths), len(receivers))
        place = receivers[owner]
        origins = self.receivers.origins[place]
        frames = tangent_frames(self.receivers.normals[receivers])[owner]
        towards = np.sum(self._local[path][:, :, None] * frames, axis=1).astype(np.float32)
        carried = self.receivers.above_faces(place, towards).astype(np.float64)
        total, rays = np.zeros(len(receivers)), 0
        for bounce in range(self.bounces):
            found, _ = _meet(self.tracer, self.scene, self.glossy, origins, towards)
            rays += len(origins)
            owner, path, carried, origins = owner[found.which], path[found.which], carried[found.which], found.origins
            lit = self._aims[columns[owner], path % AIMS ** 2]
            local = np.sum(found.frames * lit[:, None, :], axis=2)
            facing = np.flatnonzero((local[:, 2] > 1e-6) & (np.sum(found.faces * lit, axis=1) > 0.0) & (carried > 0.0))
            seen = facing[~self.tracer.occluded(origins[facing], lit[facing])]
            rays += len(facing)
            brought = self.glossy.lobe.kernel(found.views[seen], local[seen][:, None, :])[:, 0].mean(axis=1)
            total += np.bincount(owner[seen], carried[seen] * brought, len(total))
            if bounce + 1 < self.bounces:
                towards, dimmed = _reflect(self.glossy, found, self._numbers[bounce, path])
                carried = carried * dimmed
        return total / self.paths, rays


def gathered_caustics(tracer: Tracer, scene: SceneMesh, receivers: ReceiverSet, glossy: GlossySurfaces, r: int,
                      paths: int, bounces: int = 2, seed: int = 0) -> Generator[float, None, Single]:
    """Yield progress, return the transfer (columns, receivers) of all elements from `paths` paths of each receiver that
    follow the lobe until they escape: unbiased, its noise falls with their number. Independent of threads."""
    result = np.zeros((texel_count(r), len(receivers)), np.float32)
    at_once = max(1, RAYS // paths)
    parts = [slice(start, min(start + at_once, len(receivers))) for start in range(0, len(receivers), at_once)]

    def trace(part: slice) -> tuple[Places, Places, Array, int]:
        generator = np.random.Generator(np.random.PCG64([seed, part.start]))
        count = part.stop - part.start
        owner = np.repeat(np.arange(count), paths)
        turn = generator.random(count)[owner] * 2.0 * np.pi
        local = np.tile(cosine_hemisphere(paths), (count, 1))
        cosine, sine = np.cos(turn), np.sin(turn)
        local[:, :2] = np.stack([cosine * local[:, 0] - sine * local[:, 1], sine * local[:, 0] + cosine * local[:, 1]],
                                axis=1)
        frames = tangent_frames(receivers.normals[part])[owner]
        towards = np.sum(local[:, :, None] * frames, axis=1).astype(np.float32)
        carried = receivers.above_faces(owner + part.start, towards).astype(np.float64)
        origins, rays, kept = receivers.origins[part][owner], 0, []
        for bounce in range(bounces + 1):
            found, free = _meet(tracer, scene, glossy, origins, towards)
            rays += len(origins)
            if bounce:
                kept.append((owner[free], texel_of(towards[free], r), carried[free]))
            owner, carried, origins = owner[found.which], carried[found.which], found.origins
            towards, dimmed = _reflect(glossy, found, generator.random((len(owner), 2)))
            carried = carried * dimmed
        rows, columns, values = (np.concatenate([entry[i] for entry in kept]) for i in range(3))
        return rows, columns, values, rays

    for part, (rows, columns, values, rays) in tracer.map_in_order(trace, parts):
        count = part.stop - part.start
        sums = np.bincount(columns * count + rows, values, len(result) * count)
        result[:, part] = sums.reshape(-1, count) / paths
        tracer.rays += rays
        yield part.stop / len(receivers)
    return result
