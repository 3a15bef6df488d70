"""Tracers: paths of second order, inside stays inside, streamlines close, walls and openings, restarts, what the table lacks."""

import h5py
import numpy as np
import pytest
from scene_helpers import DT, PAIR, cli, scene_of, stop_after, table, the_error, write_scene
from scipy.integrate import solve_ivp
from thread_ranks import on_threads

from biem.backend import counting
from biem.curves.curve import normal
from biem.observe.fields import FLUID, FlowField
from biem.observe.instant import instant
from biem.observe.tracers import Carrier, Tracers, place_tracers
from biem.run.simulate import Stopped, simulate
from biem.run.trajectory import read_trajectory
from biem.scene.build import build
from biem.scene.config import make_scene
from biem.scene.plan import required_parts, trajectory_bytes

SOME = {"tracers": {"count": 12, "box": [0.6, 0.5]}}


def frozen(*changes):
    problem = build(scene_of(*changes))
    return problem, FlowField(problem, instant(problem, problem.X), 1e-9)


def test_paths_are_of_second_order_in_a_flow_that_stands_still():
    problem, flow = frozen({"vesicles": {"points": 32}})
    start = np.array([[0.05, 0.02], [0.3, 0.1], [-0.2, -0.25], [0.0, 0.4]])
    u = lambda t, y: flow.values(y.reshape(-1, 2)).velocity.ravel()
    exact = solve_ivp(u, (0.0, 0.01), start.ravel(), rtol=1e-9, atol=1e-11).y[:, -1].reshape(-1, 2)
    errors = []
    for steps in (4, 8, 16):
        tracers, carrier = Tracers(start, flow.inside(start)), Carrier(problem)
        for k in range(steps):
            tracers = carrier.carry(tracers, problem.X, 0.01 * k / steps, problem.X, 0.01 * (k + 1) / steps)
        errors.append(np.abs(tracers.x - exact).max())
    assert np.log2(errors[0] / errors[1]) > 1.8
    assert np.log2(errors[1] / errors[2]) > 1.8
    assert errors[2] < 1e-3
    assert np.abs(exact - start).max() > 0.2


@pytest.fixture(scope="module")
def treading(tmp_path_factory):
    """A vesicle that treads like a tank, its shape steady, with tracers inside and outside, over more than a turn of the membrane."""
    folder = tmp_path_factory.mktemp("treading")
    common = {"solver": {"kind": "split"}, "flow": {"rate": 100.0}}
    time = {"dt": 1e-3, "horizon": 0.08, "order": 2, "save_every": 80}
    shape = {"vesicles": {"reduced_area": 0.9, "points": 32, "shape": "ellipse"}}
    steady = simulate(scene_of(shape, common, time=time)).trajectory.X[-1]
    with h5py.File(folder / "steady.h5", "w") as file:
        file["X"] = steady - steady.mean(axis=-1, keepdims=True)
    inner = 0.98 * (steady[0] - steady[0].mean(axis=-1, keepdims=True))[:, ::4].T
    points = np.concatenate([inner, 0.5 * inner[:3], 1.5 * inner[:4]])
    np.savetxt(folder / "points.txt", points)
    of_file = {"vesicles": {"file": "steady.h5", "points": None, "reduced_area": None}, "tracers": {"file": "points.txt"}}
    time = {"dt": 1.25e-3, "horizon": 0.25, "order": 2}
    run = simulate(make_scene({**table(common), "time": time, **of_file, "vesicles": {"file": "steady.h5"}}, folder))
    return run, len(inner) + 3


def test_what_is_inside_a_treading_vesicle_stays_inside(treading):
    run, inner = treading
    trajectory = run.trajectory
    assert trajectory.attributes["tracer_vesicle"].tolist() == [0] * inner + [FLUID] * (trajectory.tracers.shape[1] - inner)
    problem = build(scene_of())
    for k in range(0, len(trajectory), 20):
        flow = FlowField(problem, instant(problem, trajectory.X[k]))
        assert np.array_equal(flow.inside(trajectory.tracers[k]), trajectory.attributes["tracer_vesicle"])
    assert "tracers_put_back" not in run.counts
    assert run.counts["tracer_steps"] == 200


