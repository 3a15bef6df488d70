"""What the loop knows of a solver: `step(state, dt) -> StepResult`. Steppers know no file and no scene."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Protocol

from biem.backend import Array


@dataclass(frozen=True)
class State:
    """Membranes X (M, 2, N) at time t; sigma (M, N) is their tension, or None where nothing has asked for it.

    coupling: an earlier time, the velocity (M, 2, N) that the flow and the other vesicles then gave the nodes, and its rate; a solver
    that takes this velocity explicitly goes on from there.
    """

    t: float
    X: Array
    sigma: Array | None = None
    coupling: tuple[float, Array, Array] | None = None


@dataclass(frozen=True)
class StepResult:
    """The new state and what the step reports: numbers by name (gmres_iterations, redistributed, area_length_restored, ...)."""

    state: State
    diagnostics: Mapping[str, float] = field(default_factory=dict)


class Stepper(Protocol):
    """One time step of a suspension. Raises `NumericalFailure` where the step cannot be made."""

    def step(self, state: State, dt: float) -> StepResult: ...


Flow = Callable[[Array, float], Array]  # background velocity (M, 2, N) at X (M, 2, N) and time t
