"""python -m datagen under mpirun: the bytes of one process, one voice, signals, and an end whatever happens."""

import os
import re
import signal
import subprocess
from pathlib import Path

import pytest
from datagen_fakes import CHUNKS, MPIRUN, TASKS, command, contents, ranks_run, run
from limits import LIMIT
from scene_helpers import error_line

from datagen.manifest import read_manifests

pytest.importorskip("mpi4py")
pytestmark = [pytest.mark.usefixtures("fakes"), pytest.mark.skipif(not MPIRUN.exists(), reason="no mpirun beside the interpreter")]


@pytest.mark.parametrize("ranks", [1, 3])
def test_any_number_of_ranks_leaves_the_same_bytes_and_speaks_once(tmp_path, config, whole, ranks):
    exit_code, printed, bars = ranks_run(ranks, "make", config, "-o", tmp_path / "data", FAKE_LOG=str(tmp_path / "log"), FAKE_BUSY="0.01")
    assert exit_code == 0, bars
    assert contents(tmp_path / "data") == contents(whole)
    assert printed.count("harvest: ") == printed.count("coverage of") == printed.count("pairs joined") == 1
    assert all(1 <= bars.count(f"{n}/{n}") <= 2 for n in (TASKS, CHUNKS))  # the last task and the end
    attempts = [line.split() for line in (tmp_path / "log").read_text().splitlines()]
    assert len(attempts) == TASKS + CHUNKS
    assert len({process for _, process in attempts}) == ranks


def test_failures_are_told_once_by_all_ranks_and_parts_may_have_several(tmp_path, config, whole):
    data = tmp_path / "data"
    arguments = ("harvest", config, "-o", data, "--quiet")
    exit_code, _, printed = ranks_run(2, *arguments, "--part", "1/2", FAKE_WRONG="2:odd,4:interrupt")
    assert "2 of 4 tasks failed twice" in error_line(printed, exit_code, 3)
    assert len(printed.splitlines()) == 3
    for part in ("1/2", "2/2"):
        run(*arguments, "--part", part)
    run(*arguments)
    assert contents(data / "harvest") == contents(whole / "harvest")


def test_the_slurm_scripts_start_what_they_say(tmp_path, config, whole):
    """With the environment of Slurm, and a Python that runs the fakes."""
    data, bin_folder = tmp_path / "data", tmp_path / "bin"
    bin_folder.mkdir()
    for name, line in (("mpirun", f'exec {MPIRUN} "$@"'), ("python", f'shift 2; exec {" ".join(command(1))} "$@"')):
        (bin_folder / name).write_text(f"#!/bin/bash\n{line}\n")
        (bin_folder / name).chmod(0o755)
    array = {"SLURM_ARRAY_TASK_MIN": "1", "SLURM_ARRAY_TASK_MAX": "2", "SLURM_ARRAY_TASK_COUNT": "2"}
    common = {**os.environ, "PYTHON": str(bin_folder / "python"), "SLURM_SUBMIT_DIR": str(tmp_path)}

    def script(name, *arguments, **environment):
        path = Path(__file__).parents[2] / "scripts" / "slurm" / f"{name}.sh"
        done = subprocess.run(
            ["bash", path, *arguments], env=common | environment, capture_output=True, text=True, timeout=LIMIT, check=False
        )
        return done.returncode, done.stdout + done.stderr

    for k in "12":
        assert script("datagen_array", "harvest", "tiny.toml", "data", "--set", "seed=3", SLURM_ARRAY_TASK_ID=k, **array) == (0, "")
    assert sorted(path.name for path in (data / "harvest").glob("*.json")) == ["manifest.1-of-2.json", "manifest.2-of-2.json"]
    exit_code, printed = script(
        "datagen_array", "harvest", "tiny.toml", "data", SLURM_ARRAY_TASK_ID="2", **array | {"SLURM_ARRAY_TASK_MIN": "2"}
    )
    assert (exit_code, "PARTS=32" in printed) == (2, True)
    assert script("datagen_mpi", "make", "tiny.toml", "-o", "data", "--quiet", LAUNCH="mpirun", SLURM_NTASKS="2") == (0, "")
    assert contents(data) == contents(whole)


def test_what_is_refused_is_told_once(tmp_path, config, whole):
    exit_code, _, printed = ranks_run(2, "make", config, "-o", whole, "--quiet", "--set", "seed=9")
    assert "seed was 3, is 9" in error_line(printed, exit_code, 2)
    assert len(printed.splitlines()) == 1


@pytest.mark.parametrize("to", ["mpirun", "the second rank"])
def test_a_signal_stops_all_ranks_and_the_next_run_goes_on(tmp_path, config, whole, to):
    data, log = tmp_path / "data", tmp_path / "log"
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "FAKE_BUSY": "0.3", "FAKE_LOG": str(log)}
    process = subprocess.Popen(
        command(2, "harvest", config, "-o", data, "--quiet"), env=environment, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True
    )
    processes = []
    while len(processes) < 2 or not (manifest := read_manifests(data / "harvest")) or not manifest.shards:  # both compute, a shard is done
        assert process.poll() is None, process.communicate()
        processes = list(dict.fromkeys(line.split()[1] for line in log.read_text().splitlines())) if log.exists() else []
    os.kill(process.pid if to == "mpirun" else int(processes[1]), signal.SIGTERM)
    _, printed = process.communicate(timeout=LIMIT)
    stopped = re.search(rf"error: stopped with (\d) of {TASKS} shards; run the same command again", printed)
    assert stopped, printed
    assert process.returncode == 4
    assert 1 <= int(stopped[1]) < TASKS
    made = {shard.file: (data / "harvest" / shard.file).stat().st_ino for shard in read_manifests(data / "harvest").shards}
    assert len(made) == int(stopped[1])
    run("harvest", config, "-o", data, "--quiet")
    assert contents(data / "harvest") == contents(whole / "harvest")
    assert all((data / "harvest" / name).stat().st_ino == inode for name, inode in made.items())
