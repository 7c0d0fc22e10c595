# SPDX-License-Identifier: GPL-3.0-or-later
"""Glossy transfer M_p = K R_p T_p, K = A^-1 B A^-1  (Sloan et al. 2003, section 3.1 and equation 1).

T_p takes distant light to incident radiance in the global frame, R_p turns that to the receiver's tangent frame, K (one
for each material) reflects it. Visibility comes in as SH coefficients from the shadow rays of direct transfer,
indirect light from the hits of the gather's rays.
"""

from __future__ import annotations

from collections.abc import Generator, Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from ..basis.directions import tangent_frames
from ..basis.hemisphere import Indices
from ..basis.spherical_harmonics import order_of, rotations
from ..basis.triple_product import triple_products
from ..linear_algebra import multiply, wide_batched_multiply
from ..tracing.tracer import Tracer
from .incident_light import BLOCK, NUMBERS, IndirectLight
from .positivity import OpenSurface, keep_positive


@dataclass(frozen=True)
class GlossySurfaces:
    """What reflects at g glossy receivers.

    frames: (g, 3, 3) orthonormal, rows tangent, bitangent, normal (`surface_frames`); material: (g,) places in kernels;
    kernels: K of each material, (rows, incident functions, channels), all of one shape; functions: of the rows, to keep
    the exit radiance above black in a white world (`positivity`); None leaves the rows as they are fitted.
    """

    frames: NDArray[np.float64]
    material: NDArray[np.int64]
    kernels: tuple[NDArray[np.float64], ...]
    functions: Indices | None = None

    def __post_init__(self) -> None:
        shapes = {np.shape(kernel) for kernel in self.kernels}
        if len(shapes) != 1 or len(next(iter(shapes))) != 3:
            raise ValueError(f"kernels must all be (rows, incident functions, channels), not {sorted(shapes)}")

    def __len__(self) -> int:
        return len(self.frames)

    @property
    def incident_order(self) -> int:
        """Order of the functions that incident radiance is expressed in."""
        return order_of(self.kernels[0].shape[1])

    @cached_property
    def open_surfaces(self) -> tuple[OpenSurface, ...]:
        """What each material returns of a white world; none where the rows' functions are not known."""
        return () if self.functions is None else tuple(OpenSurface.of(k, self.functions) for k in self.kernels)


def surface_frames(normals: NDArray[np.float64], tangents: NDArray[np.float64]) -> NDArray[np.float64]:
    """Frames (g, 3, 3), rows tangent, bitangent, normal, right-handed, of unit normals and tangents (g, 3).

    The tangent's part along the normal is taken out; where nothing is left (or it isn't finite) any tangent serves.
    """
    tangent = tangents - np.sum(tangents * normals, axis=1, keepdims=True) * normals
    length = np.sqrt(np.sum(tangent ** 2, axis=1))
    usable = length > 1e-6
    frames = tangent_frames(normals)
    frames[usable, 0] = tangent[usable] / length[usable, None]
    frames[usable, 1] = np.cross(normals[usable], frames[usable, 0])
    return frames


class DirectLight(Protocol):
    """Light from the sky in some columns, for blocks of the receivers."""

    columns: int

    def incident(self, part: slice) -> NDArray[np.float32] | None:
        """T (b, incident functions, columns) in the global frame; None where direct light is left out."""

    def white(self, rows: NDArray[np.float32]) -> NDArray[np.float32]:
        """What rows (b, k, columns, channels) make of a white world: (b, k, channels), up to a factor."""


@dataclass(frozen=True)
class HarmonicLight:
    """Direct light in the spherical harmonics of an order, for incident functions of an order, from the visibility (g,
    k^2), k = incident order + order - 1, of VisibilityCoefficients."""

    order: int
    incident_order: int
    visible: NDArray[np.float32] | None

    @property
    def columns(self) -> int:
        """Functions."""
        return self.order ** 2

    def incident(self, part: slice) -> NDArray[np.float32] | None:
        """See DirectLight."""
        if self.visible is None:
            return None
        products = triple_products(self.incident_order, self.order).astype(np.float32)
        return multiply(self.visible[part], products).reshape(-1, self.incident_order ** 2, self.columns)

    @staticmethod
    def white(rows: NDArray[np.float32]) -> NDArray[np.float32]:
        """See DirectLight."""
        return rows[:, :, 0]


def glossy_transfer(tracer: Tracer, surfaces: GlossySurfaces, light_order: int, visible: NDArray[np.float32] | None,
                    indirect: IndirectLight | None = None, out: NDArray[np.float32] | None = None,
                    diffuse: NDArray[np.float32] | None = None) -> Generator[float, None, NDArray[np.float32]]:
    """Yield progress, return M (g, rows, light_order^2, channels) float32: `filled_rows` in spherical harmonics.

    visible: see `HarmonicLight`; None leaves direct light out.
    """
    if visible is None and indirect is None:
        raise ValueError("glossy_transfer needs the visibility, indirect light, or both")
    direct = HarmonicLight(light_order, surfaces.incident_order, visible)
    return (yield from filled_rows(tracer, surfaces, direct, indirect, out, diffuse))


