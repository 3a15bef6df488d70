"""`cauchy.velocity_of_arrays` as a compiled loop, threads over targets. Importing this module loads numba."""

from math import pi
from typing import Any

import numpy as np
from numba import njit, prange

OPTIONS: Any = {"error_model": "numpy", "fastmath": {"contract", "nsz", "reassoc"}, "cache": True, "nogil": True}


@njit(parallel=True, **OPTIONS)
def velocity(x: Any, Y: Any, normal: Any, g: Any, w: Any, w_alpha: Any, v: Any, reach: Any, inside: bool, a: complex) -> Any:
    """D (P, 2) at x (P, 2): the trapezoid sum, replaced by barycentric quotients where a node is closer than its reach."""
    P, N = x.shape[0], Y.shape[1]
    u = np.empty((P, 2))
    for p in prange(P):
        ux, uy = 0.0, 0.0
        close = False
        for k in range(N):
            rx, ry = x[p, 0] - Y[0, k], x[p, 1] - Y[1, k]
            r2 = rx * rx + ry * ry
            close |= r2 < reach[k]
            scale = (rx * normal[0, k] + ry * normal[1, k]) * (rx * g[0, k] + ry * g[1, k]) / (r2 * r2)
            ux += scale * rx
            uy += scale * ry
        if close:
            value = _close(complex(x[p, 0], x[p, 1]), w, w_alpha, v, inside, a)
            u[p, 0], u[p, 1] = value.real, value.imag
        else:
            u[p, 0], u[p, 1] = ux / pi, uy / pi
    return u


@njit(**OPTIONS)
def _close(z: complex, w: Any, w_alpha: Any, v: Any, inside: bool, a: complex) -> complex:
    N = len(w)
    S, v0, v1, v2 = 0j, 0j, 0j, 0j
    for k in range(N):
        q = w_alpha[k] / (w[k] - z)
        S += q if inside else q / (w[k] - a)
        v0 += v[0, k] * q
        v1 += v[1, k] * q
        v2 += v[2, k] * q
    if not inside:
        S *= z - a
    v0, v1, v2 = v0 / S, v1 / S, v2 / S
    slope = 0j
    z_conj = z.conjugate()
    for k in range(N):
        r = w[k] - z
        slope += (z_conj * (v[0, k] - v0) - (v[2, k] - v2)) * w_alpha[k] / (r * r)
    return -0.5 * v0 + (0.5 * slope / S - 0.5 * v1).conjugate()
