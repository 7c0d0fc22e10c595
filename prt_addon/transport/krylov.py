# SPDX-License-Identifier: GPL-3.0-or-later
"""Krylov methods for many columns at once, every column with scalars of its own, in double precision.

BiCGSTAB (van der Vorst 1992) for any matrix, the conjugate gradients (Hestenes and Stiefel 1952) for a symmetric
positive definite one. One step, or one short cycle, at a time, so that callers report progress and may stop.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterator

import numpy as np
from numpy.typing import NDArray

Values = NDArray[np.float64]
Apply = Callable[[Values], Values]

CYCLE = 30  # steps until callers take the true residual anew: rounding can't pile up
SMALLEST = np.finfo(np.float64).tiny * 1e30


def bicgstab_cycle(apply: Apply, solution: Values, residual: Values, size: Values, tolerance: float,
                   history: list[float]) -> Generator[float, None, int]:
    """Improve `solution` in place by up to CYCLE steps; yield the share done, return the number of products.

    residual: of the solution; size: norm of each column's right side (`column_norm`); history gets the largest
    relative residual of each step.
    """
    shadow, direction = residual.copy(), residual.copy()
    rho = dot(shadow, residual)
    products = 0
    for _ in range(CYCLE):
        image = apply(direction)
        # A column that is solved stays: what is left of it is rounding, and steps along that may overflow.
        moves = column_norm(residual) > 0.25 * tolerance * size
        alpha = np.where(moves, quotient(rho, dot(shadow, image)), 0.0).astype(solution.dtype)
        half = residual - alpha * image
        half_image = apply(half)
        omega = quotient(dot(half_image, half), dot(half_image, half_image))
        omega = np.where(moves, omega, 0.0).astype(solution.dtype)
        products += 2
        solution += alpha * direction + omega * half
        residual = half - omega * half_image
        worst = float((column_norm(residual) / size).max())
        history.append(worst)
        yield min(1.0, np.log(max(worst, 1e-300)) / np.log(tolerance)) if worst < 1.0 else 0.0
        following = dot(shadow, residual)
        if worst <= 0.5 * tolerance or not np.any(following):
            break
        onward = quotient(following, rho) * quotient(alpha, omega) * (direction - omega * image)
        direction = np.where(moves, residual + onward, residual)
        rho = following
    return products


def conjugate_gradient_steps(apply: Apply, solution: Values, residual: Values) -> Iterator[Values]:
    """Improve `solution` in place, one product a step, for ever; yield the residual (changed in place) after each."""
    direction = residual.copy()
    square = dot(residual, residual)
    while True:
        image = apply(direction)
        alpha = quotient(square, dot(direction, image))
        solution += alpha * direction
        residual -= alpha * image
        yield residual
        following = dot(residual, residual)
        direction = residual + quotient(following, square) * direction
        square = following


def dot(a: Values, b: Values) -> Values:
    """Inner products of columns: of (n, ...) the sums over n."""
    return np.sum(a * b, axis=0)


def column_norm(values: Values) -> Values:
    """Norms of columns."""
    return np.sqrt(dot(values, values))


def quotient(a: Values, b: Values) -> Values:
    """a / b, and 0 for a column that is solved already (0 / 0)."""
    with np.errstate(over="ignore", invalid="ignore"):
        return np.divide(a, b, out=np.zeros_like(a), where=b != 0.0)
