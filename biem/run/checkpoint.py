"""Checkpoints: all that a restart needs to go on bit for bit. The previous one is kept as *.previous."""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from pathlib import Path

import h5py
import numpy as np

from biem.run.files import atomic_h5
from biem.steppers.stepper import State


@dataclass(frozen=True)
class Checkpoint:
    """State after `step` steps, the initial areas and lengths, and the running diagnostics since the last frame."""

    step: int
    state: State
    area_0: np.ndarray
    length_0: np.ndarray
    scene: str  # JSON of the resolved scene
    running: dict[str, float] = field(default_factory=dict)
    counts: dict[str, int] = field(default_factory=dict)
    run: str = ""  # of the trajectory that it belongs to


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
    state = checkpoint.state
    if not (np.isfinite(state.X).all() and np.isfinite(state.t) and (state.sigma is None or np.isfinite(state.sigma).all())):
        raise ValueError(f"the state at step {checkpoint.step} is not finite: checkpoint {path} is left as it was")
    with atomic_h5(path.with_name(path.name + ".next")) as file:
        file["X"], file["area_0"], file["length_0"] = state.X, checkpoint.area_0, checkpoint.length_0
        if state.sigma is not None:
            file["sigma"] = state.sigma
        file.attrs.update({"t": state.t, "step": checkpoint.step, "scene": checkpoint.scene, "run": checkpoint.run})
        for group, values in (("running", checkpoint.running), ("counts", checkpoint.counts)):
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
                checkpoint = Checkpoint(
                    int(file.attrs["step"]),
                    State(float(file.attrs["t"]), file["X"][:], sigma),
                    file["area_0"][:],
                    file["length_0"][:],
                    str(file.attrs["scene"]),
                    {k: float(v) for k, v in file["running"].attrs.items()},
                    {k: int(v) for k, v in file["counts"].attrs.items()},
                    str(file.attrs["run"]),
                )
            if run is None or checkpoint.run == run:
                return checkpoint
        except (OSError, KeyError):
            continue
    raise ValueError(f"no readable checkpoint at {path} for this run: there is nothing to resume; leave out --resume")


def _generations(path: Path) -> tuple[Path, ...]:
    """Newest first: `.next` is there only if the writer was killed before a rename."""
    return path.with_name(path.name + ".next"), path, path.with_name(path.name + ".previous")
