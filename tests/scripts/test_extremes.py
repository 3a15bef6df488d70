"""The grid of extremes: that it is whole, that its judge sees what is ill-behaved, and a fast subset of its cases."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from comparison_cases import kept_here
from studies.extremes_grid import AXES, RUNGS, Against, Case, by_rung, facing, grid, merged, pair, radius, times, write_inputs
from studies.extremes_judge import FINISHED, ILL, REFUSED, SMALLER, Attempt, Outcome, _moved, outcome_path, problems_in, said_badly, settle
from studies.extremes_kept import completed, keep
from studies.extremes_page import page
from studies.extremes_steps import Ladder, Measured, Tried, draw, ladders, measured
from studies.runs import Record

from biem.run.simulate import simulate
from biem.scene.build import build
from biem.scene.config import make_scene
from biem.stokes.near_search import minimum_gap

FAST = [case for case in grid() if case.fast]


@pytest.fixture(scope="module")
def run():
    """Two steps of the pair by the split solver, and its record."""
    scene = make_scene(by_rung(merged(pair(), times(1e-5, 2, 1)), "split"))
    done = simulate(scene)
    return done.trajectory, Record(scene="", counts=dict(done.counts))


def in_frame(trajectory, X):
    return replace(trajectory, X=np.concatenate([trajectory.X[:-1], X[None]]))


def test_every_rung_meets_every_extreme_once():
    cases = grid()
    files = [outcome_path(case, Path("x")) for case in cases]
    assert len(set(files)) == len(cases)
    wanted = {
        "capillary": {"0", "0.001", "1", "50", "500", "10000"},
        "confinement": {"0.025", "0.95"},
        "reduced-area": {"0.3", "0.5", "0.65", "0.9", "0.99", "1"},
        "gap": {"0.1", "0.01", "0.001", "0.0001"},
        "nodes": {"16", "32", "128", "512"},
        "vesicles": {"1", "2", "2000", "10000"},
    }
    for rung in RUNGS:
        for axis, values in wanted.items():
            assert values <= {case.value for case in cases if (case.axis, case.rung) == (axis, rung)}
    assert {case.axis for case in cases} == set(AXES)


@pytest.mark.parametrize("gap", [1e-1, 1e-3])
def test_vesicles_that_face_each_other_are_as_far_apart_as_is_said(gap):
    scene = merged(pair(), {"vesicles": {**facing(gap), "points": 256}})
    assert minimum_gap(build(make_scene(scene)).X) == pytest.approx(gap, abs=3e-5)


def test_a_good_run_has_no_problems(run):
    assert problems_in(*run) == []


def test_the_judge_sees_what_must_not_be_in_a_file(run):
    trajectory, record = run
    X = trajectory.X[-1]
    spoiled = X.copy()
    spoiled[0, 0, 3] = np.nan
    assert "finite values" in problems_in(in_frame(trajectory, spoiled), record)[0]
    crossed = np.stack([X[0], X[0] + 0.01])
    assert any("no crossing" in problem for problem in problems_in(in_frame(trajectory, crossed), record))
    assert any("area kept" in problem for problem in problems_in(in_frame(trajectory, X * (1 + 1e-8)), record))
    worse = {**trajectory.diagnostics, "bending_energy": trajectory.diagnostics["bending_energy"] * np.nan}
    assert any("bending_energy" in problem for problem in problems_in(replace(trajectory, diagnostics=worse), record))


def test_the_judge_sees_corrections_that_are_not_counted(run):
    trajectory, record = run
    assert trajectory.diagnostics["area_error"].max() > 1e-9
    problems = problems_in(trajectory, replace(record, counts={"redistributed": 4}))
    assert problems[0].startswith("area_error was corrected")


def test_more_than_one_line_is_a_problem():
    assert said_badly(Record("", "step 1 rejected")) == []
    assert said_badly(Record("", "one\ntwo")) == ["2 error lines"]
    assert said_badly(Record("", "one", warnings=["RuntimeWarning: overflow"])) == ["warned: RuntimeWarning: overflow"]


def test_a_run_past_its_bound_is_ill_behaved(tmp_path):
    write_inputs(tmp_path / "inputs")
    outcome = settle(Case("steps", "a hang", "split", by_rung(pair(), "split"), bound=0.05), tmp_path)
    assert outcome.outcome == ILL
    assert "past the bound" in outcome.problems[0]


def test_moved_and_scaled_trajectories_come_back(run):
    trajectory, _ = run
    length, time, offset, velocity = 3.0, 7.0, (1000.0, -5.0), (2.0, 0.5)
    t = time * trajectory.t
    shift = np.array(offset) + t[:, None] * np.array(velocity)
    there = replace(trajectory, t=t, X=length * trajectory.X + shift[:, None, :, None])
    back = _moved(there, Against("", {}, length, time, offset, velocity))
    np.testing.assert_allclose(back.X, trajectory.X, atol=1e-12)
    np.testing.assert_allclose(back.t, trajectory.t, rtol=1e-14)


EXPECTED = {  # of the fast cases: outcome, exit code of the first attempt, part of its line
    ("10000", "vesnet:hybrid"): (REFUSED, 3, "non-finite nodes"),
    ("float32, two", "implicit"): (REFUSED, 2, "solver.dtype goes with"),
    ("float32, two", "split"): (FINISHED, 0, ""),
    ("horizon 0", "split"): (REFUSED, 2, "time.horizon"),
    ("custom flow, NaN later", "split"): (REFUSED, 3, "not finite"),
}


@pytest.mark.parametrize("case", FAST, ids=lambda case: case.name)
def test_fast_cases_end_as_they_must(case, tmp_path, monkeypatch):
    wanted, code, line = EXPECTED[case.value, case.rung]
    if wanted != FINISHED:  # the one that finishes has processes of its own
        monkeypatch.setattr("studies.extremes_judge.kept", kept_here)
    write_inputs(tmp_path / "inputs")
    outcome = settle(case, tmp_path)
    assert outcome.problems == []
    assert (outcome.outcome, outcome.attempts[0].code) == (wanted, code)
    assert line in outcome.attempts[0].line
    if wanted == FINISHED:
        assert 1e-9 < outcome.error < 1e-3  # of float32, R
        assert outcome.counts["area_length_restored"] == 2 * outcome.steps
    assert settle(case, tmp_path) == outcome  # from its file


def test_the_largest_steps_of_a_ladder():
    ladder = Ladder(32, 5.0, "split")
    assert ladder.unit == pytest.approx(radius() ** 3 / 5.0)
    m = Measured(ladder, [Tried(0.02, True, 0.002), Tried(0.04, True, 0.02), Tried(0.08, False, None, "x"), Tried(0.01, True, 0.001)])
    assert (m.stable, m.accurate) == (0.04, 0.02)
    assert Measured(ladder, [Tried(0.02, False, None)]).stable is None


def test_page_and_figure_of_what_is_there(tmp_path):
    cases = [case for case in grid() if case.axis == "gap"]
    found = dict.fromkeys(cases)
    found[cases[0]] = Outcome("gap", "0.1", "implicit", FINISHED, "as given", "", [], [], error=0.012)
    found[cases[1]] = Outcome("gap", "0.01", "implicit", ILL, "as given", "", ["no crossing: frames [3]"], [])
    found[cases[2]] = Outcome("gap", "0.001", "implicit", SMALLER, "adaptive", "step 1 rejected", [], [])
    text = page(found, [])
    assert "2 of 3 cases are well-behaved: 1 finished, 1 finished with smaller steps, 0 were refused in one line; 1 are ill-behaved" in text
    assert f"{len(cases) - 3} were not run" in text
    assert "| 0.1 | finished, 0.012 R | not run |" in text
    assert "**no crossing: frames [3]**" in text
    steps = [Measured(ladder, [Tried(0.02, True, 0.002)]) for ladder in ladders()[:3]]
    draw(steps, tmp_path / "steps.png")
    assert (tmp_path / "steps.png").stat().st_size > 10_000
    assert measured(tmp_path) == []


def test_what_is_not_run_again_stays_as_it_was(tmp_path):
    cases, path = [case for case in grid() if case.axis == "gap"], tmp_path / "extremes.json"
    attempt = Attempt("as given", '{"name": "long"}', 3, "step 1 rejected")
    old, other = (
        Outcome("gap", value, "implicit", REFUSED, "", "line", [], [attempt], error) for value, error in (("0.1", 1.0), ("0.01", 2.0))
    )
    up, down = (Measured(ladder, [Tried(0.02, True, 0.002), Tried(0.04, False, None, "x")]) for ladder in ladders()[:2])
    keep(dict.fromkeys(cases) | {cases[0]: old, cases[1]: other}, [up, down], path)
    assert "long" not in path.read_text()
    new, again = replace(old, error=3.0), replace(up, tried=[Tried(0.08, True, 0.1)])
    found, steps = completed(dict.fromkeys(cases) | {cases[0]: new}, [again], path)
    assert [found[case] and found[case].error for case in cases[:3]] == [3.0, 2.0, None]
    assert found[cases[1]].attempts == [replace(attempt, scene="")]
    assert {m.ladder: m for m in steps} == {up.ladder: again, down.ladder: down}
    assert completed(found, steps, tmp_path / "none.json") == (found, steps)
