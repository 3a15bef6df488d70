"""Bad input to the split solver and its options: each is one line that says what was got and what to do, and leaves no file behind."""

import os
import subprocess
import sys

import pytest
from limits import LIMIT
from scene_helpers import PAIR, cli, error_line, scene_of, the_error, write_scene

import biem.run.solver as solver
from biem.run.simulate import simulate
from biem.scene.build import build
from biem.scene.plan import memory_estimate

SPLIT = {"kind": "split"}
# table solver, and the words that the message must have: the key, the value that it got, what was expected or is to be done
WRONG = {
    "unknown device": ({**SPLIT, "device": "gpu"}, ["solver.device", "gpu", "cuda"]),
    "unknown precision": ({**SPLIT, "dtype": "float16"}, ["solver.dtype", "float16", "float32", "float64"]),
    "far tolerance in float32": (
        {**SPLIT, "dtype": "float32", "far_tolerance": 1e-9},
        ["solver.far_tolerance", "1e-09", "at least 1e-05", 'dtype = "float64"'],
    ),
    "near tolerance in float32": ({**SPLIT, "dtype": "float32", "near_tolerance": 1e-6}, ["solver.near_tolerance", "float32", "1e-05"]),
    "unknown far field": ({**SPLIT, "far_field": "fmm"}, ["solver.far_field", "fmm", "direct", "ewald"]),
    "unknown near field": ({**SPLIT, "near_field": "exact"}, ["solver.near_field", "exact", "upsample"]),
    "unknown kind": ({"kind": "explicit"}, ["solver.kind", "explicit", "implicit", "split"]),
    "layers with implicit": ({"near_field": "layers"}, ["solver.near_field", "layers", 'solver.kind = "split"']),
    "layers_rbf with implicit": ({"near_field": "layers_rbf"}, ["solver.near_field", "layers_rbf", 'solver.kind = "split"']),
    "device with implicit": ({"device": "torch"}, ["solver.device", 'solver.kind = "split"']),
    "precision with implicit": ({"dtype": "float32"}, ["solver.dtype", 'solver.kind = "split"']),
    "tolerance with split": ({**SPLIT, "tolerance": 1e-8}, ["solver.tolerance", 'solver.kind = "implicit"']),
    "iterations with split": ({**SPLIT, "max_iterations": 10}, ["solver.max_iterations", 'solver.kind = "implicit"']),
    "near tolerance 0": ({**SPLIT, "near_tolerance": 0}, ["solver.near_tolerance", "0", "greater than 0"]),
    "far tolerance 1": ({**SPLIT, "far_tolerance": 1.0}, ["solver.far_tolerance", "1.0", "less than 1"]),
    "too few operator points": ({**SPLIT, "operator_points": 16}, ["solver.operator_points", "16", "32", "at least"]),
    "odd operator points": ({**SPLIT, "operator_points": 65}, ["solver.operator_points", "65", "multiple of 2"]),
    "repulsion that is no table": ({**SPLIT, "repulsion": True}, ["solver.repulsion", "True", "[solver.repulsion]"]),
    "negative reach": ({**SPLIT, "repulsion": {"reach": -1}}, ["solver.repulsion.reach", "-1", "greater than 0"]),
    "no reach": ({**SPLIT, "repulsion": {"strength": 1.0}}, ["solver.repulsion.reach", "missing"]),
    "strength 0": ({**SPLIT, "repulsion": {"reach": 0.1, "strength": 0}}, ["solver.repulsion.strength", "0", "greater than 0"]),
    "misspelt reach": ({**SPLIT, "repulsion": {"reach": 0.1, "strenth": 1}}, ["solver.repulsion.strenth", "did you mean strength?"]),
    "misspelt key": ({**SPLIT, "far_feild": "direct"}, ["solver.far_feild", "did you mean far_field?"]),
}


def as_toml(value):
    if isinstance(value, dict):
        return "{" + ", ".join(f"{k} = {as_toml(v)}" for k, v in value.items()) + "}"
    return {True: "true", False: "false"}[value] if isinstance(value, bool) else repr(value).replace("'", '"')


