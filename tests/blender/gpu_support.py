# SPDX-License-Identifier: GPL-3.0-or-later
"""Shared by the GPU tests: the checkout as package `prt`, made-up bakes, and a loud skip where no GPU can be had."""

from __future__ import annotations

import sys
import types
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest

ROOT = Path(__file__).parents[2]


def use_checkout_as_package() -> None:
    """Make `import prt.gpu_shaders...` work: its relative imports need the root as a package, as in the extension."""
    if "prt" not in sys.modules:
        package = types.ModuleType("prt")
        package.__path__ = [str(ROOT)]
        sys.modules["prt"] = package


use_checkout_as_package()


def require_gpu() -> None:
    """Skip the calling test, with a warning, where Blender finds no graphics driver."""
    from prt.gpu_shaders import offscreen
    from prt.prt_addon.errors import PRTError

    try:
        offscreen.prepare_gpu()
    except PRTError as error:
        warnings.warn(f"GPU TESTS DO NOT RUN HERE: {error}", stacklevel=2)
        pytest.skip(str(error))


def grid_mesh(side: int, generator: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """A bumpy square of side x side points in the plane z = 0 +- 0.05, spanning -1..1: points and triangles."""
    ticks = np.linspace(-1.0, 1.0, side)
    x, y = np.meshgrid(ticks, ticks, indexing="ij")
    points = np.stack([x, y, generator.uniform(-0.05, 0.05, x.shape)], axis=-1).reshape(-1, 3)
    corner = (np.arange(side - 1)[:, None] * side + np.arange(side - 1)).reshape(-1)
    triangles = np.concatenate(
        [np.stack([corner, corner + side, corner + 1], 1), np.stack([corner + 1, corner + side, corner + side + 1], 1)]
    )
    return points.astype(np.float32), triangles.astype(np.int32)


def made_up_bake(
    points: np.ndarray,
    triangles: np.ndarray,
    generator: np.random.Generator,
    clusters: int = 1,
    vectors: int = 0,
    channels: int = 1,
    rows: int = 1,
    columns: int = 25,
    functions: tuple[int, ...] = (),
) -> Any:
    """A BakedTransfer with random numbers in every place: nothing that the shaders must not mix up is equal.

    functions: of the view; they bring rows, normals that lean by up to 30 degrees and tangents with them.
    """
    from prt.prt_addon.storage.container import BakedTransfer, hemisphere_rows, make_header

    count, rows = len(points), rows + len(functions)
    shape = (clusters, vectors + 1, rows, columns, channels)
    bases = generator.normal(0.0, 0.02, shape)
    # Bright enough under `bright_light` that nothing is clipped at black.
    bases[:, 0, : rows - len(functions), 0] += 1.0
    rows_header = hemisphere_rows(functions) if functions else {"kind": "constant"}
    normals, tangents = leaning_frames(count, generator) if functions else (np.tile((0.0, 0.0, 1.0), (count, 1)), None)
    return BakedTransfer(
        header=make_header(shape, {"kind": "spherical_harmonics", "order": round(columns**0.5)}, rows_header),
        cluster=generator.integers(0, clusters, count).astype(np.int32),
        weights=generator.uniform(-1.0, 1.0, (count, vectors)).astype(np.float32),
        bases=bases.astype(np.float32),
        albedo=generator.uniform(0.1, 0.9, (count, 3)).astype(np.float32),
        positions=points,
        normals=normals.astype(np.float32),
        triangles=triangles,
        tangents=None if tangents is None else tangents.astype(np.float32),
    )


def leaning_frames(count: int, generator: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Unit normals within 30 degrees of z and tangents orthogonal to them, (count, 3) each."""
    normals = np.concatenate([generator.uniform(-0.4, 0.4, (count, 2)), np.ones((count, 1))], axis=1)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    across = np.stack([generator.uniform(-0.5, 0.5, count), np.ones(count), np.zeros(count)], axis=1)
    tangents = np.cross(across, normals)
    return normals, tangents / np.linalg.norm(tangents, axis=1, keepdims=True)


def bright_light(columns: int, generator: np.random.Generator) -> np.ndarray:
    """Light coefficients (columns, 3) with a strong constant part of three different colours."""
    light = generator.normal(0.0, 0.3, (columns, 3))
    light[0] = (4.0, 2.0, 3.0)
    return light


def expected_radiance(baked: Any, light: np.ndarray) -> np.ndarray:
    """Unit-albedo exit radiance (points, rows, 3) in float64, straight from the definition of the container."""
    bases = baked.bases.astype(np.float64)
    if bases.shape[-1] == 1:
        bases = np.repeat(bases, 3, axis=-1)
    weights = np.concatenate([np.ones((len(baked.cluster), 1)), baked.weights], axis=1)
    lit = np.einsum("cvrnk,nk->cvrk", bases, light[: bases.shape[3]])
    return np.einsum("pv,pvrk->prk", weights, lit[baked.cluster])
