"""Restarts: a run that was stopped and resumed is, bit for bit, the run that was not; what does not fit is refused."""

from contextlib import contextmanager
from dataclasses import replace

import numpy as np
import pytest
from scene_helpers import DT, PAIR, assert_same_frames, scene_of

from biem.errors import NumericalFailure
from biem.run import simulate as loop
from biem.run.checkpoint import checkpoint_path, read_checkpoint
from biem.run.simulate import Stopped, simulate
from biem.run.trajectory import read_trajectory

BOTH = pytest.mark.parametrize("pair", [{}, PAIR], ids=["M=1", "M=2"])


def until(steps, *changes, **more):
    return scene_of(*changes, more, time={"horizon": steps * DT})


def stop_at(monkeypatch, looks):
    """A signal that comes between the loop's looks at it: seen from look number `looks` on."""
    seen = 0

    def stop():
        nonlocal seen
        seen += 1
        return seen > looks

    @contextmanager
    def signals():
        yield stop

    monkeypatch.setattr(loop, "stop_signals", signals)


def fail_from(monkeypatch, step):
    """The stepper rejects this step."""
    make, taken = loop.make_stepper, iter(range(1, 100))

    class Failing:
        def __init__(self, *arguments):
            self.inner = make(*arguments)

        def step(self, state, dt):
            if next(taken) == step:
                raise NumericalFailure("no such step")
            return self.inner.step(state, dt)

    monkeypatch.setattr(loop, "make_stepper", Failing)


@BOTH
@pytest.mark.parametrize("checkpoint_every", [1, 2])
def test_resumed_run_equals_the_uninterrupted_one_bitwise(tmp_path, pair, checkpoint_every):
    output = {"checkpoint_every": checkpoint_every, "tension": True}
    whole = simulate(until(6, pair, output=output), tmp_path / "whole.h5")
    simulate(until(3, pair, output=output), tmp_path / "parts.h5")
    for steps in (4, 6):
        parts = simulate(until(steps, pair, output=output), tmp_path / "parts.h5", resume=True)
    assert whole.trajectory.step.tolist() == list(range(7))
    assert_same_frames(parts.trajectory, whole.trajectory)
    assert_same_frames(read_trajectory(tmp_path / "parts.h5"), whole.trajectory)
    assert parts.counts["relaxation_matrix"] == whole.counts["relaxation_matrix"]  # of all parts together
    for name in ("area_error", "length_error", "gmres_iterations", "bending_energy", "min_gap"):
        assert np.array_equal(parts.trajectory.diagnostics[name], whole.trajectory.diagnostics[name]), name


@BOTH
def test_run_stopped_between_frames_resumes_bitwise(tmp_path, monkeypatch, pair):
    easing = {"vesicles": {"shape": "ellipse", "reduced_area": 0.65}, "flow": {"kind": "quiescent", "rate": None}}
    scene = scene_of(pair, easing, time={"save_every": 4, "horizon": 10 * DT})  # the errors of its steps fall
    whole = simulate(scene).trajectory
    with monkeypatch.context() as patch:
        stop_at(patch, 2)  # the loop looks once after a step
        with pytest.raises(Stopped, match="step 3 of 10"):
            simulate(scene, tmp_path / "parts.h5")
    assert read_checkpoint(checkpoint_path(tmp_path / "parts.h5")).step == 3
    parts = simulate(scene, tmp_path / "parts.h5", resume=True).trajectory
    assert_same_frames(parts, whole)
    assert np.array_equal(parts.diagnostics["area_error"], whole.diagnostics["area_error"])


@pytest.mark.parametrize("looks", range(4))
def test_stopped_means_that_its_checkpoint_is_written(tmp_path, monkeypatch, looks):
    stop_at(monkeypatch, looks)
    with pytest.raises(Stopped) as caught:
        simulate(scene_of(time={"save_every": 100}), tmp_path / "out.h5")
    assert f"step {read_checkpoint(checkpoint_path(tmp_path / 'out.h5')).step} of" in str(caught.value)


