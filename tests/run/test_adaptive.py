"""Adaptive runs: the error follows the tolerance, rejections are counted, dt_min ends a run, restarts are bitwise."""

import math
import re
import signal
from dataclasses import replace

import numpy as np
import pytest
import torch
from scene_helpers import (
    PAIR,
    SIGNALLING_FLOW,
    assert_prefix,
    assert_same_frames,
    cli,
    finish,
    scene_of,
    start_cli,
    stop_after,
    the_error,
    write_flow,
    write_scene,
)

from biem.backend import to_numpy
from biem.errors import NumericalFailure
from biem.run import simulate as loop
from biem.run.checkpoint import checkpoint_path, read_checkpoint
from biem.run.plot import separation
from biem.run.simulate import Stopped, simulate
from biem.run.trajectory import read_trajectory
from biem.steppers.control import GROWTH
from biem.steppers.corrections import CORRECTIONS, Corrected
from biem.steppers.implicit import ImplicitStepper
from biem.steppers.order import Extrapolated
from biem.steppers.stepper import StepResult

T = 0.01  # t_gamma of the tiny scenes
ADAPTIVE = {"time": {"adaptive": True, "dt": 0.02 * T, "horizon": 0.25 * T, "tolerance": 1e-4}}
SHEAR_PAIR = {
    "vesicles": {"reduced_area": 0.65, "points": 32, "unit": "R", "centers": [[-2.3, 0.3], [0, 0]], "angles": [0, 1.5707963267948966]},
    "flow": {"rate": None, "capillary": 5.0},
}
CONTROLLED = ("area_error", "length_error", "gmres_iterations", "bending_energy", "min_gap", "dt", "error_estimate", "rejected")


def sheared(dt, **time):
    return simulate(scene_of(SHEAR_PAIR, time={"dt": f"{dt!r} t_gamma", "horizon": "2 t_gamma", **time})).trajectory


def wrap_stepper(monkeypatch, wrap):
    """Every step of a run is wrap(inner, state, dt)."""
    make = loop.make_stepper

    class Wrapped:
        def __init__(self, *arguments):
            self.inner = make(*arguments)

        def step(self, state, dt):
            return wrap(self.inner, state, dt)

    monkeypatch.setattr(loop, "make_stepper", Wrapped)


@pytest.fixture(scope="module")
def reference():
    """Second order at dt = 0.05 t_gamma: nodes to about 1e-4."""
    return sheared(0.05, order=2)


@pytest.fixture(scope="module")
def adaptive():
    """By tolerance, of first order."""
    return {tolerance: sheared(0.05, adaptive=True, tolerance=tolerance) for tolerance in (2e-3, 2e-4)}


def off(trajectory, reference):
    return np.abs(trajectory.X[-1] - reference.X[-1]).max()


def test_error_is_what_the_tolerance_promises(reference, adaptive):
    """Errors of the steps add up at most: tolerance times the number of steps, in the membrane length (1)."""
    for tolerance, done in adaptive.items():
        steps = int(done.step[-1])
        assert 0.02 * steps * tolerance < off(done, reference) < steps * tolerance
        assert abs(separation(done)[-1] - separation(reference)[-1]) < steps * tolerance
        for name in ("error_estimate", "area_error", "length_error"):
            assert done.diagnostics[name].max() <= tolerance
        assert max(done.diagnostics[n].max() for n in ("error_estimate", "area_error", "length_error")) > 0.7 * tolerance
        assert done.t[-1] == pytest.approx(2 * done.attributes["t_gamma"], rel=1e-14)


def test_ten_times_tighter_takes_and_gives_the_square_root_of_ten(reference, adaptive):
    """dt and the global error of a first-order stepper are both proportional to tolerance^(1/2)."""
    coarse, fine = adaptive.values()
    assert 2.2 < off(coarse, reference) / off(fine, reference) < 4.5
    assert 2.2 < fine.step[-1] / coarse.step[-1] < 4.5


def test_second_order_is_kept_by_extrapolation(reference, adaptive):
    done = sheared(0.05, order=2, adaptive=True, tolerance=2e-3)
    assert done.step[-1] <= adaptive[2e-3].step[-1]
    assert off(done, reference) < 0.3 * off(adaptive[2e-3], reference)


def test_equal_steps_need_more_for_the_same_error(reference, adaptive):
    done = adaptive[2e-3]
    more = math.ceil(1.2 * done.step[-1])
    assert off(sheared(2 / more), reference) > off(done, reference)


