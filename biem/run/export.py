"""A trajectory as VTKHDF time series: membranes, and where there are any tracers, walls and fields on a grid, a file each.

NAME.vtkhdf           PolyData, a closed polyline a vesicle; at points tension, curvature, traction (force on the fluid per length),
                      velocity, vesicle; at cells vesicle
NAME.grid.vtkhdf      ImageData: the quantities of `observe.fields` and inside, in the trajectory's units
NAME.tracers.vtkhdf   PolyData, a vertex a tracer: vesicle, left (1 from where it has left, where it then stays)
NAME.walls.vtkhdf     PolyData, a closed polyline a wall, of one step
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from biem.curves.curve import center_of_nodes, curvature
from biem.curves.fourier import resample
from biem.observe.grid import Grid, frames_named, grid_shape
from biem.run.derived import check_output, unfinished
from biem.run.field_command import box_of
from biem.run.fields import FrameFields, Request, check_memory, parts_of, quantities_named, remove_parts, sampled
from biem.run.observe import problem_of
from biem.run.trajectory import Trajectory, read_trajectory
from biem.run.vtkhdf import write_image, write_polydata

LEAST_CORNERS = 96  # of a membrane, by default


@dataclass(frozen=True)
class ExportOptions:
    """As on the command line. grid, box, quantities, frames: texts, None where left out; refine: corners a node of the membranes.

    shapes: without tension, traction and velocity, which take a solve a frame.
    """

    frames: str = "all"
    grid: str | None = None
    box: str | None = None
    quantities: str | None = None
    refine: int | None = None
    shapes: bool = False
    disturbance: bool = False
    tolerance: float = 1e-6
    folder: Path = Path(".")


@dataclass(frozen=True)
class Exported:
    """The files, and what is to be said of them."""

    files: list[Path]
    notices: list[str]


def export_vtkhdf(source: Path, output: Path | None, options: ExportOptions, progress: Callable[[Any], Iterable[Any]] = iter) -> Exported:
    """Writes `output` (default the trajectory's name with .vtkhdf) and the files beside it. An interrupted call leaves its frames.

    Raises ValueError or FileNotFoundError with one line for what is wrong, NumericalFailure where a tension is not found.
    """
    output = output or source.with_suffix(".vtkhdf")
    if output.suffix != ".vtkhdf":
        raise ValueError(f"output {output}: expected a name that ends in .vtkhdf")
    if options.grid is None and (options.box is not None or options.quantities is not None or options.disturbance):
        raise ValueError("--box, --quantities and --disturbance go with --grid")
    if options.refine is not None and options.refine < 1:
        raise ValueError(f"--refine {options.refine}: expected 1 or more")
    if not 1e-12 <= options.tolerance < 1.0:
        raise ValueError(f"--tolerance {options.tolerance:g}: expected a number from 1e-12 to 1")
    trajectory = read_trajectory(source)
    problem = problem_of(trajectory, options.folder)
    frames = frames_named(options.frames, len(trajectory))
    quantities: tuple[str, ...] = ()
    grids: list[Grid] = []
    points = 0.0
    if options.grid is not None:
        quantities = quantities_named(options.quantities, problem, options.disturbance)
        box = box_of(trajectory, frames, options.box)
        shape = grid_shape(options.grid, box)
        points = float(shape[0]) * shape[1]
    check_memory(problem, points, len(frames), quantities, True, not options.shapes, corners(problem.X, options.refine))
    if options.grid is not None:
        grids = [Grid.of(box, shape)] * len(frames)
    request = Request(frames, quantities, grids, None, not options.shapes, options.disturbance, options.tolerance)
    check_output(output, source)
    found = list(sampled(trajectory, problem, request, parts_of(output), progress))

    files = [output]
    write_membranes(output, trajectory, found, options.refine)
    t = trajectory.t[frames]
    if grids:
        files.append(output.with_suffix(".grid.vtkhdf"))
        values = {name: np.stack([frame.values[name] for frame in found]) for name in ("inside", *quantities)}
        on_grid = {name: v.reshape(len(found), *grids[0].shape, *v.shape[2:]) for name, v in values.items()}
        write_image(files[-1], t, grids[0].x, grids[0].y, on_grid)
    if trajectory.tracers is not None:
        files.append(output.with_suffix(".tracers.vtkhdf"))
        write_tracers(files[-1], trajectory, frames)
    if "walls" in trajectory.attributes:
        files.append(output.with_suffix(".walls.vtkhdf"))
        outlines, cells = _polylines([resample(X, 2 * X.shape[-1]).T for X in trajectory.attributes["walls"]])
        write_polydata(files[-1], t[:1], outlines[None], cells, "Lines", {}, {"wall": np.arange(len(cells))})
    remove_parts(output)
    return Exported(files, [*filter(None, [unfinished(trajectory, problem)])])


def write_membranes(path: Path, trajectory: Trajectory, found: Sequence[FrameFields], refine: int | None = None) -> None:
    """Membranes of the frames; with tension, traction and velocity where the frames have them. refine: corners a node."""
    M = trajectory.X.shape[1]
    n = corners(trajectory.X[0], refine) // M
    points: list[np.ndarray] = []
    data: dict[str, list[np.ndarray]] = {}
    for frame in found:
        X, lattice = trajectory.X[frame.frame], trajectory.lattice(frame.frame)
        X = X if lattice is None else lattice.wrapped_curves(X)
        center = center_of_nodes(X)
        fine = resample(X - center, n)
        points.append((fine + center).transpose(0, 2, 1).reshape(M * n, 2))
        values = {"curvature": curvature(fine).ravel()}
        if "sigma" in frame.values:
            values["tension"] = resample(frame.values["sigma"], n).ravel()
            for name, key in (("traction", "force"), ("velocity", "membrane_velocity")):
                values[name] = resample(frame.values[key], n).transpose(0, 2, 1).reshape(M * n, 2)
        for name, value in values.items():
            data.setdefault(name, []).append(value)
    vesicle = np.repeat(np.arange(M), n)
    on_points = {name: np.stack(value) for name, value in data.items()} | {"vesicle": np.tile(vesicle, (len(found), 1))}
    _, cells = _polylines([np.zeros((n, 2))] * M)
    write_polydata(path, np.array([f.t for f in found]), np.stack(points), cells, "Lines", on_points, {"vesicle": np.arange(M)})


def corners(X: np.ndarray, refine: int | None) -> int:
    """Of all membranes X (M, 2, N) of a frame."""
    M, _, N = X.shape
    return M * N * (refine or -(-LEAST_CORNERS // N))


def write_tracers(path: Path, trajectory: Trajectory, frames: Sequence[int]) -> None:
    """Tracers at the frames; those that have left stay where they were seen last."""
    assert trajectory.tracers is not None
    x = trajectory.tracers.copy()
    left = ~np.isfinite(x).all(axis=-1)
    for k in range(1, len(x)):
        x[k][left[k]] = x[k - 1][left[k]]
    for k, lattice in enumerate(trajectory.lattice(k) for k in range(len(x))):
        x[k] = x[k] if lattice is None else lattice.wrapped(x[k])
    P = x.shape[1]
    vesicle = np.asarray(trajectory.attributes["tracer_vesicle"])
    data = {"left": left[frames].astype(np.int64), "vesicle": np.tile(vesicle, (len(frames), 1))}
    write_polydata(path, trajectory.t[frames], x[frames], list(np.arange(P)[:, None]), "Vertices", data, {"vesicle": vesicle})


def _polylines(curves: Sequence[np.ndarray]) -> tuple[np.ndarray, list[np.ndarray]]:
    """Corners (P, 2) of closed curves, each (n, 2), and their cells, which end where they begin."""
    starts = np.cumsum([0, *(len(curve) for curve in curves)])
    cells = [np.append(np.arange(a, b), a) for a, b in pairwise(starts)]
    return np.concatenate(curves), cells
