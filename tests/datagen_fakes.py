"""Stages that compute next to nothing, in place of those of datagen, and the command line run with them, in this process or under mpirun.

`python tests/datagen_fakes.py harvest config.toml -o data` is `python -m datagen` with these stages. Environment: FAKE_LOG, a file that
takes a line "task process" for each attempt; FAKE_BUSY, seconds that a task computes; FAKE_WRONG, tasks that go wrong and how:
"3:raise,5:exit" (see WRONG), with "*" for all.
"""

import json
import multiprocessing
import os
import signal
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType

import numpy as np
from limits import LIMIT
from typer.testing import CliRunner

MPIRUN = Path(sys.executable).parent / "mpirun"
POINTS, MODES, RUNS, SHAPES = 16, 4, 4, 3  # of every harvested shard: RUNS runs with SHAPES shapes each
SAID = "coverage of {n} shapes"
CONFIG = """
seed = 3
[shapes]
points = 32
modes = 8
[[harvest]]
flow = "shear"
runs = 20
batch = 4
[[harvest]]
flow = "relaxation"
runs = 12
batch = 4
[label]
points = 8
operator_points = 16
chunk = 10
"""
TASKS, CHUNKS = 8, 10  # of CONFIG


class Odd(Exception):
    """Cannot be sent to another process."""

    def __init__(self, text, number):
        super().__init__(f"{text} {number}")
        self.lock = __import__("threading").Lock()


def _raise(task):
    raise RuntimeError(f"task {task} will not do\nfor a reason")


def _odd(task):
    raise Odd("odd", task)


def _exit(task):
    sys.exit(7)


def _interrupt(task):
    raise KeyboardInterrupt


def _disk(task):
    raise OSError(28, "No space left on device")


def _stop(task):
    os.kill(os.getpid(), signal.SIGTERM)


def _swallow(task):
    try:
        os.kill(os.getpid(), signal.SIGTERM)
        for _ in range(1000):
            pass
    except KeyboardInterrupt:
        pass


def _once(task):
    marker = Path(os.environ["FAKE_LOG"] + f".{task}")
    if not marker.exists():
        marker.touch()
        raise RuntimeError("the first time")


WRONG = {
    "raise": _raise,
    "odd": _odd,
    "exit": _exit,
    "interrupt": _interrupt,
    "disk": _disk,
    "stop": _stop,
    "swallow": _swallow,
    "once": _once,
}


def attempt(task):
    """What every fake task does: it leaves its trace, computes for a while, and goes wrong if it is to."""
    if "FAKE_LOG" in os.environ:
        with open(os.environ["FAKE_LOG"], "a") as log:
            log.write(f"{task} {os.getpid()}\n")
    wrong = dict(entry.split(":") for entry in os.environ.get("FAKE_WRONG", "").split(",") if entry)
    how = wrong.get(str(task), wrong.get("*"))
    if how:
        WRONG[how](task)
    end = time.process_time() + float(os.environ.get("FAKE_BUSY", "0"))
    while time.process_time() < end:
        pass


@dataclass(frozen=True)
class FakeTask:
    id: int


def harvest_tasks(config):
    return [FakeTask(k) for k in range(sum(-(-family.runs // family.batch) for family in config.harvest))]


def harvest(config, task):
    attempt(task.id)
    random = np.random.default_rng([config.seed, task.id])
    n = RUNS * SHAPES
    return {
        "X": random.normal(size=(n, 2, POINTS)),
        "run": task.id * RUNS + np.repeat(np.arange(RUNS), SHAPES),
        "family": np.zeros(n, dtype=np.int64),
        "time": np.tile(np.arange(1.0, SHAPES + 1), RUNS),
        "capillary": random.uniform(1, 2, n),
    }


def select(config, parts):
    parts = list(parts)
    joined = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    coefficients = np.fft.fft(joined.pop("X")[:, 0])[:, : 2 * MODES].astype(np.complex64)
    energy = np.abs(coefficients).sum(axis=1).astype(np.float32)
    return {"coefficients": coefficients, "split": (joined["run"] % 3).astype(np.int8), "bending_energy": energy, **joined}


def decode(coefficients, points):
    x = np.fft.irfft(coefficients.astype(complex), points)
    return np.stack([x, x[:, ::-1]], axis=1)


def label_shapes(X, label):
    attempt("label")
    pairs = {"X_std": X[..., : label.points]}
    if "relax" in label.maps:
        pairs["relax"] = pairs["X_std"] ** 2
    if "advection" in label.maps:
        pairs |= {f"advection/{k}": np.cos(k * pairs["X_std"])[:, None, None] * np.ones((2, 2, 1, 1)) for k in label.modes}
    return {name: values.astype(np.float32) for name, values in pairs.items()}


def report(shapes, folder, seed, flows):
    statistics = {"n": len(shapes["run"])}
    (folder / "coverage.json").write_text(json.dumps(statistics))
    return statistics


def summary(statistics):
    return [SAID.format(**statistics)]


def modules():
    """The fakes by the names of the modules that they stand for."""
    from datagen.label import label_modes

    contents = {
        "harvest": {"harvest": harvest, "harvest_tasks": harvest_tasks},
        "select": {"select": select},
        "shapes": {"decode": decode},
        "label": {"label_shapes": label_shapes, "label_modes": label_modes},
        "coverage": {"report": report, "summary": summary},
    }
    out = {}
    for name, functions in contents.items():
        out[f"datagen.{name}"] = module = ModuleType(f"datagen.{name}")
        vars(module).update(functions)
    return out


def write_config(folder, text=CONFIG, name="tiny"):
    path = folder / f"{name}.toml"
    path.write_text(text)
    return path


def cli(*arguments):
    """`python -m datagen` with these arguments, in this process; the fixture `fakes` must be in place."""
    from datagen.__main__ import app

    return CliRunner().invoke(app, [str(a) for a in arguments])


def run(*arguments):
    """The same for a command that must succeed; its result."""
    result = cli(*arguments)
    assert result.exit_code == 0, result.output
    return result


def command(ranks, *arguments):
    """The same under mpirun (1 rank: by itself), with the fakes."""
    start = [] if ranks == 1 else [MPIRUN, "-n", ranks]
    return [str(part) for part in (*start, sys.executable, __file__, *arguments)]


def ranks_run(ranks, *arguments, **environment):
    """(exit code, stdout, stderr) of `command`; fails where it does not end."""
    environment = {**os.environ, "OMP_NUM_THREADS": "1", **environment}
    done = subprocess.run(command(ranks, *arguments), env=environment, capture_output=True, text=True, check=False, timeout=LIMIT)
    return done.returncode, done.stdout, done.stderr


def start(arguments, prepare, prepare_arguments):
    """The same in a process of its own, by a fork server that has imported the package once. prepare: called first in there."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["datagen.__main__"])
    process = context.Process(target=_run, args=([str(a) for a in arguments], prepare, prepare_arguments), daemon=True)
    process.start()
    return process


def _run(arguments, prepare, prepare_arguments):
    from datagen.__main__ import app

    sys.modules.update(modules())
    prepare(*prepare_arguments)
    app(arguments)


def contents(folder):
    """All files of a folder, byte for byte."""
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


if __name__ == "__main__":
    import datagen_fakes  # by the name under which its functions are sent

    sys.modules.update(datagen_fakes.modules())
    from datagen.__main__ import app

    app()
