"""What a split step takes from the one before: the predicted coupling velocity, its fixed point, tension and rate."""

from dataclasses import replace

import numpy as np
import pytest
from split_cases import FIELDS, close, counted, in_shear, march, mild, relative, two

from biem.curves.shapes import equilibrium
from biem.membrane.maps import ExactMaps
from biem.membrane.operators import VesicleOperators, membrane_force, surface_divergence
from biem.steppers.split import FIRST_CHANGE, FIRST_SWEEPS, SplitStepper
from biem.steppers.stepper import State
from biem.stokes.interaction import Interaction


def fixed_point(X, flow, sweeps=60):
    """Velocity that the flow and the other vesicles give the nodes, and the tension, iterated until nothing changes."""
    maps, interaction = ExactMaps(), Interaction.build(X, 1.0, FIELDS)
    u = flow(X, 0.0)
    for _ in range(sweeps):
        sigma = -(maps.self_tension(X) + maps.flow_tension(X, u))
        u = flow(X, 0.0) + interaction.velocity(membrane_force(X, sigma))
    return u, sigma


def test_the_first_step_finds_the_fixed_point():
    X = close(32)
    stepper, _ = in_shear(X)
    counts, new = counted(stepper, State(0.0, X))
    u, sigma = fixed_point(X, stepper.flow)
    assert counts["pair_sum"] < 2 * FIRST_SWEEPS
    assert relative(new.coupling[1], u) < 10 * FIRST_CHANGE
    assert relative(new.sigma, sigma) < 10 * FIRST_CHANGE


def test_the_prediction_is_exact_for_a_velocity_linear_in_time():
    """Velocities that were, and change by, what leads to the fixed point now: two pair sums reproduce it."""
    X = close(32)
    stepper, _ = in_shear(X)
    u, sigma = fixed_point(X, stepper.flow)
    dt = 1e-5
    for rate in (0.0 * u, 1e3 * u, 1e3 * u[:, ::-1]):
        counts, new = counted(replace(stepper), State(0.5, X, None, (0.5 - dt, u - dt * rate, rate)))
        assert counts["pair_sum"] == 2
        assert relative(new.coupling[1], u) < 1e-9
        assert relative(new.sigma, sigma) < 1e-9
        assert new.coupling[0] == 0.5
        assert np.abs(dt * (new.coupling[2] - rate)).max() < 1e-9 * np.abs(u).max()


def test_a_wrong_prediction_is_damped_by_the_two_pair_sums():
    """The fixed point contracts: twice two pair sums damp an error by more than once."""
    X = close(32)
    stepper, _ = in_shear(X)
    u, _ = fixed_point(X, stepper.flow)
    errors = [0.01 * np.abs(u).max() * np.cos(9 * X)]
    for _ in range(3):
        new = replace(stepper).step(State(0.5, X, None, (0.4, u + errors[-1], 0.0 * u)), 1e-6).state
        errors.append(new.coupling[1] - u)
    sizes = np.array([np.abs(e).max() for e in errors])
    assert (sizes[1:] < 0.3 * sizes[:-1]).all(), sizes


def test_a_coupling_velocity_that_does_not_change_has_no_rate():
    """Relaxed shapes at rest: nothing moves, the induced velocity stays, and the rate goes to zero."""
    X = two(equilibrium(64, 0.65), 4.0, 0.3, np.pi / 2)
    stepper = SplitStepper(ExactMaps(), 1.0, 1.0, None, FIELDS)
    dt = 1e-5
    state = march(stepper, State(0.0, X), dt, 5)
    assert np.abs(state.X - X).max() < 1e-7
    assert np.abs(state.coupling[1]).max() * dt < 1e-8
    assert np.abs(state.coupling[2]).max() * dt**2 < 1e-8


def test_membranes_do_not_stretch_where_their_tension_was_found():
    """P (B X + T sigma + u_inf + u) = 0 by an independent single layer, to the accuracy of the prediction."""
    X = mild(96)
    stepper, t_gamma = in_shear(X)
    residuals = []
    for steps in (5, 10):
        dt = 0.1 * t_gamma / steps
        state = march(stepper, State(0.0, X), dt, steps)
        Y, sigma = state.X, stepper.step(state, dt).state.sigma
        u = Interaction.build(Y, 1.0, FIELDS).velocity(membrane_force(Y, sigma)) + stepper.flow(Y, state.t)
        ops = VesicleOperators(Y)
        own = ops.S @ membrane_force(Y, sigma).reshape(2, -1, 1)
        total = surface_divergence(Y, own.reshape(Y.shape) + u)
        residuals.append(np.abs(total).max() / np.abs(surface_divergence(Y, u)).max())
    assert residuals[0] < 5e-4, residuals
    assert np.log2(residuals[0] / residuals[1]) == pytest.approx(2.0, abs=0.4), residuals


def test_no_number_in_gives_no_number_out():
    X = close(32)
    stepper, t_gamma = in_shear(X)
    state = stepper.step(State(0.0, X), 0.02 * t_gamma).state
    bad = state.X.copy()
    bad[0, 0, 3] = np.nan
    with np.errstate(invalid="ignore"):
        for coupling in (None, state.coupling):
            new = stepper.step(State(state.t, bad, None, coupling), 0.02 * t_gamma).state
            assert np.isnan(new.X).any(axis=(1, 2)).all()  # both feel it
        alone = stepper.step(State(0.0, bad[:1]), 0.02 * t_gamma).state
    assert np.isnan(alone.X).all()
