"""The single layer by Kress's rule: Fourier modes of the circle, Alpert's rule, symmetry, compiled loops against array code."""

import numpy as np
import pytest
import torch
from helpers import blob, blob_case, blob_density, blob_derivative, blob_layer_by_kress, blob_normal, circle, nodes, reflect, rotate

from biem.backend import counting
from biem.curves.curve import arclength_weights, center_of_nodes
from biem.curves.fourier import derivative, resample
from biem.curves.shapes import perturbed
from biem.stokes import kress
from biem.stokes.kress import apply_single_layer, circulant, kernel_blocks, on_own_curve, single_layer_kernel
from biem.stokes.quadrature import full_matrix, single_layer_blocks


def centred(X):
    """Curves about their centres and their derivatives, as the kernel takes them."""
    local = X - center_of_nodes(X)
    return local, derivative(local)


def layer(X, f, mu=1.0):
    """S[X, f] (2, N) by the kernel on the N nodes themselves."""
    X, f = X[None], f[None]
    g = f * arclength_weights(X)[:, None, :]
    K = full_matrix(single_layer_kernel(*centred(X), mu))
    return (K @ g.reshape(1, -1, 1)).reshape(X.shape)[0]


def shapes(n, count=3):
    return np.stack([perturbed(n, 0.65, seed=seed) for seed in range(count)])


