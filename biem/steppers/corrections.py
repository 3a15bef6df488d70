"""The two corrections after a step, as a stepper around a stepper; each use is counted in the diagnostics.

area_error and length_error in the diagnostics are the largest relative errors that the step left, before it was corrected.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from array_api_compat import array_namespace

from biem.backend import Array, count
from biem.curves.conserve import restore_area_length
from biem.curves.curve import area, length
from biem.curves.reparam import redistribute
from biem.steppers.stepper import State, Stepper, StepResult

REDISTRIBUTE = "redistribute"
AREA_LENGTH = "area_length"
CORRECTIONS = (REDISTRIBUTE, AREA_LENGTH)


@dataclass(frozen=True)
class Corrected:
    """`inner`, then nodes redistributed to equal arclength, then area and length restored to area_0, length_0 (M,)."""

    inner: Stepper
    corrections: tuple[str, ...]
    area_0: Array
    length_0: Array

    def step(self, state: State, dt: float) -> StepResult:
        result = self.inner.step(state, dt)
        X, sigma = result.state.X, result.state.sigma
        xp = array_namespace(X)
        diagnostics = dict(result.diagnostics)
        for name, error in (("area", xp.abs(area(X) / self.area_0 - 1.0)), ("length", xp.abs(length(X) / self.length_0 - 1.0))):
            worst = int(xp.argmax(error))
            diagnostics[f"{name}_error"] = float(error[worst])
            diagnostics[f"{name}_error_vesicle"] = worst
        if not bool(xp.all(xp.isfinite(X))):
            return StepResult(result.state, diagnostics)  # nothing to correct: the guard rejects it
        if REDISTRIBUTE in self.corrections:
            X, *fields = redistribute(X, *([] if sigma is None else [sigma]))
            sigma = fields[0] if fields else None
            count("redistributed", X.shape[0])
        if AREA_LENGTH in self.corrections:
            X, restored = restore_area_length(X, self.area_0, self.length_0)
            count("area_length_restored", restored)
        return StepResult(replace(result.state, X=X, sigma=sigma), diagnostics)
