"""Values known from independent computations: steady inclination in shear, equilibrium energy."""

import numpy as np
import pytest

from biem.curves.curve import area, bending_energy, effective_radius, inclination, length
from biem.curves.shapes import ellipse, perturbed
from biem.steppers.corrections import CORRECTIONS, Corrected
from biem.steppers.implicit import ImplicitStepper
from biem.steppers.order import Extrapolated
from biem.steppers.stepper import State


@pytest.mark.parametrize(("capillary", "angle"), [(1.0, 0.35307), (10.0, 0.35700)])
def test_steady_inclination_in_shear(capillary, angle):
    """Steady angle to 1e-3, N = 32, second order at dt = 0.04 t_gamma; docs/measurements.md has the first-order values."""
    X = ellipse(32, 0.65)[None]
    rate = capillary / float(effective_radius(X)[0]) ** 3
    inner = ImplicitStepper(1.0, 1.0, lambda Y, t: np.stack([rate * Y[:, 1], 0 * Y[:, 1]], axis=1))
    stepper, state = Corrected(Extrapolated(inner), CORRECTIONS, area(X), length(X)), State(0.0, X)
    for _ in range(300):
        state = stepper.step(state, 0.04 / rate).state
    assert float(inclination(state.X)[0]) == pytest.approx(angle, abs=1e-3)


def test_relaxation_reaches_the_equilibrium_energy():
    X = perturbed(64, 0.65, seed=0)[None]
    stepper, state = Corrected(ImplicitStepper(1.0, 1.0), CORRECTIONS, area(X), length(X)), State(0.0, X)
    energies = [float(bending_energy(X)[0])]
    for dt, steps in ((1e-5, 100), (2e-4, 400)):
        for _ in range(steps):
            state = stepper.step(state, dt).state
            energies.append(float(bending_energy(state.X)[0]))
    assert energies[-1] == pytest.approx(42.8572, abs=1e-4)
    assert max(np.diff(energies)) < 1e-7
    assert energies[0] > 60.0