def rows_shape(surfaces: GlossySurfaces, columns: int, indirect: IndirectLight | None) -> tuple[int, int, int, int]:
    """(g, rows, columns, channels) of a fill: as many channels as the kernels or the indirect light, whichever has
    more."""
    channels = surfaces.kernels[0].shape[2]
    if indirect is not None:
        channels = max(channels, indirect.source.values // columns)
    return len(surfaces), surfaces.kernels[0].shape[0], columns, channels


def filled_rows(tracer: Tracer, surfaces: GlossySurfaces, direct: DirectLight, indirect: IndirectLight | None = None,
                out: NDArray[np.float32] | None = None, diffuse: NDArray[np.float32] | None = None,
                ) -> Generator[float, None, NDArray[np.float32]]:
    """Yield progress, return M (g, rows, columns, channels) float32, see `rows_shape`, of any columns of distant light.

    indirect: light from other surfaces, of as many columns and 1 or 3 channels. out: an array of the result's shape to
    write into (it may be a part of a larger one, or lie on disk). diffuse: (g, columns * channels of the indirect
    light), takes what the indirect light adds to the unit-albedo diffuse row (of use for a glossy bounce: the gather
    operator knows the diffuse ones). tracer: for its threads; nothing is traced.
    """
    columns, shape = direct.columns, rows_shape(surfaces, direct.columns, indirect)
    out = np.empty(shape, np.float32) if out is None else out
    if out.shape != shape:
        raise ValueError(f"glossy_transfer: out must be {shape}, not {out.shape}")

    def fill(part: slice) -> None:
        incident = _incident(direct, part, indirect, diffuse)
        _reflect(surfaces, part, _to_surface(surfaces.frames[part], incident), columns, out[part], direct)

    for part, _ in tracer.map_in_order(fill, _blocks(surfaces, columns) if indirect is None else indirect.blocks()):
        yield part.stop / max(1, len(surfaces))
    return out


def reflected_light(tracer: Tracer, surfaces: GlossySurfaces, columns: int, indirect: IndirectLight,
                    ) -> Generator[float, None, NDArray[np.float32]]:
    """Yield progress, return M (g, rows, columns, channels) float32 of light from surfaces alone, of any columns.

    For the lights of a cloud, whose direct light is no part of a bake. Rows are as they are fitted, whatever
    `surfaces.functions` says: the bound of `positivity` is for a white world, which no column is here, and what lamps
    make of the surfaces around has no edge as sharp as the sky's beside a wall. Nor is there an order of light to
    window: a column is one light, whose image in the surfaces is held by the incident functions alone.
    """
    channels = max(surfaces.kernels[0].shape[2], indirect.source.values // columns)
    out = np.empty((len(surfaces), surfaces.kernels[0].shape[0], columns, channels), np.float32)
    fitted = GlossySurfaces(surfaces.frames, surfaces.material, surfaces.kernels)

    def fill(part: slice) -> None:
        incident, _ = indirect.transfer(part)
        _reflect(fitted, part, _to_surface(fitted.frames[part], incident), columns, out[part])

    for part, _ in tracer.map_in_order(fill, indirect.blocks()):
        yield part.stop / len(surfaces)
    return out


def _blocks(surfaces: GlossySurfaces, columns: int) -> Iterator[slice]:
    """Runs of receivers whose arrays stay bounded."""
    size = max(1, min(BLOCK, NUMBERS // (surfaces.kernels[0].shape[1] * columns)))
    for start in range(0, len(surfaces), size):
        yield slice(start, min(start + size, len(surfaces)))


def _incident(direct: DirectLight, part: slice, indirect: IndirectLight | None,
              diffuse: NDArray[np.float32] | None) -> NDArray[np.float32]:
    """T (b, incident functions, columns * channels) in the global frame, direct and indirect light together."""
    sky = direct.incident(part)
    if indirect is None:
        return sky
    incident, irradiance = indirect.transfer(part)
    if diffuse is not None:
        diffuse[part] = irradiance
    if sky is not None:
        incident.reshape(*sky.shape, -1)[...] += sky[..., None]
    return incident


def _to_surface(frames: NDArray[np.float64], incident: NDArray[np.float32]) -> NDArray[np.float32]:
    """R_p T_p: rows of T (b, n^2, values) turned into the frames, band by band."""
    result = np.empty_like(incident)
    for band, block in enumerate(rotations(order_of(incident.shape[1]), frames)):
        rows = slice(band * band, (band + 1) ** 2)
        wide_batched_multiply(block.astype(np.float32), incident[:, rows], out=result[:, rows])
    return result


def _reflect(surfaces: GlossySurfaces, part: slice, incident: NDArray[np.float32], columns: int,
             out: NDArray[np.float32], direct: DirectLight | None = None) -> None:
    """K times incident radiance (b, n^2, columns * channels) in the tangent frame, into out (b, rows, columns,
    channels). The kernels of each material are shared by its receivers."""
    material = surfaces.material[part]
    for number in np.unique(material):
        members = np.flatnonzero(material == number)
        light = incident if len(members) == len(material) else incident[members]
        light = light.reshape(*light.shape[:2], columns, -1)
        kernel = np.asarray(surfaces.kernels[number], np.float32)
        reflected = [wide_batched_multiply(np.ascontiguousarray(kernel[None, :, :, min(c, kernel.shape[2] - 1)]),
                                           np.ascontiguousarray(light[..., min(c, light.shape[3] - 1)]))
                     for c in range(out.shape[3])]
        place = slice(None) if len(members) == len(material) else members
        rows = np.stack(reflected, axis=-1)
        if surfaces.open_surfaces:
            keep_positive(rows, surfaces.open_surfaces[number], direct and direct.white(rows))
        out[place] = rows
