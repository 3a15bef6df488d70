"""The kernels solve the Stokes equations: derivatives by autograd, and their surface integrals by Gauss's theorem."""

import numpy as np
import pytest
import torch
from helpers import blob, blob_derivative, blob_normal, circle, nodes

from biem.stokes.kernels import (
    double_layer,
    pressure_of_double_layer,
    pressure_of_force,
    stokeslet,
    stokeslet_prefactor,
    stress_of_force,
)

MU = 2.5
FORCE = torch.tensor([0.7, -1.3], dtype=torch.float64)


def separations():
    """(20, 2): distances 0.2 to 5 in all directions."""
    rng = np.random.default_rng(0)
    angle, radius = rng.uniform(0, 2 * np.pi, 20), np.geomspace(0.2, 5, 20)
    r = torch.from_numpy(np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1))
    return r.requires_grad_()


def flow_of_force(r):
    gxx, gxy, gyy = stokeslet(r[:, 0], r[:, 1], MU)
    px, py = pressure_of_force(r[:, 0], r[:, 1])
    return torch.stack([gxx * FORCE[0] + gxy * FORCE[1], gxy * FORCE[0] + gyy * FORCE[1]], dim=1), px * FORCE[0] + py * FORCE[1]


def flow_of_double_layer(r):
    n = torch.tensor([0.6, 0.8], dtype=torch.float64).expand(r.shape)
    dxx, dxy, dyy = double_layer(r[:, 0], r[:, 1], n[:, 0], n[:, 1])
    px, py = pressure_of_double_layer(r[:, 0], r[:, 1], n[:, 0], n[:, 1], MU)
    return torch.stack([dxx * FORCE[0] + dxy * FORCE[1], dxy * FORCE[0] + dyy * FORCE[1]], dim=1), px * FORCE[0] + py * FORCE[1]


def gradient(f, r):
    """(20, 2) of a scalar f (20,), itself differentiable."""
    return torch.autograd.grad(f.sum(), r, create_graph=True)[0]


def velocity_gradient(u, r):
    """[p, i, k] = du_i/dx_k."""
    return torch.stack([gradient(u[:, 0], r), gradient(u[:, 1], r)], dim=1)


@pytest.mark.parametrize("flow", [flow_of_force, flow_of_double_layer])
def test_flows_are_divergence_free_and_satisfy_stokes(flow):
    r = separations()
    u, p = flow(r)
    du, dp = velocity_gradient(u, r), gradient(p, r)
    laplacian = torch.stack([sum(gradient(du[:, i, k], r)[:, k] for k in (0, 1)) for i in (0, 1)], dim=1)
    du, dp, laplacian = du.detach(), dp.detach(), laplacian.detach()
    assert float((du[:, 0, 0] + du[:, 1, 1]).abs().max() / du.abs().max()) < 1e-14
    assert float(((MU * laplacian - dp).norm(dim=1) / dp.norm(dim=1)).max()) < 1e-12
    assert float(dp.norm(dim=1).min()) > 1e-4  # both sides are there


def test_stress_is_minus_pressure_plus_twice_mu_times_the_rate_of_strain():
    r = separations()
    u, p = flow_of_force(r)
    du = velocity_gradient(u, r)
    stress = -p[:, None, None] * torch.eye(2) + MU * (du + du.transpose(1, 2))
    kernel = stress_of_force(r.T, FORCE[:, None].expand(2, 20)).permute(2, 0, 1)
    error = (kernel - stress).detach().abs().amax((1, 2)) / stress.detach().abs().amax((1, 2))
    assert float(error.max()) < 1e-13


def test_double_layer_is_the_stress_kernel_with_the_normal_at_the_source():
    """D_ij = T_ijk n_k with r = y - x: Lorentz's reciprocal theorem."""
    r = separations().detach().numpy().T
    n = np.broadcast_to([[0.6], [0.8]], r.shape)
    dxx, dxy, dyy = double_layer(*r, *n)
    for f, column in (([1.0, 0.0], (dxx, dxy)), ([0.0, 1.0], (dxy, dyy))):
        T = stress_of_force(-r, np.broadcast_to(np.array(f)[:, None], r.shape))
        assert np.abs((T * n[None]).sum(axis=1) - np.stack(column)).max() < 1e-14


@pytest.mark.parametrize("center", [(0.0, 0.0), (0.2, -0.3), (3.0, 0.0)])
def test_traction_on_a_circle_balances_the_force_inside_it(center):
    N = 128
    n = circle(N)
    r = n - np.asarray(center)[:, None]
    T = stress_of_force(r, np.broadcast_to(FORCE.numpy()[:, None], r.shape))
    total = (T * n[None]).sum(axis=(1, 2)) * 2 * np.pi / N
    assert np.abs(total + FORCE.numpy() * (np.hypot(*center) < 1)).max() < 1e-12


def test_stokeslet_symmetry_homogeneity_and_prefactor():
    x, y = separations().detach().numpy().T
    G = np.stack(stokeslet(x, y, MU))
    assert stokeslet_prefactor(MU) == pytest.approx(1 / (4 * np.pi * MU), rel=1e-15)
    assert np.abs(np.stack(stokeslet(-x, -y, MU)) - G).max() < 1e-16
    shrunk = np.stack(stokeslet(x / 10, y / 10, MU))
    assert np.abs(shrunk - G - np.log(10) / (4 * np.pi * MU) * np.array([[1], [0], [1]])).max() < 1e-14
    assert np.stack(stokeslet(x, y, 1.0)) == pytest.approx(MU * G, rel=1e-14)
    assert stokeslet(np.array([1.0]), np.array([0.0]), 1.0) == (pytest.approx(1 / (4 * np.pi)), 0.0, 0.0)


def constant_double_layer(x, q, N=512):
    """Velocity (P, 2) and pressure (P,) at points x (P, 2) of a constant density on the blob by the trapezoid rule."""
    t = nodes(N)
    ds = np.hypot(*blob_derivative(t)) * 2 * np.pi / N
    r = x[:, :, None] - blob(t)
    nx, ny = np.broadcast_to(blob_normal(t)[:, None], (2, len(x), N))
    dxx, dxy, dyy = double_layer(r[:, 0], r[:, 1], nx, ny)
    px, py = pressure_of_double_layer(r[:, 0], r[:, 1], nx, ny, MU)
    u = np.stack([dxx * q[0] + dxy * q[1], dxy * q[0] + dyy * q[1]], axis=1)
    return (u * ds).sum(-1), ((px * q[0] + py * q[1]) * ds).sum(-1)


def test_double_layer_of_a_constant_is_minus_it_inside_and_nothing_outside():
    q = np.array([0.8, -0.5])
    inside = np.array([[0.0, 0.0], [0.04, 0.02], [-0.05, 0.03]])
    outside = np.array([[0.4, 0.1], [-0.3, 0.3], [0.0, -0.35], [5.0, 2.0]])
    u, p = constant_double_layer(inside, q)
    assert np.abs(u + q).max() < 1e-12
    assert np.abs(p).max() < 1e-11
    u, p = constant_double_layer(outside, q)
    assert np.abs(u).max() < 1e-12
    assert np.abs(p).max() < 1e-11
