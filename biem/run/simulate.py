"""The loop: time, step guard, output, checkpoints, progress. It knows no mathematics; steppers know no files."""

from __future__ import annotations

import json
import shutil
import signal
import subprocess
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from types import FrameType

import numpy as np
from tqdm import tqdm

from biem.backend import counting, fft_backend
from biem.curves.curve import area, bending_energy, length
from biem.errors import NumericalFailure
from biem.run.checkpoint import Checkpoint, checkpoint_path, read_checkpoint, remove_checkpoints, write_checkpoint
from biem.run.guard import check_state
from biem.run.trajectory import SCHEMA, Trajectory, TrajectoryWriter, exists, join, one_frame, read_trajectory
from biem.scene.build import Problem, build
from biem.scene.config import Scene
from biem.scene.plan import trajectory_bytes
from biem.steppers.corrections import Corrected
from biem.steppers.implicit import ImplicitStepper
from biem.steppers.order import Extrapolated
from biem.steppers.stepper import State, Stepper
from biem.stokes.near_search import minimum_gap

SIGNALS = (signal.SIGTERM, signal.SIGINT)


class Stopped(Exception):
    """The run was asked to stop by a signal; its checkpoint is written."""


@dataclass(frozen=True)
class Run:
    """What a run leaves: its trajectory, the file it is in (None: memory only), and how often each part of the solver was used."""

    trajectory: Trajectory
    path: Path | None
    counts: Counter[str]


def make_stepper(problem: Problem, area_0: np.ndarray, length_0: np.ndarray) -> Stepper:
    """The stepper that the scene asks for, with its corrections."""
    scene, solver = problem.scene, problem.scene.solver
    inner: Stepper = ImplicitStepper(
        scene.physics.kappa_b,
        scene.physics.mu,
        None if problem.flow.kind == "quiescent" else problem.flow.velocity,
        solver.operator_points,
        solver.tolerance,
        solver.max_iterations,
        solver.near_field,
        solver.near_tolerance,
        scene.output.tension,
    )
    if scene.time.order == 2:
        inner = Extrapolated(inner)
    return Corrected(inner, tuple(solver.corrections), area_0, length_0)


def simulate(scene: Scene, output: str | Path | None = None, *, resume: bool = False, force: bool = False, progress: bool = False) -> Run:
    """Runs a scene to its horizon; with `output`, into that HDF5 file, with checkpoints beside it.

    Raises ValueError for input that is wrong (before anything is touched), NumericalFailure for a rejected step (the last good state
    is in the trajectory and the checkpoint), Stopped after a signal, OSError where the output cannot be written.
    """
    path = None if output is None else Path(output)
    if path is None and resume:
        raise ValueError("resume needs the output of the run to go on with")
    if path is not None and exists(path) and not (resume or force):
        raise ValueError(f"output {path} exists: use --force to replace it or --resume to go on")
    resolved = json.dumps(scene.model_dump(mode="json"))
    if resume:
        assert path is not None
        start = read_checkpoint(checkpoint_path(path))
        _check_same_scene(start.scene, resolved)
        problem = build(scene)
        earlier = [read_trajectory(path).until(start.step)]
    else:
        problem = build(scene)
        start = Checkpoint(0, State(0.0, problem.X), area(problem.X), length(problem.X), resolved)
        earlier = [_frame(problem, start.step, start.state, {})]
    if path is not None:
        _check_space(problem, path)
    attributes = {
        "schema": SCHEMA,
        "scene": resolved,
        "solver": scene.solver.kind,
        "commit": _commit(),
        "seed": scene.vesicles.seed,
    }
    attributes |= {"t_gamma": problem.flow.time_scale or 0.0, "flow_width": problem.flow.width or 0.0}
    writer = None if path is None else TrajectoryWriter(path, attributes, earlier)
    if path is not None and not resume:
        remove_checkpoints(checkpoint_path(path))  # of a run that --force replaces
        write_checkpoint(checkpoint_path(path), start)
    with counting() as counts, fft_backend(problem.X.size):
        counts.update(start.counts)
        loop = _Loop(problem, start, writer, counts, progress)
        try:
            loop.run()
        finally:
            if writer is not None:
                writer.close()
    if path is None:
        return Run(join(earlier + loop.frames, attributes), None, counts)
    return Run(read_trajectory(path), path, counts)


