"""The seam between steppers and membrane physics: `MembraneMaps`, and its exact realisation by dense operators.

All maps are batched over M vesicles in the world frame. `ExactMaps` builds its operators on `points` nodes of the resampled curve
and reads velocities and tensions back on the N nodes it was given; 2 N removes the aliasing of P and T that dominates at small N.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from array_api_compat import array_namespace

from biem.backend import Array, count, solve
from biem.curves.curve import length, normal
from biem.curves.fourier import read_back, resample
from biem.membrane.operators import VesicleOperators
from biem.stokes.near import layer_values

LAYERS = (-1.0, -0.5, 0.0, 0.5, 1.0)  # offsets of the near layers along the outward normal, in arclength spacings
RESOLVED_FROM = 96  # nodes from which the operators are built at N itself


class MembraneMaps(Protocol):
    """What a split stepper knows of a vesicle's physics. X, u, f: (M, 2, N)."""

    def advect(self, X: Array, u: Array) -> Array:
        """(1 - M) u (M, 2, N)."""
        ...

    def relax(self, X: Array, dt: float) -> Array:
        """X_next (M, 2, N) with (X_next - X)/dt = (1 - M[X]) B[X] X_next."""
        ...

    def self_tension(self, X: Array) -> Array:
        """L^-1 P B X (M, N)."""
        ...

    def flow_tension(self, X: Array, u: Array) -> Array:
        """L^-1 P u (M, N)."""
        ...

    def near_layers(self, X: Array, f: Array) -> Array:
        """S[X, f] at X + offset h n for the offsets LAYERS, h = length/N (M, n_layers, 2, N)."""
        ...


def operator_points(N: int, points: int | None = None) -> int:
    """Nodes that the operators of an N-node curve are built at. Raises ValueError for points odd or below N."""
    if points is None:
        return N if N >= RESOLVED_FROM else 2 * N
    if points < N or points % 2:
        raise ValueError(f"operators are built at {points} points for curves of {N} nodes: points must be even and at least {N}")
    return points


@dataclass(frozen=True)
class ExactMaps:
    """`MembraneMaps` by boundary integrals. kappa_b, mu in the units of X; points: nodes of the operators (default 2 N below 96)."""

    kappa_b: float = 1.0
    mu: float = 1.0
    points: int | None = None

    def operators(self, X: Array) -> VesicleOperators:
        """The operators of the curves X (M, 2, N), on `points` nodes."""
        return VesicleOperators(resample(X, operator_points(X.shape[-1], self.points)), self.kappa_b, self.mu)

    def advect(self, X: Array, u: Array) -> Array:
        ops = self.operators(X)
        u = resample(u, ops.X.shape[-1])
        return read_back(project(ops, u), X.shape[-1])

    def relax(self, X: Array, dt: float) -> Array:
        xp = array_namespace(X)
        ops = self.operators(X)
        M, _, n = ops.X.shape
        increment, _ = relaxation_system(ops, xp.reshape(ops.bending_velocity(), (M, 2 * n, 1)), dt, False)
        # low-passed, not read back at the nodes: the stiff modes that N nodes cannot hold relax at once, whatever dt is, and would
        # alias into the shape at every step
        return X + resample(xp.reshape(increment, (M, 2, n)), X.shape[-1])

    def self_tension(self, X: Array) -> Array:
        ops = self.operators(X)
        return read_back(inextensible_tension(ops, ops.bending_velocity()), X.shape[-1])

    def flow_tension(self, X: Array, u: Array) -> Array:
        ops = self.operators(X)
        return read_back(inextensible_tension(ops, resample(u, ops.X.shape[-1])), X.shape[-1])

    def near_layers(self, X: Array, f: Array) -> Array:
        xp = array_namespace(X)
        M, _, N = X.shape
        h = (length(X) / N)[:, None, None]
        n = normal(X)
        layers = xp.stack([X + offset * h * n for offset in LAYERS], axis=1)  # (M, n_layers, 2, N)
        points = xp.reshape(xp.permute_dims(layers, (0, 1, 3, 2)), (M, len(LAYERS) * N, 2))
        u = layer_values(X, f, points, self.mu)
        return xp.permute_dims(xp.reshape(u, (M, len(LAYERS), N, 2)), (0, 1, 3, 2))


def inextensible_tension(ops: VesicleOperators, u: Array) -> Array:
    """L^-1 P u (M, n) for a velocity u (M, 2, n); the tension is minus this."""
    M, _, n = u.shape
    divergence = ops.divergence(array_namespace(u).reshape(u, (M, 2 * n, 1)))
    return solve(ops.L, divergence)[..., 0]


def project(ops: VesicleOperators, u: Array) -> Array:
    """(1 - M) u (M, 2, n)."""
    xp = array_namespace(u)
    return u - xp.reshape(xp.matmul(ops.T, inextensible_tension(ops, u)[..., None]), u.shape)


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
