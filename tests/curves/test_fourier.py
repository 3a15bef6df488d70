"""Periodic functions: trigonometric polynomials are handled exactly, and the Nyquist mode as documented."""

import numpy as np
import pytest
import torch
from helpers import nodes

from biem.curves.fourier import (
    coefficients,
    derivative,
    differentiation_matrix,
    evaluate,
    interpolation_matrix,
    read_back,
    remove_nyquist,
    resample,
    resampling_matrix,
    shift,
)


def polynomial(t, order=0):
    """0.7 + cos 3t - 2 sin 5t and its derivatives."""
    quarter = order * np.pi / 2
    return 0.7 * (order == 0) + 3.0**order * np.cos(3 * t + quarter) - 2 * 5.0**order * np.sin(5 * t + quarter)


def alternating(N):
    return (-1.0) ** np.arange(N)


def test_derivative_of_trigonometric_polynomials_is_exact_along_the_last_axis():
    t = nodes(16)
    f = np.stack([polynomial(t), np.cos(7 * t)])[None]
    exact = np.stack([polynomial(t, 1), -7 * np.sin(7 * t)])[None]
    assert np.abs(derivative(f) - exact).max() < 1e-13 * 16


def test_derivative_kills_the_nyquist_mode():
    f = polynomial(nodes(16))
    assert np.abs(derivative(alternating(16))).max() < 1e-14
    assert np.abs(derivative(f + 3 * alternating(16)) - derivative(f)).max() < 1e-13
    c = coefficients(alternating(16))[None, None]
    assert evaluate(c, np.array([[0.1]])) == pytest.approx(np.cos(0.8))
    assert [evaluate(c, np.array([[0.1]]), order).item() for order in (1, 2)] == [0, 0]


def test_derivative_converges_spectrally():
    def error(N):
        t = nodes(N)
        return np.abs(derivative(np.exp(np.sin(t))) - np.cos(t) * np.exp(np.sin(t))).max()

    assert error(8) > 1e-3
    assert error(32) < 1e-12


@pytest.mark.parametrize("N", [12, 16, 18, 40, 64])
def test_resample_to_more_or_fewer_nodes_is_exact_for_resolved_functions(N):
    assert np.abs(resample(polynomial(nodes(16)), N) - polynomial(nodes(N))).max() < 1e-13


def test_resample_carries_the_nyquist_mode_as_a_cosine():
    assert np.abs(resample(alternating(8), 32) - np.cos(4 * nodes(32))).max() < 1e-14


def test_resample_to_fewer_nodes_drops_modes_that_do_not_fit():
    t = nodes(32)
    f = 1 + np.cos(3 * t) + np.cos(4 * t) + np.sin(6 * t) + np.cos(16 * t)
    assert np.abs(resample(f, 8) - (1 + np.cos(3 * nodes(8)))).max() < 1e-14


def test_resample_up_and_down_again_loses_only_the_nyquist_mode():
    f = np.random.default_rng(0).normal(size=(3, 2, 16))
    assert np.abs(resample(resample(f, 48), 16) - remove_nyquist(f)).max() < 1e-14


@pytest.mark.parametrize("N", [16, 24, 40, 48])
def test_read_back_evaluates_at_fewer_nodes_and_cuts_off_no_mode(N):
    t = nodes(48)
    f = polynomial(t) + np.cos(13 * t) + np.sin(23 * t)
    exact = polynomial(nodes(N)) + np.cos(13 * nodes(N)) + np.sin(23 * nodes(N))
    assert np.abs(read_back(np.stack([f, 2 * f]), N) - np.stack([exact, 2 * exact])).max() < 1e-12


def test_remove_nyquist():
    f = polynomial(nodes(16))
    assert np.abs(remove_nyquist(f + 2.5 * alternating(16)) - f).max() < 1e-14
    assert np.abs(remove_nyquist(f) - f).max() < 1e-14


def test_shift_evaluates_at_moved_nodes():
    t = nodes(16)
    f = np.stack([polynomial(t), np.cos(2 * t)])
    offset = np.array([0.3, -1.1])
    exact = np.stack([polynomial(t + 0.3), np.cos(2 * (t - 1.1))])
    assert np.abs(shift(f, offset) - exact).max() < 1e-13
    assert np.abs(shift(f, np.full(2, 2 * np.pi / 16)) - np.roll(f, -1, axis=-1)).max() < 1e-13


@pytest.mark.parametrize("order", [0, 1, 2])
def test_evaluate_gives_function_and_derivatives_anywhere(order):
    t = np.stack([nodes(16), nodes(16) + 0.2])
    f = np.stack([polynomial(t), np.cos(t)], axis=1)  # (Q, C, N)
    alpha = np.array([[0.1, 2.0, 6.0], [-1.0, 0.0, 9.0]])
    values = evaluate(coefficients(f), alpha, order)
    at = alpha + np.array([[0.0], [0.2]])
    exact = np.stack([polynomial(at, order), np.cos(at + order * np.pi / 2)], axis=1)
    assert values.shape == (2, 2, 3)
    assert np.abs(values - exact).max() < 1e-12


def test_interpolation_matrix_is_the_identity_at_the_nodes_and_exact_between():
    f = np.random.default_rng(0).normal(size=16)
    assert np.abs(interpolation_matrix(nodes(16), 16) - np.eye(16)).max() < 1e-14
    alpha = np.array([0.05, 1.7, 4.4, -2.0])
    assert np.abs(interpolation_matrix(alpha, 16) @ polynomial(nodes(16)) - polynomial(alpha)).max() < 1e-13
    assert np.abs(interpolation_matrix(nodes(64), 16) @ f - resample(f, 64)).max() < 1e-13


def test_matrices_agree_with_the_functions():
    f = np.random.default_rng(0).normal(size=16)
    assert np.abs(differentiation_matrix(16) @ f - derivative(f)).max() < 1e-13
    assert np.abs(resampling_matrix(40, 16) @ f - resample(f, 40)).max() < 1e-14
    assert np.abs(resampling_matrix(8, 16) @ f - resample(f, 8)).max() < 1e-14


@pytest.mark.parametrize(
    "function",
    [
        derivative,
        remove_nyquist,
        lambda f: resample(f, 40),
        lambda f: resample(f, 8),
        lambda f: read_back(f, 12),
        lambda f: shift(f, f[..., 0]),
        lambda f: evaluate(coefficients(f), f[:, 0, :4], 1),
    ],
)
def test_torch_equals_numpy(function):
    f = np.random.default_rng(0).normal(size=(3, 2, 16))
    assert np.abs(function(torch.from_numpy(f)).numpy() - function(f)).max() < 1e-13
