"""Hausdorff distance: analytic values, brute force, and the bound that finds near pairs."""

import numpy as np
import pytest
import shapely
from drawn_shapes import groups_of_shapes
from helpers import blob, circle, ellipse, nodes

from biem.curves.curve import curvature
from biem.curves.fourier import resample
from datagen.hausdorff import ANCHORS, CORNERS, ROUNDING, candidates, closer, descriptors, distance, nearest, polygons
from datagen.shapes import encode

R = 1 / (2 * np.pi)
SQUARE = np.array([[-1.0, 0.0], [-1.0, -1.0], [1.0, -1.0], [1.0, 0.0]])
CUP = np.array([*SQUARE, [0.9, 0.0], [0.9, -0.9], [-0.9, -0.9], [-0.9, 0.0]])


def polygon(X, corners=CORNERS):
    return np.ascontiguousarray(resample(X, corners).T)


def all_distances(P):
    d = np.zeros((len(P), len(P)))
    for i in range(len(P)):
        for j in range(i):
            d[i, j] = d[j, i] = distance(P[i], P[j])
    return d


def sampled_distance(A, B, per_side):
    """Of the points that cut every side of A and B in parts: no more than d_H, and less by half a part at most."""

    def directed(A, B):
        t = np.arange(per_side)[:, None, None] / per_side
        points = ((1 - t) * A + t * np.roll(A, -1, axis=0)).reshape(-1, 2)
        return shapely.distance(shapely.points(points), shapely.linearrings(B)).max()

    return max(directed(A, B), directed(B, A))


@pytest.fixture(scope="module")
def cloud():
    X = groups_of_shapes(groups=6, each=12, spread=0.01)
    P = polygons(X)
    return X, P, all_distances(P)


@pytest.mark.parametrize("gap", [2e-3, 2e-2])
def test_distance_of_circles(gap):
    """Shifted ones have exactly parallel polygons; of concentric ones the sides see corners, of those turned by half a side."""
    one = polygon(circle(64, R))
    assert distance(one, polygon(circle(64, R, (0.6 * gap, -0.8 * gap)))) == pytest.approx(gap, abs=1e-15)
    assert distance(one, polygon(circle(64, R + gap))) == pytest.approx(gap, abs=1e-15)


def test_distance_of_ellipse_and_circle():
    A = polygon(circle(64, 0.15))
    assert distance(A, polygon(ellipse(64, 0.2, 0.1))) == pytest.approx(0.05, abs=1e-15)
    assert distance(A, polygon(ellipse(64, 0.15, 0.15))) < 1e-15


