"""Runs that are stopped, killed and read meanwhile, each in a process of its own."""

import os
import random
import signal
import subprocess
import sys

import numpy as np
import pytest
from scene_helpers import (
    DT,
    PAIR,
    SIGNALLING_FLOW,
    assert_prefix,
    assert_same_frames,
    cli,
    die_at,
    error_line,
    finish,
    frames_or_none,
    start_cli,
    the_error,
    write_flow,
    write_scene,
)

from biem.run.checkpoint import checkpoint_path, read_checkpoint
from biem.run.trajectory import read_trajectory

KILLED = -signal.SIGKILL


def whole_run(folder, scene):
    """The frames of the uninterrupted run."""
    assert cli("run", scene, "-o", folder / "whole.h5", "--quiet").exit_code == 0
    return read_trajectory(folder / "whole.h5")


def signalling_scene(folder, *changes, **more):
    """A scene whose flow can send a signal to its process at a given step."""
    module = write_flow(folder, SIGNALLING_FLOW)
    return write_scene(folder, *changes, more, flow={"kind": "custom", "rate": None, "function": f"{module}.shear"})


def at(step, name):
    return {"STOP_AT": repr(step * DT), "STOP_BY": name}


@pytest.mark.parametrize(("pair", "name"), [({}, "SIGTERM"), (PAIR, "SIGTERM"), ({}, "SIGINT")])
def test_stopped_run_can_be_read_and_resumed_bitwise(tmp_path, pair, name):
    path, out = signalling_scene(tmp_path, pair, time={"save_every": 2, "horizon": 8 * DT}), tmp_path / "out.h5"
    exit_code, printed = finish(start_cli(["run", path, "-o", out], tmp_path / "log", at(4, name)), tmp_path / "log")
    message = error_line(printed, exit_code, 4)
    assert "step 5 of 8" in message  # the step in which the signal came is finished
    assert "--resume" in message
    whole = whole_run(tmp_path, path)
    assert_prefix(read_trajectory(out), whole)
    assert read_trajectory(out).step.tolist() == [0, 2, 4]
    assert read_checkpoint(checkpoint_path(out)).step == 5
    assert not (tmp_path / "out.h5.frames").exists()
    assert cli("run", path, "-o", out, "--resume", "--quiet").exit_code == 0
    assert_same_frames(read_trajectory(out), whole)


def test_the_real_command_stops_with_exit_code_4_and_goes_on(tmp_path):
    path, out = signalling_scene(tmp_path), tmp_path / "out.h5"
    command = [sys.executable, "-m", "biem", "run", str(path), "-o", str(out)]
    stopped = subprocess.run(command, env={**os.environ, **at(2, "SIGTERM")}, capture_output=True, text=True, check=False)
    assert "step 3 of 6" in error_line(stopped.stderr, stopped.returncode, 4)
    resumed = subprocess.run([*command, "--resume"], capture_output=True, text=True, check=False)
    assert resumed.returncode == 0, resumed.stderr
    assert_same_frames(read_trajectory(out), whole_run(tmp_path, path))


@pytest.mark.parametrize("step", [1, 3, 5])
def test_run_killed_within_a_step_keeps_all_frames_before_it(tmp_path, step):
    path, out = signalling_scene(tmp_path), tmp_path / "out.h5"
    exit_code, _ = finish(start_cli(["run", path, "-o", out], tmp_path / "log", at(step, "SIGKILL")), tmp_path / "log")
    assert exit_code == KILLED
    assert read_trajectory(out).step.tolist() == list(range(step + 1))
    assert cli("run", path, "-o", out, "--resume", "--quiet").exit_code == 0
    assert_same_frames(read_trajectory(out), whole_run(tmp_path, path))