def test_streamlines_in_a_treading_vesicle_close(treading):
    run, inner = treading
    x = run.trajectory.tracers[:, :inner]
    turned = np.unwrap(np.arctan2(x[..., 1], x[..., 0]), axis=0)
    assert (np.abs(turned[-1] - turned[0]) > 2 * np.pi).all()  # all have been around
    for p in range(inner):
        back = np.flatnonzero(np.abs(turned[:, p] - turned[0, p]) > 2 * np.pi)[0]
        ends = x[back - 1 : back + 1, p]
        gaps = np.abs(turned[back - 1 : back + 1, p] - turned[0, p]) - 2 * np.pi
        there = ends[0] + (ends[1] - ends[0]) * gaps[0] / (gaps[0] - gaps[1])
        assert np.hypot(*(there - x[0, p])) < 0.01 * np.ptp(x[:, p], axis=0).max()


def test_a_tracer_that_the_membrane_passes_over_is_put_back():
    problem, flow = frozen({"vesicles": {"points": 32}})
    X, n = problem.X, normal(problem.X)[0].T
    near = np.concatenate([X[0].T[:3] - 1e-4 * n[:3], X[0].T[:3] + 1e-4 * n[:3]])
    tracers = Tracers(near, flow.inside(near))
    assert tracers.vesicle.tolist() == [0, 0, 0, FLUID, FLUID, FLUID]
    with counting() as counts:
        moved = Carrier(problem).carry(tracers, X, 0.0, X + np.array([[[0.0], [0.03]]]), 1e-9)
    after = FlowField(problem, instant(problem, X + np.array([[[0.0], [0.03]]])))
    assert np.array_equal(after.inside(moved.x), tracers.vesicle)
    assert 0 < counts["tracers_put_back"] <= 6


def test_in_a_periodic_box_a_tracer_is_put_back_to_the_image_that_it_is_at():
    away = {"vesicles": {"points": 32}, "domain": {"periodic": [0.9, 0.8]}}
    problem, flow = frozen(away)
    X, n, step = problem.X, normal(problem.X)[0].T, np.array([[[0.0], [0.03]]])
    images = np.array([[1.8, 0.0], [-0.9, 0.8], [0.0, -1.6]])
    near = X[0].T[:3] - 1e-4 * n[:3] + images
    tracers = Tracers(near, flow.inside(near))
    assert tracers.vesicle.tolist() == [0, 0, 0]
    with counting() as counts:
        moved = Carrier(problem).carry(tracers, X, 0.0, X + step, 1e-9)
    after = FlowField(problem, instant(problem, X + step, 1e-9))
    assert after.inside(moved.x).tolist() == [0, 0, 0]
    assert counts["tracers_put_back"] == 3
    assert np.abs(moved.x - near).max() < 0.05


CHANNEL = {
    "vesicles": {"centers": [[-1.0, 0.0]], "angles": [1.5708], "points": 32, "reduced_area": 0.8},
    "flow": {"kind": None, "rate": None},
    "walls": {"kind": "channel", "length": 4.0, "width": 0.6, "u_max": 50.0, "spacing": 0.05},
    "time": {"dt": 1e-3, "horizon": 8e-3},
    "solver": {"kind": "split"},
}


