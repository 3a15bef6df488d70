"""ExactMaps: definitions of the maps, building at 2 N, scaling, the near layers."""

import numpy as np
import pytest

from biem.curves.curve import length, normal
from biem.curves.fourier import resample, shift
from biem.curves.shapes import equilibrium, perturbed
from biem.membrane.maps import LAYERS, ExactMaps, operator_points
from biem.membrane.operators import VesicleOperators
from biem.stokes.single_layer import single_layer


def fine_shapes(count=4, **options):
    return np.stack([perturbed(512, 0.65, seed=seed, **options) for seed in range(count)])


def waves(k, X):
    alpha = 2 * np.pi * np.arange(X.shape[-1]) / X.shape[-1]
    return np.broadcast_to(np.stack([np.cos(k * alpha), np.sin(k * alpha)]), X.shape)


def test_maps_solve_their_equations():
    X = fine_shapes(2)[..., ::4]
    dt, maps, ops = 1e-5, ExactMaps(), VesicleOperators(X)
    u = waves(2, X)
    vec = lambda a: a.reshape(a.shape[0], -1, 1)
    project = np.eye(256) - ops.M
    assert np.allclose(vec(maps.advect(X, u)), project @ vec(u), atol=1e-12)
    X_next = maps.relax(X, dt)
    B_next = ops.B @ vec(X_next - X) + vec(ops.bending_velocity())
    assert np.allclose(vec(X_next - X) / dt, project @ B_next, atol=1e-6 * np.abs(X_next - X).max() / dt)
    for sigma, v in ((maps.flow_tension(X, u), vec(u)), (maps.self_tension(X), vec(ops.bending_velocity()))):
        assert np.allclose(ops.L @ sigma[..., None], ops.P @ v, atol=1e-9 * np.abs(ops.P @ v).max())


@pytest.mark.parametrize("name", ["advect", "self_tension", "relax"])
def test_building_at_twice_the_nodes_removes_the_aliasing(name):
    """At N = 32: points = 64 equals points = 128 in error and beats points = 32 by far for smooth shapes."""
    X = fine_shapes(modes=5)
    u = {
        "advect": lambda m, Y: m.advect(Y, waves(8, Y)),
        "self_tension": lambda m, Y: m.self_tension(Y),
        "relax": lambda m, Y: m.relax(Y, 1e-5) - Y,
    }[name]
    want = resample(u(ExactMaps(points=256), X[..., ::2]), 32)

    def error(points):
        got = u(ExactMaps(points=points), X[..., ::16])
        return np.median(np.sqrt(((got - want) ** 2).reshape(4, -1).sum(1) / (want**2).reshape(4, -1).sum(1)))

    native, double, fourfold = error(32), error(64), error(128)
    assert double == pytest.approx(fourfold, rel=0.1)
    assert double < {"advect": 0.02, "self_tension": 0.4, "relax": 0.7}[name] * native


@pytest.mark.parametrize("name", ["advect", "self_tension", "flow_tension"])
def test_maps_do_not_depend_on_where_the_nodes_lie(name):
    """Read at the nodes, modes that 32 nodes cannot hold would alias, by 1e-2 and differently at other nodes of the same curve."""
    X = resample(fine_shapes(modes=5), 32)
    moved = lambda f: shift(f, np.full(f.shape[:-1], 2 * np.pi / 96))
    u, maps = waves(2, X), ExactMaps(points=128)
    of = {
        "advect": maps.advect,
        "self_tension": lambda Y, v: maps.self_tension(Y),
        "flow_tension": maps.flow_tension,
    }[name]
    want = moved(of(X, u))
    assert np.abs(of(moved(X), moved(u)) - want).max() < 1e-7 * np.abs(want).max()


def test_default_points():
    assert [operator_points(N) for N in (16, 32, 64, 94, 96, 128)] == [32, 64, 128, 188, 96, 128]
    assert operator_points(32, 48) == 48
    for points in (31, 30, 63):
        with pytest.raises(ValueError, match="at least 32"):
            operator_points(32, points)


def test_points_that_are_no_multiple_of_the_nodes():
    X = fine_shapes(2, modes=4)[..., ::16]
    assert np.allclose(ExactMaps(points=80).relax(X, 1e-5), ExactMaps(points=128).relax(X, 1e-5), atol=1e-6)


def test_scaling_with_length_stiffness_and_viscosity():
    """relax depends on dt kappa_b/(mu L^3) alone; S_sigma scales as kappa_b/L^2 (times nothing of mu)."""
    X = fine_shapes(2, modes=4)[..., ::4]
    a, kappa_b, mu = 3.0, 2.0, 5.0
    maps = ExactMaps(kappa_b, mu)
    dt = 1e-5 * mu * a**3 / kappa_b
    assert np.allclose(maps.relax(a * X, dt), a * ExactMaps().relax(X, 1e-5), atol=1e-12)
    assert np.allclose(maps.self_tension(a * X), kappa_b / a**2 * ExactMaps().self_tension(X), rtol=1e-7)
    assert np.allclose(maps.advect(a * X, waves(3, X)), ExactMaps().advect(X, waves(3, X)), atol=1e-12)


def test_equilibrium_shape_stays():
    X = equilibrium(128, 0.65)[None]
    assert np.abs(ExactMaps().relax(X, 1e-4) - X).max() < 1e-9


def test_near_layers_are_the_single_layer_there():
    X = fine_shapes(2, modes=4)[..., ::8]
    f = waves(3, X)
    u = ExactMaps(mu=2.0).near_layers(X, f)
    assert u.shape == (2, len(LAYERS), 2, 64)
    fine, f_fine = resample(X, 1024), waves(3, resample(X, 1024))
    h = length(X)[:, None, None] / 64
    for m in range(2):
        on_curve = VesicleOperators(resample(X, 128), mu=2.0).S[m] @ resample(f, 128)[m].reshape(-1)
        assert np.allclose(u[m, 2], on_curve.reshape(2, 128)[:, ::2], atol=1e-7)
        for k, offset in enumerate(LAYERS):
            if offset:
                targets = (X + offset * h * normal(X))[m].T
                want = single_layer(fine[m : m + 1], f_fine[m : m + 1], targets, mu=2.0, near_field="none").T
                assert np.abs(u[m, k] - want).max() < 1e-6 * np.abs(want).max()
