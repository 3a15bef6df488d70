"""--json and --quiet: what programs read is JSON and nothing else; --version; completion by the shell."""

import json
import os
import re
import subprocess
import sys

import h5py
import numpy as np
import pytest
from scene_helpers import DT, ONE, PAIR, cli, scene_of, the_error, write_scene
from typer.testing import CliRunner

import biem
from biem.__main__ import app
from biem.run.reports import as_json
from biem.run.trajectory import read_trajectory
from biem.scene.build import build
from biem.scene.plan import memory_estimate, required_parts


def answer(*arguments):
    """The JSON of a command that succeeds; asserts that there is nothing else on the standard output."""
    result = cli(*arguments, "--json")
    assert result.exit_code == 0, result.output
    return json.loads(result.stdout)


def test_run_reports_what_is_in_its_file(tmp_path):
    path, out = write_scene(tmp_path, PAIR), tmp_path / "out.h5"
    report = answer("run", path, "-o", out)
    run = read_trajectory(out)
    assert (report["trajectory"], report["frames"], report["steps"]) == (str(out), 7, 6)
    assert (report["vesicles"], report["points"], report["processes"]) == (2, 16, 1)
    assert report["t"] == run.t[-1]
    assert report["t_gamma"] == pytest.approx(0.01)
    assert report["min_gap"] == run.diagnostics["min_gap"].min()
    assert report["gmres_iterations"] == run.diagnostics["gmres_iterations"].max()
    assert report["area_error"] == run.diagnostics["area_error"].max()
    assert report["used"]["pair_sum"] > 0
    assert report["notices"] == []
    assert answer("run", path, "-o", out, "--force", "--quiet")["frames"] == 7  # a report that is asked for is given


def test_one_vesicle_has_no_gap_and_notices_are_reported(tmp_path):
    with h5py.File(tmp_path / "shapes.h5", "w") as file:
        file["X"] = build(scene_of()).X[:, :, ::-1]
    path = write_scene(tmp_path, vesicles={"file": "shapes.h5", "points": None, "reduced_area": None})
    report = answer("run", path, "-o", tmp_path / "out.h5")
    assert "min_gap" not in report
    assert report["notices"] == ["1 clockwise vesicle(s) reoriented, the first is 0"]


def test_plan_reports_what_it_prints(tmp_path):
    path = write_scene(tmp_path, PAIR)
    report = answer("plan", path)
    problem = build(scene_of(PAIR))
    assert report["steps"] == 6
    assert report["dt"] == DT
    assert report["t_gamma"] == pytest.approx(1 / ONE["flow"]["rate"])
    assert report["memory_bytes"] == memory_estimate(problem)
    assert [(part["name"], part["needed"]) for part in report["parts"]] == [(p.name, p.needed) for p in required_parts(problem)]
    assert report["seconds"] == pytest.approx(6 * report["seconds_a_step"])
    assert report["seconds_a_step"] > 0
    unmeasured = answer("plan", path, "--no-measure")
    assert unmeasured["seconds_a_step"] is None
    assert f"dt = {DT:.6g}" in cli("plan", path, "--no-measure").stdout


def test_plan_quietly_is_a_check_of_a_scene(tmp_path):
    result = cli("plan", write_scene(tmp_path), "--quiet")
    assert (result.exit_code, result.output) == (0, "")
    assert "vesicles.points" in the_error(cli("plan", write_scene(tmp_path), "--quiet", "--set", "vesicles.points=17"), 2)


def test_verify_reports_its_checks_and_quietly_only_failures(tmp_path):
    out = tmp_path / "out.h5"
    assert cli("run", write_scene(tmp_path), "-o", out, "--quiet").exit_code == 0
    report = answer("verify", out)
    assert report["passed"]
    assert {check["name"] for check in report["checks"]} >= {"area kept", "no crossing", "energies match"}
    assert cli("verify", out, "--quiet").output == ""
    with h5py.File(out, "r+") as file:
        file["X"][3] *= 1.01
    result = cli("verify", out, "--json")
    assert result.exit_code == 3
    failed = [check["name"] for check in json.loads(result.stdout)["checks"] if not check["passed"]]
    assert failed == ["area kept", "length kept", "energies match"]
    assert result.stderr.startswith("error: 3 of ")
    assert [line.split(":")[0] for line in cli("verify", out, "--quiet").stdout.splitlines()] == [f"FAILED  {name}" for name in failed]


def test_errors_leave_the_standard_output_empty(tmp_path):
    for command in (["run", tmp_path / "none.toml"], ["plan", tmp_path / "none.toml"], ["verify", tmp_path / "none.h5"]):
        result = cli(*command, "--json")
        assert (result.exit_code, result.stdout) == (2, "")
        assert result.stderr.startswith("error: ")


def test_numbers_that_json_does_not_have_are_null():
    report = {"gap": np.inf, "list": [float("nan"), 1.5], "inner": {"x": -np.inf, "n": 3, "t": None, "b": True}}
    assert json.loads(as_json(report)) == {"gap": None, "list": [None, 1.5], "inner": {"x": None, "n": 3, "t": None, "b": True}}


def test_version_is_told():
    result = cli("--version")
    assert (result.exit_code, result.output) == (0, f"vesnet {biem.__version__}\n")
    assert re.fullmatch(r"\d+\.\d+\.\d+", biem.__version__)


def completions(words):
    """What bash is offered for the last of the words."""
    asked = {"_BIEM_COMPLETE": "complete_bash", "COMP_WORDS": words, "COMP_CWORD": str(len(words.split(" ")) - 1)}
    return CliRunner().invoke(app, [], prog_name="biem", env=asked).stdout.split()


def test_the_shell_completes_commands_options_and_names():
    assert {"new", "run", "plan", "plot", "verify", "doctor"} <= set(completions("biem "))
    assert completions("biem ver") == ["verify"]
    assert {"--resume", "--json", "--quiet"} <= set(completions("biem run --"))
    assert completions("biem new shear_p") == ["shear_pair"]
    assert completions("biem run x.toml --accuracy b") == ["balanced"]


def test_bash_completes_with_the_script_that_is_shown(tmp_path):
    """The script of --show-completion, in a bash of its own."""
    (tmp_path / "biem").write_text(f"#!{sys.executable}\nfrom biem.__main__ import app\n\napp(prog_name='biem')\n")
    (tmp_path / "biem").chmod(0o755)
    told = {"_TYPER_COMPLETE_TEST_DISABLE_SHELL_DETECTION": "1", "PATH": f"{tmp_path}:{os.environ['PATH']}"}
    answer = {"env": {**os.environ, **told}, "capture_output": True, "text": True, "timeout": 60}
    shown = subprocess.run([tmp_path / "biem", "--show-completion", "bash"], check=True, **answer)
    press_tab = "COMP_WORDS=(biem new rel); COMP_CWORD=2; _biem_completion biem; echo ${COMPREPLY[@]}"
    (tmp_path / "try.sh").write_text(f"{shown.stdout}\n{press_tab}\n")
    done = subprocess.run(["bash", tmp_path / "try.sh"], check=True, **answer)
    assert done.stdout.split() == ["relaxation"], done.stderr
