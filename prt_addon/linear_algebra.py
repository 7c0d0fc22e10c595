# SPDX-License-Identifier: GPL-3.0-or-later
"""Dense products, factorizations and eigenproblems through scipy's BLAS and LAPACK.

Official Blender builds carry a numpy without an optimised BLAS, up to 700 times slower at these products than the
numpy of the test machine, so every large product of the core goes through here (a test holds that).

BLAS is column-major: a C-ordered matrix is the transpose of a Fortran-ordered one, and (a b) = ((b^T) (a^T))^T, so the
transposed views below enter and leave BLAS without a copy.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import linalg
from scipy.linalg import blas, lapack
from scipy.sparse import csr_array

from . import unlocked_blas

Array = NDArray[np.floating]

_SINGLE = np.dtype(np.float32)
# Multiplications from which on giving up the lock of Python, for other threads to run, gains more than it costs.
UNLOCKED_WORK = 2_000_000
# Columns of a product from which on a call of BLAS for each is quicker than numpy's own loops.
WIDE = 1536


def _same_type(*arrays: Array) -> np.dtype:
    """float32 when every array is float32, else float64: no product silently loses precision."""
    return np.dtype(np.float32) if all(a.dtype == np.float32 for a in arrays) else np.dtype(np.float64)


def _operand(matrix: Array) -> tuple[Array, int]:
    """The Fortran-ordered array and the transpose flag that stand for `matrix` as BLAS's transposed operand."""
    flags = matrix.flags
    if flags.c_contiguous:
        return matrix.T, 0
    if flags.f_contiguous:
        return matrix, 1
    return np.ascontiguousarray(matrix).T, 0


def _contiguous(matrix: Array) -> Array:
    """The matrix itself where it is contiguous in either order, else a copy that is."""
    flags = matrix.flags
    return matrix if flags.c_contiguous or flags.f_contiguous else np.ascontiguousarray(matrix)


def multiply(a: Array, b: Array, out: Array | None = None, accumulate: bool = False) -> Array:
    """The product a (m, k) times b (k, n) as a C-ordered (m, n) array.

    out: a C-ordered (m, n) array of the product's type to write into; accumulate adds to it instead of replacing it.
    """
    if a.dtype == _SINGLE and b.dtype == _SINGLE and out is None and a.ndim == b.ndim == 2 and a.size and b.size \
            and a.shape[1] == b.shape[0]:
        # The same as below for the many small products of the encoders, where the checks would cost as much again.
        if unlocked_blas.available and a.shape[0] * b.size > UNLOCKED_WORK:
            result = np.empty((a.shape[0], b.shape[1]), _SINGLE)
            unlocked_blas.gemm(_contiguous(a), _contiguous(b), result)
            return result
        right, right_flag = _operand(b)
        left, left_flag = _operand(a)
        return blas.sgemm(1.0, right, left, trans_a=right_flag, trans_b=left_flag).T
    kind = _same_type(a, b)
    if a.ndim != 2 or b.ndim != 2 or a.shape[1] != b.shape[0]:
        raise ValueError(f"multiply: shapes {a.shape} and {b.shape} do not fit")
    if 0 in (*a.shape, *b.shape):
        result = np.zeros((a.shape[0], b.shape[1]), kind) if out is None else out
        if out is not None and not accumulate:
            out[...] = 0
        return result
    if out is not None and (out.dtype != kind or not out.flags.c_contiguous or out.shape != (a.shape[0], b.shape[1])):
        raise ValueError("multiply: out must be a C-ordered array of the product's shape and type")
    if unlocked_blas.available and a.shape[0] * b.size > UNLOCKED_WORK:
        result = np.empty((a.shape[0], b.shape[1]), kind) if out is None else out
        unlocked_blas.gemm(_contiguous(np.asarray(a, kind)), _contiguous(np.asarray(b, kind)), result, accumulate)
        return result
    right, right_flag = _operand(np.asarray(b, kind))
    left, left_flag = _operand(np.asarray(a, kind))
    gemm = blas.sgemm if kind == np.float32 else blas.dgemm
    if out is None:
        return gemm(1.0, right, left, trans_a=right_flag, trans_b=left_flag).T
    gemm(1.0, right, left, beta=1.0 if accumulate else 0.0, c=out.T, overwrite_c=True,
         trans_a=right_flag, trans_b=left_flag)
    return out


def gram(a: Array) -> Array:
    """a^T a for a (m, n): (n, n), symmetric to the last bit."""
    kind = _same_type(a)
    if 0 in a.shape:
        return np.zeros((a.shape[1], a.shape[1]), kind)
    syrk = blas.ssyrk if kind == np.float32 else blas.dsyrk
    operand, flag = _operand(np.asarray(a, kind))
    lower = syrk(1.0, operand, trans=flag, lower=1)
    return np.tril(lower) + np.tril(lower, -1).T


def batched_multiply(a: Array, b: Array) -> Array:
    """The products a (k, m, n) times b (k, n, p), stacked: (k, m, p)."""
    result = np.empty((a.shape[0], a.shape[1], b.shape[2]), _same_type(a, b))
    for index in range(a.shape[0]):
        multiply(a[index], b[index], out=result[index])
    return result


