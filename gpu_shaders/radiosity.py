# SPDX-License-Identifier: GPL-3.0-or-later
"""Matrix radiosity on the GPU: Jacobi iterations in a compute shader. Needs an active GPU context; main thread only."""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial

import bpy
import gpu
import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from ..prt_addon.errors import PRTError
from ..prt_addon.linear_algebra import sparse_multiply_few
from ..prt_addon.relighting.material_edits import TOLERANCE
from ..prt_addon.transport.form_factors import check_exits
from ..prt_addon.transport.radiosity import JACOBI, MOST_ITERATIONS, Radiosity
from . import radiosity_texels
from .compute_program import GROUP_SIZE
from .draw import make_texture, read_texture
from .render_data import texture_values

# Iterations between two looks at the residual: reading a texture back waits for the GPU.
BATCH = 8
MEASURED = 6  # iterations by which the GPU's speed is told


class RadiosityOnGpu:
    """A matrix of form factors on the GPU, to solve with again and again."""

    def __init__(self, matrix: sparse.csr_matrix) -> None:
        self.matrix = matrix
        found = radiosity_texels.radiosity_texels(matrix)
        self._receivers = found.receivers
        self._entries, self._rows = make_texture(found.entries), make_texture(found.rows)

    def solve(self, albedo: NDArray[np.floating], emittance: NDArray[np.floating],
              start: NDArray[np.floating] | None = None, tolerance: float = 1e-4,
              most: int = MOST_ITERATIONS) -> Radiosity:
        """As `solve_radiosity` by Jacobi, in single precision; albedo, emittance, start: (r, 3).

        The history has one residual for each batch of iterations, that before its last one. Raises BadScene where
        light would grow without end.
        """
        check_exits(self.matrix, albedo)
        began = time.perf_counter()
        size = float(np.sqrt(np.sum(np.square(emittance, dtype=np.float64))))
        if size == 0.0:
            return Radiosity(np.zeros_like(emittance, np.float32), JACOBI, 0, 0.0)
        fixed = make_texture(texture_values(albedo)), make_texture(texture_values(emittance))
        now = make_texture(texture_values(emittance if start is None else start))
        after = gpu.types.GPUTexture((now.width, now.height), format="RGBA32F")
        history: list[float] = []
        seconds: list[float] = []
        iterations = 0
        while True:
            for _ in range(BATCH):
                self._iterate(fixed, now, after)
                now, after = after, now
            iterations += BATCH
            values = read_texture(now).reshape(-1, 4)[:self._receivers]
            history.append(float(np.sqrt(np.sum(values[:, 3], dtype=np.float64))) / size)
            seconds.append(time.perf_counter() - began)
            if history[-1] <= tolerance or iterations >= most or not np.isfinite(history[-1]):
                return Radiosity(values[:, :3].copy(), JACOBI, iterations, history[-1], history, seconds)

    def seconds(self, iterations: int) -> float:
        """What so many iterations take, from start to their values read back."""
        black = make_texture(texture_values(np.zeros((self._receivers, 3), np.float32)))
        after = gpu.types.GPUTexture((black.width, black.height), format="RGBA32F")
        began = time.perf_counter()
        for _ in range(iterations):
            self._iterate((black, black), black, after)
        read_texture(after)
        return time.perf_counter() - began

    def _iterate(self, fixed: tuple[gpu.types.GPUTexture, gpu.types.GPUTexture], now: gpu.types.GPUTexture,
                 after: gpu.types.GPUTexture) -> None:
        program = radiosity_texels.JACOBI.shader()
        program.bind()
        textures = (self._entries, self._rows, *fixed, now)
        for name, texture in zip(radiosity_texels.JACOBI.samplers, textures, strict=True):
            program.uniform_sampler(name, texture)
        program.image("next_values", after)
        program.uniform_int("receivers", self._receivers)
        gpu.compute.dispatch(program, after.width // GROUP_SIZE, after.height, 1)


def measured_solver(matrix: sparse.csr_matrix) -> tuple[Callable[..., Radiosity] | None, float]:
    """The GPU's `solve`, and what one of its iterations costs in sparse products of the CPU, as measured here; None and
    infinity without a GPU that can."""
    if bpy.app.background:
        return None, np.inf
    values = np.ones((matrix.shape[0], 3), np.float32)
    sparse_multiply_few(matrix, values)
    began = time.perf_counter()
    sparse_multiply_few(matrix, values)
    product = max(time.perf_counter() - began, 1e-9)
    try:
        solver = RadiosityOnGpu(matrix)
        solver.seconds(1)  # compiles
        once, more = solver.seconds(1), solver.seconds(1 + MEASURED)
    except (PRTError, RuntimeError, SystemError, ValueError):  # a driver that can't: the CPU always can
        return None, np.inf
    return partial(solver.solve, tolerance=TOLERANCE), max(more - once, 0.1 * more) / MEASURED / product
