"""Membranes around another fluid: a circle's modes, rigid motions, reciprocity, the limit of equal viscosities, maps against equations."""

import numpy as np
import pytest
from helpers import circle, nodes, rotate

from biem.backend import counting
from biem.curves.curve import arclength_weights, normal
from biem.curves.shapes import ellipse, equilibrium
from biem.membrane.contrast import ContrastMaps, ContrastOperators
from biem.membrane.maps import ExactMaps
from biem.membrane.operators import VesicleOperators, bending_force, surface_divergence, tension_force
from biem.stokes.double_layers import double_layer
from biem.stokes.single_layer import single_layer

CONTRASTS = np.array([0.2, 5.0, 1e3])


def three(N, shape=equilibrium, reduced_area=0.65):
    """The same shape three times, turned."""
    one = shape(N, reduced_area)
    return np.stack([rotate(one, angle) for angle in (0.0, 0.8, 2.1)])


def operators(X, contrast, mu=1.0):
    return ContrastOperators(X, 1.0, mu, None, np.asarray(contrast))


@pytest.mark.parametrize("contrast", [0.2, 5.0, 1e4])
@pytest.mark.parametrize("mode", [-3, 2, 5])
def test_velocities_of_a_circle(contrast, mode):
    """Forces of mode m other than 0 and 1: u is 2/(1 + lambda) of what it is without contrast, as D vanishes on these modes."""
    X = circle(64, 0.7, (0.3, 0.2))[None]
    for amplitude in (1.0, 1.0j):
        f = amplitude * np.exp(1j * mode * nodes(64))
        f = np.concatenate([f.real, f.imag])
        want = 2.0 / (1.0 + contrast) * (VesicleOperators(X).S[0] @ f)
        assert np.abs(operators(X, [contrast]).S[0] @ f - want).max() < 1e-13 * max(1.0, np.abs(want).max())


@pytest.mark.parametrize("contrast", [0.2, 5.0, 1e4])
def test_a_circle_turns_and_expands(contrast):
    """Modes of D are -1/2 for rotation, which no viscosity inside resists, and 1/2 for expansion: A multiplies that by lambda."""
    X = circle(64, 0.7)
    A_inverse = operators(X[None], [contrast]).A_inverse[0]
    turning, expanding = np.concatenate([-X[1], X[0]]), X.ravel()
    assert np.abs(A_inverse @ turning - turning).max() < 1e-12 * contrast
    assert np.abs(A_inverse @ expanding - expanding / contrast).max() < 1e-12


def test_rigid_motions_pass_through_any_vesicle():
    X = three(64)
    for motion in (lambda x: 1.0 + 0.0 * x, lambda x: np.stack([-x[:, 1], x[:, 0]], axis=1)):
        u = motion(X).reshape(3, -1, 1)
        assert np.abs(operators(X, CONTRASTS).outer(u) - u).max() < 1e-11


def test_forces_and_velocities_are_reciprocal():
    """int g . A^-1 S f ds is symmetric in f and g, and positive: what membranes do to a fluid of two viscosities is dissipated."""
    X = three(64)
    rng = np.random.default_rng(0)
    waves = np.stack([np.cos(k * nodes(64) + 0.3 * k) for k in range(8)])
    f, g = (np.concatenate([rng.normal(size=8) @ waves, rng.normal(size=8) @ waves]) for _ in range(2))
    for ds, S in zip(arclength_weights(X), operators(X, CONTRASTS).S, strict=True):
        weights = np.tile(ds, 2)
        fg, gf = (weights * f) @ (S @ g), (weights * g) @ (S @ f)
        assert fg == pytest.approx(gf, rel=1e-10)
        assert (weights * f) @ (S @ f) > 0.0


