"""The size of the next step from the errors of this one: a step with an error above the tolerance is rejected and halved.

dt_next = dt min(1.2, 0.9 (tolerance / error)^(1/2)),     error = O(dt^2): what one step of a first-order stepper leaves
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

GROWTH = 1.2  # largest factor from one step to the next; it is slow, so that a rejected size is not tried again at once
SAFETY = 0.9  # aims below the tolerance; with GROWTH it keeps errors of O(dt^3) below it too


@dataclass(frozen=True)
class Controller:
    """tolerance: largest error of an accepted step; dt_min: no accepted step proposes a smaller one."""

    tolerance: float
    dt_min: float

    def accept(self, dt: float, errors: Mapping[str, float]) -> tuple[bool, float]:
        """Whether a step of dt with these errors, by name, is accepted, and the dt to go on with."""
        if self.failed(errors):
            return False, self.reject(dt)
        error = max(errors.values())
        factor = GROWTH if error == 0 else min(GROWTH, SAFETY * math.sqrt(self.tolerance / error))
        return True, max(self.dt_min, dt * factor)

    def reject(self, dt: float) -> float:
        """The dt to try after a step of dt that could not be made."""
        return 0.5 * dt

    def failed(self, errors: Mapping[str, float]) -> list[str]:
        """Names of the errors above the tolerance, or not a number."""
        return [name for name, error in errors.items() if not error <= self.tolerance]


def add_time(t: float, lost: float, dt: float) -> tuple[float, float]:
    """The sum t + lost + dt, rounded, and what the rounding lost (Kahan): a long sum of steps stays exact to a few 1e-16."""
    step = dt + lost
    total = t + step
    return total, step - (total - t)
