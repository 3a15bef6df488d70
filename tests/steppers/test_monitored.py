"""Maps that watch over their validity are heard once a state, with the array that all maps of the step get, on every rank's share."""

from dataclasses import dataclass, field, replace

import numpy as np
import pytest
from split_cases import linear_flow
from thread_ranks import on_threads

from biem.curves.shapes import ellipse
from biem.errors import NumericalFailure
from biem.membrane.maps import ExactMaps, Monitored
from biem.steppers.order import Extrapolated
from biem.steppers.split import SplitStepper
from biem.steppers.stepper import State

SHEAR = linear_flow([[0.0, 10.0], [0.0, 0.0]])
DT = 1e-4


def row(M):
    """M vesicles (M, 2, 16) one beside the other."""
    return ellipse(16, 0.8) + np.stack([np.arange(M), np.zeros(M)], axis=1)[:, :, None]


@dataclass(frozen=True)
class Watched(ExactMaps):
    """Counts the vesicles right of x = 0.5; notes what each map is given."""

    heard: list = field(default_factory=list)

    def diagnostics(self, X):
        self.heard.append(X)
        return {"out_of_distribution": int((X[:, 0].mean(axis=-1) > 0.5).sum()), "by_exact_maps": 1}


def stepper(maps, **options):
    return SplitStepper(maps, 1.0, 1.0, **{"flow": SHEAR, "interacting": False, **options})


def test_exact_maps_are_not_heard_and_report_nothing():
    assert not isinstance(ExactMaps(), Monitored)
    assert stepper(ExactMaps()).step(State(0.0, row(2)), DT).diagnostics == {}


@pytest.mark.parametrize("case", ["at rest", "tension at rest", "in flow", "pair"])
def test_they_are_heard_once_a_step_of_the_state_before_it(case):
    maps, X = Watched(), row(3)
    options = {"flow": None} if "rest" in case else {}
    step = stepper(maps, **options, interacting=case == "pair", tension="tension" in case)
    state = State(0.0, X)
    for _ in range(3):
        result = step.step(state, DT)
        assert len(maps.heard) == 1
        assert np.array_equal(maps.heard.pop(), state.X)
        assert result.diagnostics == {"out_of_distribution": 2.0, "by_exact_maps": 1.0}
        assert all(type(value) is float for value in result.diagnostics.values())
        state = result.state


def test_they_get_the_array_of_the_other_maps():
    """Else nothing that is made of it once could serve again."""
    given = []

    @dataclass(frozen=True)
    class Noting(Watched):
        def advect(self, X, u):
            given.append(X)
            return super().advect(X, u)

    maps = Noting()
    step = stepper(maps)
    state = step.step(State(0.0, row(2)), DT).state
    given.clear()
    maps.heard.clear()
    step.step(state, DT)
    assert len(given) == 1
    assert given[0] is maps.heard[0]


def test_extrapolation_hears_each_of_its_two_states_once_and_keeps_the_largest():
    maps = Watched()
    X = row(2)
    X[0, 0] += 0.5 - 1e-7 - X[0, 0].mean()  # crosses the line in the first half of the step
    flow = linear_flow([[10.0, 0.0], [0.0, -10.0]])
    result = Extrapolated(stepper(maps, flow=flow)).step(State(0.0, X), DT)
    assert [int((heard[:, 0].mean(axis=-1) > 0.5).sum()) for heard in maps.heard] == [1, 2]
    assert result.diagnostics["out_of_distribution"] == 2.0


@pytest.mark.parametrize("size", [2, 3])
def test_every_rank_is_asked_for_its_own_vesicles_and_all_know_the_sum(size):
    M, X = 7, row(7)

    def work(ranks):
        maps = Watched()
        result = stepper(maps, ranks=ranks).step(State(0.0, X), DT)
        return maps.heard, result.diagnostics

    done = on_threads(size, work)
    assert [len(heard) for heard, _ in done] == [1] * size
    assert np.array_equal(np.concatenate([heard[0] for heard, _ in done]), X)
    assert [diagnostics for _, diagnostics in done] == [{"out_of_distribution": M - 1.0, "by_exact_maps": float(size)}] * size


def test_a_refusal_on_one_rank_rejects_the_step_on_all():
    @dataclass(frozen=True)
    class Refusing(Watched):
        def diagnostics(self, X):
            if X[-1, 0].mean() > 3.5:
                raise NumericalFailure("vesicle 4 is outside of what the maps were made for")
            return {}

    work = lambda ranks: stepper(Refusing(), ranks=ranks).step(State(0.0, row(5)), DT)
    assert [str(e) for e in on_threads(2, work)] == ["vesicle 4 is outside of what the maps were made for"] * 2
    done = stepper(Refusing()).step(State(0.0, row(3)), DT)
    assert done.diagnostics == {}
    assert replace(done.state, t=0.0).X.shape == (3, 2, 16)
