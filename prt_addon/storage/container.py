# SPDX-License-Identifier: GPL-3.0-or-later
"""Baked transfer of one object, and how it is laid out in attributes, properties and files (design/contract.md)."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import StorageError
from ..lighting.light_cloud import LightCloud
from ..lighting.lit_surfaces import LitSurfaces, LocalBasis
from ..relighting.lamp_highlights import LampSurfaces
from ..relighting.live_scattering import SubsurfaceLinks
from ..scene.texel_surface import TexelSurface
from ..transport.live_operator import LiveOperator
from .columns import LIT_SURFACES, Columns, cloud_part, cubemap_size, read_columns
from .lamp_surfaces import read_lamp_surfaces
from .subsurface_links import read_links
from .texels import ENTRY as ATLAS_ENTRY

# Highest that is read; 1: constant rows only; 2: rows of the view, too; 3: columns of a light cloud, too; 4: of a
# cubemap, too; 5: points that are texels, too.
SCHEMA = 5
CLUSTER_ATTRIBUTE = "prt_cluster"
WEIGHTS_ATTRIBUTE = "prt_weights_"
ALBEDO_ATTRIBUTE = "prt_albedo"
HEADER_PROPERTY = "prt_header"
BASES_PROPERTY = "prt_bases"
CLOUD_PROPERTY = "prt_cloud"
MATERIAL_ATTRIBUTE = "prt_material"
ERROR_ATTRIBUTE = "prt_error"
SOURCE_ATTRIBUTE = "prt_source"
KERNELS_PROPERTY = "prt_kernels"
LIVE_ENTRY = "live_editing"  # in headers: which form factors, and where its rows begin; also a setting's name
LINKS_PROPERTY = "prt_links"
REBAKE = "Bake the object again"
CONSTANT_ROWS: dict[str, Any] = {"kind": "constant"}
HEMISPHERE_KIND = "constant_and_hemisphere"
MOST_FUNCTIONS = 100  # of order 10, the highest of any basis here


def hemisphere_rows(functions: Sequence[int]) -> dict[str, Any]:
    """`rows` of a header: row 0 the diffuse one, then one row per function y_i of the exit direction, i = l(l+1)+m."""
    return {"kind": HEMISPHERE_KIND, "functions": [int(index) for index in functions]}


@dataclass(frozen=True)
class BakedTransfer:
    """Compressed transfer M_p of one object's receivers: M_p = bases[c, 0] + sum_k weights[p, k] bases[c, k + 1].

    header: JSON-able dict (see `make_header`); cluster: (p,) int32; weights: (p, vectors) float32;
    bases: (clusters, vectors + 1, rows, columns, channels) float32, vector 0 the cluster mean;
    albedo: (p, 3) float32; positions, normals: (p, 3) float32 world space when baked; triangles: (t, 3) int32;
    tangents: (p, 3) float32 likewise, unit, orthogonal to the normals; None where the only row is the diffuse one.
    cloud: the local lights or lit surfaces that columns belong to, world space when baked; None where all columns are
    distant light's.
    lamp_surfaces: what materials do to the direct light of lamps, where there are a cloud and view-dependent rows.
    source: (t,) int32, which of the source mesh's triangles each one is or is a part of; None in bakes that did not
    keep it. error: (p,) float32, how far off M_p is, relative to the RMS of the object's transfer; None likewise.
    live: the form factors of the whole bake, on one of its objects, where it keeps them for edits of materials.
    texels: the surface that points lie on where they are texels, triangles then joining neighbouring ones; None where
    points are vertices.
    links: for the light of lamps through translucent parts, where it was asked for.

    Exit radiance towards a view is albedo * row 0 + sum_i y_i(view) * row i over `functions`, the view in the frame of
    x tangent, y normal x tangent, z normal.
    """

    header: dict[str, Any]
    cluster: NDArray[np.int32]
    weights: NDArray[np.float32]
    bases: NDArray[np.float32]
    albedo: NDArray[np.float32]
    positions: NDArray[np.float32]
    normals: NDArray[np.float32]
    triangles: NDArray[np.int32]
    tangents: NDArray[np.float32] | None = None
    cloud: LocalBasis | None = None
    lamp_surfaces: LampSurfaces | None = None
    source: NDArray[np.int32] | None = None
    error: NDArray[np.float32] | None = None
    live: LiveOperator | None = None
    texels: TexelSurface | None = None
    links: SubsurfaceLinks | None = None

    @property
    def drawn(self) -> tuple[NDArray[np.floating], NDArray[np.int32], NDArray[np.int32] | None]:
        """Positions, triangles and their sources of the surface itself: of its vertices, also where points are texels.
        """
        if self.texels is None:
            return self.positions, self.triangles, self.source
        return self.texels.points.astype(np.float32), self.texels.triangles, self.texels.source

    @property
    def faces(self) -> NDArray[np.float64] | None:
        """(p, 3) unit normals of the triangles that texels lie on; None for vertices."""
        return None if self.texels is None else self.texels.faces

    @property
    def material(self) -> NDArray[np.int32] | None:
        """(p,) int32, the place of each point's material in `kernels`; None without."""
        return None if self.lamp_surfaces is None else self.lamp_surfaces.material

    @property
    def kernels(self) -> NDArray[np.float32] | None:
        """(materials, functions, n^2, 1 or 3) float32: rows 1, 2, ... of a lamp's direct light; None without."""
        return None if self.lamp_surfaces is None else self.lamp_surfaces.kernels

    @property
    def functions(self) -> tuple[int, ...]:
        """The spherical harmonics y_i that rows 1, 2, ... belong to; none for diffuse transfer."""
        return tuple(self.header.get("rows", {}).get("functions", ()))

    @property
    def columns(self) -> int:
        """Number of lighting basis functions."""
        return self.bases.shape[3]

    @property
    def soft_highlights(self) -> bool:
        """Whether highlights reflect a light that rings less (`lighting.windowing.for_highlights`)."""
        return bool(self.header.get("settings", {}).get("glossy_window", False))

    @property
    def lighting_basis(self) -> Columns:
        """What the columns stand for."""
        part = cloud_part(self.header.get("columns"))
        cloud, size = 0 if part is None else int(part["columns"]), cubemap_size(self.header.get("columns"))
        return Columns(0 if size else math.isqrt(self.bases.shape[3] - cloud), cloud, size)

    @property
    def cluster_zone(self) -> NDArray[np.int32] | None:
        """(clusters,) int32, the zone of the light cloud that each cluster lies in; None without a cloud."""
        part = cloud_part(self.header.get("columns"))
        return None if part is None else np.array(part["cluster_zone"], np.int32)


