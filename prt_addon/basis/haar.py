# SPDX-License-Identifier: GPL-3.0-or-later
"""Haar wavelets on the faces of a cubemap, orthonormal in solid angle: a basis to compare others with.

Ng, Ramamoorthi & Hanrahan (2003) take the plain 2D Haar transform of each face. Texels differ in solid angle by up to
5.2 times, so here every pair is turned by the angle that its two solid angles give (the unbalanced Haar transform;
Girardi & Sweldens 1997): still orthonormal, and a constant keeps one coefficient for each face.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .cubemap import cubemap_solid_angles

Values = NDArray[np.floating]


def check_size(r: int) -> None:
    """Raises ValueError unless r is a power of two."""
    if r < 1 or r & (r - 1):
        raise ValueError(f"Haar wavelets need a power of two along a face's edge, not {r}")


def haar_transform(values: Values, r: int) -> Values:
    """Coefficients (n, 6 r r) of values (n, 6 r r) of texels, each times the root of its solid angle.

    That scaling makes plain sums of squares integrals over the sphere, on both sides. In the layout of the texels: each
    face's mean first, at the corner (0, 0), finer details in the halves beyond. Raises ValueError for other sizes.
    """
    faces = _faces(values, r).copy()
    for size, measures in _levels(r):
        for axis in (3, 2):
            measure = measures[axis]
            first, second = _halves(faces, size, axis)
            low, high = _roots(measure, axis)
            part = _block(faces, size)
            part[...] = np.concatenate([low * first + high * second, high * first - low * second], axis=axis)
    return faces.reshape(values.shape)


def inverse_haar_transform(coefficients: Values, r: int) -> Values:
    """Values (n, 6 r r) of `haar_transform`, each times the root of its solid angle."""
    faces = _faces(coefficients, r).copy()
    for size, measures in reversed(_levels(r)):
        for axis in (2, 3):
            low, high = _roots(measures[axis], axis)
            part = _block(faces, size)
            scale, detail = np.split(part, 2, axis=axis)
            first, second = low * scale + high * detail, high * scale - low * detail
            part[...] = np.stack([first, second], axis=axis + 1).reshape(part.shape)
    return faces.reshape(coefficients.shape)


def keep_largest(coefficients: Values, count: int) -> Values:
    """Each row (n, m) with all but its `count` largest coefficients zero: the best approximation of so many numbers.

    Which ones are kept differs from row to row, so that more than `count` numbers must be stored.
    """
    if count >= coefficients.shape[1]:
        return coefficients.copy()
    sizes = np.abs(coefficients)
    places = np.argpartition(sizes, coefficients.shape[1] - count, axis=1)[:, coefficients.shape[1] - count:]
    result = np.zeros_like(coefficients)
    np.put_along_axis(result, places, np.take_along_axis(coefficients, places, axis=1), axis=1)
    return result


def _faces(values: Values, r: int) -> Values:
    check_size(r)
    if values.ndim != 2 or values.shape[1] != 6 * r * r:
        raise ValueError(f"{6 * r * r} values for each function are needed, not shape {values.shape}")
    return values.reshape(-1, 6, r, r)


def _levels(r: int) -> list[tuple[int, dict[int, NDArray[np.float64]]]]:
    """From the finest level on: its size, and by axis (3 columns first, 2 rows) the solid angles that are paired."""
    measure = cubemap_solid_angles(r).reshape(6, r, r)[0]
    levels = []
    while len(measure) > 1:
        size = len(measure)
        wide = measure[:, 0::2] + measure[:, 1::2]
        # Details of columns are paired along rows as well, with the weights of the pairs that they come from.
        levels.append((size, {3: measure, 2: np.concatenate([wide, wide], axis=1)}))
        measure = wide[0::2] + wide[1::2]
    return levels


def _block(faces: Values, size: int) -> Values:
    return faces[:, :, :size, :size]


def _halves(faces: Values, size: int, axis: int) -> tuple[Values, Values]:
    part = _block(faces, size)
    return (part[..., 0::2].copy(), part[..., 1::2].copy()) if axis == 3 else (
        part[:, :, 0::2].copy(), part[:, :, 1::2].copy())


def _roots(measure: NDArray[np.float64], axis: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Cosine and sine of each pair's turn: the roots of its solid angles' shares."""
    first, second = (measure[:, 0::2], measure[:, 1::2]) if axis == 3 else (measure[0::2], measure[1::2])
    return np.sqrt(first / (first + second)), np.sqrt(second / (first + second))
