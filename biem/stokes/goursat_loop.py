"""Compiled loops of `goursat`: Cauchy integrals on the curves, and quotients next to them. Importing this module loads numba.

Every curve and every target is written once, by one thread. Complex numbers are taken apart, so that the loops vectorize.
"""

from typing import Any

import numpy as np
from numba import njit, prange

OPTIONS: Any = {"error_model": "numpy", "fastmath": {"reassoc", "contract", "arcp", "nsz"}, "cache": True, "nogil": True}
BLOCK = 256  # targets that share a thread's buffers


@njit(**OPTIONS)
def _weights(x: float, y: float, w: Any, w_alpha: Any, p: Any) -> Any:
    """w'_k/(w_k - z) into p (2, n), and their sum, for z = x + i y; w, w_alpha: (2, n)."""
    sum_x = sum_y = 0.0
    for k in range(w.shape[1]):
        rx, ry = w[0, k] - x, w[1, k] - y
        over = 1.0 / (rx * rx + ry * ry)
        px = (w_alpha[0, k] * rx + w_alpha[1, k] * ry) * over
        py = (w_alpha[1, k] * rx - w_alpha[0, k] * ry) * over
        p[0, k], p[1, k] = px, py
        sum_x += px
        sum_y += py
    return sum_x, sum_y


@njit(**OPTIONS)
def _product(p: Any, v: Any) -> Any:
    """sum_k p_k v_k for p, v: (2, n)."""
    sum_x = sum_y = 0.0
    for k in range(p.shape[1]):
        sum_x += p[0, k] * v[0, k] - p[1, k] * v[1, k]
        sum_y += p[0, k] * v[1, k] + p[1, k] * v[0, k]
    return complex(sum_x, sum_y)


@njit(**OPTIONS)
def _apart(a: Any, out: Any) -> None:
    """Real and imaginary part of a (n,) into out (2, n)."""
    for k in range(len(a)):
        out[0, k], out[1, k] = a[k].real, a[k].imag


@njit(parallel=True, **OPTIONS)
def cauchy_outside(w: Any, w_alpha: Any, g: Any, g_alpha: Any) -> Any:
    """C[g] at the nodes (V, K, n), the limit from outside, for densities g (V, K, n) and their derivatives; w, w_alpha: (V, n).

    1/(i n) (sum_{k != j} (g_k - g_j) w'_k/(w_k - w_j) + g'_j)
    """
    V, K, n = g.shape
    out = np.empty((V, K, n), dtype=np.complex128)
    for m in prange(V):
        at, slope, p, f = np.empty((2, n)), np.empty((2, n)), np.empty((2, n)), np.empty((K, 2, n))
        _apart(w[m], at)
        _apart(w_alpha[m], slope)
        for i in range(K):
            _apart(g[m, i], f[i])
        for j in range(n):
            x, y = at[0, j], at[1, j]
            at[0, j] = x + 1.0  # not its own neighbour: the weight is taken out below
            sx, sy = _weights(x, y, at, slope, p)
            at[0, j] = x
            total = complex(sx - p[0, j], sy - p[1, j])
            p[0, j] = p[1, j] = 0.0
            for i in range(K):
                out[m, i, j] = (_product(p, f[i]) - total * g[m, i, j] + g_alpha[m, i, j]) / complex(0.0, n)
    return out


@njit(parallel=True, **OPTIONS)
def quotients(z: Any, curve: Any, side: Any, w: Any, w_alpha: Any, values: Any, lift: Any) -> Any:
    """(Q, K): the K functions of the curve and side of each target at z (Q,).

    Real and imaginary parts: w, w_alpha (V, 2, n), values (2, V, K, 2, n). lift (2,): what is added to the sum of the weights, by side.
    """
    Q, K, n = len(z), values.shape[2], w.shape[2]
    out = np.empty((Q, K), dtype=np.complex128)
    for block in prange((Q + BLOCK - 1) // BLOCK):
        p = np.empty((2, n))
        for q in range(block * BLOCK, min(Q, (block + 1) * BLOCK)):
            m, s = curve[q], side[q]
            sx, sy = _weights(z[q].real, z[q].imag, w[m], w_alpha[m], p)
            if np.isfinite(sx) and np.isfinite(sy):
                over = 1.0 / (complex(sx, sy) + lift[s])
                for i in range(K):
                    out[q, i] = over * _product(p, values[s, m, i])
            else:  # at a node
                k = np.argmin((w[m, 0] - z[q].real) ** 2 + (w[m, 1] - z[q].imag) ** 2)
                for i in range(K):
                    out[q, i] = complex(values[s, m, i, 0, k], values[s, m, i, 1, k])
    return out
