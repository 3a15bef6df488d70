"""Operator-split step over any membrane maps: advection with explicit interactions, then implicit relaxation of each vesicle.

    u predicted for t^n           sigma = -L^-1 P (B X^n + u)                     u = u_inf + sum_{j != i} S_j[f(X_j^n, sigma_j)]
                                  sigma^n: the same of the new u                  u^n: likewise
    a^n = (u^n - u^{n-1})/dt      X* = X^n + dt (1 - M)(u^n + dt/2 a^n)           X^{n+1} - X* = dt (1 - M*) B* X^{n+1}

Two pair sums a step, where there is more than one vesicle. The rate a^n of the velocity at the nodes serves the prediction (with the
last tension merely carried over, an error of first order stays that no extrapolation removes) and makes the advection of second
order (Adams-Bashforth); the splitting and the relaxation are of first order. Paper, Algorithm 1, where neither is done.

Where viscosities differ (`membrane.contrast`), u is the outer velocity, to which the other vesicles' double layers belong; they are taken
with the velocities A_j^-1 (S_j f_j + u_j) that go with the forces in the same sum.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from biem.backend import Array, Latest, array_namespace, one_blas_thread, stage
from biem.curves.lattice import Box
from biem.membrane.maps import Contrasted, MembraneMaps, Monitored
from biem.membrane.operators import bending_force, tension_force
from biem.membrane.repulsion import Repulsion, work_of
from biem.ranks import ALONE, Ranks
from biem.steppers.stepper import Flow, State, StepResult
from biem.stokes.interaction import DEFAULT_FIELDS, Fields, Interaction
from biem.stokes.kress import on_own_curve
from biem.stokes.walls import Walls

FIRST_SWEEPS, FIRST_CHANGE = 20, 1e-6  # of the fixed-point iteration at the start: at most, until the relative change is below


@dataclass(frozen=True)
class _Advection:
    """What a step takes from X^n. velocity u and its rate: None where nothing moves the vesicles; sigma: None where nobody asks for it.

    monitored: what maps say of X^n that watch over their validity, of all ranks.
    """

    X_mine: Array  # one array for all maps of a step, so that they can share their factors
    velocity: Array = None
    rate: Array = None
    sigma: Array | None = None
    repulsive: Array | None = None
    monitored: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class SplitStepper:
    """Parameters of the step. flow: background velocity, or None in a fluid at rest; walls: their answer is one more explicit velocity.

    tension: keep sigma also where no other vesicle needs it; ranks: processes that share the vesicles; interacting: whether the vesicles
    are in one fluid, or each in a fluid of its own, a batch of independent runs. contrast (M,): of the vesicles' viscosities to mu, or
    None where all are 1; otherwise the maps are `Contrasted`, of the vesicles of this rank. box: a periodic one, whose images also act.
    """

    maps: MembraneMaps
    kappa_b: float
    mu: float
    flow: Flow | None = None
    fields: Fields = DEFAULT_FIELDS
    repulsion: Repulsion | None = None
    tension: bool = False
    ranks: Ranks = ALONE
    interacting: bool = True
    walls: Walls | None = None
    contrast: np.ndarray | None = None
    box: Box | None = None
    _advection: Latest = field(default_factory=Latest, init=False, repr=False, compare=False)

    def step(self, state: State, dt: float) -> StepResult:
        """The state at t + dt; sigma is the tension at t."""
        with one_blas_thread():
            # steps of different dt from one state, as extrapolation makes them, share everything but the relaxation
            a = self._advection.of(state, lambda: self._monitor(state.X, self._advect(state, dt)))
            X = self._move(state.X, a, dt)
        coupling = None if a.velocity is None else (state.t, a.velocity, a.rate)
        return StepResult(State(state.t + dt, X, a.sigma, coupling), {**work_of(a.repulsive, state.X, X - state.X), **a.monitored})

    def _monitor(self, X: Array, a: _Advection) -> _Advection:
        """With what the maps say of X, summed over the ranks."""
        maps = self.maps
        if not isinstance(maps, Monitored):
            return a
        _, told = self.ranks.gather_all(X.shape[0], lambda mine: (a.X_mine[:, 0, 0], maps.diagnostics(a.X_mine)))
        names = dict.fromkeys(name for counts in told for name in counts)
        return replace(a, monitored={name: float(sum(counts.get(name, 0.0) for counts in told)) for name in names})

    def _move(self, X: Array, a: _Advection, dt: float) -> Array:
        M = X.shape[0]
        if a.velocity is not None:
            u = a.velocity + 0.5 * dt * a.rate
            with stage("advection"):
                X = X + dt * self.ranks.gather(M, lambda mine: self.maps.advect(a.X_mine, u[mine]))
        with stage("relaxation"):
            return self.ranks.gather(M, lambda mine: self.maps.relax(X[mine], dt))

    def _advect(self, state: State, dt: float) -> _Advection:
        if self.flow is None and not self._coupled(state.X):
            M = state.X.shape[0]
            X_mine = state.X[self.ranks.mine(M)]
            sigma = -self.ranks.gather(M, lambda mine: self.maps.self_tension(X_mine)) if self.tension else None
            return _Advection(X_mine, sigma=sigma)
        if state.coupling is not None:
            return self._evaluate(state)
        start = self._evaluate(state)  # the rate is not known yet: it is taken from half a step on trial
        trial = replace(state, t=state.t + 0.5 * dt, X=self._move(state.X, start, 0.5 * dt))
        rate = (self._evaluate(trial).velocity - start.velocity) / (0.5 * dt)
        return replace(start, rate=rate)

    def _evaluate(self, state: State) -> _Advection:
        """Velocity and tension at the state; without an earlier velocity to go on from, by iteration and without a rate."""
        X, M = state.X, state.X.shape[0]
        X_mine = X[self.ranks.mine(M)]
        gather = lambda function: self.ranks.gather(M, function)
        u_inf = 0.0 * X if self.flow is None else self.flow(X, state.t)
        lattice = None if self.box is None else self.box.at(state.t)
        repulsive = None if self.repulsion is None else self.repulsion.force(X, lattice)
        if repulsive is not None:
            u_inf = u_inf + on_own_curve(X, repulsive, self.mu)
        sigma = None
        u = u_inf
        coupled = self._coupled(X)
        if coupled or self.tension:
            with stage("self-tension"):
                self_tension = gather(lambda mine: self.maps.self_tension(X_mine))

            def tension(u: Array) -> Array:
                with stage("flow tension"):
                    return -(self_tension + gather(lambda mine: self.maps.flow_tension(X_mine, u[mine])))

        if coupled:
            bending = bending_force(X, self.kappa_b)
            own_force = bending + (0.0 if repulsive is None else repulsive)
            around = self.walls, self.contrast, lattice
            interaction = Interaction.build(X, self.mu, self.fields, self.ranks.mine(M), False, *around)

            def velocity(sigma: Array, u: Array) -> Array:
                tense = tension_force(X, sigma)
                moving = None
                if self.contrast is not None:
                    maps, f = self.maps, bending + tense
                    assert isinstance(maps, Contrasted)
                    moving = gather(lambda mine: maps.velocity(X_mine, f[mine], u[mine]))
                return u_inf + gather(lambda mine: interaction.velocity(own_force + tense, moving))

            if state.coupling is None:
                u, sigma = _fixed_point(tension, velocity, u_inf)
            else:
                t_before, u_before, rate = state.coupling
                u = u_before + (state.t - t_before) * rate
                u = velocity(tension(u), u)
                sigma = tension(u)
                u = velocity(sigma, u)
        elif self.tension:
            sigma = tension(u)
        rate = 0.0 * u if state.coupling is None else (u - state.coupling[1]) / (state.t - state.coupling[0])
        return _Advection(X_mine, u, rate, sigma, repulsive)

    def _coupled(self, X: Array) -> bool:
        """Whether a vesicle's force comes back to a vesicle: from another one, from the walls, or from images."""
        return self.walls is not None or self.box is not None or (self.interacting and X.shape[0] > 1)


def _fixed_point(tension: Callable[[Array], Array], velocity: Callable[[Array, Array], Array], u: Array) -> tuple[Array, Array]:
    """Velocity and tension of all vesicles by iteration from u, where there is nothing to predict them from."""
    xp = array_namespace(u)
    for _ in range(FIRST_SWEEPS):
        sigma = tension(u)
        before, u = u, velocity(sigma, u)
        if float(xp.max(xp.abs(u - before))) <= FIRST_CHANGE * float(xp.max(xp.abs(u))):
            break
    return u, sigma
