"""Distance from the training shapes: the shapes themselves are inside, others are not, wherever they are."""

import numpy as np
import pytest
import torch
from surrogate_cases import N, placed, sample

from biem.curves.fourier import resample
from biem.curves.pose import standardize
from biem.curves.shapes import ellipse, equilibrium, perturbed
from surrogate.distribution import AXES, Distribution


@pytest.fixture(scope="module")
def shapes():
    """All of the sample's training shapes."""
    return resample(sample((400, 0, 0))[0], N)


@pytest.fixture(scope="module")
def distribution(shapes):
    measured = Distribution(N)
    measured.measure(torch.from_numpy(shapes))
    return measured


def distance(distribution, X):
    return distribution(torch.from_numpy(standardize(np.ascontiguousarray(X))[0])).numpy() / float(distribution.limit)


def test_all_but_one_in_a_thousand_training_shapes_are_inside(distribution, shapes):
    d = distribution(torch.from_numpy(shapes)).numpy()
    assert len(d) == 400
    assert np.count_nonzero(d > float(distribution.limit)) == 1
    assert np.isclose(float(distribution.limit), np.quantile(d, 0.999), rtol=1e-12)


def test_shapes_of_other_runs_are_inside(distribution):
    X = resample(sample((0, 47, 36))[0], N)
    assert np.mean(distance(distribution, X) < 1) > 0.9


@pytest.mark.parametrize(
    "X",
    [
        equilibrium(N, 0.9),
        perturbed(N, 0.9, seed=2),
        ellipse(N, 0.97),
        ellipse(N, 0.3),
        perturbed(N, 0.35, seed=1),
    ],
)
def test_shapes_of_other_reduced_areas_are_outside(distribution, X):
    assert distance(distribution, X[None])[0] > 1.2


def test_rough_shapes_are_outside(distribution, shapes):
    """Two nodes moved by as much as lies between them: along none of the axes."""
    X = shapes[:50].copy()
    X[:, 0, 7] += 1 / N
    X[:, 0, 8] -= 1 / N
    assert np.median(distance(distribution, X)) > 1.2


def test_the_distance_is_that_in_the_principal_axes(distribution, shapes):
    flat = shapes.reshape(len(shapes), -1)
    _, s, V = np.linalg.svd(flat - flat.mean(0), full_matrices=False)
    X = flat.mean(0) + 3 * s[2] / np.sqrt(400) * V[2]
    rest = float(distribution.deviation[AXES])
    d = distribution(torch.from_numpy(X.reshape(1, 2, N)))
    assert abs(float(d[0]) - 3 / np.sqrt(AXES)) < 1e-6
    X = flat.mean(0) + 2 * rest * V[40]
    d = distribution(torch.from_numpy(X.reshape(1, 2, N)))
    assert abs(float(d[0]) - 2) < 1e-6
    root_mean_square = np.sqrt(np.mean(distribution(torch.from_numpy(shapes)).numpy() ** 2))
    assert abs(root_mean_square - np.sqrt(2)) < 1e-6


def test_where_a_shape_is_makes_no_difference(distribution, shapes):
    X = standardize(shapes[:5])[0]
    moved = np.stack([placed(x, 0.7 * k, (3.0, -k), 2.5, 5 * k) for k, x in enumerate(X)])
    assert np.allclose(distance(distribution, moved), distance(distribution, X), rtol=1e-9)


def test_a_distribution_that_was_not_measured_knows_no_limit():
    assert float(Distribution(N).limit) == float("inf")
