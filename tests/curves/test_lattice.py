"""Images: wrapping, cells, which images are near, crossings with images, packings that repeat themselves; boxes that shear."""

import numpy as np
import pytest
import shapely
import torch
from helpers import circle, ellipse, rotate

from biem.curves.crossing import pair_crossings, polygons
from biem.curves.curve import area
from biem.curves.lattice import Box, Lattice
from biem.curves.packing import assemble, grid, random_packing
from biem.curves.shapes import equilibrium
from biem.stokes.near_search import minimum_gap

LATTICES = (Lattice(1.0, 1.0), Lattice(1.3, 0.9, 0.4), Lattice(0.8, 2.0, -0.35))
BY_LATTICE = pytest.mark.parametrize("lattice", LATTICES)
BY_ARRAY = pytest.mark.parametrize("convert", [np.asarray, torch.from_numpy])


def numbers(x, lattice):
    """x (P, 2) in units of the lattice vectors."""
    return np.linalg.solve(lattice.vectors.T, np.asarray(x).T).T


@BY_LATTICE
@BY_ARRAY
def test_wrapped_points_are_images_in_the_rectangle(lattice, convert):
    x = np.random.default_rng(0).uniform(-9, 9, size=(500, 2))
    w = np.asarray(lattice.wrapped(convert(x)))
    assert np.abs(w / [lattice.width, lattice.height]).max() <= 0.5 + 1e-12
    apart = numbers(x - w, lattice)
    assert np.abs(apart - np.round(apart)).max() < 1e-12
    assert len(np.unique(np.round(apart), axis=0)) > 50
    assert np.abs(np.asarray(lattice.in_cell(convert(x))) - numbers(x, lattice)).max() < 1e-12
    assert np.abs(np.asarray(lattice.displacement(convert(np.round(apart)))) - (x - w)).max() < 1e-12


def test_vectors_and_their_reciprocals():
    for lattice in LATTICES:
        assert np.allclose(lattice.vectors @ lattice.reciprocal.T, 2 * np.pi * np.eye(2), atol=1e-13)
        assert lattice.area == pytest.approx(abs(np.linalg.det(lattice.vectors)))


def test_a_sheared_box_has_the_images_that_the_flow_carries_along():
    box = Box(1.5, 0.8, rate=3.0)
    start = np.array([[0.2, 0.1], [-0.4, 0.35]])
    for t in (0.0, 0.1, 1.0, 1.5 / (3.0 * 0.8), 77.7):
        lattice = box.at(t)
        assert abs(lattice.offset) <= 0.75
        carried = start[:, None, :] + np.array([[m * 1.5 + n * 3.0 * t * 0.8, n * 0.8] for m in range(-2, 3) for n in range(-2, 3)])
        back = lattice.wrapped(carried.reshape(-1, 2)).reshape(2, -1, 2)
        assert np.abs(back - start[:, None, :]).max() < 1e-12 * (1 + t) * 100
    assert box.at(1.5 / (3.0 * 0.8)).offset == pytest.approx(0.0, abs=1e-12)  # strained by a whole width: the same images
    assert Box(1.5, 0.8).at(5.0) == Lattice(1.5, 0.8)


def some_curves():
    rng = np.random.default_rng(1)
    return np.stack([rotate(0.12 * ellipse(32, 1.0, 0.4), rng.uniform(0, 3)) + rng.uniform(-4, 4, size=(2, 1)) for _ in range(6)])


@BY_LATTICE
@BY_ARRAY
@pytest.mark.parametrize("reach", [0.0, 0.1, 0.7])
def test_no_image_that_is_near_is_missing(lattice, convert, reach):
    X = some_curves()
    curves, source = (np.asarray(a) for a in lattice.with_images(convert(X), reach))
    assert np.array_equal(source[:6], np.arange(6))
    shift = (curves - X[source]).mean(axis=-1)
    assert np.abs(curves - X[source] - shift[..., None]).max() < 1e-12
    apart = numbers(shift, lattice)
    assert np.abs(apart - np.round(apart)).max() < 1e-11
    kept = {(int(s), *np.round(n).astype(int).tolist()) for s, n in zip(source, apart, strict=True)}
    assert len(kept) == len(source)  # none twice
    nodes = curves[:6].transpose(0, 2, 1).reshape(-1, 2)
    own = np.round(apart[:6]).astype(int)
    near = 0
    for s in range(6):
        for n in np.stack(np.meshgrid(np.arange(-6, 7), np.arange(-6, 7)), axis=-1).reshape(-1, 2):
            image = curves[s] + (n @ lattice.vectors)[:, None]
            distance = np.hypot(*(nodes[:, :, None] - image[None]).transpose(1, 0, 2)).min(axis=1)
            if n.any() and (distance <= reach).any():
                near += 1
                assert (s, *(own[s] + n).tolist()) in kept
    assert near > 5 or reach < 0.7
    assert len(source) < 6 * (13 if reach < 0.7 else 60)


