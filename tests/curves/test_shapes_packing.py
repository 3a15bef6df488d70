"""Initial shapes have what they promise, the equilibrium shape is one, and packings keep their gaps inside their box."""

import numpy as np
import pytest
import shapely
from helpers import nodes
from scipy.interpolate import CubicSpline

from biem.curves import curve, packing
from biem.curves.conserve import restore_area_length
from biem.curves.fourier import derivative
from biem.curves.shapes import ellipse, equilibrium, perturbed, place

SHAPES = [ellipse, equilibrium, perturbed]


def fine_polygons(X, n=1024):
    """Polygons through periodic cubic splines of the nodes (M, 2, N)."""
    N = X.shape[-1]
    closed = np.concatenate([X, X[..., :1]], axis=-1)
    fine = CubicSpline(np.linspace(0, N, N + 1), closed, axis=-1, bc_type="periodic")(np.arange(n) * N / n)
    return [shapely.Polygon(x.T) for x in fine]


def gaps(X):
    P = fine_polygons(X)
    return np.array([P[i].distance(P[j]) for i in range(len(P)) for j in range(i)])


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("reduced_area", [0.3, 0.4, 0.5, 0.65, 0.8, 0.95, 1.0])
def test_shapes_have_their_reduced_area_length_place_and_spacing(shape, reduced_area):
    N = 512 if reduced_area < 0.5 and shape is ellipse else 128  # the tips of a slender ellipse ask for many nodes
    X = shape(N, reduced_area, 2.5)[None]
    assert X.shape == (1, 2, N)
    assert curve.length(X)[0] == pytest.approx(2.5, rel=1e-12)
    assert curve.reduced_area(X)[0] == pytest.approx(reduced_area, abs=2e-6)
    assert np.abs(curve.centroid(X)).max() < 1e-10
    assert np.ptp(curve.speed(X)) < 1e-2 * curve.speed(X).mean()
    assert fine_polygons(X)[0].is_valid
    assert shapely.LinearRing(X[0].T).is_ccw
    if reduced_area < 1:
        assert abs(curve.inclination(X)[0]) < 1e-8
        assert np.ptp(X[0, 0]) > np.ptp(X[0, 1])


def test_equilibrium_energy_at_reduced_area_0_65():
    assert curve.bending_energy(equilibrium(128, 0.65)[None])[0] == pytest.approx(42.8572, abs=1e-4)
    assert curve.bending_energy(equilibrium(128, 1.0)[None])[0] == pytest.approx(2 * np.pi**2, rel=1e-12)


@pytest.mark.parametrize("reduced_area", [0.5, 0.65, 0.9])
def test_equilibrium_satisfies_the_shape_equation(reduced_area):
    """c_ss + c^3/2 = (tension) c + (pressure) on the membrane: nothing is left after a fit of the two constants."""
    X = equilibrium(128, reduced_area)[None]
    c, v = curve.curvature(X)[0], curve.speed(X)[0]
    force = derivative(derivative(c) / v) / v + c**3 / 2
    basis = np.stack([c, np.ones(128)], axis=1)
    rest = force - basis @ np.linalg.lstsq(basis, force, rcond=None)[0]
    assert np.abs(rest).max() < 1e-6 * np.abs(force).max()


@pytest.mark.parametrize("mode", [2, 3, 4, 5])
@pytest.mark.parametrize("phase", [0.2, 1.7])
def test_perturbing_the_equilibrium_at_fixed_area_and_length_raises_the_energy_quadratically(mode, phase):
    X = equilibrium(128, 0.65)[None]
    E = curve.bending_energy(X)[0]

    def rise(amplitude):
        Y = X + amplitude * np.cos(mode * nodes(128) + phase) * curve.normal(X)
        return curve.bending_energy(restore_area_length(Y, curve.area(X), curve.length(X))[0])[0] - E

    small = [rise(4e-4), rise(-4e-4)]
    assert min(small) > 1e-5
    assert rise(8e-4) + rise(-8e-4) == pytest.approx(4 * sum(small), rel=0.02)


def test_perturbed_shapes_are_random_by_their_seed():
    X = [perturbed(64, 0.8, seed=s) for s in (0, 0, 1)]
    assert (X[0] == X[1]).all()
    assert np.abs(X[0] - X[2]).max() > 1e-2


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize(("points", "reduced_area"), [(33, 0.8), (8, 0.8), (64, 0.0), (64, 1.01), (64, -0.2)])
def test_bad_arguments_raise(shape, points, reduced_area):
    with pytest.raises(ValueError, match="points" if points != 64 else "reduced_area"):
        shape(points, reduced_area)


