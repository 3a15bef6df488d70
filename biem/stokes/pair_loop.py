"""The pair sum of Stokeslets as a compiled loop: `kernels.stokeslet`, held to it by tests/stokes/test_farfield_direct.py.

float32 or float64 as the arrays are; the sum over the curves is kept in float64. Importing this module loads numba. The machine code
is kept between processes, which is why everything stands at module level.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
from numba import njit, prange, types
from numba.extending import overload

from biem.stokes.kernels import LOG_SIGN

u32, u64, f32, f64 = np.uint32, np.uint64, np.float32, np.float64
SQRT_HALF = u64(0x3FE6A09E667F3BCD)  # bits of sqrt(1/2)
SHIFT, MANTISSA, EXPONENT = u64(0x3FF0000000000000 - 0x3FE6A09E667F3BCD), u64(0x000FFFFFFFFFFFFF), u64(52)
TWO_52, BIAS = u64(0x4330000000000000), 2.0**52 + 1023.0
SQRT_HALF_32 = u32(0x3F3504F3)
SHIFT_32, MANTISSA_32, EXPONENT_32 = u32(0x3F800000 - 0x3F3504F3), u32(0x007FFFFF), u32(23)
TWO_23, BIAS_32 = u32(0x4B000000), f32(2.0**23 + 127.0)
LOG_2, TWO, ONE = f32(0.6931471805599453), f32(2.0), f32(1.0)
S9, S7, S5, S3 = f32(1.0 / 9.0), f32(1.0 / 7.0), f32(1.0 / 5.0), f32(1.0 / 3.0)


def log(x: Any) -> Any:
    """Natural logarithm of a positive, normal float64 or float32, in compiled code.

    libm's cannot be vectorized; this one can: x = 2^e m, sqrt(1/2) <= m < sqrt(2), log m = 2 atanh((m - 1)/(m + 1)).
    """
    return np.log(x)


# Reassociation would destroy e = (2^52 + e) - 2^52, so it is not allowed here. Error 1 ulp.
@overload(log, jit_options={"error_model": "numpy", "fastmath": {"contract"}}, inline="never")
def _log(x: Any) -> Callable[[Any], Any]:
    def log_64(x: Any) -> Any:
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

    def log_32(x: Any) -> Any:
        bits = u32(f32(x).view(u32) + SHIFT_32)
        m = u32(u32(bits & MANTISSA_32) + SQRT_HALF_32).view(f32)
        e = u32(u32(bits >> EXPONENT_32) | TWO_23).view(f32) - BIAS_32
        s = (m - ONE) / (m + ONE)
        z = s * s
        return e * LOG_2 + TWO * s * (ONE + z * (S3 + z * (S5 + z * (S7 + z * S9))))

    return log_32 if x is types.float32 else log_64


# error_model="numpy": a check for division by zero would stop the vectorization
@njit(error_model="numpy", fastmath={"reassoc", "contract", "arcp", "nsz"}, cache=True)
def curve_sum(x0: Any, x1: Any, y: Any, g: Any) -> Any:
    """4 pi mu times the velocity at one point (x0, x1) of the forces g (2, N) of one curve at y (2, N)."""
    y0, y1, g0, g1 = y[0], y[1], g[0], g[1]
    zero, one, half = y.dtype.type(0.0), y.dtype.type(1.0), y.dtype.type(0.5 * LOG_SIGN)
    vx = vy = zero
    for n in range(y.shape[1]):
        rx = x0 - y0[n]
        ry = x1 - y1[n]
        r2 = rx * rx + ry * ry
        r2 = one if r2 == zero else r2  # a point does not act on itself
        along = (rx * g0[n] + ry * g1[n]) / r2
        log_r = half * log(r2)
        vx += log_r * g0[n] + along * rx
        vy += log_r * g1[n] + along * ry
    return vx, vy


@njit(parallel=True, error_model="numpy", fastmath={"reassoc", "contract", "arcp", "nsz"}, cache=True)
def sum_pairs(x: Any, y: Any, g: Any, skip: Any, scale: float) -> Any:
    """Velocity (P, 2) at x (P, 2) of forces g (M, 2, N) at y (M, 2, N); target p skips curve skip[p]."""
    P, M = x.shape[0], y.shape[0]
    u = np.empty_like(x)
    for p in prange(P):
        ux = uy = 0.0
        for j in range(M):
            if j != skip[p]:
                vx, vy = curve_sum(x[p, 0], x[p, 1], y[j], g[j])
                ux += vx
                uy += vy
        u[p, 0] = scale * ux
        u[p, 1] = scale * uy
    return u


@njit(parallel=True, error_model="numpy", fastmath={"reassoc", "contract", "arcp", "nsz"}, cache=True)
def sum_own(x: Any, y: Any, g: Any, curve: Any, scale: float) -> Any:
    """Velocity (P, 2) at x (P, 2) of the forces of curve curve[p] alone (-1: 0)."""
    u = np.zeros_like(x)
    for p in prange(x.shape[0]):
        if curve[p] >= 0:
            vx, vy = curve_sum(x[p, 0], x[p, 1], y[curve[p]], g[curve[p]])
            u[p, 0] = scale * vx
            u[p, 1] = scale * vy
    return u
