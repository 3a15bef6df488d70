"""Double layer close to its curve: against the trapezoid rule on many nodes, its jumps, and between array code and compiled loop."""

import numpy as np
import pytest
import torch
from helpers import FEET, blob, blob_density, blob_derivative, blob_normal, circle, nodes, standing_off

from biem.stokes import cauchy
from biem.stokes.cauchy import Curve
from biem.stokes.kernels import double_layer


def blob_curve(N, inside):
    X = blob(nodes(N))
    return Curve(X, inside), blob_density(nodes(N))


def by_trapezoid(x, n=40_000):
    """D[blob, density] at x (P, 2) no closer than 1e-3 lengths."""
    t = nodes(n)
    r = x[:, :, None] - blob(t)
    D_xx, D_xy, D_yy = double_layer(r[:, 0], r[:, 1], *blob_normal(t))
    g = blob_density(t) * np.hypot(*blob_derivative(t)) * 2 * np.pi / n
    return np.stack([(D_xx * g[0] + D_xy * g[1]).sum(-1), (D_xy * g[0] + D_yy * g[1]).sum(-1)], axis=-1)


@pytest.mark.parametrize("inside", [True, False])
@pytest.mark.parametrize("distance", [1e-3, 5e-3, 2e-2, 0.08])
def test_velocity_is_exact_at_any_distance(inside, distance):
    x = standing_off(-distance if inside else distance)
    curve, tau = blob_curve(256, inside)
    assert np.abs(curve.velocity(x, tau) - by_trapezoid(x)).max() < 3e-13


@pytest.mark.parametrize("inside", [True, False])
def test_velocity_converges_spectrally_next_to_the_curve(inside):
    x = standing_off(-1e-3 if inside else 1e-3)
    exact = by_trapezoid(x)
    errors = [np.abs(curve.velocity(x, tau) - exact).max() for curve, tau in (blob_curve(N, inside) for N in (32, 64, 128))]
    assert errors[1] < 1e-2 * errors[0]
    assert errors[2] < 1e-4 * errors[1]


def test_velocity_jumps_by_the_density_across_the_curve():
    inner, tau = blob_curve(128, True)
    outer, _ = blob_curve(128, False)
    jump = outer.velocity(standing_off(1e-9), tau) - inner.velocity(standing_off(-1e-9), tau)
    assert np.abs(jump - blob_density(FEET).T).max() < 1e-6


def test_constant_density_gives_minus_itself_inside_and_nothing_outside():
    X = circle(48, 0.7, (2.0, -1.0))
    tau = np.full((2, 48), 1.0) * np.array([[0.3], [-2.0]])
    ring = np.stack([np.cos(FEET), np.sin(FEET)], axis=1)
    center = np.array([2.0, -1.0])
    for radius in (0.1, 0.5, 0.7 - 1e-6):
        assert np.abs(Curve(X, True).velocity(center + radius * ring, tau) - [-0.3, 2.0]).max() < 1e-11
    for radius in (0.7 + 1e-6, 0.8, 5.0):
        assert np.abs(Curve(X, False).velocity(center + radius * ring, tau)).max() < 1e-11


@pytest.mark.parametrize("inside", [True, False])
def test_array_code_equals_compiled_loop(inside, monkeypatch):
    curve, tau = blob_curve(64, inside)
    sign = -1 if inside else 1
    x = np.concatenate([standing_off(sign * d) for d in (1e-4, 0.02, 0.1)])
    by_loop = curve.velocity(x, tau)
    monkeypatch.setattr(cauchy, "on_cpu", lambda a: False)
    monkeypatch.setattr(cauchy, "CHUNK", 1000)
    by_arrays = [curve.velocity(x, tau), curve.velocity(torch.as_tensor(x), tau).numpy()]
    for u in by_arrays:
        assert np.abs(u - by_loop).max() < 1e-12
