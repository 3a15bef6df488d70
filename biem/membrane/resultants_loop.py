"""The inner loops of `resultants` that libraries are slow at for small matrices. Importing this module loads numba.

One thread each: callers run chunks of vesicles side by side. Held to their array versions by tests/membrane/test_resultants.py.
"""

from typing import Any

import numpy as np
from numba import njit

OPTIONS: Any = {"error_model": "numpy", "fastmath": {"contract", "nsz", "reassoc"}, "cache": True, "nogil": True}


@njit(**OPTIONS)
def in_frame(G: Any, a: Any, b: Any) -> Any:
    """a . G b (M, n, n) for blocks xx, xy, yy G (M, 3, n, n) and fields a, b (M, 2, n)."""
    M, _, n, _ = G.shape
    out = np.empty((M, n, n), G.dtype)
    for m in range(M):
        for i in range(n):
            ax, ay = a[m, 0, i], a[m, 1, i]
            for j in range(n):
                bx, by = b[m, 0, j], b[m, 1, j]
                out[m, i, j] = ax * (G[m, 0, i, j] * bx + G[m, 1, i, j] * by) + ay * (G[m, 1, i, j] * bx + G[m, 2, i, j] * by)
    return out


@njit(**OPTIONS)
def dot_product_matrix(A: Any, a: Any, b: Any) -> Any:
    """A_ij (a_i . b_j) (M, n, n) for A (M, n, n) and fields a, b (M, 2, n)."""
    M, n, _ = A.shape
    out = np.empty((M, n, n), A.dtype)
    for m in range(M):
        for i in range(n):
            ax, ay = a[m, 0, i], a[m, 1, i]
            for j in range(n):
                out[m, i, j] = A[m, i, j] * (ax * b[m, 0, j] + ay * b[m, 1, j])
    return out


@njit(**OPTIONS)
def inverse_factor(A: Any, least: float) -> Any:
    """W (M, n, n), lower triangular, with W^T W = A^-1 for symmetric positive definite A (M, n, n); NaN where A is not.

    A pivot within `least` of zero, relative to the largest element of the diagonal, is left out: its row of W is zero.

    Cholesky of [A | I] by rows, eight at a time: W is what becomes of I.
    """
    M, n, _ = A.shape
    W = np.zeros((M, n, n), A.dtype)
    work = np.empty((n, 2 * n), A.dtype)
    for m in range(M):
        for i in range(n):
            for j in range(n):
                work[i, j] = A[m, i, j]
                work[i, n + j] = 0.0
            work[i, n + i] = 1.0
        small = 0.0
        for i in range(n):
            small = max(small, least * A[m, i, i])
        for k in range(0, n, 8):
            end = min(k + 8, n)
            for i in range(k, end):
                for p in range(k, i):
                    f = work[p, i]
                    for j in range(i, n + i):
                        work[i, j] -= f * work[p, j]
                f = work[i, i]
                f = 1.0 / np.sqrt(f) if f > small else (0.0 if f >= -small else np.nan)
                for j in range(i, n + i + 1):
                    work[i, j] *= f
            for i in range(end, n):  # never after a block of fewer than eight rows
                a0, a1, a2, a3 = work[k, i], work[k + 1, i], work[k + 2, i], work[k + 3, i]
                a4, a5, a6, a7 = work[k + 4, i], work[k + 5, i], work[k + 6, i], work[k + 7, i]
                for j in range(i, n + end):
                    work[i, j] -= (
                        a0 * work[k, j]
                        + a1 * work[k + 1, j]
                        + a2 * work[k + 2, j]
                        + a3 * work[k + 3, j]
                        + a4 * work[k + 4, j]
                        + a5 * work[k + 5, j]
                        + a6 * work[k + 6, j]
                        + a7 * work[k + 7, j]
                    )
        for i in range(n):
            for j in range(i + 1):
                W[m, i, j] = work[i, n + j]
    return W
