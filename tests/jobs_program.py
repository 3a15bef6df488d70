"""Rounds of tasks on several ranks, one after the other: `mpirun -n 3 python tests/jobs_program.py FOLDER`. Prints what became of each.

In every round each rank begins a task before any task ends, so that what is to go wrong on a certain rank does go wrong there.
"""

import json
import os
import sys
import time
from functools import partial
from pathlib import Path

from datagen_fakes import WRONG
from limits import LIMIT

from biem.ranks import world
from datagen.jobs import run_tasks
from datagen.stop import stoppable

TASKS = 40
ROUNDS = {  # how, and on which rank, or of which task
    "fine": {},
    "raise": {"task": 5},
    "odd": {"task": 5},
    "exit": {"task": 5},
    "interrupt": {"task": 5},
    "raise on 0": {"rank": 0},
    "raise on 1": {"rank": 1},
    "odd on 1": {"rank": 1},
    "exit on 1": {"rank": 1},
    "interrupt on 1": {"rank": 1},
    "unsendable on 1": {"rank": 1},
    "disk on 1": {"rank": 1},
    "disk on 0": {"rank": 0},
    "stop on 1": {"rank": 1},
    "stop on 0": {"rank": 0},
    "swallow on 1": {"rank": 1},
    "unacknowledged": {},
    "none": {"tasks": 0},
    "few": {"tasks": 1, "meet": False},
}


def make(folder, size, round_name, task):
    """(task, rank), after all ranks have begun a task of this round; or what is to go wrong."""
    rank, rules = int(os.environ["PMI_RANK"]), ROUNDS[round_name]
    if rules.get("meet", True):
        (folder / f"{round_name}.{rank}").touch()
        end = time.monotonic() + LIMIT
        while len(list(folder.glob(f"{round_name}.*"))) < size:
            if time.monotonic() > end:
                os._exit(9)  # a rank was given nothing to do
    if rank == rules.get("rank") or task == rules.get("task"):
        how = round_name.split()[0]
        if how == "unsendable":
            return lambda: task
        WRONG[how](task)
    return task, rank


def main(folder):
    ranks = world()
    for name, rules in ROUNDS.items():
        done = []

        def acknowledge(some, name=name, done=done):
            if name == "unacknowledged":
                raise OSError("no room for the manifest")
            done.extend(some)

        with stoppable():
            report = run_tasks(partial(make, folder, ranks.size, name), range(rules.get("tasks", TASKS)), acknowledge, ranks)
        told = {
            "failures": sorted([failure.task, failure.error] for failure in report.failures),
            "stopped": report.stopped,
            "error": report.error and str(report.error),
        }
        everywhere = ranks.comm.gather(told)
        if ranks.rank == 0:
            assert all(other == told for other in everywhere), everywhere
            print(json.dumps({"round": name, "done": sorted(done), **told}), flush=True)


if __name__ == "__main__":
    import jobs_program  # by the name under which its functions are sent

    jobs_program.main(Path(sys.argv[1]))
