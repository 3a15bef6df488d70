"""High modes of a relaxation network's increments, where its errors in them would grow from step to step.

From mode k = damped_from on the increment is that of a circle, X_k (e^{-dt (2 pi k)^3/4} - 1), or X_k (1/(1 + dt (2 pi k)^3/4) - 1) of an
implicit step: stable, and wrong by a good part of what these modes do on other shapes. So it is done only where it must be: relaxation
lowers the bending energy, and the first of CHOICES for which that holds over STEPS steps, but for RISE, is taken. The highest two modes are
always damped: what neighbours' velocities put there beside exact advection was not in the training shapes. Without it the shear pair, mlp
relaxation and all else exact, was rejected after 5 t_gamma; with it it errs by 0.5 % of R until 8 (ivnet: 0.4 % instead of 1.0 %).
"""

from __future__ import annotations

from collections.abc import Callable
from math import pi

import numpy as np
import torch
from torch import Tensor

from biem.curves.curve import area, bending_energy, length
from biem.errors import NumericalFailure
from biem.steppers.corrections import Corrected
from biem.steppers.stepper import State, StepResult
from surrogate.weights import Card

CHOICES = (15, 13, 11)  # of N = 32
STEPS = 100
RISE = 0.02  # of the energy at the start; exact maps at 64 nodes show 0.005, by what 32 nodes cannot hold
Relax = Callable[[np.ndarray, float], np.ndarray]


def damped(increments: Tensor, X: Tensor, card: Card) -> Tensor:
    """increments (M, 2, N) of X in the standard pose, the modes |k| >= card.damped_from as they relax on a circle."""
    N, dt = X.shape[-1], card.dt or 0.0
    k = torch.arange(N // 2 + 1, dtype=torch.float64, device=X.device)
    rate = 0.25 * dt * (2.0 * pi * k) ** 3
    decay = torch.exp(-rate) - 1.0 if card.relaxation == "converged" else 1.0 / (1.0 + rate) - 1.0
    return torch.fft.irfft(torch.where(k >= (card.damped_from or 0), decay * torch.fft.rfft(X), torch.fft.rfft(increments)), n=N)


def least_damping(relax: Callable[[int], Relax], X: np.ndarray, dt: float) -> int:
    """The first of CHOICES, for N nodes, with which relax(choice) is stable from X (M, 2, N); the last one where none is."""
    choices = [round(choice * X.shape[-1] / 32) for choice in CHOICES]
    return next((choice for choice in choices if _is_stable(relax(choice), X, dt)), choices[-1])


def _is_stable(relax: Relax, X: np.ndarray, dt: float) -> bool:
    stepper = Corrected(_Relaxation(relax), ("area_length", "redistribute"), area(X), length(X))
    state, most = State(0.0, X), (1.0 + RISE) * bending_energy(X)
    for _ in range(STEPS):
        try:
            state = stepper.step(state, dt).state
        except NumericalFailure:
            return False
        if not (bending_energy(state.X) <= most).all():
            return False
    return True


class _Relaxation:
    """Relaxation alone, as a stepper."""

    def __init__(self, relax: Relax) -> None:
        self.relax = relax

    def step(self, state: State, dt: float) -> StepResult:
        return StepResult(State(state.t + dt, self.relax(state.X, dt)))
