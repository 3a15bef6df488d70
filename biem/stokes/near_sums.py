"""[Accurate - N-node trapezoid] single layer at near targets by direct summation: what `near_correction` says, without its rows.

    u(x_q) += sum_k G(x_q - Y_k) (f_up,k ds_up,k - [k = level j] f_j ds_j),      Y: the curve on n = level N nodes

The N nodes are every level-th of the n, so one sum gives both rules. Only curves with pairs at a level are upsampled to it; pairs closer
than the last level have graded rows. X, f: (M, 2, N), targets: (P, 2). NumPy arrays and tensors in the CPU's memory are summed in
compiled loops (near_loop), other arrays in array code where they are.
"""

from __future__ import annotations

from dataclasses import dataclass

from biem.backend import Array, array_namespace, count, from_numpy, on_cpu, scatter_add, to_numpy
from biem.curves.curve import arclength_weights, center_of_nodes
from biem.curves.fourier import resample
from biem.stokes.farfield_direct import own_sum, own_sum_of_arrays
from biem.stokes.near import LEVELS, apply_rows, near_correction, upsampling
from biem.stokes.near_search import NearPairs, float64


@dataclass(frozen=True)
class NearSums:
    """Correction of the velocity (P, 2) at near targets, for several forces on one geometry; nothing of size Q x N but the close rows."""

    mu: float
    levels: tuple[Level, ...]
    close: NearPairs | None  # pairs beyond the last level
    rows: Array | None
    use_loops: bool

    @classmethod
    def build(cls, X: Array, targets: Array, pairs: NearPairs, mu: float, tolerance: float) -> NearSums:
        """tolerance: aimed-at error over max |S|; pairs: those of `find_near` at the width that belongs to it."""
        if on_cpu(X):
            return cls._build(float64(to_numpy(X)), float64(to_numpy(targets)), pairs.to_numpy(), mu, tolerance, True)
        return cls._build(X, targets, pairs, mu, tolerance, False)

    @classmethod
    def _build(cls, X: Array, targets: Array, pairs: NearPairs, mu: float, tolerance: float, use_loops: bool) -> NearSums:
        count("near_sums", len(pairs))
        xp = array_namespace(X)
        level = upsampling(pairs.rho, X.shape[-1], tolerance)
        levels = [Level.build(X, targets, pairs.subset(level == n), n) for n in LEVELS if xp.any(level == n)]
        if not xp.any(level == 0):
            return cls(mu, tuple(levels), None, None, use_loops)
        close = pairs.subset(level == 0).to_numpy()
        rows = near_correction(float64(X), float64(targets), close, mu, "upsample", tolerance)
        return cls(mu, tuple(levels), close, xp.astype(rows, X.dtype, copy=False), use_loops)

    def add(self, u: Array, f: Array) -> Array:
        """u (P, 2) with the correction for force densities f (M, 2, N) added."""
        if not self.use_loops:
            return self._add(u, f)
        f = float64(to_numpy(f))
        return from_numpy(self._add(to_numpy(u), f), like=u)

    def _add(self, u: Array, f: Array) -> Array:
        for level in self.levels:
            u = scatter_add(u, level.target, level.velocity(f, self.mu, self.use_loops))
        return u if self.close is None else apply_rows(u, self.rows, self.close, f)


@dataclass(frozen=True)
class Level:
    """Q pairs that one upsampling factor resolves, and the V curves that they meet on n = factor N nodes."""

    factor: int
    target: Array  # (Q,)
    x: Array  # targets from the centres of their curves (Q, 2)
    slot: Array  # the pair's curve among the V (Q,)
    vesicle: Array  # (V,)
    Y: Array  # from the curves' centres (V, 2, n)
    ds_up: Array  # (V, 1, n)
    ds: Array  # (V, 1, N)

    @classmethod
    def build(cls, X: Array, targets: Array, pairs: NearPairs, factor: int) -> Level:
        xp = array_namespace(X)
        N, dtype = X.shape[-1], X.dtype
        vesicle, slot = xp.unique_inverse(pairs.vesicle)
        curves = float64(X[vesicle])
        center = center_of_nodes(curves)
        x = float64(targets[pairs.target]) - center[slot][..., 0]
        Y = resample(curves - center, factor * N)
        ds_up, ds = arclength_weights(Y)[:, None, :], arclength_weights(curves)[:, None, :]
        x, Y, ds_up, ds = (xp.astype(a, dtype, copy=False) for a in (x, Y, ds_up, ds))
        return cls(factor, pairs.target, x, slot, vesicle, Y, ds_up, ds)

    def velocity(self, f: Array, mu: float, use_loops: bool) -> Array:
        """Of [accurate - trapezoid], (Q, 2)."""
        f = f[self.vesicle]
        g = resample(f, self.Y.shape[-1]) * self.ds_up
        g[..., :: self.factor] -= f * self.ds
        own = own_sum if use_loops else own_sum_of_arrays
        return own(self.x, self.Y, g, self.slot, mu)
