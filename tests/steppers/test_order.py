"""Extrapolated steps: second order, an estimate of the right size, the same state for steady states."""

from dataclasses import replace

import numpy as np
import pytest

from biem.curves.curve import effective_radius
from biem.curves.shapes import equilibrium, place
from biem.steppers.implicit import ImplicitStepper
from biem.steppers.order import Extrapolated
from biem.steppers.stepper import State, StepResult


def pair(points=32):
    one = equilibrium(points, 0.65)
    R = float(effective_radius(one[None])[0])
    return np.stack([place(one, np.array([-2.3 * R, 0.3 * R]), 0.0), place(one, np.zeros(2), np.pi / 2)])


def in_shear(X, capillary=5.0):
    rate = capillary / float(effective_radius(X)[0]) ** 3
    return ImplicitStepper(1.0, 1.0, lambda Y, t: np.stack([rate * Y[:, 1], 0.0 * Y[:, 1]], axis=1)), 1.0 / rate


def test_order_for_the_coupled_pair():
    """Near 2; the stiff modes, which follow the flow implicitly, lower it a little at these dt."""
    X = pair(48)
    inner, t_gamma = in_shear(X)
    ends = []
    for h in (0.04, 0.02, 0.01):
        state = State(0.0, X)
        for _ in range(round(0.16 / h)):
            state = Extrapolated(inner).step(state, h * t_gamma).state
        ends.append(state.X)
    order = np.log2(np.abs(ends[0] - ends[1]).max() / np.abs(ends[1] - ends[2]).max())
    assert order > 1.7


def test_estimate_is_the_error_of_two_half_steps():
    X = pair()
    inner, t_gamma = in_shear(X)
    dt = 0.02 * t_gamma
    result = Extrapolated(inner).step(State(0.0, X), dt)
    state = State(0.0, X)
    for _ in range(64):
        state = inner.step(state, dt / 64).state
    half = inner.step(inner.step(State(0.0, X), dt / 2).state, dt / 2).state
    assert result.diagnostics["error_estimate"] == pytest.approx(np.abs(half.X - state.X).max(), rel=0.1)
    assert np.abs(result.state.X - state.X).max() < 0.1 * result.diagnostics["error_estimate"]
    assert result.diagnostics["gmres_iterations"] > 0


def test_first_order_keeps_the_two_half_steps():
    X = pair()
    inner, t_gamma = in_shear(X)
    dt = 0.02 * t_gamma
    result = Extrapolated(inner, order=1).step(State(0.0, X), dt)
    half = inner.step(inner.step(State(0.0, X), dt / 2).state, dt / 2)
    assert np.array_equal(result.state.X, half.state.X)
    assert np.array_equal(result.state.sigma, half.state.sigma)
    assert result.diagnostics["error_estimate"] == Extrapolated(inner).step(State(0.0, X), dt).diagnostics["error_estimate"]


def test_changes_of_area_and_length_are_those_of_the_step():
    class Growing:
        def step(self, state, dt):
            factor = np.array([1.0, 1.0 + dt])[:, None, None]
            return StepResult(replace(state, X=state.X * factor), {"seen": dt} if dt < 0.1 else {})

    diagnostics = Extrapolated(Growing(), order=1).step(State(0.0, pair()), 0.1).diagnostics
    assert diagnostics["length_change"] == pytest.approx(1.05**2 - 1)
    assert diagnostics["area_change"] == pytest.approx(1.05**4 - 1)
    assert diagnostics["seen"] == 0.05  # what only some of the steps report


def test_exact_for_a_linear_equation_of_second_degree():
    """A first-order stepper for x' = t (explicit Euler) becomes exact: x = t^2 / 2."""

    class Euler:
        def step(self, state, dt):
            return StepResult(replace(state, t=state.t + dt, X=state.X + dt * state.t), {})

    X = pair()
    state = State(0.0, X)
    for _ in range(4):
        state = Extrapolated(Euler()).step(state, 0.25).state
    assert np.abs(state.X - X - 0.5).max() < 1e-14
    assert state.sigma is None
