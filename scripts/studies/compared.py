"""The numbers of a comparison: errors of rungs against a reference run, what they cost, the Pareto fronts, a summary in words.

Times are in t_gamma where the scene has one, else in its own unit. Costs are seconds of wall or CPU time per such time, without start and
compilation.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from biem.curves.curve import effective_radius
from biem.run.trajectory import Trajectory
from biem.scene.build import SOLVERS_WITH
from biem.scene.config import Scene
from biem.scene.tables import flat
from studies.differences import MEANING, Differences, differences
from studies.fitting import Entry
from studies.pareto import front
from studies.runs import Kept, Record

WANTED = 0.01  # error of positions, R: what the summary looks for
COSTS = {"cpu": "CPU seconds", "wall": "wall seconds"}
ENDED = 1e-9  # relative: a run that came closer to its horizon is finished


@dataclass(frozen=True)
class Ran:
    """A rung and its run. kept: None for a rung that was refused before it."""

    entry: Entry
    kept: Kept | None

    @property
    def name(self) -> str:
        return self.entry.name

    @property
    def record(self) -> Record:
        return self.kept.record if self.kept else Record("", failure=self.entry.refused)

    @cached_property
    def trajectory(self) -> Trajectory | None:
        """What there is of it, if it made a step."""
        return self.kept.trajectory if self.kept and self.record.until > 0 else None


@dataclass(frozen=True)
class Compared:
    """Runs against a reference. floor: the reference's own error over time; apart: of each rung that made a step, by name.

    unit, scale: the name of the unit of time and its value; how: in words, what the floor is.
    """

    reference: Ran
    rungs: Sequence[Ran]
    apart: Mapping[str, Differences]
    floor: Differences | None
    how: str
    unit: str
    scale: float

    @property
    def truth(self) -> Trajectory:
        assert self.reference.trajectory is not None
        return self.reference.trajectory

    @property
    def R(self) -> float:
        """Of the vesicles' mean area, as in `differences`."""
        return float(np.sqrt(np.mean(effective_radius(self.truth.X[0]) ** 2)))


def compare(reference: Ran, rungs: Sequence[Ran], coarse: Ran | None, factor: float, how: str) -> Compared:
    """coarse: the reference with larger steps; factor: what the difference between the two is divided by; how: `Compared.how`.

    Raises ValueError for a reference that made no step.
    """
    truth = reference.trajectory
    if truth is None:
        raise ValueError(f"the reference {reference.name} made no step: {reference.record.failure or 'no word'}")
    apart = {ran.name: differences(ran.trajectory, truth) for ran in rungs if ran.trajectory is not None}
    floor = None
    if coarse is not None and coarse.trajectory is not None:
        found = differences(coarse.trajectory, truth)
        floor = Differences(found.t, {name: values / factor for name, values in found.values.items()})
    t_gamma = float(truth.attributes["t_gamma"])
    return Compared(reference, rungs, apart, floor, how, *(("t_gamma", t_gamma) if t_gamma else ("unit of time", 1.0)))


def results(compared: Compared, horizon: float) -> dict[str, Any]:
    """All numbers, as compare.json has them. horizon: of the scene, in its unit of time."""
    end = min(horizon, float(compared.truth.t[-1]))
    rows = [_row(ran, compared, end) for ran in compared.rungs]
    reference = _row(compared.reference, compared, end) | {"worst": None, "end": None}
    if compared.floor is not None:
        reference |= _errors(compared.floor)
    quantities = [name for name in MEANING if any(row["worst"] and name in row["worst"] for row in [reference, *rows])]
    done = [row for row in rows if row["worst"] and row["complete"]]
    found = {
        "unit": compared.unit,
        "unit_value": compared.scale,
        "horizon": horizon / compared.scale,
        "until": end / compared.scale,
        "R": compared.R,
        "vesicles": int(compared.truth.X.shape[1]),
        "meaning": {name: MEANING[name] for name in quantities},
        "reference": reference | {"how": compared.how},
        "rungs": rows,
        "front": {quantity: {cost: _front(done, quantity, cost) for cost in COSTS} for quantity in quantities},
        "settings": _settings([compared.reference, *compared.rungs]),
        "commit": compared.reference.record.commit,
        "machine": compared.reference.record.machine,
    }
    return found | {"summary": summary(found)}


