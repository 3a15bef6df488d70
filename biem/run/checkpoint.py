"""Checkpoints: all that a restart needs to go on bit for bit. The previous one is kept as *.previous."""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from pathlib import Path

import h5py
import numpy as np

from biem.backend import to_numpy
from biem.run.files import atomic_h5
from biem.steppers.stepper import State


@dataclass(frozen=True)
class Checkpoint:
    """State after `step` steps, the initial areas and lengths, and the running diagnostics since the last frame.

    What is written may be tensors; what is read is NumPy arrays.
    """

    step: int
    state: State
    area_0: np.ndarray
    length_0: np.ndarray
    scene: str  # JSON of the resolved scene
    running: dict[str, float] = field(default_factory=dict)
    counts: dict[str, int] = field(default_factory=dict)
    run: str = ""  # of the trajectory that it belongs to
    control: dict[str, float] = field(default_factory=dict)  # of adaptive steps: the next dt, and what rounding took from t
    tracers: np.ndarray | None = None  # (P, 2), not a number where they have left


def checkpoint_path(trajectory: Path) -> Path:
    """Where the checkpoint of a trajectory lies."""
    return trajectory.with_name(trajectory.name + ".checkpoint")


def write_checkpoint(path: Path, checkpoint: Checkpoint) -> None:
    """Replaces the checkpoint at `path`, keeping it as *.previous; raises ValueError, leaving it, if the state is not finite."""
    prepare_checkpoint(path, checkpoint)
    if path.exists():
        os.replace(path, path.with_name(path.name + ".previous"))
    os.replace(path.with_name(path.name + ".next"), path)


def prepare_checkpoint(path: Path, checkpoint: Checkpoint) -> None:
    """Writes *.next, which counts as the newest checkpoint of its run; raises ValueError if the state is not finite."""
    t, coupling = checkpoint.state.t, checkpoint.state.coupling
    arrays = {"X": checkpoint.state.X, "sigma": checkpoint.state.sigma}
    if coupling is not None:
        arrays |= {"coupling": coupling[1], "coupling_rate": coupling[2]}
    arrays = {name: to_numpy(a) for name, a in arrays.items() if a is not None}
    if not (np.isfinite(t) and all(np.isfinite(a).all() for a in arrays.values())):
        raise ValueError(f"the state at step {checkpoint.step} is not finite: checkpoint {path} is left as it was")
    with atomic_h5(path.with_name(path.name + ".next")) as file:
        others = {} if checkpoint.tracers is None else {"tracers": checkpoint.tracers}
        for name, a in {**arrays, **others, "area_0": checkpoint.area_0, "length_0": checkpoint.length_0}.items():
            file[name] = a
        if coupling is not None:
            file["coupling"].attrs["t"] = coupling[0]
        file.attrs.update({"t": t, "step": checkpoint.step, "scene": checkpoint.scene, "run": checkpoint.run})
        for group, values in (("running", checkpoint.running), ("counts", checkpoint.counts), ("control", checkpoint.control)):
            file.create_group(group).attrs.update(values)


def remove_checkpoints(path: Path) -> None:
    """Removes the checkpoint at `path` and its predecessor."""
    for old in _generations(path):
        old.unlink(missing_ok=True)


def read_checkpoint(path: Path, run: str | None = None) -> Checkpoint:
    """The newest readable checkpoint at `path` (of that run, where one is named). Raises ValueError if there is none."""
    for candidate in _generations(path):
        try:
            with h5py.File(candidate, "r") as file:
                sigma = file["sigma"][:] if "sigma" in file else None
                coupling = None
                if "coupling" in file:
                    coupling = (float(file["coupling"].attrs["t"]), file["coupling"][:], file["coupling_rate"][:])
                checkpoint = Checkpoint(
                    int(file.attrs["step"]),
                    State(float(file.attrs["t"]), file["X"][:], sigma, coupling),
                    file["area_0"][:],
                    file["length_0"][:],
                    str(file.attrs["scene"]),
                    {k: float(v) for k, v in file["running"].attrs.items()},
                    {k: int(v) for k, v in file["counts"].attrs.items()},
                    str(file.attrs["run"]),
                    {k: float(v) for k, v in file["control"].attrs.items()} if "control" in file else {},
                    file["tracers"][:] if "tracers" in file else None,
                )
            if run is None or checkpoint.run == run:
                return checkpoint
        except (OSError, KeyError):
            continue
    raise ValueError(f"no readable checkpoint at {path} for this run: there is nothing to resume; leave out --resume")


def _generations(path: Path) -> tuple[Path, ...]:
    """Newest first: `.next` is there only if the writer was killed before a rename."""
    return path.with_name(path.name + ".next"), path, path.with_name(path.name + ".previous")
