"""Membranes around a fluid of another viscosity: lambda = mu_in/mu_out of each vesicle, mu = mu_out. X: (M, 2, n).

The velocity u on membrane i, for its elastic force f and the outer velocity v, that of everything else (mu, everywhere):

    A u = S f + v,     A = (1 + lambda)/2 - (1 - lambda) D,     D: the principal value of the double layer (`stokes.double_layers`)

    outside   v + S f + (1 - lambda) D u        inside   (v + S f + (1 - lambda) D u) / lambda

so that S becomes A^-1 S and v becomes A^-1 v in all that `operators` builds. A is the identity on rigid motions and at lambda = 1; its
eigenvalues lie between 1 and lambda. Pozrikidis (1992), 5.2; Rahimian, Veerapaneni & Biros, J. Comput. Phys. 229 (2010).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from biem.backend import Array, Latest, array_namespace, constant, count, from_numpy, parallel_map, shares, solve
from biem.curves.fourier import resample, resampling_matrix
from biem.membrane.maps import ExactMaps, operator_points
from biem.membrane.operators import VesicleOperators, bending_force, relaxation_system
from biem.stokes.double_layers import own_matrix
from biem.stokes.quadrature import full_matrix

CHUNK_VALUES = 1 << 16  # entries of one (2n, 2n) matrix over the vesicles of a chunk: to fit the cache


@dataclass(frozen=True)
class ContrastOperators(VesicleOperators):
    """`VesicleOperators` with A^-1 S in place of S. contrast: lambda (M,)."""

    contrast: Array = None

    @cached_property
    def A_inverse(self) -> Array:
        """(M, 2n, 2n): outer velocity -> velocity of the membrane."""
        xp = array_namespace(self.X)
        count("contrast_matrix", self.X.shape[0])
        lambda_ = self.contrast[:, None, None]
        identity = xp.eye(2 * self.X.shape[-1], dtype=self.X.dtype, device=self.X.device)
        A = 0.5 * (1.0 + lambda_) * identity - (1.0 - lambda_) * own_matrix(self.X)
        return solve(A, xp.broadcast_to(identity, A.shape))

    @cached_property
    def S(self) -> Array:
        return array_namespace(self.X).matmul(self.A_inverse, full_matrix(self.S_blocks))

    @cached_property
    def B(self) -> Array:
        return -self.kappa_b * self._after(self.D4)

    @cached_property
    def T(self) -> Array:
        n = self.X.shape[-1]
        x_s, y_s = self.tangent[:, 0, None, :], self.tangent[:, 1, None, :]
        SD = self._after(self.D)
        return SD[..., :n] * x_s + SD[..., n:] * y_s

    def bending_velocity(self) -> Array:
        xp = array_namespace(self.X)
        f = bending_force(self.X, self.kappa_b)
        return xp.reshape(xp.matmul(self.S, xp.reshape(f, (f.shape[0], -1, 1))), f.shape)

    def outer(self, u: Array) -> Array:
        return array_namespace(self.X).matmul(self.A_inverse, u)

    def _after(self, a: Array) -> Array:
        """S after a (M, n, n) on either component (M, 2n, 2n)."""
        return by_component(self.S, a)


def vesicle_operators(X: Array, kappa_b: float, mu: float, contrast: np.ndarray | None) -> VesicleOperators:
    """The operators of curves X (M, 2, n); contrast: lambda (M,), or None where it is 1."""
    return VesicleOperators(X, kappa_b, mu) if contrast is None else ContrastOperators(X, kappa_b, mu, None, from_numpy(contrast, like=X))


def by_component(A: Array, a: Array) -> Array:
    """A (M, ., 2n) after a (n, c), or one of each (M, n, c), on either component: (M, ., 2c)."""
    xp = array_namespace(A)
    n = A.shape[-1] // 2
    return xp.concat([xp.matmul(A[..., :n], a), xp.matmul(A[..., n:], a)], axis=-1)


@dataclass(frozen=True)
class _Responses:
    """What the maps of one geometry are made of, between the N nodes: matrices (M, ., 2N), and tensions (M, N)."""

    self_tension: Array
    flow_tension: Array  # (M, N, 2N)
    advection: Array  # (M, 2N, 2N), as the next two
    outer: Array  # A^-1
    single: Array  # A^-1 S


@dataclass(frozen=True)
class ContrastMaps(ExactMaps):
    """`MembraneMaps` of vesicles with contrasts lambda (M,), by dense operators in float64; u is the outer velocity.

    Some ten times the work of `ExactMaps`. The curves that a map is given are always these M ones.
    """

    contrast: np.ndarray = field(default_factory=lambda: np.ones(0))
    _of_curve: Latest = field(default_factory=Latest, init=False, repr=False, compare=False)

    def advect(self, X: Array, u: Array) -> Array:
        return _apply(self._responses(X).advection, u)

    def relax(self, X: Array, dt: float) -> Array:
        xp = array_namespace(X)

        def increment(ops: ContrastOperators) -> Array:
            columns = xp.reshape(ops.bending_velocity(), (ops.X.shape[0], -1, 1))
            return xp.reshape(relaxation_system(ops, columns, dt, False)[0], ops.X.shape)

        return X + resample(xp.concat(self._by_chunk(X, increment), axis=0), X.shape[-1])

    def self_tension(self, X: Array) -> Array:
        return self._responses(X).self_tension

    def flow_tension(self, X: Array, u: Array) -> Array:
        xp = array_namespace(X)
        return xp.matmul(self._responses(X).flow_tension, xp.reshape(u, (u.shape[0], -1, 1)))[..., 0]

    def velocity(self, X: Array, f: Array, u: Array) -> Array:
        """A^-1 (S f + u): of the membranes, for their own force densities f and outer velocities u (M, 2, N)."""
        responses = self._responses(X)
        return _apply(responses.single, f) + _apply(responses.outer, u)

    def _responses(self, X: Array) -> _Responses:
        def build() -> _Responses:
            parts = self._by_chunk(X, lambda ops: _responses_of(ops, X.shape[-1]))
            concat = array_namespace(X).concat
            return _Responses(*(concat([getattr(part, name) for part in parts], axis=0) for name in _Responses.__dataclass_fields__))

        return self._of_curve.of(X, build)

    def _by_chunk(self, X: Array, function: Callable[[ContrastOperators], Any]) -> list[Any]:
        """function(operators) of chunks of vesicles."""
        n = operator_points(X.shape[-1], self.points)
        contrast = from_numpy(self.contrast, like=X)
        most = max(1, CHUNK_VALUES // (2 * n) ** 2)
        operators = lambda which: ContrastOperators(resample(X[which], n), self.kappa_b, self.mu, None, contrast[which])
        return parallel_map(lambda which: function(operators(which)), shares(0, X.shape[0], 1, most))


def _responses_of(ops: ContrastOperators, N: int) -> _Responses:
    xp = array_namespace(ops.X)
    m, _, n = ops.X.shape
    E, R = constant(resampling_matrix, n, N, like=ops.X), constant(resampling_matrix, N, n, like=ops.X)
    low_passed = lambda a: xp.reshape(xp.matmul(R, xp.reshape(a, (m, 2, n, -1))), (m, 2 * N, -1))
    outer = by_component(ops.A_inverse, E)
    bending = xp.reshape(ops.bending_velocity(), (m, 2 * n, 1))
    solved = solve(ops.L, ops.divergence(xp.concat([bending, outer], axis=-1)))  # L^-1 P [B X, A^-1 E]
    tension = xp.matmul(R, solved)
    advection = low_passed(outer - xp.matmul(ops.T, solved[..., 1:]))
    return _Responses(tension[..., 0], tension[..., 1:], advection, low_passed(outer), low_passed(by_component(ops.S, E)))


def _apply(matrix: Array, u: Array) -> Array:
    xp = array_namespace(u)
    return xp.reshape(xp.matmul(matrix, xp.reshape(u, (u.shape[0], -1, 1))), u.shape)
