"""Pairs of vesicles and split steppers that several test files take."""

from functools import cache

import numpy as np
import torch

from biem.backend import counting, to_numpy
from biem.curves.curve import effective_radius
from biem.curves.shapes import ellipse, equilibrium, place
from biem.membrane.maps import ExactMaps
from biem.steppers.split import SplitStepper
from biem.steppers.stepper import State
from biem.stokes.interaction import Fields

FIELDS = Fields(near_tolerance=1e-10, far_field="direct")


def two(one, distance, offset, angle=0.0):
    """Two vesicles (2, 2, N), the first at (-distance R, offset R), the other at the origin, turned."""
    R = float(effective_radius(one[None])[0])
    return np.stack([place(one, np.array([-distance * R, offset * R]), 0.0), place(one, np.zeros(2), angle)])


def mild(N):
    return two(ellipse(N, 0.9), 3.0, 0.4)


def close(N):
    """Biconcave shapes 0.15 R apart."""
    return two(equilibrium(N, 0.65), 2.3, 0.3, np.pi / 2)


def linear_flow(gradient):
    def velocity(X, t):
        x, y = X[:, 0], X[:, 1]
        (a, b), (c, d) = gradient
        return (torch if isinstance(X, torch.Tensor) else np).stack([a * x + b * y, c * x + d * y], 1)

    return velocity


def shear_of(X, capillary=5.0):
    return capillary / float(effective_radius(X)[0]) ** 3


def in_shear(X, **options):
    """The stepper in shear of capillary number 5, and t_gamma."""
    rate = shear_of(X)
    return SplitStepper(ExactMaps(), 1.0, 1.0, linear_flow([[0.0, rate], [0.0, 0.0]]), FIELDS, **options), 1.0 / rate


def march(stepper, state, dt, steps):
    for _ in range(steps):
        state = stepper.step(state, dt).state
    return state


@cache
def developed(make, N):
    """The state after 1 t_gamma, by small steps."""
    X = make(N)
    stepper, t_gamma = in_shear(X)
    return march(stepper, State(0.0, X), 0.0125 * t_gamma, 80)


def relative(a, b):
    a, b = to_numpy(a), to_numpy(b)
    return np.abs(a - b).max() / np.abs(b).max()


def counted(stepper, state, dt=1e-6):
    with counting() as counts:
        result = stepper.step(state, dt)
    return counts, result.state
