# SPDX-License-Identifier: GPL-3.0-or-later
"""scipy's BLAS and LAPACK without Python's lock.

The functions in `scipy.linalg.blas` and `.lapack` hold the interpreter's lock while they compute, so threads that use
them wait for each other (measured: two threads are no faster than one). The same compiled routines are exported for
Cython by `scipy.linalg.cython_blas` and `.cython_lapack`; called by address through ctypes they run without the lock.
A call costs some 5 us more, so it pays for large products and for eigenproblems.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from types import ModuleType

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cython_blas, cython_lapack

_LETTERS = {letter: ctypes.create_string_buffer(letter) for letter in (b"N", b"T", b"V", b"L")}
_LETTER = {letter: ctypes.addressof(buffer) for letter, buffer in _LETTERS.items()}
_CONSTANTS = {"s": (ctypes.c_float(1.0), ctypes.c_float(0.0)), "d": (ctypes.c_double(1.0), ctypes.c_double(0.0))}
_ONE = {kind: ctypes.addressof(pair[0]) for kind, pair in _CONSTANTS.items()}
_ZERO = {kind: ctypes.addressof(pair[1]) for kind, pair in _CONSTANTS.items()}


def _routine(module: ModuleType, name: str, arguments: int) -> Callable[..., None] | None:
    """The exported routine, or None where this scipy exports none of these arguments with 32-bit integers."""
    capsule = getattr(module, "__pyx_capi__", {}).get(name)
    if capsule is None:
        return None
    get_name, get_pointer = ctypes.pythonapi.PyCapsule_GetName, ctypes.pythonapi.PyCapsule_GetPointer
    get_name.restype, get_name.argtypes = ctypes.c_char_p, [ctypes.py_object]
    get_pointer.restype, get_pointer.argtypes = ctypes.c_void_p, [ctypes.py_object, ctypes.c_char_p]
    signature = get_name(capsule)
    kinds = signature[signature.index(b"(") + 1:].rstrip(b")").split(b",")
    if not signature.startswith(b"void") or len(kinds) != arguments or b"int *" not in [k.strip() for k in kinds]:
        return None
    return ctypes.CFUNCTYPE(None, *[ctypes.c_void_p] * arguments)(get_pointer(capsule, signature))


_GEMM = {"s": _routine(cython_blas, "sgemm", 13), "d": _routine(cython_blas, "dgemm", 13)}
_EIGEN = _routine(cython_lapack, "dsyevd", 11)
available = None not in (*_GEMM.values(), _EIGEN)


def _address(array: NDArray) -> int:
    return array.ctypes.data


def gemm(a: NDArray, b: NDArray, out: NDArray, accumulate: bool = False) -> None:
    """out (m, n) = or += a (m, k) times b (k, n): all float32 or all float64, none empty, out C-ordered, a and b
    contiguous in either order. The caller has checked all that."""
    kind = out.dtype.char if out.dtype.char == "d" else "s"
    (m, k), n = a.shape, b.shape[1]
    a_plain, b_plain = a.flags.c_contiguous, b.flags.c_contiguous
    # Column-major BLAS sees the transposes, so out^T = b^T a^T.
    sizes = (ctypes.c_int * 6)(n, m, k, n if b_plain else k, k if a_plain else m, n)
    at = ctypes.addressof(sizes)
    _GEMM[kind](_LETTER[b"N" if b_plain else b"T"], _LETTER[b"N" if a_plain else b"T"], at, at + 4, at + 8, _ONE[kind],
                _address(b), at + 12, _address(a), at + 16, _ONE[kind] if accumulate else _ZERO[kind],
                _address(out), at + 20)


def eigenpairs_in_place(matrices: NDArray[np.float64]) -> NDArray[np.float64]:
    """Ascending eigenvalues (k, n) of symmetric matrices (k, n, n), C-ordered, whose rows become the eigenvectors.

    Raises ValueError where LAPACK says that it did not converge; NaN or infinity may pass unnoticed.
    """
    count, size = matrices.shape[:2]
    values = np.empty((count, size))
    work, integers = np.empty(1 + 6 * size + 2 * size**2), np.empty(3 + 5 * size, np.int32)
    sizes = (ctypes.c_int * 4)(size, work.size, integers.size, 0)
    at, matrix, value = ctypes.addressof(sizes), _address(matrices), _address(values)
    work_at, integers_at = _address(work), _address(integers)
    for index in range(count):
        _EIGEN(_LETTER[b"V"], _LETTER[b"L"], at, matrix + 8 * size**2 * index, at, value + 8 * size * index, work_at,
               at + 4, integers_at, at + 8, at + 12)
        if sizes[3] != 0:
            raise ValueError(f"eigenpairs_in_place: LAPACK's dsyevd ended with {sizes[3]}")
    return values
