"""The extremes: every rung driven along one axis at a time until it finishes, finishes with smaller steps, or refuses in one line.

python scripts/extremes.py                                      the small cases, then docs/extremes.md: a few seconds each
python scripts/extremes.py --only gap --solvers implicit,split  some of them
python scripts/extremes.py --only steps --only vesicles --long  1e5 steps of one vesicle, 10,000 vesicles: hours

Cases lie under -o, one JSON each with its runs; those that are there are not repeated. --again repeats what was refused or ill-behaved.
What the page says of cases that are not under -o comes from docs/extremes.json, where all outcomes are kept.
Exit codes: 0 all well-behaved, 2 bad input, 3 some are not.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer
from studies.extremes_grid import AXES, RUNGS, Case, grid, write_inputs
from studies.extremes_judge import ILL, Outcome, outcome_path, read_outcome, settle
from studies.extremes_kept import completed, keep
from studies.extremes_page import page
from studies.extremes_steps import AXIS as STEP_SIZES
from studies.extremes_steps import draw, ladders, measure, measured
from tqdm import tqdm

from biem.cli import fail, one_line_errors
from biem.run.files import write_atomically

app = typer.Typer(add_completion=False, pretty_exceptions_enable=False, help=__doc__)


@app.command()
def extremes(
    only: Annotated[list[str] | None, typer.Option(help=f"Axes: {', '.join((*AXES, STEP_SIZES))}.", metavar="AXIS")] = None,
    solvers: Annotated[str, typer.Option(help="Rungs, with commas.")] = ",".join(RUNGS),
    output: Annotated[Path, typer.Option("-o", "--output", help="Folder of the cases.")] = Path("out/extremes"),
    docs: Annotated[Path | None, typer.Option(help="Folder of the page extremes.md; default docs, none with --fast.")] = None,
    fast: Annotated[bool, typer.Option("--fast", help="The cases that the tests run.")] = False,
    long: Annotated[bool, typer.Option("--long", help="Also the cases of minutes and hours.")] = False,
    again: Annotated[bool, typer.Option("--again", help="Repeat what was refused or ill-behaved.")] = False,
) -> None:
    """Run the cases that are chosen, and write the page of all that are there."""
    with one_line_errors():
        axes, rungs = _chosen("--only", only or [*AXES, STEP_SIZES], (*AXES, STEP_SIZES)), _chosen("--solvers", solvers.split(","), RUNGS)
    write_inputs(output / "inputs")
    chosen = [c for c in grid() if c.axis in axes and c.rung in rungs and (c.fast if fast else long or not c.long)]
    ill = [outcome for outcome in _settled(chosen, output, again) if outcome.outcome == ILL]
    if STEP_SIZES in axes and not fast:
        for ladder in tqdm([ladder for ladder in ladders() if ladder.rung in rungs], desc="step sizes", unit="ladder"):
            measure(ladder, output, again)
    target = docs or (None if fast else Path("docs"))
    if target is not None:
        _write(target, output)
    for outcome in ill:
        typer.echo(f"{outcome.axis}, {outcome.value}, {outcome.rung}: {'; '.join(outcome.problems)}")
    if ill:
        fail(f"{len(ill)} of {len(chosen)} cases are ill-behaved", 3)


def _settled(cases: Sequence[Case], folder: Path, again: bool) -> list[Outcome]:
    with tqdm(cases, desc="cases", unit="case", dynamic_ncols=True) as bar:
        outcomes = []
        for case in bar:
            bar.set_postfix_str(case.name)
            outcomes.append(settle(case, folder, again))
    return outcomes


def _write(docs: Path, folder: Path) -> None:
    """The page and its figure, of all cases that are there, and of the others from extremes.json as the page before had them."""
    there = {case: read_outcome(outcome_path(case, folder)) for case in grid()}
    (docs / "images").mkdir(parents=True, exist_ok=True)
    found, steps = completed(there, measured(folder), docs / "extremes.json")
    keep(found, steps, docs / "extremes.json")
    if steps:
        draw(steps, docs / "images" / "extremes_steps.png")
    write_atomically(docs / "extremes.md", page(found, steps).encode())
    typer.echo(str(docs / "extremes.md"))


def _chosen(option: str, names: Sequence[str], known: Sequence[str]) -> list[str]:
    """The names, all of which are known. Raises ValueError."""
    names = [name.strip() for name in names]
    for name in names:
        if name not in known:
            raise ValueError(f'{option} "{name}": expected one of {", ".join(known)}')
    return names


if __name__ == "__main__":
    app()
