# SPDX-License-Identifier: GPL-3.0-or-later
"""What goes to the GPU, as plain arrays, and the signatures that say when it changed. Imports neither gpu nor bpy.

Long lists lie in 2D textures of TEXTURE_WIDTH texels, row after row: texel i at (i % width, i // width). Every texture
is RGBA32F, the one format that all of Blender's backends read and write in every stage.
"""

from __future__ import annotations

import hashlib
from collections.abc import Hashable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..prt_addon.errors import BadScene
from ..prt_addon.relighting.texel_light import corner_albedo
from . import hemisphere_glsl

if TYPE_CHECKING:
    from ..prt_addon.relighting.live_scattering import LiveScattering
    from ..prt_addon.scene.surface_textures import SurfaceTextures
    from ..prt_addon.scene.texel_surface import TexelSurface
    from ..prt_addon.storage.container import BakedTransfer

# Turn of frames within a triangle, in radians, up to which blending across it shows nothing (functions turn by up to
# four times as much), and the steps in which frames are turned beyond it.
LARGEST_TURN, TURN_STEP = 0.1, 0.05
TEXTURE_WIDTH = 2048
LARGEST_TEXTURE = 16384  # texels per side that OpenGL 4.3, Vulkan and Metal devices fit for Blender all offer
DEPTH_BIAS = 1e-6  # NDC towards the viewer: wins against the original surface, loses to anything in front of it


@dataclass(frozen=True)
class DrawItem:
    """One baked object as the viewport shows it now.

    key: changes when `baked` does (`transfer_signature(baked)`, or anything hashable and cheaper that does).
    matrix: (4, 4), from world space at bake time to world space now: current matrix_world @ inverse(matrix at bake).
    light: (columns, 3), coefficients in the lighting basis of the bake, or (zones, columns, 3) where a light cloud
        takes part (`relighting.scene_light.joined_light`); more columns than a bake for distant light has are left out
        (spherical harmonics of a higher order).
    direct: (points, rows, 3) float32, what lamps add to the exit radiance: their direct light, which no bake holds.
        Never changed in place: another array means other light.
    exposure: factor on the radiance. stale: drawn dimmed, because the object was edited after its bake.
    scattering: what takes the lamps' light through the body, where the bake has links for it. Never changed in place.
    heat: (points,) in 0..1 shown as false colours in place of the radiance, or None.
    colours: false colours that are no heat, or None. textures: images that replace the albedo of points, or None.
    """

    key: Hashable
    baked: BakedTransfer
    matrix: ArrayLike
    light: ArrayLike
    exposure: float = 1.0
    stale: bool = False
    heat: NDArray[np.floating] | None = None
    direct: NDArray[np.float32] | None = None
    colours: FalseColours | None = None
    textures: SurfaceTextures | None = None
    scattering: LampScattering | None = None

    @property
    def is_lit(self) -> bool:
        """Whether light is shown, not false colours."""
        return self.heat is None and self.colours is None


@dataclass(frozen=True, eq=False)
class LampScattering:
    """live: of the bake; bounced: (points, 3) E / pi of lamps by way of the scene, or None; on_card: whether `direct`
    is still to be taken through the body, by the graphics card; else that was done, and the card is only timed."""

    live: LiveScattering
    bounced: NDArray[np.float32] | None = None
    on_card: bool = False


@dataclass(frozen=True, eq=False)
class FalseColours:
    """values: (points, 3) float32 scene-linear, shown as they are. Never changed in place."""

    values: NDArray[np.float32]


@dataclass(frozen=True)
class RenderData:
    """The arrays of one baked object that do not depend on the light.

    points: receivers; positions, albedo: (vertices, 3) float32, contiguous, as many vertices as points where the view
    does not count; triangles: (triangles, 3) int32 of vertices;
    encoding: (height, TEXTURE_WIDTH, 4) float32, see `encode`; cluster_vectors: (clusters,) int32, how many of the
    `vectors` each cluster really has (the rest are zero). functions: of the view, one for each row but the first;
    normals, tangents: (vertices, 3) float32, receivers, turns: (vertices,), see `Corners`; None without functions.
    atlas_places: (vertices, 2) float32 in an atlas and atlas: (height, width, 4) float32 numbers of the points around
    each square between texels, -1 for none, where points are texels: vertices are then the surface's own; None else.
    """

    points: int
    positions: NDArray[np.float32]
    albedo: NDArray[np.float32]
    triangles: NDArray[np.int32]
    encoding: NDArray[np.float32]
    clusters: int
    vectors: int
    rows: int
    columns: int
    cluster_vectors: NDArray[np.int32]
    functions: tuple[int, ...] = ()
    normals: NDArray[np.float32] | None = None
    tangents: NDArray[np.float32] | None = None
    receivers: NDArray[np.int64] | None = None
    turns: NDArray[np.float32] | None = None
    atlas_places: NDArray[np.float32] | None = None
    atlas: NDArray[np.float32] | None = None

    @property
    def exit_size(self) -> tuple[int, int]:
        """Width and height in texels of the texture of exit radiances: `rows` consecutive texels per point."""
        return TEXTURE_WIDTH, texture_height(self.points * self.rows)


