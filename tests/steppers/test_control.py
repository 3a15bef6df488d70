"""The controller alone, on errors C dt^p: it reaches the tolerance, rejects nothing once it is there, and sums times exactly."""

import math

import numpy as np
import pytest

from biem.steppers.control import GROWTH, Controller, add_time

CONTROL = Controller(1e-3, 1e-6)


def drive(constant, power, dt, steps=60):
    """Accepted steps and the number of rejected ones for an error constant * dt^power."""
    taken, rejected = [], 0
    while len(taken) < steps:
        accepted, following = CONTROL.accept(dt, {"error": constant * dt**power})
        if accepted:
            taken.append(dt)
        rejected += not accepted
        dt = following
    return np.array(taken), rejected


@pytest.mark.parametrize("power", [2, 3])
@pytest.mark.parametrize("start", [1e-4, 0.03, 1.0])
def test_steps_settle_below_the_tolerance(power, start):
    dt, rejected = drive(2.0, power, start)
    largest = (1e-3 / 2.0) ** (1 / power)
    assert 0.85 * largest < dt[-1] < largest
    assert rejected == max(0, math.ceil(math.log2(start / largest)))  # halvings at the start, none later
    assert (dt[1:] / dt[:-1]).max() <= GROWTH * (1 + 1e-12)


def test_a_step_at_the_tolerance_is_accepted_and_the_next_one_shorter():
    assert CONTROL.accept(0.1, {"error": 1e-3}) == (True, pytest.approx(0.09))
    assert CONTROL.accept(0.1, {"error": np.nextafter(1e-3, 1)}) == (False, 0.05)
    assert CONTROL.reject(0.1) == 0.05


def test_the_largest_error_decides():
    errors = {"estimate": 1e-5, "area": 9e-4, "length": 0.0}
    assert CONTROL.accept(0.1, errors)[1] == pytest.approx(0.09 * math.sqrt(1e-3 / 9e-4))
    assert CONTROL.accept(0.1, {**errors, "length": 2e-3}) == (False, 0.05)
    assert CONTROL.failed({**errors, "length": 2e-3}) == ["length"]


@pytest.mark.parametrize("error", [math.nan, math.inf])
@pytest.mark.parametrize("other", [0.0, 1.0])
def test_what_is_no_number_is_rejected(error, other):
    for errors in ({"a": error, "b": other}, {"a": other, "b": error}):
        assert CONTROL.accept(0.1, errors) == (False, 0.05)


def test_no_error_grows_at_most_and_dt_min_is_a_floor_of_proposals():
    assert CONTROL.accept(0.1, {"error": 0.0}) == (True, pytest.approx(0.1 * GROWTH))
    assert CONTROL.accept(1e-6, {"error": 1e-3}) == (True, 1e-6)


def test_times_are_summed_without_loss():
    steps = np.random.default_rng(0).uniform(1e-5, 1e-3, size=200_000)
    t, lost, plain = 0.0, 0.0, 0.0
    for dt in steps.tolist():
        t, lost = add_time(t, lost, dt)
        plain += dt
    exact = math.fsum(steps)
    assert abs(t - exact) <= math.ulp(exact)
    assert abs(plain - exact) > 20 * math.ulp(exact)
