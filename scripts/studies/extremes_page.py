"""The page docs/extremes.md: all cases of the grid in tables, what was refused in words, and how large steps may be."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence

from studies.extremes_grid import RUNGS, Case
from studies.extremes_judge import FINISHED, ILL, REFUSED, SMALLER, Outcome
from studies.extremes_steps import ACCURATE, HORIZON, LEAST_STEPS, Measured

MARKS = {FINISHED: "finished", SMALLER: "smaller steps", REFUSED: "refused", ILL: "**ill-behaved**"}
TITLES = {
    "capillary": "Capillary number, two vesicles in shear; dt = 1e-5, of the exact rungs at most 0.02 t_gamma",
    "confinement": "Confinement R/W, one vesicle in a parabolic flow, Ca = 5",
    "reduced-area": "Reduced area, one vesicle in shear",
    "gap": "Gap over membrane length, two vesicles side by side in shear",
    "nodes": "Nodes a vesicle, two in shear",
    "vesicles": "Vesicles: one and two in shear, more fill 30 % of a parabolic flow, Ca = 2",
    "precision": "Precision of kernels, solves and sums",
    "far": "Centre of the suspension, in lengths",
    "clustered": "Nodes at alpha + a sin(alpha) instead of alpha, a =",
    "units": "Other units, two vesicles in shear",
    "steps": "Many steps",
    "input": "What a scene may be told wrongly, or unusually",
}
HEAD = """# Extremes

Made by `python scripts/extremes.py` (`--long` for the cases of minutes and hours) from its JSON files; not to be edited by hand.

Every rung is driven along one axis at a time away from two relaxed vesicles of reduced area 0.65 in shear (Ca = 5, N = 32, 40 steps of
dt = 1e-5 mu L^3/kappa_b = 0.024 t_gamma), or one of them. A case has *finished*; or *smaller steps* were needed: it was rejected, and
finished with adaptive ones, or with dt/4 or dt/16; or it was *refused* in one line, before the first step (exit code 2) or at a step
that could not be made (3), with all frames before it kept. Anything else is ill-behaved: a value that is not finite in a file, membranes
that cross, area or length that drift or are corrected uncounted, a traceback, a warning, more lines than one, no end within the bound.
Every file that a case left is checked, also of those refused.

