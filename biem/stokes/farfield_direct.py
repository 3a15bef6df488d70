"""Pair sum of Stokeslets by direct summation: u(x_p) = sum over curves j and nodes n of G(x_p - X_jn) f_jn ds_jn.

NumPy arrays go to a compiled loop (numba, threads over targets, result independent of their number); other arrays to a chunked
array-API sum. Cost P M N pairs, memory linear in P.
"""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
from array_api_compat import array_namespace, is_numpy_array

from biem.backend import Array, count, threads
from biem.stokes.kernels import LOG_SIGN, stokeslet, stokeslet_prefactor

CHUNK = 1 << 20  # pairs of one temporary


def direct_sum(targets: Array, X: Array, weighted_force: Array, mu: float, exclude: Array | None = None) -> Array:
    """Velocity (P, 2) at targets (P, 2) of point forces f ds (M, 2, N) at X (M, 2, N).

    exclude (P,), integers: the curve whose nodes a target skips (-1: none), so that a node does not meet itself.
    """
    xp = array_namespace(X)
    count("pair_sum")
    origin = xp.mean(X, axis=(0, 2))
    x, y = targets - origin, X - origin[None, :, None]
    skip = xp.full((targets.shape[0],), -1, dtype=xp.int64, device=X.device) if exclude is None else exclude
    if is_numpy_array(X) and X.dtype == np.float64:
        return _compiled()(
            np.ascontiguousarray(x), np.ascontiguousarray(y), np.ascontiguousarray(weighted_force), skip, stokeslet_prefactor(mu)
        )
    return _chunked(x, y, weighted_force, skip, mu)


def _chunked(x: Array, y: Array, g: Array, skip: Array, mu: float) -> Array:
    xp = array_namespace(y)
    M, _, N = y.shape
    flat_y = xp.reshape(xp.permute_dims(y, (1, 0, 2)), (2, M * N))
    flat_g = xp.reshape(xp.permute_dims(g, (1, 0, 2)), (2, M * N))
    owner = xp.reshape(xp.arange(M, device=y.device)[:, None] + xp.zeros((M, N), dtype=xp.int64, device=y.device), (-1,))
    parts = []
    step = max(1, CHUNK // (M * N))
    for start in range(0, x.shape[0], step):
        xc = x[start : start + step]
        own = skip[start : start + step, None] == owner[None, :]
        rx = xp.where(own, xp.ones_like(y[0, 0, 0]), xc[:, 0, None] - flat_y[0])
        ry = xp.where(own, xp.zeros_like(y[0, 0, 0]), xc[:, 1, None] - flat_y[1])
        gxx, gxy, gyy = (xp.where(own, xp.zeros_like(rx[0, 0]), k) for k in stokeslet(rx, ry, mu))
        ux = xp.sum(gxx * flat_g[0] + gxy * flat_g[1], axis=-1)
        uy = xp.sum(gxy * flat_g[0] + gyy * flat_g[1], axis=-1)
        parts.append(xp.stack([ux, uy], axis=-1))
    return xp.concat(parts, axis=0)


@cache
def _compiled() -> Any:
    """The compiled loop; the formula is `kernels.stokeslet`, held to it by tests/stokes/test_farfield_direct.py."""
    import numba
    from numba import njit, prange

    numba.set_num_threads(min(threads(), numba.config.NUMBA_NUM_THREADS))
    u64, f64 = np.uint64, np.float64
    sqrt_half = u64(0x3FE6A09E667F3BCD)  # bits of sqrt(1/2)
    shift, mantissa, exponent = u64(0x3FF0000000000000 - 0x3FE6A09E667F3BCD), u64(0x000FFFFFFFFFFFFF), u64(52)
    two_52, bias = u64(0x4330000000000000), 2.0**52 + 1023.0

    # libm's log cannot be vectorized; this one can: x = 2^e m, sqrt(1/2) <= m < sqrt(2), log m = 2 atanh((m - 1)/(m + 1)).
    # Reassociation would destroy e = (2^52 + e) - 2^52, so it is not allowed here. Error 1 ulp.
    @njit(error_model="numpy", fastmath={"contract"})
    def log(x: Any) -> Any:
        bits = f64(x).view(u64) + shift
        m = u64((bits & mantissa) + sqrt_half).view(f64)
        e = u64((bits >> exponent) | two_52).view(f64) - bias
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
                    along = (rx * g0[n] + ry * g1[n]) / r2
                    log_r = LOG_SIGN * 0.5 * log(r2)
                    vx += log_r * g0[n] + along * rx
                    vy += log_r * g1[n] + along * ry
                ux += vx
                uy += vy
            u[p, 0] = scale * ux
            u[p, 1] = scale * uy
        return u

    return sum_pairs
