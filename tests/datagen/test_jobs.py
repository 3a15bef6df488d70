"""Tasks shared among ranks: every task is done once or set aside after two attempts, whatever is raised, and nothing hangs."""

import json
import os
import signal
import subprocess
import sys
import threading
from pathlib import Path

import pytest
from datagen_fakes import MPIRUN, WRONG
from jobs_program import ROUNDS, TASKS
from limits import LIMIT

from biem.backend import threads
from datagen.jobs import one_thread, run_tasks
from datagen.stop import Stopped, stop_asked, stoppable, unless_stopped

# One process


def squares(task):
    return task * task


def test_all_tasks_are_done_in_order_and_acknowledged():
    done = []
    report = run_tasks(squares, range(20), done.extend)
    assert done == [k * k for k in range(20)]
    assert (report.failures, report.stopped, report.error) == ([], False, None)


@pytest.mark.parametrize("how", ["raise", "odd", "exit", "interrupt"])
def test_a_task_that_raises_is_tried_twice_and_set_aside(how):
    tried, done = [], []

    def make(task):
        tried.append(task)
        if task == 1:
            WRONG[how](task)
        return task

    report = run_tasks(make, range(4), done.extend)
    assert tried == [0, 1, 2, 3, 1]  # the second attempt comes after the others
    assert done == [0, 2, 3]
    [failure] = report.failures
    assert failure.task == 1
    expected = {
        "raise": "RuntimeError: task 1 will not do for a reason (datagen_fakes.py:",
        "odd": "Odd: odd 1 (datagen_fakes.py:",
        "exit": "SystemExit: 7 (datagen_fakes.py:",
        "interrupt": "KeyboardInterrupt",
    }
    assert failure.error.startswith(expected[how])
    assert "\n" not in failure.error


def test_a_task_that_raises_once_is_done():
    tried, done = [], []

    def make(task):
        tried.append(task)
        if tried.count(task) == 1:
            raise ArithmeticError
        return task

    assert run_tasks(make, range(5), done.extend).failures == []
    assert tried == [*range(5)] * 2
    assert done == [*range(5)]


def test_a_disk_error_ends_the_round_at_once():
    tried, done = [], []

    def make(task):
        tried.append(task)
        if task == 2:
            WRONG["disk"](task)
        return task

    report = run_tasks(make, range(9), done.extend)
    assert tried == [0, 1, 2]
    assert done == [0, 1]
    assert isinstance(report.error, OSError)
    assert "No space left" in str(report.error)


def test_what_cannot_be_acknowledged_ends_the_round():
    begun, refused = [], threading.Event()

    def make(task):
        begun.append(task)
        if task == 3:
            assert refused.wait(LIMIT)
        return task

    def acknowledge(done):
        if 2 in done:
            refused.set()
            raise ValueError("not this one")

    report = run_tasks(make, range(100), acknowledge)
    assert str(report.error) == "not this one"
    assert len(begun) < 100


@pytest.mark.parametrize("how", ["stop", "swallow"])
def test_a_signal_gives_up_the_task_and_begins_no_other(how):
    done = []

    def make(task):
        if task == 2:
            WRONG[how](task)
        return task

    with stoppable():
        report = run_tasks(make, range(5), done.extend)
    assert report.stopped
    assert (done, report.failures) == ([0, 1], [])
    assert run_tasks(make, range(2), done.extend).stopped is False  # the signal is forgotten with its block


