"""What a run leaves: frames and checkpoints, in files written by the first rank, or in memory. Where a run begins or goes on."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

from biem.observe.observables import Observations, Observer
from biem.ranks import Ranks
from biem.run.checkpoint import (
    Checkpoint,
    checkpoint_path,
    prepare_checkpoint,
    read_checkpoint,
    remove_checkpoints,
    write_checkpoint,
)
from biem.run.observe import Recorder, observables_path, rows_to_resume
from biem.run.trajectory import Trajectory, TrajectoryWriter, exists, join, read_trajectory
from biem.scene.build import Problem
from biem.scene.config import make_scene
from biem.scene.plan import trajectory_bytes
from biem.scene.tables import flat
from biem.steppers.stepper import State


class Output:
    """Frames and checkpoints of one run. path: None keeps the frames in memory, on every rank, and makes no checkpoints."""

    def __init__(
        self,
        problem: Problem,
        path: Path | None,
        start: Checkpoint,
        attributes: dict,
        earlier: Trajectory,
        resume: bool,
        ranks: Ranks,
        observer: tuple[Observer, int] | None = None,
    ) -> None:
        self.path = path
        self._ranks = ranks
        self._attributes = attributes
        self._frames = [earlier]
        self._writer: Any = None
        self._recorder: Recorder | None = None
        self._every = None if observer is None else observer[1]  # steps between observations, on every rank
        if path is None:
            self._recorder = None if observer is None else _recorder(observer[0], attributes, None, None, start)
        else:
            begin = lambda: _start_files(problem, path, start, attributes, earlier, resume, observer)
            self._writer, self._recorder = ranks.on_root(begin, share=False) or (None, None)

    def frame(self, make: Callable[[], Trajectory]) -> None:
        """Adds the frame that make() gives."""
        if self.path is None:
            self._frames.append(make())
        else:
            self._ranks.on_root(lambda: self._writer.append(make()), share=False)

    def observe(self, state: State, step: int, last: bool) -> None:
        """Adds the row of observables of a state, where one is due."""
        if self._every is not None and (step % self._every == 0 or last):
            record = lambda: None if self._recorder is None else self._recorder.record(state, step)
            if self.path is None:
                record()
            else:
                self._ranks.on_root(record, share=False)

    def checkpoint(self, make: Callable[[], Checkpoint]) -> None:
        """Writes the checkpoint that make() gives."""
        path = self.path
        if path is not None:
            self._ranks.on_root(lambda: self._write_checkpoint(path, make()), share=False)

    def _write_checkpoint(self, path: Path, checkpoint: Checkpoint) -> None:
        if self._recorder is not None:
            self._recorder.commit()  # a run goes on from a checkpoint with the rows before it
        write_checkpoint(checkpoint_path(path), checkpoint)

    def close(self) -> None:
        """All frames, and all rows of observables, in one file."""
        self._ranks.on_root(self._close, share=False)

    def _close(self) -> None:
        if self._recorder is not None:
            self._recorder.close()
        if self._writer is not None:
            self._writer.close()

    def observations(self) -> Observations | None:
        """All rows of observables, of a run that has any; of one that went into a file, on the first rank alone."""
        return None if self._recorder is None else self._recorder.rows()

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
    if path is not None and "observe" in json.loads(scene) and observables_path(path).exists() and not (resume or force):
        raise ValueError(f"output {observables_path(path)} exists, without its trajectory: use --force to replace it")
    if resume and force:
        raise ValueError("--resume goes on with the output, --force replaces it: give one of them")
    if path is None or not resume:
        return None
    read_checkpoint(checkpoint_path(path))  # says so if there is none at all
    frames = read_trajectory(path)
    start = read_checkpoint(checkpoint_path(path), str(frames.attributes.get("run")))
    _check_same_scene(start.scene, scene)
    return start, frames.until(start.step)


def _start_files(
    problem: Problem,
    path: Path,
    start: Checkpoint,
    attributes: dict,
    earlier: Trajectory,
    resume: bool,
    observer: tuple[Observer, int] | None,
) -> tuple[TrajectoryWriter, Recorder | None]:
    """Trajectory and checkpoint of a run that begins or goes on; what --force replaces is there until both could be written.

    With observables, also what records them: their file is begun last, and found before anything is touched.
    """
    file = observables_path(path)
    rows = rows_to_resume(file, start.run, start.step) if resume and observer is not None else None
    _check_space(path, trajectory_bytes(problem) + (0.0 if observer is None else problem.steps / observer[1] * observer[0].bytes))
    path.absolute().parent.mkdir(parents=True, exist_ok=True)
    writer = TrajectoryWriter(path, attributes, [earlier]) if resume else _start_anew(path, start, attributes, earlier)
    return writer, None if observer is None else _recorder(observer[0], attributes, file, rows, start)


def _recorder(observer: Observer, attributes: dict, file: Path | None, rows: Observations | None, start: Checkpoint) -> Recorder:
    """What records observables from the start on, the row of the initial state included. rows: those before a restart."""
    recorder = Recorder(observer, attributes, file, rows)
    if rows is None:
        recorder.record(start.state, start.step)
    return recorder


def _start_anew(path: Path, start: Checkpoint, attributes: dict, earlier: Trajectory) -> TrajectoryWriter:
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


def _check_space(path: Path, size: float) -> None:
    """size: bytes of what a run leaves."""
    folder = path.absolute().parent
    while not folder.exists():
        folder = folder.parent
    needed, free = 2.2 * size, shutil.disk_usage(folder).free  # merging holds two copies
    if needed > free:
        raise ValueError(
            f"output {path} needs about {needed / 1e6:.2g} MB, {free / 1e6:.2g} MB are free: raise time.save_every or choose another disk"
        )
