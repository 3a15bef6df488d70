"""Command line: python -m surrogate train | merge | evaluate | grid | run. Exit codes: 0 done, 2 bad input, 3 failure, 4 stop, 5 files."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Annotated

import torch
import typer

import biem.__main__ as biem_cli
from biem.cli import first_rank_only, one_line_errors, read_part
from biem.ranks import Ranks, world
from biem.run.solver import check_device
from surrogate.config import Training, load_training
from surrogate.evaluation import PARTS, Options, evaluate
from surrogate.grid import grid_table, variants
from surrogate.jobs import Work, cost, dealt, pick, pick_all
from surrogate.library import KINDS
from surrogate.merge import merge
from surrogate.pairs import open_pairs
from surrogate.train import train

app = typer.Typer(no_args_is_help=True, add_completion=False, pretty_exceptions_enable=False, help=__doc__)

Data = Annotated[list[Path], typer.Option("--data", help="File of pairs; may be given several times, later ones go before earlier ones.")]
Output = Annotated[Path, typer.Option("-o", "--output", help="Folder of the runs.")]
Config = Annotated[Path | None, typer.Option("--config", help="Settings (TOML), such as configs/train/mlp.toml.", metavar="CONFIG")]
Overrides = Annotated[list[str] | None, typer.Option("--set", help="Override a key: --set training.samples=1000.", metavar="KEY=VALUE")]
Device = Annotated[str, typer.Option("--device", help='"cpu" or "cuda".')]
Part = Annotated[str | None, typer.Option("--part", help="K/P: of P processes that share the work, this is the K-th.")]
Quiet = Annotated[bool, typer.Option("--quiet", help="No progress bars.")]
Name = Annotated[str | None, typer.Option("--map", help="relax, self_tension, advection, flow_tension or near.")]
Arch = Annotated[str | None, typer.Option("--arch", help="Override network.arch: ivnet or mlp.")]
Target = Annotated[str | None, typer.Option("--target", help="Override network.target: full, or residual.")]


@app.command("train")
def train_command(
    data: Data,
    output: Output = Path("out/train"),
    name: Name = None,
    mode: Annotated[int | None, typer.Option("--mode", help="One Fourier mode of an IVNet; default all.")] = None,
    every: Annotated[bool, typer.Option("--all", help="Every map and mode.")] = False,
    config: Config = None,
    arch: Arch = None,
    target: Target = None,
    grouped: Annotated[bool, typer.Option("--grouped", help="All modes of a map at once, as one grouped network (GPU).")] = False,
    device: Device = "cpu",
    part: Part = None,
    quiet: Quiet = False,
    overrides: Overrides = None,
) -> None:
    """Train networks, or go on; under mpirun, or as a job array with --part, one network after another on each process."""
    with one_line_errors():
        ranks = world()
    with one_line_errors(ranks):
        settings = ranks.together(lambda: load_training(config, _overrides(arch, target, overrides)))
        pairs = ranks.on_root(lambda: [open_pairs(path) for path in data])
        if every == (name is not None) or (every and mode is not None):
            raise ValueError("give either --map, with or without --mode, or --all")
        works = pick_all(settings, pairs, output, grouped) if every else pick(settings, pairs, output, str(name), mode, grouped)
        k, parts = _share(ranks, part)
        for work in dealt(works, partial(cost, settings), parts)[k - 1]:
            _train(work, settings, device, quiet)


@app.command("merge")
def merge_command(
    runs: Annotated[list[Path], typer.Argument(help="Folders of runs, or files of weights.", metavar="RUN...", show_default=False)],
    output: Annotated[Path, typer.Option("-o", "--output", help="Folder of weights.")],
    half: Annotated[bool, typer.Option(help="Weights in 16 bits.")] = True,
) -> None:
    """Collect runs in a folder of weights: the modes of a map as one network, batch norms folded away."""
    first_rank_only()
    with one_line_errors():
        for path in merge(runs, output, half):
            typer.echo(f"{path}  {path.stat().st_size / 1e6:.2f} MB")


@app.command("evaluate")
def evaluate_command(
    data: Annotated[Path, typer.Option("--data", help="File of pairs: its test runs are evaluated.")],
    output: Annotated[Path, typer.Option("-o", "--output", help="Folder of tables and pictures.")] = Path("out/evaluate"),
    flow: Annotated[list[Path] | None, typer.Option("--flow", help="Pairs of relax by the converged flow, one for each time step.")] = None,
    taylor_green: Annotated[Path | None, typer.Option(help="Pairs of another suspension (scripts/taylor_green_shapes.py).")] = None,
    shapes: Annotated[Path | None, typer.Option(help="What the pairs are of, resolved; default shapes.h5 beside them.")] = None,
    weights: Annotated[Path | None, typer.Option("--weights", help="Folder of weights; default those that are shipped.")] = None,
    kinds: Annotated[str, typer.Option(help="Which maps.")] = ",".join(KINDS),
    only: Annotated[str, typer.Option(help="Which parts.")] = ",".join(PARTS),
    smoke: Annotated[bool, typer.Option("--smoke", help="Few shapes, few steps: seconds.")] = False,
    quiet: Quiet = False,
) -> None:
    """Errors of maps on held-out runs, of real velocities, of 100 relaxation steps, and what they cost, beside exact maps at few nodes."""
    first_rank_only()
    with one_line_errors():
        torch.set_num_threads(1)
        beside = data.parent / "shapes.h5"
        options = Options(
            data=data,
            out=output,
            flows=tuple(flow or ()),
            shapes=shapes or (beside if beside.exists() else None),
            taylor_green=taylor_green,
            weights=weights,
            kinds=tuple(kinds.split(",")),
            only=tuple(only.split(",")),
            quiet=quiet,
        )
        if smoke:
            options = replace(options, samples=8, velocity_shapes=4, relaxation_shapes=2, steps=3, counts=(2,), rounds=1)
        typer.echo(evaluate(options).text)


@app.command("grid")
def grid_command(
    data: Data,
    name: Annotated[str, typer.Option("--map")],
    output: Output = Path("out/grid"),
    mode: Annotated[int | None, typer.Option("--mode")] = None,
    blocks: Annotated[str, typer.Option(help="Values, as 1,2,4.")] = "1,2,4",
    widths: Annotated[str, typer.Option(help="Values, as 16,32.")] = "16,32",
    levels: Annotated[str, typer.Option(help="Values, as 1,2,3.")] = "1,2,3",
    config: Config = None,
    device: Device = "cpu",
    part: Part = None,
    quiet: Quiet = False,
    overrides: Overrides = None,
) -> None:
    """Train IVNets of all combinations of n_b, w and L on one map and mode, and print a table of what they cost and reach."""
    with one_line_errors():
        ranks = world()
    with one_line_errors(ranks):
        settings = ranks.together(lambda: load_training(config, overrides or []))
        pairs = ranks.on_root(lambda: [open_pairs(path) for path in data])
        chosen = variants(settings.of(name), blocks, widths, levels)
        works = [(pick(one, pairs, output / label, name, mode), one) for label, one in chosen.items()]
        k, parts = _share(ranks, part)
        for jobs, one in works[k - 1 :: parts]:
            for work in jobs:
                _train(work, one, device, quiet)
        ranks.any(False)  # all are there
        if ranks.rank == 0 and part is None:
            typer.echo(grid_table(output, chosen))


@app.command("run")
def run_command(
    scene: biem_cli.ScenePath,
    output: Annotated[Path | None, typer.Option("-o", "--output", help="Trajectory to write; default out/NAME.h5.")] = None,
    weights: Annotated[Path | None, typer.Option("--weights", help="Folder of weights; default those that are shipped.")] = None,
    maps: Annotated[str | None, typer.Option("--maps", help="ivnet, mlp, hybrid or exact, for all maps.")] = None,
    resume: Annotated[bool, typer.Option("--resume", help="Go on from the checkpoint beside the output.")] = False,
    force: Annotated[bool, typer.Option("--force", help="Replace an output that exists.")] = False,
    quiet: Quiet = False,
    overrides: Overrides = None,
) -> None:
    """Run a scene by VesNet: `python -m biem run --solver vesnet`."""
    chosen = [*(overrides or []), *([f'solver.maps="{maps}"'] if maps else [])]
    biem_cli.run(scene, output, "vesnet", resume, force, quiet, weights=weights, overrides=chosen)


def _overrides(arch: str | None, target: str | None, overrides: list[str] | None) -> list[str]:
    named = {"network.arch": arch, "network.target": target}
    return [*(overrides or []), *(f'{key}="{value}"' for key, value in named.items() if value is not None)]


def _share(ranks: Ranks, part: str | None) -> tuple[int, int]:
    """(K, P): of P processes, this is the K-th, from 1."""
    if part is None:
        return ranks.rank + 1, ranks.size
    if ranks.size > 1:
        raise ValueError("--part is for processes that do not know each other: leave it out under mpirun")
    return read_part(part)


def _train(work: Work, settings: Training, device: str, quiet: bool) -> None:
    if device == "cpu":
        torch.set_num_threads(1)  # networks are small: a second thread costs more than it gives
    else:
        check_device(device, "--device")
    job, pairs = work
    path = train(settings, job, pairs, device=device, progress=not quiet)
    if not quiet:
        typer.echo(str(path))


if __name__ == "__main__":
    app()
