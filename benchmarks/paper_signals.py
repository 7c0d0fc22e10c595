# SPDX-License-Identifier: GPL-3.0-or-later
"""Transfer signals like those of Sloan et al. 2003, from the bake's own fill, kept as .npy files.

The paper's Buddha is the one of the shared meshes (49,990 vertices). Its smooth bird (48,668 vertices) is not
published; the horse (48,485 vertices) stands in for it: smooth, of the same size, and its transfer is shadowing alone,
as the bird's.
"""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from common import load_obj, mesh_path, smooth_object
from numpy.typing import NDArray

from prt_addon.baking.recipe import _Bake
from prt_addon.baking.settings import BakeSettings
from prt_addon.basis.hemisphere import functions_of, gram_matrix
from prt_addon.scene.scene_mesh import SceneMesh
from prt_addon.scene.surface_material import SurfaceMaterial

GLOSS = SurfaceMaterial("gloss", (0.8, 0.8, 0.8), roughness=0.4, metallic=1.0, specular_level=0.5)
ANISOTROPIC = replace(GLOSS, anisotropic=0.6)
# Mean free path of 1 % of the object's size (radius / 4 pi, see transport/dipole.py).
WAX = replace(GLOSS, metallic=0.0, subsurface_weight=1.0)


@dataclass(frozen=True)
class Signal:
    """What to bake: rows 0 is diffuse transfer; vectors: the paper's n' for it; bounces: 0 is shadowing alone."""

    mesh: str
    material: SurfaceMaterial | None
    rows: int
    order: int
    vectors: int
    bounces: int

    @property
    def metric(self) -> NDArray[np.float64] | None:
        """A (rows, rows), in which the squared error over the hemisphere of views is measured; None for diffuse."""
        return gram_matrix(functions_of(self.rows)) if self.rows else None


BUDDHA, HORSE = "buddha_nirj.obj", "vtk_horse.ply"
SIGNALS = {
    "diffuse 1 x 100": Signal(BUDDHA, None, 0, 10, 8, 1),
    "glossy 16 x 25": Signal(BUDDHA, GLOSS, 16, 5, 6, 1),
    "anisotropic 24 x 25": Signal(BUDDHA, ANISOTROPIC, 24, 5, 8, 1),
    "subsurface + gloss 25 x 25": Signal(BUDDHA, WAX, 25, 5, 8, 1),
    "horse diffuse 1 x 25": Signal(HORSE, None, 0, 5, 4, 0),
    "horse diffuse 1 x 100": Signal(HORSE, None, 0, 10, 8, 0),
    "horse anisotropic 24 x 25": Signal(HORSE, ANISOTROPIC, 24, 5, 8, 0),
}


class _Caught(Exception):
    """Ends a bake where its signals are known."""


class _Signals(_Bake):
    """A bake up to its encoding."""

    def _encode(self, signals: dict[str, NDArray[np.float32]]) -> Generator:
        self.signals = signals
        raise _Caught
        yield


def load_ply(path: Path) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    """Positions (v, 3) and triangles (t, 3) of a big-endian binary PLY file of triangles, vertices before faces."""
    content = path.read_bytes()
    end = content.index(b"end_header\n") + len(b"end_header\n")
    sizes = {"float32": ">f4", "uint8": "u1", "int32": ">i4"}
    counts, columns = {}, []
    for words in (line.split() for line in content[:end].decode().splitlines()):
        if words[0] == "element":
            counts[words[1]] = int(words[2])
        elif words[0] == "property" and words[1] != "list":
            columns.append((words[2], sizes[words[1]]))
    vertices = np.frombuffer(content, np.dtype(columns), counts["vertex"], end)
    faces = np.frombuffer(content, np.dtype([("corners", "u1"), ("triangle", ">i4", 3)]), counts["face"],
                          end + vertices.nbytes)
    if (faces["corners"] != 3).any():
        raise ValueError(f"{path}: only triangles are read")
    positions = np.stack([vertices[axis] for axis in "xyz"], axis=1).astype(np.float64)
    return positions, faces["triangle"].astype(np.int32)


def signal_of(name: str, cache: Path) -> NDArray[np.float32]:
    """(points, rows * columns) of one of SIGNALS, without the diffuse row where there are others."""
    path = cache / f"{name.replace(' ', '')}.npy"
    if path.exists():
        return np.load(path)
    wanted = SIGNALS[name]
    positions, triangles = (load_ply if wanted.mesh.endswith(".ply") else load_obj)(mesh_path(wanted.mesh))
    mesh = smooth_object("mesh", positions, triangles, (0.7, 0.7, 0.7))
    if wanted.material is not None:
        size = float(np.linalg.norm(np.ptp(positions, axis=0)))
        mesh = replace(mesh, materials=(replace(wanted.material, subsurface_radius=(0.01 * 4 * np.pi * size,) * 3),))
    settings = BakeSettings(order=wanted.order, directions=1024, gather_directions=128, bounces=wanted.bounces,
                            error_receivers=0, spacing=0.0, glossy_rows=wanted.rows, glossy_albedo=0.0)
    bake = _Signals(SceneMesh.assemble([mesh]), settings, None, None, {})
    try:
        for _ in bake.run():
            pass
    except _Caught:
        pass
    found = bake.signals["mesh"][..., 0]
    found = found[:, 1:] if wanted.rows else found
    cache.mkdir(parents=True, exist_ok=True)
    np.save(path, found.reshape(len(found), -1))
    return np.load(path)
