"""The pair sum of Stokeslets as a compiled loop: `kernels.stokeslet`, held to it by tests/stokes/test_farfield_direct.py.

Importing this module loads numba. The machine code is kept between processes, which is why everything stands at module level.
"""

from typing import Any

import numpy as np
from numba import njit, prange

from biem.stokes.kernels import LOG_SIGN

u64, f64 = np.uint64, np.float64
SQRT_HALF = u64(0x3FE6A09E667F3BCD)  # bits of sqrt(1/2)
SHIFT, MANTISSA, EXPONENT = u64(0x3FF0000000000000 - 0x3FE6A09E667F3BCD), u64(0x000FFFFFFFFFFFFF), u64(52)
TWO_52, BIAS = u64(0x4330000000000000), 2.0**52 + 1023.0


# libm's log cannot be vectorized; this one can: x = 2^e m, sqrt(1/2) <= m < sqrt(2), log m = 2 atanh((m - 1)/(m + 1)).
# Reassociation would destroy e = (2^52 + e) - 2^52, so it is not allowed here. Error 1 ulp.
@njit(error_model="numpy", fastmath={"contract"}, cache=True)
def log(x: Any) -> Any:
    """Natural logarithm of a positive, normal float64."""
    bits = f64(x).view(u64) + SHIFT
    m = u64((bits & MANTISSA) + SQRT_HALF).view(f64)
    e = u64((bits >> EXPONENT) | TWO_52).view(f64) - BIAS
    s = (m - 1.0) / (m + 1.0)
    z = s * s
    series = 1.0 / 21.0
    series = series * z + 1.0 / 19.0
    series = series * z + 1.0 / 17.0
    series = series * z + 1.0 / 15.0
    series = series * z + 1.0 / 13.0
    series = series * z + 1.0 / 11.0
    series = series * z + 1.0 / 9.0
    series = series * z + 1.0 / 7.0
    series = series * z + 1.0 / 5.0
    series = series * z + 1.0 / 3.0
    return e * 0.6931471805599453 + 2.0 * s * (1.0 + z * series)


# error_model="numpy": a check for division by zero would stop the vectorization
@njit(parallel=True, error_model="numpy", fastmath={"reassoc", "contract", "arcp", "nsz"}, cache=True)
def sum_pairs(x: Any, y: Any, g: Any, skip: Any, scale: float) -> Any:
    """Velocity (P, 2) at x (P, 2) of forces g (M, 2, N) at y (M, 2, N); target p skips curve skip[p]."""
    P, M, N = x.shape[0], y.shape[0], y.shape[2]
    u = np.empty((P, 2))
    for p in prange(P):
        x0, x1 = x[p, 0], x[p, 1]
        ux = uy = 0.0
        for j in range(M):
            if j == skip[p]:
                continue
            y0, y1, g0, g1 = y[j, 0], y[j, 1], g[j, 0], g[j, 1]
            vx = vy = 0.0
            for n in range(N):
                rx = x0 - y0[n]
                ry = x1 - y1[n]
                r2 = rx * rx + ry * ry
                r2 = r2 if r2 > 0.0 else 1.0  # a point does not act on itself
                along = (rx * g0[n] + ry * g1[n]) / r2
                log_r = LOG_SIGN * 0.5 * log(r2)
                vx += log_r * g0[n] + along * rx
                vy += log_r * g1[n] + along * ry
            ux += vx
            uy += vy
        u[p, 0] = scale * ux
        u[p, 1] = scale * uy
    return u