def test_the_fluid_sticks_to_both_sides_of_the_membrane():
    """Velocities next to it, by the representation outside, and inside over lambda, are those of the membrane; it keeps its area."""
    X, contrast, mu = three(96)[1:2], 5.0, 0.7
    f = bending_force(X)
    v = np.stack([100.0 * X[:, 1], 0.0 * X[:, 0]], axis=1)
    maps = ContrastMaps(1.0, mu, contrast=np.array([contrast]))
    u = maps.velocity(X, f, v)
    n, d = normal(X), 1e-9
    for side in (1.0, -1.0):
        x = (X + side * d * n)[0].T
        fluid = np.stack([100.0 * x[:, 1], 0.0 * x[:, 0]], axis=1)
        fluid = fluid + single_layer(X, f, x, mu, tolerance=1e-10) + (1.0 - contrast) * double_layer(X, u, x, 1e-10)
        fluid = fluid / (contrast if side < 0 else 1.0)
        assert np.abs(fluid - u[0].T).max() < 1e-6 * np.abs(u).max()
    assert np.abs((u * n).sum(axis=1) @ arclength_weights(X)[0]) < 1e-9 * np.abs(u).max()


def test_contrast_1_is_the_plain_vesicle():
    X, one = three(32), np.ones(3)
    plain, maps = ExactMaps(1.3, 0.7), ContrastMaps(1.3, 0.7, contrast=one)
    u = np.stack([np.cos(3 * X[:, 1]), np.sin(5 * X[:, 0])], axis=1)
    for got, want in (
        (maps.advect(X, u), plain.advect(X, u)),
        (maps.relax(X, 1e-5) - X, plain.relax(X, 1e-5) - X),
        (maps.self_tension(X), plain.self_tension(X)),
        (maps.flow_tension(X, u), plain.flow_tension(X, u)),
        (maps.near_layers(X, u), plain.near_layers(X, u)),
    ):
        assert np.abs(got - want).max() < 1e-4 * np.abs(want).max()  # of two quadratures at 64 nodes


def test_maps_solve_their_equations():
    """P u = 0 for u = A^-1 (S f + v) with the tension that the maps give, and advection is that without bending."""
    X = three(64, ellipse, 0.95)
    maps = ContrastMaps(1.3, 0.7, 128, contrast=CONTRASTS)
    v = np.stack([100.0 * X[:, 1], np.cos(4 * X[:, 0])], axis=1)
    sigma = -(maps.self_tension(X) + maps.flow_tension(X, v))
    u = maps.velocity(X, bending_force(X, 1.3) + tension_force(X, sigma), v)
    assert np.abs(surface_divergence(X, u)).max() < 1e-4 * np.abs(surface_divergence(X, v)).max()
    advected = maps.velocity(X, tension_force(X, -maps.flow_tension(X, v)), v)
    assert np.abs(maps.advect(X, v) - advected).max() < 1e-7 * np.abs(v).max()
    dt = 1e-9
    relaxing = maps.velocity(X, bending_force(X, 1.3) + tension_force(X, -maps.self_tension(X)), 0 * v)
    assert np.abs((maps.relax(X, dt) - X) / dt - relaxing).max() < 1e-4 * np.abs(relaxing).max()


def test_each_vesicle_has_its_own_contrast():
    X = three(32)
    together = ContrastMaps(contrast=CONTRASTS)
    for m, contrast in enumerate(CONTRASTS):
        alone = ContrastMaps(contrast=np.array([contrast]))
        assert np.abs(together.advect(X, X)[m] - alone.advect(X[[m]], X[[m]])[0]).max() < 1e-12
        assert np.abs(together.relax(X, 1e-5)[m] - alone.relax(X[[m]], 1e-5)[0]).max() < 1e-12


def test_one_factorisation_serves_a_step():
    X, maps = three(32), ContrastMaps(contrast=CONTRASTS)
    with counting() as counts:
        maps.self_tension(X)
        maps.flow_tension(X, X)
        maps.velocity(X, X, X)
        maps.advect(X, X)
    assert counts["contrast_matrix"] == counts["double_layer_matrix"] == counts["tension_matrix"] == 3
    with counting() as counts:
        maps.relax(X, 1e-5)
    assert counts["contrast_matrix"] == counts["relaxation_matrix"] == 3