def test_images_of_rows_that_have_slid_far_are_found():
    """Of a flat box, many rows up: as many as by bounding boxes among all images."""
    lattice, reach = Lattice(4.0, 0.5, 1.9), 3.0
    X = lattice.wrapped_curves(some_curves()[:1])
    low, high = X.min(axis=-1)[0], X.max(axis=-1)[0]
    d = np.array([[4.0 * m + 1.9 * n, 0.5 * n] for m in range(-20, 21) for n in range(-20, 21) if m or n])
    near = ((low + d <= high + reach) & (high + d >= low - reach)).all(axis=1).sum()
    assert near > 15
    assert len(lattice.with_images(X, reach)[0]) == 1 + near


def test_curves_torn_apart_have_no_images():
    X = some_curves()
    X[2, 0, 5], X[4, 1, 0] = 1e12, np.nan
    curves, source = LATTICES[0].with_images(X, 0.1)
    assert not np.isin([2, 4], source[6:]).any()
    assert np.isfinite(curves[6:]).all()


@BY_LATTICE
def test_crossings_with_images_are_those_in_the_middle(lattice):
    """A pair that crosses anywhere is found wherever its curves are, and one a little apart is not."""
    rng = np.random.default_rng(2)
    for gap, crossing in ((-1e-3, [(0, 1)]), (1e-3, [])):
        pair = np.stack([circle(32, 0.1, (-0.1, 0.0)), circle(32, 0.1, (0.1 + gap, 0.0))])
        for _ in range(10):
            moved = pair + rng.uniform(-1, 1, size=2)[:, None] + (rng.integers(-3, 4, size=(2, 2)) @ lattice.vectors)[..., None]
            assert pair_crossings(moved, None, lattice) == crossing
    assert pair_crossings(pair, None, Lattice(0.4015, 1.0)) == []
    assert pair_crossings(pair, None, Lattice(0.4005, 1.0)) == [(0, 1)]  # the other way round
    assert pair_crossings(pair[:1], None, Lattice(1.0, 0.1999)) == [(0, 0)]


@BY_LATTICE
def test_smallest_gap_also_to_images(lattice):
    one = circle(64, 0.05, (0.3, -0.2))
    to_itself = min(np.hypot(*(np.array(n) @ lattice.vectors)) for n in ((1, 0), (0, 1), (1, 1), (1, -1)))
    assert minimum_gap(one[None], lattice) == pytest.approx(to_itself - 0.1, abs=1e-4)
    other = circle(64, 0.05, np.array([0.3, -0.2]) + [0.0, 0.13] + np.array([3, -2]) @ lattice.vectors)
    assert minimum_gap(np.stack([one, other]), lattice) == pytest.approx(0.03, abs=1e-12)


SHAPE = equilibrium(64, 0.65, 1.0)


@pytest.mark.parametrize(
    ("count", "box"),
    [(1, (0.5, 0.2)), (3, (0.7, 0.6)), (8, (1.4, 0.9)), (30, (2.6, 2.5))],
    ids=["narrower than it is long", "one cell", "few cells", "many"],
)
def test_random_packings_that_repeat_themselves(count, box):
    shapes, gap = np.repeat(SHAPE[None], count, axis=0), 0.03
    for seed in range(10 if count == 1 else 1):
        centers, angles = random_packing(shapes, box, gap, np.random.default_rng(seed), periodic=True)
        assert ((centers >= 0) & (centers <= box)).all()
        X = assemble(shapes, centers, angles)
        lattice = Lattice(*box)
        assert minimum_gap(X, lattice) >= gap - 1e-9
        assert pair_crossings(X, None, lattice) == []
        assert len(np.unique(angles)) == count
        outside = ~shapely.contains_properly(shapely.box(0, 0, *box), polygons(X))
        assert outside.any() or count == 1  # some reach over a side


def test_a_packing_too_dense_is_refused_and_a_grid_keeps_its_gaps():
    shapes = np.repeat(SHAPE[None], 4, axis=0)
    room = 4.2 * float(area(SHAPE[None])[0])
    with pytest.raises(ValueError, match="4 vesicles do not fit"):
        random_packing(shapes, (room, 1.0), 0.05, np.random.default_rng(0), periodic=True)
    centers, angles = grid(shapes, (1.0, 0.4), 0.04)
    assert minimum_gap(assemble(shapes, centers, angles), Lattice(1.0, 0.4)) >= 0.04
