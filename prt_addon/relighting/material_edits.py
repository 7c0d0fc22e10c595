# SPDX-License-Identifier: GPL-3.0-or-later
"""Bounced light after materials were edited, from the light that was baked: nothing is baked or traced anew.

With B = rho I + e, the light that leaves, and I = D + F B, the light that arrives, a bake knows I_0 for rho_0 and
e = 0. Other albedos rho and an emission e change what leaves by dB = B - rho_0 I_0, and since D stays,

    dB = S + rho F dB,   S = (rho - rho_0) I_0 + e,   I = I_0 + F dB:

matrix radiosity with S for an emittance (Carr et al. 2003: reflectances and emittances may change, geometry may not).
Direct light need not be known apart from bounced light, an unedited scene costs nothing and changes nothing, and
whatever the stored form factors are off by counts only for what was edited.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..linear_algebra import sparse_multiply_few
from ..transport.form_factors import radius_bound, row_sums
from ..transport.interreflection import limited_albedo
from ..transport.live_operator import LiveOperator
from ..transport.radiosity import (
    JACOBI,
    Radiosity,
    choose_solver,
    predicted_cost,
    predicted_iterations,
    solve_radiosity,
)

Single = NDArray[np.float32]
# Relative, of the change of light, which itself is a part of the light: less than what sampled rows are off by.
TOLERANCE = 3e-3
LEAST_SHARE = 0.05  # of a diffuse layer: below, what was baked says too little of the light that arrived
Solve = Callable[[Single, Single, Single | None], Radiosity]


@dataclass
class MaterialEdits:
    """Answers to edits of the materials of one bake, each started from the last. operator: of the bake; on_gpu: solves
    (albedo, emittance, start) by Jacobi elsewhere, None to solve here always; gpu_cost: of an iteration there, in
    sparse products here; used_gpu: by the last answer."""

    operator: LiveOperator
    on_gpu: Solve | None = None
    gpu_cost: float = np.inf
    used_gpu: bool = False
    _last: tuple[Single, Single] | None = None
    _sums: NDArray[np.float64] | None = None

    def arriving(self, baked_row: Single) -> Single:
        """The light that arrived I_0 (n, 3), of the baked diffuse row (points, 3) of the baked objects under the
        present light; 0 where nothing was baked."""
        light = np.zeros_like(self.operator.albedo)
        light[:len(baked_row)] = baked_row / np.maximum(self.operator.share[:len(baked_row), None], LEAST_SHARE)
        return light

    def added(self, change: Single, emission: Single, light: Single, glow: Single | None = None,
              ) -> tuple[Single, Radiosity]:
        """What F dB adds to the baked diffuse row (n, 3), and how it was found.

        change: (n, 3) of the albedos since the bake; emission: (n, 3), radiance; light: I_0, of `arriving`; glow:
        (points, 3), what arrives of the emission before any bounce where that is known better (`glowing_surfaces`).
        Raises BadScene where light would grow without end.
        """
        operator = self.operator
        albedo = limited_albedo(np.maximum(operator.albedo + operator.share[:, None] * change, np.float32(0.0)))
        direct = np.zeros_like(light)
        if glow is not None:  # dB = e + X with X = (rho - rho_0) I_0 + rho F e + rho F X, where F e is taken from glow
            direct = sparse_multiply_few(operator.matrix, emission)
            direct[:len(glow)] = glow
            emission = albedo * direct
        source = (albedo - operator.albedo) * light + emission
        found = self._solve(albedo, source, self._start(source))
        self._last = source, found.radiosity
        return (direct + sparse_multiply_few(operator.matrix, found.radiosity)) * operator.share[:, None], found

    def _start(self, source: Single) -> Single | None:
        """The last answer where this one is nearer to it than to none."""
        if self._last is None or not np.isfinite(self._last[1]).all():
            return None
        moved = float(np.sum(np.square(source - self._last[0], dtype=np.float64)))
        return self._last[1] if moved < float(np.sum(np.square(source, dtype=np.float64))) else None

    def _solve(self, albedo: Single, source: Single, start: Single | None) -> Radiosity:
        if self._sums is None:
            self._sums = row_sums(self.operator.matrix)
        bound = radius_bound(self.operator.matrix, albedo, self._sums)
        here = predicted_cost(choose_solver(bound, TOLERANCE), bound, TOLERANCE)
        self.used_gpu = self.on_gpu is not None and \
            self.gpu_cost * predicted_iterations(JACOBI, bound, TOLERANCE) < here
        if self.used_gpu:
            return self.on_gpu(albedo, source, start)
        return solve_radiosity(self.operator.matrix, albedo, source, tolerance=TOLERANCE, start=start,
                               sums=self._sums)
