"""Command line: python -m biem run | plan | plot | verify. Exit codes: 0 done, 2 bad input, 3 step rejected, 4 stopped, 5 file error."""

from __future__ import annotations

import json
import time
from collections import Counter
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from tqdm import tqdm

from biem.backend import fft_backend, threads
from biem.cli import fail, first_rank_only, one_line_errors
from biem.curves.curve import area, length
from biem.ranks import Ranks, world
from biem.run.simulate import simulate
from biem.run.solver import make_stepper, on_device
from biem.run.trajectory import Trajectory, read_trajectory
from biem.scene.accuracy import describe
from biem.scene.build import Problem, build
from biem.scene.config import Scene, load_scene
from biem.scene.plan import memory_estimate, required_parts, trajectory_bytes
from biem.steppers.stepper import State

WALL_SECONDS = 2.5e-10  # to factorise walls, per cube of their nodes, on one core (docs/measurements.md)
LONGEST_MEASUREMENT = 20.0  # s

app = typer.Typer(no_args_is_help=True, add_completion=False, pretty_exceptions_enable=False, help=__doc__)

ScenePath = Annotated[Path, typer.Argument(help="Scene file (TOML).", metavar="SCENE", show_default=False)]
Overrides = Annotated[list[str] | None, typer.Option("--set", help="Override a key: --set vesicles.points=32.", metavar="KEY=VALUE")]
SolverName = Annotated[str | None, typer.Option("--solver", help="Override solver.kind.")]
AccuracyName = Annotated[str | None, typer.Option("--accuracy", help="A preset for the scene's: fast, balanced or reference.")]
WeightsFolder = Annotated[Path | None, typer.Option("--weights", help="Override solver.weights: a folder.", metavar="DIR")]
TrajectoryPath = Annotated[Path, typer.Argument(help="Trajectory (HDF5).", metavar="TRAJECTORY", show_default=False)]


@app.command()
def run(
    scene: ScenePath,
    output: Annotated[Path | None, typer.Option("-o", "--output", help="Trajectory to write; default out/NAME.h5.")] = None,
    solver: SolverName = None,
    resume: Annotated[bool, typer.Option("--resume", help="Go on from the checkpoint beside the output.")] = False,
    force: Annotated[bool, typer.Option("--force", help="Replace an output that exists.")] = False,
    quiet: Annotated[bool, typer.Option("--quiet", help="No progress bar, no summary.")] = False,
    accuracy: AccuracyName = None,
    weights: WeightsFolder = None,
    overrides: Overrides = None,
) -> None:
    """Run a scene to its horizon; under mpirun, its vesicles shared among the processes."""
    with one_line_errors():
        ranks = world()
    with one_line_errors(ranks):
        loaded = ranks.together(lambda: _load(scene, solver, accuracy, weights, overrides))
        path = output or Path(loaded.output.trajectory or f"out/{loaded.name}.h5")
        notices = ranks.on_root(lambda: build(loaded).notices if loaded.vesicles.file else ())
        for notice in notices if ranks.rank == 0 else ():
            typer.echo(f"notice: {notice}", err=True)
        done = simulate(loaded, path, resume=resume, force=force, progress=not quiet, ranks=ranks)
        if not quiet and ranks.rank == 0:
            typer.echo(_summary(done.trajectory, path, done.counts, ranks))


@app.command()
def plan(
    scene: ScenePath,
    solver: SolverName = None,
    measure: Annotated[bool, typer.Option(help="Time two steps for the estimate.")] = True,
    accuracy: AccuracyName = None,
    weights: WeightsFolder = None,
    overrides: Overrides = None,
) -> None:
    """Print what a scene requires, and why, with memory, file size and time."""
    first_rank_only()
    with one_line_errors():
        problem = build(_load(scene, solver, accuracy, weights, overrides))
        M, _, N = problem.X.shape
        adaptive = problem.scene.time.adaptive
        steps = "adaptive steps, their number not known, the first one of" if adaptive else f"{problem.steps} steps of"
        typer.echo(f"{problem.scene.name}: {M} vesicle(s) of {N} nodes, {steps} dt = {problem.dt:.6g}{_in_flow_times(problem)}")
        for line in describe(problem.scene.model_dump()):
            typer.echo(line)
        parts = required_parts(problem)
        wide = max(len(p.name) for p in parts)
        for part in parts:
            typer.echo(f"  {'yes' if part.needed else ' - '}  {part.name:<{wide}}  {part.why}")
        typer.echo(f"memory of a step: {memory_estimate(problem) / 1e6:.0f} MB; trajectory: {trajectory_bytes(problem) / 1e6:.1f} MB")
        factorization = 0.0 if problem.walls is None else WALL_SECONDS * len(problem.walls.nodes) ** 3 / threads()
        if factorization > LONGEST_MEASUREMENT:
            typer.echo(f"time: the walls take about {_clock(factorization)} to factorise, once; steps are not measured")
        elif measure:
            seconds = _seconds_a_step(problem)
            total = "if all are as long as the first one" if adaptive else "in all"
            typer.echo(f"time: {seconds:.3g} s a step here, about {_clock(seconds * problem.steps)} {total}")


