"""Trainings on several processes: under mpirun and as a job array, the networks of one process; stopped by a signal, they go on."""

import json
import os
import signal
import subprocess
import sys
import time
from contextlib import contextmanager
from pathlib import Path

import pytest
from datagen_fakes import MPIRUN
from limits import LIMIT
from typer.testing import CliRunner

import surrogate.train
from surrogate.__main__ import app
from surrogate.weights import read_weights

ROOT = Path(__file__).parents[2]
QUICK = ["--set", "training.samples=64", "--set", "training.batch=16", "--set", "training.every=2", "--set", "network.width=8"]


def start(*arguments, launcher=(), **environment):
    command = [*launcher, sys.executable, "-m", "surrogate", "train", *(str(a) for a in arguments)]
    quiet = {**os.environ, "OMP_NUM_THREADS": "1", **environment}
    return subprocess.Popen(command, cwd=ROOT, env=quiet, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)


def finish(process):
    printed, _ = process.communicate(timeout=LIMIT)
    return process.returncode, printed


def invoke(*arguments):
    """`python -m surrogate` in this process."""
    return CliRunner().invoke(app, [str(a) for a in arguments])


def stopped_after(steps):
    """In place of signals: one that is seen after so many steps."""

    @contextmanager
    def signals():
        looks = iter(range(1, steps + 1))
        yield lambda: next(looks) == steps

    return signals


def tensors(folder):
    """Of all networks below a folder, by their names."""
    found = {path.parent.name: read_weights(path)[0].state_dict() for path in sorted(folder.rglob("weights.safetensors"))}
    return {name: {key: value.tolist() for key, value in state.items()} for name, state in found.items()}


@pytest.fixture(scope="module")
def alone(pairs_path, tmp_path_factory):
    folder = tmp_path_factory.mktemp("alone")
    done = invoke("train", "--all", "--data", pairs_path, "-o", folder, "--quiet", *QUICK)
    assert done.exit_code == 0, done.output
    return tensors(folder)


@pytest.mark.skipif(not MPIRUN.exists(), reason="no mpirun beside the interpreter")
def test_two_ranks_train_what_one_does(pairs_path, tmp_path, alone):
    pytest.importorskip("mpi4py")
    code, printed = finish(start("--all", "--data", pairs_path, "-o", tmp_path, "--quiet", *QUICK, launcher=(str(MPIRUN), "-n", "2")))
    assert code == 0, printed
    assert tensors(tmp_path) == alone


def test_the_slurm_script_trains_its_part(pairs_path, tmp_path, alone):
    environment = {
        "PYTHON": sys.executable,
        "SLURM_SUBMIT_DIR": str(ROOT),
        "SLURM_ARRAY_TASK_ID": "2",
        "SLURM_ARRAY_TASK_MIN": "1",
        "SLURM_ARRAY_TASK_MAX": "2",
        "SLURM_ARRAY_TASK_COUNT": "2",
    }
    config = tmp_path / "empty.toml"
    config.write_text("")
    script = [
        "bash",
        str(ROOT / "scripts" / "slurm" / "train_array.sh"),
        str(config),
        str(pairs_path.parent),
        str(tmp_path / "runs"),
        *QUICK,
    ]
    done = subprocess.run(script, env={**os.environ, **environment}, capture_output=True, text=True, timeout=LIMIT, check=False)
    assert done.returncode == 0, done.stderr
    found = tensors(tmp_path / "runs")
    assert len(found) == 4  # of five: the first part has the dearest
    assert found == {name: alone[name] for name in found}


def test_a_signal_leaves_a_checkpoint_that_goes_on(pairs_path, tmp_path, monkeypatch):
    long = [
        "--map",
        "self_tension",
        "--data",
        pairs_path,
        "--quiet",
        *QUICK,
        "--set",
        "training.samples=160000",
        "--set",
        "training.every=20",
    ]
    process = start(*long, "-o", tmp_path)
    log = tmp_path / "self_tension" / "log.jsonl"
    deadline = time.monotonic() + LIMIT
    while not (log.exists() and log.read_text()):
        assert process.poll() is None
        assert time.monotonic() < deadline
        time.sleep(0.05)
    process.send_signal(signal.SIGTERM)
    code, printed = finish(process)
    assert code == 4, printed
    assert "self_tension stopped at step" in printed
    assert len(printed.strip().splitlines()) == 1
    before = log.read_text().splitlines()
    monkeypatch.setattr(surrogate.train, "stop_signals", stopped_after(30))
    done = invoke("train", *long, "-o", tmp_path)
    assert done.exit_code == 4, done.output
    after = [json.loads(line)["step"] for line in log.read_text().splitlines()]
    step = json.loads(before[-1])["step"]
    assert after[: len(before)] == [json.loads(line)["step"] for line in before]
    assert after[len(before) :] == [k for k in range(step + 1, step + 31) if k % 20 == 0 or k == step + 30]