def test_at_the_end_of_a_channel_tracers_leave_and_at_walls_they_stay(tmp_path):
    np.savetxt(tmp_path / "points.txt", [[1.8, 0.0], [1.0, 0.59], [-1.0, 0.0], [0.0, 0.1]])
    trajectory = simulate(scene_of(CHANNEL, tracers={"file": "points.txt"}, folder=tmp_path), tmp_path / "out.h5").trajectory
    left = ~np.isfinite(trajectory.tracers).all(axis=-1)
    assert left.sum(axis=0).tolist() == [int(left[:, 0].sum()), 0, 0, 0]
    assert 2 <= left[:, 0].sum() <= 7
    assert (np.diff(left[:, 0].astype(int)) >= 0).all()  # for good
    assert trajectory.attributes["tracer_vesicle"].tolist() == [FLUID, FLUID, 0, FLUID]
    assert trajectory.tracers[-1, 3, 0] == pytest.approx(50.0 * (1 - (0.1 / 0.6) ** 2) * 8e-3, rel=0.05)
    assert 0 < trajectory.tracers[-1, 1, 0] - 1.0 < 0.05


def test_a_resumed_run_has_the_same_tracers_bitwise(tmp_path, monkeypatch):
    scene = scene_of(PAIR, SOME, solver={"kind": "split"})
    whole = simulate(scene, tmp_path / "whole.h5").trajectory
    with monkeypatch.context() as patch:
        stop_after(patch, 3)
        with pytest.raises(Stopped):
            simulate(scene, tmp_path / "parts.h5")
    assert 1 < len(read_trajectory(tmp_path / "parts.h5")) < len(whole)
    parts = simulate(scene, tmp_path / "parts.h5", resume=True).trajectory
    for found in (parts, read_trajectory(tmp_path / "parts.h5"), simulate(scene).trajectory):
        assert np.array_equal(found.tracers, whole.tracers)
        assert np.array_equal(found.X, whole.X)
        assert np.array_equal(found.attributes["tracer_vesicle"], whole.attributes["tracer_vesicle"])
    assert np.abs(whole.tracers[-1] - whole.tracers[0]).max() > 0.01


def test_tracers_change_nothing_of_the_run_and_cost_nothing_where_there_are_none():
    with_them, without = simulate(scene_of(PAIR, SOME)), simulate(scene_of(PAIR))
    assert np.array_equal(with_them.trajectory.X, without.trajectory.X)
    assert without.trajectory.tracers is None
    assert not {"tracer_steps", "field_points", "goursat"} & set(without.counts)
    assert "tracers" not in scene_of(PAIR).model_dump(mode="json")


def test_ranks_share_the_tracers_of_the_first_one():
    scene = scene_of(PAIR, SOME, solver={"kind": "split"}, time={"horizon": 3 * DT})
    alone = simulate(scene).trajectory
    for run in on_threads(2, lambda ranks: simulate(scene, ranks=ranks)):
        assert np.array_equal(run.trajectory.tracers, alone.tracers)
        assert np.array_equal(run.trajectory.X, alone.X)


def test_a_plan_tells_of_tracers_and_their_share_of_the_file(tmp_path):
    np.savetxt(tmp_path / "points.txt", np.zeros((3, 2)))
    without, drawn, named = (
        build(scene_of(PAIR, folder=tmp_path, **({"tracers": table} if table else {})))
        for table in ({}, {"count": 40}, {"file": "points.txt"})
    )
    told = [[part.why for part in required_parts(problem) if part.name == "tracers"] for problem in (without, drawn, named)]
    assert told[0] == []
    assert told[1][0].startswith("40: ")
    assert told[2][0].startswith("3: ")
    assert trajectory_bytes(drawn) - trajectory_bytes(without) == 8 * 2 * 40 * (drawn.steps + 2)


def test_other_tracers_are_not_resumed(tmp_path):
    path = write_scene(tmp_path, SOME)
    assert cli("run", path, "-o", tmp_path / "out.h5", "--quiet").exit_code == 0
    message = the_error(cli("run", path, "-o", tmp_path / "out.h5", "--resume", "--set", "tracers.seed=3"), 2)
    assert "tracers.seed was 0, is 3" in message