def test_what_a_solver_keeps_of_the_step_before_survives_a_restart(tmp_path, monkeypatch):
    make = loop.make_stepper

    class Remembering:
        def __init__(self, *arguments):
            self.inner = make(*arguments)

        def step(self, state, dt):
            new = self.inner.step(state, dt)
            t, u, rate = (state.t, 0.0 * state.X, 0.0 * state.X) if state.coupling is None else state.coupling
            drift = 1e-3 * (u + (state.t - t) * rate).mean()
            return replace(new, state=replace(new.state, X=new.state.X + drift, coupling=(state.t, state.X, state.X - u)))

    monkeypatch.setattr(loop, "make_stepper", Remembering)
    whole = simulate(until(6, PAIR)).trajectory
    simulate(until(3, PAIR), tmp_path / "out.h5")
    assert read_checkpoint(checkpoint_path(tmp_path / "out.h5")).state.coupling[0] == 2 * DT
    assert_same_frames(simulate(until(6, PAIR), tmp_path / "out.h5", resume=True).trajectory, whole)


def test_truncated_checkpoint_resumes_from_the_previous_one(tmp_path):
    whole = simulate(until(6, PAIR)).trajectory
    simulate(until(3, PAIR), tmp_path / "out.h5")
    path = checkpoint_path(tmp_path / "out.h5")
    path.write_bytes(path.read_bytes()[:5000])
    assert_same_frames(simulate(until(6, PAIR), tmp_path / "out.h5", resume=True).trajectory, whole)


def test_no_step_is_longer_than_dt_after_a_longer_horizon(tmp_path):
    simulate(until(2.5), tmp_path / "out.h5")  # the third step is half a step
    longer = simulate(until(6), tmp_path / "out.h5", resume=True).trajectory
    assert longer.t[-1] == 6 * DT
    assert np.diff(longer.t).max() <= DT * (1 + 1e-9)


def test_longer_horizon_is_bitwise_also_where_steps_round(tmp_path):
    whole = simulate(scene_of(time={"dt": 1e-4, "horizon": 6e-4})).trajectory
    simulate(scene_of(time={"dt": 1e-4, "horizon": 3e-4}), tmp_path / "out.h5")  # 3 * 1e-4 is not 3e-4
    assert_same_frames(simulate(scene_of(time={"dt": 1e-4, "horizon": 6e-4}), tmp_path / "out.h5", resume=True).trajectory, whole)


@pytest.mark.parametrize(
    ("changes", "key"),
    [
        ({"flow": {"rate": 50.0}}, "flow.rate"),
        ({"vesicles": {"points": 32}}, "vesicles.points"),
        ({"time": {"dt": 2 * DT}}, "time.dt"),
        ({"solver": {"corrections": []}}, "solver.corrections"),
        (PAIR, "vesicles.centers"),
    ],
)
def test_resuming_another_scene_is_refused_naming_the_key(tmp_path, changes, key):
    simulate(scene_of(), tmp_path / "out.h5")
    before = (tmp_path / "out.h5").read_bytes()
    with pytest.raises(ValueError, match=key.replace(".", r"\.") + " was .*, is "):
        simulate(scene_of(changes), tmp_path / "out.h5", resume=True)
    assert (tmp_path / "out.h5").read_bytes() == before


def test_resuming_without_a_checkpoint_is_refused(tmp_path):
    with pytest.raises(ValueError, match="no readable checkpoint"):
        simulate(scene_of(), tmp_path / "out.h5", resume=True)
    with pytest.raises(ValueError, match="output"):
        simulate(scene_of(), resume=True)
    assert not list(tmp_path.iterdir())


def test_tension_asked_for_half_way_is_not_made_up_for_the_first_half(tmp_path):
    simulate(until(3), tmp_path / "out.h5")
    try:
        sigma = simulate(until(6, output={"tension": True}), tmp_path / "out.h5", resume=True).trajectory.sigma
    except ValueError as error:
        assert "tension" in str(error)  # noqa: PT017 - refusing is as good as marking the frames
    else:
        assert sigma is None or not (sigma[1:4] == 0).all(axis=(1, 2)).any()


def test_last_good_state_is_a_frame_also_after_a_stop(tmp_path, monkeypatch):
    scene = scene_of(time={"save_every": 4, "horizon": 10 * DT})
    good = simulate(until(6)).trajectory
    fail_from(monkeypatch, 4)  # the first one after the restart
    with monkeypatch.context() as patch:
        stop_at(patch, 2)
        with pytest.raises(Stopped):
            simulate(scene, tmp_path / "out.h5")
    with pytest.raises(NumericalFailure, match="step 4 rejected"):
        simulate(scene, tmp_path / "out.h5", resume=True)
    assert read_checkpoint(checkpoint_path(tmp_path / "out.h5")).step == 3
    assert np.array_equal(read_trajectory(tmp_path / "out.h5").X[-1], good.X[3])
