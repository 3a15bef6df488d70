"""Wall shapes: sizes, straight sides, equal spacing, and spectra that end in rounding."""

import numpy as np
import pytest

from biem.curves import wall_shapes
from biem.curves.curve import area, curvature, speed
from biem.curves.fourier import rfft

SHAPES = {
    "circle": lambda N: wall_shapes.circle(N, 0.7),
    "ellipse": lambda N: wall_shapes.ellipse(N, 0.7, 0.5),
    "triangle": lambda N: wall_shapes.polygon(N, 0.7, 3),
    "hexagon": lambda N: wall_shapes.polygon(N, 0.7, 6),
    "star": lambda N: wall_shapes.star(N, 0.7, 5),
}


@pytest.mark.parametrize("name", SHAPES)
def test_size_is_the_radius_of_the_circle_of_equal_area(name):
    X = SHAPES[name](384)
    assert abs(area(X[None])[0] / (np.pi * 0.49) - 1) < 1e-8
    v = speed(X[None])[0]
    assert np.ptp(v) < 1e-5 * v.mean()


@pytest.mark.parametrize("name", SHAPES)
def test_spectrum_ends_in_small_values(name):
    modes = np.abs(rfft(SHAPES[name](512))).max(axis=0)
    assert modes[-20:].max() < 1e-8 * modes.max()
    assert modes[-20:].max() < 1e-2 * modes[100:130].max() + 1e-14 * modes.max()


def test_polygons_have_flat_sides_and_turn_at_corners():
    c = curvature(wall_shapes.polygon(600, 1.0, 4)[None])[0]
    assert (np.abs(c) < 0.1).mean() > 0.3
    peaks = (c > np.roll(c, 1)) & (c >= np.roll(c, -1)) & (c > 1.0)
    assert peaks.sum() == 4


def test_channel_has_straight_walls_of_its_width_and_length():
    X = wall_shapes.channel(800, 9.0, 0.75)
    assert np.abs(np.ptp(X, axis=1) - [9.0, 1.5]).max() < 1e-9
    sides = X[:, np.abs(X[0]) < 2.0]
    assert np.abs(np.abs(sides[1]) - 0.75).max() < 1e-12


def test_nodes_for_a_spacing():
    X = wall_shapes.circle(64, 1.0)
    assert wall_shapes.nodes_for(X, 0.1, 16) == 64  # 2 pi / 0.1 = 62.8
    assert wall_shapes.nodes_for(X, 1.0, 16) == 16