def test_equilibrium_that_touches_itself_raises():
    with pytest.raises(ValueError, match="reduced area"):
        equilibrium(64, 0.1)


def test_place_turns_and_moves():
    X = place(np.array([[1.0, 0.0], [0.0, 2.0]]), (10.0, 20.0), np.pi / 2)
    assert pytest.approx(np.array([[10.0, 8.0], [21.0, 20.0]])) == X


@pytest.mark.parametrize(("count", "box"), [(1, (0.6, 0.3)), (12, (2.0, 0.8)), (16, (2.0, 0.8)), (7, (3.0, 0.9))])
def test_grid_keeps_its_gaps_inside_the_box(count, box):
    shapes = np.stack([equilibrium(64, 0.65)] * count)
    X = packing.assemble(shapes, *packing.grid(shapes, box, 0.05))
    assert len(X) == count
    assert (gaps(X) > 0.05 - 1e-9).all()
    assert X.min() > 0
    assert (X.max(axis=(0, 2)) < box).all()


def test_grid_with_too_many_vesicles_says_how_many_fit():
    shapes = np.stack([ellipse(64, 0.8)] * 17)
    width, height = np.ptp(shapes[0], axis=1)
    box = (4.5 * (width + 0.05), 3.2 * (height + 0.05))
    with pytest.raises(ValueError, match=r"\b12\b"):
        packing.grid(shapes, box, 0.05)
    assert len(packing.grid(shapes[:12], box, 0.05)[0]) == 12


def test_random_packing_of_40_vesicles_at_area_fraction_0_40():
    rng = np.random.default_rng(5)
    shapes = np.stack([ellipse(32, 0.8)] * 40)
    box = (2.0, curve.area(shapes).sum() / 0.40 / 2.0)
    X = packing.assemble(shapes, *packing.random_packing(shapes, box, 0.01, rng))
    assert gaps(X).min() > 0.01 - 1e-4  # the moves are checked on polygons of 4 corners a node
    assert X.min() > 0
    assert (X.max(axis=(0, 2)) < box).all()
    assert np.abs(curve.reduced_area(X) - curve.reduced_area(shapes)).max() < 1e-12  # full size
    assert np.ptp(curve.inclination(X)) > 2  # turned at random


def test_the_same_seed_gives_the_same_packing_of_vesicles_of_full_size():
    shapes = np.stack([ellipse(32, 0.8)] * 6)
    box = np.sqrt(curve.area(shapes).sum() / 0.55) * np.ones(2)
    a, b, c = (packing.random_packing(shapes, box, 0.01, np.random.default_rng(seed)) for seed in (6, 6, 5))
    assert (a[0] == b[0]).all()
    assert (a[1] == b[1]).all()
    assert np.abs(a[0] - c[0]).max() > 0.01
    assert min(gaps(packing.assemble(shapes, *placed)).min() for placed in (a, c)) > 0.01 - 1e-4


@pytest.mark.parametrize(("count", "gap"), [(12, 0.02), (4, 0.4)])
def test_random_packing_that_does_not_fit_raises(monkeypatch, count, gap):
    monkeypatch.setattr(packing, "MOST_MOVES", 10)
    shapes = np.stack([ellipse(32, 0.8)] * count)
    with pytest.raises(ValueError, match=f"{count} vesicles"):
        packing.random_packing(shapes, (0.6, 0.6), gap, np.random.default_rng(0))


def test_vesicles_that_would_fit_but_for_their_gaps_are_refused_at_once(monkeypatch):
    """Of the area that 20 cover, 1.03, 1.15 is there; with half of a gap around each it is 1.24."""
    shapes = np.repeat(equilibrium(32, 0.65)[None], 20, axis=0)
    side = float(np.sqrt(curve.area(shapes).sum() / 0.9))
    monkeypatch.setattr(packing, "MOST_MOVES", 0)  # none is made
    with pytest.raises(ValueError, match=r"they cover 1\.24, the box .* has 1\.15: at most 18 can fit"):
        packing.random_packing(shapes, (side, side), 0.02, np.random.default_rng(0))
    circles = np.repeat(ellipse(32, 1.0)[None], 16, axis=0)
    width = 4 * (np.ptp(circles[0, 0]) + 0.05)  # a grid of them does fit
    with pytest.raises(ValueError, match="no random packing"):
        packing.random_packing(circles, (width, width), 0.05, np.random.default_rng(0))
