"""Boundary operators of one vesicle each, batched over M, and its elastic force. X: (M, 2, n).

    f(X, sigma) = -kappa_b X_ssss + (sigma X_s)_s            B X = -kappa_b S[X_ssss]      T sigma = S[(sigma X_s)_s]
    P u = X_s . u_s        L = P T        M = T L^-1 P       (1 - M): projection onto velocities that keep the membrane's length

Paper, section 2.2. Every arclength derivative divides by the local speed. Matrices act on stacked [x; y] vectors.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

from biem.backend import Array, array_namespace, constant, count, solve
from biem.curves.curve import center_of_nodes, d_ds, dot, speed, tangent
from biem.curves.fourier import differentiation_matrix
from biem.stokes.quadrature import full_matrix, single_layer_blocks


def bending_force(X: Array, kappa_b: float = 1.0, frozen: Array | None = None) -> Array:
    """-kappa_b X_ssss (M, 2, n); arclength taken on `frozen` (default X itself), as the semi-implicit step needs it."""
    v = speed(X if frozen is None else frozen)
    f = X - center_of_nodes(X)
    for _ in range(4):
        f = d_ds(f, v)
    return -kappa_b * f


def tension_force(X: Array, sigma: Array) -> Array:
    """(sigma X_s)_s (M, 2, n) for a tension sigma (M, n)."""
    return d_ds(sigma[:, None, :] * tangent(X), speed(X))


def membrane_force(X: Array, sigma: Array, kappa_b: float = 1.0) -> Array:
    """Force density f of the membrane on the fluid (M, 2, n)."""
    return bending_force(X, kappa_b) + tension_force(X, sigma)


def surface_divergence(X: Array, u: Array) -> Array:
    """P u = X_s . u_s (M, n)."""
    return dot(tangent(X), d_ds(u, speed(X)))


@dataclass(frozen=True)
class VesicleOperators:
    """S, B, T, P, L, M of the curves X (M, 2, n) as dense matrices, each built when first asked for."""

    X: Array
    kappa_b: float = 1.0
    mu: float = 1.0
    alpert_order: int | None = None

    @cached_property
    def speed(self) -> Array:
        return speed(self.X)

    @cached_property
    def tangent(self) -> Array:
        return tangent(self.X)

    @cached_property
    def S_blocks(self) -> Array:
        """xx, xy, yy (M, 3, n, n) of the single layer, arclength weights included."""
        return single_layer_blocks(self.X, self.mu, self.alpert_order)

    @cached_property
    def D(self) -> Array:
        """d/ds (M, n, n)."""
        return constant(differentiation_matrix, self.X.shape[-1], like=self.X) / self.speed[..., None]

    @cached_property
    def D4(self) -> Array:
        """d^4/ds^4 (M, n, n)."""
        D2 = array_namespace(self.X).matmul(self.D, self.D)
        return array_namespace(self.X).matmul(D2, D2)

    @cached_property
    def B_blocks(self) -> Array:
        return -self.kappa_b * array_namespace(self.X).matmul(self.S_blocks, self.D4[:, None])

    @property
    def S(self) -> Array:
        """(M, 2n, 2n): force density -> velocity."""
        return full_matrix(self.S_blocks)

    @property
    def B(self) -> Array:
        """(M, 2n, 2n): position -> velocity due to bending."""
        return full_matrix(self.B_blocks)

    @cached_property
    def T(self) -> Array:
        """(M, 2n, n): tension -> velocity."""
        xp = array_namespace(self.X)
        SD = xp.matmul(self.S_blocks, self.D[:, None])
        x_s, y_s = self.tangent[:, 0, None, :], self.tangent[:, 1, None, :]
        return xp.concat([SD[:, 0] * x_s + SD[:, 1] * y_s, SD[:, 1] * x_s + SD[:, 2] * y_s], axis=-2)

    @cached_property
    def P(self) -> Array:
        """(M, n, 2n): velocity -> surface divergence."""
        xp = array_namespace(self.X)
        return xp.concat([self.tangent[:, 0, :, None] * self.D, self.tangent[:, 1, :, None] * self.D], axis=-1)

    @cached_property
    def L(self) -> Array:
        """(M, n, n): tension -> surface divergence of its velocity. Symmetric up to the quadrature; condition number about 0.75 n."""
        count("tension_matrix", self.X.shape[0])
        return self.divergence(self.T)

    @property
    def M(self) -> Array:
        """(M, 2n, 2n): velocity -> velocity of the tension that makes it inextensible, with the opposite sign."""
        xp = array_namespace(self.X)
        return xp.matmul(self.T, solve(self.L, self.P))

    def outer(self, u: Array) -> Array:
        """Velocity (M, 2n, c) that outer velocities u (M, 2n, c) give the membrane: they themselves, where the fluid is the same inside."""
        return u

    def divergence(self, u: Array) -> Array:
        """P u for columns u (M, 2n, c) -> (M, n, c)."""
        xp = array_namespace(self.X)
        n = self.X.shape[-1]
        x_s, y_s = self.tangent[:, 0, :, None], self.tangent[:, 1, :, None]
        return x_s * xp.matmul(self.D, u[:, :n]) + y_s * xp.matmul(self.D, u[:, n:])

    def bending_velocity(self) -> Array:
        """B X (M, 2, n) with X_ssss by FFT in the local frame."""
        xp = array_namespace(self.X)
        f = bending_force(self.X, self.kappa_b)
        S, fx, fy = self.S_blocks, f[:, 0, :, None], f[:, 1, :, None]
        u_x = xp.matmul(S[:, 0], fx) + xp.matmul(S[:, 1], fy)
        u_y = xp.matmul(S[:, 1], fx) + xp.matmul(S[:, 2], fy)
        return xp.stack([u_x[..., 0], u_y[..., 0]], axis=1)


def relaxation_system(ops: VesicleOperators, columns: Array, dt: float, tension: bool) -> tuple[Array, Array | None]:
    """Increments Z with (1 - dt (1 - M) B) Z = dt (1 - M) C, and tensions -L^-1 P (B Z + C), for velocities C (M, 2n, c).

    With C = B X + u, Z is the increment of the semi-implicit Euler step; solving for it and not for X keeps its digits.
    """
    xp = array_namespace(columns)
    m = columns.shape[-1]
    B = ops.B
    count("relaxation_matrix", columns.shape[0])
    solved = solve(ops.L, ops.divergence(xp.concat([columns, B], axis=-1)))  # L^-1 P [C, B]
    projected = xp.concat([columns, B], axis=-1) - xp.matmul(ops.T, solved)
    identity = xp.eye(B.shape[-1], dtype=B.dtype, device=B.device)
    Z = solve(identity - dt * projected[..., m:], dt * projected[..., :m])
    return Z, -(xp.matmul(solved[..., m:], Z) + solved[..., :m]) if tension else None
