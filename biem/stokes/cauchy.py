"""Double layer of one closed curve at any distance from it, to the accuracy of its nodes, through Cauchy integrals.

In complex notation (w on the curve, n its outward normal, tau the density, z the target), with C[f](z) = 1/(2 pi i) int f dw/(w - z),

    u = -1/2 C[tau] + conj( -1/2 C[conj(tau) + tau conj(n)/n] + 1/2 (conj(z) C[tau]' - C[conj(w) tau]') ).

Each C[f] is holomorphic on either side of the curve; its boundary values v_k at the nodes come from the singular integral with the
singularity subtracted (a fixed matrix), and its values and derivatives at targets from the barycentric quotients

    v(z) = sum_k v_k p_k / S,      v'(z) = sum_k (v_k - v(z))/(w_k - z) p_k / S,      p_k = w'_k/(w_k - z)
    S = sum_k p_k inside, sum_k p_k - i N outside:  1/(2 pi i) int (v(w) - v(z))/(w - z) dw  is 0 inside and -v(z) outside

(the second quotient likewise). Both are taken from the closest node on, so that no digits are lost next to it.
Helsing & Ojala, J. Comput. Phys. 227 (2008); Barnett, Wu & Veerapaneni, SIAM J. Sci. Comput. 37 (2015).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from math import pi

import numpy as np
from array_api_compat import device

from biem.backend import Array, array_namespace, compiled, from_numpy, on_cpu, to_numpy
from biem.curves.curve import dot
from biem.curves.fourier import derivative, differentiation_matrix
from biem.stokes.kernels import double_layer

NEAR = 8.0  # node spacings: beyond, the trapezoid rule errs by exp(-2 pi NEAR), more on the hollow side of a bend
CHUNK = 1 << 20  # pairs of one temporary
LOOPS = "biem.stokes.cauchy_loop"


@dataclass(frozen=True)
class Curve:
    """One closed counterclockwise curve X (2, N), seen by targets inside or outside of it."""

    X: np.ndarray
    inside: bool

    @cached_property
    def center(self) -> np.ndarray:
        """Origin of the complex plane (2, 1)."""
        return self.X.mean(axis=-1, keepdims=True)

    @cached_property
    def X_alpha(self) -> np.ndarray:
        return derivative(self.X - self.center)

    @cached_property
    def speed(self) -> np.ndarray:
        return np.hypot(*self.X_alpha)

    @cached_property
    def ds(self) -> np.ndarray:
        """Arclength weights (N,)."""
        return self.speed * (2.0 * pi / self.X.shape[-1])

    @cached_property
    def normal(self) -> np.ndarray:
        """Outward (2, N)."""
        return np.stack([self.X_alpha[1], -self.X_alpha[0]]) / self.speed

    @cached_property
    def curvature(self) -> np.ndarray:
        x_aa, y_aa = derivative(self.X_alpha)
        return (self.X_alpha[0] * y_aa - self.X_alpha[1] * x_aa) / self.speed**3

    @cached_property
    def w(self) -> np.ndarray:
        """Nodes about the centre, complex (N,)."""
        return _complex(self.X - self.center)

    @cached_property
    def boundary_values(self) -> np.ndarray:
        """(N, N): f -> the limit of C[f] at the nodes from the targets' side."""
        N = len(self.w)
        w_alpha = _complex(self.X_alpha)
        r = self.w[None, :] - self.w[:, None]
        np.fill_diagonal(r, 1.0)
        quotient = w_alpha[None, :] / r
        np.fill_diagonal(quotient, 0.0)
        rows = (quotient - np.diag(quotient.sum(axis=1)) + differentiation_matrix(N)) / (1j * N)
        return rows + np.eye(N) if self.inside else rows

    def holomorphic(self, tau: np.ndarray) -> np.ndarray:
        """Boundary values (3, N) of the Cauchy integrals of tau, conj(tau) + tau conj(n)/n and conj(w) tau, for tau (2, N)."""
        t, n = _complex(tau), _complex(self.normal)
        densities = np.stack([t, t.conj() + t * n.conj() / n, self.w.conj() * t], axis=1)
        return np.ascontiguousarray((self.boundary_values @ densities).T)

    def velocity(self, points: Array, tau: np.ndarray) -> Array:
        """D[tau] (P, 2) at points (P, 2) on the curve's side of the targets. tau: (2, N)."""
        reach = (NEAR * self.ds) ** 2
        arrays = [self.X - self.center, self.normal, self.ds * tau, self.w, _complex(self.X_alpha), self.holomorphic(tau), reach]
        x = points - from_numpy(self.center[:, 0], like=points)
        if on_cpu(points):
            loop = compiled(LOOPS).velocity
            return from_numpy(loop(np.ascontiguousarray(to_numpy(x)), *arrays, self.inside), like=points)
        return velocity_of_arrays(x, [from_numpy(f, like=points) for f in arrays], self.inside)


