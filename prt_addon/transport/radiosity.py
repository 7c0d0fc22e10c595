# SPDX-License-Identifier: GPL-3.0-or-later
"""Matrix radiosity: B = E + rho F B, solved for all channels at once (Carr et al. 2003, section 3).

B, E and rho are radiosity, emittance and reflectance of receivers, F their form factors (`form_factors`). Four ways to
the same answer: Jacobi, which the GPU can take, too; Gauss-Seidel, about half the iterations, each one slower; and two
Krylov methods, whose iterations grow with the square root only where light dies out slowly (bright closed rooms).
`choose_solver` takes the one that is predicted to be done first.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse import linalg as sparse_linalg

from ..linear_algebra import sparse_multiply_few
from .form_factors import check_exits, radius_bound
from .krylov import SMALLEST, bicgstab_cycle, column_norm, conjugate_gradient_steps

JACOBI, GAUSS_SEIDEL, BICGSTAB, CONJUGATE_GRADIENTS = "jacobi", "gauss-seidel", "bicgstab", "conjugate-gradients"
METHODS = (JACOBI, GAUSS_SEIDEL, BICGSTAB, CONJUGATE_GRADIENTS)
# What an iteration costs in units of one sparse product in single precision (benchmarks/radiosity.py prints them).
RELATIVE_COSTS: Mapping[str, float] = {JACOBI: 1.0, GAUSS_SEIDEL: 1.0, BICGSTAB: 2.1}
# Preparing Gauss-Seidel (a triangular factor for each channel), and what a Krylov method does before its first step.
PREPARATION: Mapping[str, float] = {GAUSS_SEIDEL: 20.0, BICGSTAB: 2.5}
MOST_ITERATIONS = 5000
MOST_CYCLES = 10  # of BiCGSTAB: what they do not solve is not to be solved in this precision
# Of the brightest channel: residuals of a darker one are told relative to this share of it.
DARKEST_CHANNEL = 1e-3
# Residuals down to which single precision serves the Krylov methods, too, where the emittance has it.
SINGLE_TOLERANCE = 1e-5


@dataclass(frozen=True)
class Radiosity:
    """radiosity: (r, channels) of the emittance's type; method; iterations, of which one of BiCGSTAB takes two sparse
    products and the others' one; residual: |E - (I - rho F) B| / |E|, of the worst channel; history: the same after
    each iteration; seconds: after each iteration since the start, preparations included."""

    radiosity: NDArray[np.floating]
    method: str
    iterations: int
    residual: float
    history: list[float] = field(default_factory=list)
    seconds: list[float] = field(default_factory=list)


def solve_radiosity(matrix: sparse.csr_matrix, albedo: NDArray[np.floating], emittance: NDArray[np.floating],
                    method: str | None = None, tolerance: float = 1e-4, areas: NDArray[np.floating] | None = None,
                    start: NDArray[np.floating] | None = None, most: int = MOST_ITERATIONS,
                    sums: NDArray[np.float64] | None = None) -> Radiosity:
    """Solve B = E + rho F B to a relative residual.

    matrix: (r, r) form factors, row = receiver that gathers; albedo, emittance: (r, channels); method: of METHODS, None
    to choose; areas: (r,), for the conjugate gradients only, which need A_i F_ij = A_j F_ji; start: a radiosity near
    the answer (the last one of a light that changes); sums: of the matrix's rows, where they are known. Raises
    BadScene where light would grow without end.
    """
    check_exits(matrix, albedo, sums)
    if method is None:
        # A bound costs nothing where sums are known, an estimate a dozen products: as many as some solutions.
        method = choose_solver(radius_bound(matrix, albedo, sums), tolerance)
    found = _iterate(_System(matrix, albedo, emittance, areas, tolerance), method, start, most)
    if method == BICGSTAB and emittance.dtype == np.float32 and not found.residual <= tolerance:
        # Single precision was not enough after all.
        found = _iterate(_System(matrix, albedo, emittance.astype(np.float64), areas, tolerance), method, None, most)
        found = replace(found, radiosity=found.radiosity.astype(np.float32))
    return found


def _iterate(system: _System, method: str, start: NDArray[np.floating] | None, most: int) -> Radiosity:
    """Iterate until the residual is small enough, or no number any more."""
    emittance, began = system.emittance, time.perf_counter()
    steps = {JACOBI: _jacobi, GAUSS_SEIDEL: _gauss_seidel, BICGSTAB: _bicgstab,
             CONJUGATE_GRADIENTS: _conjugate_gradients}[method]
    solution = emittance.copy() if start is None else start.astype(emittance.dtype)
    history: list[float] = []
    seconds: list[float] = []
    if not emittance.any():
        return Radiosity(np.zeros_like(emittance), method, 0, 0.0)
    for solution, residual in steps(system, solution):  # noqa: B007, B020
        history.append(residual)
        seconds.append(time.perf_counter() - began)
        if residual <= system.tolerance or len(history) >= most or not np.isfinite(residual):
            break
    return Radiosity(solution.astype(emittance.dtype, copy=False), method, len(history), history[-1], history, seconds)


def predicted_iterations(method: str, radius: float, tolerance: float) -> float:
    """How many iterations a method will take where light dies out by `radius` with each bounce.

    Jacobi's error shrinks by the radius, Gauss-Seidel's by its square (exactly so for consistently ordered matrices,
    about so for these). Of BiCGSTAB measured in rooms: their form factors have few large eigenvalues, each of which
    costs a Krylov method about one iteration, so that bright rooms take little longer (albedo 0.3 to 0.999: 3 to 19).
    """
    if radius >= 1.0:
        return np.inf
    single = np.log(tolerance) / np.log(max(radius, 1e-12))
    if method == JACOBI:
        return max(1.0, single)
    if method == GAUSS_SEIDEL:
        return max(1.0, 0.5 * single)
    return max(1.0, 0.2 * np.log(2.0 / tolerance) + 2.0 * np.log(1.0 / (1.0 - radius)))


def choose_solver(radius: float, tolerance: float, costs: Mapping[str, float] = RELATIVE_COSTS,
                  preparation: Mapping[str, float] = PREPARATION) -> str:
    """The method that is predicted to be done first. costs: of an iteration of each method at hand, preparation: before
    the first, in any common unit; those of `RELATIVE_COSTS` where nothing was measured."""
    return min(costs, key=lambda method: predicted_cost(method, radius, tolerance, costs, preparation))


def predicted_cost(method: str, radius: float, tolerance: float, costs: Mapping[str, float] = RELATIVE_COSTS,
                   preparation: Mapping[str, float] = PREPARATION) -> float:
    """What a solution will cost, in the unit of the costs."""
    return costs[method] * predicted_iterations(method, radius, tolerance) + preparation.get(method, 0.0)


@dataclass(frozen=True)
class _System:
    """What `solve_radiosity` was asked."""

    matrix: sparse.csr_matrix
    albedo: NDArray[np.floating]
    emittance: NDArray[np.floating]
    areas: NDArray[np.floating] | None
    tolerance: float

    def size(self) -> NDArray[np.float64]:
        """(channels,) norms of the emittance; of a much darker channel than the brightest as of one not so dark, whose
        rounding would otherwise never be solved away."""
        norms = column_norm(self.emittance.astype(np.float64))
        return np.maximum(norms, max(DARKEST_CHANNEL * float(norms.max(initial=0.0)), SMALLEST))

    def residual_of(self, left: NDArray[np.floating]) -> float:
        """Relative residual of the worst channel, of what is left (r, channels)."""
        return float((column_norm(left.astype(np.float64)) / self.size()).max())


Steps = Iterator[tuple[NDArray[np.floating], float]]


def _jacobi(system: _System, values: NDArray[np.floating]) -> Steps:
    """B <- B + diag(M)^-1 (E - M B) with M = I - rho F (Carr et al. 2003, equation 4), in the emittance's precision.

    Each iterate is yielded with its own residual, which the next step needs anyway.
    """
    kind = system.emittance.dtype
    matrix = system.matrix.astype(kind, copy=False)
    albedo = system.albedo.astype(kind)
    inverse = (1.0 / (1.0 - albedo * matrix.diagonal()[:, None])).astype(kind)
    left = system.emittance + albedo * sparse_multiply_few(matrix, values) - values
    while True:
        values = values + inverse * left
        left = system.emittance + albedo * sparse_multiply_few(matrix, values) - values
        yield values, system.residual_of(left)


def _gauss_seidel(system: _System, values: NDArray[np.floating]) -> Steps:
    """Sweeps in the order of the receivers: B <- (I - rho L)^-1 (E + rho U B), L with the diagonal, F = L + U.

    A triangular matrix is its own factor: SuperLU solves with it in compiled code. After a sweep E - M B is
    rho U (B - B_before), so that the residual costs nothing.
    """
    albedo = system.albedo.astype(np.float64)
    grey = bool((albedo == albedo[:, :1]).all())
    channels = [slice(None)] if grey else [slice(k, k + 1) for k in range(albedo.shape[1])]
    upper = sparse.triu(system.matrix, 1, format="csr").astype(np.float64)
    lower = sparse.tril(system.matrix, 0, format="csc").astype(np.float64)
    factors = [_triangular(lower, albedo[:, part.start or 0]) for part in channels]
    values, emittance = values.astype(np.float64), system.emittance.astype(np.float64)
    above = albedo * sparse_multiply_few(upper, values)
    while True:
        right = emittance + above
        for part, factor in zip(channels, factors, strict=True):
            values[:, part] = factor.solve(np.ascontiguousarray(right[:, part]))
        before, above = above, albedo * sparse_multiply_few(upper, values)
        yield values, system.residual_of(above - before)


def _triangular(lower: sparse.csc_matrix, albedo: NDArray[np.float64]) -> sparse_linalg.SuperLU:
    """I - rho L, ready to be solved with."""
    rows = sparse.csc_matrix((lower.data * albedo[lower.indices], lower.indices, lower.indptr), lower.shape)
    scaled = sparse.identity(lower.shape[0], format="csc") - rows
    return sparse_linalg.splu(scaled, permc_spec="NATURAL", diag_pivot_thresh=0.0, relax=1, panel_size=1,
                              options={"Equil": False})


def _bicgstab(system: _System, values: NDArray[np.floating]) -> Steps:
    """BiCGSTAB on (I - rho F) B = E, in the emittance's precision where that is enough."""
    kind = system.emittance.dtype if system.tolerance >= SINGLE_TOLERANCE else np.dtype(np.float64)
    matrix, albedo = system.matrix.astype(kind, copy=False), system.albedo.astype(kind)
    emittance, solution = system.emittance.astype(kind), values.astype(kind)

    def apply(values: NDArray[np.float64]) -> NDArray[np.float64]:
        return values - albedo * sparse_multiply_few(matrix, values)

    for cycle in range(MOST_CYCLES):
        residual, history = emittance - apply(solution), []
        reached = system.residual_of(residual)
        if cycle or reached <= system.tolerance:
            yield solution, reached
        for _ in bicgstab_cycle(apply, solution, residual, system.size(), system.tolerance, history):
            # Of the last step of a cycle the true residual is told, with the next cycle.
            if not history[-1] <= system.tolerance:
                yield solution, history[-1]


