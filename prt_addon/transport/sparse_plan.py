# SPDX-License-Identifier: GPL-3.0-or-later
"""Whether sparse sampling would be faster than computing every element, from what one element costs here.

Measured (docs/sparse_precomputation.md): weighing and weaving neighbours costs more than a ray for each element, so
with single rays, and wherever an operator carries all columns at once, sparse sampling is left out.
"""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np

from .elements import Elements

# Seconds that ranks, features, weights and reconstruction take: for each vertex, and for each element of the whole
# matrix, one BLAS thread (0.65 ms a vertex at 6 x 32 x 32, 0.25 at 6 x 16 x 16).
PER_VERTEX, PER_ELEMENT = 2e-4, 7e-8
# Share of all elements that sparse sampling asks for, and gain below which it is not worth its error: timings of
# single elements are off by half on a busy machine.
SAMPLED, LEAST_GAIN = 0.12, 2.0
# An element that is worth a sample costs so much more than one of all, in order: its rays are less coherent and graze
# what casts the shadow (measured with rays: 0.8 to 4.9; paths are incoherent anyway).
HARDER_RAYS = 2.0
# Elements that are timed, in runs of so many columns, as the sampling asks for them, and how often.
TIMED, COLUMNS, TIMES = 20_000, 16, 3


@dataclass(frozen=True)
class SparsePlan:
    """all_seconds: every element that is not known beforehand; sparse_seconds: sparse sampling; operator_seconds: of an
    operator that carries all columns at once, None without one; pays: sparse sampling is the fastest by LEAST_GAIN;
    why: one line for the report."""

    all_seconds: float
    sparse_seconds: float
    operator_seconds: float | None
    pays: bool
    why: str


def element_seconds(elements: Elements, seed: int = 0) -> float:
    """Seconds of one element, from some at random in the order of columns, the least of TIMES measurements; they count
    as asked for. 0 for no receivers."""
    if not len(elements):
        return 0.0
    generator = np.random.default_rng(seed)
    columns = np.sort(generator.choice(elements.columns, min(COLUMNS, elements.columns), replace=False))
    each = min(len(elements), -(-TIMED // len(columns)))
    least = np.inf
    for _ in range(TIMES):
        receivers = np.tile(np.sort(generator.choice(len(elements), each, replace=False)), len(columns))
        started = time.perf_counter()
        elements.evaluate(receivers, np.repeat(columns, each))
        least = min(least, (time.perf_counter() - started) / len(receivers))
    return least


def plan(receivers: int, columns: int, seconds: float, unknown: float = 0.5, operator: float | None = None,
         harder: float = 1.0) -> SparsePlan:
    """seconds: of one element (`element_seconds`); unknown: share of the elements that brute force computes (direct
    light: a hemisphere); operator: seconds of a way that gives all columns at once (the gather operator); harder: how
    much more a sampled element costs (HARDER_RAYS)."""
    size = receivers * columns
    every, some = seconds * unknown * size, seconds * harder * SAMPLED * size + overhead(columns) * size
    other = every if operator is None else min(every, operator)
    pays = bool(some * LEAST_GAIN < other)
    if pays:
        why = f"sparse sampling: about {some:.3g} s instead of {other:.3g} s"
    elif operator is not None and operator <= every:
        why = f"sparse sampling left out: the gather operator carries all columns in about {operator:.3g} s, " \
              f"sparse sampling would take {some:.3g} s"
    else:
        why = f"sparse sampling left out: every element takes about {every:.3g} s, sparse sampling {some:.3g} s"
    return SparsePlan(every, some, operator, pays, why)


def overhead(columns: int) -> float:
    """Seconds for each element of the whole matrix that sparse sampling takes besides its elements."""
    return PER_ELEMENT + PER_VERTEX / columns


def break_even(columns: int = 6144, unknown: float = 0.5) -> float:
    """Seconds of an element from which on sparse sampling takes less time than all elements."""
    return overhead(columns) / (unknown - SAMPLED)