@pytest.mark.parametrize("region", ["all", "inside", "outside"])
def test_drawn_tracers_are_where_they_are_asked_for(region):
    problem = build(scene_of(PAIR, tracers={"count": 50, "box": [1.2, 0.6], "corner": [-0.6, -0.3], "region": region, "seed": 4}))
    tracers = place_tracers(problem)
    assert tracers.x.shape == (50, 2)
    assert (np.abs(tracers.x) <= [0.6, 0.3]).all()
    inside = tracers.vesicle != FLUID
    assert {"all": 0 < inside.sum() < 50, "inside": inside.all(), "outside": not inside.any()}[region]
    assert np.array_equal(place_tracers(problem).x, tracers.x)


BAD = {
    "neither": ({}, "give count (and box), or file, one of them"),
    "both": ({"count": 3, "file": "points.txt"}, "one of them"),
    "no file": ({"file": "none.txt"}, "none.txt does not exist"),
    "no numbers": ({"file": "words.txt"}, "expected rows of two finite numbers"),
    "not finite": ({"file": "nan.txt"}, "nan.txt: row 2 is 0.5 nan; expected rows of two finite numbers"),
    "three columns": ({"file": "three.txt"}, "1 rows of 3 columns"),
    "nothing in it": ({"file": "empty.txt"}, "0 rows of 2 columns"),
    "beyond memory": ({"count": 10**12}, "and tracers needs about"),
    "file and box": ({"file": "points.txt", "box": [1.0, 1.0]}, "tracers.box goes with count"),
    "no box": ({"count": 3, "corner": [0.0, 0.0]}, "tracers.corner goes with a box"),
    "flat box": ({"count": 3, "box": [1.0, 0.0]}, "both sides must be positive"),
    "no place": ({"count": 3, "box": [0.1, 0.1], "corner": [5.0, 5.0], "region": "inside"}, "no place for 3 of them"),
    "unknown key": ({"number": 3}, "did you mean"),
}


@pytest.mark.parametrize("case", BAD)
def test_a_table_that_lacks_something_ends_in_one_line(tmp_path, case, monkeypatch):
    monkeypatch.setattr("biem.observe.tracers.MOST_DRAWS", 5)
    np.savetxt(tmp_path / "points.txt", [[0.0, 0.0]])
    np.savetxt(tmp_path / "three.txt", [[0.0, 0.0, 1.0]])
    np.savetxt(tmp_path / "nan.txt", [[0.0, 0.0], [0.5, np.nan]])
    (tmp_path / "words.txt").write_text("here and there\n")
    (tmp_path / "empty.txt").write_text("# x y\n\n")
    changes, fragment = BAD[case]
    path = write_scene(tmp_path, **({"tracers": changes} if changes else {}))
    if not changes:
        path.write_text(path.read_text() + "[tracers]\n")
    assert fragment in the_error(cli("run", path, "-o", tmp_path / "out.h5"), 2)
    assert not (tmp_path / "out.h5").exists()


def test_a_point_beyond_the_walls_is_refused(tmp_path):
    np.savetxt(tmp_path / "points.txt", [[0.0, 0.0], [0.0, 0.7]])
    with pytest.raises(ValueError, match="point 1 is not in the fluid"):
        place_tracers(build(scene_of(CHANNEL, tracers={"file": "points.txt"}, folder=tmp_path)))
    plan = cli("plan", write_scene(tmp_path, CHANNEL, tracers={"file": "points.txt"}), "--no-measure")
    assert "point 1 is not in the fluid" in the_error(plan, 2)


def test_a_place_is_drawn_from_one_sequence_however_many_at_once(monkeypatch):
    problem = build(scene_of(PAIR, tracers={"count": 40, "region": "inside"}))
    whole = place_tracers(problem)
    assert (whole.vesicle >= 0).all()
    assert np.array_equal(place_tracers(problem, most=3).x, whole.x[:3])
    monkeypatch.setattr("biem.observe.tracers.DRAWN_AT_ONCE", 1)
    assert np.array_equal(place_tracers(problem).x, whole.x)
