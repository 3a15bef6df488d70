"""`kress.kernel_blocks`, and its product with a density, as compiled loops. Importing this module loads numba.

One thread each: callers run chunks of vesicles side by side. Held to the array code by tests/stokes/test_kress.py.
"""

from typing import Any

import numpy as np
from numba import njit

from biem.stokes.pair_loop import log

OPTIONS: Any = {"error_model": "numpy", "fastmath": {"reassoc", "contract", "arcp", "nsz"}, "cache": True, "nogil": True}


@njit(**OPTIONS)
def _unrolled(c: Any, scale: float) -> Any:
    """c_{i-j} for j = 0..n-1 is the stretch from n - i on: c is even."""
    n = c.shape[0]
    out = np.empty(2 * n)
    for d in range(2 * n):
        out[d] = scale * c[d % n]
    return out


@njit(**OPTIONS)
def kernel_blocks(X: Any, X_alpha: Any, c: Any, scale: float, log_sign: float) -> Any:
    """K (M, 3, n, n); c: circulant (n,)."""
    M, _, n = X.shape
    K = np.empty((M, 3, n, n))
    c_all = _unrolled(c, scale)
    for m in range(M):
        x, y = X[m, 0], X[m, 1]
        for i in range(n):
            K_xx, K_xy, K_yy = K[m, 0, i], K[m, 1, i], K[m, 2, i]
            c_i = c_all[n - i : 2 * n - i]
            for j in range(n):
                rx = x[i] - x[j]
                ry = y[i] - y[j]
                r2 = rx * rx + ry * ry
                r2 = r2 if r2 > 0.0 else 1.0
                log_term = c_i[j] + scale * log_sign * 0.5 * log(r2)
                sx = scale * rx / r2
                K_xx[j] = log_term + sx * rx
                K_xy[j] = sx * ry
                K_yy[j] = log_term + scale * ry * ry / r2
            ax, ay = X_alpha[m, 0, i], X_alpha[m, 1, i]
            speed2 = ax * ax + ay * ay
            log_speed = scale * (c[0] + log_sign * 0.5 * np.log(speed2))
            K_xx[i] = log_speed + scale * ax * ax / speed2
            K_xy[i] = scale * ax * ay / speed2
            K_yy[i] = log_speed + scale * ay * ay / speed2
    return K


@njit(**OPTIONS)
def apply_kernel(X: Any, X_alpha: Any, g: Any, c: Any, scale: float, log_sign: float) -> Any:
    """K g (M, 2, n) for g (M, 2, n)."""
    M, _, n = X.shape
    u = np.empty((M, 2, n))
    c_all = _unrolled(c, scale)
    for m in range(M):
        x, y, g_x, g_y = X[m, 0], X[m, 1], g[m, 0], g[m, 1]
        for i in range(n):
            c_i = c_all[n - i : 2 * n - i]
            u_x = u_y = 0.0
            for j in range(n):
                rx = x[i] - x[j]
                ry = y[i] - y[j]
                r2 = rx * rx + ry * ry
                r2 = r2 if r2 > 0.0 else 1.0
                log_term = c_i[j] + scale * log_sign * 0.5 * log(r2)
                along = scale * (rx * g_x[j] + ry * g_y[j]) / r2
                u_x += log_term * g_x[j] + along * rx
                u_y += log_term * g_y[j] + along * ry
            ax, ay = X_alpha[m, 0, i], X_alpha[m, 1, i]
            speed2 = ax * ax + ay * ay
            log_speed = log_sign * 0.5 * np.log(speed2)  # c_0 is in the loop
            along = (ax * g_x[i] + ay * g_y[i]) / speed2
            u[m, 0, i] = u_x + scale * (log_speed * g_x[i] + along * ax)
            u[m, 1, i] = u_y + scale * (log_speed * g_y[i] + along * ay)
    return u