def settings(table):
    """--set arguments of a table solver."""
    return [argument for key, value in table.items() for argument in ("--set", f"solver.{key}={as_toml(value)}")]


@pytest.mark.parametrize("case", WRONG)
def test_bad_options_are_told_in_one_line_and_leave_nothing(tmp_path, case):
    table, words = WRONG[case]
    path = write_scene(tmp_path, PAIR, vesicles={"points": 32})
    result = cli("run", path, "-o", tmp_path / "out.h5", *settings(table))
    message = the_error(result, 2)
    assert result.stdout == ""
    assert [word for word in words if word not in message] == [], message
    assert [file.name for file in tmp_path.iterdir()] == ["scene.toml"]
    assert the_error(cli("plan", path, *settings(table)), 2) == message  # plan says the same


@pytest.mark.parametrize("name", ["cuda", "cuda:7"])
def test_cuda_that_is_not_there_is_told(tmp_path, name):
    torch = pytest.importorskip("torch")
    if torch.cuda.is_available() and torch.cuda.device_count() > 7:
        pytest.skip("this machine has it")
    if name == "cuda" and torch.cuda.is_available():
        pytest.skip("this machine has it")
    message = the_error(cli("run", write_scene(tmp_path, PAIR), "-o", tmp_path / "out.h5", *settings({**SPLIT, "device": name})), 2)
    assert f'solver.device = "{name}"' in message
    assert '"cpu"' in message
    assert not list(tmp_path.glob("out*"))


def without(folder, *modules):
    """Environment of a process in which these modules cannot be imported."""
    names = ", ".join(repr(m) for m in modules)
    (folder / "sitecustomize.py").write_text(
        "from importlib.machinery import PathFinder\n"
        "find = PathFinder.find_spec\n"
        f"without = lambda name, *a, **k: None if name.partition('.')[0] in ({names},) else find(name, *a, **k)\n"
        "PathFinder.find_spec = staticmethod(without)\n"
    )
    return {**os.environ, "PYTHONPATH": os.pathsep.join([str(folder), os.environ.get("PYTHONPATH", "")])}


def process(folder, *arguments, environment=None):
    command = [sys.executable, "-m", "biem", *map(str, arguments)]
    return subprocess.run(command, env=environment, capture_output=True, text=True, check=False, timeout=LIMIT)


def test_ewald_without_finufft_names_the_extra_and_auto_does_without(tmp_path):
    path, environment = write_scene(tmp_path, PAIR), without(tmp_path, "finufft")
    arguments = ("run", path, "-o", tmp_path / "out.h5", "--quiet")
    done = process(tmp_path, *arguments, *settings({**SPLIT, "far_field": "ewald"}), environment=environment)
    message = error_line(done.stderr, done.returncode, 2)
    assert "vesnet[fast]" in message
    assert "finufft" in message
    assert len(done.stderr.splitlines()) == 1
    assert not list(tmp_path.glob("out*"))
    done = process(tmp_path, *arguments, *settings(SPLIT), environment=environment)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


def test_memory_that_does_not_fit_is_told_before_anything_is_written(tmp_path, monkeypatch):
    needed = memory_estimate(build(scene_of(PAIR, solver=SPLIT)))
    monkeypatch.setattr(solver, "free_memory", lambda: 0.5 * needed)
    result = cli("run", write_scene(tmp_path, PAIR), "-o", tmp_path / "out.h5", *settings(SPLIT))
    message = the_error(result, 2)
    assert "2 vesicles of 16 nodes" in message
    assert "memory" in message
    assert "0.0 GB" not in message, message  # sizes that differ are not both printed as nothing
    assert 'take fewer vesicles or nodes, solver.kind = "split"' not in message  # it is split already
    assert not list(tmp_path.glob("out*"))


def test_memory_that_just_fits_is_no_error(monkeypatch):
    scene = scene_of(PAIR, solver=SPLIT)
    needed = memory_estimate(build(scene))
    monkeypatch.setattr(solver, "free_memory", lambda: 1.01 * needed)
    assert len(simulate(scene).trajectory) == 7
