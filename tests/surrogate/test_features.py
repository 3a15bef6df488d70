"""Input channels against formulas: of an ellipse, and of curves whose arclength is known."""

from math import pi

import numpy as np
import pytest
import torch
from helpers import ellipse, nodes
from surrogate_cases import mild

from biem.curves.curve import normal
from biem.curves.shapes import equilibrium
from surrogate.features import CHANNELS, derivative, features, frame


def channel(X, name):
    return features(torch.from_numpy(np.ascontiguousarray(X)), (name,))[:, 0].numpy()


def test_the_curvature_of_an_ellipse_and_its_derivatives_by_arclength():
    a, b, t = 0.2, 0.12, nodes(128)
    s, c, e = np.sin(t), np.cos(t), a**2 - b**2
    v = np.hypot(a * s, b * c)
    expected = {
        "x": a * c,
        "y": b * s,
        "normal_x": b * c / v,
        "normal_y": a * s / v,
        "speed": v,
        "curvature": a * b / v**3,
        "curvature_s": -3 * a * b * e * s * c / v**6,
        "curvature_ss": -3 * a * b * e * ((c**2 - s**2) / v**6 - 6 * e * s**2 * c**2 / v**8) / v,
    }
    for name, values in expected.items():
        assert np.abs(channel(ellipse(128, a, b)[None], name) - values).max() < 1e-9 * np.abs(values).max(), name


def test_bending_moves_a_circle_inwards_by_its_symbol():
    """Of length 1: X_ssss = (2 pi)^3 n, of the mode k = 1, where 1/(4 |D|) is 1/(8 pi)."""
    X = ellipse(32, 0.5 / pi, 0.5 / pi)[None]
    assert np.abs(channel(X, "bending_n") + pi**2).max() < 1e-10
    assert np.abs(channel(X, "bending_t")).max() < 1e-10


def test_bending_of_a_curve_with_nodes_evenly_in_arclength_is_a_factor_of_each_mode():
    X = equilibrium(128, 0.65)[None]
    k = np.arange(65)
    decay = (2 * pi * k) ** 3 / 4
    decay[-1] = 0
    expected = -np.fft.irfft(decay * np.fft.rfft(X))
    n = normal(X)
    t = np.stack([-n[:, 1], n[:, 0]], axis=1)
    scale = np.abs(expected).max()
    assert scale > 30
    assert np.abs(channel(X, "bending_n") - (expected * n).sum(1)).max() < 1e-5 * scale
    assert np.abs(channel(X, "bending_t") - (expected * t).sum(1)).max() < 1e-5 * scale


def test_the_order_of_channels_is_the_one_asked_for():
    X = torch.from_numpy(mild(2))
    every = features(X)
    assert every.shape == (2, len(CHANNELS), 32)
    assert every.dtype == torch.float64
    assert torch.equal(features(X, ("curvature", "y")), every[:, [CHANNELS.index("curvature"), 1]])


@pytest.mark.parametrize("name", CHANNELS)
def test_channels_go_with_the_nodes(name):
    X = mild(1)
    assert (
        np.abs(channel(np.roll(X, 5, axis=-1), name) - np.roll(channel(X, name), 5, axis=-1)).max() < 1e-9 * np.abs(channel(X, name)).max()
    )


def test_the_frame_is_the_outward_normal_and_the_tangent():
    X = mild(2)
    F = frame(torch.from_numpy(X)).numpy()
    assert np.abs(F[:, 0] - normal(X)).max() < 1e-13
    assert np.abs(F[:, 1, 0] + F[:, 0, 1]).max() < 1e-13
    assert np.abs(F[:, 1, 1] - F[:, 0, 0]).max() < 1e-13


def test_the_derivative_takes_out_the_nyquist_mode():
    t = nodes(16)
    f = torch.from_numpy(np.stack([np.sin(3 * t), np.cos(8 * t), np.ones(16)]))
    assert np.abs(derivative(f).numpy() - np.stack([3 * np.cos(3 * t), 0 * t, 0 * t])).max() < 1e-13
