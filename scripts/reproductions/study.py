"""What the experiments share: where their runs and results are, which runs are made now, what there is of each run, results as JSON."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from studies.rungs import Rung, rung
from studies.runs import Record, kept_all, read_record

from biem.errors import NumericalFailure
from biem.run.files import write_atomically
from biem.run.simulate import commit
from biem.run.trajectory import Trajectory, read_trajectory
from biem.scene.config import Scene, make_scene

ROOT = Path(__file__).resolve().parents[2]
SCENES = ROOT / "configs" / "scenes"
FINISHED, REJECTED, UNFINISHED, MISSING = "finished", "rejected", "unfinished", "not run"
REACHED = 1.0 - 1e-6  # of the horizon
Results = dict[str, Any]


@dataclass(frozen=True)
class Study:
    """What is asked for.

    output: folder of all experiments. solvers: the rungs that are run now, by name (None: all); the others are taken as they are.
    collect: nothing is run. quick: horizons of a few steps, in a folder of their own. device, steps: of timing and dense.
    """

    output: Path
    solvers: tuple[str, ...] | None = None
    collect: bool = False
    quick: bool = False
    workers: int = 1
    device: str = "cpu"
    steps: int | None = None

    def folder(self, name: str) -> Path:
        """Of one experiment, made if it is not there."""
        path = (self.output / "quick" if self.quick else self.output) / name
        path.mkdir(parents=True, exist_ok=True)
        return path

    def rungs(self, names: Sequence[str]) -> tuple[str, ...]:
        """The experiment's own rungs, then those that are asked for besides."""
        return tuple(dict.fromkeys((*names, *(self.solvers or ()))))

    def runs(self, name: str) -> bool:
        """Whether a rung is run now."""
        return not self.collect and (self.solvers is None or name in self.solvers)


@dataclass(frozen=True)
class Task:
    """A run: of a rung, into a file. ready: whatever trajectory of this scene lies there is taken as it is."""

    rung: Rung
    path: Path
    ready: bool = False

    @property
    def scene(self) -> Scene:
        return self.rung.scene


@dataclass(frozen=True)
class Found:
    """What there is of a run."""

    task: Task
    trajectory: Trajectory | None
    record: Record | None

    @property
    def state(self) -> str:
        """FINISHED, REJECTED, UNFINISHED or MISSING."""
        if self.record is not None and self.record.failure:
            return REJECTED
        if self.trajectory is None:
            return MISSING
        return FINISHED if self.record is not None or _at_its_end(self.trajectory) else UNFINISHED

    def summary(self) -> Results:
        """State, time reached in t_gamma (or as it is where the flow has none), steps, seconds a step, what the error was."""
        trajectory = self.trajectory
        if trajectory is None:
            return {"state": self.state, "failure": self.record.failure if self.record else ""}
        steps = np.diff(trajectory.step)
        wall = float((trajectory.diagnostics["wall_seconds"][1:] * steps).sum()) / max(1, int(steps.sum()))
        row = {
            "state": self.state,
            "until": float(trajectory.t[-1] / (trajectory.attributes["t_gamma"] or 1.0)),
            "steps": int(trajectory.step[-1]),
            "seconds_a_step": wall,
            "failure": self.record.failure if self.record else "",
            "smallest_gap": _finite(trajectory.diagnostics["min_gap"].min()),
        }
        if "out_of_distribution" in trajectory.diagnostics:
            row["out_of_distribution"] = int(trajectory.diagnostics["out_of_distribution"].max())
        return row


def scene_rung(scene: Path, name: str, overrides: Sequence[str], horizon: str | None) -> Rung:
    """A rung on a scene; horizon: in place of the scene's."""
    return rung(scene, name, [*overrides, *([f'time.horizon="{horizon}"'] if horizon else [])])


def from_file(made: Rung, path: Path) -> Rung:
    """A rung that begins with the shapes in a file, which lies beside its scene."""
    return Rung(made.name, make_scene({**made.scene.model_dump(mode="json"), "vesicles": {"file": path.name}}, path.parent))


def gather(study: Study, tasks: Mapping[str, Task], ending: str = "", desc: str = "runs") -> dict[str, Found]:
    """Makes the runs that are asked for and not there, then says what there is of all. Raises NumericalFailure if a process dies."""
    now = {name: (task.scene, task.path) for name, task in tasks.items() if study.runs(task.rung.name) and not _done(task)}
    if now:
        try:
            kept_all(now, study.workers, 1, ending, desc)
        except RuntimeError as error:
            raise NumericalFailure(str(error)) from None
    return {name: found(task) for name, task in tasks.items()}


def found(task: Task) -> Found:
    """What there is of a run, of this scene."""
    record = read_record(task.scene, task.path)
    try:
        trajectory = read_trajectory(task.path)
    except (FileNotFoundError, ValueError):
        trajectory = None
    if trajectory is not None and not _same(trajectory, task.scene):
        trajectory = None
    return Found(task, trajectory, record)


def _done(task: Task) -> bool:
    there = found(task).trajectory
    return there is not None and (task.ready or _at_its_end(there))


def _same(trajectory: Trajectory, scene: Scene) -> bool:
    """Whether a trajectory is of a scene, one written before a setting came to be included."""
    try:
        return make_scene(json.loads(trajectory.attributes["scene"])).model_dump() == scene.model_dump()
    except ValueError:
        return False


def _at_its_end(trajectory: Trajectory) -> bool:
    """Whether the horizon in t_gamma, or as a number, is reached."""
    horizon = json.loads(trajectory.attributes["scene"])["time"]["horizon"]
    value, _, unit = str(horizon).partition(" ")
    scale = {"": 1.0, "t_gamma": float(trajectory.attributes["t_gamma"])}.get(unit.strip())
    return scale is not None and bool(trajectory.t[-1] >= REACHED * float(value) * scale)


def write_results(study: Study, name: str, data: Results) -> Results:
    """results.json of an experiment."""
    data = {"experiment": name, "commit": commit(), "quick": study.quick, **data}
    write_atomically(study.folder(name) / "results.json", json.dumps(data, indent=1, allow_nan=False).encode())
    return data


def read_results(study: Study, name: str) -> Results | None:
    """Of an earlier run of an experiment, or None."""
    path = study.folder(name) / "results.json"
    return json.loads(path.read_text()) if path.exists() else None


def table(head: Iterable[str], rows: Iterable[Iterable[Any]]) -> str:
    """In Markdown; numbers in three digits, None as nothing."""
    head = list(head)
    lines = ["| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
    return "\n".join([*lines, *("| " + " | ".join(shown(value) for value in row) + " |" for row in rows)])


def shown(value: Any) -> str:
    """A value as a table has it."""
    if value is None:
        return ""
    return f"{value:.3g}" if isinstance(value, float) else str(value)


def ended(row: Results) -> str:
    """In words, how far a run went."""
    if row["state"] == FINISHED:
        return "finished"
    if row["state"] == MISSING:
        return "not run" if not row.get("failure") else f"refused: {row['failure']}"
    return f"**{'rejected' if row['state'] == REJECTED else 'unfinished'}** at {row['until']:.3g}"


def _finite(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None
