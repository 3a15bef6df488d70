"""Pair sum of Stokeslets by direct summation: u(x_p) = sum over curves j and nodes n of G(x_p - X_jn) f_jn ds_jn.

On the CPU a compiled loop (numba, threads over targets, result independent of their number), in float32 or float64 as the arrays are;
on CUDA one fused kernel (`farfield_triton`), or a chunked array-API sum where Triton is not installed. Cost P M N pairs, memory linear
in P and M N.
"""

from __future__ import annotations

from importlib.util import find_spec

import numpy as np
from array_api_compat import is_torch_array

from biem.backend import Array, array_namespace, compiled, count, from_numpy, on_cpu, to_numpy
from biem.stokes.kernels import stokeslet, stokeslet_prefactor

CHUNK = 1 << 20  # pairs of one temporary


def direct_sum(targets: Array, X: Array, weighted_force: Array, mu: float, exclude: Array | None = None) -> Array:
    """Velocity (P, 2) at targets (P, 2) of point forces f ds (M, 2, N) at X (M, 2, N).

    exclude (P,), integers: the curve whose nodes a target skips (-1: none), so that a node does not meet itself.
    """
    return DirectSum(targets, X, mu, exclude).velocity(weighted_force)


class DirectSum:
    """`direct_sum` for fixed points."""

    def __init__(self, targets: Array, X: Array, mu: float, exclude: Array | None = None) -> None:
        xp = array_namespace(X)
        origin = xp.mean(X, axis=(0, 2))
        self.mu = mu
        self.x, self.y = targets - origin, X - origin[None, :, None]
        self.skip = xp.full((targets.shape[0],), -1, dtype=xp.int64, device=X.device) if exclude is None else exclude

    def velocity(self, weighted_force: Array) -> Array:
        """(P, 2) for weighted_force = f ds (M, 2, N)."""
        count("pair_sum")
        if on_cpu(self.y):
            return _by_loop("sum_pairs", self.x, self.y, weighted_force, self.skip, self.mu)
        if is_torch_array(self.y) and self.y.device.type == "cuda" and find_spec("triton") is not None:
            from biem.stokes.farfield_triton import sum_pairs

            return sum_pairs(self.x, self.y, weighted_force, self.skip, stokeslet_prefactor(self.mu))
        return chunked_sum(self.x, self.y, weighted_force, self.skip, self.mu)


def own_sum(x: Array, y: Array, g: Array, curve: Array, mu: float) -> Array:
    """Velocity (P, 2) at x (P, 2) of the forces g (M, 2, N) at y (M, 2, N) of curve curve[p] alone (-1: 0)."""
    if on_cpu(y):
        return _by_loop("sum_own", x, y, g, curve, mu)
    return own_sum_of_arrays(x, y, g, curve, mu)


def _by_loop(name: str, x: Array, y: Array, g: Array, curve: Array, mu: float) -> Array:
    loop = getattr(compiled("biem.stokes.pair_loop"), name)
    arrays = (np.ascontiguousarray(to_numpy(a)) for a in (x, y, g))
    return from_numpy(loop(*arrays, to_numpy(curve), stokeslet_prefactor(mu)), like=x)


def chunked_sum(x: Array, y: Array, g: Array, skip: Array, mu: float) -> Array:
    """The sum in chunks of targets, for any array library and device."""
    xp = array_namespace(y)
    M, _, N = y.shape
    flat_y = xp.reshape(xp.permute_dims(y, (1, 0, 2)), (2, M * N))
    flat_g = xp.reshape(xp.permute_dims(g, (1, 0, 2)), (2, M * N))
    owner = xp.reshape(xp.arange(M, device=y.device)[:, None] + xp.zeros((M, N), dtype=xp.int64, device=y.device), (-1,))
    u = xp.empty_like(x)
    step = max(1, CHUNK // (M * N))
    for start in range(0, x.shape[0], step):
        part = slice(start, start + step)
        own = skip[part, None] == owner[None, :]
        u[part] = _sum(x[part, 0, None] - flat_y[0], x[part, 1, None] - flat_y[1], flat_g[0], flat_g[1], own, mu)
    return u


def own_sum_of_arrays(x: Array, y: Array, g: Array, curve: Array, mu: float) -> Array:
    """`own_sum` in chunks of targets, for any array library and device."""
    xp = array_namespace(y)
    u = xp.empty_like(x)
    step = max(1, CHUNK // y.shape[2])
    for start in range(0, x.shape[0], step):
        part = slice(start, start + step)
        none = (curve[part] < 0)[:, None]
        j = xp.where(none[:, 0], xp.zeros_like(curve[part]), curve[part])
        yj, gj = xp.take(y, j, axis=0), xp.take(g, j, axis=0)
        u[part] = _sum(x[part, 0, None] - yj[:, 0], x[part, 1, None] - yj[:, 1], gj[:, 0], gj[:, 1], none, mu)
    return u


def _sum(rx: Array, ry: Array, g0: Array, g1: Array, skip: Array, mu: float) -> Array:
    """Sum (P, 2) over the last axis of G(r) g but for the pairs to skip and those that coincide."""
    xp = array_namespace(rx)
    skip = skip | ((rx == 0.0) & (ry == 0.0))
    zero = xp.zeros_like(rx[0, 0])
    gxx, gxy, gyy = (xp.where(skip, zero, k) for k in stokeslet(rx, ry, mu))
    return xp.stack([xp.sum(gxx * g0 + gxy * g1, axis=-1), xp.sum(gxy * g0 + gyy * g1, axis=-1)], axis=-1)