def _row(ran: Ran, compared: Compared, end: float) -> dict[str, Any]:
    """What a run is, what it cost, how far it is off."""
    record, trajectory, scale = ran.record, ran.trajectory, compared.scale
    row: dict[str, Any] = {
        "name": ran.name,
        "notes": list(ran.entry.notes),
        "failure": record.failure,
        "until": record.until / scale,
        "complete": record.until >= end * (1 - ENDED) and not record.failure,
        "nodes": None if trajectory is None else int(trajectory.X.shape[-1]),
        "steps": record.steps,
        "rejected": 0,
        "cost": None,
        "worst": None,
        "end": None,
        "wall_a_step": record.wall_a_step,
        "cpu_a_step": record.cpu_a_step,
        "peak_bytes": record.peak_bytes,
        "stages": dict(record.seconds),
        "counts": dict(record.counts),
        "threads": record.threads,
        "commit": record.commit,
    }
    if trajectory is not None:
        rate = record.steps * scale / record.until
        row |= {
            "rejected": int(trajectory.diagnostics["rejected"].sum()),
            "cost": {"cpu": record.cpu_a_step * rate, "wall": record.wall_a_step * rate},
        }
    return row | (_errors(compared.apart[ran.name]) if ran.name in compared.apart else {})


def _errors(found: Differences) -> dict[str, Any]:
    return {"worst": found.largest(), "end": {name: float(values[-1]) for name, values in found.values.items()}}


def _front(rows: Sequence[Mapping[str, Any]], quantity: str, cost: str) -> list[str]:
    """Names of the rungs that ran to the end and that no other one beats."""
    return [rows[k]["name"] for k in front([row["cost"][cost] for row in rows], [row["worst"].get(quantity, np.nan) for row in rows])]


def _settings(runs: Sequence[Ran]) -> dict[str, Any]:
    """Settings of the scenes by their paths: those that all share, and of the others a list, one value a run, the reference first."""
    tables = [_taken(ran.entry.rung.scene) for ran in runs]
    keys = list(dict.fromkeys(key for table in tables for key in table))
    values = {key: [table.get(key) for table in tables] for key in keys}
    same = {key: len({json.dumps(value) for value in found}) == 1 for key, found in values.items()}
    return {
        "runs": [ran.name for ran in runs],
        "shared": {key: values[key][0] for key in keys if same[key]},
        "different": {key: values[key] for key in keys if not same[key]},
    }


def _taken(scene: Scene) -> dict[str, Any]:
    """The settings by their paths, without those that the scene's solver does not take."""
    table = scene.model_dump(mode="json")
    for key, kinds in SOLVERS_WITH.items():
        if scene.solver.kind not in kinds:
            del table["solver"][key]
    return flat(table)