def make_header(shape: tuple[int, ...], columns: dict[str, Any], rows: dict[str, Any], **extra: Any) -> dict[str, Any]:
    """The header of a container: schema, shapes, conventions, lighting and exit basis, and what the caller adds.

    shape: of the bases (clusters, vectors + 1, rows, columns, channels).
    """
    schema = 1 if rows.get("kind") == "constant" else 2
    for higher, applies in ((3, cloud_part(columns)), (4, cubemap_size(columns)), (5, ATLAS_ENTRY in extra)):
        schema = higher if applies else schema
    return {
        "schema": schema,
        "shape": [int(s) for s in shape],
        "columns": columns,
        "rows": rows,
        "conventions": {
            "axes": "Blender world: right-handed, Z up, metres",
            "spherical_harmonics": "real, orthonormal, index l(l+1)+m, no Condon-Shortley phase",
            "radiance": "W m^-2 sr^-1, linear Rec.709; the diffuse row is for unit albedo",
            "exit_frame": "x tangent, y normal x tangent, z normal; the exit direction points away from the surface",
        },
        **extra,
    }


def check_header(header: Any, subject: str) -> dict[str, Any]:
    """The header if this version can read it. Raises StorageError naming the subject otherwise."""
    if not isinstance(header, dict) or not isinstance(header.get("schema"), int):
        raise StorageError(subject, "its baked data has no readable header", REBAKE)
    if header["schema"] > SCHEMA:
        raise StorageError(subject, f"its baked data has schema {header['schema']}, this version reads up to {SCHEMA}",
                           "Update the extension, or bake the object again")
    shape = header.get("shape")
    if not (isinstance(shape, list) and len(shape) == 5 and all(type(s) is int and s > 0 for s in shape)):
        raise StorageError(subject, "the header of its baked data states no valid shape", REBAKE)
    _check_rows(header, subject)
    read_columns(header, subject, REBAKE)
    return header


