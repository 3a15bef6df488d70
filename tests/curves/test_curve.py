"""Geometry of curves: circles, ellipses and a blob by closed forms and scipy's quadrature, and the symmetries of every quantity."""

import numpy as np
import pytest
import torch
from helpers import blob, blob_derivative, circle, ellipse, mirror, nodes, reflect, rotate
from scipy import integrate, special

from biem.curves import curve

A, B = 1.3, 0.7
SCALARS = [curve.area, curve.length, curve.reduced_area, curve.effective_radius, curve.bending_energy]
FIELDS = [curve.speed, curve.curvature, curve.arclength_weights]


def moved_ellipse(N=96, angle=0.0, center=(0.0, 0.0)):
    return (rotate(ellipse(N, A, B), angle) + np.asarray(center)[:, None])[None]


def blobs(N=96):
    return np.stack([blob(nodes(N)), 1.5 * blob(nodes(N) + 0.3) + 0.2])


def test_ellipse_area_length_and_what_follows_from_them():
    X = moved_ellipse(angle=0.4, center=(2.0, -1.0))
    perimeter = 4 * A * special.ellipe(1 - B**2 / A**2)
    assert curve.area(X)[0] == pytest.approx(np.pi * A * B, rel=1e-13)
    assert curve.length(X)[0] == pytest.approx(perimeter, rel=1e-13)
    assert curve.arclength_weights(X).sum() == pytest.approx(perimeter, rel=1e-13)
    assert curve.effective_radius(X)[0] == pytest.approx(np.sqrt(A * B), rel=1e-13)
    assert curve.reduced_area(X)[0] == pytest.approx(4 * np.pi**2 * A * B / perimeter**2, rel=1e-13)
    assert curve.centroid(X)[0] == pytest.approx([2.0, -1.0], abs=1e-13)


def test_clockwise_area_is_negative():
    assert curve.area(mirror(moved_ellipse()))[0] == pytest.approx(-np.pi * A * B, rel=1e-13)


def test_ellipse_tangent_normal_and_curvature():
    X, t = moved_ellipse(), nodes(96)
    v = np.hypot(A * np.sin(t), B * np.cos(t))
    assert np.abs(curve.speed(X)[0] - v).max() < 1e-12
    assert np.abs(curve.tangent(X)[0] - np.stack([-A * np.sin(t), B * np.cos(t)]) / v).max() < 1e-12
    assert np.abs(curve.normal(X)[0] - np.stack([B * np.cos(t), A * np.sin(t)]) / v).max() < 1e-12
    assert np.abs(curve.curvature(X)[0] - A * B / v**3).max() < 1e-10


def test_bending_energy_of_circle_and_ellipse():
    assert curve.bending_energy(circle(32, 0.5)[None], kappa_b=3.0)[0] == pytest.approx(3 * np.pi / 0.5, rel=1e-13)
    exact, _ = integrate.quad(lambda t: 0.5 * (A * B) ** 2 * np.hypot(A * np.sin(t), B * np.cos(t)) ** -5, 0, 2 * np.pi, epsabs=1e-12)
    assert curve.bending_energy(moved_ellipse())[0] == pytest.approx(exact, rel=1e-10)


@pytest.mark.parametrize("angle", [0.0, 0.3, -1.2, 1.5])
def test_ellipse_inertia_and_inclination(angle):
    X = moved_ellipse(angle=angle, center=(3.0, 5.0))
    turn = rotate(np.eye(2), angle)
    exact = turn @ np.diag([np.pi * A * B**3 / 4, np.pi * A**3 * B / 4]) @ turn.T
    assert np.abs(curve.inertia_tensor(X)[0] - exact).max() < 1e-12
    assert curve.inclination(X)[0] == pytest.approx(angle, abs=1e-12)


def test_inclination_of_an_upright_ellipse_is_a_quarter_turn():
    assert abs(curve.inclination(moved_ellipse(angle=np.pi / 2))[0]) == pytest.approx(np.pi / 2, abs=1e-12)


