"""Double layers of many curves: at any distance, on either side, on the curve itself, of curves that are thin; loops against array code."""

import numpy as np
import pytest
import torch
from helpers import FEET, blob, blob_case, blob_density, blob_derivative, blob_normal, circle, dumbbell, nodes, rotate, standing_off

from biem.backend import counting
from biem.curves.curve import arclength_weights, normal
from biem.curves.fourier import resample
from biem.curves.shapes import equilibrium
from biem.stokes import cauchy, double_layers
from biem.stokes.double_layers import DoubleLayers, double_layer, own_matrix
from biem.stokes.kernels import double_layer as kernel
from biem.stokes.near_search import find_near


def by_trapezoid(x, X, q, n=20_000):
    """D of one curve X (2, N) at x (P, 2) with the trapezoid rule on n nodes of its interpolant."""
    Y, g = resample(X, n), resample(q, n)
    outward = normal(Y[None])[0]
    ds = arclength_weights(Y[None])[0]
    r = x[:, :, None] - Y
    D = kernel(r[:, 0], r[:, 1], *outward)
    return np.stack([((D[0] * g[0] + D[1] * g[1]) * ds).sum(-1), ((D[1] * g[0] + D[2] * g[1]) * ds).sum(-1)], axis=-1)


def of_blob(x, n=40_000):
    """D[blob, density] at x (P, 2) no closer than 1e-3 lengths."""
    t = nodes(n)
    r = x[:, :, None] - blob(t)
    D = kernel(r[:, 0], r[:, 1], *blob_normal(t))
    g = blob_density(t) * np.hypot(*blob_derivative(t)) * 2 * np.pi / n
    return np.stack([(D[0] * g[0] + D[1] * g[1]).sum(-1), (D[1] * g[0] + D[2] * g[1]).sum(-1)], axis=-1)


@pytest.mark.parametrize("distance", [1e-3, 5e-3, 2e-2, 0.08, -1e-3, -2e-2])
def test_velocity_near_and_far_inside_and_outside(distance):
    x = standing_off(distance)
    X, q = blob_case(48)
    assert np.abs(double_layer(X[None], q[None], x, 1e-8) - of_blob(x)).max() < 1e-7


def test_several_curves_add_up_and_one_is_skipped():
    X, q = blob_case(64)
    X = np.stack([X, rotate(X, 1.0) + np.array([[0.5], [0.1]])])
    q = np.stack([q, np.roll(q, 5, axis=1)])
    x = np.concatenate([standing_off(0.01), standing_off(0.4)])
    alone = [double_layer(X[[m]], q[[m]], x) for m in range(2)]
    assert np.abs(double_layer(X, q, x) - sum(alone)).max() < 1e-14
    skip = np.where(np.arange(len(x)) % 2 == 0, 1, -1)
    both = double_layer(X, q, x, exclude=skip)
    assert np.abs(both - np.where(skip[:, None] == 1, alone[0], sum(alone))).max() < 1e-14


def test_constant_density_gives_minus_itself_inside_half_on_and_nothing_outside():
    X = np.stack([circle(96, 0.7, (2.0, -1.0)), dumbbell(96, 0.3)])
    q = np.ones((2, 2, 96)) * np.array([0.3, -2.0])[:, None]
    ring = np.stack([np.cos(FEET), np.sin(FEET)], axis=1)
    for radius, inside in ((0.1, True), (0.7 - 1e-6, True), (0.7 + 1e-6, False), (0.8, False)):
        u = double_layer(X[:1], q[:1], np.array([2.0, -1.0]) + radius * ring)
        assert np.abs(u - (np.array([-0.3, 2.0]) if inside else 0.0)).max() < 1e-9
    on = own_matrix(X) @ q.reshape(2, -1, 1)
    assert np.abs(on[..., 0] + 0.5 * q.reshape(2, -1)).max() < 1e-6


