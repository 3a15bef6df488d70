"""Operator-split Euler step over any membrane maps: advection with explicit interactions, then implicit relaxation of each vesicle.

    u: predicted for t^n                        sigma = -L^-1 P (B X^n + u_inf + u)      u = sum_{j != i} S_j[f(X_j^n, sigma_j)]
                                                sigma^n = the same of the new u          u^n likewise
    X* = X^n + dt (1 - M) (u_inf + u^n)         X^{n+1} - X* = dt (1 - M*) B* X^{n+1}

Two pair sums a step, where there is more than one vesicle. The prediction is linear in time through u^{n-1} and u^n: with the last
velocity or tension merely carried over, an error of first order stays, and no extrapolation removes it. Paper, Algorithm 1.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

from array_api_compat import array_namespace

from biem.backend import Array, Latest, one_blas_thread
from biem.membrane.maps import MembraneMaps
from biem.membrane.operators import bending_force, tension_force
from biem.membrane.repulsion import Repulsion, work_of
from biem.ranks import ALONE, Ranks
from biem.steppers.stepper import Flow, State, StepResult
from biem.stokes.interaction import DEFAULT_FIELDS, Fields, Interaction
from biem.stokes.kress import on_own_curve

FIRST_SWEEPS, FIRST_CHANGE = 20, 1e-6  # of the fixed-point iteration at the start: at most, until the relative change is below


@dataclass(frozen=True)
class _Advection:
    """What a step takes from X^n: (1 - M) u (None where nothing moves the vesicles), tension, `State.coupling`, force of the repulsion."""

    velocity: Array | None
    sigma: Array | None
    coupling: tuple[float, Array, Array] | None = None
    repulsive: Array | None = None


@dataclass(frozen=True)
class SplitStepper:
    """Parameters of the step. flow: background velocity, or None in a fluid at rest.

    tension: keep sigma also where no other vesicle needs it; ranks: processes that share the vesicles.
    """

    maps: MembraneMaps
    kappa_b: float
    mu: float
    flow: Flow | None = None
    fields: Fields = DEFAULT_FIELDS
    repulsion: Repulsion | None = None
    tension: bool = False
    ranks: Ranks = ALONE
    _advection: Latest = field(default_factory=Latest, init=False, repr=False, compare=False)

    def step(self, state: State, dt: float) -> StepResult:
        """The state at t + dt; sigma is the tension at t."""
        M = state.X.shape[0]
        with one_blas_thread():
            # steps of different dt from one state, as extrapolation makes them, share everything but the relaxation
            a = self._advection.of(state.X, lambda: self._advect(state))
            X_star = state.X if a.velocity is None else state.X + dt * a.velocity
            X = self.ranks.gather(M, lambda mine: self.maps.relax(X_star[mine], dt))
        return StepResult(State(state.t + dt, X, a.sigma, a.coupling), work_of(a.repulsive, state.X, X - state.X))

    def _advect(self, state: State) -> _Advection:
        u_inf = None if self.flow is None else self.flow(state.X, state.t)
        if state.X.shape[0] == 1:
            sigma = self._tension(state.X, u_inf) if self.tension else None
            return _Advection(None if u_inf is None else self.maps.advect(state.X, u_inf), sigma)
        return self._advect_coupled(state, 0.0 * state.X if u_inf is None else u_inf)

    def _advect_coupled(self, state: State, u_inf: Array) -> _Advection:
        X, M = state.X, state.X.shape[0]
        X_mine = X[self.ranks.mine(M)]  # one array for all maps of this step, so that they can share their factors
        gather = lambda function: self.ranks.gather(M, function)
        own_force = bending_force(X, self.kappa_b)
        repulsive = None if self.repulsion is None else self.repulsion.force(X)
        if repulsive is not None:
            own_force = own_force + repulsive
            u_inf = u_inf + on_own_curve(X, repulsive, self.mu)
        interaction = Interaction.build(X, self.mu, self.fields, self.ranks.mine(M))
        self_tension = gather(lambda mine: self.maps.self_tension(X_mine))
        tension = lambda u: -(self_tension + gather(lambda mine: self.maps.flow_tension(X_mine, (u_inf + u)[mine])))
        induced = lambda sigma: gather(lambda mine: interaction.velocity(own_force + tension_force(X, sigma)))
        if state.coupling is None:
            u, sigma = _fixed_point(tension, induced, 0.0 * X)
            rate = 0.0 * u
        else:
            t_before, u_before, rate = state.coupling
            sigma = tension(induced(tension(u_before + (state.t - t_before) * rate)))
            u = induced(sigma)
            rate = (u - u_before) / (state.t - t_before)
        velocity = gather(lambda mine: self.maps.advect(X_mine, (u_inf + u)[mine]))
        return _Advection(velocity, sigma, (state.t, u, rate), repulsive)

    def _tension(self, X: Array, u: Array | None) -> Array:
        sigma = self.maps.self_tension(X)
        return -sigma if u is None else -(sigma + self.maps.flow_tension(X, u))


def _fixed_point(tension: Callable[[Array], Array], induced: Callable[[Array], Array], u: Array) -> tuple[Array, Array]:
    """Induced velocity and tension of all vesicles by iteration, where there is nothing to predict them from."""
    xp = array_namespace(u)
    for _ in range(FIRST_SWEEPS):
        sigma = tension(u)
        before, u = u, induced(sigma)
        if float(xp.max(xp.abs(u - before))) <= FIRST_CHANGE * float(xp.max(xp.abs(u))):
            break
    return u, sigma
