"""Forces and velocities of all membranes at one instant, from their shapes alone. X: (M, 2, N).

Tension makes the membranes inextensible under all that moves them:

    sigma + L^-1 P K T sigma = -L^-1 P (B X + u_inf + S f_r + K (f_b + f_r)),     K: single layers of the others and the walls' answer

solved by GMRES, block-diagonally preconditioned as it stands. Then u = u_inf + S f + K f with f = f_b + f_sigma + f_r is the velocity
of the nodes. A stepper's own tension lags by up to a step; this one does not.

Where viscosities differ (`membrane.contrast`), the outer velocity v is solved for, with u = A^-1 (S f + v) and K also the double layers of
the others' velocities:

    v - K (f, u) = u_inf + S f_r,     sigma = -L^-1 P A^-1 (S f_b + v),  or as given
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.sparse.linalg import LinearOperator, gmres

from biem.backend import one_blas_thread
from biem.errors import NumericalFailure
from biem.membrane.contrast import ContrastMaps
from biem.membrane.maps import ExactMaps
from biem.membrane.operators import bending_force, tension_force
from biem.membrane.repulsion import Repulsion
from biem.scene.build import Problem
from biem.stokes.interaction import Fields, Interaction
from biem.stokes.kress import on_own_curve

MOST_ITERATIONS = 200


@dataclass(frozen=True)
class Instant:
    """Of membranes X at t: tension sigma (M, N); force density f_b + f_sigma + f_r on the fluid, velocity of the nodes (M, 2, N)."""

    t: float
    X: np.ndarray
    sigma: np.ndarray
    force: np.ndarray
    velocity: np.ndarray


def instant(problem: Problem, X: np.ndarray, t: float = 0.0, sigma: np.ndarray | None = None, tolerance: float = 1e-8) -> Instant:
    """The instant at which membranes X (M, 2, N) of the problem's scene are where they are, at time t.

    sigma (M, N): their tension, where it is known; otherwise it is solved for, to the relative `tolerance`, also that of near and far
    fields. Raises NumericalFailure where GMRES does not reach it.
    """
    physics, solver = problem.scene.physics, problem.scene.solver
    M = X.shape[0]
    u_inf = 0.0 * X if problem.flow.kind == "quiescent" else problem.flow.velocity(X, t)
    with one_blas_thread():
        fields = Fields(near_tolerance=tolerance, far_tolerance=tolerance)
        lattice = None if problem.box is None else problem.box.at(t)
        alone = M == 1 and problem.walls is None and lattice is None
        around = problem.walls, problem.contrast, lattice
        others = None if alone else Interaction.build(X, physics.mu, fields, slice(None), True, *around)
        repulsion = repulsion_of(problem)
        repulsive = None if repulsion is None else repulsion.force(X, lattice)
        if problem.contrast is not None:
            if repulsive is not None:
                u_inf = u_inf + on_own_curve(X, repulsive, physics.mu)
            return Instant(t, X, *_with_contrast(problem, X, u_inf, others, repulsive, sigma, tolerance))
        velocity_of_others = lambda f: 0.0 * X if others is None else others.velocity(f)
        force = bending_force(X, physics.kappa_b) + (0.0 if repulsive is None else repulsive)
        if sigma is None:
            maps = ExactMaps(physics.kappa_b, physics.mu, solver.operator_points)
            u = u_inf + velocity_of_others(force)
            if repulsive is not None:
                u = u + on_own_curve(X, repulsive, physics.mu)
            rhs = -(maps.self_tension(X) + maps.flow_tension(X, u))
            apply = lambda s: s + maps.flow_tension(X, velocity_of_others(tension_force(X, s)))
            sigma = rhs if alone else _gmres(apply, rhs, tolerance)
        force = force + tension_force(X, sigma)
        return Instant(t, X, sigma, force, u_inf + velocity_of_others(force) + on_own_curve(X, force, physics.mu))


def _with_contrast(
    problem: Problem,
    X: np.ndarray,
    u_inf: np.ndarray,
    others: Interaction | None,
    repulsive: np.ndarray | None,
    sigma: np.ndarray | None,
    tolerance: float,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Tension, force and velocity."""
    assert problem.contrast is not None
    physics = problem.scene.physics
    maps = ContrastMaps(physics.kappa_b, physics.mu, problem.scene.solver.operator_points, contrast=problem.contrast)
    bending = bending_force(X, physics.kappa_b)
    zero = 0.0 * X

    def tense(v: np.ndarray) -> np.ndarray:
        """The part of the tension's force that depends on v."""
        return tension_force(X, -maps.flow_tension(X, v)) if sigma is None else zero

    elastic = bending + tension_force(X, -maps.self_tension(X) if sigma is None else sigma)  # the part that does not
    v = u_inf
    if others is not None:
        force = elastic + (zero if repulsive is None else repulsive)
        rhs = u_inf + others.velocity(force, maps.velocity(X, elastic, zero))
        v = _gmres(lambda v: v - others.velocity(tense(v), maps.velocity(X, tense(v), v)), rhs, tolerance)
    if sigma is None:
        sigma = -(maps.self_tension(X) + maps.flow_tension(X, v))
    elastic = bending + tension_force(X, sigma)
    return sigma, elastic + (zero if repulsive is None else repulsive), maps.velocity(X, elastic, v)


def repulsion_of(problem: Problem) -> Repulsion | None:
    """Reach and strength from the unit of the scene's mean membrane length to that of X."""
    table = problem.scene.solver.repulsion
    if table is None:
        return None
    length = problem.length
    return Repulsion(table.reach * length, table.strength * problem.scene.physics.kappa_b / length**3, problem.walls)


def _gmres(apply: Callable[[np.ndarray], np.ndarray], rhs: np.ndarray, tolerance: float) -> np.ndarray:
    b = rhs.ravel()
    matvec = lambda v: apply(v.reshape(rhs.shape)).ravel()
    operator = LinearOperator((b.size, b.size), matvec=matvec, dtype=b.dtype)
    solution, _ = gmres(operator, b, x0=b, rtol=tolerance, atol=0.0, restart=min(b.size, MOST_ITERATIONS), maxiter=1)
    residual = np.linalg.norm(b - matvec(solution)) / (np.linalg.norm(b) or 1.0)
    if not residual <= 10.0 * tolerance:
        raise NumericalFailure(f"the tension was found to a relative residual of {residual:.1e} only (wanted {tolerance:.1e})")
    return solution.reshape(rhs.shape)
