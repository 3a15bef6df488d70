"""Double layers of closed curves: D[X, q](x) = int D(x - y) q(y) ds at any points, and on the curve itself as a matrix. X, q: (M, 2, N).

far       the trapezoid rule on the N nodes, summed directly: P M N pairs, a third of what Stokeslets cost; always in float64, for next to a
          curve the kernel grows like 1/distance, and what is subtracted there must be what was added
near      in place of it, Cauchy integrals on 2 N nodes (`cauchy`), to the accuracy of these nodes at any distance
on it     the kernel is smooth: D_ii = -kappa/(2 pi) t t^T ds, half the jump apart, and the trapezoid rule is spectrally accurate

Constant density q: -q inside, -q/2 on and 0 outside the curve. Compiled loops on the CPU (double_layer_loop), array code elsewhere.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import pi

import numpy as np

from biem.backend import Array, array_namespace, compiled, count, from_numpy, on_cpu, scatter_add, to_numpy
from biem.curves.curve import arclength_weights, center_of_nodes, curvature, dot, normal, tangent
from biem.curves.fourier import derivative, resample
from biem.stokes import cauchy
from biem.stokes.kernels import double_layer as kernel
from biem.stokes.near import near_width
from biem.stokes.near_search import NearPairs, find_near, float64

REFINEMENT = 2  # nodes of the Cauchy integrals per node of the curve: products with the normal have twice the modes
CHUNK = 1 << 20  # pairs of one temporary
LOOPS = "biem.stokes.double_layer_loop"


def double_layer(X: Array, q: Array, targets: Array, tolerance: float = 1e-6, exclude: Array | None = None) -> Array:
    """u(x) = sum over curves of D[X, q](x) at targets (P, 2), near, far, inside or outside -> (P, 2).

    X, q: (M, 2, N), counterclockwise curves and densities. tolerance: from which distance on the trapezoid rule is good enough.
    exclude (P,): a curve that a target skips (-1: none). Raises ValueError for shapes that do not fit.
    """
    if X.ndim != 3 or X.shape[1] != 2 or q.shape != X.shape or targets.ndim != 2 or targets.shape[1] != 2:
        raise ValueError(
            f"double_layer got X {tuple(X.shape)}, q {tuple(q.shape)}, targets {tuple(targets.shape)}: "
            "expected X and q (M, 2, N), targets (P, 2)"
        )
    pairs = find_near(X, targets, near_width("upsample", tolerance), exclude)
    return DoubleLayers.build(X, targets, pairs, exclude).velocity(q)


def own_matrix(X: Array) -> Array:
    """D on the curve itself, its principal value, as a matrix (M, 2N, 2N) on stacked [x; y], arclength weights included."""
    xp = array_namespace(X)
    M, _, n = X.shape
    count("double_layer_matrix", M)
    r = X[:, :, :, None] - X[:, :, None, :]
    coincide = xp.eye(n, dtype=X.dtype, device=X.device)
    outward = normal(X)[:, :, None, :]
    D = kernel(r[:, 0] + coincide, r[:, 1], outward[:, 0], outward[:, 1])
    t = tangent(X)
    bend = -curvature(X) / (2.0 * pi)
    limits = (bend * t[:, 0] ** 2, bend * t[:, 0] * t[:, 1], bend * t[:, 1] ** 2)
    ds = arclength_weights(X)[:, None, :]
    xx, xy, yy = (ds * (d * (1.0 - coincide) + limit[:, None, :] * coincide) for d, limit in zip(D, limits, strict=True))
    return xp.concat([xp.concat([xx, xy], axis=-1), xp.concat([xy, yy], axis=-1)], axis=-2)


@dataclass(frozen=True)
class DoubleLayers:
    """D of the curves y (M, 2, N) at fixed targets x (P, 2), both about a common origin, for several densities."""

    x: Array
    y: Array
    normal: Array  # (M, 2, N)
    ds: Array  # (M, 1, N)
    skip: Array  # (P,)
    near: NearDoubleLayers | None

    @classmethod
    def build(cls, X: Array, targets: Array, pairs: NearPairs, exclude: Array | None = None) -> DoubleLayers:
        """pairs: those of `find_near` for X and the targets; beyond them the trapezoid rule has to do. exclude as in `double_layer`."""
        xp = array_namespace(X)
        count("double_layers")
        X, targets = float64(X), float64(targets)
        origin = xp.mean(X, axis=(0, 2))
        skip = xp.full((targets.shape[0],), -1, dtype=xp.int64, device=X.device) if exclude is None else exclude
        near = NearDoubleLayers.build(X, targets, pairs) if len(pairs) else None
        return cls(targets - origin, X - origin[None, :, None], normal(X), arclength_weights(X)[:, None, :], skip, near)

    def velocity(self, q: Array) -> Array:
        """(P, 2) for densities q (M, 2, N), in their dtype."""
        count("double_layer_sum")
        xp = array_namespace(q)
        density = float64(q)
        u = far_sum(self.x, self.y, self.normal, density * self.ds, self.skip)
        if self.near is not None:
            u = scatter_add(u, self.near.target, self.near.velocity(density))
        return xp.astype(u, q.dtype, copy=False)


@dataclass(frozen=True)
class NearDoubleLayers:
    """[accurate - trapezoid rule] of Q pairs, and the V curves that they meet, about their centres; w, w_alpha: on n = 2 N nodes."""

    target: Array  # (Q,)
    x: Array  # (Q, 2)
    slot: Array  # the pair's curve among the V (Q,)
    closest: Array  # its node closest to the target (Q,)
    outside: Array  # (Q,)
    vesicle: Array  # (V,)
    y: Array  # (V, 2, N)
    normal: Array
    ds: Array  # (V, 1, N)
    w: Array  # complex (V, n)
    w_alpha: Array
    turn: Array  # conj(n)/n (V, n)

    @classmethod
    def build(cls, X: Array, targets: Array, pairs: NearPairs) -> NearDoubleLayers:
        xp = array_namespace(X)
        count("near_double_layers", len(pairs))
        as_here = lambda a: from_numpy(a, like=X) if isinstance(a, np.ndarray) else a
        target, of, alpha, distance = (as_here(a) for a in (pairs.target, pairs.vesicle, pairs.alpha, pairs.distance))
        vesicle, slot = xp.unique_inverse(of)
        curves = X[vesicle]
        center = center_of_nodes(curves)
        n = REFINEMENT * X.shape[-1]
        fine = resample(curves - center, n)
        outward = _complex(normal(fine))
        closest = xp.astype(xp.round(alpha * (n / (2.0 * pi))), xp.int64) % n
        return cls(
            target,
            targets[target] - center[slot][..., 0],
            slot,
            closest,
            distance >= 0.0,
            vesicle,
            curves - center,
            normal(curves),
            arclength_weights(curves)[:, None, :],
            _complex(fine),
            _complex(derivative(fine)),
            xp.conj(outward) / outward,
        )

    def velocity(self, q: Array) -> Array:
        """(Q, 2) for densities q (M, 2, N)."""
        xp = array_namespace(q)
        q = q[self.vesicle]
        tau = _complex(resample(q, self.w.shape[-1]))
        densities = xp.stack([tau, xp.conj(tau) + tau * self.turn, xp.conj(self.w) * tau], axis=1)  # (V, 3, n)
        v = cauchy.outer_values(self.w, self.w_alpha, densities)
        w, w_alpha, slot = self.w, self.w_alpha, self.slot
        if not bool(xp.all(self.outside)):  # each curve once more, as it is seen from inside
            w, w_alpha, v = xp.concat([w, w]), xp.concat([w_alpha, w_alpha]), xp.concat([v, v + densities])
            slot = xp.where(self.outside, slot, slot + self.w.shape[0])
        accurate = cauchy.close_velocities(self.x, self.closest, self.outside, slot, w, w_alpha, v)
        return accurate - own_sum(self.x, self.y, self.normal, q * self.ds, self.slot)


def far_sum(x: Array, y: Array, outward: Array, g: Array, skip: Array) -> Array:
    """D (P, 2) at x (P, 2) by the trapezoid rule, for weighted densities g = q ds at y (M, 2, N); target p skips curve skip[p]."""
    xp = array_namespace(y)
    if on_cpu(y):
        return _by_loop("sum_all", x, y, outward, g, skip)
    M, _, N = y.shape
    flat = lambda a: xp.reshape(xp.permute_dims(a, (1, 0, 2)), (2, M * N))
    y, outward, g = flat(y), flat(outward), flat(g)
    owner = xp.arange(M * N, dtype=skip.dtype, device=y.device) // N
    u = xp.empty_like(x)
    step = max(1, CHUNK // (M * N))
    for start in range(0, x.shape[0], step):
        part = slice(start, start + step)
        r = x[part, :, None] - y[None]
        u[part] = _sum(r, outward[None], xp.where((skip[part, None] == owner)[:, None, :], xp.zeros_like(g[0, 0]), g[None]))
    return u


def own_sum(x: Array, y: Array, outward: Array, g: Array, curve: Array) -> Array:
    """The same of curve curve[p] alone (P, 2)."""
    if on_cpu(y):
        return _by_loop("sum_own", x, y, outward, g, curve)
    xp = array_namespace(y)
    u = xp.empty_like(x)
    step = max(1, CHUNK // y.shape[2])
    for start in range(0, x.shape[0], step):
        part = slice(start, start + step)
        j = curve[part]
        u[part] = _sum(x[part, :, None] - y[j], outward[j], g[j])
    return u


def _sum(r: Array, outward: Array, g: Array) -> Array:
    """Sum (P, 2) over the last axis of D(r) g, for r, normals, g that broadcast to (P, 2, K); 0 from points that coincide."""
    xp = array_namespace(r)
    r2 = dot(r, r)
    scale = dot(r, outward) * dot(r, g) / xp.where(r2 == 0.0, xp.ones_like(r2), pi * r2 * r2)
    return xp.sum(scale[:, None, :] * r, axis=-1)


def _by_loop(name: str, *arrays: Array) -> Array:
    *fields, curve = arrays
    values = [np.ascontiguousarray(to_numpy(a)) for a in fields]
    return from_numpy(getattr(compiled(LOOPS), name)(*values, to_numpy(curve)), like=fields[0])


def _complex(f: Array) -> Array:
    return f[:, 0] + 1j * f[:, 1]


__all__ = ["DoubleLayers", "double_layer", "own_matrix"]
