"""A case of the grid run and judged, from its files alone: finished, finished with smaller steps, refused in one line, or ill-behaved.

A rejected step is met as its message says, by smaller steps: adaptive ones, and where the rung has none dt/4, then dt/16.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

import numpy as np

from biem.curves.curve import area, length
from biem.run.files import one_line, write_atomically
from biem.run.trajectory import Trajectory, exists
from biem.run.verify import verify
from biem.scene.config import Scene, make_scene
from studies.differences import differences
from studies.extremes_grid import Against, Case, Tables, merged
from studies.runs import Kept, Record, kept

FINISHED, SMALLER, REFUSED, ILL = "finished", "finished with smaller steps", "refused", "ill-behaved"
BAD_INPUT, REJECTED = 2, 3  # exit codes
COUNTED = {"area_error": "area_length_restored", "length_error": "area_length_restored"}  # diagnostics, and what counts their correction
UNALTERED = 1e-9  # relative error of area or length that nothing needs to correct
ROOT = Path(__file__).resolve().parents[2]
LONGEST_LINE = 600


@dataclass(frozen=True)
class Attempt:
    """One run of a case. how: "as given", "adaptive", "dt/4", "dt/16"; problems: why it is ill-behaved."""

    how: str
    scene: str  # resolved; empty where it was refused before
    code: int = 0
    line: str = ""
    problems: list[str] = field(default_factory=list)


@dataclass(frozen=True)
class Outcome:
    """What a case came to. error: largest of position and shape, R, against what; drifts: relative, of area and length;

    largest_correction: largest error of a step before it was corrected; counts: of the run, by name; seconds: of stepping.
    """

    axis: str
    value: str
    rung: str
    outcome: str
    how: str
    line: str
    problems: list[str]
    attempts: list[Attempt]
    error: float | None = None
    against: str = ""
    area_drift: float | None = None
    length_drift: float | None = None
    largest_correction: float | None = None
    smallest_step: float | None = None
    first_step: float | None = None
    steps: int = 0
    rejected: float = 0.0
    counts: Mapping[str, float] = field(default_factory=dict)
    seconds: float = 0.0
    peak_bytes: float = 0.0
    commit: str = ""


def outcome_path(case: Case, folder: Path) -> Path:
    """Where the outcome of a case lies."""
    return folder / "cases" / case.axis / _file_name(case.value) / f"{_file_name(case.rung)}.json"


def read_outcome(path: Path) -> Outcome | None:
    """The outcome in that file, or None where there is none."""
    try:
        return outcome_of(json.loads(path.read_text()))
    except (FileNotFoundError, json.JSONDecodeError, TypeError, KeyError):
        return None


def outcome_of(table: dict) -> Outcome:
    """Inverse of `asdict`."""
    return Outcome(**{**table, "attempts": [Attempt(**attempt) for attempt in table["attempts"]]})


def settle(case: Case, folder: Path, again: bool = False) -> Outcome:
    """The outcome of a case, from its file where the case has not changed. again: repeat what was refused or ill-behaved."""
    path = outcome_path(case, folder)
    found = read_outcome(path)
    unchanged = found is not None and found.attempts[0].scene == _resolved(case.scene, folder)
    if found is not None and unchanged and not (again and found.outcome in (REFUSED, ILL)):
        return found
    path.parent.mkdir(parents=True, exist_ok=True)
    if again:
        for old in path.parent.glob(f"{path.stem}-*"):
            if old.is_file():
                old.unlink()
    attempts: list[Attempt] = []
    last: Kept | None = None
    for how, scene in _ways(case):
        run = path.with_name(f"{path.stem}-{_file_name(how)}.h5")
        attempt, last = _attempt(how, scene, run, folder, case.bound)
        attempts.append(replace(attempt, line=_said_anywhere(attempt.line, folder)))
        if attempt.problems or attempt.code == 0 or (how == "as given" and attempt.code == BAD_INPUT):
            break
        if how == "adaptive" and attempt.code == REJECTED:
            break
    outcome = _outcome(case, attempts, last, folder)
    write_atomically(path, json.dumps(asdict(outcome), indent=1).encode())
    return outcome


def problems_in(trajectory: Trajectory, record: Record) -> list[str]:
    """What a run must not leave, in words: from its frames, and from what it said."""
    with np.errstate(all="ignore"):
        problems = [f"{check.name}: {check.detail}" for check in verify(trajectory) if not check.passed]
    for name, values in trajectory.diagnostics.items():
        if np.isnan(values).any() or (name != "min_gap" and np.isinf(values).any()):
            problems.append(f"diagnostics/{name} is not finite")
    corrected = json.loads(trajectory.attributes["scene"])["solver"]["corrections"]
    for name, counted in COUNTED.items():
        altered = "area_length" in corrected and trajectory.diagnostics[name].max() > UNALTERED
        if altered and not record.failure and not record.counts.get(counted):
            problems.append(f"{name} was corrected, but {counted} is not counted")
    return problems


def said_badly(record: Record) -> list[str]:
    """Why what a run said is not one line."""
    lines = record.failure.splitlines()
    problems = [f"{len(lines)} error lines"] if len(lines) > 1 else []
    if len(record.failure) > LONGEST_LINE:
        problems.append(f"an error line of {len(record.failure)} letters")
    return problems + [f"warned: {one_line_of(text)}" for text in record.warnings[:1]]


def one_line_of(text: str) -> str:
    """Text without its line breaks."""
    return " ".join(text.split())


def _ways(case: Case) -> list[tuple[str, Tables]]:
    """The case as given, and with smaller steps, in the order in which they are tried."""
    time = case.scene["time"]
    smaller = [(f"dt/{n}", merged(case.scene, {"time": {"dt": time["dt"] / n, "save_every": n * time["save_every"]}})) for n in (4, 16)]
    return [("as given", case.scene), ("adaptive", merged(case.scene, {"time": {"adaptive": True}})), *smaller]


def _attempt(how: str, tables: Tables, path: Path, folder: Path, bound: float) -> tuple[Attempt, Kept | None]:
    try:
        scene = _scene(tables, folder)
    except ValueError as error:
        return Attempt(how, "", BAD_INPUT, str(error), said_badly(Record("", str(error)))), None
    resolved = json.dumps(scene.model_dump(mode="json"))
    try:
        done = kept(scene, path, timeout=bound)
    except (TimeoutError, RuntimeError) as error:
        why = "past the bound" if isinstance(error, TimeoutError) else "the process died"
        return Attempt(how, resolved, -1, one_line(error), [f"{why}: {one_line(error)}"]), None
    problems = said_badly(done.record)
    if exists(path):
        try:
            problems += problems_in(done.trajectory, done.record)
        except (OSError, KeyError, ValueError) as error:
            problems.append(f"the file cannot be judged: {type(error).__name__}: {one_line(error)}")
    return Attempt(how, resolved, done.record.code, done.record.failure, problems), done


def _outcome(case: Case, attempts: list[Attempt], last: Kept | None, folder: Path) -> Outcome:
    first, final = attempts[0], attempts[-1]
    problems = [f"{a.how}: {problem}" for a in attempts for problem in a.problems]
    finished = final.code == 0 and not final.problems
    outcome = ILL if problems else (FINISHED if len(attempts) == 1 else SMALLER) if finished else REFUSED
    line = "" if outcome == FINISHED else first.line if len(attempts) == 1 or outcome == SMALLER else _last_rejection(attempts)
    base = Outcome(case.axis, case.value, case.rung, outcome, final.how if finished else first.how, line, problems, attempts)
    if last is None:
        return base
    record = last.record
    base = replace(
        base,
        steps=record.steps,
        counts=record.counts,
        seconds=record.wall_a_step * record.steps,
        peak_bytes=record.peak_bytes,
        commit=record.commit,
    )
    if not finished or not exists(last.path):
        return base
    trajectory = last.trajectory
    d = trajectory.diagnostics
    error, against = _error(case, trajectory, folder)
    drift = {f: max(float(np.abs(f(X) / f(trajectory.X[0]) - 1.0).max()) for X in trajectory.X) for f in (area, length)}
    return replace(
        base,
        error=error,
        against=against,
        area_drift=drift[area],
        length_drift=drift[length],
        largest_correction=float(max(d["area_error"].max(), d["length_error"].max())),
        smallest_step=float(d["dt"][1:].min()) if len(trajectory) > 1 else None,
        first_step=float(case.scene["time"]["dt"]),
        rejected=float(d["rejected"].sum()),
    )


def _said_anywhere(line: str, folder: Path) -> str:
    """The line without the folders of this machine."""
    for where in (folder.resolve(), ROOT):
        line = line.replace(f"{where}/", "")
    return line


def _last_rejection(attempts: list[Attempt]) -> str:
    """The line of the last attempt that was made, not refused for its input."""
    return next(a.line for a in reversed(attempts) if a.code == REJECTED)


def _error(case: Case, trajectory: Trajectory, folder: Path) -> tuple[float | None, str]:
    """The largest error of position and shape, R; None where there is nothing to hold the case against, with why."""
    if case.against is None:
        return None, ""
    scene = _scene(case.against.scene, folder)
    name = hashlib.sha256(json.dumps(scene.model_dump(mode="json")).encode()).hexdigest()[:16]
    try:
        reference = kept(scene, folder / "references" / f"{name}.h5", timeout=3 * case.bound)
    except (TimeoutError, RuntimeError) as error:
        return None, f"{case.against.what} was not made: {one_line(error)}"
    if reference.record.failure:
        return None, f"{case.against.what} was refused: {reference.record.failure}"
    largest = differences(_moved(trajectory, case.against), reference.trajectory).largest()
    return max(largest["position"], largest["shape"]), case.against.what


def _moved(trajectory: Trajectory, against: Against) -> Trajectory:
    """The trajectory where, and in the units in which, the other one is."""
    shift = np.array(against.offset) + trajectory.t[:, None] * np.array(against.velocity)  # (F, 2)
    X = (trajectory.X - shift[:, None, :, None]) / against.length
    return replace(trajectory, t=trajectory.t / against.time, X=X, sigma=None)


def _scene(tables: Tables, folder: Path) -> Scene:
    return make_scene(dict(tables), folder / "inputs")


def _resolved(tables: Tables, folder: Path) -> str:
    try:
        return json.dumps(_scene(tables, folder).model_dump(mode="json"))
    except ValueError:
        return ""


def _file_name(text: str) -> str:
    return re.sub(r"[^\w.=+-]+", "_", text).strip("_")
