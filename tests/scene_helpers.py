"""Tiny scenes, the command line in this process, and runs in processes of their own that can be killed."""

import json
import multiprocessing
import os
import signal
import sys
from contextlib import contextmanager

import numpy as np
from typer.testing import CliRunner

from biem.__main__ import app
from biem.run import simulate as loop
from biem.run.trajectory import read_trajectory
from biem.scene.config import make_scene

DT = 2.0**-13  # k DT is exact: shortening a horizon changes no bit of the steps before it
ONE = {
    "name": "tiny",
    "vesicles": {"reduced_area": 0.8, "points": 16},
    "flow": {"kind": "shear", "rate": 100.0},
    "time": {"dt": DT, "horizon": 6 * DT},
}
PAIR = {"vesicles": {"centers": [[-0.35, 0.05], [0.35, 0.0]], "angles": [1.4, 1.6]}}
FRAME_FIELDS = ("t", "step", "X", "sigma")

# A flow that sends its own process a signal at the time STOP_AT, so that a run ends at a known step.
SIGNALLING_FLOW = """
import os, signal
def shear(x, y, t):
    if t >= float(os.environ.get("STOP_AT", "inf")) - 1e-12:
        os.kill(os.getpid(), getattr(signal, os.environ["STOP_BY"]))
    return 100.0 * y, 0.0 * x
"""


def table(*changes, **more):
    """ONE with tables changed: table(PAIR, flow={"rate": 10.0}). A key set to None is taken out; flow={} empties nothing."""
    out = {name: dict(value) if isinstance(value, dict) else value for name, value in ONE.items()}
    for change in (*changes, more):
        for name, value in change.items():
            out[name] = {**out.get(name, {}), **value} if isinstance(value, dict) else value
            if isinstance(value, dict):
                out[name] = {key: v for key, v in out[name].items() if v is not None}
    return out


def scene_of(*changes, folder=".", **more):
    """The validated scene of `table`."""
    return make_scene(table(*changes, **more), folder)


def write_scene(folder, *changes, **more):
    """A TOML file of `table` in the folder; its path."""
    whole = table(*changes, **more)
    lines = [f"{key} = {json.dumps(value)}" for key, value in whole.items() if not isinstance(value, dict)]
    for name, value in whole.items():
        if isinstance(value, dict):
            lines += [f"[{name}]", *(f"{key} = {json.dumps(v)}" for key, v in value.items())]
    path = folder / "scene.toml"
    path.write_text("\n".join(lines) + "\n")
    return path


def write_flow(folder, body):
    """A module of this name, used nowhere else, in the folder; returns the name."""
    name = "flow_" + "".join(c if c.isalnum() else "_" for c in str(folder))
    (folder / f"{name}.py").write_text(body)
    return name


def cli(*arguments):
    """`python -m biem` with these arguments, in this process."""
    return CliRunner().invoke(app, [str(a) for a in arguments])


def the_error(result, *codes):
    """The one line that a failed command prints, without "error: "; asserts that it is all there is."""
    assert result.exception is None or isinstance(result.exception, SystemExit), repr(result.exception)
    return error_line(result.output, result.exit_code, *codes)


def error_line(output, exit_code, *codes):
    """The message of the last line, which must be the only one that starts with "error:"."""
    lines = [line for line in output.replace("\r", "\n").splitlines() if line.strip()]
    assert exit_code in (codes or (1, 2, 3, 4, 5)), (exit_code, output)
    assert "Traceback" not in output, output
    assert [line.startswith("error: ") for line in lines].count(True) == 1, output
    assert lines[-1].startswith("error: "), output  # nothing of a message runs into a second line
    return lines[-1].removeprefix("error: ")


def assert_same_frames(a, b):
    """Bitwise equal t, step, X and sigma."""
    for name in FRAME_FIELDS:
        x, y = getattr(a, name), getattr(b, name)
        assert (x is None) == (y is None), name
        assert x is None or (x.dtype == y.dtype and np.array_equal(x, y)), name


def assert_prefix(part, whole):
    """The frames of `part` are, bit for bit, the first ones of `whole`."""
    assert len(part) <= len(whole)
    assert_same_frames(part, whole.until(part.step[-1]))


def frames_or_none(path):
    """What a reader finds at this moment; None where no file is there yet."""
    return read_trajectory(path) if path.exists() else None


def start_cli(arguments, log, environment=None, prepare=None, prepare_arguments=()):
    """`python -m biem` in a process of its own, its output in the file `log`.

    A fork server that has imported the package once starts it in a fraction of a second. prepare: called first in there.
    """
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["biem.__main__"])
    process = context.Process(
        target=_run_cli, args=([str(a) for a in arguments], str(log), environment or {}, prepare, prepare_arguments), daemon=True
    )
    process.start()
    return process


def finish(process, log):
    """Waits for the process; its exit code and what it printed."""
    process.join(60)
    assert process.exitcode is not None, "the run does not end"
    return process.exitcode, log.read_text() if log.exists() else ""


def _run_cli(arguments, log, environment, prepare, prepare_arguments):
    descriptor = os.open(log, os.O_CREAT | os.O_WRONLY | os.O_TRUNC)
    os.dup2(descriptor, 1)
    os.dup2(descriptor, 2)
    os.environ.update(environment)
    if prepare is not None:
        prepare(*prepare_arguments)
    app(arguments)


FILE_EVENTS = {"open", "os.rename", "os.remove", "os.mkdir", "os.rmdir"}  # h5py opens its files past Python: not among them


def die_at(event_number, folder):
    """SIGKILL to this process right before its n-th file operation below the folder."""
    seen = 0

    def hook(event, arguments):
        nonlocal seen
        if event in FILE_EVENTS and str(arguments[0]).startswith(folder):
            seen += 1
            if seen == event_number:
                os.kill(os.getpid(), signal.SIGKILL)

    sys.addaudithook(hook)


def stop_after(monkeypatch, steps):
    """A signal is seen from the end of that step on."""
    looks = iter(range(1, 1000))

    @contextmanager
    def signals():
        yield lambda: next(looks) >= steps

    monkeypatch.setattr(loop, "stop_signals", signals)