@pytest.mark.parametrize("n", [16, 18, 32, 34])
def test_all_modes_of_the_circle_are_exact(n):
    """S[a e^{imt}] = (a e^{imt}/|m| - conj(a) e^{it} [m = 1])/4, and a/4 for m = 0, for every |m| < n/2."""
    t = nodes(n)
    for m in range(-(n // 2) + 1, n // 2):
        for a in (1.0, 1j, 0.6 - 0.3j):
            f = a * np.exp(1j * m * t)
            u = layer(circle(n), np.stack([f.real, f.imag]))
            exact = f / (4 * max(1, abs(m))) - (np.conj(a) / 4 * np.exp(1j * t) if m == 1 else 0)
            assert np.abs(u[0] + 1j * u[1] - exact).max() < 1e-14, m


def test_a_force_of_the_highest_mode_has_half_the_weight_of_a_cosine():
    """The interpolant of (-1)^j is cos(n t/2): its velocity at the nodes is that of the cosine."""
    n = 18
    f = np.cos(n // 2 * nodes(n))
    u = layer(circle(n), np.stack([f, 0 * f]))
    assert np.abs(u - np.stack([f, 0 * f]) / (4 * n / 2)).max() < 1e-14


def test_circulant_is_even_and_integrates_the_logarithm():
    for n in (18, 32):
        c = circulant(n)
        assert np.abs(c[1:] - c[:0:-1]).max() < 1e-14
        log = np.zeros(n)
        log[1:] = -np.log(2 * np.sin(nodes(n)[1:] / 2))
        for m in (0, 1, n // 2 - 1):
            mean = ((c + log) * np.cos(m * nodes(n))).mean()
            assert mean == pytest.approx(0.0 if m == 0 else 0.5 / m, abs=1e-15)


def test_converges_spectrally_to_alperts_rule():
    """On the blob, to the order-16 rule on 512 nodes: each 16 nodes gain a factor of 20 until rounding."""
    X, f = blob_case(512)
    exact = (full_matrix(single_layer_blocks(X[None], order=16))[0] @ f.reshape(-1)).reshape(2, 512)
    error = np.array([np.abs(layer(*blob_case(n)) - exact[:, :: 512 // n]).max() for n in (16, 32, 64, 128)])
    assert error[1] < 1e-5
    assert error[2] < 1e-9
    assert error[3] < 1e-14
    assert (error[1:3] < error[:2] / 20.0 ** np.array([1, 2])).all(), error


@pytest.mark.parametrize("n", [18, 34, 64, 100])
def test_equals_an_independent_product_rule(n):
    assert np.abs(layer(*blob_case(n)) - blob_layer_by_kress(n)).max() < 1e-14


def test_kernel_is_symmetric_and_of_the_blocks():
    X = shapes(34)
    K = single_layer_kernel(*centred(X), 1.7)
    assert K.shape == (3, 3, 34, 34)
    assert np.abs(K - K.transpose(0, 1, 3, 2)).max() < 1e-15
    i, j = 3, 20
    rx, ry = X[1, :, i] - X[1, :, j]
    r2 = rx**2 + ry**2
    c = circulant(34)[i - j]
    want = np.array([c - 0.5 * np.log(r2) + rx * rx / r2, rx * ry / r2, c - 0.5 * np.log(r2) + ry * ry / r2]) / (4 * np.pi * 1.7)
    assert np.abs(K[1, :, i, j] - want).max() < 1e-15


def test_kernel_is_positive_on_densities_without_net_normal_part():
    """The least eigenvalue of K is that of the normals, 0 up to the quadrature; all others are positive."""
    X, X_alpha = centred(0.5 * blob(nodes(96))[None])  # small: the logarithm of large curves is negative
    values, vectors = np.linalg.eigh(full_matrix(single_layer_kernel(X, X_alpha))[0])
    weighted_normal = np.concatenate([X_alpha[0, 1], -X_alpha[0, 0]])
    assert abs(values[0]) < 1e-14
    assert values[1] > 1e-4
    assert abs(vectors[:, 0] @ weighted_normal) == pytest.approx(np.linalg.norm(weighted_normal), rel=1e-10)


@pytest.mark.parametrize("n", [96, 98])
def test_normal_density_is_all_pressure(n):
    """S[n] = 0."""
    assert np.abs(layer(blob(nodes(n)), blob_normal(nodes(n)))).max() < 1e-13


@pytest.mark.parametrize("n", [18, 34, 64, 100])
def test_compiled_loops_equal_the_array_code(n, monkeypatch):
    X, X_alpha = centred(shapes(n))
    g = np.random.default_rng(n).normal(size=X.shape)
    K, u = single_layer_kernel(X, X_alpha, 0.7), apply_single_layer(X, X_alpha, g, 0.7)
    assert np.abs(K - kernel_blocks(X, X_alpha, 0.7)).max() < 1e-14 * np.abs(K).max() * 10
    monkeypatch.setattr(kress, "on_cpu", lambda a: False)
    assert np.abs(single_layer_kernel(X, X_alpha, 0.7) - K).max() < 1e-13 * np.abs(K).max()
    assert np.abs(apply_single_layer(X, X_alpha, g, 0.7) - u).max() < 1e-13 * np.abs(u).max()
    tensors = [torch.from_numpy(a) for a in (X, X_alpha, g)]
    assert np.abs(single_layer_kernel(*tensors[:2], 0.7).numpy() - K).max() < 1e-13 * np.abs(K).max()
    assert np.abs(apply_single_layer(*tensors, 0.7).numpy() - u).max() < 1e-13 * np.abs(u).max()


def test_torch_on_the_cpu_has_the_same_bits():
    X, X_alpha = centred(shapes(34))
    g = np.cos(5 * X)
    tensors = [torch.from_numpy(a) for a in (X, X_alpha, g)]
    assert np.array_equal(single_layer_kernel(*tensors[:2]).numpy(), single_layer_kernel(X, X_alpha))
    assert np.array_equal(apply_single_layer(*tensors).numpy(), apply_single_layer(X, X_alpha, g))


@pytest.mark.parametrize("n", [18, 34, 64])
def test_application_is_the_product_with_the_kernel(n):
    X, X_alpha = centred(shapes(n))
    g = np.random.default_rng(n).normal(size=X.shape)
    u = (full_matrix(single_layer_kernel(X, X_alpha, 1.3)) @ g.reshape(3, -1, 1)).reshape(X.shape)
    assert np.abs(apply_single_layer(X, X_alpha, g, 1.3) - u).max() < 1e-13 * np.abs(u).max()


@pytest.mark.parametrize("N", [18, 48, 64])
def test_on_own_curve_is_the_rule_on_twice_the_nodes(N):
    X, f = blob_case(N)
    fine = layer(resample(X, 2 * N), resample(f, 2 * N), 1.7)
    assert np.abs(on_own_curve(X[None], f[None], 1.7)[0] - fine[:, ::2]).max() < 1e-14


def test_on_own_curve_converges_and_a_distant_origin_costs_few_digits():
    X, f = blob_case(64)
    u = on_own_curve(X[None], f[None])[0]
    assert np.abs(u - blob_layer_by_kress(512)[:, ::8]).max() < 1e-9
    assert np.abs(on_own_curve(X[None] + 1e3, f[None])[0] - u).max() < 1e-12


@pytest.mark.parametrize("size", [1e-3, 0.1, 40.0])
def test_growth_adds_the_logarithm_of_the_size_times_the_total_force(size):
    """S[lX, f] = l (S[X, f] - log(l)/(4 pi mu) int f ds)."""
    X, f = blob_case(66)
    total = (f * np.hypot(*blob_derivative(nodes(66)))).sum(axis=1, keepdims=True) * 2 * np.pi / 66
    for S in (lambda X: layer(X, f, mu=3.0), lambda X: on_own_curve(X[None], f[None], 3.0)[0]):
        exact = size * (S(X) - np.log(size) / (4 * np.pi * 3.0) * total)
        assert np.abs(S(size * X) - exact).max() < 2e-13 * np.abs(exact).max()


def test_motions_reflection_and_reindexing_commute_with_the_single_layer():
    X, f = blob_case(50)
    u = layer(X, f)
    assert np.abs(layer(rotate(X, 0.8), rotate(f, 0.8)) - rotate(u, 0.8)).max() < 1e-14
    assert np.abs(layer(reflect(X), reflect(f)) - reflect(u)).max() < 1e-14
    assert np.abs(layer(np.roll(X, 9, -1), np.roll(f, 9, -1)) - np.roll(u, 9, -1)).max() < 1e-14
    assert np.abs(layer(X + 1000.0, f) - u).max() < 1e-11


def test_curves_of_a_batch_do_not_mix_and_kernels_are_counted():
    X, f = np.stack([blob(nodes(34)), 2 * circle(34)]), np.stack([blob_density(nodes(34)), circle(34)])
    with counting() as counts:
        K = single_layer_kernel(*centred(X))
    assert counts == {"single_layer_matrix": 2}
    for m in (0, 1):
        assert np.array_equal(K[m], single_layer_kernel(*centred(X[m : m + 1]))[0])
    with counting() as counts:
        u = on_own_curve(X, f)
    assert counts == {}
    assert np.array_equal(u[1], on_own_curve(X[1:], f[1:])[0])


def test_a_node_that_is_no_number_stays_in_its_curve():
    X, X_alpha = centred(shapes(18))
    X[1, 0, 4] = np.nan
    K = single_layer_kernel(X, X_alpha)
    assert np.isnan(K[1, 0, 4, [0, 3, 5]]).all()
    assert np.isfinite(K[[0, 2]]).all()