def _check_rows(header: dict[str, Any], subject: str) -> None:
    """Raise StorageError where the rows are of no known kind or do not fit the shape."""
    stated, count = header.get("rows"), header["shape"][2]
    kind = stated.get("kind") if isinstance(stated, dict) else None
    functions = stated.get("functions", []) if kind == HEMISPHERE_KIND else []
    valid = kind in ("constant", HEMISPHERE_KIND) and isinstance(functions, list) and all(
        type(index) is int and 0 <= index < MOST_FUNCTIONS for index in functions)
    if not valid or len(set(functions)) != len(functions):
        raise StorageError(subject, "the header of its baked data states no valid rows", REBAKE)
    if count != 1 + len(functions):
        raise StorageError(subject, "the header of its baked data states no valid shape: "
                           f"{count} rows, of which {1 + len(functions)} are named", REBAKE)


def parse_header(text: str, subject: str) -> dict[str, Any]:
    """The header in a JSON text. Raises StorageError where it is broken or newer than this version."""
    try:
        header = json.loads(text)
    except (ValueError, TypeError) as error:
        raise StorageError(subject, f"the header of its baked data is not readable ({error})", REBAKE) from error
    return check_header(header, subject)


def pack_weights(weights: NDArray[np.float32]) -> list[NDArray[np.float32]]:
    """Weights (p, vectors) as FLOAT4 arrays (p, 4): weight k is component k % 4 of array k // 4, the rest zero."""
    points, vectors = weights.shape
    count = -(-vectors // 4)
    padded = np.zeros((points, 4 * count), np.float32)
    padded[:, :vectors] = weights
    return [np.ascontiguousarray(padded[:, 4 * k:4 * k + 4]) for k in range(count)]


def unpack(header: dict[str, Any], cluster: NDArray, packed_weights: list[NDArray], flat_bases: NDArray,
           geometry: tuple[NDArray, NDArray, NDArray, NDArray], subject: str, tangents: NDArray | None = None,
           flat_cloud: NDArray | None = None, material: NDArray | None = None, flat_kernels: NDArray | None = None,
           flat_links: NDArray | None = None) -> BakedTransfer:
    """The container from stored arrays, checked against the header.

    geometry: albedo, positions, normals (p, 3) and triangles (t, 3); tangents (p, 3) where rows need them; flat_cloud:
    of `flatten_cloud` where columns need it; material (p,) and flat_kernels where the header has lamp surfaces;
    flat_links where it has links.
    Raises StorageError where a shape, an index or a value can't be right, so that broken data is never drawn.
    """
    clusters, representatives, rows, columns, channels = check_header(header, subject)["shape"]
    points, vectors = len(cluster), representatives - 1
    albedo, positions, normals, triangles = geometry
    expected = clusters * representatives * rows * columns * channels
    if channels not in (1, 3):
        raise StorageError(subject, "the header of its baked data states no valid shape", REBAKE)
    if flat_bases.size != expected:
        raise StorageError(subject, f"its bases hold {flat_bases.size} numbers instead of {expected}", REBAKE)
    if len(packed_weights) != -(-vectors // 4) or any(w.shape != (points, 4) for w in packed_weights):
        raise StorageError(subject, "its weights do not fit the header", REBAKE)
    if len(positions) != points or len(albedo) != points or len(normals) != points:
        raise StorageError(subject, f"the mesh has {len(positions)} points, the baked data {points}", REBAKE)
    if points and not (int(cluster.min()) >= 0 and int(cluster.max()) < clusters):
        raise StorageError(subject, "a cluster index is out of range", REBAKE)
    if rows == 1:
        tangents = None
    elif tangents is None or len(tangents) != points:
        raise StorageError(subject, "its baked data has view-dependent rows but no tangents", REBAKE)
    weights = np.concatenate([*packed_weights, np.zeros((points, 0), np.float32)], axis=1)[:, :vectors]
    bases = np.asarray(flat_bases, np.float32).reshape(clusters, representatives, rows, columns, channels)
    if not all(np.isfinite(values).all() for values in (bases, weights, albedo, positions, normals)) or (
            tangents is not None and not np.isfinite(tangents).all()):
        raise StorageError(subject, "its baked data holds values that are not finite", REBAKE)
    return BakedTransfer(header, np.asarray(cluster, np.int32), np.asarray(weights, np.float32), bases,
                         np.asarray(albedo, np.float32), np.asarray(positions, np.float32),
                         np.asarray(normals, np.float32), np.asarray(triangles, np.int32),
                         None if tangents is None else np.asarray(tangents, np.float32),
                         read_cloud(header, flat_cloud, subject),
                         read_lamp_surfaces(header, material, flat_kernels, points, subject, REBAKE),
                         links=read_links(header, flat_links, points, subject, REBAKE))


def flatten_cloud(cloud: LocalBasis) -> NDArray[np.floating]:
    """A cloud's positions as one list of numbers: its zones' lights, then the lights of the cloud before merging. Of
    lit surfaces: the triangles' corners, the corners' patches (whole numbers below 2^24), the axes, all float32."""
    if isinstance(cloud, LitSurfaces):
        return np.concatenate([cloud.corners.ravel(), cloud.patch.ravel(), cloud.axes.ravel()]).astype(np.float32)
    return np.concatenate([cloud.positions.ravel(), cloud.dense.ravel()])


def read_cloud(header: dict[str, Any], flat_cloud: NDArray | None, subject: str) -> LocalBasis | None:
    """The light cloud, or lit surfaces, of a header and its list of numbers; None where the header states none. Raises
    StorageError."""
    part = cloud_part(header.get("columns"))
    if part is None:
        return None
    if part["kind"] == LIT_SURFACES:
        return _read_surfaces(part, flat_cloud, subject)
    starts = np.concatenate([[0], np.cumsum(part["lights"])])
    numbers = None if flat_cloud is None else np.asarray(flat_cloud, np.float64)
    if numbers is None or numbers.size % 3 or numbers.size < 3 * starts[-1] or not np.isfinite(numbers).all():
        raise StorageError(subject, "the lights of its light cloud are missing or broken", REBAKE)
    places = numbers.reshape(-1, 3)
    return LightCloud(places[:starts[-1]], starts, part["emission_order"], places[starts[-1]:], part["spacing"],
                      part["radius"])


def _read_surfaces(part: dict[str, Any], flat: NDArray | None, subject: str) -> LitSurfaces:
    """Lit surfaces of their part of a header and their list of numbers. Raises StorageError."""
    triangles, patches, columns = part["triangles"], part["patches"], part["columns"]
    numbers = None if flat is None else np.asarray(flat, np.float64)
    if numbers is None or numbers.size != 12 * triangles + columns * patches or not np.isfinite(numbers).all():
        raise StorageError(subject, "the surfaces that lamps shine on are missing or broken", REBAKE)
    corners, patch, axes = np.split(numbers, [9 * triangles, 12 * triangles])
    if triangles and not (patch.min() >= -1 and patch.max() < patches):
        raise StorageError(subject, "the surfaces that lamps shine on are missing or broken", REBAKE)
    return LitSurfaces(corners.reshape(-1, 3, 3).astype(np.float32), patch.reshape(-1, 3).astype(np.int32),
                       axes.reshape(columns, patches).astype(np.float32))
