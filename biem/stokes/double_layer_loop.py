"""Sums of double layers as compiled loops: `kernels.double_layer`, held to it by tests/stokes/test_double_layers.py.

Threads over targets; the result does not depend on their number. Importing this module loads numba.
"""

from math import pi
from typing import Any

import numpy as np
from numba import njit, prange

OPTIONS: Any = {"error_model": "numpy", "fastmath": {"contract", "nsz", "reassoc", "arcp"}, "cache": True, "nogil": True}


@njit(**OPTIONS)
def curve_sum(x0: Any, x1: Any, y: Any, normal: Any, g: Any) -> Any:
    """pi times D at one point (x0, x1) of the weighted densities g = q ds (2, N) of one curve at y (2, N)."""
    y0, y1, n0, n1, g0, g1 = y[0], y[1], normal[0], normal[1], g[0], g[1]
    vx = vy = 0.0
    for k in range(y.shape[1]):
        rx = x0 - y0[k]
        ry = x1 - y1[k]
        r2 = rx * rx + ry * ry
        r2 = 1.0 if r2 == 0.0 else r2  # a point does not act on itself
        scale = (rx * n0[k] + ry * n1[k]) * (rx * g0[k] + ry * g1[k]) / (r2 * r2)
        vx += scale * rx
        vy += scale * ry
    return vx, vy


@njit(parallel=True, **OPTIONS)
def sum_all(x: Any, y: Any, normal: Any, g: Any, skip: Any) -> Any:
    """D (P, 2) at x (P, 2) of all curves y (M, 2, N); target p skips curve skip[p]."""
    P, M = x.shape[0], y.shape[0]
    u = np.empty_like(x)
    for p in prange(P):
        ux = uy = 0.0
        for j in range(M):
            if j != skip[p]:
                vx, vy = curve_sum(x[p, 0], x[p, 1], y[j], normal[j], g[j])
                ux += vx
                uy += vy
        u[p, 0], u[p, 1] = ux / pi, uy / pi
    return u


@njit(parallel=True, **OPTIONS)
def sum_own(x: Any, y: Any, normal: Any, g: Any, curve: Any) -> Any:
    """D (P, 2) at x (P, 2) of curve curve[p] alone."""
    u = np.empty_like(x)
    for p in prange(x.shape[0]):
        j = curve[p]
        vx, vy = curve_sum(x[p, 0], x[p, 1], y[j], normal[j], g[j])
        u[p, 0], u[p, 1] = vx / pi, vy / pi
    return u
