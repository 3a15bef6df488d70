"""The loop: time, step guard, output, checkpoints, progress. It knows no mathematics; steppers know no files."""

from __future__ import annotations

import json
import signal
import subprocess
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from types import FrameType
from uuid import uuid4

import numpy as np
from tqdm import tqdm

from biem.backend import count, counting, fft_backend, stage, to_numpy
from biem.curves.curve import area, bending_energy, length
from biem.errors import NumericalFailure
from biem.observe.observables import Observations
from biem.observe.tracers import Carrier, Tracers, place_tracers
from biem.ranks import ALONE, Ranks
from biem.run.checkpoint import Checkpoint
from biem.run.guard import check_state
from biem.run.observe import observer_of_run
from biem.run.output import Output, where_to_resume
from biem.run.solver import check_machine, make_stepper, on_device
from biem.run.trajectory import MONITORED, SCHEMA, Trajectory, one_frame
from biem.scene.build import Problem, build
from biem.scene.config import Scene
from biem.steppers.control import Controller, add_time
from biem.steppers.order import ERRORS
from biem.steppers.stepper import State, Stepper, StepResult
from biem.stokes.near_search import minimum_gap

SIGNALS = (signal.SIGTERM, signal.SIGINT)
WORST = ("area_error", "length_error", "gmres_iterations", "error_estimate")  # diagnostics of a frame: the largest since the last one
Enough = Callable[[float, np.ndarray], bool]
REJECTED = (NumericalFailure, ValueError)  # ValueError: the flow refused a point or a time


class Stopped(Exception):
    """The run was asked to stop by a signal; its checkpoint is written."""


@dataclass(frozen=True)
class Run:
    """What a run leaves: its trajectory, the file it is in (None: memory only), and how often each part of the solver was used.

    observations: the rows that the scene's [observe] asked for; of a run into a file, on the first rank alone.
    """

    trajectory: Trajectory
    path: Path | None
    counts: Counter[str]
    observations: Observations | None = None


def simulate(
    scene: Scene,
    output: str | Path | None = None,
    *,
    resume: bool = False,
    force: bool = False,
    progress: bool = False,
    ranks: Ranks = ALONE,
    enough: Enough | None = None,
) -> Run:
    """Runs a scene to its horizon; with `output`, into that HDF5 file, with checkpoints beside it.

    enough: called with t and X (M, 2, N) of every frame that is saved; the run ends early where it says True.
    ranks: the processes that share the work (`biem.ranks.world()` under mpirun); the first one writes, the others get the last frame
    back from a run into a file. Raises ValueError for input that is wrong (before anything is touched), NumericalFailure for a rejected
    step (the last good state is in the trajectory and the checkpoint), Stopped after a signal, OSError where the output cannot be written.
    """
    path = None if output is None else Path(output)
    return ranks.together(lambda: _simulate(scene, path, resume, force, progress, ranks, enough))


