"""Far sums of pressure and stress: against the kernels, Ewald's against the direct one, curves that are skipped, periodic images."""

import numpy as np
import pytest
from helpers import crowd, nodes

from biem.curves.curve import normal
from biem.curves.fourier import derivative
from biem.curves.lattice import Lattice
from biem.stokes.farfield_stress import DirectStress, EwaldStress, PeriodicStress, stress_sum
from biem.stokes.kernels import double_layer, pressure_of_double_layer, pressure_of_force, stress_of_force
from biem.stokes.stress_loop import double_velocity

MU, N = 1.3, 32
NOTHING = np.zeros(0, dtype=np.int64)


def case(P=300, M=12):
    """Targets (P, 2), curves and complex strengths (M, 2, N), (M, N), scattered over a long box; no target is close to a node."""
    rng = np.random.default_rng(0)
    X = np.concatenate([crowd(N)] * (M // 4)) + rng.uniform([0, 0], [6, 2], (M, 2))[:, :, None]
    x = rng.uniform([-0.5, -0.5], [6.5, 2.5], (4 * P, 2))
    far = np.abs(x[:, None] - X.transpose(0, 2, 1).reshape(1, -1, 2)).max(-1).min(1) > 0.02
    q = rng.standard_normal((M, N)) + 1j * rng.standard_normal((M, N))
    return x[far][:P], X, q


def skips(P, M):
    """The first targets skip one curve, later ones two or none."""
    chosen = [[p % M] if p < P // 3 else [1, 4] if p < P // 2 else [] for p in range(P)]
    return np.cumsum([0, *(len(c) for c in chosen)]), np.array([m for c in chosen for m in c], dtype=np.int64)


def none(P):
    return np.zeros(P + 1, dtype=np.int64), NOTHING


def test_direct_sum_is_the_sum_of_the_kernels():
    x, X, q = case()
    phi, D = DirectStress(x, X, *none(len(x))).evaluate(q)
    f = 4 * np.pi * np.stack([q.real, q.imag]).reshape(2, -1)
    r = x[:, :, None] - X.transpose(1, 0, 2).reshape(2, -1)
    px, py = pressure_of_force(r[:, 0], r[:, 1])
    s = stress_of_force(r, np.broadcast_to(f, r.shape)).sum(-1)
    assert np.abs(2 * phi.real - (px * f[0] + py * f[1]).sum(-1)).max() < 1e-11
    assert np.abs(D - (0.5 * (s[:, 0, 0] - s[:, 1, 1]) - 1j * s[:, 0, 1])).max() < 1e-11


def test_with_the_other_sign_it_is_a_double_layer():
    x, X, _ = case()
    tau = np.stack([np.cos(2 * nodes(N)) + 0.3, np.sin(nodes(N))])
    slope = derivative(tau)
    q = np.broadcast_to(1j * MU * (slope[0] + 1j * slope[1]) / N, (len(X), N))
    phi, _ = DirectStress(x, X, *none(len(x))).evaluate(q, -1.0)
    g = np.broadcast_to(tau, X.shape) * np.hypot(*derivative(X).transpose(1, 0, 2))[:, None] * 2 * np.pi / N
    flat = [a.transpose(1, 0, 2).reshape(2, -1) for a in (X, normal(X), g)]
    r = x[:, :, None] - flat[0]
    px, py = pressure_of_double_layer(r[:, 0], r[:, 1], flat[1][0], flat[1][1], MU)
    far = np.abs(r).max(1).min(1) > 0.15  # the trapezoid rule has converged there
    p = (px * flat[2][0] + py * flat[2][1]).sum(-1)
    assert far.sum() > 30
    assert np.abs(2 * phi.real - p)[far].max() < 1e-4 * np.abs(p).max()

    xx, xy, yy = double_layer(r[:, 0], r[:, 1], flat[1][0], flat[1][1])
    u = np.stack([xx * flat[2][0] + xy * flat[2][1], xy * flat[2][0] + yy * flat[2][1]], axis=1).sum(-1)
    assert np.abs(double_velocity(x, X, normal(X), g, *none(len(x))) - u).max() < 1e-12


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("tolerance", [1e-4, 1e-6, 1e-9])
def test_ewald_sum_is_the_direct_one(tolerance, sign):
    x, X, q = case()
    which = skips(len(x), len(X))
    exact, ewald = DirectStress(x, X, *which).evaluate(q, sign), EwaldStress(x, X, *which, tolerance).evaluate(q, sign)
    for a, b in zip(exact, ewald, strict=True):
        assert np.abs(a - b).max() < tolerance * np.abs(a).max()


def test_skipped_curves_are_left_out_also_where_the_target_is_on_them():
    x, X, q = case(P=40)
    x = np.concatenate([x, X[3, :, :5].T])
    first = np.append(np.zeros(len(x) - 4, dtype=np.int64), np.arange(1, 6))
    skip = np.full(5, 3)
    for far in (DirectStress(x, X, first, skip), EwaldStress(x, X, first, skip, 1e-9)):
        phi, D = far.evaluate(q)
        without = DirectStress(x[-5:], np.delete(X, 3, axis=0), *none(5)).evaluate(np.delete(q, 3, axis=0))
        assert np.abs(phi[-5:] - without[0]).max() < 1e-8 * np.abs(phi).max()
        assert np.abs(D[-5:] - without[1]).max() < 1e-8 * np.abs(D).max()


def test_auto_takes_ewald_where_it_pays():
    rng = np.random.default_rng(1)
    x, X, _ = case()
    assert isinstance(stress_sum(x, X, *none(len(x)), "auto", 1e-6), DirectStress)
    X = np.concatenate([X + shift for shift in rng.uniform(0, 20, (20, 2, 1))])
    x = rng.uniform(0, 20, (50_000, 2))
    assert isinstance(stress_sum(x, X, *none(len(x)), "auto", 1e-6), EwaldStress)
    assert isinstance(stress_sum(x, X, *none(len(x)), "direct", 1e-6), DirectStress)


def periodic(lattice, x, X, q, cutoff):
    curves, source = lattice.with_images(X, 2.0 * cutoff + lattice.width + lattice.height)
    return PeriodicStress(lattice.wrapped(x), curves, source, *none(len(x)), lattice, 1e-8, cutoff).evaluate(q)


@pytest.mark.parametrize("offset", [0.0, 0.7])
def test_periodic_sum_does_not_depend_on_the_cutoff_and_repeats(offset):
    lattice = Lattice(2.0, 1.5, offset)
    X = 0.3 * crowd(N)[:2] + np.array([[[0.2], [-0.3]], [[-0.5], [0.4]]])
    rng = np.random.default_rng(2)
    q = rng.standard_normal((2, N)) + 1j * rng.standard_normal((2, N))
    q -= q.mean()  # forces add up to zero
    x = rng.uniform([-1, -0.75], [1, 0.75], (60, 2))
    one, other = (periodic(lattice, x, X, q, cutoff) for cutoff in (0.3, 0.6))
    for a, b in zip(one, other, strict=True):
        assert np.abs(a - b).max() < 1e-6 * np.abs(a).max()
    images = x + np.array([1.0, -2.0]) @ lattice.vectors
    for a, b in zip(one, periodic(lattice, images, X, q, 0.3), strict=True):
        assert np.abs(a - b).max() < 1e-9 * np.abs(a).max()


def test_periodic_sum_is_that_of_all_images():
    """Of forces without moments up to the second in curves far apart, so that the sum over images converges."""
    lattice = Lattice(1.0, 1.0)
    y = 0.05 * np.array([[-1.5, -0.5, 0.5, 1.5], [0.0, 0.0, 0.0, 0.0]])[None]
    q = np.array([[1.0, -3.0, 3.0, -1.0]]) * (0.6 - 0.8j)
    x = np.random.default_rng(3).uniform(-0.5, 0.5, (40, 2))
    x = x[np.hypot(*(x - [0.0, 0.0]).T) > 0.2]
    phi, D = periodic(lattice, x, y, q, 0.4)
    reach = np.arange(-20, 21)
    images = np.stack(np.meshgrid(reach, reach), axis=-1).reshape(-1, 2)
    all_of_them = (y + images[:, :, None]).reshape(len(images), 2, -1)
    exact = DirectStress(x, all_of_them, *none(len(x))).evaluate(np.repeat(q, len(images), axis=0))
    assert np.abs(phi - exact[0]).max() < 1e-4 * np.abs(phi).max()
    assert np.abs(D - exact[1]).max() < 1e-4 * np.abs(D).max()
