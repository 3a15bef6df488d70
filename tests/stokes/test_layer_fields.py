"""Layers at any points: one accuracy near and far, agreement with the solver's own sums, insides, points on membranes, images."""

import numpy as np
import pytest
from helpers import FEET, blob, blob_case, blob_normal, crowd, nodes, standing_off, two_blobs

from biem.curves.lattice import Lattice
from biem.curves.shapes import equilibrium
from biem.stokes.double_layers import double_layer
from biem.stokes.layer_fields import Layers
from biem.stokes.single_layer import single_layer

MU = 1.7


def around(X, P=1500):
    """Points in a box around curves (M, 2, N)."""
    low, high = X.min(axis=(0, 2)) - 0.1, X.max(axis=(0, 2)) + 0.1
    return np.random.default_rng(0).uniform(low, high, (P, 2))


def test_agrees_with_the_velocities_of_the_solver():
    X, f, x = two_blobs(64)
    x = np.concatenate([x, around(X, 400)])
    found = Layers(X, MU, f, tolerance=1e-9).values(x).velocity
    assert np.abs(found - single_layer(X, f, x, MU, tolerance=1e-11, far_field="direct")).max() < 1e-10
    found = Layers(X, MU, None, f, tolerance=1e-9).values(x).velocity
    assert np.abs(found - double_layer(X, f, x, 1e-11)).max() < 1e-7


@pytest.mark.parametrize("tolerance", [1e-4, 1e-6])
@pytest.mark.parametrize("shape", [lambda: blob(nodes(32)), lambda: equilibrium(16, 0.65, 1.0), lambda: equilibrium(96, 0.65, 1.0)])
def test_errors_stay_below_the_tolerance_wherever_near_ends(shape, tolerance):
    X = shape()[None]
    t = nodes(X.shape[-1])
    f = np.stack([np.cos(3 * t) + 0.2, np.sin(2 * t)])[None]
    x = around(X)
    found, exact = (Layers(X, MU, f, f, tolerance=e, far_field="direct").values(x) for e in (tolerance, 1e-13))
    for name in ("velocity", "phi", "D"):
        a, b = getattr(found, name), getattr(exact, name)
        assert 0 < np.abs(a - b).max() < tolerance * np.abs(b).max()


def test_parts_of_what_is_asked_for_are_the_same_numbers():
    X, f, x = two_blobs(32)
    layers = Layers(X, MU, f)
    asked = ((True, True, True), (True, False, False), (False, True, False), (False, False, True))
    both, velocity, pressure, stress = (layers.values(x, *names) for names in asked)
    assert np.array_equal(both.velocity, velocity.velocity)
    assert np.array_equal(both.phi, pressure.phi)
    assert np.array_equal(both.D, stress.D)
    assert (velocity.phi.size, pressure.velocity.size, pressure.D.size, stress.velocity.size) == (0, 0, 0, 0)
    nothing = layers.values(np.zeros((0, 2)))
    assert (nothing.velocity.shape, nothing.phi.shape, nothing.inside.shape) == ((0, 2), (0,), (0,))


@pytest.mark.parametrize("offset", [1e-9, 1e-4, 0.01, 0.05])
def test_inside_is_told_up_to_the_curve(offset):
    X, _, _ = two_blobs(32)
    turned = np.array([[np.cos(2.0), -np.sin(2.0)], [np.sin(2.0), np.cos(2.0)]])
    inner, outer = standing_off(-offset), standing_off(offset)
    x = np.concatenate([inner, outer, inner @ turned.T + [0.42, 0.0], outer @ turned.T + [0.42, 0.0]])
    assert np.array_equal(Layers(X, MU).inside(x), np.repeat([0, -1, 1, -1], 13))


def test_inside_of_unlike_curves_is_that_of_fine_polygons():
    import shapely

    X = 0.8 * crowd(48) + np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [1.0, 1.0]])[:, :, None]
    x = around(X, 4000)
    t = np.linspace(0, 2 * np.pi, 4000, endpoint=False)
    fine = (0.8 * crowd(4000) + np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [1.0, 1.0]])[:, :, None]).transpose(0, 2, 1)
    expected = np.full(len(x), -1)
    for m, corners in enumerate(fine):
        expected[shapely.contains_xy(shapely.Polygon(corners), x)] = m
    assert len(t) == fine.shape[1]
    assert set(expected) == {-1, 0, 1, 2, 3}
    assert (Layers(X, MU).inside(x) == expected).mean() > 0.9995


def test_on_a_membrane_are_the_limits_from_outside_at_nodes_and_between():
    X, f = (a[None] for a in blob_case(64))
    layers, t = Layers(X, MU, f, f), np.append(nodes(64), FEET)
    x = blob(t).T
    on, outside = layers.values(x), layers.values(x + 1e-9 * blob_normal(t).T)
    assert (on.inside == -1).all()
    for name in ("velocity", "phi", "D"):
        a, b = getattr(on, name), getattr(outside, name)
        assert np.abs(a - b).max() < 1e-6 * np.abs(b).max()
    inside = layers.values(x - 1e-9 * blob_normal(t).T)
    assert np.abs(on.phi - inside.phi).max() > 0.1 * np.abs(on.phi).max()


def test_in_a_periodic_box_points_and_curves_stand_for_their_images():
    X, f, _ = two_blobs(48)
    f = f - f.mean(axis=-1, keepdims=True)
    f -= (f * np.hypot(*(np.roll(X, -1, -1) - np.roll(X, 1, -1)).transpose(1, 0, 2))[:, None]).sum((0, 2))[:, None] / (2 * 2.0)
    lattice = Lattice(1.1, 0.9, 0.3)
    x = around(X, 200)
    a_1, a_2 = lattice.vectors
    here = Layers(X, MU, f, tolerance=1e-8, lattice=lattice).values(x)
    there = Layers(X + (2 * a_1 - a_2)[:, None], MU, f, tolerance=1e-8, lattice=lattice).values(x + a_2 - 3 * a_1)
    assert np.array_equal(here.inside, there.inside)
    assert {0, 1, -1} == set(here.inside)
    for name in ("velocity", "phi", "D"):
        a, b = getattr(here, name), getattr(there, name)
        assert np.abs(a - b).max() < 1e-7 * np.abs(a).max()
