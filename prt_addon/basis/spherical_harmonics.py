# SPDX-License-Identifier: GPL-3.0-or-later
"""Real spherical harmonics: values, rotation, the clamped cosine, windows.

Conventions are those of this package's docstring. Everything is double precision.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import linalg

from ..linear_algebra import multiply, small_batched_multiply

Array = NDArray[np.float64]
WindowKind = Literal["none", "hanning", "lanczos", "laplacian", "heat"]


def order_of(count: int) -> int:
    """The order whose `count` functions these are: sqrt(count). Raises ValueError where count is no positive square."""
    order = math.isqrt(max(count, 0))
    if order < 1 or order * order != count:
        raise ValueError(f"{count} coefficients are no whole number of spherical harmonic bands (1, 4, 9, 16, ...)")
    return order


def expand_bands(factors: ArrayLike) -> Array:
    """One value per band (order,) repeated for every function of the band: (order^2,)."""
    factors = np.asarray(factors, np.float64)
    return np.repeat(factors, 2 * np.arange(len(factors)) + 1)


def _check_order(order: int) -> None:
    if order < 1:
        raise ValueError(f"spherical harmonics need order 1 or more, not {order}")


def evaluate(order: int, directions: ArrayLike) -> Array:
    """Values of the order^2 functions at unit directions (n, 3): (n, order^2), C-ordered.

    The normalised Legendre recursion (Press et al., Numerical Recipes 3rd ed., eq. 6.7.9) with sin^m(theta) moved into
    the azimuthal factor, so that both are polynomials in x, y, z: no trigonometry, no trouble at the poles, and
    stable far beyond order 12. Raises ValueError for an order below 1 or directions that are not (n, 3).
    """
    _check_order(order)
    directions = np.asarray(directions, np.float64)
    if directions.ndim != 2 or directions.shape[1] != 3:
        raise ValueError(f"directions must be an (n, 3) array, not {directions.shape}")
    x, y, z = np.ascontiguousarray(directions.T)
    values = np.empty((order * order, len(directions)))
    sectoral = math.sqrt(1 / (4 * math.pi))  # the normalised P(m, m) without its sin^m(theta)
    cosine, sine = np.ones_like(z), np.zeros_like(z)  # sin^m(theta) times cos(m phi), sin(m phi)
    for m in range(order):
        if m > 0:
            cosine, sine = x * cosine - y * sine, x * sine + y * cosine
            # sqrt(2) enters once, with m = 1: real functions share the energy of the pair (m, -m).
            sectoral *= math.sqrt((2 * m + 1) / (2 * m)) * (math.sqrt(2) if m == 1 else 1)
        _fill_column(values, order, m, sectoral, z, cosine, sine)
    return np.ascontiguousarray(values.T)


def _fill_column(values: Array, order: int, m: int, sectoral: float, z: Array, cosine: Array, sine: Array) -> None:
    """All bands l = m .. order-1 of the functions +m and -m by the three-term recursion in l."""
    before, current = np.zeros_like(z), np.full_like(z, sectoral)
    for band in range(m, order):
        np.multiply(current, cosine, out=values[band * (band + 1) + m])
        if m > 0:
            np.multiply(current, sine, out=values[band * (band + 1) - m])
        up = band + 1
        a = math.sqrt((4 * up * up - 1) / (up * up - m * m))
        b = math.sqrt((band * band - m * m) / (4 * band * band - 1)) if band > m else 0.0
        before, current = current, a * (z * current - b * before)


def rotation(order: int, matrix: ArrayLike) -> Array:
    """The matrix (order^2, order^2) that turns coefficients of f(s) into those of f(R^-1 s), R the 3x3 `matrix`.

    Block diagonal and orthonormal. Recursion of Ivanic & Ruedenberg (J. Phys. Chem. 1996, 100, 6342, with the
    correction 1998, 102, 9099). Reflections are fine too (the functions are homogeneous polynomials). Raises
    ValueError where the matrix is not orthonormal.
    """
    _check_order(order)
    matrix = np.asarray(matrix, np.float64)
    if matrix.shape != (3, 3) or not np.abs(matrix.T @ matrix - np.eye(3)).max() < 1e-6:  # small
        raise ValueError("a rotation of spherical harmonics needs an orthonormal 3x3 matrix (no scale, no shear)")
    result = np.zeros((order * order, order * order))
    result[0, 0] = 1
    if order == 1:
        return result
    first = matrix[np.ix_((1, 2, 0), (1, 2, 0))]  # band 1 is (y, z, x)
    block = result[1:4, 1:4] = first
    for band in range(2, order):
        block = _next_block(band, first, block)
        start = band * band
        result[start:start + 2 * band + 1, start:start + 2 * band + 1] = block
    return result


def _next_block(band: int, first: Array, previous: Array) -> Array:
    """The block of `band` from those of band 1 and band - 1: u U + v V + w W, table 1 of the paper, row by row."""
    # product[i + 1][mu + band - 1] holds P(i, mu, m') for every column m', table 2 of the paper.
    product = np.empty((3, 2 * band - 1, 2 * band + 1))
    for i in range(3):
        low, middle, high = first[i]
        product[i, :, 1:-1] = middle * previous
        product[i, :, -1] = high * previous[:, -1] - low * previous[:, 0]
        product[i, :, 0] = high * previous[:, 0] + low * previous[:, -1]
    columns = np.arange(-band, band + 1)
    divisor = np.where(np.abs(columns) < band, (band + columns) * (band - columns), 2 * band * (2 * band - 1))
    rows = [_block_row(band, m, product) for m in range(-band, band + 1)]
    return np.array(rows) / np.sqrt(divisor)


def _block_row(band: int, m: int, product: Array) -> Array:
    """Row m of the block of `band`, before the division by the square root of the column's divisor."""
    centre, size, sign = band - 1, abs(m), 1 if m >= 0 else -1

    def p(i: int, mu: int) -> Array:
        return product[i + 1, centre + mu]

    row = np.zeros(product.shape[2])
    if size < band:
        row += math.sqrt((band + m) * (band - m)) * p(0, m)
    v = math.sqrt((band + size - 1) * (band + size)) / 2
    if m == 0:
        row -= math.sqrt(2) * v * (p(1, 1) + p(-1, -1))
    elif size == 1:
        row += math.sqrt(2) * v * p(sign, 0)
    else:
        row += v * (p(1, sign * (size - 1)) - sign * p(-1, -sign * (size - 1)))
    if m != 0 and size < band - 1:
        w = math.sqrt((band - size - 1) * (band - size)) / 2
        row -= w * (p(1, sign * (size + 1)) + sign * p(-1, -sign * (size + 1)))
    return row


