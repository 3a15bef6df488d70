"""The step guard, and what a failing run leaves: the last good state in trajectory and checkpoint, one line, exit code 3."""

import re
from dataclasses import replace

import numpy as np
import pytest
from scene_helpers import DT, PAIR, assert_same_frames, cli, scene_of, the_error, write_scene

from biem.errors import NumericalFailure
from biem.run import simulate as loop
from biem.run.checkpoint import checkpoint_path, read_checkpoint
from biem.run.guard import check_state
from biem.run.simulate import simulate
from biem.run.trajectory import read_trajectory
from biem.scene.build import build
from biem.stokes.near_search import minimum_gap

ALPHA = 2 * np.pi * np.arange(32) / 32
GOOD = {"area_error": 1e-5, "length_error": 1e-5, "area_error_vesicle": 0, "length_error_vesicle": 0, "gmres_iterations": 0}
CLOSE = {"vesicles": {"centers": [[-0.2, 0.0], [0.2, 0.0]], "angles": [1.57, 1.57]}}


def circles(distance):
    one = np.stack([0.2 * np.cos(ALPHA), 0.2 * np.sin(ALPHA)])
    return np.stack([one, one + np.array([distance, 0.0])[:, None], one + np.array([0.0, 5.0])[:, None]])


def figure_eight(X):
    out = X.copy()
    out[1] += np.stack([0.2 * np.sin(ALPHA), 0.2 * np.sin(2 * ALPHA)]) - X[1] + 3.0
    return out


def with_nan(X, value=np.nan):
    out = X.copy()
    out[2, 1, 7] = value
    return out


def test_a_good_state_passes():
    check_state(circles(0.41), np.zeros((3, 32)), GOOD, 1e-2)
    check_state(circles(0.41), None, {**GOOD, "area_error": 1e-2}, 1e-2)


@pytest.mark.parametrize(
    ("X", "sigma", "diagnostics", "fragments"),
    [
        (with_nan(circles(1.0)), None, {}, ["vesicle 2", "non-finite"]),
        (with_nan(circles(1.0), np.inf), None, {}, ["vesicle 2", "non-finite"]),
        (circles(1.0), np.full((3, 32), np.nan), {}, ["tension", "finite"]),
        (circles(1.0), None, {"area_error": 0.02, "area_error_vesicle": 1}, ["area of vesicle 1", "2.00e-02", "max_error"]),
        (circles(1.0), None, {"length_error": 0.3, "length_error_vesicle": 2}, ["length of vesicle 2", "3.00e-01"]),
        (circles(1.0), None, {"area_error": np.nan}, ["area of vesicle 0"]),
        (circles(0.39), None, {}, ["vesicles 0 and 1 cross"]),
        (circles(0.0), None, {}, ["vesicles 0 and 1 cross"]),  # one on top of the other
        (figure_eight(circles(1.0)), None, {}, ["vesicle 1 crosses itself"]),
    ],
)
def test_a_bad_state_is_rejected_with_vesicle_and_numbers(X, sigma, diagnostics, fragments):
    with pytest.raises(NumericalFailure) as caught:
        check_state(X, sigma, {**GOOD, **diagnostics}, 1e-2)
    assert all(fragment in str(caught.value) for fragment in fragments), str(caught.value)


def spoil_step_3(monkeypatch, spoil):
    """The stepper's third state is spoil(X)."""
    make = loop.make_stepper

    class Spoiling:
        def __init__(self, *arguments):
            self.inner, self.taken = make(*arguments), 0

        def step(self, state, dt):
            self.taken += 1
            result = self.inner.step(state, dt)
            return replace(result, state=replace(result.state, X=spoil(result.state.X))) if self.taken == 3 else result

    monkeypatch.setattr(loop, "make_stepper", Spoiling)


def crossing(X):
    return X - X.mean(axis=-1, keepdims=True)


def nan(X):
    return X * np.nan


@pytest.mark.parametrize(("spoil", "fragment"), [(nan, "non-finite"), (crossing, "vesicles 0 and 1 cross")])
@pytest.mark.parametrize("save_every", [1, 5])
def test_failing_run_ends_in_one_line_with_the_last_good_state_on_disk(tmp_path, monkeypatch, spoil, fragment, save_every):
    changes = {**PAIR, "time": {"save_every": save_every}}
    good = simulate(scene_of(PAIR, time={"horizon": 2 * DT})).trajectory
    whole = simulate(scene_of(changes)).trajectory
    path, out = write_scene(tmp_path, changes), tmp_path / "out.h5"
    with monkeypatch.context() as patch:
        spoil_step_3(patch, spoil)
        message = the_error(cli("run", path, "-o", out), 3)
    assert "step 3" in message
    assert f"t = {2 * DT:.6g}" in message
    assert fragment in message
    kept, checkpoint = read_trajectory(out), read_checkpoint(checkpoint_path(out))
    assert kept.step.tolist() == ([0, 1, 2] if save_every == 1 else [0, 2])
    assert np.isfinite(kept.X).all()
    state = checkpoint.state
    for X, sigma, t in ((kept.X[-1], kept.sigma[-1], kept.t[-1]), (state.X, state.sigma, state.t)):
        assert t == 2 * DT
        assert np.array_equal(X, good.X[-1])
        assert np.array_equal(sigma, good.sigma[-1])
    assert not (tmp_path / "out.h5.frames").exists()
    assert cli("run", path, "-o", out, "--resume").exit_code == 0  # the failure was not the scene's
    resumed = read_trajectory(out)
    assert np.array_equal(resumed.X[-1], whole.X[-1])
    if save_every == 1:
        assert_same_frames(resumed, whole)


def test_absurd_time_steps_fail_in_one_line(tmp_path):
    path = write_scene(tmp_path, time={"dt": 1e3, "horizon": 1e4}, solver={"corrections": []})
    message = the_error(cli("run", path, "-o", tmp_path / "out.h5"), 3)
    step, error = int(re.search(r"step (\d+) rejected", message)[1]), float(re.search(r"is off by (\S+)", message)[1])
    assert error > 1e-2
    kept = read_trajectory(tmp_path / "out.h5")
    assert kept.step[-1] == step - 1
    assert np.isfinite(kept.X).all()


@pytest.mark.parametrize("rate", [1e30, 1e200, 1e300])
def test_absurd_flows_fail_in_one_line(tmp_path, rate):
    path = write_scene(tmp_path, flow={"rate": rate})
    message = the_error(cli("run", path, "-o", tmp_path / "out.h5", "--quiet"), 3)
    assert "step 1 rejected" in message
    assert np.isfinite(read_trajectory(tmp_path / "out.h5").X).all()


@pytest.mark.parametrize("pair", [CLOSE, {"vesicles": {"centers": [[-2.0, 0.0], [2.0, 0.0]]}}], ids=["close", "far"])
def test_gmres_that_does_not_converge_gives_residual_iterations_and_gap(tmp_path, pair):
    scene = scene_of(pair, solver={"max_iterations": 1})
    path = write_scene(tmp_path, pair, solver={"max_iterations": 1})
    message = the_error(cli("run", path, "-o", tmp_path / "out.h5"), 3)
    residual = float(re.search(r"residual of (\S+)", message)[1])
    assert 1e-10 < residual < 1
    assert "1 iteration" in message
    gap = float(re.search(r"gap .*?(inf|\d\S*?)[:;]", message)[1])
    assert gap == pytest.approx(minimum_gap(build(scene).X), rel=0.01)