@app.command()
def plot(
    trajectory: TrajectoryPath,
    output: Annotated[Path | None, typer.Option("-o", "--output", help="Folder; default the trajectory's name.")] = None,
    movie: Annotated[bool, typer.Option(help="Draw the movie.")] = True,
) -> None:
    """Draw frames, energies, errors and a movie."""
    first_rank_only()
    with one_line_errors():
        from biem.run.plot import draw_all  # matplotlib loads slowly: only where it is needed

        folder = output or trajectory.with_suffix("")
        for file in draw_all(read_trajectory(trajectory), folder, movie, lambda frames: tqdm(frames, desc="movie", leave=False)):
            typer.echo(str(file))


@app.command()
def verify(trajectory: TrajectoryPath) -> None:
    """Check a trajectory file: schema, finite values, areas and lengths, crossings, energies."""
    from biem.run.verify import verify as check_all

    first_rank_only()
    with one_line_errors():
        checks = check_all(read_trajectory(trajectory))
        for check in checks:
            typer.echo(f"{'ok    ' if check.passed else 'FAILED'}  {check.name}: {check.detail}")
        failed = sum(not check.passed for check in checks)
        if failed:
            fail(f"{failed} of {len(checks)} checks failed on {trajectory}", 3)


def _load(path: Path, solver: str | None, accuracy: str | None, weights: Path | None, overrides: list[str] | None) -> Scene:
    settings = list(overrides or [])
    if solver:
        settings.append(f'solver.kind="{solver}"')
    if weights is not None:
        settings.append(f"solver.weights={json.dumps(str(weights.absolute()), ensure_ascii=False)}")
    return load_scene(path, settings, accuracy)


def _in_flow_times(problem: Problem) -> str:
    unit = problem.flow.time_scale
    return f" ({problem.dt / unit:.4g} t_gamma) to {problem.horizon / unit:.4g} t_gamma" if unit else f" to t = {problem.horizon:.6g}"


def _seconds_a_step(problem: Problem) -> float:
    """Wall time of the second of two steps: the first one compiles and plans."""
    stepper = make_stepper(problem, area(problem.X), length(problem.X))
    with fft_backend(problem.X.size):
        state = stepper.step(on_device(State(0.0, problem.X), problem.scene), problem.dt).state
        begin = time.perf_counter()
        stepper.step(state, problem.dt)
        return time.perf_counter() - begin


def _clock(seconds: float) -> str:
    if seconds < 120:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 7200 else f"{seconds / 3600:.1f} h"


def _summary(trajectory: Trajectory, path: Path, counts: Counter[str], ranks: Ranks) -> str:
    d = trajectory.diagnostics
    seconds = float((d["wall_seconds"][1:] * np.diff(trajectory.step)).sum())
    lines = [
        f"{len(trajectory)} frames to t = {trajectory.t[-1]:.6g} in {_clock(seconds)} of stepping: {path}",
        f"largest error of a step, before correction: area {d['area_error'].max():.1e}, length {d['length_error'].max():.1e}",
    ]
    if trajectory.X.shape[1] > 1:
        gmres = d["gmres_iterations"].max()
        lines.append(f"smallest gap {d['min_gap'].min():.4g}" + (f"; at most {gmres:.0f} GMRES iterations a step" if gmres else ""))
    if "out_of_distribution" in d:
        outside, exact = d["out_of_distribution"].max(), d.get("by_exact_maps", np.zeros(1)).max()
        lines.append(f"outside the training distribution: at most {outside:.0f} of {trajectory.X.shape[1]} vesicles in a step")
        lines[-1] += f"; by exact maps: at most {exact:.0f}" if exact else ""
    lines.append("used: " if ranks.size == 1 else f"used by the first of {ranks.size} processes: ")
    lines[-1] += ", ".join(f"{name} {n}" for name, n in sorted(counts.items()))
    return "\n".join(lines)


if __name__ == "__main__":
    app()