def summary(found: Mapping[str, Any]) -> list[str]:
    """What the numbers say, a sentence or two each."""
    unit, reference, rows = found["unit"], found["reference"], found["rungs"]
    done = [row for row in rows if row["worst"] and row["complete"]]
    lines = [_about(found)]
    good = sorted((row for row in done if row["worst"]["position"] <= WANTED), key=lambda row: row["cost"]["cpu"])
    if good:
        best = good[0]
        lines.append(
            f"Fastest within {WANTED:.0%} of R: {best['name']}, {_times(best, reference)} the reference "
            f"({best['cost']['cpu']:.2g} against {reference['cost']['cpu']:.2g} CPU seconds a {unit}), "
            f"centroids off by {best['worst']['position']:.2g} R at most."
        )
    elif done:
        best = min(done, key=lambda row: row["worst"]["position"])
        lines.append(
            f"No rung keeps all centroids within {WANTED:.0%} of R. The closest is {best['name']}, {_times(best, reference)} "
            f"the reference, off by {best['worst']['position']:.2g} R at most."
        )
    if done:
        names = found["front"]["position"]["cpu"]
        lines.append(f"No rung beats {_listed(names)} in both cost and position.")
        cheapest = min(done, key=lambda row: row["cost"]["cpu"])
        if cheapest is not best:
            lines.append(
                f"Cheapest: {cheapest['name']}, {_times(cheapest, reference)} the reference, "
                f"off by {cheapest['worst']['position']:.2g} R at most."
            )
    if reference["worst"]:
        close = [row["name"] for row in done if row["worst"]["position"] <= reference["worst"]["position"]]
        if close:
            lines.append(f"As close to the reference as that is known to be right: {_listed(close)}.")
    if reference["failure"]:
        lines.append(f"The reference ended at {reference['until']:.3g} {unit}, and all are compared up to there: {reference['failure']}")
    for row in rows:
        if row["failure"] and row["cost"] is None:
            lines.append(f"{row['name']} was refused: {row['failure']}")
        elif row["failure"]:
            lines.append(f"{row['name']} failed at {row['until']:.3g} {unit}: {row['failure']}")
    notes = dict.fromkeys(note for row in rows for note in row["notes"])
    return lines + [f"{_listed([row['name'] for row in rows if note in row['notes']])} ran with {note}." for note in notes]


def _about(found: Mapping[str, Any]) -> str:
    """The reference and how good it is."""
    reference, vesicles = found["reference"], found["vesicles"]
    text = f"{vesicles} vesicle{'s' * (vesicles != 1)} over {found['until']:.3g} {found['unit']}{'s' * (found['unit'] == 'unit of time')}"
    if not reference["worst"]:
        return f"{text}. The reference is {reference['name']}; its own error could not be estimated."
    error = reference["worst"]["position"]
    more = "" if error <= WANTED else f" That is more than {WANTED:.0%}: smaller errors say nothing; take a smaller step (--reference)."
    return f"{text}. The reference, {reference['name']}, is itself off by about {error:.2g} R: {reference['how']}.{more}"


def _times(row: Mapping[str, Any], reference: Mapping[str, Any]) -> str:
    ratio = reference["cost"]["cpu"] / max(row["cost"]["cpu"], 1e-300)
    return f"{ratio:.2g} times as fast as" if ratio >= 1 else f"{1 / ratio:.2g} times slower than"


def _listed(names: Sequence[str]) -> str:
    return " and ".join(filter(None, [", ".join(names[:-1]), names[-1]]))


def table(found: Mapping[str, Any]) -> str:
    """Errors at worst and costs, in Markdown, the reference first."""
    quantities, unit = list(found["meaning"]), found["unit"]
    head = ["rung", "N", "steps", *quantities, f"CPU s a {unit}", f"wall s a {unit}", "MB", ""]
    lines = ["| " + " | ".join(head) + " |", "|---|" + "---:|" * (len(head) - 2) + "---|"]
    for row in [found["reference"], *found["rungs"]]:
        worst, cost = row["worst"] or {}, row["cost"] or {}
        cells = [
            "reference" if row is found["reference"] else row["name"],
            row["nodes"],
            f"{row['steps']}" + (f" (+{row['rejected']})" if row["rejected"] else ""),
        ]
        cells += [_number(worst.get(name)) for name in quantities] + [_number(cost.get(name)) for name in COSTS]
        state = "its own error" if row is found["reference"] else "" if row["complete"] else f"until {row['until']:.3g} {unit}"
        cells += [f"{row['peak_bytes'] / 1e6:.0f}" if cost else None, "refused" if not cost else state]
        lines.append("| " + " | ".join("-" if cell is None else str(cell) for cell in cells) + " |")
    return "\n".join(lines)


def _number(value: float | None) -> str | None:
    return None if value is None else f"{value:.2g}"
