"""`cauchy.velocity_of_arrays`, `close_velocity` and `outer_values` as compiled loops, threads over targets or curves.

Importing this module loads numba.
"""

from math import pi
from typing import Any

import numpy as np
from numba import njit, prange

OPTIONS: Any = {"error_model": "numpy", "fastmath": {"contract", "nsz", "reassoc"}, "cache": True, "nogil": True}


@njit(parallel=True, **OPTIONS)
def velocity(x: Any, Y: Any, normal: Any, g: Any, w: Any, w_alpha: Any, v: Any, reach: Any, inside: bool) -> Any:
    """D (P, 2) at x (P, 2): the trapezoid sum, replaced by barycentric quotients where a node is closer than its reach."""
    P, N = x.shape[0], Y.shape[1]
    u = np.empty((P, 2))
    for p in prange(P):
        ux, uy = 0.0, 0.0
        close = False
        closest, least = 0, np.inf
        for k in range(N):
            rx, ry = x[p, 0] - Y[0, k], x[p, 1] - Y[1, k]
            r2 = rx * rx + ry * ry
            close |= r2 < reach[k]
            if r2 < least:
                closest, least = k, r2
            scale = (rx * normal[0, k] + ry * normal[1, k]) * (rx * g[0, k] + ry * g[1, k]) / (r2 * r2)
            ux += scale * rx
            uy += scale * ry
        if close:
            value = _close(complex(x[p, 0], x[p, 1]), closest, not inside, w, w_alpha, v)
            u[p, 0], u[p, 1] = value.real, value.imag
        else:
            u[p, 0], u[p, 1] = ux / pi, uy / pi
    return u


@njit(parallel=True, **OPTIONS)
def close_velocity(x: Any, closest: Any, outside: Any, curve: Any, w: Any, w_alpha: Any, v: Any) -> Any:
    """D (Q, 2) at x (Q, 2) beside the node closest[q] of curve[q] by barycentric quotients. w, w_alpha: (V, N), v: (V, 3, N)."""
    Q = x.shape[0]
    u = np.empty((Q, 2))
    for q in prange(Q):
        j = curve[q]
        value = _close(complex(x[q, 0], x[q, 1]), closest[q], outside[q], w[j], w_alpha[j], v[j])
        u[q, 0], u[q, 1] = value.real, value.imag
    return u


@njit(parallel=True, **OPTIONS)
def outer_values(w: Any, w_alpha: Any, f: Any, f_alpha: Any) -> Any:
    """`cauchy.outer_values`: limits (V, 3, N) from outside of the Cauchy integrals of f (V, 3, N) on curves w (V, N)."""
    V, N = w.shape
    v = np.empty((V, 3, N), np.complex128)
    for m in prange(V):
        for j in range(N):
            s0, s1, s2 = f_alpha[m, 0, j], f_alpha[m, 1, j], f_alpha[m, 2, j]
            f0, f1, f2 = f[m, 0, j], f[m, 1, j], f[m, 2, j]
            for k in range(N):
                if k != j:
                    quotient = w_alpha[m, k] / (w[m, k] - w[m, j])
                    s0 += (f[m, 0, k] - f0) * quotient
                    s1 += (f[m, 1, k] - f1) * quotient
                    s2 += (f[m, 2, k] - f2) * quotient
            v[m, 0, j], v[m, 1, j], v[m, 2, j] = s0 / complex(0.0, N), s1 / complex(0.0, N), s2 / complex(0.0, N)
    return v


@njit(**OPTIONS)
def _close(z: complex, closest: int, outside: bool, w: Any, w_alpha: Any, v: Any) -> complex:
    N = len(w)
    V0, V1, V2 = v[0, closest], v[1, closest], v[2, closest]
    S = complex(0.0, -N) if outside else 0j
    d0, d1, d2 = -S * V0, -S * V1, -S * V2
    for k in range(N):
        p = w_alpha[k] / (w[k] - z)
        S += p
        d0 += (v[0, k] - V0) * p
        d1 += (v[1, k] - V1) * p
        d2 += (v[2, k] - V2) * p
    d0, d1, d2 = d0 / S, d1 / S, d2 / S
    v0, v1, v2 = V0 + d0, V1 + d1, V2 + d2
    slope = 0j
    z_conj = z.conjugate()
    for k in range(N):
        r = w[k] - z
        change0, change2 = v[0, k] - v0, v[2, k] - v2
        if k == closest:
            change0, change2 = -d0, -d2
        slope += (z_conj * change0 - change2) * w_alpha[k] / (r * r)
    return -0.5 * v0 + (0.5 * slope / S - 0.5 * v1).conjugate()
