"""Nodes redistributed to equal arclength, and area and length restored: exactness, symmetries, and failures that name the vesicle."""

import numpy as np
import pytest
import torch
from helpers import blob, circle, ellipse, nodes, reflect
from scipy import special

from biem.curves import curve
from biem.curves.conserve import restore_area_length
from biem.curves.reparam import equal_arclength_parameters, redistribute
from biem.curves.shapes import equilibrium
from biem.errors import NumericalFailure


def uneven(N=96):
    """Resolved shapes with speeds that vary by more than a half."""
    return np.stack([blob(nodes(N)), ellipse(N, 1.0, 0.5), 0.3 * ellipse(N, 0.7, 1.0) + 5.0])


def bent(N=96):
    """Vesicle shapes off their area and length by some per mille, with the area and length they had."""
    X = np.stack([equilibrium(N, v) for v in (0.5, 0.65, 0.9)])
    t = nodes(N)
    Y = X + 2e-3 * np.stack([np.cos(t) + np.sin(3 * t), 1 + np.cos(2 * t)])
    return Y, curve.area(X), curve.length(X)


def test_parameters_are_equally_spaced_in_the_exact_arclength_of_an_ellipse():
    alpha = equal_arclength_parameters(ellipse(32, 1.0, 0.5)[None])[0]
    s = special.ellipeinc(np.append(alpha, alpha[0] + 2 * np.pi) - np.pi / 2, 0.75)  # int sqrt(sin^2 + cos^2/4)
    assert np.abs(np.diff(s) - 4 * special.ellipe(0.75) / 32).max() < 1e-10
    assert abs(alpha[0]) < 1e-12  # no shift along the curve: by symmetry the vertex stays


@pytest.mark.parametrize("offset", [0.0, 0.9])
def test_redistribution_moves_no_node_on_average(offset):
    X = blob(nodes(128) + offset)[None]
    fine = blob(nodes(4096) + offset)
    s = np.append(0, np.cumsum(np.hypot(*np.diff(np.c_[fine, fine[:, 0]]))))  # polygon, error 1e-6
    s, total = s[:-1], s[-1]
    lead = 2 * np.pi * s / total - nodes(4096)  # g / v_0 + const
    alpha = equal_arclength_parameters(X)[0]
    at = np.interp(alpha, nodes(4096), lead - lead.mean(), period=2 * np.pi)
    assert np.abs(alpha + at - nodes(128)).max() < 1e-5


def test_redistribution_keeps_the_curve_and_evens_the_spacing():
    X = uneven()
    (Y,) = redistribute(X)
    before, after = (np.ptp(curve.speed(Z), axis=-1) / curve.speed(Z).mean(axis=-1) for Z in (X, Y))
    assert before.min() > 0.3
    assert after.max() < 1e-5
    assert np.abs(curve.area(Y) / curve.area(X) - 1).max() < 1e-10
    assert np.abs(curve.length(Y) / curve.length(X) - 1).max() < 1e-10


@pytest.mark.parametrize("N", [48, 64])
def test_redistribution_changes_the_area_of_resolved_shapes_by_less_than_1e_6(N):
    X = uneven(N)
    assert np.abs(curve.area(redistribute(X)[0]) / curve.area(X) - 1).max() < 1e-6


def test_redistribution_commutes_with_reindexing_and_reflection():
    X = uneven()
    (Y,) = redistribute(X)
    assert np.abs(redistribute(np.roll(X, 7, axis=-1))[0] - np.roll(Y, 7, axis=-1)).max() < 1e-12
    assert np.abs(redistribute(reflect(X))[0] - reflect(Y)).max() < 1e-12


def test_redistribution_is_idempotent():
    (Y,) = redistribute(uneven(128))
    assert np.abs(redistribute(Y)[0] - Y).max() < 1e-10


def test_fields_travel_with_the_nodes():
    X = uneven()
    Y, x, y = redistribute(X, X[:, 0], X[:, 1])
    assert np.abs(Y - X).max() > 1e-2
    assert np.abs(np.stack([x, y], axis=1) - Y).max() < 1e-9


def test_redistribution_of_a_collapsed_curve_names_it():
    X = np.stack([circle(32), np.zeros((2, 32))])
    with np.errstate(all="ignore"), pytest.raises(NumericalFailure, match="vesicle 1"):
        redistribute(X)


