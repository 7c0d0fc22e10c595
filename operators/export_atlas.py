# SPDX-License-Identifier: GPL-3.0-or-later
"""What an export writes of bakes at texels beside the arrays: pictures in their atlases, and the surface with its UVs.

Light and weights go beyond charts' rims, so that whoever filters the pictures blends nothing in from outside.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..prt_addon.relighting.texel_light import atlas_picture
from ..prt_addon.storage.container import BakedTransfer
from ..prt_addon.storage.exr import write_exr
from ..prt_addon.storage.files import write_atomically
from .relit import Lit

RINGS = 4  # of texels beyond charts

FILES = {
    "light.exr": "the light that leaves the surface now (R, G, B), scene-linear, albedo included, as a lightmap",
    "weights.exr": "channels cluster, w000, w001, ...: of each texel; evaluate texels first, then filter",
    "surface.obj": "the surface with its UVs into the pictures, world space when baked, metres, Z up",
}


def export_atlases(baked: dict[str, BakedTransfer], folder: Path, lit: Lit) -> Iterator[Path]:
    """Write the pictures of all bakes at texels; the paths as they are done. Raises PRTError, StorageError."""
    for number, (name, transfer) in enumerate(baked.items()):
        if transfer.texels is None:
            continue
        stem = f"{number:04d}_{file_name(name)}"
        light = atlas_picture(transfer.texels, lit.radiance(name, transfer), RINGS)
        yield _written(folder / f"{stem}_light.exr", dict(zip("RGB", np.moveaxis(light, 2, 0), strict=True)))
        yield _written(folder / f"{stem}_weights.exr", weight_channels(transfer))
        yield _write_obj(folder / f"{stem}_surface.obj", transfer)


def weight_channels(baked: BakedTransfer) -> dict[str, NDArray[np.float32]]:
    """The cluster and weights of each texel as channels; -1 where there is no texel."""
    values = np.concatenate([baked.cluster[:, None].astype(np.float32) + 1.0, baked.weights], axis=1)
    picture = atlas_picture(baked.texels, values)
    channels = {"cluster": picture[..., 0] - 1.0}
    return channels | {f"w{k:03d}": picture[..., 1 + k] for k in range(baked.weights.shape[1])}


def file_name(name: str) -> str:
    """A name that every file system takes."""
    return "".join(c if c.isalnum() or c in "-_." else "_" for c in name)[:80]


def _written(path: Path, channels: dict[str, NDArray[np.float32]]) -> Path:
    write_exr(path, channels)
    return path


def _write_obj(path: Path, baked: BakedTransfer) -> Path:
    """The surface as a Wavefront file: each corner has a UV of its own."""
    surface = baked.texels
    places = (surface.places.reshape(-1, 2) + 0.5) / np.array([surface.width, surface.height])
    corner, places_of = surface.triangles + 1, np.arange(3 * len(surface.triangles)).reshape(-1, 3) + 1
    faces = np.stack([corner, places_of, corner], axis=2).reshape(-1, 9)
    text = "# written by PRT\n" + "".join(_rows(template, values) for template, values in (
        ("v %.9g %.9g %.9g\n", surface.points), ("vt %.7f %.7f\n", places), ("vn %.6f %.6f %.6f\n", surface.normals),
        ("f %d/%d/%d %d/%d/%d %d/%d/%d\n", faces)))
    content = text.encode()
    write_atomically(path, lambda stream: stream.write(content) and None)
    return path


def _rows(template: str, values: NDArray[np.generic]) -> str:
    """A line for each row of values (n, k), all in one go."""
    return template * len(values) % tuple(values.ravel().tolist())
