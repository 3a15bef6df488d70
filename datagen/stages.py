"""The stages of a data set: harvest -> select -> label. Each makes what is missing of its files, from its settings and the stage before.

A stage is a function of a Session, called on all ranks. It returns when its files are complete, or, of a part, when the part is.
"""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Protocol

import h5py
import numpy as np
import typer
from tqdm import tqdm

from biem.backend import counting
from biem.errors import NumericalFailure
from biem.ranks import ALONE, Ranks
from biem.run.solver import check_device
from datagen.config import MAPS, Dataset, Label
from datagen.jobs import Report, run_tasks
from datagen.ledger import Ledger
from datagen.manifest import WHOLE, Column, Manifest, Part, Shard, check_same, read_manifest, read_manifests, write_manifest
from datagen.shards import Arrays, damage, join_shards, read_shard, shard_name, write_shard
from datagen.stop import Stopped, unless_stopped

HARVEST, SHAPES, SHAPES_MANIFEST = "harvest", "shapes.h5", "shapes.json"  # in the data folder
LABEL_SET = re.compile(r"labels(?:-([A-Za-z0-9_.-]+))?|pairs(?:-([A-Za-z0-9_.-]+))?\.h5")


@dataclass(frozen=True)
class LabelSet:
    """Where the labels of some settings lie; of the same shapes there may be several, with names. data: the data folder."""

    data: Path
    name: str = ""

    def __post_init__(self) -> None:
        if not LABEL_SET.fullmatch(self.folder.name):
            raise ValueError(f"--name {self.name}: expected letters, digits, and the signs . _ -")

    @property
    def _suffix(self) -> str:
        return f"-{self.name}" if self.name else ""

    @property
    def folder(self) -> Path:
        """Of the shards."""
        return self.data / f"labels{self._suffix}"

    @property
    def pairs(self) -> Path:
        """The file that joins them."""
        return self.data / f"pairs{self._suffix}.h5"

    @property
    def manifest(self) -> Path:
        """Of that file."""
        return self.pairs.with_suffix(".json")


def label_sets(data: Path) -> list[LabelSet]:
    """All sets of labels in a data folder, whole or not."""
    found = (LABEL_SET.fullmatch(path.name) for path in data.glob("*"))
    return [LabelSet(data, name) for name in sorted({match[1] or match[2] or "" for match in found if match})]


@dataclass(frozen=True)
class Session:
    """What a stage is asked to do. data: the data folder; labels: the name of the set of labels."""

    config: Dataset
    data: Path
    part: Part = WHOLE
    force: bool = False
    quiet: bool = False
    ranks: Ranks = ALONE
    labels: str = ""

    def say(self, line: str, aloud: bool = False) -> None:
        """A line of the first rank. aloud: to stderr, also when quiet."""
        if self.ranks.rank == 0 and (aloud or not self.quiet):
            typer.echo(line, err=aloud)


class Task(Protocol):
    @property
    def id(self) -> int: ...


@dataclass(frozen=True)
class Rows:
    """A task of labelling: rows start .. stop - 1 of the shapes."""

    id: int
    start: int
    stop: int


@dataclass(frozen=True)
class Made:
    """What travels of a task: all but its data."""

    shard: Shard
    columns: dict[str, Column]
    runs_ended: int  # early, as harvest counts them


def settings(config: Dataset, stage: str) -> dict[str, Any]:
    """What the files of a stage depend on: its own tables and those of the stages before it. Not the name, nor the device."""
    whole = config.model_copy(update={"label": resolved(config.label)}).model_dump(
        mode="json", exclude={"name": True, "simulation": {"device"}}
    )
    later = {"harvest": ("select", "label"), "select": ("label",), "label": ()}[stage]
    return {key: value for key, value in whole.items() if key not in later}


def resolved(label: Label) -> Label:
    """With the modes that None means; maps and modes in one order. Raises ValueError for modes that there are not."""
    from datagen.label import label_modes

    return label.model_copy(update={"modes": sorted(label_modes(label)), "maps": [name for name in MAPS if name in label.maps]})