def test_area_and_length_are_restored_to_1e_10():
    Y, area_0, length_0 = bent()
    assert np.abs(curve.area(Y) / area_0 - 1).min() > 1e-4
    Z, changed = restore_area_length(Y, area_0, length_0)
    assert changed == 3
    assert np.abs(curve.area(Z) / area_0 - 1).max() < 1e-10
    assert np.abs(curve.length(Z) / length_0 - 1).max() < 1e-10


def test_the_displacement_is_along_the_normal_with_constant_and_curvature_alone():
    Y, area_0, length_0 = bent()
    d = restore_area_length(Y, area_0, length_0)[0] - Y
    n, c = curve.normal(Y), curve.curvature(Y)
    for i in range(3):
        basis = np.stack([n[i].ravel(), (c[i] * n[i]).ravel()], axis=1)
        rest = d[i].ravel() - basis @ np.linalg.lstsq(basis, d[i].ravel(), rcond=None)[0]
        assert np.abs(rest).max() < 1e-7 * np.abs(d[i]).max()


def test_restoring_commutes_with_reindexing_and_reflection():
    Y, area_0, length_0 = bent()
    Z, _ = restore_area_length(Y, area_0, length_0)
    assert np.abs(restore_area_length(np.roll(Y, 5, -1), area_0, length_0)[0] - np.roll(Z, 5, -1)).max() < 1e-10
    assert np.abs(restore_area_length(reflect(Y), area_0, length_0)[0] - reflect(Z)).max() < 1e-10


def test_vesicles_within_the_tolerance_stay_bitwise():
    Y, area_0, length_0 = bent()
    area_0[1], length_0[1] = curve.area(Y)[1], curve.length(Y)[1] * (1 + 5e-11)
    Z, changed = restore_area_length(Y, area_0, length_0)
    assert changed == 2
    assert (Z[1] == Y[1]).all()
    assert (Z[[0, 2]] != Y[[0, 2]]).any(axis=(1, 2)).all()
    assert restore_area_length(Z, area_0, length_0)[1] == 0


@pytest.mark.parametrize("excess", [1e-3, 5e-2])
def test_circles_and_near_circles_where_the_two_gradients_are_parallel(excess):
    X = circle(64, 1 / (2 * np.pi))
    Y = (1 + excess) * np.stack([X, X * (1 + 0.01 * np.cos(2 * nodes(64)))])
    area_0, length_0 = np.array([1.0, 1 - 1e-3 * excess]) * curve.area(X[None]), np.ones(2)
    Z, changed = restore_area_length(Y, area_0, length_0)
    assert changed == 2
    assert np.abs(curve.area(Z) / area_0 - 1).max() < 1e-10
    assert np.abs(curve.length(Z) - 1).max() < 1e-10
    assert np.abs(Z[0] - X).max() < 1e-9


@pytest.mark.parametrize("deficit", [0.0, 1e-9, 1e-5])
def test_a_circle_bent_by_many_modes_is_restored(deficit):
    """No displacement along n and c n alone takes the modes away together."""
    t, R = nodes(32), 1 / (2 * np.pi)
    r = R * (1 + 5e-3 * np.cos(2 * t + 0.4) + 2e-3 * np.cos(3 * t) + 1e-3 * np.sin(5 * t))
    X = (np.stack([r * np.cos(t), r * np.sin(t)]) + np.array([[3.0], [-2.0]]))[None]
    area_0, length_0 = np.array([(1 - deficit) * np.pi * R**2]), np.ones(1)
    Z, changed = restore_area_length(X, area_0, length_0)
    assert changed == 1
    assert np.abs(curve.area(Z) / area_0 - 1).max() < 1e-10
    assert np.abs(curve.length(Z) - 1).max() < 1e-10
    assert np.abs(Z - X).max() < 1.2 * np.abs(r - R).max()


def test_more_area_than_the_length_can_hold_raises_and_names_the_vesicle():
    Y, area_0, length_0 = bent()
    area_0[2] = 1.01 * length_0[2] ** 2 / (4 * np.pi)
    with pytest.raises(NumericalFailure, match="vesicle 2"):
        restore_area_length(Y, area_0, length_0)


def test_torch_equals_numpy():
    X, (Y, area_0, length_0) = uneven(), bent()
    assert np.abs(redistribute(torch.from_numpy(X))[0].numpy() - redistribute(X)[0]).max() < 1e-12
    Z, changed = restore_area_length(*(torch.from_numpy(a) for a in (Y, area_0, length_0)))
    assert changed == 3
    assert np.abs(Z.numpy() - restore_area_length(Y, area_0, length_0)[0]).max() < 1e-11
