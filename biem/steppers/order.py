"""Second order in time by local extrapolation: one step of dt against two of dt/2, as a stepper around a first-order stepper.

X = 2 X_{dt/2, dt/2} - X_dt,     error estimate max |X_{dt/2, dt/2} - X_dt| over the mean length of the membranes
"""

from __future__ import annotations

from dataclasses import dataclass

from array_api_compat import array_namespace

from biem.curves.curve import length
from biem.steppers.stepper import State, Stepper, StepResult


@dataclass(frozen=True)
class Extrapolated:
    """`inner` (of first order, one-step) made second order; costs three of its steps. The estimate is that of `inner`."""

    inner: Stepper

    def step(self, state: State, dt: float) -> StepResult:
        """The extrapolated state at t + dt; diagnostics hold the estimate and the most GMRES iterations of the three."""
        xp = array_namespace(state.X)
        whole = self.inner.step(state, dt)
        half = self.inner.step(state, 0.5 * dt)
        two = self.inner.step(half.state, 0.5 * dt)
        coarse, fine = whole.state, two.state
        X = 2.0 * fine.X - coarse.X
        sigma = None if fine.sigma is None or coarse.sigma is None else 2.0 * fine.sigma - coarse.sigma
        names = whole.diagnostics.keys()
        diagnostics = {name: max(r.diagnostics[name] for r in (whole, half, two)) for name in names}
        diagnostics["error_estimate"] = float(xp.max(xp.abs(fine.X - coarse.X)) / xp.mean(length(state.X)))
        return StepResult(State(state.t + dt, X, sigma), diagnostics)