def test_blob_area_centroid_and_inertia_against_integrals_over_the_interior():
    def moment(p, q):
        """int x^p y^q dA = 1/(p+1) int x^(p+1) y^q dy (Green)."""

        def f(t):
            return blob(t)[0] ** (p + 1) * blob(t)[1] ** q * blob_derivative(t)[1] / (p + 1)

        return integrate.quad(f, 0, 2 * np.pi, epsabs=1e-14, epsrel=1e-13, limit=200)[0]

    X = blob(nodes(96))[None]
    area = moment(0, 0)
    c = np.array([moment(1, 0), moment(0, 1)]) / area
    xx, yy, xy = moment(2, 0) - area * c[0] ** 2, moment(0, 2) - area * c[1] ** 2, moment(1, 1) - area * c[0] * c[1]
    assert np.abs(c).min() > 1e-4  # the test says something about the centroid
    assert curve.area(X)[0] == pytest.approx(area, rel=1e-12)
    assert curve.centroid(X)[0] == pytest.approx(c, abs=1e-13)
    assert np.abs(curve.inertia_tensor(X)[0] - [[yy, -xy], [-xy, xx]]).max() < 1e-14


@pytest.mark.parametrize("move", [lambda X: X + np.array([[-3.0], [7.0]]), lambda X: rotate(X, 0.7), reflect, lambda X: np.roll(X, 5, -1)])
@pytest.mark.parametrize("quantity", SCALARS)
def test_scalars_do_not_change_under_motions_reflection_and_reindexing(quantity, move):
    X = blobs()
    assert quantity(move(X)) == pytest.approx(quantity(X), rel=1e-12)


@pytest.mark.parametrize("quantity", FIELDS)
def test_fields_move_with_their_nodes(quantity):
    X = blobs()
    f = quantity(X)
    scale = np.abs(f).max()
    assert np.abs(quantity(rotate(X, 0.7)) - f).max() < 1e-11 * scale
    assert np.abs(quantity(np.roll(X, 5, axis=-1)) - np.roll(f, 5, axis=-1)).max() < 1e-11 * scale
    assert np.abs(quantity(reflect(X)) - mirror(f)).max() < 1e-11 * scale


def test_vectors_turn_with_the_curve():
    X = blobs()
    for vector in (curve.tangent, curve.normal):
        assert np.abs(vector(rotate(X, 0.7)) - rotate(vector(X), 0.7)).max() < 1e-12
    assert np.abs(curve.centroid(rotate(X, 0.7))[..., None] - rotate(curve.centroid(X)[..., None], 0.7)).max() < 1e-13
    assert np.abs(curve.centroid(reflect(X)) - curve.centroid(X) * [1, -1]).max() < 1e-13
    assert np.abs(curve.normal(reflect(X)) - reflect(curve.normal(X))).max() < 1e-12


def test_a_distant_origin_costs_no_digits_but_those_of_the_nodes():
    X = blobs()
    far = X + 1000.0
    assert curve.area(far) == pytest.approx(curve.area(X), rel=1e-12)
    assert curve.centroid(far) - 1000 == pytest.approx(curve.centroid(X), abs=1e-12)
    assert np.abs(curve.inertia_tensor(far) - curve.inertia_tensor(X)).max() < 1e-14
    assert curve.bending_energy(far) == pytest.approx(curve.bending_energy(X), rel=1e-11)


def test_arclength_derivative_of_the_position_is_the_tangent():
    X = blobs()
    v = curve.speed(X)
    assert np.abs(curve.d_ds(X, v) - curve.tangent(X)).max() < 1e-12
    assert np.abs(curve.d_ds(X[:, 0], v) - curve.tangent(X)[:, 0]).max() < 1e-12


@pytest.mark.parametrize("quantity", [*SCALARS, *FIELDS, curve.normal, curve.centroid, curve.inertia_tensor, curve.inclination])
def test_torch_equals_numpy(quantity):
    X = blobs()
    assert np.abs(quantity(torch.from_numpy(X)).numpy() - quantity(X)).max() < 1e-10
