"""Trajectory files: every committed frame stays readable, whenever the writer is killed.

out.h5: t (F,), step (F,), X (F, M, 2, N), sigma (F, M, N) where the solver has a tension, diagnostics/* (F,), walls/* (2, N_k) where
there are walls, the outer one first, tracers (F, P, 2) and tracer_vesicle (P,) where there are tracers, attributes.
dt, error_estimate and rejected came later: files without them are read as zeros. MONITORED are there in runs by learned maps alone.
While a run is writing, new frames lie one file each in out.h5.frames/ and are merged into out.h5 from time to time and at the end;
`read_trajectory` reads both. Every file appears by a rename after a sync.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from biem.curves.lattice import Box, Lattice
from biem.run.files import atomic_h5, one_line
from biem.run.growing import Growing, read_growing

SCHEMA = 1
REQUIRED = ("area_error", "length_error", "bending_energy", "gmres_iterations", "wall_seconds", "min_gap")
DIAGNOSTICS = (*REQUIRED, "dt", "error_estimate", "rejected", "repulsion_work")
MONITORED = ("out_of_distribution", "by_exact_maps")  # numbers of vesicles: of maps that watch over their validity


@dataclass(frozen=True)
class Trajectory:
    """Frames: t (F,), step (F,), X (F, M, 2, N), sigma (F, M, N) or None; diagnostics: name -> (F,).

    area_error and length_error are the largest relative errors of a step since the last frame, before correction; bending_energy is
    the suspension's; gmres_iterations the most since the last frame; wall_seconds the mean of a step since then; min_gap is at t; dt is
    of the last step; error_estimate the worst since the last frame, zero where there is none; rejected the steps rejected since then.
    MONITORED, where there are any, are the most vesicles in a step since the last frame.
    attributes["walls"]: the curves (2, N_k) of the walls, where there are any. attributes["periodic"]: width, height and shear rate of
    a periodic box, where there is one; membranes are where they have wandered to.
    tracers (F, P, 2), where there are any, not a number from where they have left; attributes["tracer_vesicle"] (P,): the vesicle that
    each is in, -1 for the fluid between.
    """

    t: np.ndarray
    step: np.ndarray
    X: np.ndarray
    sigma: np.ndarray | None
    diagnostics: Mapping[str, np.ndarray]
    attributes: Mapping[str, Any]
    tracers: np.ndarray | None = None

    def __len__(self) -> int:
        return len(self.t)

    def lattice(self, frame: int) -> Lattice | None:
        """The images at a frame, in a periodic box."""
        return Box(*map(float, self.attributes["periodic"])).at(float(self.t[frame])) if "periodic" in self.attributes else None

    def until(self, step: int) -> Trajectory:
        """The frames up to a step."""
        keep = self.step <= step
        return replace(
            self,
            t=self.t[keep],
            step=self.step[keep],
            X=self.X[keep],
            sigma=None if self.sigma is None else self.sigma[keep],
            diagnostics={name: values[keep] for name, values in self.diagnostics.items()},
            tracers=None if self.tracers is None else self.tracers[keep],
        )


def one_frame(
    t: float, step: int, X: np.ndarray, sigma: np.ndarray | None, diagnostics: Mapping[str, float], tracers: np.ndarray | None = None
) -> Trajectory:
    """A trajectory of one frame."""
    names = (*DIAGNOSTICS, *(name for name in MONITORED if name in diagnostics))
    values = {name: np.array([diagnostics.get(name, 0.0)], dtype=np.float64) for name in names}
    one = lambda a: None if a is None else a[None]
    return Trajectory(np.array([t]), np.array([step]), X[None], one(sigma), values, {}, one(tracers))


def join(parts: list[Trajectory], attributes: Mapping[str, Any]) -> Trajectory:
    """Frames of all parts in turn. Tension is kept where every frame has it but the initial one, which then shows zero."""
    with_tension = [p for p in parts if p.sigma is not None]
    sigma = None
    if with_tension:
        sigma = np.concatenate([np.zeros((len(p), *p.X.shape[1:2], p.X.shape[3])) if p.sigma is None else p.sigma for p in parts])
    names = (*DIAGNOSTICS, *(name for name in MONITORED if any(name in p.diagnostics for p in parts)))
    diagnostics = {name: np.concatenate([p.diagnostics.get(name, np.zeros(len(p))) for p in parts]) for name in names}
    t, step, X = (np.concatenate([getattr(p, name) for p in parts]) for name in ("t", "step", "X"))
    tracers = None if parts[0].tracers is None else np.concatenate([p.tracers for p in parts])
    return Trajectory(t, step, X, sigma, diagnostics, dict(attributes), tracers)


def read_trajectory(path: str | Path) -> Trajectory:
    """All committed frames of a trajectory file, finished or being written. Raises ValueError if it is none."""
    path = Path(path)
    pieces = read_growing(path, _folder(path), _read, lambda frames: frames.attributes.get("run"))
    return join(pieces, pieces[0].attributes)


class TrajectoryWriter(Growing):
    """Appends frames to `path`; `close` leaves one plain file."""

    def __init__(self, path: Path, attributes: Mapping[str, Any], frames: list[Trajectory]) -> None:
        """Starts the file with the given frames (those before a restart, or the initial one), replacing what was there.

        The attribute "run" tells its loose frames from those of a run that it replaces.
        """
        self.attributes = dict(attributes)
        super().__init__(path, _folder(path), join(frames, self.attributes), read_trajectory, self._write_frames)

    def _write_frames(self, path: Path, frames: Trajectory) -> None:
        with atomic_h5(path) as file:
            for name in ("t", "step", "X"):
                file[name] = getattr(frames, name)
            if frames.sigma is not None:
                file["sigma"] = frames.sigma
            if frames.tracers is not None:
                file["tracers"] = frames.tracers
                file["tracer_vesicle"] = self.attributes["tracer_vesicle"]
            for name, values in frames.diagnostics.items():
                file[f"diagnostics/{name}"] = values
            for name, value in self.attributes.items():
                if name not in ("walls", "tracer_vesicle"):
                    file.attrs[name] = value
            for k, X in enumerate(self.attributes.get("walls", ())):
                file[f"walls/{k}"] = X


def exists(path: Path) -> bool:
    """Whether a trajectory, or what a killed run left of one, is there."""
    return path.exists() or _folder(path).exists()


def _folder(path: Path) -> Path:
    return path.with_name(path.name + ".frames")


def _read(path: Path) -> Trajectory:
    if not path.exists():
        raise FileNotFoundError(f"trajectory {path} does not exist")
    try:
        with h5py.File(path, "r") as file:
            needed = ["t", "step", "X", *(f"diagnostics/{name}" for name in REQUIRED)]
            missing = [name for name in needed if name not in file]
            if missing or file.attrs.get("schema") != SCHEMA:
                lacks = f"it lacks {', '.join(missing)}" if missing else f"its schema is {file.attrs.get('schema')}"
                raise ValueError(f"{path} is not a trajectory of schema {SCHEMA}: {lacks}")
            sigma = file["sigma"][:] if "sigma" in file else None
            t, stored = file["t"][:], file["diagnostics"]
            names = (*DIAGNOSTICS, *(name for name in MONITORED if name in stored))
            diagnostics = {name: stored[name][:] if name in stored else np.zeros(len(t)) for name in names}
            attributes = dict(file.attrs)
            if "walls" in file:
                attributes["walls"] = tuple(file[f"walls/{k}"][:] for k in range(len(file["walls"])))
            tracers = file["tracers"][:] if "tracers" in file else None
            if tracers is not None:
                attributes["tracer_vesicle"] = file["tracer_vesicle"][:]
            return Trajectory(t, file["step"][:], file["X"][:], sigma, diagnostics, attributes, tracers)
    except OSError as error:
        if not path.exists():
            raise FileNotFoundError(f"trajectory {path} does not exist") from None
        if path.is_dir():
            raise ValueError(f"{path} is a folder: give the trajectory, a file NAME.h5") from None
        raise ValueError(f"{path} cannot be read as HDF5: {one_line(error)}") from None