@pytest.mark.parametrize("pair", [{}, PAIR], ids=["M=1", "M=2"])
def test_time_is_the_sum_of_the_steps_and_ends_at_the_horizon(pair):
    done = simulate(scene_of(pair, ADAPTIVE, time={"dt": 0.003 * T})).trajectory
    dt = done.diagnostics["dt"]
    assert dt[:2].tolist() == [0.0, 0.003 * T]
    assert done.t[-1] == 0.25 * T
    for k in range(len(done)):
        assert abs(math.fsum(dt[: k + 1]) - done.t[k]) < 1e-15 * 0.25 * T
    assert (dt[2:] / dt[1:-1]).max() <= GROWTH * (1 + 1e-12)
    assert dt[-1] <= dt[-2] * GROWTH  # the last one is what is left
    assert np.ptp(dt[1:]) > 0.003 * T


def test_frames_are_of_accepted_steps_and_keep_the_worst_since_the_last_one():
    every = simulate(scene_of(PAIR, ADAPTIVE, time={"dt": 0.2 * T})).trajectory
    some = simulate(scene_of(PAIR, ADAPTIVE, time={"dt": 0.2 * T, "save_every": 3})).trajectory
    last = int(every.step[-1])
    assert some.step.tolist() == [*range(0, last, 3), last]
    assert np.array_equal(some.X, every.X[some.step])
    assert np.array_equal(some.diagnostics["dt"], every.diagnostics["dt"][some.step])
    between = list(zip(some.step[:-1] + 1, some.step[1:] + 1, strict=True))
    assert some.diagnostics["error_estimate"][1:].tolist() == [every.diagnostics["error_estimate"][a:b].max() for a, b in between]
    assert some.diagnostics["rejected"][1:].tolist() == [every.diagnostics["rejected"][a:b].sum() for a, b in between]


def test_a_first_step_that_is_too_long_is_halved_and_counted():
    done = simulate(scene_of(PAIR, ADAPTIVE, time={"dt": 0.2 * T}))
    d = done.trajectory.diagnostics
    assert d["rejected"][1] >= 2
    assert d["dt"][1] == 0.2 * T / 2 ** d["rejected"][1]
    assert done.counts["steps_rejected"] == d["rejected"].sum()
    assert d["error_estimate"].max() <= 1e-4


@pytest.mark.parametrize("corrections", [["area_length", "redistribute"], []])
def test_area_and_length_alone_can_reject_a_step(monkeypatch, corrections):
    """The steps' own errors count, not what has added up since the start."""

    def no_estimate(inner, state, dt):
        result = inner.step(state, dt)
        return replace(result, diagnostics={**result.diagnostics, "error_estimate": 0.0})

    wrap_stepper(monkeypatch, no_estimate)
    time = {"horizon": 2 * T, "dt": 0.2 * T, "tolerance": 2e-4}
    d = simulate(scene_of(ADAPTIVE, time=time, solver={"corrections": corrections})).trajectory.diagnostics
    assert d["rejected"].sum() >= 1
    assert (max(d["area_error"].max(), d["length_error"].max()) > 2e-4) == (corrections == [])


FAILURES = {
    "solver": NumericalFailure("GMRES stopped"),
    "flow": ValueError("flow is not finite at x = 1"),
    "not finite": np.nan,
    "crossing": 0.0,  # both on top of the other
}


def failing(failure, dt_largest, from_t=0.0):
    def step(inner, state, dt):
        if dt <= dt_largest or state.t < from_t:
            return inner.step(state, dt)
        if isinstance(failure, Exception):
            raise failure
        result = inner.step(state, dt)
        return replace(result, state=replace(result.state, X=(result.state.X - result.state.X.mean(axis=-1, keepdims=True)) + failure))

    return step


@pytest.mark.parametrize("case", FAILURES)
def test_steps_that_fail_are_halved_until_they_do_not(monkeypatch, case):
    wrap_stepper(monkeypatch, failing(FAILURES[case], 0.011 * T))
    done = simulate(scene_of(PAIR, ADAPTIVE, time={"horizon": 0.1 * T, "tolerance": 1e-2}))
    dt = done.trajectory.diagnostics["dt"][1:]
    assert dt[0] == 0.01 * T
    assert dt.max() <= 0.011 * T
    assert done.counts["steps_rejected"] == done.trajectory.diagnostics["rejected"].sum() >= len(dt) / 6
    assert done.trajectory.t[-1] == 0.1 * T


