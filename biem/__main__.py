"""Command line: biem new | plan | run | plot | observe | field | export | verify | doctor, or python -m biem.

Exit codes: 0 done, 2 bad input, 3 step rejected or check failed, 4 stopped, 5 file error.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer
from tqdm import tqdm

from biem import __version__
from biem.cli import fail, first_rank_only, one_line_errors
from biem.observe.tracers import place_tracers
from biem.ranks import world
from biem.run import reports
from biem.run.files import make_folder, write_atomically
from biem.run.observe import observe_file, observer_of_run
from biem.run.simulate import simulate
from biem.run.trajectory import read_trajectory
from biem.scene.accuracy import PRESETS
from biem.scene.build import build
from biem.scene.config import Scene, load_scene
from biem.scene.new import scene_names, scene_text

app = typer.Typer(no_args_is_help=True, pretty_exceptions_enable=False, help=__doc__)

ScenePath = Annotated[Path, typer.Argument(help="Scene file (TOML).", metavar="SCENE", show_default=False)]
Overrides = Annotated[list[str] | None, typer.Option("--set", help="Override a key: --set vesicles.points=32.", metavar="KEY=VALUE")]
SolverName = Annotated[
    str | None, typer.Option("--solver", help="Override solver.kind.", autocompletion=lambda: ["implicit", "split", "vesnet"])
]
AccuracyName = Annotated[
    str | None,
    typer.Option("--accuracy", help="A preset for the scene's: fast, balanced or reference.", autocompletion=lambda: list(PRESETS)),
]
WeightsFolder = Annotated[Path | None, typer.Option("--weights", help="Override solver.weights: a folder.", metavar="DIR")]
TrajectoryPath = Annotated[Path, typer.Argument(help="Trajectory (HDF5).", metavar="TRAJECTORY", show_default=False)]
GridShape = Annotated[str | None, typer.Option("--grid", help="Fields on a grid: NXxNY, or N along its longer side.", metavar="SHAPE")]
GridBox = Annotated[str | None, typer.Option("--box", help="Of the grid: x0,y0,x1,y1; default around the membranes, or the walls.")]
FieldQuantities = Annotated[
    str | None, typer.Option("--quantities", help="Numbers: velocity, pressure, vorticity, stress; default all.", metavar="NAMES")
]
FieldTolerance = Annotated[float, typer.Option("--tolerance", help="Of fields: aimed-at error over the largest values.")]
SceneFolder = Annotated[Path, typer.Option("--folder", help="Where the scene's custom flow or walls are.", metavar="DIR")]
AsJson = Annotated[bool, typer.Option("--json", help="Print the result as JSON, and nothing else on the standard output.")]


def _show_version(asked: bool) -> None:
    if asked:
        typer.echo(f"vesnet {__version__}")
        raise typer.Exit


@app.callback()
def main(
    version: Annotated[bool, typer.Option("--version", callback=_show_version, is_eager=True, help="Print the version and end.")] = False,
) -> None:
    """Options of the program itself."""


@app.command()
def new(
    name: Annotated[
        str | None,
        typer.Argument(help="A scene; left out: their names.", show_default=False, autocompletion=lambda: list(scene_names().items())),
    ] = None,
    output: Annotated[Path | None, typer.Option("-o", "--output", help="File to write; default NAME.toml.")] = None,
    all_keys: Annotated[bool, typer.Option("--all-keys", help="Add the keys that it leaves out, as comments.")] = False,
) -> None:
    """Write a scene to begin with, with comments; without a name, tell which there are."""
    first_rank_only()
    with one_line_errors():
        if name is None:
            for known, about in scene_names().items():
                typer.echo(f"{known:<24} {about}")
            return
        text, path = scene_text(name, all_keys), output or Path(f"{name}.toml")
        if path.exists():
            raise ValueError(f"{path} exists: choose another name with -o")
        make_folder(path.parent)
        write_atomically(path, text.encode())
        typer.echo(f"{path}: run it by `biem run {path}`")


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
    as_json: AsJson = False,
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
        if ranks.rank == 0 and (as_json or not quiet):
            report = reports.run_report(done.trajectory, path, done.counts, ranks, notices)
            typer.echo(reports.as_json(report) if as_json else "\n".join(reports.run_lines(report)))


@app.command()
def plan(
    scene: ScenePath,
    solver: SolverName = None,
    measure: Annotated[bool, typer.Option(help="Time two steps for the estimate.")] = True,
    accuracy: AccuracyName = None,
    weights: WeightsFolder = None,
    overrides: Overrides = None,
    quiet: Annotated[bool, typer.Option("--quiet", help="Print nothing: whether the scene can be run, by the exit code.")] = False,
    as_json: AsJson = False,
) -> None:
    """Print what a scene requires, and why, with memory, file size and time."""
    first_rank_only()
    with one_line_errors():
        problem = build(_load(scene, solver, accuracy, weights, overrides))
        observer_of_run(problem, problem.X)  # refuses quantities that the scene does not have
        place_tracers(problem, most=1)  # and tracers for which it has no place
        report = reports.plan_report(problem, measure and (as_json or not quiet))
        if as_json or not quiet:
            typer.echo(reports.as_json(report) if as_json else "\n".join(reports.plan_lines(report)))


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
def observe(
    source: Annotated[
        Path, typer.Argument(help="Trajectory, or the observables that a run has written (HDF5).", metavar="TRAJECTORY", show_default=False)
    ],
    output: Annotated[
        Path | None, typer.Option("-o", "--output", help="File to write, .csv or .h5; default TRAJECTORY.observables.csv.")
    ] = None,
    quantities: Annotated[
        str | None, typer.Option("--quantities", help="Names apart by commas; default all that the scene has.", metavar="NAMES")
    ] = None,
    every: Annotated[int, typer.Option("--every", min=1, help="Observe each n-th frame.", metavar="N")] = 1,
    bins: Annotated[int, typer.Option("--bins", min=1, help="Bins over the width of the flow.", metavar="N")] = 20,
    stored_tension: Annotated[bool, typer.Option("--stored-tension", help="Take the solver's tension, do not find it anew.")] = False,
    plots: Annotated[Path | None, typer.Option("--plots", help="Draw them, into this folder.", metavar="DIR")] = None,
    folder: Annotated[Path, typer.Option("--folder", help="Where the scene's custom flow or walls are.", metavar="DIR")] = Path("."),
    quiet: Annotated[bool, typer.Option("--quiet", help="No progress bar, no names of files.")] = False,
    as_json: AsJson = False,
) -> None:
    """Compute stresses, viscosity, shapes, motion, distances and distributions, frame by frame."""
    first_rank_only()
    with one_line_errors():
        names = None if quantities is None else [name.strip() for name in quantities.split(",") if name.strip()]
        bar = (lambda frames: tqdm(frames, desc="observe", unit="frame", leave=False)) if not quiet else iter
        done = observe_file(source, output, plots, names, every, bins, stored_tension, folder, bar)
        for notice in done.notices:
            typer.echo(f"notice: {notice}", err=True)
        if as_json:
            typer.echo(reports.as_json(done.report))
        for file in () if as_json or quiet else done.files:
            typer.echo(str(file))


@app.command()
def field(
    trajectory: TrajectoryPath,
    output: Annotated[
        Path | None, typer.Option("-o", "--output", help="A .png, .gif, .mp4, .h5, or .csv of points; default TRAJECTORY.field.png.")
    ] = None,
    frames: Annotated[str | None, typer.Option("--frames", help='"-1", "3,5", "0:200:10", "all"; default the last, of movies all.')] = None,
    grid: GridShape = None,
    box: GridBox = None,
    points: Annotated[Path | None, typer.Option("--points", help="Text file of rows x y, in place of a grid.", metavar="FILE")] = None,
    quantities: FieldQuantities = None,
    show: Annotated[
        str | None, typer.Option("--show", help="Of a picture: speed (default), u, v, pressure, vorticity, shear_stress.", metavar="NAME")
    ] = None,
    streamlines: Annotated[bool, typer.Option("--streamlines", help="Draw streamlines.")] = False,
    follow: Annotated[bool, typer.Option("--follow", help="Move the grid with the mean of the membranes.")] = False,
    disturbance: Annotated[bool, typer.Option("--disturbance", help="Only what the vesicles add to the flow.")] = False,
    tolerance: FieldTolerance = 1e-6,
    folder: SceneFolder = Path("."),
    quiet: Annotated[bool, typer.Option("--quiet", help="No progress bar, no name of the file.")] = False,
) -> None:
    """Compute the flow around and in the vesicles: velocity, pressure, vorticity, stress, as numbers, pictures or movies."""
    first_rank_only()
    with one_line_errors():
        from biem.run.field_command import Options, make_fields

        path = output or trajectory.with_suffix(".field.png")
        options = Options(frames, grid, box, points, quantities, show, streamlines, follow, disturbance, tolerance, folder)
        bar = (lambda frames: tqdm(frames, desc="field", unit="frame", leave=False)) if not quiet else iter
        for notice in make_fields(trajectory, path, options, bar):
            typer.echo(f"notice: {notice}", err=True)
        if not quiet:
            typer.echo(str(path))


@app.command()
def export(
    trajectory: TrajectoryPath,
    vtkhdf: Annotated[bool, typer.Option("--vtkhdf", help="As VTKHDF, for ParaView 5.12 or newer.")] = False,
    output: Annotated[Path | None, typer.Option("-o", "--output", help="File to write; default TRAJECTORY.vtkhdf.")] = None,
    frames: Annotated[str, typer.Option("--frames", help='"-1", "3,5", "0:200:10" or "all".')] = "all",
    grid: GridShape = None,
    box: GridBox = None,
    quantities: FieldQuantities = None,
    refine: Annotated[int | None, typer.Option("--refine", help="Corners a node; default 96 corners a membrane, at least.")] = None,
    shapes: Annotated[bool, typer.Option("--shapes", help="Without tension, traction and velocity, which take a solve a frame.")] = False,
    disturbance: Annotated[bool, typer.Option("--disturbance", help="On the grid, only what the vesicles add to the flow.")] = False,
    tolerance: FieldTolerance = 1e-6,
    folder: SceneFolder = Path("."),
    quiet: Annotated[bool, typer.Option("--quiet", help="No progress bar, no names of files.")] = False,
) -> None:
    """Export membranes, tracers, walls and, with --grid, fields as time series for ParaView."""
    first_rank_only()
    with one_line_errors():
        from biem.run.export import ExportOptions, export_vtkhdf

        if not vtkhdf:
            raise ValueError("export: name the format, --vtkhdf")
        options = ExportOptions(frames, grid, box, quantities, refine, shapes, disturbance, tolerance, folder)
        bar = (lambda frames: tqdm(frames, desc="export", unit="frame", leave=False)) if not quiet else iter
        done = export_vtkhdf(trajectory, output, options, bar)
        for notice in done.notices:
            typer.echo(f"notice: {notice}", err=True)
        for file in () if quiet else done.files:
            typer.echo(str(file))


@app.command()
def verify(
    trajectory: TrajectoryPath,
    quiet: Annotated[bool, typer.Option("--quiet", help="No line for a check that holds.")] = False,
    as_json: AsJson = False,
) -> None:
    """Check a trajectory file: schema, finite values, areas and lengths, crossings, energies."""
    from biem.run.verify import verify as check_all

    first_rank_only()
    with one_line_errors():
        checks = check_all(read_trajectory(trajectory))
        failed = sum(not check.passed for check in checks)
        if as_json:
            report = {"trajectory": str(trajectory), "checks": [vars(check) for check in checks], "passed": not failed}
            typer.echo(reports.as_json(report))
        for check in () if as_json else checks:
            if not (quiet and check.passed):
                typer.echo(f"{'ok    ' if check.passed else 'FAILED'}  {check.name}: {check.detail}")
        if failed:
            fail(f"{failed} of {len(checks)} checks failed on {trajectory}", 3)


@app.command()
def doctor(
    quiet: Annotated[bool, typer.Option("--quiet", help="No line for what is in order.")] = False,
    as_json: AsJson = False,
) -> None:
    """Tell versions, devices, MPI, FFT and threads, and try the solvers on runs of known results: about ten seconds."""
    from biem.run.doctor import Finding, as_report, diagnose, examine, lines

    def tell(finding: Finding) -> None:
        if not as_json and (finding.state == "failed" or not quiet):
            state = {"ok": "ok    ", "failed": "FAILED", "absent": " -    "}[finding.state]
            typer.echo(f"{state}  {finding.name}: {finding.detail} ({finding.seconds:.1f} s)")

    first_rank_only()
    with one_line_errors():
        found = examine()
        for line in () if as_json or quiet else lines(found):
            typer.echo(line)
        findings = diagnose(tell)
        if as_json:
            typer.echo(reports.as_json(as_report(found, findings)))
        failed = sum(finding.state == "failed" for finding in findings)
        if failed:
            fail(f"{failed} of {len(findings)} checks failed", 3)


def _load(path: Path, solver: str | None, accuracy: str | None, weights: Path | None, overrides: list[str] | None) -> Scene:
    settings = list(overrides or [])
    if solver:
        settings.append(f'solver.kind="{solver}"')
    if weights is not None:
        settings.append(f"solver.weights={json.dumps(str(weights.absolute()), ensure_ascii=False)}")
    return load_scene(path, settings, accuracy)


if __name__ == "__main__":
    app()
