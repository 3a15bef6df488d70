"""Fields of a trajectory as a file: numbers (HDF5, text), pictures, movies. What `python -m biem field` does."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from biem.observe.grid import Grid, box_around, frames_named, grid_shape, read_box
from biem.run.derived import check_output, unfinished
from biem.run.field_files import write_fields, write_table
from biem.run.fields import Request, check_memory, parts_of, quantities_named, remove_parts, sampled
from biem.run.observe import problem_of
from biem.run.trajectory import Trajectory, read_trajectory
from biem.scene.build import Problem
from biem.scene.tracers import points_from_file

PICTURES, MOVIES = (".png",), (".gif", ".mp4")
ENDINGS = (".h5", ".csv", *PICTURES, *MOVIES)


@dataclass(frozen=True)
class Options:
    """As on the command line, each None where it is left out. frames, grid, box, quantities: texts; show: of a picture."""

    frames: str | None = None
    grid: str | None = None
    box: str | None = None
    points: Path | None = None
    quantities: str | None = None
    show: str | None = None
    streamlines: bool = False
    follow: bool = False
    disturbance: bool = False
    tolerance: float = 1e-6
    folder: Path = Path(".")


def make_fields(source: Path, output: Path, options: Options, progress: Callable[[Any], Iterable[Any]] = iter) -> list[str]:
    """Writes `output`; what it is made of is told by its ending. Returns what is to be said of it.

    An interrupted call leaves its frames, which the next one takes.

    Raises ValueError or FileNotFoundError with one line for what is wrong, NumericalFailure where a tension is not found.
    """
    kind = output.suffix.lower()
    _check(kind, output, options)
    trajectory = read_trajectory(source)
    problem = problem_of(trajectory, options.folder)
    default = "all" if kind in MOVIES else "-1"
    frames = frames_named(default if options.frames is None else options.frames, len(trajectory))
    if kind in PICTURES and len(frames) > 1:
        raise ValueError(f"--frames {options.frames} names {len(frames)} frames, {kind} holds one: name one, or write a .gif or a .mp4")
    drawn = kind in (*PICTURES, *MOVIES)
    quantities = _quantities(options, problem, drawn)
    points = None if options.points is None else points_from_file(options.points, "--points")
    if points is None:
        box = box_of(trajectory, frames, options.box, options.follow)
        shape = grid_shape(options.grid, box)
        check_memory(problem, float(shape[0]) * shape[1], len(frames), quantities, not drawn)
        grids = _grids(trajectory, frames, Grid.of(box, shape), options.follow)
    else:
        check_memory(problem, len(points), len(frames), quantities, True)
        grids = []
    request = Request(frames, quantities, grids, points, disturbance=options.disturbance, tolerance=options.tolerance)
    check_output(output, source)
    again = lambda bar=iter: sampled(trajectory, problem, request, parts_of(output), bar)
    if drawn:
        from biem.run.field_pictures import Painter  # matplotlib loads slowly: only where it is needed

        painter = Painter.of(trajectory, options.show or "speed", again(progress), options.streamlines)
        if kind in PICTURES:
            painter.picture(next(again()), grids[0], output)
        else:
            painter.movie(again(progress), grids, output)
    else:
        found = list(again(progress))
        about = {"trajectory": source.name, "run": str(trajectory.attributes.get("run", ""))}
        if kind == ".csv":
            write_table(output, request, found)
        else:
            write_fields(output, request, found, about)
    remove_parts(output)
    return [*filter(None, [unfinished(trajectory, problem)])]


def box_of(trajectory: Trajectory, frames: list[int], text: str | None, follow: bool = False) -> tuple[float, float, float, float]:
    """The box that is asked for, or the periodic box, or one around the walls or around the membranes of all of the frames.

    follow: about the membranes' mean node, with which it moves.
    """
    if text is not None:
        return read_box(text)
    if "periodic" in trajectory.attributes:
        width, height = (float(side) for side in trajectory.attributes["periodic"][:2])
        return -0.5 * width, -0.5 * height, 0.5 * width, 0.5 * height
    X = trajectory.X[frames]
    if follow:
        X = X - _centers(trajectory, frames)[:, None, :, None]
    return box_around(X, trajectory.attributes.get("walls", ()))


def _centers(trajectory: Trajectory, frames: list[int]) -> np.ndarray:
    return trajectory.X[frames].mean(axis=(1, 3))


def _grids(trajectory: Trajectory, frames: list[int], grid: Grid, follow: bool) -> list[Grid]:
    if not follow:
        return [grid] * len(frames)
    return [grid.moved(center) for center in _centers(trajectory, frames)]


def _quantities(options: Options, problem: Problem, drawn: bool) -> tuple[str, ...]:
    if not drawn:
        return quantities_named(options.quantities, problem, options.disturbance)
    from biem.run.field_pictures import quantities_shown

    return quantities_shown(options.show or "speed", options.streamlines)


def _check(kind: str, output: Path, options: Options) -> None:
    """Raises ValueError for options that do not go together."""
    if kind not in ENDINGS:
        raise ValueError(f"output {output}: expected a name that ends in " + ", ".join(ENDINGS))
    drawn = kind in (*PICTURES, *MOVIES)
    if kind == ".mp4" and shutil.which("ffmpeg") is None:
        raise ValueError(f"output {output}: .mp4 needs ffmpeg, which is not installed; write a .gif")
    if drawn and options.quantities is not None:
        raise ValueError("--quantities goes with .h5 and .csv; a picture has --show")
    if not drawn and (options.show is not None or options.streamlines):
        raise ValueError("--show and --streamlines go with pictures and movies: .png, .gif, .mp4")
    if options.points is not None:
        if drawn:
            raise ValueError("--points goes with .h5 and .csv: a picture needs a grid")
        if options.grid is not None or options.box is not None or options.follow:
            raise ValueError("--points says where: leave out --grid, --box and --follow")
    if kind == ".csv" and options.points is None:
        raise ValueError("a .csv is for --points; grids go into .h5")
    if options.box is not None and options.follow:
        raise ValueError("--box stays where it is: leave out --follow")
    if not 1e-12 <= options.tolerance < 1.0:
        raise ValueError(f"--tolerance {options.tolerance:g}: expected a number from 1e-12 to 1")
