# SPDX-License-Identifier: GPL-3.0-or-later
"""Functions over the hemisphere about +Z: spherical harmonics restricted to it, fitted by least squares.

Sloan, Hall, Hart, Snyder, Clustered Principal Components for Precomputed Radiance Transfer (2003), appendix: the best
coefficients of f over the hemisphere H are c = A^-1 b with A_ik = integral over H of y_i y_k and b_k = integral over
H of f y_k. A is stiff (condition 1.5e5 at order 5, 3e12 at order 10), so everything here is double precision and A^-1
is an eigen-decomposition truncated on purpose.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..linear_algebra import multiply, symmetric_eigenpairs
from . import spherical_harmonics

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

# The function that the others replace best (l = 1, m = 0: squared error 1.48e-5 at order 5), the paper's section 6.1.
_REDUNDANT = 2
# Below these eigenvalues of A (its largest is 1) a direction is dropped. Along an eigenvector of eigenvalue e, a
# function of unit energy over H has a coefficient vector of length 1 / sqrt(e), so that rounding at the precision u
# of coefficients or basis values returns as an error of up to u / sqrt(e) over H.
# Coefficients that are stored and drawn in single precision: u = 6e-8, error up to 2e-4. Drops nothing up to order 6.
SINGLE_PRECISION = 1e-7
# Coefficients that stay in double precision: u = 1e-16 and e known to 1e-15, error up to 3e-10. Drops nothing up to
# order 10, whose smallest eigenvalue, 3.2e-13, is still known to three digits.
DOUBLE_PRECISION = 1e-13


def functions_of(rows: int) -> Indices:
    """Indices of the harmonics of a row count: all of an order (1, 4, 9, 16, 25, ... rows), or 24: order 5 without
    l = 1, m = 0. Raises ValueError for other counts."""
    if rows == 24:
        return np.delete(np.arange(25), _REDUNDANT)
    return np.arange(spherical_harmonics.order_of(rows) ** 2)


def order_of(functions: Indices) -> int:
    """The lowest order that has all these functions. Raises ValueError where there are none, or repeated ones."""
    functions = np.asarray(functions, np.int64)
    if functions.ndim != 1 or not len(functions) or functions.min() < 0 or len(np.unique(functions)) < len(functions):
        raise ValueError(f"functions must be distinct indices of spherical harmonics, not {functions}")
    return math.isqrt(int(functions.max())) + 1


def bands_of(functions: Indices) -> tuple[Indices, Indices]:
    """l and m (k,), (k,) of functions (k,)."""
    functions = np.asarray(functions, np.int64)
    bands = np.array([math.isqrt(int(index)) for index in functions], np.int64)
    return bands, functions - bands * (bands + 1)


def evaluate(functions: Indices, directions: ArrayLike) -> Array:
    """Values (n, k) of functions (k,) at unit directions (n, 3) in the local frame (+Z the normal)."""
    values = spherical_harmonics.evaluate(order_of(functions), directions)
    return np.ascontiguousarray(values[:, functions])


def heights(count: int) -> tuple[Array, Array]:
    """Gauss-Legendre nodes z in (0, 1) and weights, sum 1: exact for polynomials in z up to degree 2 count - 1."""
    nodes, weights = np.polynomial.legendre.leggauss(count)
    return (nodes + 1) / 2, weights / 2


def meridian(z: Array) -> Array:
    """Directions (n, 3) at heights z with azimuth 0."""
    return np.stack([np.sqrt((1 - z) * (1 + z)), np.zeros_like(z), z], axis=1)


def gram_matrix(functions: Indices) -> Array:
    """A (k, k): the integral of y_i y_k over the hemisphere, to rounding.

    Functions of different m are orthogonal on every circle of latitude; for equal m the product is a polynomial in z
    of degree at most 2 order - 2, which Gauss-Legendre integrates exactly.
    """
    order = order_of(functions)
    z, weights = heights(order)
    bands, azimuths = bands_of(functions)
    # The mirror image of sin(m phi) is cos(m phi): both have the same profile along a meridian.
    profile = spherical_harmonics.evaluate(order, meridian(z))[:, bands * (bands + 1) + np.abs(azimuths)]
    circle = np.where(azimuths == 0, 2 * np.pi, np.pi)  # integral of cos^2(m phi) or sin^2(m phi)
    matrix = multiply((profile * weights[:, None]).T, profile * circle)
    matrix = np.where(azimuths[:, None] == azimuths[None, :], matrix, 0.0)
    return (matrix + matrix.T) / 2


@dataclass(frozen=True, eq=False)
class HemisphereBasis:
    """Least-squares fits over the hemisphere with some spherical harmonics.

    functions (k,): their indices; gram (k, k): A; eigenvalues (k,), descending, and vectors (k, k), columns, of A;
    smallest: the eigenvalue from which on a direction is kept; kept: how many are.
    """

    functions: Indices
    gram: Array
    eigenvalues: Array
    vectors: Array
    smallest: float
    kept: int

    @property
    def condition(self) -> float:
        """Largest over smallest eigenvalue of A, all directions."""
        return float(self.eigenvalues[0] / self.eigenvalues[-1])

    @property
    def condition_kept(self) -> float:
        """Largest over smallest eigenvalue of what is inverted."""
        return float(self.eigenvalues[0] / self.eigenvalues[self.kept - 1])

    def describe(self) -> str:
        """One line for the report."""
        return (f"{self.kept} of {len(self.functions)} directions of the hemispherical basis kept, condition"
                f" {self.condition_kept:.1e} of {self.condition:.1e}")

    def evaluate(self, directions: ArrayLike) -> Array:
        """Values (n, k) at unit directions (n, 3) in the local frame."""
        return evaluate(self.functions, directions)

    def fit(self, integrals: ArrayLike) -> Array:
        """Coefficients A^+ b (k, ...) from hemispherical integrals b (k, ...), b_k = integral over H of f y_k.

        Applied factor by factor, never as a product of matrices: the small result of V^T b along a stiff direction
        is divided before it meets the large ones.
        """
        integrals = np.asarray(integrals, np.float64)
        flat = integrals.reshape(len(integrals), -1)
        along = multiply(np.ascontiguousarray(self.vectors[:, :self.kept].T), flat)
        along /= self.eigenvalues[:self.kept, None]
        return multiply(np.ascontiguousarray(self.vectors[:, :self.kept]), along).reshape(integrals.shape)

    def squared_norm(self, coefficients: ArrayLike) -> Array:
        """Integral over H of (sum_i c_i y_i)^2 for coefficients (k, n): (n,)."""
        coefficients = np.asarray(coefficients, np.float64)
        return np.sum(coefficients * multiply(self.gram, coefficients), axis=0)

    def root(self) -> Array:
        """A^(1/2) (k, k): the length of root times c is the norm of the function over H."""
        return multiply(self.vectors * np.sqrt(np.maximum(self.eigenvalues, 0.0)),  # rounding may dip below zero
                        np.ascontiguousarray(self.vectors.T))


def hemisphere_basis(functions: Indices, smallest: float = SINGLE_PRECISION) -> HemisphereBasis:
    """The least-squares basis of some functions; directions of eigenvalues below `smallest` are dropped.

    The decomposition is made for each m on its own (A has a block for each), so that what is kept commutes with
    rotations about the normal to the last bit. Raises ValueError where nothing would be kept.
    """
    functions = np.asarray(functions, np.int64)
    matrix = gram_matrix(functions)
    _, azimuths = bands_of(functions)
    values, vectors = np.empty(len(functions)), np.zeros_like(matrix)
    start = 0
    for m in np.unique(azimuths):
        place = np.flatnonzero(azimuths == m)
        block = slice(start, start + len(place))
        values[block], vectors[place, block] = symmetric_eigenpairs(matrix[np.ix_(place, place)])
        start = block.stop
    descending = np.argsort(-values, kind="stable")
    values, vectors = values[descending], np.ascontiguousarray(vectors[:, descending])
    kept = int(np.count_nonzero(values >= smallest * values[0]))
    if not kept or not smallest > 0:
        raise ValueError(f"the smallest eigenvalue to keep must be above 0 and at most 1, not {smallest}")
    return HemisphereBasis(functions, matrix, values, vectors, smallest, kept)