def _conjugate_gradients(system: _System, values: NDArray[np.floating]) -> Steps:
    """Conjugate gradients on what light arrives, y = sqrt(rho A) H, where B = E + rho H and H = F E + F rho H.

    y = sqrt(rho A) F E + S y with S_ij = sqrt(rho_i A_i) F_ij sqrt(rho_j / A_j), which is symmetric, has the
    eigenvalues of rho F whatever the areas are, and needs no division by a black surface's albedo.
    """
    if system.areas is None:
        raise ValueError("the conjugate gradients need the receivers' areas")
    matrix, albedo = system.matrix.astype(np.float64), system.albedo.astype(np.float64)
    area, emittance = system.areas.astype(np.float64)[:, None], system.emittance.astype(np.float64)
    into = np.sqrt(albedo * area)
    # What has no area sends no light.
    out = np.sqrt(np.divide(albedo, area, out=np.zeros_like(albedo), where=area > 0.0))

    def apply(values: NDArray[np.float64]) -> NDArray[np.float64]:
        return values - into * sparse_multiply_few(matrix, out * values)

    # From a radiosity: sqrt(rho A) H = sqrt(A / rho) (B - E) is undefined for black surfaces, sqrt(rho A) F B is not.
    solution = into * sparse_multiply_few(matrix, values.astype(np.float64))
    residual = into * sparse_multiply_few(matrix, emittance) - apply(solution)
    for left in conjugate_gradient_steps(apply, solution, residual):
        # In radiosity E - M B = rho F B - rho H = sqrt(rho / A) times what is left of y.
        yield emittance + out * solution, system.residual_of(out * left)
