"""Compiled loops of `farfield_stress`. Importing this module loads numba.

Phi = sum_k q_k/r,  D = -sum_k (conj(r) q_k/r^2 + sign conj(q_k)/r),  r = z - y_k in the complex plane; q: (M, 2, N) real and imaginary
parts. A target skips the curves skip[first[p] : first[p + 1]]. Each target is written once, by one thread.
"""

from typing import Any

import numpy as np
from numba import njit, prange

OPTIONS: Any = {"error_model": "numpy", "fastmath": {"reassoc", "contract", "arcp", "nsz"}, "cache": True, "nogil": True}
SERIES_BELOW = 1e-2  # of s^2 r^2: there 1 - (1 + z) e^-z loses digits


@njit(**OPTIONS)
def _curve(x: float, y: float, Y: Any, q: Any, sign: float) -> Any:
    """Phi and D of one curve's nodes Y (2, N) at (x, y)."""
    phi_x = phi_y = d_x = d_y = 0.0
    for k in range(Y.shape[1]):
        rx, ry = x - Y[0, k], y - Y[1, k]
        over = 1.0 / (rx * rx + ry * ry)
        cx, cy = rx * over, -ry * over  # 1/r
        qx, qy = q[0, k], q[1, k]
        ax, ay = qx * cx - qy * cy, qx * cy + qy * cx  # q/r
        bx, by = rx * cx + ry * cy, rx * cy - ry * cx  # conj(r)/r
        phi_x += ax
        phi_y += ay
        d_x -= ax * bx - ay * by + sign * (qx * cx + qy * cy)
        d_y -= ax * by + ay * bx + sign * (qx * cy - qy * cx)
    return phi_x, phi_y, d_x, d_y


@njit(parallel=True, **OPTIONS)
def direct(x: Any, Y: Any, q: Any, sign: float, first: Any, skip: Any) -> Any:
    """Phi and D (P, 2) at x (P, 2) of the nodes Y (M, 2, N)."""
    P, M = len(x), len(Y)
    out = np.empty((P, 2), dtype=np.complex128)
    for p in prange(P):
        phi_x = phi_y = d_x = d_y = 0.0
        at = first[p]
        for m in range(M):
            if at < first[p + 1] and skip[at] == m:  # skipped curves are sorted
                at += 1
                continue
            a, b, c, d = _curve(x[p, 0], x[p, 1], Y[m], q[m], sign)
            phi_x += a
            phi_y += b
            d_x += c
            d_y += d
        out[p, 0], out[p, 1] = complex(phi_x, phi_y), complex(d_x, d_y)
    return out


@njit(**OPTIONS)
def _add(total: Any, rx: float, ry: float, r2: float, f1: float, f2: float, qx: float, qy: float, sign: float) -> None:
    """Adds f1 q/r to Phi and -(f2 conj(r) q/r^2 + f1 sign conj(q)/r) to D; total: real and imaginary parts of both."""
    over = 1.0 / r2
    cx, cy = rx * over, -ry * over
    ax, ay = qx * cx - qy * cy, qx * cy + qy * cx
    bx, by = rx * cx + ry * cy, rx * cy - ry * cx
    total[0] += f1 * ax
    total[1] += f1 * ay
    total[2] -= f2 * (ax * bx - ay * by) + f1 * sign * (qx * cx + qy * cy)
    total[3] -= f2 * (ax * by + ay * bx) + f1 * sign * (qx * cy - qy * cx)


@njit(parallel=True, **OPTIONS)
def near_sum(
    x: Any, order: Any, Y: Any, q: Any, owner: Any, starts: Any, side: float, s2: float, Z: Any, g: Any, sign: float, first: Any, skip: Any
) -> Any:
    """What the smooth kernels leave, (P, 2) Phi and D: singular parts within 1 of each target, less the smooth parts of skipped curves.

    Lengths in units of the cut-off. x (P, 2) from the lower left corner of the cells of this side, order (P,): in which to visit them;
    Y, q (S, 2) and owner (S,): sources sorted by cell and the curves that they are of; starts (nx, ny + 1): where each cell begins;
    s2: s^2; Z, g (M, 2, N): the same sources by curve, from the same corner.
    """
    P = len(x)
    nx, ny = starts.shape[0], starts.shape[1] - 1
    out = np.empty((P, 2), dtype=np.complex128)
    for place in prange(P):
        p = order[place]
        x0, x1 = x[p, 0], x[p, 1]
        total = np.zeros(4)
        begin, end = first[p], first[p + 1]
        for i in range(int(max(0.0, np.floor((x0 - 1.0) / side))), int(min(nx - 1.0, np.floor((x0 + 1.0) / side))) + 1):
            away = max(side * i - x0, x0 - side * (i + 1), 0.0)
            reach = np.sqrt(max(1.0 - away * away, 0.0))
            low = int(max(0.0, np.floor((x1 - reach) / side)))
            high = int(min(ny - 1.0, np.floor((x1 + reach) / side))) + 1
            if low >= high:
                continue
            for k in range(starts[i, low], starts[i, high]):
                rx, ry = x0 - Y[k, 0], x1 - Y[k, 1]
                r2 = rx * rx + ry * ry
                skipped = r2 >= 1.0 or r2 == 0.0
                for j in range(begin, end):
                    skipped |= skip[j] == owner[k]
                if not skipped:
                    decay = np.exp(-s2 * r2)
                    _add(total, rx, ry, r2, decay, (1.0 + s2 * r2) * decay, q[k, 0], q[k, 1], sign)
        for j in range(begin, end):
            m = skip[j]
            for k in range(Z.shape[2]):
                rx, ry = x0 - Z[m, 0, k], x1 - Z[m, 1, k]
                r2 = rx * rx + ry * ry
                if r2 > 0.0:
                    z = s2 * r2
                    f1 = -np.expm1(-z)
                    f2 = f1 - z * (1.0 - f1) if z > SERIES_BELOW else z * z * (0.5 - z * (1.0 / 3.0 - z * (0.125 - z / 30.0)))
                    _add(total, rx, ry, r2, -f1, -f2, g[m, 0, k], g[m, 1, k], sign)
        out[p, 0], out[p, 1] = complex(total[0], total[1]), complex(total[2], total[3])
    return out


@njit(parallel=True, **OPTIONS)
def double_velocity(x: Any, Y: Any, normal: Any, g: Any, first: Any, skip: Any) -> Any:
    """Velocity (P, 2) at x (P, 2) of the double layer of weighted densities g = tau ds (M, 2, N) at Y; see `kernels.double_layer`."""
    P, M = len(x), len(Y)
    out = np.empty((P, 2))
    for p in prange(P):
        ux = uy = 0.0
        at = first[p]
        for m in range(M):
            if at < first[p + 1] and skip[at] == m:
                at += 1
                continue
            for k in range(Y.shape[2]):
                rx, ry = x[p, 0] - Y[m, 0, k], x[p, 1] - Y[m, 1, k]
                over = 1.0 / (rx * rx + ry * ry)
                scale = (rx * normal[m, 0, k] + ry * normal[m, 1, k]) * (rx * g[m, 0, k] + ry * g[m, 1, k]) * over * over
                ux += scale * rx
                uy += scale * ry
        out[p, 0], out[p, 1] = ux / np.pi, uy / np.pi
    return out
