"""What is made of a trajectory: files that must not take its place, of frames that must be finite, of a run that may not have ended."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path

import h5py
import numpy as np

from biem.run.files import make_folder
from biem.run.trajectory import SCHEMA, Trajectory, exists
from biem.scene.build import Problem


def check_output(output: Path, source: Path) -> None:
    """Before anything is computed: that the file can be written, and replaces neither its source nor a trajectory.

    Makes the folder. Raises ValueError or OSError with one line for what is wrong.
    """
    if output.is_dir():
        raise ValueError(f"output {output} is a folder: give the name of a file")
    if output.exists() and source.exists() and output.samefile(source):
        raise ValueError(f"output {output} is the file that it is made of: choose another name")
    if exists(output) and (not output.exists() or _is_trajectory(output)):
        raise ValueError(f"output {output} is a trajectory, which is not replaced: choose another name, or remove it first")
    make_folder(output.parent)
    try:
        descriptor, probe = tempfile.mkstemp(prefix=f".{output.stem}.", dir=output.parent)
        os.close(descriptor)
        os.unlink(probe)
    except OSError as error:
        raise OSError(f"output {output}: its folder cannot be written to ({error.strerror}): choose another place") from None


def check_finite(trajectory: Trajectory) -> None:
    """Raises ValueError for a frame, which no run writes, with nodes that are not finite."""
    wrong = ~np.isfinite(trajectory.X).all(axis=(2, 3))
    if wrong.any():
        frame, vesicle = np.argwhere(wrong)[0]
        raise ValueError(
            f"the trajectory is damaged: at frame {frame} vesicle {vesicle} is not finite ({wrong.any(axis=1).sum()} of {len(trajectory)} "
            "frames have such vesicles); `biem verify` checks the whole file"
        )


def unfinished(trajectory: Trajectory, problem: Problem) -> str | None:
    """What is to be said of a run that has not come to its horizon; None of one that has."""
    if trajectory.t[-1] >= problem.horizon * (1 - 1e-9):
        return None
    return (
        f"the run has not come to its horizon: it has committed {len(trajectory)} frame(s), to t = {trajectory.t[-1]:.6g} of "
        f"{problem.horizon:.6g}"
    )


def _is_trajectory(path: Path) -> bool:
    try:
        with h5py.File(path, "r") as file:
            return "X" in file and file.attrs.get("schema") == SCHEMA
    except OSError:
        return False
