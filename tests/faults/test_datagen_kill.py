"""Data sets whose making is killed at random moments: a second run ends with the same bytes, and makes no acknowledged file anew."""

import json
import os
import random
import signal
import subprocess
from pathlib import Path

import pytest
from datagen_fakes import CHUNKS, MPIRUN, TASKS, command, contents, run, start
from limits import LIMIT
from scene_helpers import die_at

pytest.importorskip("mpi4py")
pytestmark = [pytest.mark.usefixtures("fakes"), pytest.mark.skipif(not MPIRUN.exists(), reason="no mpirun beside the interpreter")]

FILES = TASKS + CHUNKS  # shards of both stages


def shards(data):
    return [*data.glob("harvest/0*.h5"), *data.glob("labels/0*.h5")]


def acknowledged(data):
    """Inode and time of every file that a manifest knows; asserts that each is as the manifest says."""
    found = {}
    for path in [*data.glob("*/manifest*.json"), *data.glob("shapes.json")]:
        for shard in json.loads(path.read_text())["shards"]:
            stat = (path.parent / shard["file"]).stat()
            assert stat.st_size == shard["bytes"]
            found[path.parent / shard["file"]] = (stat.st_ino, stat.st_mtime_ns)
    return found


def started(ranks, log, *arguments, busy=0.03):
    """A run of several ranks; in the log stand their process ids once they have begun a task."""
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "FAKE_BUSY": str(busy), "FAKE_LOG": str(log)}
    quiet = subprocess.DEVNULL
    return subprocess.Popen(command(ranks, *arguments, "--quiet"), env=environment, stdout=quiet, stderr=quiet)


def kill_when(process, log, data, files, delay, victims):
    """SIGKILL to ranks when the data has so many shards, and `delay` looks at the disk later. victims: how many ranks, at most.

    Returns whether the run did not end well.
    """
    while process.poll() is None and len(shards(data)) < files:
        pass
    for _ in range(delay):
        shards(data)
    pids = list({int(line.split()[1]) for line in log.read_text().splitlines()}) if log.exists() else []
    for pid in random.Random(files).sample(pids, min(victims, len(pids))):
        if _is_rank(pid):
            os.kill(pid, signal.SIGKILL)
    return process.wait(LIMIT) != 0


def _is_rank(pid):
    """Whether the process still is what it was: one of ours."""
    try:
        return b"datagen_fakes" in Path(f"/proc/{pid}/cmdline").read_bytes()
    except FileNotFoundError:
        return False


def test_killed_at_a_random_moment_the_next_run_ends_the_same(tmp_path, config, whole, moment):
    """The moments differ in the files that are there, in the ranks (2 or 3) and in who is killed: one of them, or all."""
    pick = random.Random(moment)
    data, log = tmp_path / "data", tmp_path / "log"
    ranks, files, delay, victims = pick.choice((2, 3)), pick.randrange(1, FILES), pick.randrange(60), pick.choice((1, 9))
    process = started(ranks, log, "make", config, "-o", data)
    killed = kill_when(process, log, data, files, delay, victims)
    assert killed or len(shards(data)) == FILES  # near the end it may be faster than the kill
    before = acknowledged(data)
    run("make", config, "-o", data, "--quiet")
    assert contents(data) == contents(whole)
    after = acknowledged(data)
    assert {path: after[path] for path in before} == before


def test_parts_killed_in_turn_end_the_same(tmp_path, config, whole):
    data = tmp_path / "data"
    for k, files in ((1, 2), (2, 6)):
        part = ("harvest", config, "-o", data, "--part", f"{k}/2")
        process = started(2, tmp_path / f"log{k}", *part, busy=0.3)
        assert kill_when(process, tmp_path / f"log{k}", data, files, 3, 9)
        before = acknowledged(data)
        run(*part, "--quiet")
        after = acknowledged(data)
        assert {path: after[path] for path in before} == before
    assert not (data / "harvest" / "manifest.json").exists()
    run("make", config, "-o", data, "--quiet")
    assert contents(data) == contents(whole)


@pytest.mark.parametrize("event", range(1, 160, 13))
def test_killed_before_any_file_operation_the_next_run_ends_the_same(tmp_path, config, whole, event):
    data = tmp_path / "data"
    process = start(["make", config, "-o", data, "--quiet"], die_at, (event, str(data)))
    process.join(LIMIT)
    assert process.exitcode == -signal.SIGKILL, "the run has fewer file operations than this: lower the range"
    before = acknowledged(data)
    run("make", config, "-o", data, "--quiet")
    assert contents(data) == contents(whole)
    after = acknowledged(data)
    assert {path: after[path] for path in before} == before
