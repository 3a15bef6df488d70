"""Layers next to their curve: against graded quadrature at all distances, exact flows, jumps; far away, on nodes and between them."""

import numpy as np
import pytest
from helpers import (
    FEET,
    blob,
    blob_case,
    blob_density,
    blob_derivative,
    blob_normal,
    circle,
    gauss_legendre,
    nodes,
    standing_off,
    stokeslet_sum,
    two_blobs,
)

from biem.stokes import goursat
from biem.stokes.goursat import GoursatFunctions
from biem.stokes.kernels import double_layer, pressure_of_double_layer, pressure_of_force, stress_of_force

MU = 1.7
DISTANCES = [0.1, 1e-2, 1e-3, 1e-5, 1e-8]


def graded(offset, n=800):
    """For each of `standing_off(offset)`: the point, nodes t, normals and weighted densities by `helpers.blob_layer_by_sinh`'s rule."""
    z, w = gauss_legendre(n)
    for x, t0 in zip(standing_off(offset), FEET, strict=True):
        e = abs(offset) / np.hypot(*blob_derivative(t0))
        half = np.arcsinh(np.pi / e)
        t = t0 + e * np.sinh(half * z)
        ds = w * half * e * np.cosh(half * z) * np.hypot(*blob_derivative(t))
        yield x, x[:, None] - blob(t), t, blob_density(t) * ds


def single_exact(offset):
    """Velocity (13, 2) for mu = MU, pressure (13,) and stress (13, 2, 2) of the blob's single layer."""
    values = []
    for x, r, t, g in graded(offset):
        p = (np.stack(pressure_of_force(*r)) * g).sum()
        values.append((stokeslet_sum(x[None], blob(t), g)[0] / MU, p, stress_of_force(r, g).sum(-1)))
    return tuple(np.array(v) for v in zip(*values, strict=True))


def double_exact(offset):
    """Velocity and pressure of its double layer."""
    values = []
    for _, r, t, g in graded(offset):
        xx, xy, yy = double_layer(*r, *blob_normal(t))
        p = (np.stack(pressure_of_double_layer(*r, *blob_normal(t), MU)) * g).sum()
        values.append((np.array([(xx * g[0] + xy * g[1]).sum(), (xy * g[0] + yy * g[1]).sum()]), p))
    return tuple(np.array(v) for v in zip(*values, strict=True))


def of_blob(N=64, single=True, double=False, tolerance=1e-10):
    X, f = (a[None] for a in blob_case(N))
    return GoursatFunctions.build(X, f if single else None, f if double else None, np.array([0]), MU, tolerance)


def at(functions, x, outside, **asked):
    return functions.evaluate(x, np.zeros(len(x), dtype=int), np.full(len(x), outside), **asked)


def stress_of(close):
    p, D = 2.0 * close.potential.real, close.deviator
    return np.array([[D.real - p, -D.imag], [-D.imag, -D.real - p]]).transpose(2, 0, 1)


@pytest.mark.parametrize("outside", [True, False])
@pytest.mark.parametrize("distance", DISTANCES)
def test_velocity_pressure_and_stress_of_forces_are_exact_at_any_distance(distance, outside):
    offset = distance if outside else -distance
    close = at(of_blob(), standing_off(offset), outside)
    u, p, s = single_exact(offset)
    rounding = 3e-12 + 3e-17 / distance  # of the quadrature, whose integrand is of size 1/distance
    assert np.abs(close.velocity - u).max() < 1e-13
    assert np.abs(2 * close.potential.real - p).max() < rounding
    assert np.abs(stress_of(close) - s).max() < rounding
    assert np.abs(s).max() > 0.5


@pytest.mark.parametrize("outside", [True, False])
@pytest.mark.parametrize("distance", DISTANCES[:4])
def test_velocity_and_pressure_of_a_double_layer_are_exact_at_any_distance(distance, outside):
    offset = distance if outside else -distance
    close = at(of_blob(single=False, double=True), standing_off(offset), outside)
    u, p = double_exact(offset)
    assert np.abs(close.velocity - u).max() < 2e-12 + 1e-17 / distance
    assert np.abs(2 * close.potential.real - p).max() < (1e-11 + 3e-18 / distance**2) * np.abs(p).max()


def test_both_layers_together_are_the_sum_of_both():
    x = standing_off(-0.01)
    parts = [at(of_blob(64, single, double), x, False) for single, double in ((True, False), (False, True), (True, True))]
    for name in ("velocity", "potential", "deviator"):
        a, b, both = (getattr(part, name) for part in parts)
        assert np.abs(a + b - both).max() < 1e-11 * np.abs(both).max()


