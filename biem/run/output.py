"""What a run leaves: frames and checkpoints, in files written by the first rank, or in memory. Where a run begins or goes on."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

from biem.ranks import Ranks
from biem.run.checkpoint import (
    Checkpoint,
    checkpoint_path,
    prepare_checkpoint,
    read_checkpoint,
    remove_checkpoints,
    write_checkpoint,
)
from biem.run.trajectory import Trajectory, TrajectoryWriter, exists, join, read_trajectory
from biem.scene.build import Problem
from biem.scene.config import make_scene
from biem.scene.plan import trajectory_bytes
from biem.scene.tables import flat


class Output:
    """Frames and checkpoints of one run. path: None keeps the frames in memory, on every rank, and makes no checkpoints."""

    def __init__(
        self, problem: Problem, path: Path | None, start: Checkpoint, attributes: dict, earlier: Trajectory, resume: bool, ranks: Ranks
    ) -> None:
        self.path = path
        self._ranks = ranks
        self._attributes = attributes
        self._frames = [earlier]
        self._writer: Any = None
        if path is not None:
            begin = lambda: _start_files(problem, path, start, attributes, earlier, resume)
            self._writer = ranks.on_root(begin, share=False)

    def frame(self, make: Callable[[], Trajectory]) -> None:
        """Adds the frame that make() gives."""
        if self.path is None:
            self._frames.append(make())
        else:
            self._ranks.on_root(lambda: self._writer.append(make()), share=False)

    def checkpoint(self, make: Callable[[], Checkpoint]) -> None:
        """Writes the checkpoint that make() gives."""
        path = self.path
        if path is not None:
            self._ranks.on_root(lambda: write_checkpoint(checkpoint_path(path), make()), share=False)

    def close(self) -> None:
        """All frames in one file."""
        self._ranks.on_root(lambda: None if self._writer is None else self._writer.close(), share=False)

    def trajectory(self) -> Trajectory | None:
        """All frames; of a run that went into a file, on the first rank alone."""
        if self.path is None:
            return join(self._frames, self._attributes)
        return read_trajectory(self.path) if self._ranks.rank == 0 else None


def where_to_resume(path: Path | None, scene: str, resume: bool, force: bool) -> tuple[Checkpoint, Trajectory] | None:
    """The checkpoint to go on from and the frames up to it; None for a new run. Raises ValueError where the two do not go together."""
    if path is None and resume:
        raise ValueError("resume needs the output of the run to go on with")
    if path is not None and exists(path) and not (resume or force):
        raise ValueError(f"output {path} exists: use --force to replace it or --resume to go on")
    if resume and force:
        raise ValueError("--resume goes on with the output, --force replaces it: give one of them")
    if path is None or not resume:
        return None
    read_checkpoint(checkpoint_path(path))  # says so if there is none at all
    frames = read_trajectory(path)
    start = read_checkpoint(checkpoint_path(path), str(frames.attributes.get("run")))
    _check_same_scene(start.scene, scene)
    return start, frames.until(start.step)


def _start_files(problem: Problem, path: Path, start: Checkpoint, attributes: dict, earlier: Trajectory, resume: bool) -> TrajectoryWriter:
    """Trajectory and checkpoint of a run that begins or goes on; what --force replaces is there until both could be written."""
    _check_space(problem, path)
    path.absolute().parent.mkdir(parents=True, exist_ok=True)
    if resume:
        return TrajectoryWriter(path, attributes, [earlier])
    checkpoint = checkpoint_path(path)
    prepare_checkpoint(checkpoint, start)
    try:
        writer = TrajectoryWriter(path, attributes, [earlier])
    except BaseException:
        checkpoint.with_name(checkpoint.name + ".next").unlink(missing_ok=True)
        raise
    remove_checkpoints(checkpoint)
    write_checkpoint(checkpoint, start)
    return writer


def _check_same_scene(old: str, new: str) -> None:
    """A run may be resumed with a longer horizon and other output settings; nothing else may differ."""
    a, b = (flat(make_scene(json.loads(scene)).model_dump(mode="json")) for scene in (old, new))  # keys that came later: defaults
    free = ("time.horizon", "output.trajectory", "output.checkpoint_every")
    differ = [k for k in sorted(a.keys() | b.keys()) if a.get(k) != b.get(k) and not k.startswith(free)]
    if differ:
        what = "; ".join(f"{k} was {a.get(k)!r}, is {b.get(k)!r}" for k in differ[:4])
        raise ValueError(f"the checkpoint is of another scene: {what}; resume with the old values or start anew with --force")


def _check_space(problem: Problem, path: Path) -> None:
    folder = path.absolute().parent
    while not folder.exists():
        folder = folder.parent
    needed, free = 2.2 * trajectory_bytes(problem), shutil.disk_usage(folder).free  # merging holds two copies
    if needed > free:
        raise ValueError(
            f"output {path} needs about {needed / 1e6:.2g} MB, {free / 1e6:.2g} MB are free: raise time.save_every or choose another disk"
        )