def test_on_the_curve_rigid_motions_and_the_mean_of_both_sides():
    X, q = blob_case(96)
    D = own_matrix(X[None])[0]
    for motion in ([1 + 0 * X[0], 0 * X[0]], [-X[1], X[0]]):
        assert np.abs(D @ np.concatenate(motion) + 0.5 * np.concatenate(motion)).max() < 1e-11
    n = normal(X[None])[0]
    sides = [double_layer(X[None], q[None], (X + d * n).T, 1e-10) for d in (1e-9, -1e-9)]
    assert np.abs((D @ q.ravel()).reshape(2, -1).T - 0.5 * (sides[0] + sides[1])).max() < 1e-7
    assert np.abs(sides[0] - sides[1] - q.T).max() < 1e-7


def test_on_the_curve_it_converges_spectrally():
    exact = (own_matrix(blob_case(256)[0][None])[0] @ blob_case(256)[1].ravel()).reshape(2, -1)
    errors = []
    for N in (16, 32, 64):
        X, q = blob_case(N)
        errors.append(np.abs((own_matrix(X[None])[0] @ q.ravel()).reshape(2, -1) - exact[:, :: 256 // N]).max())
    assert errors[1] < 0.1 * errors[0]
    assert errors[2] < 1e-3 * errors[1]


@pytest.mark.parametrize("distance", [2e-3, 2e-2, 0.05])
def test_thin_vesicles_take_no_more_nodes(distance):
    """Two lobes 0.03 lengths thick where they meet: no point is far inside, and none is needed."""
    X = equilibrium(64, 0.5)
    t = nodes(64)
    q = np.stack([np.cos(2 * t + 0.4) + 0.3, np.sin(t) - 0.5 * np.cos(3 * t)])
    fine = resample(X, 128)
    x = (fine + distance * normal(fine[None])[0])[:, 1::6].T
    exact = by_trapezoid(x, X, q)
    assert np.abs(cauchy.Curve(X, False).velocity(x, q) - exact).max() < 1e-7
    assert np.abs(double_layer(X[None], q[None], x, 1e-10) - exact).max() < 1e-10


def test_array_code_equals_the_compiled_loops(monkeypatch):
    X, q = blob_case(32)
    X = np.stack([X, rotate(X, 1.0) + np.array([[0.5], [0.1]])])
    q = np.stack([q, np.roll(q, 5, axis=1)])
    x = np.concatenate([standing_off(d) for d in (0.3, 0.01, -0.01, 1e-4)])
    skip = np.arange(len(x)) % 3 - 1
    pairs = find_near(X, x, 3.0, skip)
    by_loop = DoubleLayers.build(X, x, pairs, skip).velocity(q)
    for module in (cauchy, double_layers):
        monkeypatch.setattr(module, "on_cpu", lambda a: False)
        monkeypatch.setattr(module, "CHUNK", 3000)
    here = torch.from_numpy
    by_arrays = DoubleLayers.build(X, x, pairs, skip).velocity(q)
    on_tensors = DoubleLayers.build(here(X), here(x), pairs, here(skip)).velocity(here(q))
    assert np.abs(by_arrays - by_loop).max() < 1e-12
    assert np.abs(on_tensors.numpy() - by_loop).max() < 1e-12


def test_single_precision_densities_lose_nothing_to_the_sum():
    X, q = blob_case(32)
    x = standing_off(1e-3) + np.array([3.0, 0.0])
    moved = X + np.array([[3.0], [0.0]])
    u = double_layer(moved[None], q[None].astype(np.float32), x)
    assert u.dtype == np.float32
    assert np.abs(u - double_layer(moved[None], q[None], x)).max() < 1e-6


def test_work_is_counted_and_shapes_are_checked():
    X, q = blob_case(32)
    with counting() as counts:
        double_layer(X[None], q[None], standing_off(0.01))
        own_matrix(np.stack([X, X]))
    assert (counts["double_layers"], counts["double_layer_sum"], counts["double_layer_matrix"]) == (1, 1, 2)
    assert counts["near_double_layers"] == len(FEET)
    with pytest.raises(ValueError, match=r"got X \(2, 32\)"):
        double_layer(X, q, standing_off(0.01))
