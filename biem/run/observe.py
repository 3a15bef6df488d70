"""Observables of a run: recorded while it runs, or taken from its trajectory afterwards."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from biem.backend import fft_backend, stage, to_numpy
from biem.observe.observables import BINS, Observations, Observer, join
from biem.observe.quantities import QUANTITIES, known
from biem.run.derived import check_finite, check_output, unfinished
from biem.run.files import make_folder
from biem.run.observations import (
    ObservationWriter,
    are_observations,
    check_ending,
    read_observations,
    remove,
    write_observations,
)
from biem.run.trajectory import Trajectory, read_trajectory
from biem.scene.build import Problem, build
from biem.scene.config import make_scene
from biem.steppers.stepper import State

ORIGIN = ("run", "solver", "commit")  # attributes of a trajectory that its observables carry too
COMMIT_AFTER = 5.0  # s of work on a trajectory that an interruption may cost


def observables_path(trajectory: Path) -> Path:
    """Where a run writes its observables."""
    return trajectory.with_suffix(".observables.h5")


def observer_of_run(problem: Problem, first: np.ndarray) -> tuple[Observer, int] | None:
    """What the scene's [observe] asks for, and every how many steps; None without that table. first (M, 2, N): the first frame.

    Raises ValueError for a quantity that is unknown, or that the scene does not have.
    """
    table, scene = problem.scene.observe, problem.scene
    if table is None:
        return None
    observer = Observer.of(replace(problem, X=first), table.quantities, solve=False, running=True, bins=table.bins)
    kept = scene.output.tension or len(problem.X) > 1 or problem.walls is not None
    lacking = [q.name for q in observer.quantities if q.source != "shape"]
    if lacking and not kept:
        raise ValueError(f"observe: {lacking[0]} takes the tension, which this run does not keep: leave out output.tension = false")
    return observer, table.every or scene.time.save_every


class Recorder:
    """Rows of a run, into a file at every checkpoint, or in memory where there is no path."""

    def __init__(self, observer: Observer, origin: Mapping[str, Any], path: Path | None, earlier: Observations | None = None) -> None:
        """earlier: the rows before a restart; without them the file begins anew."""
        about = {**observer.about, **{name: origin[name] for name in ORIGIN}}
        self.observer = replace(observer, about=about)
        rows = self.observer.nothing() if earlier is None else earlier
        self._writer = None if path is None else ObservationWriter(path, rows)
        self._rows = [rows] if path is None else []

    def record(self, state: State, step: int) -> None:
        """The row of a state."""
        with stage("observables"):
            sigma = None if state.sigma is None else to_numpy(state.sigma)
            self._rows.append(self.observer.row(to_numpy(state.X), state.t, step, sigma))

    def commit(self) -> None:
        """What was recorded is on the disk."""
        if self._writer is not None and self._rows:
            self._writer.append(join(self._rows))
            self._rows = []

    def close(self) -> None:
        """All rows in one file."""
        self.commit()
        if self._writer is not None:
            self._writer.close()

    def rows(self) -> Observations:
        """All rows so far."""
        return join(self._rows) if self._writer is None else read_observations(self._writer.path)


def rows_to_resume(path: Path, run: str, step: int) -> Observations | None:
    """The rows up to the step of a checkpoint, None at the start. Raises ValueError where the file does not have them."""
    if step == 0:
        return None
    try:
        rows = read_observations(path)
    except (FileNotFoundError, ValueError) as error:
        raise ValueError(f"{error}; a run goes on with the rows before it alone: start anew with --force") from None
    if rows.about.get("run") != run:
        raise ValueError(f"observables {path} are of another run than the trajectory: start anew with --force")
    return rows.where(rows.step <= step)


@dataclass(frozen=True)
class Observed:
    """What became of a file: the rows, the files written, what is to be said of them, and a summary for programs."""

    rows: Observations
    files: list[Path]
    notices: list[str]
    report: dict[str, Any]


def observe_file(
    source: Path,
    output: Path | None = None,
    plots: Path | None = None,
    names: Sequence[str] | None = None,
    every: int = 1,
    bins: int = BINS,
    stored_tension: bool = False,
    folder: Path = Path("."),
    progress: Callable[[Any], Iterable[Any]] = iter,
) -> Observed:
    """Observables of a trajectory, or those that a run has written, as a file (.csv or .h5; default beside the source) and pictures.

    plots: folder for the pictures; the other arguments as of `observe` and `problem_of`. What an interrupted call had found is gone on
    from. Raises ValueError or FileNotFoundError with one line for what is wrong, NumericalFailure where a tension is not found.
    """
    written = are_observations(source)
    output = output or source.with_suffix(".csv" if written else ".observables.csv")
    check_ending(output)
    check_output(output, source)
    if plots is not None:
        make_folder(plots)  # before anything is computed
    notices: list[str] = []
    if written:
        if stored_tension or bins != BINS:
            raise ValueError(f"{source} holds observables: --bins and --stored-tension are for trajectories")
        rows = read_observations(source)
        rows = (rows if names is None else _some(rows, names)).where(np.arange(0, len(rows), every))
    else:
        trajectory = read_trajectory(source)
        problem = problem_of(trajectory, folder)
        notices += filter(None, [unfinished(trajectory, problem)])
        known(names if names is not None else QUANTITIES)
        partial = output.with_name(output.name + ".partial.h5")
        rows = observe(
            trajectory, problem, names, stored_tension=stored_tension, every=every, bins=bins, partial=partial, progress=progress
        )
    files = write_observations(output, rows)
    if not written:
        remove(partial)
    if plots is not None:
        from biem.run.observe_plots import draw_observables  # matplotlib loads slowly: only where it is needed

        drawn = draw_observables(rows, plots)
        files += drawn
        if not drawn:
            notices.append(f"there is nothing to draw of {len(rows)} row(s): pictures take more than one, or a quantity in bins")
    report = {
        "source": str(source),
        "files": [str(file) for file in files],
        "rows": len(rows),
        "quantities": [q.name for q in rows.quantities],
    }
    return Observed(rows, files, notices, report | {"about": dict(rows.about), "notices": notices})


def _some(rows: Observations, names: Sequence[str]) -> Observations:
    """Those of the quantities. Raises ValueError for names that there are not."""
    known(names)
    there = [q.name for q in rows.quantities]
    for name in names:
        if name not in there:
            raise ValueError(f"{name} is not among the observables of the file: it has {', '.join(there)}")
    chosen = tuple(q for q in rows.quantities if q.name in names)
    return replace(rows, quantities=chosen, values={q.name: rows.values[q.name] for q in chosen})


def problem_of(trajectory: Trajectory, folder: Path) -> Problem:
    """The problem that a trajectory is of, from its first frame on. folder: where its scene's own files are (custom flows, walls)."""
    if len(trajectory) == 0:
        raise ValueError("the trajectory has no frames")
    if not folder.is_dir():
        raise ValueError(f"--folder {folder} does not exist: it is where the scene's custom flow or walls are")
    check_finite(trajectory)
    scene = make_scene(json.loads(trajectory.attributes["scene"]), folder)
    try:
        return build(scene, trajectory.X[0])
    except ValueError as error:
        if scene.flow.function or (scene.walls is not None and scene.walls.file):
            raise ValueError(f"{error}; --folder says where the files of the scene are") from None
        raise


