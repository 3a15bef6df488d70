"""Solvers on one scene: how far they are from a reference run, and what they cost; a page that shows it.

python scripts/compare.py configs/scenes/shear_pair.toml
python scripts/compare.py scene.toml --solvers "split[time.order=2, vesicles.points=32], vesnet:mlp, fast" -o out/mine --set vesicles.seed=3

A rung is a solver, with settings of its own in brackets, or a preset (fast, balanced, reference). Networks get the nodes and the steps that
they were trained for. The reference is implicit with 128 nodes, order 2 and small steps, unless --reference names another rung; a second
run of it at twice the step tells its own error. Finished runs are kept: a second call takes seconds, and one that was stopped goes on.

Into the folder: report.html (one file, nothing from outside), compare.json, error_time.png, paths.png, membranes.png, and the trajectories.
Exit codes: 0 done, 2 bad input, 3 the reference failed, 4 stopped, 5 file error.
"""

from __future__ import annotations

import json
import os
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer
from studies.compared import Compared, Ran, compare, results, table
from studies.fitting import Entry, coarser, entry, reference_name
from studies.rungs import split_list
from studies.runs import Kept, kept_all

from biem.cli import one_line_errors
from biem.errors import NumericalFailure
from biem.run.files import write_atomically
from biem.run.simulate import Stopped
from biem.scene.build import build

DEFAULT = "implicit, split, fast, balanced, vesnet:hybrid, vesnet:mlp, vesnet:ivnet"


def main(
    scene: Annotated[Path, typer.Argument(help="Scene file (TOML).", metavar="SCENE", show_default=False)],
    solvers: Annotated[str, typer.Option(help="Rungs, with commas between them.", metavar="RUNG,...")] = DEFAULT,
    output: Annotated[Path | None, typer.Option("-o", "--output", help="Folder; default out/compare/SCENE.", metavar="DIR")] = None,
    overrides: Annotated[
        list[str] | None, typer.Option("--set", help="Override a key for all rungs: --set vesicles.seed=3.", metavar="KEY=VALUE")
    ] = None,
    weights: Annotated[Path | None, typer.Option(help="Folder of weights; default the shipped ones.", metavar="DIR")] = None,
    reference: Annotated[str | None, typer.Option(help="The rung that the others are held against.", metavar="RUNG")] = None,
    workers: Annotated[int | None, typer.Option(help="Runs at a time; default one for every --threads cores.", min=1)] = None,
    threads: Annotated[int, typer.Option(help="Threads of a run.", min=1)] = 1,
) -> None:
    """Compare solvers on one scene: errors against a reference, costs, and a page that shows them."""
    with one_line_errors():
        settings = overrides or []
        wanted = reference or reference_name(scene, settings)
        truth = entry(scene, wanted, settings, weights)
        if truth.refused:
            raise ValueError(f"the reference {truth.name} is refused: {truth.refused}")
        rungs = [entry(scene, name, settings, weights) for name in _names(solvers)]
        coarse, factor, how = coarser(scene, wanted, settings, weights)
        folder = output or Path("out/compare") / scene.stem
        folder.mkdir(parents=True, exist_ok=True)
        runs = _run(
            folder, [("reference-run", truth), ("reference-run-coarser", coarse), *((e.rung.file, e) for e in rungs)], workers, threads
        )
        try:
            compared = compare(
                Ran(truth, runs[0]), [Ran(*pair) for pair in zip(rungs, runs[2:], strict=True)], Ran(coarse, runs[1]), factor, how
            )
        except ValueError as error:
            raise NumericalFailure(str(error)) from None
        typer.echo(_written(compared, folder, scene))


def _names(solvers: str) -> list[str]:
    names = split_list(solvers)
    twice = [name for name, n in Counter(names).items() if n > 1]
    if not names or twice:
        raise ValueError(
            f'--solvers "{solvers}": ' + (f"{twice[0]} is there twice" if twice else 'expected rungs, as in "implicit, split"')
        )
    return names


def _run(folder: Path, entries: Sequence[tuple[str, Entry]], workers: int | None, threads: int) -> list[Kept | None]:
    """The runs in the order of the entries, the longest first to begin. What was refused last time is tried anew. Raises Stopped."""
    tasks = {}
    for file, e in sorted(entries, key=lambda pair: -pair[1].work):
        path = folder / f"{file}.h5"
        if not e.refused:
            _forget_refusal(path.with_suffix(".json"))
            tasks[file] = (e.rung.scene, path)
    cores = len(os.sched_getaffinity(0))
    try:
        runs = kept_all(tasks, workers or max(1, cores // threads), threads, desc="runs")
    except KeyboardInterrupt:
        raise Stopped("stopped; the same command goes on") from None
    except RuntimeError as error:  # a process that died without a word of its own
        raise NumericalFailure(str(error)) from None
    return [runs.get(file) for file, _ in entries]


def _forget_refusal(record: Path) -> None:
    """Weights may be there now that were not."""
    try:
        found = json.loads(record.read_text())
        refused = bool(found["failure"]) and found["steps"] == 0
    except (FileNotFoundError, json.JSONDecodeError, KeyError):
        return
    if refused:
        record.unlink()


def _written(compared: Compared, folder: Path, scene: Path) -> str:
    """What goes to the terminal; the files are made."""
    from studies.pictures import draw_all  # matplotlib loads slowly
    from studies.report import page

    found = {"scene": scene.stem} | results(compared, build(compared.reference.entry.rung.scene).horizon)
    write_atomically(folder / "compare.json", json.dumps(found, indent=1).encode())
    draw_all(compared, found, folder)
    write_atomically(folder / "report.html", page(compared, found).encode())
    return "\n\n".join([table(found), "\n".join(found["summary"]), str(folder / "report.html")])


if __name__ == "__main__":
    app = typer.Typer(add_completion=False, pretty_exceptions_enable=False)
    app.command(help=__doc__)(main)
    app()