def harvest_stage(session: Session) -> None:
    """Runs -> data/harvest/."""
    from datagen.harvest import harvest, harvest_tasks

    config, folder = session.config, session.data / HARVEST
    check_device(config.simulation.device, "simulation.device")
    tasks = harvest_tasks(config)
    _fill(session, folder, _harvest_wanted(config), tasks, partial(harvest, config), "shapes")


def select_stage(session: Session) -> None:
    """data/harvest/ -> data/shapes.h5, on the first rank alone."""
    session.ranks.on_root(lambda: _select(session), share=False)


def label_stage(session: Session) -> None:
    """data/shapes.h5 -> data/labels/, and data/pairs.h5 when they are complete."""
    data, label, files = session.data, resolved(session.config.label), LabelSet(session.data, session.labels)
    shapes = session.ranks.on_root(lambda: finished_shapes(session.config, data))
    n = shapes.rows
    tasks = [Rows(k, start, min(start + label.chunk, n)) for k, start in enumerate(range(0, n, label.chunk))]
    wanted = Manifest(stage="label", settings=settings(session.config, "label"), input=shapes.digest, tasks=len(tasks))
    everything = _fill(session, files.folder, wanted, tasks, partial(label_rows, data / SHAPES, label), "pairs")
    if session.part == WHOLE:
        session.ranks.on_root(lambda: _join(session, files, everything), share=False)


def label_rows(path: Path, label: Label, rows: Rows) -> Arrays:
    """The pairs of some rows of the shapes file."""
    from datagen.label import label_shapes
    from datagen.shapes import decode

    some = slice(rows.start, rows.stop)
    with h5py.File(path, "r") as file:
        coefficients, split, run = (file[name][some] for name in ("coefficients", "split", "run"))
    pairs = label_shapes(decode(coefficients, label.operator_points), label)
    return {**pairs, "split": split, "run": run, "shape": np.arange(rows.start, rows.stop)}


def finished_shapes(config: Dataset, data: Path) -> Manifest:
    """The manifest of data/shapes.h5. Raises ValueError unless it is there, of these settings, and as it was written."""
    path = data / SHAPES_MANIFEST
    if not path.exists():
        raise ValueError(f"{data / SHAPES} is not there or not finished: run `python -m datagen select` first")
    found = read_manifest(path)
    check_same(path, found, Manifest(stage="select", settings=settings(config, "select"), input=found.input, tasks=1))
    if not found.rows:
        raise ValueError(f"{data / SHAPES} holds no shapes: nothing to label; harvest longer, or select with a smaller select.distance")
    read_shard(data / SHAPES, found.shards[0])
    return found


def _harvest_wanted(config: Dataset) -> Manifest:
    from datagen.harvest import harvest_tasks

    return Manifest(stage="harvest", settings=settings(config, "harvest"), input=None, tasks=len(harvest_tasks(config)))


def _select(session: Session) -> None:
    from datagen.coverage import report, summary
    from datagen.select import select

    config, data = session.config, session.data
    folder, path = data / HARVEST, data / SHAPES_MANIFEST
    harvested = read_manifests(folder)
    if harvested is None:
        raise ValueError(f"{folder} has no manifest: run `python -m datagen harvest` first")
    check_same(folder, harvested, _harvest_wanted(config))
    if not harvested.complete:
        missing = f"{len(harvested.shards)} of {harvested.tasks} shards"
        raise ValueError(f"{folder} has {missing}: run `python -m datagen harvest` again, or its other parts, first")
    wanted = Manifest(stage="select", settings=settings(config, "select"), input=harvested.digest, tasks=1)
    if path.exists() and not session.force:
        found = read_manifest(path)
        check_same(path, found, wanted)
        wrong = damage(data / SHAPES, found.shards[0])
        if not wrong:
            session.say(f"select: {data / SHAPES} is there, {found.rows} shapes")
            return
        session.say(f"{data / SHAPES} {wrong}: made again", aloud=True)
    shapes = unless_stopped(lambda: select(config, (read_shard(folder / shard.file, shard) for shard in harvested.shards)))
    for old in (path, *data.glob(".shapes.*.tmp")):
        old.unlink(missing_ok=True)
    shard, columns = write_shard(data / SHAPES, shapes)
    wanted = wanted.having([shard], columns)
    for files in label_sets(data):
        labels = read_manifests(files.folder)
        if labels is not None and labels.input != wanted.digest:
            session.say(
                f"{files.folder} holds labels of other shapes now: make them anew with `python -m datagen label --force`", aloud=True
            )
    statistics = report(shapes, data, config.seed, [family.flow for family in config.harvest])
    write_manifest(path, wanted)  # last: what it acknowledges is all there
    session.say(f"select: {shard.rows} of {harvested.rows} shapes in {data / SHAPES}")
    for line in summary(statistics):
        session.say(f"  {line}")


