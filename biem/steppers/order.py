"""One step of dt against two of dt/2, as a stepper around a first-order stepper: an error estimate, and second order in time.

X = X_{dt/2, dt/2} (order 1)  or  2 X_{dt/2, dt/2} - X_dt (order 2, local extrapolation)
error estimate: max |X_{dt/2, dt/2} - X_dt| over the mean length of the membranes, that of the two half steps, O(dt^2)
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from biem.backend import to_numpy
from biem.curves.curve import area, length
from biem.steppers.stepper import State, Stepper, StepResult

ERRORS = {"error_estimate": "error estimate", "area_change": "relative change of area", "length_change": "relative change of length"}
SUMS = ("repulsion_work",)  # diagnostics that add up over the half steps


@dataclass(frozen=True)
class Extrapolated:
    """`inner` (of first order, one-step) with an error estimate; order 2: extrapolated. Costs three steps of `inner`."""

    inner: Stepper
    order: int = 2

    def step(self, state: State, dt: float) -> StepResult:
        """The state at t + dt; diagnostics hold ERRORS and of each of inner's numbers the largest of the three steps."""
        whole = self.inner.step(state, dt)
        half = self.inner.step(state, 0.5 * dt)
        two = self.inner.step(half.state, 0.5 * dt)
        coarse, fine = whole.state, two.state
        X, sigma, coupling = fine.X, fine.sigma, fine.coupling
        if self.order == 2:
            X = 2.0 * fine.X - coarse.X
            sigma = None if fine.sigma is None or coarse.sigma is None else 2.0 * fine.sigma - coarse.sigma
            coupling = coarse.coupling  # of an extrapolated state, unlike that of the half step
        parts = [result.diagnostics for result in (whole, half, two)]
        diagnostics = {name: max(d.get(name, 0.0) for d in parts) for name in dict.fromkeys(name for d in parts for name in d)}
        for name in SUMS:
            if name in diagnostics:
                diagnostics[name] = half.diagnostics.get(name, 0.0) + two.diagnostics.get(name, 0.0)
        before, after = to_numpy(state.X), to_numpy(X)  # the same bits also where a restart hands a NumPy state to a solver on tensors
        length_before = length(before)
        diagnostics["error_estimate"] = float(np.max(np.abs(to_numpy(fine.X - coarse.X))) / np.mean(length_before))
        for name, ratio in (("area_change", area(after) / area(before)), ("length_change", length(after) / length_before)):
            diagnostics[name] = float(np.max(np.abs(ratio - 1.0)))
        return StepResult(State(state.t + dt, X, sigma, coupling), diagnostics)