def observe(
    trajectory: Trajectory,
    problem: Problem,
    names: Iterable[str] | None = None,
    *,
    stored_tension: bool = False,
    every: int = 1,
    bins: int = BINS,
    partial: Path | None = None,
    progress: Callable[[Any], Iterable[Any]] = iter,
) -> Observations:
    """Rows of every so many frames of the problem's trajectory. names: default all that the scene has.

    stored_tension: take the solver's tension, do not find it anew. partial: a file in which an interrupted call leaves its rows, and from
    which the next one goes on; to be removed once the rows are safe. Raises ValueError for what the scene or the trajectory does not have,
    NumericalFailure as `instant` does.
    """
    observer = Observer.of(problem, names, solve=not stored_tension, bins=bins)
    if stored_tension and trajectory.sigma is None and any(q.source != "shape" for q in observer.quantities):
        raise ValueError("the trajectory keeps no tension (output.tension): leave out --stored-tension")
    observer = replace(observer, about={**observer.about, **{name: trajectory.attributes.get(name, "") for name in ORIGIN}})
    frames = list(range(0, len(trajectory), every))
    steps = trajectory.step[frames]
    kept = _begun(partial, observer, steps)
    parts, written = [kept], 1
    since, writer = time.monotonic(), None

    def commit() -> None:
        nonlocal since, writer, written
        assert partial is not None
        writer = writer or ObservationWriter(partial, kept)
        writer.append(join(parts[written:]))
        since, written = time.monotonic(), len(parts)

    try:
        with fft_backend(trajectory.X[0].size):
            for k in progress([k for k, step in zip(frames, steps, strict=True) if step not in kept.step]):
                stored = stored_tension and trajectory.sigma is not None and trajectory.step[k] > 0
                sigma = trajectory.sigma[k] if stored and trajectory.sigma is not None else None
                parts.append(observer.row(trajectory.X[k], float(trajectory.t[k]), int(trajectory.step[k]), sigma))
                if partial is not None and time.monotonic() - since > COMMIT_AFTER:
                    commit()
    except BaseException:
        if partial is not None and len(parts) > written:
            commit()
        raise
    rows = join(parts)
    return rows.where(np.argsort(rows.step))


def _begun(partial: Path | None, observer: Observer, steps: np.ndarray) -> Observations:
    """Rows that an earlier call for the same has left, of the frames of these steps; none where there are none."""
    empty = observer.nothing()
    if partial is None or not partial.exists():
        return empty
    try:
        rows = read_observations(partial)
    except ValueError:
        return empty
    same = rows.quantities == empty.quantities and np.array_equal(rows.edges, empty.edges) and dict(rows.about) == dict(empty.about)
    return rows.where(np.isin(rows.step, steps)) if same else empty
