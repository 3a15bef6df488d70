"""The single layer on the curve: Fourier modes of the circle, Kress's rule on a blob, order of convergence, and its symmetries."""

import numpy as np
import pytest
import torch
from helpers import blob, blob_case, blob_density, blob_derivative, blob_layer_by_kress, blob_normal, circle, nodes, reflect, rotate

from biem.backend import counting
from biem.stokes.quadrature import default_order, full_matrix, single_layer_blocks


def layer(X, f, **options):
    """S[X, f] for X, f: (M, 2, N) or (2, N)."""
    X, f = np.broadcast_arrays(X, f)
    batch = X.reshape(-1, *X.shape[-2:])
    S = full_matrix(single_layer_blocks(batch, **options))
    return (S @ f.reshape(len(batch), -1, 1)).reshape(f.shape)


def circle_mode(a, m, t):
    """S[a e^{imt}] on the unit circle, u + iv."""
    own = a / 4 if m == 0 else a * np.exp(1j * m * t) / (4 * abs(m))
    return own - (np.conj(a) / 4 * np.exp(1j * t) if m == 1 else 0)


def complex_layer(f, **options):
    u = layer(circle(len(f)), np.stack([f.real, f.imag]), **options)
    return u[0] + 1j * u[1]


@pytest.mark.parametrize("m", range(9))
def test_modes_of_the_circle(m):
    t = nodes(32)
    for a in (1.0, 1j):
        assert np.abs(complex_layer(a * np.exp(1j * m * t), order=16) - circle_mode(a, m, t)).max() <= 1e-10


@pytest.mark.parametrize("k", range(9))
@pytest.mark.parametrize(("unit", "a"), [(1, 1.0), (1j, 1.0), (1, 1j), (1j, 1j)])
def test_real_densities_on_the_circle(k, unit, a):
    """(cos kt, 0), (0, cos kt), (sin kt, 0), (0, sin kt) as halves of e^{ikt} and e^{-ikt}."""
    t = nodes(32)
    f = unit * (np.cos(k * t) if a == 1 else np.sin(k * t))
    plus, minus = (unit / 2, unit / 2) if a == 1 else (unit / 2j, -unit / 2j)
    exact = circle_mode(plus, k, t) + circle_mode(minus, -k, t)
    assert np.abs(complex_layer(f, order=16) - exact).max() <= 1e-10


def test_rule_of_order_8_converges_with_about_that_order():
    exact = blob_layer_by_kress(384)
    error = [np.abs(layer(*blob_case(N), order=8) - exact[:, :: 384 // N]).max() for N in (48, 96, 192)]
    order = np.log2(np.array(error[:-1]) / error[1:])
    assert (order > 7.7).all()
    assert order[-1] < 10.5


def test_rule_of_order_16_agrees_with_kress_on_a_blob():
    exact = blob_layer_by_kress(384)
    error = [np.abs(layer(*blob_case(N), order=16) - exact[:, :: 384 // N]).max() for N in (32, 64, 128)]
    assert error[0] < 1e-6
    assert error[1] < 1e-10
    assert error[2] < 1e-14
    assert np.log2(error[0] / error[1]) > 13


@pytest.mark.parametrize(("order", "N"), [(16, 18), (8, 8), (None, 8)])
def test_orders_that_do_not_fit_raise(order, N):
    with pytest.raises(ValueError, match=f"got {N}"):
        single_layer_blocks(circle(N)[None], order=order)


def test_unknown_orders_raise_and_the_default_is_the_highest_that_fits():
    with pytest.raises(ValueError, match="order 12"):
        single_layer_blocks(circle(32)[None], order=12)
    assert [default_order(N) for N in (10, 18, 20, 128)] == [8, 8, 16, 16]
    for N in (10, 20):
        assert np.isfinite(single_layer_blocks(circle(N)[None])).all()
    assert (single_layer_blocks(circle(18)[None]) == single_layer_blocks(circle(18)[None], order=8)).all()


def test_normal_density_is_all_pressure():
    assert np.abs(layer(blob(nodes(128)), blob_normal(nodes(128)))).max() < 1e-14


def test_single_layer_is_selfadjoint_and_positive_on_densities_without_net_normal_part():
    N = 96
    ds = np.tile(np.hypot(*blob_derivative(nodes(N))) * 2 * np.pi / N, 2)
    f, g = blob_density(nodes(N)), blob_density(2 * nodes(N) + 1.0)
    Sf, Sg = layer(blob(nodes(N)), f), layer(blob(nodes(N)), g)
    assert ds @ (g * Sf).ravel() == pytest.approx(ds @ (f * Sg).ravel(), rel=1e-10)
    assert ds @ (f * Sf).ravel() > 0
    assert ds @ (g * Sg).ravel() > 0


@pytest.mark.parametrize("size", [0.1, 40.0])
def test_growth_adds_the_logarithm_of_the_size_times_the_total_force(size):
    """S[lX, f] = l (S[X, f] - log(l)/(4 pi mu) int f ds)."""
    X, f = blob_case(96)
    total = (f * np.hypot(*blob_derivative(nodes(96)))).sum(axis=1, keepdims=True) * 2 * np.pi / 96
    exact = size * (layer(X, f, mu=3.0) - np.log(size) / (4 * np.pi * 3.0) * total)
    assert np.abs(layer(size * X, f, mu=3.0) - exact).max() < 1e-13 * np.abs(exact).max()


def test_motions_reflection_and_reindexing_commute_with_the_single_layer():
    X, f = blob_case(64)
    u = layer(X, f)
    assert np.abs(layer(rotate(X, 0.8), rotate(f, 0.8)) - rotate(u, 0.8)).max() < 1e-14
    assert np.abs(layer(reflect(X), reflect(f)) - reflect(u)).max() < 1e-14
    assert np.abs(layer(np.roll(X, 9, -1), np.roll(f, 9, -1)) - np.roll(u, 9, -1)).max() < 1e-14
    assert np.abs(layer(X + 1000.0, f) - u).max() < 1e-10


def test_curves_of_a_batch_do_not_mix_and_viscosity_divides():
    X, f = np.stack([blob(nodes(64)), 2 * circle(64)]), np.stack([blob_density(nodes(64))] * 2)
    u = layer(X, f)
    assert np.abs(u - np.stack([layer(X[0], f[0]), layer(X[1], f[1])])).max() < 1e-15
    assert np.abs(layer(X, f, mu=4.0) - u / 4).max() < 1e-15


def test_each_matrix_is_counted():
    with counting() as counts:
        single_layer_blocks(np.stack([circle(32)] * 3))
    assert counts["single_layer_matrix"] == 3


@pytest.mark.parametrize("order", [8, 16])
def test_torch_equals_numpy(order):
    X = np.stack([blob(nodes(40)), circle(40)])
    blocks = single_layer_blocks(X, 1.7, order)
    assert np.abs(single_layer_blocks(torch.from_numpy(X), 1.7, order).numpy() - blocks).max() < 1e-14
    assert np.abs(full_matrix(torch.from_numpy(blocks)).numpy() - full_matrix(blocks)).max() == 0
