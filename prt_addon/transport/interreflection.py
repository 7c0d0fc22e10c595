# SPDX-License-Identifier: GPL-3.0-or-later
"""Diffuse interreflection of all lighting columns at once: T = T_direct + G rho T.

Bounces are added one by one (a Neumann series: bounce k is what light does after k reflections) until the energy left
is below the asked error. In a closed bright room the series dies out as albedo^k, hundreds of bounces at 0.99; there
a Krylov method (BiCGSTAB, van der Vorst 1992) solves the same equation in tens of products, in double precision.
"""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from .krylov import SMALLEST, bicgstab_cycle, column_norm

# A ratio of successive bounces above this is a slow series: 1/(1-0.7) = 3.3 times the steps of BiCGSTAB at equal error.
SLOW_RATIO = 0.7
# A closed room that reflects everything has no finite answer; no material reflects more than fresh snow or spectralon.
LARGEST_ALBEDO = 0.995
MAXIMUM_STEPS = 500


@dataclass(frozen=True)
class Interreflection:
    """transfer: (r, columns, channels) float32 with all bounces; bounces: how many were added one by one, or -1 where
    the Krylov solver took all; method: "series" or "BiCGSTAB"; residual: relative, of the equation (series: the energy
    estimated to be left); steps: sparse products used; history: relative energy of each bounce (or residual)."""

    transfer: NDArray[np.float32]
    bounces: int
    method: str
    residual: float
    steps: int
    history: list[float]


def limited_albedo(albedo: NDArray[np.float32]) -> NDArray[np.float32]:
    """Albedo at most LARGEST_ALBEDO, see there."""
    return np.minimum(albedo, np.float32(LARGEST_ALBEDO))


def interreflect(matrix: sparse.csr_matrix, albedo: NDArray[np.float32], direct: NDArray[np.float32],
                 tolerance: float, bounces: int = -1) -> Generator[float, None, Interreflection]:
    """Yield progress, return the transfer with interreflection.

    matrix: the gather operator (r, r); albedo: (r, channels), 1 or 3; direct: (r, columns) float32 unit-albedo
    transfer; tolerance: relative energy that may be left out; bounces: exactly so many, -1 for as many as it takes.
    """
    channels = albedo.shape[1]
    term = np.repeat(direct[:, :, None], channels, axis=2)
    total = term.copy()
    history: list[float] = []
    norm = previous = max(_norm(term), np.finfo(np.float64).tiny)
    limit = MAXIMUM_STEPS if bounces < 0 else bounces
    left = 0.0
    for step in range(limit):
        term = _bounce(matrix, albedo, term)
        total += term
        size = _norm(term)
        ratio = size / max(previous, np.finfo(np.float64).tiny)
        previous = size
        history.append(size / norm)
        # The terms left form at most a geometric series with the last ratio.
        left = size / norm * (ratio / (1.0 - ratio) if ratio < 1.0 else 1.0)
        yield (step + 1) / (limit if bounces >= 0 else step + 3)
        if bounces < 0 and left <= tolerance:
            break
        if bounces < 0 and step >= 3 and ratio > SLOW_RATIO:
            return (yield from _krylov(matrix, albedo, direct, total, tolerance, history))
    return Interreflection(total, len(history), "series", left, len(history), history)


def _norm(values: NDArray[np.floating]) -> float:
    return float(np.sqrt(np.sum(np.square(values, dtype=np.float64))))


def _bounce(matrix: sparse.csr_matrix, albedo: NDArray[np.floating], transfer: NDArray[np.floating]) -> NDArray:
    """G rho T: reflect at the albedo of the surface that is seen, gather at the receiver."""
    reflected = transfer * albedo[:, None, :]
    return (matrix * reflected.reshape(len(transfer), -1)).reshape(transfer.shape)


def _krylov(matrix: sparse.csr_matrix, albedo: NDArray[np.float32], direct: NDArray[np.float32],
            start: NDArray[np.float32], tolerance: float, history: list[float],
            ) -> Generator[float, None, Interreflection]:
    """BiCGSTAB on (I - G rho) T = T_direct, every column with scalars of its own, from the series so far."""
    operator, rho = matrix.astype(np.float64), albedo.astype(np.float64)
    right = np.repeat(direct[:, :, None].astype(np.float64), albedo.shape[1], axis=2)
    solution = start.astype(np.float64)

    def apply(values: NDArray[np.float64]) -> NDArray[np.float64]:
        return values - _bounce(operator, rho, values)

    size = np.maximum(column_norm(right), SMALLEST)
    steps = len(history)
    worst = np.inf
    while steps < MAXIMUM_STEPS:
        residual = right - apply(solution)
        steps += 1
        worst = float((column_norm(residual) / size).max())
        if worst <= tolerance:
            break
        # Restarted every CYCLE steps and on breakdown: the true residual is taken anew, rounding can't pile up.
        used = yield from bicgstab_cycle(apply, solution, residual, size, tolerance, history)
        steps += used
    return Interreflection(solution.astype(np.float32), -1, "BiCGSTAB", worst, steps, history)