def _simulate(scene: Scene, path: Path | None, resume: bool, force: bool, progress: bool, ranks: Ranks, enough: Enough | None) -> Run:
    resolved = json.dumps(scene.model_dump(mode="json"))
    found = ranks.on_root(lambda: where_to_resume(path, resolved, resume, force))
    problem = ranks.together(lambda: build(scene))
    if found is None:
        ranks.together(lambda: check_machine(problem, ranks))
        tracers = ranks.together(lambda: place_tracers(problem))
        start = Checkpoint(0, State(0.0, problem.X), area(problem.X), length(problem.X), resolved, run=uuid4().hex)
        start = start if tracers is None else replace(start, tracers=tracers.x)
        earlier = _frame(problem, start.step, start.state, {}, tracers)
    else:
        start, earlier = found
        _check_same_walls(problem, earlier)
        tracers = None if start.tracers is None else Tracers(start.tracers, earlier.attributes["tracer_vesicle"])
    stepper = ranks.together(lambda: make_stepper(problem, start.area_0, start.length_0, ranks))
    start = replace(start, state=on_device(start.state, scene, ranks))
    attributes = {
        "schema": SCHEMA,
        "scene": resolved,
        "solver": scene.solver.kind,
        "commit": commit(),
        "seed": scene.vesicles.seed,
        "t_gamma": problem.flow.time_scale or 0.0,
        "flow_width": problem.flow.width or 0.0,
        "run": start.run,
    }
    if problem.walls is not None:
        attributes["walls"] = problem.walls.curves
    if problem.box is not None:
        attributes["periodic"] = [problem.box.width, problem.box.height, problem.box.rate]
    if tracers is not None:
        attributes["tracer_vesicle"] = tracers.vesicle
    observer = ranks.together(lambda: observer_of_run(problem, earlier.X[0]))
    files = Output(problem, path, start, attributes, earlier, resume, ranks, observer)
    with counting() as counts, fft_backend(problem.X.size):
        counts.update(start.counts)
        loop = _Loop(problem, stepper, start, int(earlier.step[-1]), files, counts, progress and ranks.rank == 0, ranks, enough, tracers)
        loop.run()
    files.close()
    return Run(files.trajectory() or _frame(problem, loop.step, loop.state, {}, loop.tracers), path, counts, files.observations())