@pytest.mark.parametrize("case", FAILURES)
@pytest.mark.parametrize("save_every", [1, 100])
def test_below_dt_min_the_run_ends_with_the_last_good_state(tmp_path, monkeypatch, case, save_every):
    time = {"save_every": save_every, "dt_min": 0.001 * T}
    path, out = write_scene(tmp_path, PAIR, ADAPTIVE, time={**ADAPTIVE["time"], **time}), tmp_path / "out.h5"
    whole = simulate(scene_of(PAIR, ADAPTIVE, time=time)).trajectory
    with monkeypatch.context() as patch:
        wrap_stepper(patch, failing(FAILURES[case], 0.0, from_t=0.1 * T))
        message = the_error(cli("run", path, "-o", out), 3)
    kept = read_trajectory(out)
    words = {"solver": "GMRES stopped", "flow": "not finite at x = 1", "not finite": "non-finite", "crossing": "vesicles 0 and 1 cross"}
    step, t = int(re.search(r"step (\d+) rejected", message)[1]), float(re.search(r"at t = (\S+) ", message)[1])
    assert words[case] in message
    assert ("more nodes (vesicles.points) or solver.repulsion" if case == "crossing" else "a lower time.dt_min") in message
    assert f"time.dt_min = {0.001 * T:g}" in message
    assert (kept.step[-1], kept.t[-1]) == (step - 1, pytest.approx(t, rel=1e-5))
    assert 0.1 * T <= kept.t[-1] < 0.14 * T
    checkpoint = read_checkpoint(checkpoint_path(out))
    assert (checkpoint.step, checkpoint.state.t) == (step - 1, kept.t[-1])
    assert np.array_equal(checkpoint.state.X, kept.X[-1])
    tried = float(re.search(r"with dt = ([^\s,]+),", message)[1])
    assert 0.001 * T <= tried < 0.002 * T
    assert checkpoint.counts["steps_rejected"] == 1 + round(math.log2(checkpoint.control["dt"] / tried))
    assert cli("run", path, "-o", out, "--resume", "--quiet").exit_code == 0  # the failure was not the scene's
    resumed = read_trajectory(out)
    assert np.array_equal(resumed.X[-1], whole.X[-1])
    if save_every == 1:
        assert_same_frames(resumed, whole)


def test_a_tolerance_out_of_reach_names_itself(tmp_path):
    path = write_scene(tmp_path, PAIR, ADAPTIVE, time={**ADAPTIVE["time"], "tolerance": 1e-8, "dt_min": 0.002 * T})
    message = the_error(cli("run", path, "-o", tmp_path / "out.h5"), 3)
    assert re.search(r"step 1 rejected at t = 0 .*: error estimate \S+e-\d\d.*above time\.tolerance = 1e-08 with dt = \S+, half", message)
    assert float(re.search(r"error estimate ([^\s,]+)", message)[1]) > 1e-8
    assert read_trajectory(tmp_path / "out.h5").step.tolist() == [0]


@pytest.mark.parametrize("pair", [{}, PAIR], ids=["M=1", "M=2"])
@pytest.mark.parametrize("step", [1, 4])
def test_stopped_run_resumes_bitwise(tmp_path, monkeypatch, pair, step):
    scene = scene_of(pair, ADAPTIVE, time={"save_every": 3, "dt": 0.1 * T})
    whole = simulate(scene)
    with monkeypatch.context() as patch:
        stop_after(patch, step)
        with pytest.raises(Stopped, match=rf"step {step} at t = {whole.trajectory.t[0]:g}\.\d"):
            simulate(scene, tmp_path / "out.h5")
    checkpoint = read_checkpoint(checkpoint_path(tmp_path / "out.h5"))
    assert checkpoint.step == step
    assert checkpoint.control["dt"] > 0
    parts = simulate(scene, tmp_path / "out.h5", resume=True)
    assert_same_frames(parts.trajectory, whole.trajectory)
    for name in CONTROLLED:
        assert np.array_equal(parts.trajectory.diagnostics[name], whole.trajectory.diagnostics[name]), name
    assert parts.counts["steps_rejected"] == whole.counts["steps_rejected"]


def test_a_longer_horizon_goes_on_as_if_it_had_been_the_first(tmp_path):
    whole = simulate(scene_of(PAIR, ADAPTIVE)).trajectory
    for horizon in (0.1 * T, 0.25 * T):
        done = simulate(scene_of(PAIR, ADAPTIVE, time={"horizon": horizon}), tmp_path / "out.h5", resume=horizon > 0.1 * T).trajectory
    assert_same_frames(done, whole)