class _Loop:
    """One run from a checkpoint to the horizon."""

    def __init__(self, problem: Problem, start: Checkpoint, writer: TrajectoryWriter | None, counts: Counter[str], progress: bool):
        self.problem = problem
        self.start = start
        self.writer = writer
        self.counts = counts
        self.progress = progress
        self.frames: list[Trajectory] = []
        self.stepper = make_stepper(problem, start.area_0, start.length_0)
        self.step = start.step
        self.state = start.state
        self.running = dict(start.running)
        self.latest: Mapping[str, float] = {}

    def run(self) -> None:
        scene = self.problem.scene
        every = scene.time.save_every
        checkpoint_every = scene.output.checkpoint_every or every
        saved = self.step
        with _signals() as stop, self._bar() as bar:
            while self.step < self.problem.steps:
                try:
                    self._advance()
                except NumericalFailure as failure:
                    if saved != self.step:
                        self._save_frame()
                    self._checkpoint()
                    unit = self.problem.flow.time_scale
                    when = f"t = {self.state.t:.6g}" + (f" ({self.state.t / unit:.4g} t_gamma)" if unit else "")
                    raise NumericalFailure(
                        f"step {self.step + 1} rejected at {when}: {failure}; the state before it is kept; try smaller steps (time.dt)"
                    ) from None
                last = self.step == self.problem.steps
                if self.step % every == 0 or last:
                    self._save_frame()
                    saved = self.step
                if self.step % checkpoint_every == 0 or last or stop():
                    self._checkpoint()
                bar.update()
                bar.set_postfix_str(self._status(), refresh=False)
                if stop() and not last:
                    raise Stopped(f"stopped at step {self.step} of {self.problem.steps}")

    def _advance(self) -> None:
        problem = self.problem
        begin = time.perf_counter()
        t_next = min((self.step + 1) * problem.dt, problem.horizon)
        result = self.stepper.step(self.state, t_next - self.state.t)
        d = result.diagnostics
        check_state(result.state.X, result.state.sigma, d, problem.scene.solver.max_error)
        self.state = State(t_next, result.state.X, result.state.sigma)
        self.step += 1
        r = self.running
        for name in ("area_error", "length_error", "gmres_iterations"):
            r[name] = max(r.get(name, 0.0), float(d[name]))
        r["steps"] = r.get("steps", 0.0) + 1
        r["seconds"] = r.get("seconds", 0.0) + time.perf_counter() - begin
        self.latest = d

    def _save_frame(self) -> None:
        frame = _frame(self.problem, self.step, self.state, self.running)
        if self.writer is None:
            self.frames.append(frame)
        else:
            self.writer.append(frame)
        self.running = {}

    def _checkpoint(self) -> None:
        if self.writer is not None:
            s = self.start
            checkpoint = Checkpoint(self.step, self.state, s.area_0, s.length_0, s.scene, self.running, dict(self.counts))
            write_checkpoint(checkpoint_path(self.writer.path), checkpoint)

    def _bar(self) -> tqdm:
        return tqdm(
            total=self.problem.steps,
            initial=self.step,
            unit="step",
            disable=not self.progress,
            desc=self.problem.scene.name,
            mininterval=0.5,
            dynamic_ncols=True,
        )

    def _status(self) -> str:
        d, unit = self.latest, self.problem.flow.time_scale
        t = f"t = {self.state.t / unit:.2f} t_gamma" if unit else f"t = {self.state.t:.3g}"
        return f"{t}, area {d['area_error']:.0e}, length {d['length_error']:.0e}, GMRES {d['gmres_iterations']:.0f}"


def _frame(problem: Problem, step: int, state: State, running: dict[str, float]) -> Trajectory:
    diagnostics = {name: running.get(name, 0.0) for name in ("area_error", "length_error", "gmres_iterations")}
    diagnostics["bending_energy"] = float(bending_energy(state.X, problem.scene.physics.kappa_b).sum())
    diagnostics["wall_seconds"] = running.get("seconds", 0.0) / max(1.0, running.get("steps", 0.0))
    diagnostics["min_gap"] = minimum_gap(state.X)
    return one_frame(state.t, step, state.X, state.sigma, diagnostics)


@contextmanager
def _signals() -> Iterator[Callable[[], bool]]:
    """Whether SIGTERM or SIGINT has come; a second one ends the process at once."""
    seen: list[int] = []

    def note(number: int, _: FrameType | None) -> None:
        if seen:
            raise KeyboardInterrupt
        seen.append(number)

    try:
        old = {s: signal.signal(s, note) for s in SIGNALS}
    except ValueError:  # not in the main thread: signals stay with the program
        old = {}
    try:
        yield lambda: bool(seen)
    finally:
        for s, handler in old.items():
            signal.signal(s, handler)


def _check_same_scene(old: str, new: str) -> None:
    """A run may be resumed with a longer horizon and other output settings; nothing else may differ."""
    a, b = _flat(json.loads(old)), _flat(json.loads(new))
    free = ("time.horizon", "output.")
    differ = [k for k in sorted(a.keys() | b.keys()) if a.get(k) != b.get(k) and not k.startswith(free)]
    if differ:
        what = "; ".join(f"{k} was {a.get(k)!r}, is {b.get(k)!r}" for k in differ[:4])
        raise ValueError(f"the checkpoint is of another scene: {what}; resume with the old values or start anew with --force")


def _flat(table: dict, prefix: str = "") -> dict[str, object]:
    flat: dict[str, object] = {}
    for key, value in table.items():
        if isinstance(value, dict):
            flat.update(_flat(value, f"{prefix}{key}."))
        else:
            flat[prefix + key] = value
    return flat


def _check_space(problem: Problem, path: Path) -> None:
    folder = path.absolute().parent
    folder.mkdir(parents=True, exist_ok=True)
    needed, free = 2.2 * trajectory_bytes(problem), shutil.disk_usage(folder).free  # merging holds two copies
    if needed > free:
        raise ValueError(
            f"output {path} needs about {needed / 1e6:.0f} MB, {free / 1e6:.0f} MB are free: raise time.save_every or choose another disk"
        )


def _commit() -> str:
    here = Path(__file__).parent
    try:
        done = subprocess.run(["git", "-C", here, "rev-parse", "HEAD"], capture_output=True, text=True, check=True, timeout=10)
        return done.stdout.strip()
    except (OSError, subprocess.SubprocessError):
        try:
            return f"vesnet {version('vesnet')}"
        except PackageNotFoundError:
            return "unknown"