class _Loop:
    """One run from a checkpoint to the horizon."""

    def __init__(
        self,
        problem: Problem,
        stepper: Stepper,
        start: Checkpoint,
        saved: int,
        files: Output,
        counts: Counter[str],
        progress: bool,
        ranks: Ranks,
        enough: Enough | None,
        tracers: Tracers | None,
    ) -> None:
        self.problem = problem
        self.stepper = stepper
        self.ranks = ranks
        self.saved = saved  # step of the last frame
        self.start = start
        self.files = files
        self.counts = counts
        self.progress = progress
        self.enough = enough
        self.tracers = tracers
        self.carrier = Carrier(problem)
        self.step = start.step
        self.state = start.state
        self.running = dict(start.running)
        self.latest: Mapping[str, float] = {}
        self.shortened = False
        self.controller = Controller(problem.scene.time.tolerance, problem.dt_min) if problem.scene.time.adaptive else None
        self.control = dict(start.control) or {"dt": problem.dt, "lost": 0.0}

    def run(self) -> None:
        scene = self.problem.scene
        every = scene.time.save_every
        checkpoint_every = scene.output.checkpoint_every or every
        with stop_signals() as stop, self._bar() as bar:
            while not self._done():
                try:
                    if self.controller is None:
                        self._advance()
                    else:
                        self._advance_adaptively(self.controller)
                except REJECTED as failure:
                    self._close_with_this_state()
                    unit = self.problem.flow.time_scale
                    when = f"t = {self.state.t:.6g}" + (f" ({self.state.t / unit:.4g} t_gamma)" if unit else "")
                    way = "smaller steps (time.dt)" if self.controller is None else "a lower time.dt_min or a larger time.tolerance"
                    if self.controller is not None and " cross (" in str(failure):
                        way = "more nodes (vesicles.points) or solver.repulsion, where steps this small do not keep them apart"
                    if scene.walls is not None and scene.walls.kind == "channel" and "crosses a wall" in str(failure):
                        way += "; at an end of the channel, where the fluid leaves, a longer channel or a shorter time.horizon"
                    raise NumericalFailure(
                        f"step {self.step + 1} rejected at {when}: {failure}; the state before it is kept; try {way}"
                    ) from None
                last = self._done()
                if self.step % every == 0 or last:
                    self._save_frame()
                    last = last or (self.enough is not None and self.ranks.any(self.enough(self.state.t, to_numpy(self.state.X))))
                self.files.observe(self.state, self.step, last)
                stopping = self.ranks.any(stop()) and not last
                if (self.step % checkpoint_every == 0 or last or stopping) and not self.shortened:
                    self._checkpoint()
                bar.update(self._shown() - bar.n)
                bar.set_postfix_str(self._status(), refresh=False)
                if stopping:
                    self.files.close()
                    where = f"of {self.problem.steps}" if self.controller is None else f"at t = {self.state.t:.6g}"
                    raise Stopped(f"stopped at step {self.step} {where}; go on with --resume")
                if last:
                    return

    def _done(self) -> bool:
        return self.step >= self.problem.steps if self.controller is None else self.state.t >= self.problem.horizon

    def _advance(self) -> None:
        """One step of dt, or what is left to the horizon."""
        problem = self.problem
        begin = time.perf_counter()
        t_next = (self.step + 1) * problem.dt
        self.shortened = t_next > problem.horizon * (1 + 1e-9)  # the last step: not one to go on from
        if self.shortened:
            t_next = problem.horizon
        dt = t_next - self.state.t if self.shortened else problem.dt
        self._take(t_next, dt, self._try(dt), 0, begin)

    def _advance_adaptively(self, controller: Controller) -> None:
        """One accepted step; rejected ones before it are halved until they are below dt_min, which raises NumericalFailure."""
        begin, rejected = time.perf_counter(), 0
        t, lost, dt = self.state.t, self.control["lost"], self.control["dt"]
        left = self.problem.horizon - t - lost
        while True:
            self.shortened = dt > left * (1 - 1e-9)  # the last step, as above
            dt = left if self.shortened else dt
            try:
                result = self._try(dt)
                errors = {name: result.diagnostics[name] for name in ERRORS}
                accepted, dt_next = controller.accept(dt, errors)
                if accepted:
                    break
                failed = ", ".join(f"{ERRORS[name]} {errors[name]:.2e}" for name in controller.failed(errors))
                why = f"{failed} above time.tolerance = {controller.tolerance:g}"
            except REJECTED as failure:
                dt_next, why = controller.reject(dt), str(failure)
            rejected += 1
            count("steps_rejected")
            if dt_next < controller.dt_min:
                raise NumericalFailure(f"{why} with dt = {dt:.3g}, half of it is below time.dt_min = {controller.dt_min:.3g}")
            dt = dt_next
        t_next, lost = (self.problem.horizon, 0.0) if self.shortened else add_time(t, lost, dt)
        self.control = {"dt": dt_next, "lost": lost}
        self._take(t_next, dt, result, rejected, begin)

    def _try(self, dt: float) -> StepResult:
        """A step that the guard lets pass."""

        def attempt() -> StepResult:
            with np.errstate(all="ignore"):  # what is not finite is the guard's to name
                result = self.stepper.step(self.state, dt)
            problem, new = self.problem, result.state
            lattice = None if problem.box is None else problem.box.at(new.t)
            check_state(new.X, new.sigma, result.diagnostics, problem.scene.solver.max_error, problem.region, lattice)
            return result

        return self.ranks.together(attempt)

    def _take(self, t_next: float, dt: float, result: StepResult, rejected: int, begin: float) -> None:
        """The step becomes the present state; rejected: steps tried before it; begin: time at which the first of them began."""
        self.tracers = self._carried(t_next, result.state)
        self.state = replace(result.state, t=t_next)
        self.step += 1
        self.latest = {**result.diagnostics, "dt": dt}
        r = self.running
        for name in (*WORST, *(name for name in MONITORED if name in result.diagnostics)):
            r[name] = max(r.get(name, 0.0), float(result.diagnostics.get(name, 0.0)))
        work = result.diagnostics.get("repulsion_work", 0.0)
        for name, value in (("steps", 1), ("rejected", rejected), ("repulsion_work", work), ("seconds", time.perf_counter() - begin)):
            r[name] = r.get(name, 0.0) + value
        r["dt"] = dt

    def _carried(self, t_next: float, new: State) -> Tracers | None:
        """The tracers after a step; the first process moves them."""
        old, tracers = self.state, self.tracers
        if tracers is None:
            return None
        with stage("tracers"):
            return self.ranks.on_root(lambda: self.carrier.carry(tracers, to_numpy(old.X), old.t, to_numpy(new.X), t_next))

    def _save_frame(self) -> None:
        with stage("output"):
            self.files.frame(lambda: _frame(self.problem, self.step, self.state, self.running, self.tracers))
        self.running = {}
        self.saved = self.step

    def _close_with_this_state(self) -> None:
        """The last good state as a frame and a checkpoint, all frames in one file."""
        if self.saved != self.step:
            self._save_frame()
        self._checkpoint()
        self.files.close()

    def _checkpoint(self) -> None:
        s, control = self.start, {} if self.controller is None else self.control
        x = None if self.tracers is None else self.tracers.x
        make = lambda: Checkpoint(self.step, self.state, s.area_0, s.length_0, s.scene, self.running, dict(self.counts), s.run, control, x)
        with stage("output"):
            self.files.checkpoint(make)

    def _shown(self) -> float:
        """Where the bar stands: at a step, or at a time where the number of steps is not known."""
        return self.step if self.controller is None else self.state.t

    def _bar(self) -> tqdm:
        fixed = self.controller is None
        return tqdm(
            total=self.problem.steps if fixed else self.problem.horizon,
            bar_format=None if fixed else "{l_bar}{bar}| t = {n:.4g} of {total:.4g} [{elapsed}<{remaining}{postfix}]",
            initial=self._shown(),
            unit="step",
            disable=not self.progress,
            desc=self.problem.scene.name,
            mininterval=0.5,
            dynamic_ncols=True,
        )

    def _status(self) -> str:
        d, unit = self.latest, self.problem.flow.time_scale
        parts = [f"t = {self.state.t / unit:.2f} t_gamma" if unit else f"t = {self.state.t:.3g}"]
        if self.controller is not None:
            parts.append(f"dt = {d['dt']:.2g}")
        parts += [f"{name} {d[f'{name}_error']:.0e}" for name in ("area", "length") if f"{name}_error" in d]
        if "gmres_iterations" in d:
            parts.append(f"GMRES {d['gmres_iterations']:.0f}")
        return ", ".join(parts)


