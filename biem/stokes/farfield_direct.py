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
from biem.stokes.kernels import stokeslet, stokeslet_prefactor

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
        return _loop()(
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
def _loop() -> Any:
    """The compiled loop, on as many threads as `threads()` says; numba is loaded here, where it is needed."""
    import numba

    from biem.stokes.pair_loop import sum_pairs

    numba.set_num_threads(min(threads(), numba.config.NUMBA_NUM_THREADS))
    return sum_pairs
