"""Fully coupled semi-implicit Euler step: bending, tension and vesicle-vesicle interaction implicit, operators frozen at X^n.

    (X_i - X_i^n)/dt = (1 - M_i)(B_i X_i + u_i),   sigma_i = -L_i^-1 P_i (B_i X_i + u_i),   u_i = u_inf + sum_{j != i} S_j[f(X_j, sigma_j)]

With the coupling velocity u_i given, vesicle i is solved exactly by its own dense block; f_i is then affine in u_i. What is left is

    u - O F u = u_inf + O f_0,      O: single layers between vesicles,  F: block-diagonal response of the force

which is the coupled system right-preconditioned by its exact diagonal blocks, with the velocity as the unknown. GMRES starts from the
velocity of the present forces, so a step depends on (X^n, sigma^n) alone. Paper, eq. (time_step_sc1); Quaife & Biros (2014).

Where viscosities differ (`membrane.contrast`), u_i is the outer velocity: the blocks see A_i^-1 u_i, and the other vesicles' double
layers, of the velocities (X_j - X_j^n)/dt with which they answer, are part of O F.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.sparse.linalg import LinearOperator, gmres

from biem.backend import Array, array_namespace, constant, count, from_numpy, one_blas_thread, parallel_map, stage, to_numpy
from biem.curves.curve import speed
from biem.curves.fourier import resample, resampling_matrix
from biem.curves.lattice import Box
from biem.errors import NumericalFailure
from biem.membrane.contrast import vesicle_operators
from biem.membrane.maps import operator_points
from biem.membrane.operators import VesicleOperators, bending_force, membrane_force, relaxation_system
from biem.membrane.repulsion import Repulsion, work_of
from biem.steppers.stepper import Flow, State, StepResult
from biem.stokes.interaction import DEFAULT_FIELDS, Fields, Interaction
from biem.stokes.kress import on_own_curve
from biem.stokes.near_search import minimum_gap
from biem.stokes.walls import Walls

CHUNK_VALUES = 1 << 16  # matrix entries per operator of one chunk of vesicles: they stay in the cache


@dataclass(frozen=True)
class ImplicitStepper:
    """Parameters of the step. flow: background velocity, or None in a fluid at rest.

    points: nodes of the operators (default 2 N below N = 96); tolerance: GMRES, relative; tension: keep sigma also where no other vesicle
    needs it. The repulsion is taken at X^n, as a background velocity. Walls are part of the coupling: O includes their answer to a force,
    by their factorised equations, so that no flow passes them at any iteration. contrast (M,): of the vesicles' viscosities to mu, or
    None where all are 1. box: a periodic one; then O includes all images, where they are at t^n.
    """

    kappa_b: float
    mu: float
    flow: Flow | None = None
    points: int | None = None
    tolerance: float = 1e-10
    max_iterations: int = 200
    fields: Fields = DEFAULT_FIELDS
    repulsion: Repulsion | None = None
    tension: bool = False
    walls: Walls | None = None
    contrast: np.ndarray | None = None
    box: Box | None = None

    def step(self, state: State, dt: float) -> StepResult:
        """The state at t + dt. Raises NumericalFailure if GMRES does not reach the tolerance."""
        with one_blas_thread():
            alone = state.X.shape[0] == 1 and self.walls is None and self.box is None
            return self._step_alone(state, dt) if alone else self._step_coupled(state, dt)

    def _step_coupled(self, state: State, dt: float) -> StepResult:
        X = state.X
        u_inf = 0.0 * X if self.flow is None else self.flow(X, state.t)
        with stage("response"):
            response = self._response(X, dt)
        lattice = None if self.box is None else self.box.at(state.t)
        coupling = Interaction.build(X, self.mu, self.fields, slice(None), True, self.walls, self.contrast, lattice)
        repulsive = None if self.repulsion is None else self.repulsion.force(X, lattice)
        if repulsive is not None:
            u_inf = u_inf + on_own_curve(X, repulsive, self.mu) + coupling.velocity(repulsive, 0.0 * X)

        velocity_0 = None if self.contrast is None else response.increment_0 / dt
        velocity_of = lambda v: None if self.contrast is None else response.moved(v) / dt
        rhs = u_inf + coupling.velocity(response.force_0, velocity_0)
        guess = rhs if state.sigma is None else u_inf + coupling.velocity(membrane_force(X, state.sigma, self.kappa_b), velocity_0)
        u, iterations = self._gmres(lambda v: v - coupling.velocity(response.force(v), velocity_of(v)), rhs, guess, X)
        increment = response.increment(u)
        diagnostics = {"gmres_iterations": iterations, **work_of(repulsive, X, increment)}
        return StepResult(State(state.t + dt, X + increment, response.tension(u)), diagnostics)

    def _step_alone(self, state: State, dt: float) -> StepResult:
        """One vesicle: no coupling, one solve; without flow, relaxation alone."""
        xp = array_namespace(state.X)
        ops = self._operators(state.X, slice(None))
        N = state.X.shape[-1]
        columns = xp.reshape(ops.bending_velocity(), (1, -1, 1))
        if self.flow is not None:
            columns = columns + ops.outer(xp.reshape(resample(self.flow(state.X, state.t), ops.X.shape[-1]), (1, -1, 1)))
        increment, tension = relaxation_system(ops, columns, dt, self.tension)
        sigma = None if tension is None else resample(tension[..., 0], N)
        X = state.X + resample(xp.reshape(increment, ops.X.shape), N)
        return StepResult(State(state.t + dt, X, sigma), {"gmres_iterations": 0})

    def _operators(self, X: Array, which: slice) -> VesicleOperators:
        """Of the vesicles `which` among all X."""
        contrast = None if self.contrast is None else self.contrast[which]
        return vesicle_operators(resample(X[which], operator_points(X.shape[-1], self.points)), self.kappa_b, self.mu, contrast)

    def _response(self, X: Array, dt: float) -> Response:
        """Increment, tension and force of every vesicle as affine functions of its coupling velocity."""
        xp = array_namespace(X)
        M, _, N = X.shape
        n = operator_points(N, self.points)
        chunk = max(1, CHUNK_VALUES // (2 * n) ** 2)
        parts = parallel_map(lambda which: self._response_of(X, which, dt), [slice(k, k + chunk) for k in range(0, M, chunk)])
        return Response(*(xp.concat([getattr(p, name) for p in parts], axis=0) for name in Response.__dataclass_fields__))

    def _response_of(self, X: Array, which: slice, dt: float) -> Response:
        xp = array_namespace(X)
        ops = self._operators(X, which)
        m, _, n = ops.X.shape
        N = X.shape[-1]
        count("coupled_response", m)
        # columns: the bending velocity of X^n, then the interpolated unit velocities of the N nodes, x then y
        E = constant(resampling_matrix, n, N, like=X)
        zero = xp.zeros_like(E)
        basis = xp.concat([xp.concat([E, zero], axis=1), xp.concat([zero, E], axis=1)], axis=0)
        own = xp.reshape(ops.bending_velocity(), (m, 2 * n, 1))
        columns = xp.concat([own, ops.outer(xp.broadcast_to(basis, (m, *basis.shape)))], axis=-1)
        increment, tension = relaxation_system(ops, columns, dt, True)
        D, D4 = ops.D, ops.D4
        x_s, y_s = ops.tangent[:, 0, :, None], ops.tangent[:, 1, :, None]
        R = constant(resampling_matrix, N, n, like=X)
        speed_N = speed(X[which])
        R_force = R * ops.speed[:, None, :] / speed_N[:, :, None]  # low-passed is the force on an arc: what is left sums to zero, too
        R_bend, R_tension = -self.kappa_b * xp.matmul(R_force, D4), xp.matmul(R_force, D)
        fx = xp.matmul(R_bend, increment[:, :n]) + xp.matmul(R_tension, x_s * tension)
        fy = xp.matmul(R_bend, increment[:, n:]) + xp.matmul(R_tension, y_s * tension)
        force = xp.concat([fx, fy], axis=1)
        increment = xp.concat([xp.matmul(R, increment[:, :n]), xp.matmul(R, increment[:, n:])], axis=1)
        tension = xp.matmul(R, tension)
        bending = resample(bending_force(ops.X, self.kappa_b) * ops.speed[:, None, :], N) / speed_N[:, None, :]
        force_0 = xp.reshape(force[..., 0], (m, 2, N)) + bending
        return Response(
            xp.reshape(increment[..., 0], (m, 2, N)),
            increment[..., 1:],
            tension[..., 0],
            tension[..., 1:],
            force_0,
            force[..., 1:],
        )

    def _gmres(self, apply: Callable[[Array], Array], rhs: Array, guess: Array, X: Array) -> tuple[Array, int]:
        """u with apply(u) = rhs, and the iterations taken; the true residual is checked."""
        size = int(np.prod(rhs.shape))
        iterations = 0

        def matvec(v: np.ndarray) -> np.ndarray:
            return to_numpy(apply(from_numpy(v.reshape(rhs.shape), like=rhs))).ravel()

        def tick(_: float) -> None:
            nonlocal iterations
            iterations += 1

        b = to_numpy(rhs).ravel()
        solution, _ = gmres(
            LinearOperator((size, size), matvec=matvec, dtype=b.dtype),
            b,
            x0=to_numpy(guess).ravel(),
            rtol=self.tolerance,
            atol=0.0,
            restart=min(size, self.max_iterations),
            maxiter=1,
            callback=tick,
            callback_type="pr_norm",
        )
        residual = np.linalg.norm(b - matvec(solution)) / (np.linalg.norm(b) or 1.0)
        if not residual <= 10.0 * self.tolerance:
            raise NumericalFailure(
                f"GMRES stopped at a relative residual of {residual:.1e} (wanted {self.tolerance:.1e}) after {iterations} iterations, "
                f"smallest gap between nodes and membranes {minimum_gap(X):.2e}: take smaller steps or more nodes"
            )
        return from_numpy(solution.reshape(rhs.shape), like=rhs), iterations


@dataclass(frozen=True)
class Response:
    """Affine maps u (M, 2, N) -> increment of X, tension, force: constant part and matrix of each."""

    increment_0: Array
    increment_1: Array
    tension_0: Array
    tension_1: Array
    force_0: Array
    force_1: Array

    def force(self, u: Array) -> Array:
        """Linear part of the force (M, 2, N)."""
        return _apply(self.force_1, u, self.force_0.shape)

    def moved(self, u: Array) -> Array:
        """Linear part of the increment (M, 2, N)."""
        return _apply(self.increment_1, u, self.increment_0.shape)

    def increment(self, u: Array) -> Array:
        """X^{n+1} - X^n (M, 2, N)."""
        return self.increment_0 + self.moved(u)

    def tension(self, u: Array) -> Array:
        """sigma^{n+1} (M, N)."""
        return self.tension_0 + _apply(self.tension_1, u, self.tension_0.shape)


def _apply(matrix: Array, u: Array, shape: tuple[int, ...]) -> Array:
    xp = array_namespace(u)
    return xp.reshape(xp.matmul(matrix, xp.reshape(u, (u.shape[0], -1, 1))), shape)
