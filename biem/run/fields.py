"""Fields of the frames of a trajectory, one after the other; what was computed before an interruption is kept and gone on from.

Parts: a folder beside the output with one HDF5 file a frame, removed by whoever has written the output. A part is used again if it is of
the same run and was asked for in the same words.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from biem.backend import fft_backend
from biem.observe.fields import QUANTITIES, SIZES, FlowField, field_bytes
from biem.observe.grid import Grid
from biem.observe.instant import instant
from biem.run.files import atomic_h5
from biem.run.solver import free_memory
from biem.run.trajectory import Trajectory
from biem.scene.build import Problem
from biem.scene.plan import memory_estimate

VALUES_A_CORNER = 12  # of a polyline: where it is and what it holds, with the third components


@dataclass(frozen=True)
class Request:
    """What is to be computed at each of the frames: quantities at the points of its grid, or at points (P, 2), or at none.

    grids: one for each frame. membranes: also what `instant` finds. disturbance, tolerance: as of `FlowField`.
    """

    frames: Sequence[int]
    quantities: tuple[str, ...]
    grids: Sequence[Grid] = ()
    points: np.ndarray | None = None
    membranes: bool = False
    disturbance: bool = False
    tolerance: float = 1e-6

    @property
    def size(self) -> int:
        """Points a frame."""
        if self.grids:
            ny, nx = self.grids[0].shape
            return nx * ny
        return 0 if self.points is None else len(self.points)

    def points_of(self, k: int) -> np.ndarray:
        """(P, 2) of the k-th of the frames."""
        if self.grids:
            return self.grids[k].points
        return np.zeros((0, 2)) if self.points is None else self.points


@dataclass(frozen=True)
class FrameFields:
    """A frame of the trajectory and what was asked for: arrays by name, (P, ...); of membranes sigma (M, N), force, velocity (M, 2, N)."""

    frame: int
    t: float
    values: Mapping[str, np.ndarray]


def quantities_named(text: str | None, problem: Problem, disturbance: bool) -> tuple[str, ...]:
    """Those of a list apart by commas; default all that the scene's flow has. Raises ValueError for one that is unknown."""
    if text is None:
        return QUANTITIES if problem.flow.kind != "custom" or disturbance else ("velocity",)
    names = tuple(dict.fromkeys(name.strip() for name in text.split(",") if name.strip()))
    unknown = [name for name in names if name not in QUANTITIES]
    if unknown or not names:
        raise ValueError(f"--quantities {text}: expected some of " + ", ".join(QUANTITIES))
    return names


def check_memory(
    problem: Problem, points: float, frames: int, quantities: Sequence[str], kept: bool, membranes: bool = False, corners: int = 0
) -> None:
    """Raises ValueError, before anything is computed, where this machine has not the memory.

    points: of a frame; kept: whether all frames are held until they are written; membranes: as of `Request`; corners: of the
    polylines of a frame.
    """
    values = (1 + sum(SIZES[name] for name in quantities)) * points + (5 * problem.X.size if membranes else 0)
    needed = field_bytes(problem, points, quantities) + memory_estimate(problem) + (3.0 * 8.0 * values * frames if kept else 0.0)
    polylines = 3.0 * 8.0 * VALUES_A_CORNER * corners * frames
    needed += polylines
    free = free_memory()
    if needed > free:
        if polylines > 0.5 * needed:
            raise ValueError(
                f"membranes of {corners} corners at {frames} frames need about {needed / 1e6:.3g} MB of memory, {free / 1e6:.3g} MB are "
                "free: take fewer frames, or a smaller --refine"
            )
        many = f"{frames} frames of " if kept and frames > 1 else ""
        raise ValueError(
            f"fields at {many}{points:.4g} points need about {needed / 1e6:.3g} MB of memory, {free / 1e6:.3g} MB are free: take a coarser "
            "grid, fewer frames or fewer quantities"
        )


def sampled(
    trajectory: Trajectory,
    problem: Problem,
    request: Request,
    parts: Path | None = None,
    progress: Callable[[Any], Iterable[Any]] = iter,
) -> Iterator[FrameFields]:
    """The fields of the frames, in turn. Raises NumericalFailure as `instant` does, OSError where parts cannot be written."""
    with fft_backend(problem.X.size):
        for k, frame in enumerate(progress(list(request.frames))):
            path = None if parts is None else parts / f"{frame:08d}.h5"
            about = _about(trajectory, request, k)
            found = None if path is None else _read_part(path, about)
            if found is None:
                found = _compute(trajectory, problem, request, k)
                if path is not None:
                    path.parent.mkdir(parents=True, exist_ok=True)
                    _write_part(path, about, found)
            yield FrameFields(frame, float(trajectory.t[frame]), found)


def parts_of(output: Path) -> Path:
    """Where the parts of an output lie."""
    return output.with_name(output.name + ".parts")


def remove_parts(output: Path) -> None:
    """The output is written."""
    shutil.rmtree(parts_of(output), ignore_errors=True)


def _compute(trajectory: Trajectory, problem: Problem, request: Request, k: int) -> dict[str, np.ndarray]:
    frame = request.frames[k]
    at = instant(problem, trajectory.X[frame], float(trajectory.t[frame]))
    found: dict[str, np.ndarray] = {}
    if request.membranes:
        found |= {"sigma": at.sigma, "force": at.force, "membrane_velocity": at.velocity}
    if request.size:
        flow = FlowField(problem, at, request.tolerance, request.disturbance)
        values = flow.values(request.points_of(k), request.quantities)
        found |= {name: getattr(values, name) for name in ("inside", *request.quantities)}
    return found


def _about(trajectory: Trajectory, request: Request, k: int) -> str:
    """What a part is, in words that no other one has."""
    points = sha256(request.points_of(k).tobytes()).hexdigest()
    t = float(trajectory.t[request.frames[k]])
    words = t, points, request.quantities, request.membranes, request.disturbance, request.tolerance
    return json.dumps([str(trajectory.attributes.get("run")), *words])


def _read_part(path: Path, about: str) -> dict[str, np.ndarray] | None:
    try:
        with h5py.File(path, "r") as file:
            if file["about"].asstr()[()] != about:
                return None
            return {name: values[()] for name, values in file["values"].items()}
    except (OSError, KeyError):
        return None


def _write_part(path: Path, about: str, found: Mapping[str, np.ndarray]) -> None:
    with atomic_h5(path) as file:
        file["about"] = about
        for name, values in found.items():
            file[f"values/{name}"] = values