def _fill(session: Session, folder: Path, wanted: Manifest, tasks: Sequence[Task], compute: Callable[[Any], Arrays], unit: str) -> Manifest:
    """Makes the shards that are missing of a folder, of this part; all that is there then."""
    ranks, part = session.ranks, session.part
    ledger: Ledger = ranks.on_root(lambda: Ledger(folder, wanted, part, session.force), share=False)
    todo = [] if ledger is None else [tasks[k] for k in ledger.todo]
    mine = sum(part.has(k) for k in range(wanted.tasks))
    rows = runs_ended = 0
    begin = time.perf_counter()
    for notice in [] if ledger is None else ledger.notices:
        session.say(notice, aloud=True)
    with tqdm(
        total=mine,
        initial=mine - len(todo),
        desc=wanted.stage,
        unit="task",
        disable=session.quiet or not todo,
        dynamic_ncols=True,
        bar_format="{l_bar}{bar}| {n_fmt}/{total_fmt} tasks [{elapsed}<{remaining}{postfix}]",
    ) as bar:

        def acknowledge(made: list[Made]) -> None:
            ledger.acknowledge((one.shard, one.columns) for one in made)
            nonlocal rows, runs_ended
            rows += sum(one.shard.rows for one in made)
            runs_ended += sum(one.runs_ended for one in made)
            bar.set_postfix_str(f"{rows / (time.perf_counter() - begin):.3g} {unit}/s", refresh=False)
            bar.update(len(made))

        report = run_tasks(partial(_make, compute, folder), todo, acknowledge, ranks)
    everything = ranks.on_root(partial(Ledger.everything, ledger))
    for failure in sorted(report.failures, key=lambda f: f.task.id):
        session.say(f"failed: {folder / shard_name(failure.task.id)}: {failure.error}", aloud=True)
    _raise(report, everything, len(todo))
    has = f"{len(everything.shards)} of {everything.tasks} shards, {everything.rows} {unit} in {folder}"
    session.say(f"{wanted.stage}: {has}" if part == WHOLE else f"{wanted.stage}, {part}: done; {has}")
    if part != WHOLE and everything.complete:
        session.say("all parts are done: run the same command without --part to join them")
    if runs_ended:
        session.say(f"  {runs_ended} runs ended early, their later shapes are missing")
    return everything


def _make(compute: Callable[[Any], Arrays], folder: Path, task: Task) -> Made:
    with counting() as counts:
        arrays = compute(task)
    shard, columns = write_shard(folder / shard_name(task.id), arrays)
    return Made(shard, columns, counts["runs_ended"])


def _raise(report: Report, everything: Manifest, tasks: int) -> None:
    """Raises what a round of tasks ended with, if it did not end well."""
    if report.error:
        raise report.error
    if report.stopped:
        raise Stopped(f"stopped with {len(everything.shards)} of {everything.tasks} shards")
    if report.failures:
        raise NumericalFailure(f"{len(report.failures)} of {tasks} tasks failed twice and were set aside; run again to try them once more")


def _join(session: Session, files: LabelSet, labels: Manifest) -> None:
    for old in (files.manifest, *session.data.glob(f".{files.pairs.stem}.*.tmp")):
        old.unlink(missing_ok=True)
    shard = join_shards(files.pairs, files.folder, labels)
    write_manifest(files.manifest, labels.model_copy(update={"stage": "join", "input": labels.digest, "tasks": 1, "shards": [shard]}))
    session.say(f"label: {labels.rows} pairs joined in {files.pairs}")