def test_stress_of_a_double_layer_is_that_of_its_velocity():
    functions, x, h = of_blob(single=False, double=True), standing_off(0.03), 1e-5
    moved = {step: at(functions, x + np.array(step) * h, True).velocity for step in ((1, 0), (-1, 0), (0, 1), (0, -1))}
    du_dx, du_dy = (moved[1, 0] - moved[-1, 0]) / (2 * h), (moved[0, 1] - moved[0, -1]) / (2 * h)
    close = at(functions, x, True)
    D = MU * (du_dx[:, 0] - du_dy[:, 1]) - 1j * MU * (du_dx[:, 1] + du_dy[:, 0])
    assert np.abs(close.deviator - D).max() < 1e-6 * np.abs(D).max()
    assert np.abs(-2 * close.potential.imag / MU - (du_dx[:, 1] - du_dy[:, 0])).max() < 1e-6 * np.abs(D).max()
    assert np.abs(du_dx[:, 0] + du_dy[:, 1]).max() < 1e-6 * np.abs(D).max()


def test_a_circle_under_pressure_holds_it_inside():
    n = circle(32)
    functions = GoursatFunctions.build((2.0 + 0.7 * n)[None], -3.0 * n[None], None, np.array([0]), MU, 1e-10)
    ring = np.stack([np.cos(FEET), np.sin(FEET)], axis=1)
    for radius, outside in ((0.1, False), (0.7 - 1e-8, False), (0.7 + 1e-8, True), (1.0, True)):
        close = at(functions, 2.0 + radius * ring, outside)
        assert np.abs(close.velocity).max() < 1e-13
        assert np.abs(stress_of(close) + (0.0 if outside else 3.0) * np.eye(2)).max() < 1e-12
    assert functions.levels[0].w.shape[-1] == 128  # what is resolved is not refined


def test_on_the_curve_are_the_limits_of_the_side_at_nodes_and_between():
    functions, t = of_blob(32), np.append(nodes(32), nodes(32) + 0.07)
    x, n, f = blob(t).T, blob_normal(t).T, blob_density(t).T
    outer, inner = at(functions, x, True), at(functions, x, False)
    assert np.abs(outer.velocity - inner.velocity).max() < 1e-13
    assert np.abs(((stress_of(outer) - stress_of(inner)) @ n[:, :, None])[..., 0] + f).max() < 1e-11
    assert np.abs(2 * (outer.potential - inner.potential).real - (f * n).sum(1)).max() < 1e-11
    nearby = at(functions, x + 1e-7 * n, True)
    assert np.abs(nearby.potential - outer.potential).max() < 1e-5


def test_nodes_are_added_until_the_curve_is_resolved(monkeypatch):
    monkeypatch.setattr(goursat, "FIRST", 32)
    x, (u, p, _) = standing_off(1e-3), single_exact(1e-3)
    errors = []
    for tolerance in (1e-2, 1e-5, 1e-9):
        functions = of_blob(16, tolerance=tolerance)
        close = at(functions, x, True)
        errors.append((functions.levels[-1].w.shape[-1], np.abs(2 * close.potential.real - p).max()))
        assert np.abs(close.velocity - u).max() < 0.1 * tolerance
    (few, rough), _, (many, fine) = errors
    assert few < many
    assert fine < 1e-9 < rough < 1e-2


def test_far_away_a_layer_is_a_point_force():
    X, f = (a[None] for a in blob_case(64))
    functions = of_blob(64)
    x = 1e5 * np.stack([np.cos(FEET), np.sin(FEET)], axis=1)
    total = (f[0] * np.hypot(*blob_derivative(nodes(64)))).sum(-1) * 2 * np.pi / 64
    assert np.abs(at(functions, x, True).velocity - stokeslet_sum(x, np.zeros((2, 1)), total[:, None]) / MU).max() < 1e-6
    assert X.shape == (1, 2, 64)


def test_each_target_meets_its_own_curve_and_only_what_is_asked_for():
    X, f, _ = two_blobs(32)
    x = np.array([X[0, :, 3] + 1e-3, X[1, :, 5] + 1e-3, X[0, :, 9] - 1e-3])
    vesicle, outside = np.array([0, 1, 0]), np.array([True, False, False])
    both = GoursatFunctions.build(X, f, None, np.array([0, 1]), MU, 1e-9).evaluate(x, vesicle, outside)
    for m in (0, 1):
        mine = vesicle == m
        alone = GoursatFunctions.build(X, f, None, np.array([m]), MU, 1e-9).evaluate(x[mine], vesicle[mine], outside[mine])
        for name in ("velocity", "potential", "deviator"):
            assert np.abs(getattr(both, name)[mine] - getattr(alone, name)).max() < 1e-14 * np.abs(getattr(both, name)).max() + 1e-14
    functions = GoursatFunctions.build(X, f, None, np.array([0, 1]), MU, 1e-9)
    velocity, stress = functions.evaluate(x, vesicle, outside, deviator=False), functions.evaluate(x, vesicle, outside, velocity=False)
    pressure = functions.evaluate(x, vesicle, outside, False, False)
    assert np.array_equal(velocity.velocity, both.velocity)
    assert np.array_equal(stress.deviator, both.deviator)
    assert np.array_equal(pressure.potential, both.potential)
    assert (velocity.deviator.size, stress.velocity.size, pressure.velocity.size, pressure.deviator.size) == (0, 0, 0, 0)
