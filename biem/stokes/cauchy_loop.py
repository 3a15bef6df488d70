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
            value = _close(complex(x[p, 0], x[p, 1]), closest, w, w_alpha, v, inside, a)
            u[p, 0], u[p, 1] = value.real, value.imag
        else:
            u[p, 0], u[p, 1] = ux / pi, uy / pi
    return u


@njit(**OPTIONS)
def _close(z: complex, closest: int, w: Any, w_alpha: Any, v: Any, inside: bool, a: complex) -> complex:
    N = len(w)
    inverse = 1.0 + 0j if inside else w[closest] - a  # 1/c at the closest node
    V0, V1, V2 = v[0, closest] * inverse, v[1, closest] * inverse, v[2, closest] * inverse
    S, d0, d1, d2 = 0j, 0j, 0j, 0j
    for k in range(N):
        q = w_alpha[k] / (w[k] - z)
        c = 1.0 + 0j if inside else 1.0 / (w[k] - a)
        S += c * q
        d0 += (v[0, k] - c * V0) * q
        d1 += (v[1, k] - c * V1) * q
        d2 += (v[2, k] - c * V2) * q
    c_z = 1.0 + 0j if inside else 1.0 / (z - a)
    d0, d1, d2 = d0 / S, d1 / S, d2 / S
    v0, v1, v2 = c_z * (V0 + d0), c_z * (V1 + d1), c_z * (V2 + d2)
    jump = 0j if inside else (z - w[closest]) / inverse * c_z
    slope = 0j
    z_conj = z.conjugate()
    for k in range(N):
        r = w[k] - z
        change0, change2 = v[0, k] - v0, v[2, k] - v2
        if k == closest:
            change0, change2 = V0 * jump - c_z * d0, V2 * jump - c_z * d2
        slope += (z_conj * change0 - change2) * w_alpha[k] / (r * r)
    return -0.5 * v0 + (0.5 * c_z * slope / S - 0.5 * v1).conjugate()