Errors are the largest of positions and shapes (Hausdorff), in R, against a run of second order with half the step and more nodes, or
against what the page says beside them; networks make steps of 1e-5 and its multiples alone, also where that is many t_gamma.
"""


def page(found: Mapping[Case, Outcome | None], steps: Sequence[Measured]) -> str:
    """The page of all cases, with those that were not run named so."""
    outcomes = [outcome for outcome in found.values() if outcome]
    counted = Counter(outcome.outcome for outcome in outcomes)
    well = len(outcomes) - counted[ILL]
    summary = (
        f"{well} of {len(outcomes)} cases are well-behaved: {counted[FINISHED]} finished, {counted[SMALLER]} finished with smaller steps, "
        f"{counted[REFUSED]} were refused in one line; {counted[ILL]} are ill-behaved, {len(found) - len(outcomes)} were not run."
    )
    parts = [HEAD, summary, ""]
    for axis in dict.fromkeys(case.axis for case in found):
        cases = [case for case in found if case.axis == axis]
        parts += [f"## {TITLES[axis]}", "", *_matrix(cases, found), "", *_details(cases, found), ""]
    parts += _steps(steps)
    parts += ["## Refusals in words", "", *_lines(outcomes)]
    return "\n".join(parts).rstrip() + "\n"


def _matrix(cases: Sequence[Case], found: Mapping[Case, Outcome | None]) -> Iterable[str]:
    rungs = [rung for rung in RUNGS if any(case.rung == rung for case in cases)]
    yield _row(["", *rungs])
    yield _row(["---"] * (len(rungs) + 1))
    for value in dict.fromkeys(case.value for case in cases):
        by_rung = {case.rung: found[case] for case in cases if case.value == value}
        yield _row([value, *(_cell(by_rung.get(rung)) for rung in rungs)])


def _cell(outcome: Outcome | None) -> str:
    if outcome is None:
        return "not run"
    error = "" if outcome.error is None else f", {_number(outcome.error)} R"
    return MARKS[outcome.outcome] + error


def _details(cases: Sequence[Case], found: Mapping[Case, Outcome | None]) -> Iterable[str]:
    """A row of numbers for every case that finished."""
    rows = [(case, outcome) for case in cases if (outcome := found[case]) and outcome.outcome in (FINISHED, SMALLER)]
    if not rows:
        return
    names = ["", "rung", "steps", "error, R", "against", "drift of area", "of length", "largest correction", "corrected vesicles"]
    names += ["smallest step / dt", "rejected", "seconds", "peak MB"]
    yield "<details><summary>Numbers of those that finished</summary>\n"
    yield _row(names)
    yield _row(["---"] * len(names))
    for case, o in rows:
        corrected = o.counts.get("area_length_restored", 0) + o.counts.get("redistributed", 0)
        shrunk = None if o.smallest_step is None or not o.first_step else o.smallest_step / o.first_step
        how = "" if o.how == "as given" else f" ({o.how})"
        numbers = [_number(o.error), o.against, _number(o.area_drift), _number(o.length_drift), _number(o.largest_correction)]
        numbers += [f"{corrected:.0f}", _number(shrunk), f"{o.rejected:.0f}", _number(o.seconds), f"{o.peak_bytes / 1e6:.0f}"]
        yield _row([case.value + how, case.rung, f"{o.steps}", *numbers])
    yield "\n</details>"


def _steps(steps: Sequence[Measured]) -> list[str]:
    if not steps:
        return []
    rows = [["Ca", "N", "rung", "largest stable dt, t_gamma", f"largest within {ACCURATE:.0%} of R", "what ended it"], ["---"] * 6]
    for m in sorted(steps, key=lambda m: (m.ladder.capillary, m.ladder.points)):
        last = max(m.tried, key=lambda step: step.dt)
        why = "none did" if last.stable else _short(last.line)
        rows.append([f"{m.ladder.capillary:g}", f"{m.ladder.points}", m.ladder.rung, _number(m.stable), _number(m.accurate), why])
    bounded = sum("solver.max_error" in max(m.tried, key=lambda step: step.dt).line for m in steps)
    text = (
        f"Two vesicles in shear: dt was doubled until a run to {HORIZON:g} t_gamma, of {LEAST_STEPS} steps at least, broke; its positions "
        f"and shapes are held against steps of second order of 0.005 t_gamma at as many nodes. {bounded} of the {len(steps)} ladders end "
        "where a step, before it is corrected, errs by more in area or length than the run allows (solver.max_error): a bound that a scene "
        "may raise. Steps of networks are multiples of 1e-5 mu L^3/kappa_b, which at Ca = 50 is 0.24 t_gamma."
    )
    return ["## How large steps may be", "", text, "", "![Largest steps](images/extremes_steps.png)", "", *map(_row, rows), ""]


def _lines(outcomes: Sequence[Outcome]) -> Iterable[str]:
    """The line of every case that was not plainly finished."""
    yield _row(["case", "rung", "exit", "line"])
    yield _row(["---"] * 4)
    for o in outcomes:
        if o.line:
            code = next((a.code for a in o.attempts if a.line == o.line), 0)
            yield _row([f"{o.axis}: {o.value}", o.rung, f"{code}", o.line])
    for o in outcomes:
        for problem in o.problems:
            yield _row([f"{o.axis}: {o.value}", o.rung, "", f"**{problem}**"])


def _short(line: str) -> str:
    """What a rejected step says of why, without where and what to do."""
    return line.split(": ", 1)[-1].split(";")[0]


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.2g}"


def _row(cells: Sequence[str]) -> str:
    return "| " + " | ".join(cell.replace("|", "/") for cell in cells) + " |"