def rotations(order: int, matrices: ArrayLike) -> list[Array]:
    """The diagonal blocks (r, 2l+1, 2l+1), l = 0 .. order-1, of `rotation` for many matrices (r, 3, 3) at once.

    Functions of a turned direction are sums of those of their band, y(R s) = D y(s), so a few fixed directions s
    determine D by least squares: one evaluation and small products instead of a recursion from band to band, and no
    error is handed from one band to the next (orthonormal to 1e-13 at order 10). Raises as `rotation`.
    """
    _check_order(order)
    matrices = np.asarray(matrices, np.float64)
    if matrices.ndim != 3 or matrices.shape[1:] != (3, 3):
        raise ValueError(f"rotations of spherical harmonics need matrices (r, 3, 3), not {matrices.shape}")
    products = small_batched_multiply(matrices.transpose(0, 2, 1), matrices)
    if not np.all(np.abs(products - np.eye(3)) < 1e-6):  # NaN among them
        raise ValueError("a rotation of spherical harmonics needs an orthonormal 3x3 matrix (no scale, no shear)")
    points, solutions = _probes(order)
    turned = small_batched_multiply(points[None], matrices.transpose(0, 2, 1))
    values = evaluate(order, turned.reshape(-1, 3)).reshape(len(matrices), len(points), order * order)
    return [small_batched_multiply(values[:, :, band * band:(band + 1) ** 2].transpose(0, 2, 1), solutions[band][None])
            for band in range(order)]