def velocity_of_arrays(x: Array, arrays: Sequence[Array], inside: bool) -> Array:
    """D (P, 2) at x (P, 2) in chunks of targets, for any array library and device; `cauchy_loop.velocity` is the same compiled.

    arrays: nodes Y, normal, g = tau ds, each (2, N); w, w_alpha (N,); boundary values v (3, N); reach (N,), the squared distance below
    which v is used.
    """
    Y, normal, g, w, w_alpha, v, reach = arrays
    xp = array_namespace(x)
    u = xp.empty_like(x)
    step = max(1, CHUNK // Y.shape[-1])
    for start in range(0, x.shape[0], step):
        part = slice(start, start + step)
        r = x[part, :, None] - Y
        D_xx, D_xy, D_yy = double_layer(r[:, 0], r[:, 1], normal[0], normal[1])
        far = xp.stack([xp.sum(D_xx * g[0] + D_xy * g[1], axis=-1), xp.sum(D_xy * g[0] + D_yy * g[1], axis=-1)], axis=-1)
        near = xp.any(dot(r, r) < reach, axis=-1)
        if bool(xp.any(near)):
            closest = xp.argmin(dot(r, r)[near], axis=-1)
            outside = xp.full(closest.shape, not inside, dtype=xp.bool, device=device(x))
            far[near] = close_velocity(x[part][near], closest, outside, w[None], w_alpha[None], v[None])
        u[part] = far
    return u


def outer_values(w: Array, w_alpha: Array, f: Array) -> Array:
    """Limits (V, 3, N) at the nodes, from outside, of C[f] for densities f (V, 3, N) on curves w (V, N); from inside f is to be added.

    The same as `Curve.boundary_values` without the matrices; in float64.
    """
    xp = array_namespace(w)
    f_alpha = derivative(xp.real(f)) + 1j * derivative(xp.imag(f))
    if on_cpu(w):
        arrays = (np.ascontiguousarray(to_numpy(a)) for a in (w, w_alpha, f, f_alpha))
        return _like(compiled(LOOPS).outer_values(*arrays), w)
    V, N = w.shape
    diagonal = xp.eye(N, dtype=xp.bool, device=device(w))
    parts = []
    step = max(1, CHUNK // N**2)
    for start in range(0, V, step):
        part = slice(start, start + step)
        r = w[part, None, :] - w[part, :, None]
        quotient = xp.where(diagonal, xp.zeros_like(r), w_alpha[part, None, :] / xp.where(diagonal, xp.ones_like(r), r))
        sums = xp.matmul(f[part], xp.permute_dims(quotient, (0, 2, 1))) - f[part] * xp.sum(quotient, axis=-1)[:, None, :]
        parts.append((sums + f_alpha[part]) / (1j * N))
    return xp.concat(parts, axis=0)


def close_velocities(x: Array, closest: Array, outside: Array, curve: Array, w: Array, w_alpha: Array, v: Array) -> Array:
    """D (Q, 2) at x (Q, 2) beside the nodes `closest` (Q,) of curve[q] among V, each about its centre. w, w_alpha: (V, N), v: (V, 3, N)."""
    xp = array_namespace(x)
    if on_cpu(x):
        arrays = (np.ascontiguousarray(to_numpy(a)) for a in (x, closest, outside, curve, w, w_alpha, v))
        return from_numpy(compiled(LOOPS).close_velocity(*arrays), like=x)
    u = xp.empty_like(x)
    step = max(1, CHUNK // w.shape[-1])
    for start in range(0, x.shape[0], step):
        part = slice(start, start + step)
        j = curve[part]
        u[part] = close_velocity(x[part], closest[part], outside[part], w[j], w_alpha[j], v[j])
    return u


def close_velocity(x: Array, closest: Array, outside: Array, w: Array, w_alpha: Array, v: Array) -> Array:
    """D (Q, 2) at x (Q, 2) beside the nodes `closest` (Q,) of their curves, by the quotients; `cauchy_loop.close_velocity` compiled.

    w, w_alpha: (Q, N), v: (Q, 3, N), or of one curve for all (1, ...); outside (Q,): on which side the targets are.
    """
    xp = array_namespace(x)
    N = w.shape[-1]
    z = xp.asarray(x[:, 0] + 1j * x[:, 1], device=device(x))
    at_closest = xp.arange(N, device=device(x))[None, :] == closest[:, None]  # (Q, N)
    r = w - z[:, None]
    p = w_alpha / r
    lift = 1j * N * xp.astype(outside, x.dtype)
    S = xp.sum(p, axis=-1) - lift
    start = xp.sum(xp.where(at_closest[:, None, :], v, xp.zeros_like(v[0, 0, 0])), axis=-1)  # (Q, 3)
    change = (xp.sum((v - start[:, :, None]) * p[:, None, :], axis=-1) + lift[:, None] * start) / S[:, None]
    v_z = start + change
    from_z = xp.where(at_closest[:, None, :], -change[:, :, None], v - v_z[:, :, None])
    of_z = xp.conj(z)[:, None] * from_z[:, 0] - from_z[:, 2]
    slope = xp.sum(of_z * p / r, axis=-1) / S
    u = -0.5 * v_z[:, 0] + xp.conj(0.5 * slope - 0.5 * v_z[:, 1])
    return xp.stack([xp.real(u), xp.imag(u)], axis=-1)


def _like(a: np.ndarray, like: Array) -> Array:
    """Complex values as an array of the library of `like`, on the CPU."""
    return a if isinstance(like, np.ndarray) else array_namespace(like).asarray(a)


def _complex(f: np.ndarray) -> np.ndarray:
    return f[0] + 1j * f[1]
