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
from uuid import uuid4

import numpy as np
from tqdm import tqdm

from biem.backend import counting, fft_backend
from biem.curves.curve import area, bending_energy, length
from biem.errors import NumericalFailure
from biem.run.checkpoint import (
    Checkpoint,
    checkpoint_path,
    prepare_checkpoint,
    read_checkpoint,
    remove_checkpoints,
    write_checkpoint,
)
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
    if resume and force:
        raise ValueError("--resume goes on with the output, --force replaces it: give one of them")
    resolved = json.dumps(scene.model_dump(mode="json"))
    if resume:
        assert path is not None
        start, earlier = _where_to_resume(path, resolved)
        problem = build(scene)
    else:
        problem = build(scene)
        start = Checkpoint(0, State(0.0, problem.X), area(problem.X), length(problem.X), resolved, run=uuid4().hex)
        earlier = _frame(problem, start.step, start.state, {})
    if path is not None:
        _check_space(problem, path)
    attributes = {
        "schema": SCHEMA,
        "scene": resolved,
        "solver": scene.solver.kind,
        "commit": _commit(),
        "seed": scene.vesicles.seed,
        "t_gamma": problem.flow.time_scale or 0.0,
        "flow_width": problem.flow.width or 0.0,
        "run": start.run,
    }
    writer = None if path is None else _start_files(path, start, attributes, earlier, resume)
    with counting() as counts, fft_backend(problem.X.size):
        counts.update(start.counts)
        loop = _Loop(problem, start, int(earlier.step[-1]), writer, counts, progress)
        loop.run()
        if writer is not None:
            writer.close()
    if path is None:
        return Run(join([earlier, *loop.frames], attributes), None, counts)
    return Run(read_trajectory(path), path, counts)


class _Loop:
    """One run from a checkpoint to the horizon."""

    def __init__(
        self, problem: Problem, start: Checkpoint, saved: int, writer: TrajectoryWriter | None, counts: Counter[str], progress: bool
    ) -> None:
        self.problem = problem
        self.saved = saved  # step of the last frame
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
        self.shortened = False

    def run(self) -> None:
        scene = self.problem.scene
        every = scene.time.save_every
        checkpoint_every = scene.output.checkpoint_every or every
        with _signals() as stop, self._bar() as bar:
            while self.step < self.problem.steps:
                try:
                    self._advance()
                except (NumericalFailure, ValueError) as failure:  # ValueError: the flow refused a point or a time
                    self._close_with_this_state()
                    unit = self.problem.flow.time_scale
                    when = f"t = {self.state.t:.6g}" + (f" ({self.state.t / unit:.4g} t_gamma)" if unit else "")
                    raise NumericalFailure(
                        f"step {self.step + 1} rejected at {when}: {failure}; the state before it is kept; try smaller steps (time.dt)"
                    ) from None
                last = self.step == self.problem.steps
                if self.step % every == 0 or last:
                    self._save_frame()
                stopping = stop() and not last
                if (self.step % checkpoint_every == 0 or last or stopping) and not self.shortened:
                    self._checkpoint()
                bar.update()
                bar.set_postfix_str(self._status(), refresh=False)
                if stopping:
                    if self.writer is not None:
                        self.writer.close()
                    raise Stopped(f"stopped at step {self.step} of {self.problem.steps}")

    def _advance(self) -> None:
        problem = self.problem
        begin = time.perf_counter()
        t_next = (self.step + 1) * problem.dt
        self.shortened = t_next > problem.horizon * (1 + 1e-9)  # the last step: not one to go on from
        if self.shortened:
            t_next = problem.horizon
        with np.errstate(all="ignore"):  # what is not finite is the guard's to name
            result = self.stepper.step(self.state, t_next - self.state.t if self.shortened else problem.dt)
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
        self.saved = self.step

    def _close_with_this_state(self) -> None:
        """The last good state as a frame and a checkpoint, all frames in one file."""
        if self.saved != self.step:
            self._save_frame()
        self._checkpoint()
        if self.writer is not None:
            self.writer.close()

    def _checkpoint(self) -> None:
        if self.writer is not None:
            s = self.start
            checkpoint = Checkpoint(self.step, self.state, s.area_0, s.length_0, s.scene, self.running, dict(self.counts), s.run)
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


def _where_to_resume(path: Path, scene: str) -> tuple[Checkpoint, Trajectory]:
    """The checkpoint to go on from and the frames up to it."""
    read_checkpoint(checkpoint_path(path))  # says so if there is none at all
    frames = read_trajectory(path)
    start = read_checkpoint(checkpoint_path(path), str(frames.attributes.get("run")))
    _check_same_scene(start.scene, scene)
    return start, frames.until(start.step)


def _start_files(path: Path, start: Checkpoint, attributes: dict, earlier: Trajectory, resume: bool) -> TrajectoryWriter:
    """Trajectory and checkpoint of a run that begins or goes on; what --force replaces is there until both could be written."""
    path.absolute().parent.mkdir(parents=True, exist_ok=True)
    if resume:
        return TrajectoryWriter(path, attributes, [earlier])
    checkpoint = checkpoint_path(path)
    prepare_checkpoint(checkpoint, start)
    try:
        writer = TrajectoryWriter(path, attributes, [earlier])
    except BaseException:
        checkpoint.with_name(checkpoint.name + ".next").unlink(missing_ok=True)
        raise
    remove_checkpoints(checkpoint)
    write_checkpoint(checkpoint, start)
    return writer


def _check_same_scene(old: str, new: str) -> None:
    """A run may be resumed with a longer horizon and other output settings; nothing else may differ."""
    a, b = _flat(json.loads(old)), _flat(json.loads(new))
    free = ("time.horizon", "output.trajectory", "output.checkpoint_every")
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
    while not folder.exists():
        folder = folder.parent
    needed, free = 2.2 * trajectory_bytes(problem), shutil.disk_usage(folder).free  # merging holds two copies
    if needed > free:
        raise ValueError(
            f"output {path} needs about {needed / 1e6:.2g} MB, {free / 1e6:.2g} MB are free: raise time.save_every or choose another disk"
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