@pytest.mark.parametrize(("at", "save_every"), [(0.08, 1), (0.15, 1), (0.15, 4)])
def test_killed_run_resumes_bitwise(tmp_path, at, save_every):
    module = write_flow(tmp_path, SIGNALLING_FLOW)
    time = {**ADAPTIVE["time"], "dt": 0.1 * T, "save_every": save_every}
    path = write_scene(tmp_path, PAIR, flow={"kind": "custom", "rate": None, "function": f"{module}.shear"}, time=time)
    out, log = tmp_path / "out.h5", tmp_path / "log"
    exit_code, printed = finish(start_cli(["run", path, "-o", out], log, {"STOP_AT": repr(at * T), "STOP_BY": "SIGKILL"}), log)
    assert exit_code == -signal.SIGKILL, printed
    assert cli("run", path, "-o", tmp_path / "whole.h5", "--quiet").exit_code == 0
    whole, left = read_trajectory(tmp_path / "whole.h5"), read_trajectory(out)
    assert_prefix(left, whole)
    assert 0 < len(left) < len(whole)
    assert cli("run", path, "-o", out, "--resume", "--quiet").exit_code == 0
    resumed = read_trajectory(out)
    assert_same_frames(resumed, whole)
    for name in CONTROLLED:
        assert np.array_equal(resumed.diagnostics[name], whole.diagnostics[name]), name


def test_resuming_with_another_tolerance_is_refused(tmp_path):
    simulate(scene_of(ADAPTIVE), tmp_path / "out.h5")
    with pytest.raises(ValueError, match=r"time\.tolerance was 0\.0001, is 0\.001"):
        simulate(scene_of(ADAPTIVE, time={"tolerance": 1e-3}), tmp_path / "out.h5", resume=True)


def test_progress_shows_the_time_against_the_horizon(tmp_path):
    path = write_scene(tmp_path, PAIR, ADAPTIVE)
    result = cli("run", path, "-o", tmp_path / "out.h5")
    assert f"t = {0.25 * T:.4g} of {0.25 * T:.4g}" in result.stderr
    assert "t_gamma, dt = " in result.stderr
    assert "GMRES" in result.stderr


def torch_stepper(problem, area_0, length_0, ranks):
    """The implicit stepper giving tensors, as one that keeps its states on a device; it has nothing to report."""
    inner = ImplicitStepper(1.0, 1.0, problem.flow.velocity)

    class GivesTensors:
        def step(self, state, dt):
            sigma = None if state.sigma is None else to_numpy(state.sigma)
            new = inner.step(replace(state, X=to_numpy(state.X), sigma=sigma), dt).state
            return StepResult(replace(new, X=torch.from_numpy(new.X), sigma=torch.from_numpy(new.sigma)))

    stepper = Extrapolated(GivesTensors(), 1) if problem.scene.time.adaptive else GivesTensors()
    return Corrected(stepper, CORRECTIONS, area_0, length_0)


@pytest.mark.parametrize("is_adaptive", [True, False])
def test_states_may_be_tensors_and_diagnostics_may_lack(tmp_path, monkeypatch, is_adaptive):
    changes = (PAIR, ADAPTIVE, {"time": {"adaptive": is_adaptive, "horizon": 0.1 * T}})
    of_arrays = simulate(scene_of(*changes)).trajectory
    monkeypatch.setattr(loop, "make_stepper", torch_stepper)
    time = {**ADAPTIVE["time"], **changes[2]["time"]}
    path, out = write_scene(tmp_path, PAIR, time=time), tmp_path / "out.h5"
    with monkeypatch.context() as patch:
        stop_after(patch, 2)
        assert "stopped at step 2" in the_error(cli("run", path, "-o", out), 4)
    result = cli("run", path, "-o", out, "--resume")
    assert result.exit_code == 0, result.output
    assert "GMRES" not in result.output
    done = read_trajectory(out)
    assert_same_frames(done, simulate(scene_of(*changes)).trajectory)  # bitwise over the restart
    assert np.abs(done.X - of_arrays.X).max() < 1e-9
    assert np.abs(done.sigma - of_arrays.sigma).max() < 1e-6 * np.abs(of_arrays.sigma).max()
    for name in ("error_estimate", "area_error", "length_error", "dt"):
        assert np.allclose(done.diagnostics[name], of_arrays.diagnostics[name], rtol=1e-4, atol=1e-12), name
    assert not done.diagnostics["gmres_iterations"].any()
