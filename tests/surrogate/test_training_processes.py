"""Trainings on several processes: under mpirun and as a job array, the networks of one process; stopped by a signal, they go on."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from datagen_fakes import MPIRUN

from surrogate.weights import read_weights

ROOT = Path(__file__).parents[2]
QUICK = ["--set", "training.samples=64", "--set", "training.batch=16", "--set", "training.every=2", "--set", "network.width=8"]
LIMIT = 120


def start(*arguments, launcher=(), **environment):
    command = [*launcher, sys.executable, "-m", "surrogate", "train", *(str(a) for a in arguments)]
    quiet = {**os.environ, "OMP_NUM_THREADS": "1", **environment}
    return subprocess.Popen(command, cwd=ROOT, env=quiet, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)


def finish(process):
    printed, _ = process.communicate(timeout=LIMIT)
    return process.returncode, printed


def tensors(folder):
    """Of all networks below a folder, by their names."""
    found = {path.parent.name: read_weights(path)[0].state_dict() for path in sorted(folder.rglob("weights.safetensors"))}
    return {name: {key: value.tolist() for key, value in state.items()} for name, state in found.items()}


@pytest.fixture(scope="module")
def alone(pairs_path, tmp_path_factory):
    folder = tmp_path_factory.mktemp("alone")
    code, printed = finish(start("--all", "--data", pairs_path, "-o", folder, "--quiet", *QUICK))
    assert code == 0, printed
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
    for k in "12":
        done = subprocess.run(
            script, env={**os.environ, **environment, "SLURM_ARRAY_TASK_ID": k}, capture_output=True, text=True, timeout=LIMIT, check=False
        )
        assert done.returncode == 0, done.stderr
        assert len(tensors(tmp_path / "runs")) == (2 if k == "1" else 5) or k == "1"
    assert tensors(tmp_path / "runs") == alone


def test_a_signal_leaves_a_checkpoint_that_goes_on(pairs_path, tmp_path):
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
    before = len(log.read_text().splitlines())
    process = start(*long, "-o", tmp_path)
    while len(log.read_text().splitlines()) <= before:
        assert process.poll() is None
        assert time.monotonic() < deadline
        time.sleep(0.05)
    process.send_signal(signal.SIGTERM)
    assert finish(process)[0] == 4
