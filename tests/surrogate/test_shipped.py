"""The shipped weights: small enough, whole, and as good as their cards say."""

import numpy as np
import pytest
from surrogate_cases import mild, smooth_field

from biem.membrane.maps import SLOTS, ExactMaps
from surrogate.library import KINDS, SHIPPED, find, kind_of, load_maps

SLOTS_OF = {"ivnet": set(SLOTS), "mlp": set(SLOTS), "hybrid": set(SLOTS) - {"near"}}
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
def test_maps_of_a_kind_are_near_the_exact_ones(kind):
    there = {card.network.map for _, card in find(SHIPPED) if kind_of(card) == kind}
    assert there == SLOTS_OF[kind]
    maps, exact = load_maps(kind, slots=there), ExactMaps(points=128)
    X, u = mild(6), smooth_field(6, 4)
    fine = X
    for _ in range(8):
        fine = exact.relax(fine, 1.25e-6)
    answers = {
        "relax": lambda m: (m.relax(X, 1e-5) if m is maps else fine) - X,
        "self_tension": lambda m: m.self_tension(X),
        "advection": lambda m: m.advect(X, u),
        "flow_tension": lambda m: m.flow_tension(X, u),
        "near": lambda m: m.near_layers(X, u),
    }
    for slot in sorted(there):
        bound = BOUNDS[kind] * (3 if slot == "relax" else 1)  # shapes near equilibrium: increments are small
        assert np.median(relative(answers[slot](maps), answers[slot](exact))) < bound, slot