def small_batched_multiply(a: Array, b: Array, out: Array | None = None) -> Array:
    """The products of a (k or 1, m, n) with b (k or 1, n, p): (k, m, p), for matrices of up to some 100 x 100.

    numpy's own loop over the stack: 0.04-0.5 us for each product of up to 25 x 25 x 25, where a call from Python costs
    2 us, and its plain loops reach 5 GFLOP/s at such sizes in Blender's builds too. Each product's bits depend on its
    own operands alone.
    """
    return np.matmul(a, b, out=out)


def wide_batched_multiply(a: Array, b: Array, out: Array | None = None) -> Array:
    """As `small_batched_multiply`, by BLAS where the products have WIDE columns or more (those of a cubemap)."""
    if b.shape[2] < WIDE:
        return small_batched_multiply(a, b, out)
    count = max(len(a), len(b))
    result = np.empty((count, a.shape[1], b.shape[2]), _same_type(a, b)) if out is None else out
    for index in range(count):
        multiply(a[index if len(a) > 1 else 0], b[index if len(b) > 1 else 0], out=result[index])
    return result


def symmetric_eigenpairs(matrix: Array, count: int | None = None) -> tuple[Array, Array]:
    """Eigenvalues in descending order (count,) and eigenvectors as columns (n, count) of a symmetric matrix.

    Signs are fixed (largest component of each vector positive), so results do not depend on the LAPACK in use.
    """
    size = matrix.shape[0]
    count = size if count is None else min(count, size)
    if count == 0:
        return np.zeros(0, matrix.dtype), np.zeros((size, 0), matrix.dtype)
    values, vectors = linalg.eigh(matrix, subset_by_index=(size - count, size - 1), check_finite=True)
    values, vectors = values[::-1], vectors[:, ::-1]
    signs = np.sign(vectors[np.abs(vectors).argmax(axis=0), np.arange(count)])
    return np.ascontiguousarray(values), np.ascontiguousarray(vectors * np.where(signs == 0, 1, signs))


def small_symmetric_eigenpairs(matrix: Array) -> tuple[Array, Array]:
    """All eigenvalues, descending, and eigenvectors as columns of a small symmetric matrix, in double precision.

    LAPACK's driver without scipy's checks, which cost ten times the solution at sizes below about 20. Signs as LAPACK
    leaves them. Raises ValueError where LAPACK says that it did not converge; NaN or infinity may pass
    unnoticed: callers check.
    """
    values, vectors, status = lapack.dsyevd(matrix)
    if status != 0:
        raise ValueError(f"small_symmetric_eigenpairs: LAPACK's dsyevd ended with {status}")
    return values[::-1], vectors[:, ::-1]


def many_symmetric_eigenpairs(matrices: NDArray[np.float64]) -> tuple[Array, Array]:
    """All eigenvalues, descending (k, n), and eigenvectors as rows (k, n, n) of small symmetric matrices (k, n, n), in
    double precision, without Python's lock. Signs as LAPACK leaves them; raises ValueError where it says that it did
    not converge; NaN or infinity may pass unnoticed.
    """
    if unlocked_blas.available:
        vectors = np.array(matrices, np.float64, order="C")
        values = unlocked_blas.eigenpairs_in_place(vectors)
        return values[:, ::-1], vectors[:, ::-1]
    pairs = [small_symmetric_eigenpairs(matrix) for matrix in matrices]
    return np.stack([pair[0] for pair in pairs]), np.stack([pair[1].T for pair in pairs])


def small_generalized_eigenpairs(a: Array, b: Array) -> tuple[Array, Array] | None:
    """Solutions of a v = value b v for small symmetric matrices, in double precision: values descending (n,), vectors
    as columns with v^T b v = 1. None where b is not positive definite, which callers meet by a sturdier way."""
    values, vectors, status = lapack.dsygvd(a, b)
    return None if status != 0 else (values[::-1], vectors[:, ::-1])


def row_squares(a: Array) -> Array:
    """The squared length of every row of a (m, n): (m,), in a's own precision."""
    return np.vecdot(a, a)


def sparse_multiply(a: csr_array, b: Array) -> Array:
    """The product of a sparse a (m, k) and a dense b (k, n): (m, n).

    scipy's own compiled loop, no BLAS involved: every row of the result depends on its row of `a` alone, to the last
    bit.
    """
    return a @ b


def sparse_multiply_few(a: csr_array, b: Array) -> Array:
    """The same for a few columns, such as colour channels: one after the other, in C order.

    scipy's loop over a row's entries costs one addition per column; for three of them it takes 1.9 times as long as
    three loops over one column each (0.8 million entries: 2.6 ms against 1.4).
    """
    result = np.empty((a.shape[0], b.shape[1]), np.result_type(a.dtype, b.dtype))
    for column in range(b.shape[1]):
        result[:, column] = a @ np.ascontiguousarray(b[:, column])
    return result