def test_a_signal_between_tasks_is_seen_and_one_after_the_last_changes_nothing():
    with stoppable():
        os.kill(os.getpid(), signal.SIGINT)
        assert stop_asked()
        assert run_tasks(squares, range(5), lambda done: pytest.fail("none is begun")).stopped
        assert not run_tasks(squares, [], lambda done: None).stopped
        with pytest.raises(Stopped):
            unless_stopped(lambda: pytest.fail("not begun"))
    assert unless_stopped(lambda: 5) == 5
    with pytest.raises(ZeroDivisionError):
        unless_stopped(lambda: 1 // 0)


def test_one_thread_is_for_the_block(monkeypatch):
    for before in ("3", None):
        monkeypatch.setenv("OMP_NUM_THREADS", before) if before else monkeypatch.delenv("OMP_NUM_THREADS")
        with one_thread():
            assert threads() == 1
        assert os.environ.get("OMP_NUM_THREADS") == before


def test_no_mpi_is_loaded_for_one_process():
    program = "import sys, datagen.__main__, datagen.jobs as jobs; jobs.run_tasks(abs, [1], print); assert 'mpi4py' not in sys.modules"
    environment = {key: value for key, value in os.environ.items() if not key.startswith(("PMI", "OMPI"))}
    done = subprocess.run([sys.executable, "-c", program], env=environment, capture_output=True, text=True, check=True, timeout=LIMIT)
    assert done.stdout == "[1]\n"


# Several


@pytest.fixture(scope="module")
def rounds(tmp_path_factory):
    """What became of the rounds of `jobs_program` on three ranks."""
    pytest.importorskip("mpi4py")
    if not MPIRUN.exists():
        pytest.skip("no mpirun beside the interpreter")
    program = Path(__file__).parents[1] / "jobs_program.py"
    command = [MPIRUN, "-n", 3, sys.executable, program, tmp_path_factory.mktemp("rounds")]
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    done = subprocess.run([str(c) for c in command], env=environment, capture_output=True, text=True, check=False, timeout=LIMIT)
    assert done.returncode == 0, done.stderr
    return {table["round"]: table for table in map(json.loads, done.stdout.splitlines())}


def test_every_round_ends(rounds):
    assert list(rounds) == list(ROUNDS)


def test_every_rank_computes_and_every_task_is_acknowledged_once(rounds):
    done = rounds["fine"]["done"]
    assert [task for task, _ in done] == [*range(TASKS)]
    assert {rank for _, rank in done} == {0, 1, 2}
    assert rounds["none"]["done"] == []
    assert [task for task, _ in rounds["few"]["done"]] == [0]


@pytest.mark.parametrize("how", ["raise", "odd", "exit", "interrupt"])
def test_a_task_that_fails_wherever_it_runs_is_the_only_one_set_aside(rounds, how):
    table = rounds[how]
    assert [task for task, _ in table["done"]] == [k for k in range(TASKS) if k != 5]
    [[task, error]] = table["failures"]
    assert task == 5
    assert error.startswith({"raise": "RuntimeError", "odd": "Odd", "exit": "SystemExit: 7", "interrupt": "KeyboardInterrupt"}[how])
    assert (table["stopped"], table["error"]) == (False, None)


@pytest.mark.parametrize("name", ["raise on 0", "raise on 1", "odd on 1", "exit on 1", "interrupt on 1", "unsendable on 1"])
def test_a_rank_that_always_fails_leaves_the_rest_to_the_others(rounds, name):
    table = rounds[name]
    failed = [task for task, _ in table["failures"]]
    assert sorted([task for task, _ in table["done"]] + failed) == [*range(TASKS)]
    assert name[-1] not in {str(rank) for _, rank in table["done"]}
    assert (table["stopped"], table["error"]) == (False, None)


@pytest.mark.parametrize("name", ["disk on 0", "disk on 1"])
def test_a_disk_error_of_any_rank_ends_the_round(rounds, name):
    assert "No space left" in rounds[name]["error"]
    assert rounds[name]["failures"] == []
    assert name[-1] not in {str(rank) for _, rank in rounds[name]["done"]}


@pytest.mark.parametrize("name", ["stop on 0", "stop on 1", "swallow on 1"])
def test_a_signal_to_any_rank_ends_the_round_and_what_is_done_is_acknowledged(rounds, name):
    table = rounds[name]
    assert table["stopped"]
    assert (table["failures"], table["error"]) == ([], None)
    ranks = [rank for _, rank in table["done"]]
    assert int(name[-1]) not in ranks
    assert set(ranks) == {0, 1, 2} - {int(name[-1])}  # the others' tasks, which had begun, were finished
    assert len(ranks) < TASKS


def test_what_cannot_be_acknowledged_ends_the_round_on_all(rounds):
    assert rounds["unacknowledged"]["error"] == "no room for the manifest"
    assert rounds["unacknowledged"]["done"] == []
