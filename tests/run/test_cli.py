"""The command line: what it prints, its exit codes, and that every failure is one line starting with "error:"."""

import re

import h5py
import pytest
from scene_helpers import (
    DT,
    PAIR,
    assert_same_frames,
    cli,
    error_line,
    finish,
    scene_of,
    start_cli,
    the_error,
    write_flow,
    write_scene,
)

from biem.curves.curve import area
from biem.run.simulate import simulate
from biem.run.trajectory import read_trajectory


def test_run_writes_the_trajectory_and_a_summary(tmp_path):
    path, out = write_scene(tmp_path, PAIR), tmp_path / "out.h5"
    result = cli("run", path, "-o", out)
    assert result.exit_code == 0
    done = read_trajectory(out)
    assert_same_frames(done, simulate(scene_of(PAIR)).trajectory)
    summary = result.stdout
    assert f"7 frames to t = {6 * DT:.6g}" in summary
    assert str(out) in summary
    assert float(re.search(r"smallest gap (\S+);", summary)[1]) == pytest.approx(done.diagnostics["min_gap"].min(), rel=1e-3)
    assert f"at most {done.diagnostics['gmres_iterations'].max():.0f} GMRES" in summary
    assert f"area {done.diagnostics['area_error'].max():.1e}" in summary
    assert "pair_sum" in summary


def test_quiet_prints_nothing(tmp_path):
    result = cli("run", write_scene(tmp_path), "-o", tmp_path / "out.h5", "--quiet")
    assert (result.exit_code, result.output) == (0, "")


def test_output_goes_where_asked_else_where_the_scene_says_else_to_out(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    path = write_scene(tmp_path)
    assert cli("run", path, "--quiet").exit_code == 0
    assert len(read_trajectory(tmp_path / "out" / "tiny.h5")) == 7
    assert cli("run", path, "--quiet", "--set", "output.trajectory=elsewhere/x.h5").exit_code == 0
    assert len(read_trajectory(tmp_path / "elsewhere" / "x.h5")) == 7
    assert cli("run", path, "--quiet", "--set", "output.trajectory=elsewhere/x.h5", "-o", tmp_path / "here.h5").exit_code == 0
    assert len(read_trajectory(tmp_path / "here.h5")) == 7


def test_set_and_solver_override_the_file(tmp_path):
    path = write_scene(tmp_path)
    changes = ["--solver", "implicit", "--set", "vesicles.points=32", "--set", f"time.horizon={DT}"]
    assert cli("run", path, "-o", tmp_path / "out.h5", *changes).exit_code == 0
    assert read_trajectory(tmp_path / "out.h5").X.shape == (2, 1, 2, 32)
    assert "solver.kind" in the_error(cli("run", path, "--solver", "exact"), 2)


def test_reoriented_vesicles_are_noticed_aloud(tmp_path):
    X = simulate(scene_of(PAIR)).trajectory.X[0]
    with h5py.File(tmp_path / "shapes.h5", "w") as file:
        file["X"] = X[:, :, ::-1]
    path = write_scene(tmp_path, vesicles={"file": "shapes.h5", "points": None, "reduced_area": None})
    result = cli("run", path, "-o", tmp_path / "out.h5", "--quiet")
    assert result.exit_code == 0
    assert "notice: 2 clockwise" in result.stderr
    assert (area(read_trajectory(tmp_path / "out.h5").X[0]) > 0).all()


FAILURES = {
    "missing scene": (["run", "{tmp}/none.toml"], "does not exist"),
    "scene is a folder": (["run", "{tmp}"], "folder"),
    "scene below a file": (["plan", "{scene}/x.toml"], "x.toml"),
    "bad toml": (["plan", "{tmp}/bad.toml"], "not valid TOML"),
    "unknown key": (["run", "{scene}", "--set", "vesicles.point=32"], "did you mean points?"),
    "set without =": (["run", "{scene}", "--set", "vesicles.points"], "key=value"),
    "bad value": (["plan", "{scene}", "--set", "vesicles.points=17"], "vesicles.points"),
    "bad time": (["run", "{scene}", "-o", "{tmp}/x.h5", "--set", "time.horizon=0"], "time.horizon"),
    "touching": (["run", "{scene}", "-o", "{tmp}/x.h5", "--set", "vesicles.centers=[[0,0],[0.1,0]]"], "vesicles 0 and 1 overlap"),
    "no shapes": (["run", "{tmp}/file.toml", "-o", "{tmp}/x.h5"], "shapes.h5"),
    "flow with an error": (["run", "{tmp}/custom.toml", "-o", "{tmp}/x.h5"], "flow_"),
    "nothing to resume": (["run", "{scene}", "-o", "{tmp}/x.h5", "--resume"], "no readable checkpoint"),
    "no trajectory to plot": (["plot", "{tmp}/none.h5"], "none.h5"),
    "plot a scene": (["plot", "{scene}"], "scene.toml"),
    "plot a folder": (["plot", "{tmp}"], "is a folder: give the trajectory"),
    "no trajectory to verify": (["verify", "{tmp}/none.h5"], "none.h5"),
    "verify a scene": (["verify", "{scene}"], "scene.toml"),
    "verify a folder": (["verify", "{tmp}"], "is a folder: give the trajectory"),
    "too many steps": (["run", "{scene}", "-o", "{tmp}/x.h5", "--set", "time.dt=1e-14"], "free"),
}


@pytest.mark.parametrize("case", FAILURES)
def test_failures_end_in_one_line_and_an_exit_code(tmp_path, case):
    arguments, fragment = FAILURES[case]
    (tmp_path / "bad.toml").write_text("time = [")
    times = f"[time]\ndt = {DT}\nhorizon = {DT}\n"
    (tmp_path / "file.toml").write_text(f'[vesicles]\nfile = "shapes.h5"\n{times}')
    module = write_flow(tmp_path, "def f(x, y, t):\n    return nothing, y\n")
    (tmp_path / "custom.toml").write_text(f'[flow]\nkind = "custom"\nfunction = "{module}.f"\n{times}')
    names = {"tmp": tmp_path, "scene": write_scene(tmp_path)}
    message = the_error(cli(*(a.format(**names) for a in arguments)), 2, 5)
    assert fragment in message
    assert not (tmp_path / "x.h5").exists()


@pytest.mark.parametrize("arguments", [["run"], ["run", "{scene}", "--sett", "x=1"], ["sing"], ["plan", "{scene}", "more"]])
def test_wrong_usage_is_told_and_fails(tmp_path, arguments):
    result = cli(*(a.format(scene=write_scene(tmp_path)) for a in arguments))
    assert result.exit_code == 2
    assert "Traceback" not in result.output
    assert "--help" in result.output


@pytest.mark.parametrize("command", [[], ["run"], ["plan"], ["plot"], ["verify"]])
def test_help_is_there(command):
    result = cli(*command, "--help")
    assert result.exit_code == 0
    assert "Usage" in result.output


@pytest.mark.parametrize(("changes", "code"), [({"flow": {"rate": 1e200}}, 3), ({"vesicles": {"points": 17}}, 2)])
def test_failing_process_prints_one_line_and_nothing_else(tmp_path, changes, code):
    arguments = ["run", write_scene(tmp_path, changes), "-o", tmp_path / "out.h5", "--quiet"]
    exit_code, printed = finish(start_cli(arguments, tmp_path / "log"), tmp_path / "log")
    error_line(printed, exit_code, code)
    assert len(printed.splitlines()) == 1, printed
