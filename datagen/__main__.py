"""Command line: python -m datagen harvest | select | label | make | verify, of a data set file (TOML). Also under mpirun and srun.

A second run makes what is missing. Exit codes: 0 done, 2 bad input, 3 tasks or checks failed, 4 stopped by a signal, 5 file error.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated

import typer

from biem.cli import fail, first_rank_only, one_line_errors
from biem.ranks import world
from datagen.config import load_dataset
from datagen.jobs import one_thread
from datagen.manifest import WHOLE, Part
from datagen.stages import Session, harvest_stage, label_stage, select_stage
from datagen.stop import EXIT_CODE, Stopped, stoppable

app = typer.Typer(no_args_is_help=True, add_completion=False, pretty_exceptions_enable=False, help=__doc__)

ConfigPath = Annotated[Path, typer.Argument(help="Data set file (TOML).", metavar="CONFIG", show_default=False)]
Output = Annotated[Path | None, typer.Option("-o", "--output", help="Data folder; default data/NAME.")]
Overrides = Annotated[list[str] | None, typer.Option("--set", help="Override a key: --set label.points=64.", metavar="KEY=VALUE")]
PartOf = Annotated[str | None, typer.Option("--part", help="Make the K-th of P parts, for job arrays.", metavar="K/P")]
Force = Annotated[bool, typer.Option("--force", help="Start anew, remove what is there.")]
Quiet = Annotated[bool, typer.Option("--quiet", help="No progress bar, no summary.")]
Device = Annotated[str | None, typer.Option("--device", help="Override simulation.device.")]
Maps = Annotated[str | None, typer.Option("--maps", help="Override label.maps: --maps relax,advection.", metavar="A,B")]
Name = Annotated[str, typer.Option("--name", help="Of this set of labels, beside others of the same shapes: labels-NAME, pairs-NAME.h5.")]
Modes = Annotated[str | None, typer.Option("--modes", help="Override label.modes: --modes 0,1,2 or 0-4.", metavar="K,L-M")]


@app.command()
def harvest(
    config: ConfigPath,
    output: Output = None,
    part: PartOf = None,
    device: Device = None,
    force: Force = False,
    quiet: Quiet = False,
    overrides: Overrides = None,
) -> None:
    """Compute the runs, and take shapes along the way: DATA/harvest/."""
    _stages([harvest_stage], config, output, overrides, part=part, device=device, force=force, quiet=quiet)


@app.command()
def select(config: ConfigPath, output: Output = None, force: Force = False, quiet: Quiet = False, overrides: Overrides = None) -> None:
    """Drop shapes that are nearly the same, split the others by run: DATA/shapes.h5."""
    _stages([select_stage], config, output, overrides, force=force, quiet=quiet)


@app.command()
def label(
    config: ConfigPath,
    output: Output = None,
    name: Name = "",
    part: PartOf = None,
    maps: Maps = None,
    modes: Modes = None,
    force: Force = False,
    quiet: Quiet = False,
    overrides: Overrides = None,
) -> None:
    """Make the training pairs of the shapes: DATA/labels/, joined in DATA/pairs.h5."""
    _stages([label_stage], config, output, overrides, name=name, part=part, maps=maps, modes=modes, force=force, quiet=quiet)


@app.command()
def make(
    config: ConfigPath,
    output: Output = None,
    device: Device = None,
    maps: Maps = None,
    modes: Modes = None,
    force: Force = False,
    quiet: Quiet = False,
    overrides: Overrides = None,
) -> None:
    """Harvest, select and label."""
    stages = [harvest_stage, select_stage, label_stage]
    _stages(stages, config, output, overrides, device=device, maps=maps, modes=modes, force=force, quiet=quiet)


@app.command()
def verify(
    data: Annotated[Path, typer.Argument(help="Data folder.", metavar="DATA", show_default=False)],
    seed: Annotated[int, typer.Option(help="Of the choice of the labels that are computed again.")] = 0,
    fraction: Annotated[float, typer.Option(help="Of the labels that are computed again.", min=0, max=1)] = 0.01,
    quiet: Quiet = False,
) -> None:
    """Check manifests, files, values and splits, and compute some of the labels again."""
    from datagen.verify import verify as check

    first_rank_only()
    with one_line_errors(), one_thread():
        checked = check(data, seed, fraction, progress=not quiet)
        for problem in checked.problems:
            typer.echo(f"FAILED  {problem}")
        if not quiet:
            for line in checked.found:
                typer.echo(f"ok      {line}")
        if checked.problems:
            fail(f"{len(checked.problems)} problem(s) in {data}", 3)


def _stages(
    stages: Sequence[Callable[[Session], None]],
    path: Path,
    output: Path | None,
    overrides: list[str] | None,
    *,
    name: str = "",
    part: str | None = None,
    device: str | None = None,
    maps: str | None = None,
    modes: str | None = None,
    force: bool,
    quiet: bool,
) -> None:
    with one_line_errors():
        ranks = world()

    def begin() -> Session:
        changes = list(overrides or [])
        if device is not None:
            changes.append(f"simulation.device={json.dumps(device)}")
        if maps is not None:
            changes.append(f"label.maps={json.dumps([name.strip() for name in maps.split(',')])}")
        if modes is not None:
            changes.append(f"label.modes={json.dumps(parse_modes(modes))}")
        config = load_dataset(path, changes)
        data = output or Path("data") / config.name
        return Session(config, data, WHOLE if part is None else Part.parse(part), force, quiet or ranks.rank > 0, ranks, name)

    def run() -> None:
        session = begin()
        for stage in stages:
            stage(session)

    with one_line_errors(ranks), one_thread(), stoppable():
        try:
            ranks.together(run)
        except Stopped as stopped:
            fail(f"{stopped}; run the same command again to go on", EXIT_CODE, ranks)


def parse_modes(text: str) -> list[int]:
    """Of "0,1,2", "0-4" or both. Raises ValueError."""
    modes: list[int] = []
    for piece in text.split(","):
        first, dash, last = (number.strip() for number in piece.partition("-"))
        if not first.isdecimal() or (dash and not (last.isdecimal() and int(last) >= int(first))):
            raise ValueError(f'--modes {text}: expected numbers and ranges, as in "0,1,2" or "0-4,8"')
        modes += range(int(first), int(last or first) + 1)
    return modes


if __name__ == "__main__":
    app()