@lru_cache(maxsize=16)
def _probes(order: int) -> tuple[Array, list[Array]]:
    """3 * order directions (n, 3) and per band the pseudo-inverse (n, 2l+1) of its functions' values there.

    Even over a hemisphere (opposite directions tell the same), so that the functions of each band are independent on
    them: condition below 7 up to order 14 (with 2 * order directions it would be 120).
    """
    count = 3 * order
    z = 1 - (np.arange(count) + 0.5) / count
    azimuth = 2 * np.pi * np.modf(np.arange(count) * ((math.sqrt(5) - 1) / 2))[0]
    radius = np.sqrt(1 - z * z)
    points = np.stack([radius * np.cos(azimuth), radius * np.sin(azimuth), z], axis=1)
    values = evaluate(order, points)
    return points, [np.ascontiguousarray(linalg.pinv(values[:, band * band:(band + 1) ** 2]).T)
                    for band in range(order)]


def rotate(coefficients: ArrayLike, matrix: ArrayLike) -> Array:
    """Coefficients (order^2, ...) of f(R^-1 s) from those of f(s); R is the 3x3 `matrix`. Raises as `rotation`."""
    coefficients = np.asarray(coefficients, np.float64)
    order = order_of(len(coefficients))
    flat = coefficients.reshape(len(coefficients), -1)
    return multiply(rotation(order, matrix), flat).reshape(coefficients.shape)


def zonal_cosine(order: int) -> Array:
    """Factors per band (order,) of the convolution with max(cos, 0) / pi: 1, 2/3, 1/4, 0, -1/24, 0, ...

    Unshadowed diffuse transfer is t_i = factor_l y_i(normal), and its exit radiance sum_i factor_l l_i y_i(normal).
    Ramamoorthi & Hanrahan, An Efficient Representation for Irradiance Environment Maps (2001), eqs. 7-9, over pi.
    """
    _check_order(order)
    factors = np.zeros(order)
    factors[0] = 1
    factors[1:2] = 2 / 3
    for band in range(2, order, 2):
        half = band // 2
        factors[band] = 2 * (-1) ** (half - 1) * math.comb(band, half) / ((band + 2) * (band - 1) * 2.0**band)
    return factors


def zonal_hemisphere(order: int) -> Array:
    """Factors per band (order,) of the convolution with a hemisphere's indicator: the integral of y_i over the upper
    hemisphere of n is factor_l y_i(n) (Funk-Hecke): 2 pi times the integral of the Legendre polynomial from 0 to 1."""
    _check_order(order)
    at_zero = np.zeros(order + 1)  # Legendre polynomials at 0: 1, 0, -1/2, 0, 3/8, ...
    at_zero[0] = 1
    for band in range(2, order + 1, 2):
        at_zero[band] = -at_zero[band - 2] * (band - 1) / band
    factors = np.zeros(order)
    factors[0] = 2 * np.pi
    bands = np.arange(1, order)
    factors[1:] = 2 * np.pi * (at_zero[:order - 1] - at_zero[2:]) / (2 * bands + 1)
    return factors


def window(order: int, kind: WindowKind, strength: float = 0.0) -> Array:
    """Factors per band (order,) that damp ringing; band 0 is always 1. Sloan, Stupid SH Tricks (2008), Windowing.

    hanning: (1 + cos(pi l / n)) / 2, lanczos: sinc(l / n), with n = order: the first band left out gets 0.
    laplacian: 1 / (1 + strength l^2 (l + 1)^2), the minimiser of squared error plus strength times squared Laplacian.
    heat: exp(-strength l (l + 1)), light diffused over the sphere for the time `strength` (the heat or
    Gauss-Weierstrass kernel, which is positive); of these it removes negative lobes at the smallest loss (measured).
    Raises ValueError for an unknown kind or a negative strength.
    """
    _check_order(order)
    bands = np.arange(order, dtype=np.float64)
    if kind == "none":
        return np.ones(order)
    if kind == "hanning":
        return (1 + np.cos(np.pi * bands / order)) / 2
    if kind == "lanczos":
        return np.sinc(bands / order)
    if not strength >= 0:
        raise ValueError(f"a window's strength must be 0 or more, not {strength}")
    if kind == "laplacian":
        return 1 / (1 + strength * (bands * (bands + 1)) ** 2)
    if kind == "heat":
        return np.exp(-strength * bands * (bands + 1))
    raise ValueError(f"unknown window {kind!r}: none, hanning, lanczos, laplacian or heat")
