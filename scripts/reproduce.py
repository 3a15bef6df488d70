"""The paper's experiments, run by all rungs of the ladder, and docs/reproduction.md from what came out.

python scripts/reproduce.py near                                     # one experiment: results.json and pictures in out/reproduce/near
python scripts/reproduce.py poiseuille --solvers 'vesnet:hybrid'     # runs one rung now, takes the others as far as they are there
python scripts/reproduce.py taylor_green --collect                   # runs nothing: what there is of finished and unfinished runs
python scripts/reproduce.py all                                      # everything: days on two cores
python scripts/reproduce.py report                                   # docs/reproduction.md and its figures

A run that is finished is not repeated, one that was stopped goes on. The report keeps what it said of experiments that are not in -o.
"""

from __future__ import annotations

import shutil
from importlib import import_module
from pathlib import Path
from typing import Annotated

import typer
from reproductions.study import MISSING, ROOT, Results, Study
from studies.rungs import split_list

from biem.cli import one_line_errors
from biem.run.files import write_atomically

EXPERIMENTS = {
    "relaxation": "Relaxation of a shape outside the training set",
    "poiseuille": "One vesicle in Poiseuille flow",
    "shear": "Two vesicles in shear",
    "taylor_green": "32 vesicles in Taylor-Green flow",
    "scatter": "How far a count in Taylor-Green flow is determined",
    "near": "Near-singular integration",
    "errors": "Errors of the networks",
    "timing": "Seconds of a step",
    "dense": "2,000 vesicles in Poiseuille flow",
}
WITH_SOLVERS = tuple(name for name in EXPERIMENTS if name not in ("scatter", "near", "errors"))
HEAD = """# The paper's experiments

Each with what the paper says, what is found here, and why they differ; written by

```
python scripts/reproduce.py all        # or one of {names}
python scripts/reproduce.py report
```

A rung is a solver with its settings: "implicit" couples the vesicles implicitly (the paper's BIEM), "split" explicitly by exact operators,
built at 64 nodes for N = 32 where nothing else is said; "hybrid", "mlp" and "ivnet" are VesNet with corrected exact maps, shared trunks,
and one IVNet a mode. Runs that were rejected or are unfinished count up to where they are, and say so.
"""

app = typer.Typer(add_completion=False, pretty_exceptions_enable=False, help=__doc__)


@app.command()
def main(
    name: Annotated[str, typer.Argument(help=f"{', '.join(EXPERIMENTS)}, all or report.", metavar="NAME", show_default=False)],
    output: Annotated[Path, typer.Option("-o", "--output", help="Folder of runs and results.")] = Path("out/reproduce"),
    solvers: Annotated[str | None, typer.Option(help="Rungs to run now, between commas; default all.", metavar="RUNG,...")] = None,
    collect: Annotated[bool, typer.Option("--collect", help="Run nothing: results of what there is.")] = False,
    quick: Annotated[bool, typer.Option("--quick", help="A few steps of each run, in a folder of their own.")] = False,
    workers: Annotated[int, typer.Option(min=1, help="Runs at a time, each on one thread.")] = 1,
    device: Annotated[str, typer.Option(help="Of timing and dense: cpu or cuda.")] = "cpu",
    steps: Annotated[int | None, typer.Option(min=1, help="Of dense; default 200, 4,000 on a CUDA device.")] = None,
    docs: Annotated[Path, typer.Option(help="Of report: the folder that gets reproduction.md and images/.")] = ROOT / "docs",
) -> None:
    """Run an experiment, all, or write the report."""
    with one_line_errors():
        if name not in (*EXPERIMENTS, "all", "report"):
            raise ValueError(f'there is no experiment "{name}": expected one of {", ".join(EXPERIMENTS)}, all or report')
        for option, value, takers in (
            ("solvers", solvers, WITH_SOLVERS),
            ("steps", steps, ("dense",)),
            ("device", device, ("timing", "dense")),
        ):
            if value not in (None, "cpu") and name not in (*takers, "all"):
                raise ValueError(f"--{option} goes with {', '.join(takers)} or all: {name} has none")
        rungs = None if solvers is None else tuple(split_list(solvers))
        study = Study(output, rungs, collect or name == "report", quick, workers, device, steps)
        if name == "report":
            typer.echo(str(report(study, docs)))
            return
        for chosen in EXPERIMENTS if name == "all" else [name]:
            results = import_module(f"reproductions.{chosen}").measure(study)
            if results:
                typer.echo(f"## {EXPERIMENTS[chosen]}\n\n{import_module(f'reproductions.{chosen}').section(results)}\n")
            typer.echo(str(study.folder(chosen)))


def report(study: Study, docs: Path) -> Path:
    """reproduction.md, with the pictures in images/, of what there is of all experiments; of the others as it was."""
    images, path = docs / "images", docs / "reproduction.md"
    images.mkdir(parents=True, exist_ok=True)
    before = _sections(path.read_text() if path.exists() else "")
    parts = [HEAD.format(names=", ".join(EXPERIMENTS))]
    for name, title in EXPERIMENTS.items():
        module = import_module(f"reproductions.{name}")
        results: Results = module.measure(study)
        head = f"## {title}\n\n`python scripts/reproduce.py {name}`\n"
        if _empty(results):
            parts.append(before.get(title, f"{head}\nNot run yet.\n"))
            continue
        parts.append(head)
        pictures = []
        for picture in results["pictures"]:
            target = images / f"reproduction_{name}_{picture}"
            shutil.copyfile(study.folder(name) / picture, target)
            pictures.append(f"![{title}](images/{target.name})")
        parts.append("\n\n".join([module.section(results), *pictures]) + "\n")
    write_atomically(path, "\n".join(parts).encode())
    return path


def _empty(results: Results) -> bool:
    """Whether nothing of an experiment was run."""
    rows = results.get("rows", {})
    states = [row.get("state") for row in (rows.values() if isinstance(rows, dict) else rows)]
    return not results or (bool(states) and set(states) == {MISSING})


def _sections(page: str) -> dict[str, str]:
    """The parts of the page by their titles."""
    parts = [f"## {part}" for part in page.split("\n## ")[1:]]
    return {part.partition("\n")[0].removeprefix("## "): part for part in parts}


if __name__ == "__main__":
    app()
