"""Operators of one vesicle: identities, analytic values, symmetry, accuracy against more nodes."""

import numpy as np
import pytest

from biem.backend import counting
from biem.curves.curve import area, bending_energy, length, normal, tangent
from biem.curves.fourier import resample
from biem.curves.shapes import equilibrium, perturbed
from biem.membrane.maps import ExactMaps
from biem.membrane.operators import VesicleOperators, bending_force, membrane_force, surface_divergence, tension_force


def some_shapes(points, count=3, **options):
    return np.stack([perturbed(512, 0.65, seed=seed, **options)[:, :: 512 // points] for seed in range(count)])


def stacked(u):
    return u.reshape(u.shape[0], -1, 1)


def test_projection_is_a_projection_and_keeps_length():
    ops = VesicleOperators(some_shapes(128))
    one_minus_M = np.eye(256) - ops.M
    assert np.abs(one_minus_M @ one_minus_M - one_minus_M).max() < 1e-13
    u = np.random.default_rng(0).normal(size=(3, 2, 16))
    assert np.abs(ops.P @ one_minus_M @ stacked(resample(u, 128))).max() < 1e-11


def test_surface_divergence_of_rigid_motions_is_zero():
    X = some_shapes(64)
    spin = np.stack([-X[:, 1], X[:, 0]], axis=1)
    assert np.abs(surface_divergence(X, spin + 3.0)).max() < 1e-11
    assert np.abs(surface_divergence(X, X) - 1.0).max() < 1e-11  # growth: |X_s|^2


def test_force_on_a_circle():
    """Radius a: X_ssss = n/a^3, (sigma X_s)_s = -sigma n/a."""
    a, N = 0.3, 64
    t = 2 * np.pi * np.arange(N) / N
    X = a * np.stack([np.cos(t), np.sin(t)])[None]
    sigma = np.full((1, N), 2.0)
    assert np.allclose(bending_force(X, 1.7), -1.7 * normal(X) / a**3, atol=1e-8)
    assert np.allclose(tension_force(X, sigma), -2.0 * normal(X) / a, atol=1e-11)


def test_force_is_force_and_torque_free():
    X = some_shapes(128)
    sigma = np.cos(2 * np.pi * np.arange(128) / 128)[None] + np.zeros((3, 1))
    ops = VesicleOperators(X)
    fds = membrane_force(X, sigma, 1.0) * ops.speed[:, None, :]
    torque = X[:, 0] * fds[:, 1] - X[:, 1] * fds[:, 0]
    scale = np.abs(fds).max()
    assert np.abs(fds.mean(axis=-1)).max() < 1e-8 * scale
    assert np.abs(torque.mean(axis=-1)).max() < 1e-8 * scale


def test_bending_force_is_minus_the_gradient_of_the_energy_at_fixed_length():
    """d/de E(X + e V) for an inextensible V equals -int f . V ds."""
    X = perturbed(128, 0.7, seed=1, modes=4)[None]
    ops = VesicleOperators(X)
    u = np.stack([np.sin(3 * X[:, 1]), np.cos(2 * X[:, 0])], axis=1) * 0.1
    V = ((np.eye(256) - ops.M) @ stacked(u)).reshape(1, 2, 128)
    e = 1e-5
    slope = (bending_energy(X + e * V)[0] - bending_energy(X - e * V)[0]) / (2 * e)
    work = (bending_force(X) * V).sum(axis=1) @ (ops.speed[0] * 2 * np.pi / 128)
    assert slope == pytest.approx(-work[0], rel=1e-6)


def test_full_matrices_agree_with_what_they_stand_for():
    X = some_shapes(64)
    ops = VesicleOperators(X, kappa_b=2.0, mu=3.0)
    assert np.allclose((ops.B @ stacked(X)).reshape(X.shape), ops.bending_velocity(), rtol=0, atol=1e-7)
    sigma = np.sin(2 * np.pi * np.arange(64) / 64)[None] + np.zeros((3, 1))
    by_force = ops.S @ stacked(tension_force(X, sigma))
    assert np.allclose(ops.T @ sigma[..., None], by_force, atol=1e-12)
    assert np.allclose(ops.P @ by_force, surface_divergence(X, by_force.reshape(X.shape))[..., None], atol=1e-9)
    assert np.allclose(ops.L, ops.P @ ops.T, atol=1e-12)


def test_viscosity_and_stiffness_scale():
    X = some_shapes(32, 1)
    one, other = VesicleOperators(X), VesicleOperators(X, kappa_b=2.0, mu=4.0)
    assert np.allclose(other.S, one.S / 4)
    assert np.allclose(other.B, one.B / 2)
    assert np.allclose(other.M, one.M)


def test_tension_matrix_is_symmetric_and_well_conditioned():
    for points, bound in ((64, 300), (128, 600)):
        ops = VesicleOperators(equilibrium(points, 0.65)[None])
        L = ops.L[0]
        assert np.abs(L - L.T).max() < 2e-3 * np.abs(L).max()
        assert np.linalg.eigvalsh(0.5 * (L + L.T)).max() < 0.0  # negative definite: tension takes energy
        assert np.linalg.cond(L) < bound


def test_operators_rotate_with_the_curve():
    X = some_shapes(32, 1)
    c, s = np.cos(0.7), np.sin(0.7)
    Q = np.array([[c, -s], [s, c]])
    u = tangent(X) * np.cos(X[:, :1])
    maps = ExactMaps()
    assert np.allclose(maps.advect(Q @ X, Q @ u), Q @ maps.advect(X, u), atol=1e-12)
    assert np.allclose(maps.self_tension(Q @ X), maps.self_tension(X), rtol=1e-9)
    assert np.allclose(maps.relax(Q @ X + 7.0, 1e-5), Q @ maps.relax(X, 1e-5) + 7.0, atol=1e-12)


def test_only_what_is_asked_for_is_built():
    X = some_shapes(32)
    with counting() as counts:
        ExactMaps().flow_tension(X, X)
    assert counts == {"single_layer_matrix": 3, "tension_matrix": 3}


def test_operators_converge_with_the_nodes():
    """Halving h gains many digits: (1 - M) e^{2ia} and self-tension against 256 nodes."""
    X = some_shapes(512, 2, modes=5)
    errors = []
    want = ExactMaps(points=256).self_tension(X[..., ::2])
    for N in (32, 64, 128):
        got = ExactMaps(points=N).self_tension(X[..., :: 512 // N])
        errors.append(np.abs(got - want[:, :: 256 // N]).max() / np.abs(want).max())
    assert errors[1] < 1e-2 * errors[0]
    assert errors[2] < 1e-3 * errors[1]
    assert errors[2] < 1e-8


def test_reduced_inputs_are_not_changed():
    X = some_shapes(32)
    before = X.copy()
    ExactMaps().relax(X, 1e-5)
    assert np.array_equal(X, before)
    assert np.all(area(X) > 0)
    assert np.allclose(length(X), 1.0, atol=1e-2)