def test_run_killed_at_random_moments_loses_no_frame_and_ends_the_same(tmp_path):
    """One run of 70 steps, killed from outside six times while it is being read, resumed each time."""
    path, out, log = write_scene(tmp_path, time={"horizon": 70 * DT}), tmp_path / "out.h5", tmp_path / "log"
    whole = whole_run(tmp_path, path)
    for kills, target in enumerate(sorted(random.Random(3).sample(range(2, 66), 6))):
        process = start_cli(["run", path, "-o", out, "--quiet", *(["--resume"] if kills else [])], log)
        while process.is_alive() and ((before := frames_or_none(out)) is None or len(before) < target):
            pass
        process.kill()
        assert finish(process, log)[0] == KILLED, log.read_text()
        assert_prefix(before, whole)
        after = read_trajectory(out)
        assert_prefix(after, whole)
        assert len(after) >= len(before) >= target
    assert cli("run", path, "-o", out, "--resume", "--quiet").exit_code == 0
    assert_same_frames(read_trajectory(out), whole)
    assert not (tmp_path / "out.h5.frames").exists()


@pytest.mark.parametrize("event", range(5, 81, 15))
def test_run_killed_before_any_file_operation_ends_the_same(tmp_path, event):
    path = write_scene(tmp_path, time={"save_every": 2}, output={"checkpoint_every": 1})
    out, log = tmp_path / "out.h5", tmp_path / "log"
    whole = whole_run(tmp_path, path)
    exit_code, printed = finish(start_cli(["run", path, "-o", out, "--quiet"], log, None, die_at, (event, str(tmp_path))), log)
    assert exit_code == KILLED, printed or "the run has fewer file operations than this: lower the range"
    if out.exists():
        assert_prefix(read_trajectory(out), whole)
    result = cli("run", path, "-o", out, "--quiet", *(["--resume"] if checkpoint_path(out).exists() else ["--force"]))
    assert result.exit_code == 0, result.output
    assert_same_frames(read_trajectory(out), whole)


@pytest.mark.parametrize("event", range(5, 10))
def test_replacing_killed_at_any_file_operation_never_mixes_two_runs(tmp_path, event):
    """--force over what a killed run left: afterwards there is the old run or the new one, not frames of both."""
    old, out, log = signalling_scene(tmp_path), tmp_path / "out.h5", tmp_path / "log"
    finish(start_cli(["run", old, "-o", out, "--quiet"], log, at(3, "SIGKILL")), log)
    before = read_trajectory(out)
    assert (tmp_path / "out.h5.frames").exists()
    new = write_scene(tmp_path, vesicles={"points": 32})
    after = whole_run(tmp_path, new)
    finish(start_cli(["run", new, "-o", out, "--force", "--quiet"], log, None, die_at, (event, str(tmp_path))), log)
    left = read_trajectory(out)
    assert_prefix(left, before if left.X.shape[-1] == 16 else after)


@pytest.mark.parametrize("event", [5, 6, 8, 10, 12])
def test_resuming_a_replacement_that_was_killed_skips_no_frame(tmp_path, event):
    path, out, log = write_scene(tmp_path), tmp_path / "out.h5", tmp_path / "log"
    whole = whole_run(tmp_path, path)
    assert cli("run", path, "-o", out, "--quiet").exit_code == 0
    finish(start_cli(["run", path, "-o", out, "--force", "--quiet"], log, None, die_at, (event, str(tmp_path))), log)
    result = cli("run", path, "-o", out, "--resume", "--quiet")
    if result.exit_code == 0:
        assert_same_frames(read_trajectory(out), whole)
    else:
        the_error(result, 2)


def test_run_is_readable_from_another_process_while_it_writes(tmp_path):
    path, out, log = write_scene(tmp_path, time={"horizon": 80 * DT}), tmp_path / "out.h5", tmp_path / "log"
    process, seen = start_cli(["run", path, "-o", out, "--quiet"], log), []
    while process.is_alive():
        frames = frames_or_none(out)
        if frames is not None:
            seen.append(frames)
    assert finish(process, log) == (0, "")
    whole = read_trajectory(out)
    for frames in seen:
        assert_prefix(frames, whole)
    lengths = [len(frames) for frames in seen]
    assert lengths == sorted(lengths)  # a frame that was there stays there
    assert len(set(lengths)) > 5  # it was read while it grew
    assert np.array_equal(whole.step, np.arange(81))
