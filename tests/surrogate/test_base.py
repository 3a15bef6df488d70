"""Labels by exact maps at few nodes: those of `ExactMaps`, one velocity at a time."""

import numpy as np
import pytest
from surrogate_cases import mild, mode_labels, sample

from biem.curves.fourier import resample
from biem.membrane.maps import ExactMaps
from surrogate.base import CHUNK, exact_labels


@pytest.mark.parametrize("points", [32, 48, 64])
@pytest.mark.parametrize("name", ["advection", "flow_tension"])
def test_operators_are_the_exact_maps_of_one_velocity_at_a_time(name, points):
    X = mild(2)
    got, want = exact_labels(X, name, points), mode_labels(name, X, points)
    want = want.reshape(got.shape)
    assert np.abs(got - want).max() < 1e-12 * np.abs(want).max()


@pytest.mark.parametrize("points", [32, 48])
def test_fields_are_the_exact_maps(points):
    X, maps = mild(2), ExactMaps(points=points)
    assert np.array_equal(exact_labels(X, "self_tension", points), maps.self_tension(X))
    assert np.array_equal(exact_labels(X, "relax", points, 3e-5), maps.relax(X, 3e-5) - X)


@pytest.mark.parametrize("name", ["relax", "self_tension", "advection", "flow_tension"])
def test_many_curves_are_the_curves_one_by_one(name):
    X = np.concatenate([mild(3)] * 6)
    assert len(X) > CHUNK
    whole = exact_labels(X, name, 32, 1e-5)
    assert whole.dtype == np.float64
    one = exact_labels(X[2:3], name, 32, 1e-5)[0]
    for row in (2, 17):
        assert np.abs(whole[row] - one).max() < 1e-12 * np.abs(one).max()


@pytest.mark.parametrize(("name", "bound"), [("relax", 2e-2), ("self_tension", 1e-2), ("advection/2", 1e-3), ("flow_tension/2", 2e-3)])
def test_at_twice_the_nodes_they_are_close_to_the_labels(pairs, name, bound):
    """In the median over shapes of the sample, which 32 nodes do not hold wholly: that remainder is what is learned."""
    rows = np.arange(48)
    label = pairs.read(name, rows)
    name, _, k = name.partition("/")
    got = exact_labels(pairs.read("X_std", rows).astype(np.float64), name, 64, 1e-5)
    got = got[:, int(k)] if k else got
    axes = tuple(range(1, label.ndim))
    errors = np.sqrt(((got - label) ** 2).sum(axes) / (label**2).sum(axes))
    assert 1e-6 < np.median(errors) < bound


def test_the_sample_is_what_the_pairs_are_of(pairs):
    X = sample()[0]
    assert np.abs(resample(X, 32) - pairs.read("X_std", np.arange(48))).max() < 1e-7


def test_there_are_none_of_near_layers():
    with pytest.raises(KeyError):
        exact_labels(mild(1), "near", 32)
