"""docs/extremes.json: what all cases and ladders came to, for the page where only some of them are run again."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path

from biem.run.files import write_atomically
from studies.extremes_grid import Case
from studies.extremes_judge import Outcome, outcome_of
from studies.extremes_steps import Ladder, Measured, measured_of

Outcomes = dict[Case, Outcome | None]


def completed(found: Mapping[Case, Outcome | None], steps: Sequence[Measured], path: Path) -> tuple[Outcomes, list[Measured]]:
    """What was found, and of the rest what the file says."""
    if not path.exists():
        return dict(found), list(steps)
    table = json.loads(path.read_text())
    before = {(o.axis, o.value, o.rung): o for o in map(outcome_of, table["cases"])}
    ladders: dict[Ladder, Measured] = {m.ladder: m for m in (*map(measured_of, table["steps"]), *steps)}
    return {case: outcome or before.get((case.axis, case.value, case.rung)) for case, outcome in found.items()}, list(ladders.values())


def keep(found: Mapping[Case, Outcome | None], steps: Sequence[Measured], path: Path) -> None:
    """Writes the file, a line a case; without the scenes, which the grid gives."""
    cases = [json.dumps(_without_scenes(asdict(outcome))) for outcome in found.values() if outcome]
    lines = ['{"cases": [', ",\n".join(cases), '], "steps": [', ",\n".join(json.dumps(asdict(m)) for m in steps), "]}\n"]
    write_atomically(path, "\n".join(lines).encode())


def _without_scenes(table: dict) -> dict:
    return {**table, "attempts": [{**attempt, "scene": ""} for attempt in table["attempts"]]}
