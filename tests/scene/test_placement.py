"""Vesicles put in their places: explicitly, on a grid, at random; what cannot be is refused."""

import numpy as np
import pytest
from scene_helpers import scene_of

from biem.curves.curve import area, centroid, length
from biem.scene.build import build
from biem.scene.config import make_scene
from biem.stokes.near_search import minimum_gap


def placed(**vesicles):
    return build(scene_of(vesicles={"points": 32, **vesicles})).X


def test_explicit_placement():
    X = placed(length=2.0, reduced_area=0.7, centers=[[1.0, 2.0], [-1.0, 0.5]], angles=[0.0, np.pi / 2])
    turned = np.stack([-(X[0, 1] - 2.0) - 1.0, X[0, 0] - 1.0 + 0.5])
    assert np.abs(X[1] - turned).max() < 1e-14
    assert np.abs(length(X) - 2.0).max() < 1e-13
    assert np.abs(4 * np.pi * area(X) / length(X) ** 2 - 0.7).max() < 1e-3
    assert np.ptp(X[0, 0]) > np.ptp(X[0, 1])  # the long axis lies along x
    assert placed().shape == (1, 2, 32)
    assert np.abs(placed().mean(axis=-1)).max() < 1e-12
    R = np.sqrt(area(X[:1])[0] / np.pi)
    in_radii = placed(length=2.0, reduced_area=0.7, centers=[[1.0 / R, 2.0 / R]], unit="R")
    assert np.abs(in_radii - X[0]).max() < 1e-13


def test_overlapping_centers_are_refused_with_the_pair():
    with pytest.raises(ValueError, match="vesicles 0 and 2 overlap"):
        placed(centers=[[0.0, 0.0], [5.0, 0.0], [0.1, 0.0]])


@pytest.mark.parametrize("placement", ["grid", "random"])
@pytest.mark.parametrize("shape", ["ellipse", "perturbed"])
def test_packings_keep_count_gap_box_and_seed(placement, shape):
    keys = {"placement": placement, "shape": shape, "count": 4, "box": [1.0, 1.0], "corner": [3.0, -1.0], "gap": 0.03, "seed": 5}
    X = placed(**keys)
    assert X.shape == (4, 2, 32)
    assert minimum_gap(X) >= 0.03 - 1e-9
    assert (X[:, 0].min(), X[:, 1].min()) >= (3.0, -1.0)
    assert (X[:, 0].max(), X[:, 1].max()) <= (4.0, 0.0)
    assert np.array_equal(placed(**keys), X)
    if (placement, shape) != ("grid", "ellipse"):
        assert not np.array_equal(placed(**{**keys, "seed": 6}), X)
    fraction = placed(placement=placement, shape=shape, area_fraction=0.2, count=4)
    assert np.abs(fraction).max() < 0.5 * np.sqrt(area(fraction).sum() / 0.2)  # the box, centred on the origin


def test_placements_that_cannot_be_are_refused():
    for keys, fragment in [
        ({"placement": "grid", "count": 50, "box": [1.0, 1.0]}, "do not fit"),
        ({"placement": "random", "count": 50, "box": [1.0, 1.0], "gap": 0.5}, "do not fit"),
        ({"placement": "grid", "count": 4}, "two of count, area_fraction and box"),
        ({"placement": "grid", "count": 4, "box": [1.0, 1.0], "area_fraction": 0.1}, "two of count, area_fraction and box"),
        ({"placement": "grid", "count": 1, "box": [-1.0, 1.0]}, "vesicles.box"),
        ({"placement": "grid", "count": 1, "box": [1.0, 1.0], "centers": [[0.0, 0.0]]}, "explicit"),
        ({"count": 4}, "vesicles.count"),
        ({"angles": [0.1, 0.2]}, "angles"),
    ]:
        with pytest.raises(ValueError, match=fragment):
            placed(**keys)
    with pytest.raises(ValueError, match=r"solver\.operator_points = 16 is below vesicles\.points = 32"):
        build(scene_of(vesicles={"points": 32}, solver={"operator_points": 16}))


HOW = [{"box": [2.0, 2.0], "count": 9}, {"area_fraction": 0.3, "count": 9}, {"area_fraction": 0.2, "box": [2.0, 1.5]}]


@pytest.mark.parametrize("how", HOW)
@pytest.mark.parametrize("shape", ["equilibrium", "perturbed"])
@pytest.mark.parametrize("placement", ["random", "grid"])
def test_vesicles_are_where_they_are_at_any_resolution(how, shape, placement):
    X = [build(scene_of(vesicles={**how, "placement": placement, "shape": shape, "points": N})).X for N in (32, 96)]
    for other in X[1:]:
        np.testing.assert_allclose(centroid(other), centroid(X[0]), atol=1e-4)  # 32 nodes hold the shape to that


def test_between_walls_too():
    walls, time = {"kind": "circle", "radius": 1.0, "omega": 1.0}, {"dt": 1.0, "horizon": 1.0}
    vesicles = lambda N: {"placement": "random", "count": 4, "points": N}
    X = [build(make_scene({"name": "walled", "vesicles": vesicles(N), "walls": walls, "time": time})).X for N in (32, 64)]
    np.testing.assert_allclose(centroid(X[0]), centroid(X[1]), atol=1e-4)


def test_a_place_too_far_for_the_digits_of_a_shape_is_refused():
    assert placed(centers=[[1e6, 0.0]]).shape == (1, 2, 32)
    with pytest.raises(ValueError, match=r"vesicle 1 is .* times its size from the origin"):
        placed(centers=[[0.0, 0.0], [1e10, 0.0]])
