"""NumPy and PyTorch (float64, CPU) give the same answers from the same source."""

import numpy as np
import pytest
import torch

from biem.curves.conserve import restore_area_length
from biem.curves.curve import area, bending_energy, centroid, curvature, inclination, length
from biem.curves.reparam import redistribute
from biem.curves.shapes import equilibrium, perturbed, place
from biem.membrane.maps import ExactMaps
from biem.steppers.corrections import CORRECTIONS, Corrected
from biem.steppers.implicit import ImplicitStepper
from biem.steppers.stepper import State
from biem.stokes.single_layer import single_layer


@pytest.fixture(autouse=True)
def two_threads():
    """The batched LU of torch's CPU build is wrong with two threads: nothing here may reach it."""
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    yield
    torch.set_num_threads(before)


def shapes(points=32):
    return np.stack([perturbed(points, 0.65, seed=seed) for seed in range(3)]) + 0.3


def close(a, b, tolerance):
    a, b = np.asarray(a), np.asarray(b)
    return np.abs(a - b).max() <= tolerance * np.abs(b).max()


@pytest.mark.parametrize("function", [area, length, centroid, curvature, inclination, bending_energy])
def test_geometry(function):
    X = shapes()
    assert close(function(torch.from_numpy(X)), function(X), 1e-11)


def test_corrections():
    X = shapes()
    T = torch.from_numpy(X)
    assert close(redistribute(T * 1.01)[0], redistribute(X * 1.01)[0], 1e-12)
    a, b = restore_area_length(T * 1.001, area(T), length(T))[0], restore_area_length(X * 1.001, area(X), length(X))[0]
    assert close(a, b, 1e-12)


@pytest.mark.parametrize("points", [32, 96])
def test_exact_maps(points):
    X = shapes(points)
    T, maps = torch.from_numpy(X), ExactMaps(kappa_b=1.3, mu=0.7)
    u, v = np.cos(5 * X), torch.cos(5 * T)
    assert close(maps.advect(T, v), maps.advect(X, u), 1e-11)
    assert close(maps.relax(T, 1e-5) - T, maps.relax(X, 1e-5) - X, 1e-7)
    assert close(maps.self_tension(T), maps.self_tension(X), 1e-8)
    assert close(maps.flow_tension(T, v), maps.flow_tension(X, u), 1e-10)
    assert close(maps.near_layers(T, v), maps.near_layers(X, u), 1e-11)


@pytest.mark.parametrize("near_field", ["upsample", "ying_zorin", "none"])
def test_single_layer(near_field):
    X = shapes()[:1]
    f = np.sin(7 * X)
    rng = np.random.default_rng(0)
    targets = X[0].T[rng.integers(0, 32, 60)] + rng.normal(scale=0.02, size=(60, 2))
    T = torch.from_numpy
    a, b = single_layer(T(X), T(f), T(targets), near_field=near_field), single_layer(X, f, targets, near_field=near_field)
    assert close(a, b, 1e-11)


def test_implicit_step():
    one = equilibrium(32, 0.65)
    X = np.stack([place(one, np.array([-0.3, 0.04]), 0.0), place(one, np.zeros(2), np.pi / 2)])

    def step(X, stack):
        flow = lambda Y, t: stack([2000.0 * Y[:, 1], 0.0 * Y[:, 1]], 1)
        stepper = Corrected(ImplicitStepper(1.0, 1.0, flow), CORRECTIONS, area(X), length(X))
        return stepper.step(State(0.0, X), 1e-5).state

    a, b = step(torch.from_numpy(X), torch.stack), step(X, np.stack)
    assert close(a.X, b.X, 1e-11)
    assert close(a.sigma, b.sigma, 1e-7)


def test_float32_stays_float32():
    X = torch.from_numpy(shapes()).float()
    maps = ExactMaps()
    assert maps.advect(X, torch.cos(X)).dtype == torch.float32
    assert close(maps.advect(X, torch.cos(X)), maps.advect(X.double(), torch.cos(X.double())), 1e-3)
