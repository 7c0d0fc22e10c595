# SPDX-License-Identifier: GPL-3.0-or-later
"""What goes to the GPU, as plain arrays, and the signatures that say when it changed. Imports neither gpu nor bpy.

Long lists lie in 2D textures of TEXTURE_WIDTH texels, row after row: texel i at (i % width, i // width). Every texture
is RGBA32F, the one format that all of Blender's backends read and write in every stage.
"""

from __future__ import annotations

import hashlib
from collections.abc import Hashable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..prt_addon.errors import BadScene

if TYPE_CHECKING:
    from ..prt_addon.storage.container import BakedTransfer

TEXTURE_WIDTH = 2048
LARGEST_TEXTURE = 16384  # texels per side that OpenGL 4.3, Vulkan and Metal devices fit for Blender all offer
DEPTH_BIAS = 1e-6  # NDC towards the viewer: wins against the original surface, loses to anything in front of it


@dataclass(frozen=True)
class DrawItem:
    """One baked object as the viewport shows it now.

    key: changes when `baked` does (`transfer_signature(baked)`, or anything hashable and cheaper that does).
    matrix: (4, 4), from world space at bake time to world space now: current matrix_world @ inverse(matrix at bake).
    light: (columns, 3), coefficients in the lighting basis of the bake; more columns than the bake has are left out
        (spherical harmonics of a higher order).
    exposure: factor on the radiance. stale: drawn dimmed, because the object was edited after its bake.
    heat: (points,) in 0..1 shown as false colours in place of the radiance, or None.
    """

    key: Hashable
    baked: BakedTransfer
    matrix: ArrayLike
    light: ArrayLike
    exposure: float = 1.0
    stale: bool = False
    heat: NDArray[np.floating] | None = None


@dataclass(frozen=True)
class RenderData:
    """The arrays of one baked object that do not depend on the light.

    positions, albedo: (points, 3) float32, contiguous; triangles: (triangles, 3) int32;
    encoding: (height, TEXTURE_WIDTH, 4) float32, see `encode`; cluster_vectors: (clusters,) int32, how many of the
    `vectors` each cluster really has (the rest are zero). functions: of the view, one for each row but the first;
    normals, tangents: (points, 3) float32, None without functions.
    """

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

    @property
    def points(self) -> int:
        return len(self.positions)

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
    seen = bool(baked.functions)
    return RenderData(
        positions=np.ascontiguousarray(baked.positions, np.float32),
        albedo=np.ascontiguousarray(baked.albedo, np.float32),
        triangles=np.ascontiguousarray(baked.triangles, np.int32),
        encoding=encode(baked.cluster, baked.weights),
        clusters=clusters,
        vectors=vectors_and_mean - 1,
        rows=rows,
        columns=columns,
        cluster_vectors=used_vectors(baked.bases),
        functions=baked.functions,
        normals=np.ascontiguousarray(baked.normals, np.float32) if seen else None,
        tangents=np.ascontiguousarray(baked.tangents, np.float32) if seen else None,
    )


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
    for values in drawn + ([baked.normals, baked.tangents] if baked.functions else []):
        digest.update(repr((values.shape, values.dtype.str)).encode())
        digest.update(np.ascontiguousarray(values))
    return digest.hexdigest()


def light_signature(item: DrawItem) -> Hashable:
    """Changes when the exit radiance must be computed again: the light or the heat values changed."""
    heat = None if item.heat is None else np.asarray(item.heat, np.float32).tobytes()
    return np.asarray(item.light, np.float32).tobytes(), heat


def matching_light(light: ArrayLike, columns: int) -> NDArray[np.float32]:
    """The first `columns` coefficients of a light (n, 3). Raises BadScene when it has fewer."""
    coefficients = np.asarray(light, np.float32)
    if coefficients.ndim != 2 or coefficients.shape[1] != 3 or len(coefficients) < columns:
        raise BadScene(
            "the light",
            f"it has shape {coefficients.shape}, the bake expects ({columns}, 3)",
            "Bake the object again with the current settings",
        )
    return coefficients[:columns]


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