def _check_same_walls(problem: Problem, earlier: Trajectory) -> None:
    """Walls from a file may have changed with it. Raises ValueError."""
    old, new = earlier.attributes.get("walls", ()), () if problem.walls is None else problem.walls.curves
    if len(old) != len(new) or not all(np.array_equal(a, b) for a, b in zip(old, new, strict=True)):
        raise ValueError("the walls are not those of the frames before: restore walls.file, or start anew with --force")


def _frame(problem: Problem, step: int, state: State, running: dict[str, float], tracers: Tracers | None) -> Trajectory:
    X = to_numpy(state.X)
    sigma = None if state.sigma is None else to_numpy(state.sigma)
    diagnostics = {name: running.get(name, 0.0) for name in (*WORST, "dt", "rejected", "repulsion_work")}
    diagnostics |= {name: running[name] for name in MONITORED if name in running}
    diagnostics["bending_energy"] = float(bending_energy(X, problem.scene.physics.kappa_b).sum())
    diagnostics["wall_seconds"] = running.get("seconds", 0.0) / max(1.0, running.get("steps", 0.0))
    diagnostics["min_gap"] = minimum_gap(X, None if problem.box is None else problem.box.at(state.t))
    if problem.walls is not None:
        diagnostics["min_gap"] = min(diagnostics["min_gap"], float(problem.walls.distance(X.transpose(0, 2, 1).reshape(-1, 2)).min()))
    return one_frame(state.t, step, X, sigma, diagnostics, None if tracers is None else tracers.x)


@contextmanager
def stop_signals() -> Iterator[Callable[[], bool]]:
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


def commit() -> str:
    here = Path(__file__).parent
    try:
        done = subprocess.run(["git", "-C", here, "rev-parse", "HEAD"], capture_output=True, text=True, check=True, timeout=10)
        return done.stdout.strip()
    except (OSError, subprocess.SubprocessError):
        try:
            return f"vesnet {version('vesnet')}"
        except PackageNotFoundError:
            return "unknown"