def test_error_of_the_polygons_is_of_second_order_and_within_the_bound():
    """Circles turned by half a side: the corners of the outer polygon are c h^2/8 further from the inner one than the circles are."""
    errors = []
    for corners in (CORNERS // 2, CORNERS):
        t = nodes(corners) + np.pi / corners
        turned = (R + 2e-3) * np.stack([np.cos(t), np.sin(t)], axis=-1)
        errors.append(distance(turned, polygon(circle(64, R), corners)) - 2e-3)
    bound = (1 / R + 1 / (R + 2e-3)) / (8 * CORNERS**2)
    assert 0.3 * bound < errors[1] < bound
    assert errors[0] / errors[1] == pytest.approx(4, rel=0.02)


def test_error_of_the_polygons_of_rough_shapes():
    X = groups_of_shapes(groups=20, each=2, spread=0.03, seed=4)
    c = np.abs(curvature(resample(X, 1024))).max(axis=-1)
    errors = []
    for i in range(0, 40, 2):
        exact = distance(polygon(X[i], 4096), polygon(X[i + 1], 4096))
        errors.append(abs(distance(polygon(X[i]), polygon(X[i + 1])) - exact))
        assert errors[-1] <= (c[i] + c[i + 1]) / (8 * CORNERS**2)
    assert 1e-7 < max(errors) < 4e-5


def test_farthest_point_within_a_side():
    """The middle of the square's upper side is 0.9 from the cup; all corners are within 0.1 of the other polygon."""
    assert distance(SQUARE, CUP) == pytest.approx(0.9, abs=1e-9)
    assert distance(CUP, SQUARE) == pytest.approx(0.9, abs=1e-9)
    assert closer(SQUARE, CUP, 0.9 + 1e-9)
    assert not closer(SQUARE, CUP, 0.9 - 1e-9)


def test_distance_is_that_of_many_points():
    """Polygons of few corners, so that the farthest points lie within sides."""
    rng = np.random.default_rng(1)
    within = 0
    for _ in range(200):
        A, B = rng.normal(size=(7, 2)), rng.normal(size=(5, 2))
        d = distance(A, B)
        part = max(np.hypot(*(P - np.roll(P, 1, axis=0)).T).max() for P in (A, B)) / 200
        sampled = sampled_distance(A, B, 200)
        assert sampled - 1e-12 <= d <= sampled + part / 2
        within += d > sampled_distance(A, B, 1) + 1e-6
        assert closer(A, B, d + 1e-9)
        assert not closer(A, B, d - 1e-9)
    assert within >= 5


def test_distance_is_a_metric_and_knows_no_first_corner(cloud):
    _, P, d = cloud
    assert d[np.triu_indices(len(P), 1)].min() > 1e-4
    for i, j, k in np.random.default_rng(2).integers(0, len(P), (200, 3)):
        assert d[i, j] <= d[i, k] + d[k, j] + 1e-12
    for i, j in ((0, 1), (0, 40), (13, 14)):
        assert distance(np.roll(P[i], 77, axis=0), P[j]) == pytest.approx(d[i, j], abs=1e-12)
        assert distance(P[j], P[i]) == pytest.approx(d[i, j], abs=1e-12)
        assert distance(P[i], np.roll(P[i], 5, axis=0)) < 1e-15


def test_mirror_images_are_different_shapes():
    X = 0.2 * blob(nodes(128))
    assert distance(polygon(X), polygon(X[:, ::-1] * np.array([[1.0], [-1.0]]))) > 0.005


def test_closer_is_the_distance_compared(cloud):
    _, P, d = cloud
    near = np.argwhere(np.triu((d < 2e-2) & (d > 0)))
    assert len(near) > 300
    for i, j in near:
        assert closer(P[i], P[j], d[i, j] + 1e-11)
        assert not closer(P[i], P[j], d[i, j] - 1e-11)
    assert not any(closer(P[i], P[j], 2e-2) for i, j in np.argwhere(np.triu(d > 2e-2))[:300])
    assert not closer(P[0], P[0], 0.0)  # nothing is closer than 0
    assert closer(P[0], P[0], 1e-300)


def test_descriptors_of_a_circle():
    D = descriptors(polygon(circle(64, R))[None])[0]
    assert D.shape == (len(ANCHORS),) == (23,)
    assert np.abs(D - np.abs(np.hypot(*ANCHORS.T) - R)).max() < 1.001 / R / (8 * CORNERS**2)


def test_descriptors_bound_the_distance_from_below(cloud):
    """And closely: the mean over near pairs of bound/distance is above 0.85."""
    _, P, d = cloud
    D = descriptors(P)
    bound = np.abs(D[:, None] - D).max(axis=-1)
    assert (bound <= d + ROUNDING).all()
    near = (d > 0) & (d < 1e-2)
    assert near.sum() > 150
    assert (bound[near] / d[near]).mean() > 0.85


@pytest.mark.parametrize("eps", [1e-3, 5e-3, 2e-2, 0.5])
def test_candidates_miss_no_near_pair(cloud, eps):
    _, P, d = cloud
    D = descriptors(P)
    for column in (0, 11):
        order = np.argsort(D[:, column], kind="stable")
        reach = np.where(np.arange(len(P)) % 5, eps + ROUNDING, -1.0)
        start, rows = candidates(D[order], column, D, reach)
        found = np.zeros_like(d, dtype=bool)
        for i in range(len(P)):
            found[i, order[rows[start[i] : start[i + 1]]]] = True
        assert (found == (np.abs(D[:, None] - D).max(axis=-1) <= reach[:, None])).all()
        assert not (d < eps)[~found & (reach > 0)[:, None]].any()


def test_nearest_is_that_of_all_pairs(cloud):
    X, P, _ = cloud
    c = encode(X, 32)
    d = all_distances(polygons(c))
    np.fill_diagonal(d, np.inf)
    D = descriptors(polygons(c))
    for i in range(0, len(P), 3):
        j, found = nearest(c, D, i)
        assert j == d[i].argmin()
        assert found == pytest.approx(d[i].min(), abs=1e-12)
    twins = np.concatenate([c, c[:1]])
    assert nearest(twins, descriptors(polygons(twins)), 0) == (len(c), 0.0)