def texture_height(texels: int) -> int:
    """Rows of TEXTURE_WIDTH texels that hold a list of `texels`; at least one. Raises BadScene beyond the largest."""
    height = max(1, -(-texels // TEXTURE_WIDTH))
    if height > LARGEST_TEXTURE:
        raise BadScene(
            "the preview", f"{texels} values do not fit a texture", "Split the object or bake it with fewer vectors"
        )
    return height


def texture_values(values: NDArray[np.floating]) -> NDArray[np.float32]:
    """(n, 3 or 4) values as a texture (height, TEXTURE_WIDTH, 4) float32, zero where nothing was given."""
    height = texture_height(len(values))
    texels = np.zeros((height * TEXTURE_WIDTH, 4), np.float32)
    texels[: len(values), : values.shape[1]] = values
    return texels.reshape(height, TEXTURE_WIDTH, 4)


def encode(cluster: NDArray[np.integer], weights: NDArray[np.floating]) -> NDArray[np.float32]:
    """Clusters (points,) and weights (points, vectors) as one texture (height, TEXTURE_WIDTH, 4).

    ceil((vectors + 1) / 4) texels per point: the cluster in the place of the mean's weight, which is always 1 (exact in
    float32 up to 2^24 clusters), then the weights.
    """
    points, vectors = weights.shape
    texels = (vectors + 4) // 4
    numbers = np.zeros((points, texels * 4), np.float32)
    numbers[:, 0] = cluster
    numbers[:, 1 : vectors + 1] = weights
    return texture_values(numbers.reshape(points * texels, 4))


def make_render_data(baked: BakedTransfer) -> RenderData:
    """The arrays that the GPU needs of a baked object. Raises BadScene when they do not fit textures."""
    clusters, vectors_and_mean, rows, columns, _ = baked.bases.shape
    if baked.texels is not None:
        return texel_data(baked, encode(baked.cluster, baked.weights), used_vectors(baked.bases))
    corners = shared_frames(baked) if baked.functions else None
    place = slice(None) if corners is None else corners.receivers
    return RenderData(
        points=len(baked.positions),
        positions=np.ascontiguousarray(baked.positions[place], np.float32),
        albedo=np.ascontiguousarray(baked.albedo[place], np.float32),
        triangles=np.ascontiguousarray(baked.triangles if corners is None else corners.triangles, np.int32),
        encoding=encode(baked.cluster, baked.weights),
        clusters=clusters,
        vectors=vectors_and_mean - 1,
        rows=rows,
        columns=columns,
        cluster_vectors=used_vectors(baked.bases),
        functions=baked.functions,
        normals=None if corners is None else np.ascontiguousarray(baked.normals[place], np.float32),
        tangents=None if corners is None else corners.tangents,
        receivers=None if corners is None else corners.receivers,
        turns=None if corners is None else corners.turns,
    )


def plain_surface(data: RenderData) -> RenderData:
    """The same surface with one vertex per point and no frames, as colours that don't depend on the view need it."""
    if data.atlas is not None:
        return replace(data, functions=())
    first = slice(0, data.points)
    triangles = data.receivers[data.triangles].astype(np.int32)
    return replace(data, positions=data.positions[first], albedo=data.albedo[first], triangles=triangles, functions=())


def texel_data(baked: BakedTransfer, encoding: NDArray[np.float32], cluster_vectors: NDArray[np.int32]) -> RenderData:
    """The arrays of a bake at texels: each triangle of the surface has three vertices of its own."""
    surface = baked.texels
    clusters, vectors_and_mean, rows, columns, _ = baked.bases.shape
    corner = surface.triangles.ravel()
    albedo = corner_albedo(baked).reshape(-1, 3)
    points, normals, tangents = (np.ascontiguousarray(values[corner], np.float32)
                                 for values in (surface.points, surface.normals, surface.tangents))
    return RenderData(
        points=len(baked.positions),
        positions=points,
        albedo=albedo.astype(np.float32),
        triangles=np.arange(len(corner), dtype=np.int32).reshape(-1, 3),
        encoding=encoding,
        clusters=clusters,
        vectors=vectors_and_mean - 1,
        rows=rows,
        columns=columns,
        cluster_vectors=cluster_vectors,
        functions=baked.functions,
        normals=normals,
        tangents=tangents,
        atlas_places=np.ascontiguousarray(surface.places.reshape(-1, 2), np.float32),
        atlas=points_around(surface),
    )


def points_around(surface: TexelSurface) -> NDArray[np.float32]:
    """(height, width, 4) numbers of the points at lower left, lower right, upper left and upper right of the square
    whose lower left texel each is; -1 where there is none. Exact in single precision up to 2^24 points."""
    number = np.full((surface.height + 1, surface.width + 1), -1.0, np.float32)
    number[surface.row, surface.column] = np.arange(len(surface.row))
    return np.stack([number[:-1, :-1], number[:-1, 1:], number[1:, :-1], number[1:, 1:]], axis=2)


@dataclass(frozen=True)
class Corners:
    """Vertices to draw: receivers (v,) their numbers; turns (v,) float32, by how many radians about the normal the
    frame to draw with is turned from the receiver's own; tangents (v, 3) float32 of that frame; triangles (t, 3)."""

    receivers: NDArray[np.int64]
    turns: NDArray[np.float32]
    tangents: NDArray[np.float32]
    triangles: NDArray[np.int32]


def shared_frames(baked: BakedTransfer) -> Corners:
    """Frames in which the corners of each triangle agree.

    Coefficients of functions of the view may only be blended in one frame. No field of tangents is smooth all over a
    closed surface, so where the three of a triangle turn against each other by more than LARGEST_TURN, its second and
    third corner become vertices of their own, in the first one's frame: the shader turns their coefficients, which is
    exact, and blends like with like.
    """
    points, triangles = len(baked.positions), baked.triangles
    receivers, turns = np.arange(points), np.zeros(points, np.float32)
    tangents = np.asarray(baked.tangents, np.float32)
    if not hemisphere_glsl.turns_with_frames(baked.functions) or not any(baked.functions):
        return Corners(receivers, turns, tangents, triangles)
    turn = np.stack([_turn_towards(baked, triangles[:, 0], triangles[:, k]) for k in (1, 2)], axis=1)
    chosen = np.flatnonzero(np.abs(turn).max(axis=1, initial=0.0) > LARGEST_TURN)
    # Corners of one receiver that turn by nearly as much share a vertex; those that hardly turn stay as they are.
    steps = np.rint(turn[chosen] / TURN_STEP).astype(np.int64)
    turns_on = steps.ravel() != 0
    drawn = triangles[chosen, 1:].astype(np.int64).ravel()
    key, place = np.unique(drawn[turns_on] * 2 ** 16 + steps.ravel()[turns_on] + 2 ** 15, return_inverse=True)
    corner, angle = key // 2 ** 16, ((key % 2 ** 16 - 2 ** 15) * TURN_STEP).astype(np.float32)
    drawn[turns_on] = points + place
    new_triangles = triangles.copy()
    new_triangles[chosen, 1:] = drawn.reshape(-1, 2)
    normals, own = baked.normals[corner], tangents[corner]
    turned = np.cos(angle)[:, None] * own + np.sin(angle)[:, None] * np.cross(normals, own)
    return Corners(np.concatenate([receivers, corner]), np.concatenate([turns, angle]),
                   np.concatenate([tangents, turned.astype(np.float32)]), new_triangles)


def _turn_towards(baked: BakedTransfer, first: NDArray[np.integer], corner: NDArray[np.integer]) -> NDArray[np.float64]:
    """Angles (t,) about their normals from the tangents of corners to the tangents of the first corners, carried over
    by the smallest rotation that takes normal to normal."""
    tangents, normals = np.asarray(baked.tangents, np.float64), np.asarray(baked.normals, np.float64)
    source, target, wanted = normals[first], normals[corner], tangents[first]
    # The part along the bisector's reflection: t - (t . n') / (1 + n . n') (n + n'); opposite normals have none.
    cosine = np.maximum(1.0 + np.sum(source * target, axis=1), 1e-6)
    carried = wanted - (np.sum(wanted * target, axis=1) / cosine)[:, None] * (source + target)
    own = tangents[corner]
    return np.arctan2(np.sum(carried * np.cross(target, own), axis=1), np.sum(carried * own, axis=1))


def used_vectors(bases: NDArray[np.float32]) -> NDArray[np.int32]:
    """Vectors that each cluster has, (clusters,): up to its last that is not zero. Taken from the bases and not from
    the header, so that a picture never leaves out anything."""
    used = bases.reshape(*bases.shape[:2], -1).any(axis=2)
    used[:, 0] = True  # the mean
    return (bases.shape[1] - 1 - used[:, ::-1].argmax(axis=1)).astype(np.int32)


def constant_texels(constants: NDArray[np.float32], cluster_vectors: NDArray[np.int32]) -> NDArray[np.float32]:
    """Constants (clusters, vectors + 1, rows, 3) as a texture, the number of vectors of its cluster in the fourth
    component of each mean: there the shader reads it without another fetch."""
    texels = np.zeros((*constants.shape[:3], 4), np.float32)
    texels[..., :3] = constants
    texels[:, 0, :, 3] = cluster_vectors[:, None]
    return texture_values(texels.reshape(-1, 4))


def transfer_signature(baked: BakedTransfer) -> str:
    """A digest of everything that is drawn of a baked object: equal for equal content (a few ms per 10 MB).

    Call it when data is read, not on every redraw, and keep the result as `DrawItem.key`.
    """
    digest = hashlib.blake2b(repr(baked.functions).encode(), digest_size=16)
    drawn = [baked.cluster, baked.weights, baked.bases, baked.albedo, baked.positions, baked.triangles]
    if baked.texels is not None:
        drawn += [baked.texels.points, baked.texels.places, baked.texels.column, baked.texels.row]
    for values in drawn + ([baked.normals, baked.tangents] if baked.functions else []):
        digest.update(repr((values.shape, values.dtype.str)).encode())
        digest.update(np.ascontiguousarray(values))
    return digest.hexdigest()


def light_signature(item: DrawItem) -> Hashable:
    """Changes when the exit radiance must be computed again: the light or the false colours changed."""
    heat = None if item.heat is None else np.asarray(item.heat, np.float32).tobytes()
    return np.asarray(item.light, np.float32).tobytes(), heat, item.colours


def matching_light(light: ArrayLike, columns: int) -> NDArray[np.float32]:
    """The first `columns` coefficients of a light (n, 3), or a light of zones (zones, columns, 3) as it is. Raises
    BadScene when it has fewer."""
    coefficients = np.asarray(light, np.float32)
    fits = coefficients.shape[1:] == (columns, 3) if coefficients.ndim == 3 else (
        coefficients.ndim == 2 and coefficients.shape[1] == 3 and len(coefficients) >= columns)
    if not fits:
        raise BadScene(
            "the light",
            f"it has shape {coefficients.shape}, the bake expects ({columns}, 3)",
            "Bake the object again with the current settings",
        )
    return coefficients if coefficients.ndim == 3 else coefficients[:columns]


def heat_colours(heat: NDArray[np.floating]) -> NDArray[np.float32]:
    """(points, 3) scene-linear colours of values in 0..1: black, blue, magenta, orange, white; ever brighter."""
    stops = np.array([[0, 0, 0], [0.02, 0.05, 0.4], [0.5, 0.03, 0.35], [1.0, 0.35, 0.02], [1, 1, 1]])
    places = np.linspace(0.0, 1.0, len(stops))
    return np.stack([np.interp(heat, places, stops[:, channel]) for channel in range(3)], axis=1).astype(np.float32)


def clip_transform(view_projection: ArrayLike, matrix: ArrayLike) -> NDArray[np.float64]:
    """(4, 4) from baked world positions to clip space, moved by DEPTH_BIAS in NDC towards the viewer."""
    transform = np.array(view_projection, np.float64) @ np.array(matrix, np.float64)  # small
    transform[2] -= DEPTH_BIAS * transform[3]
    return transform


def viewer_of(transform: ArrayLike) -> NDArray[np.float64]:
    """Where a (4, 4) transform to clip space is seen from, homogeneous (4,), in the space that it starts from.

    (x, y, z, 1) is the eye of a perspective view; (x, y, z, 0) the unit direction towards the viewer of an
    orthographic one. Either way `viewer.xyz - viewer.w * point` points from a point to the viewer. The eye is what
    the transform takes to x = y = w = 0: the cross product in four dimensions of these three rows. It does not depend
    on the depth range (nor on a depth bias), which would cost digits in an inverse. A transform that flattens, which
    shows nothing, has no viewer: (0, 0, 1, 0).
    """
    rows = np.asarray(transform, np.float64)
    others = rows[[0, 1, 3]] / np.maximum(np.abs(rows[[0, 1, 3]]).max(axis=1, keepdims=True), 1e-300)
    viewer = np.array([(-1) ** k * np.linalg.det(np.delete(others, k, axis=1)) for k in range(4)])  # small
    if rows[2] @ viewer > 0.0:  # small; in front of the near plane, never behind the far one
        viewer = -viewer
    largest = np.abs(viewer[:3]).max()
    if not np.abs(viewer).max() > 1e-12:
        return np.array([0.0, 0.0, 1.0, 0.0])
    return viewer / viewer[3] if abs(viewer[3]) > 1e-12 * largest else np.append(
        viewer[:3] / np.sqrt(np.sum(viewer[:3] ** 2)), 0.0)
