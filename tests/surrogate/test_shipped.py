"""The shipped weights: small enough, whole, and as good as their cards say."""

import numpy as np
import pytest
from surrogate_cases import mild, smooth_field

from biem.membrane.maps import SLOTS, ExactMaps
from surrogate.library import KINDS, SHIPPED, find, kind_of, load_maps

BOUNDS = {"ivnet": 0.05, "mlp": 0.03, "hybrid": 0.01}  # relative L2 of each map, smooth shapes and velocities


def relative(a, b):
    axes = tuple(range(1, a.ndim))
    return np.sqrt(((a - b) ** 2).sum(axes) / (b**2).sum(axes))


def test_they_take_at_most_30_megabytes_and_are_of_one_reduced_area():
    cards = find(SHIPPED)
    assert sum(path.stat().st_size for path, _ in cards) <= 30e6
    assert {card.reduced_area for _, card in cards} == {0.65}
    for path, card in cards:
        assert path.parent.name == kind_of(card)
        assert all(0.0 <= e["median"] < 0.1 for e in card.errors.values())


@pytest.mark.parametrize("kind", KINDS)
def test_all_maps_of_a_kind_are_near_the_exact_ones(kind):
    maps, exact = load_maps(kind), ExactMaps(points=128)
    X, u = mild(6), smooth_field(6, 4)
    bound = BOUNDS[kind]
    assert np.median(relative(maps.advect(X, u), exact.advect(X, u))) < bound
    assert np.median(relative(maps.flow_tension(X, u), exact.flow_tension(X, u))) < bound
    assert np.median(relative(maps.self_tension(X), exact.self_tension(X))) < bound
    fine = X
    for _ in range(8):
        fine = exact.relax(fine, 1.25e-6)
    scale = np.abs(fine - X).max()
    assert np.median(np.abs(maps.relax(X, 1e-5) - fine).max(axis=(1, 2))) < 2 * bound * scale
    if kind != "hybrid":
        assert np.median(relative(maps.near_layers(X, u), exact.near_layers(X, u))) < bound
    assert set(maps.loaded) == set(SLOTS) - ({"near"} if kind == "hybrid" else set())
