"""Checks of a data folder: manifests, every file against its manifest, values, splits, the joined file, and some labels computed again.

Each problem is one line that names the file. Stages that have not been made are no problem; what has been made must be whole.
"""

from __future__ import annotations

import hashlib
import io
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import h5py
import numpy as np
from tqdm import tqdm

from biem.run.files import one_line
from biem.scene.tables import validated
from datagen.config import SPLITS, Label
from datagen.manifest import Column, Manifest, Shard, manifest_paths, read_manifest, read_manifests
from datagen.shards import Arrays, damage, dataset_names, shard_name, sources
from datagen.stages import HARVEST, SHAPES, SHAPES_MANIFEST, LabelSet, label_sets

TOLERANCE = 1e-6  # of a row's largest value: labels computed again on another machine; on the same one they are equal
BATCH = 64  # shapes whose labels are computed again at once


@dataclass
class Checked:
    """problems: a line each; found: a line for each stage, what was looked at."""

    problems: list[str] = field(default_factory=list)
    found: list[str] = field(default_factory=list)


@dataclass(frozen=True)
class _Folder:
    """A manifest, and the arrays of its sound shards that are kept for the checks between files."""

    manifest: Manifest
    kept: Mapping[str, Arrays]


def verify(data: Path, seed: int = 0, fraction: float = 0.01, progress: bool = False) -> Checked:
    """All checks of a data folder. seed, fraction: which labels are computed again, at least one. Raises ValueError if there is no data."""
    checked = Checked()
    sets = label_sets(data)
    if not sets and not any((data / name).exists() for name in (HARVEST, SHAPES, SHAPES_MANIFEST)):
        raise ValueError(f"{data} holds no data set: give the folder that `python -m datagen` has written to")
    harvest = _shards(data / HARVEST, (), "shapes", checked, progress)
    shapes = _shapes(data, checked)
    if harvest and shapes:
        _check_follows(data / SHAPES_MANIFEST, shapes.manifest, data / HARVEST, harvest.manifest, checked)
    for files in sets:
        labels = _shards(files.folder, ("run", "split", "shape"), "pairs", checked, progress)
        if labels and not shapes and not (data / SHAPES).exists():
            checked.problems.append(f"{data / SHAPES} is missing, the labels in {files.folder} are of its shapes")
        if labels and shapes:
            follows = _check_follows(files.folder, labels.manifest, data / SHAPES, shapes.manifest, checked)
            if shapes.kept:
                _check_pairs(files.folder, shapes.kept[SHAPES], labels, checked)
            if shapes.kept and follows:
                _recompute(files.folder, shapes.kept[SHAPES], labels, np.random.default_rng(seed), fraction, checked, progress)
        if labels and labels.manifest.complete:
            _check_joined(files, labels, checked)
        elif files.pairs.exists() and not files.folder.exists():
            checked.problems.append(f"{files.pairs} joins shards that are not there: run `python -m datagen label`")
    return checked


def _shards(folder: Path, keep: tuple[str, ...], unit: str, checked: Checked, progress: bool) -> _Folder | None:
    """The checks of a folder of shards; None where it has no readable manifest."""
    if not folder.exists():
        return None
    try:
        manifest = read_manifests(folder)
        if manifest is None:
            raise ValueError(f"{folder} has no manifest: run the stage that made it")
    except ValueError as error:
        checked.problems.append(str(error))
        return None
    expected = [shard_name(task) for task in range(manifest.tasks)]
    listed = {shard.file for shard in manifest.shards}
    missing = [name for name in expected if name not in listed]
    if missing:
        some = ", ".join(missing[:4]) + (", ..." if len(missing) > 4 else "")
        checked.problems.append(f"{folder}: {len(missing)} of {manifest.tasks} shards are not there yet: {some}")
    known = listed.intersection(expected) | {path.name for path in manifest_paths(folder)}
    for path in sorted(folder.iterdir()):
        if path.name not in known:
            checked.problems.append(f"{path} is unexpected: no task makes it" if path.name not in missing else f"{path} is in no manifest")
    kept = {}
    for shard in tqdm(manifest.shards, desc=folder.name, disable=not progress, leave=False):
        arrays = _check_shard(folder / shard.file, shard, manifest.columns, keep, checked)
        if arrays is not None:
            kept[shard.file] = arrays
    checked.found.append(f"{folder}: {len(kept)} of {manifest.tasks} shards, {manifest.rows} {unit}")
    return _Folder(manifest, kept)


def _shapes(data: Path, checked: Checked) -> _Folder | None:
    path = data / SHAPES_MANIFEST
    if not path.exists():
        if (data / SHAPES).exists():
            checked.problems.append(f"{data / SHAPES} was not finished: it has no {path.name}, run `python -m datagen select`")
        return None
    try:
        manifest = read_manifest(path)
        if [shard.file for shard in manifest.shards] != [SHAPES]:
            raise ValueError(f"{path} does not list {SHAPES} alone")
    except ValueError as error:
        checked.problems.append(str(error))
        return None
    arrays = _check_shard(data / SHAPES, manifest.shards[0], manifest.columns, ("coefficients", "run", "split"), checked)
    if arrays is None:
        return _Folder(manifest, {})
    run, split = arrays["run"], arrays["split"]
    if not np.isin(split, range(len(SPLITS))).all():
        checked.problems.append(f"{data / SHAPES}: split has values beyond 0..{len(SPLITS) - 1}")
    both = np.unique(np.stack([run, split]), axis=1)
    for shared in np.unique(both[0, 1:][both[0, 1:] == both[0, :-1]]):
        where = ", ".join(SPLITS[s] for s in both[1, both[0] == shared] if 0 <= s < len(SPLITS))
        checked.problems.append(f"{data / SHAPES}: run {shared} is in more than one split: {where}")
    sizes = ", ".join(f"{(split == k).sum()} {name}" for k, name in enumerate(SPLITS))
    checked.found.append(f"{data / SHAPES}: {len(run)} shapes ({sizes}) of {len(np.unique(run))} runs")
    return _Folder(manifest, {SHAPES: arrays})


def _check_shard(path: Path, shard: Shard, columns: Mapping[str, Column], keep: tuple[str, ...], checked: Checked) -> Arrays | None:
    """Some arrays of a shard; None, and a problem, where the file is not as it was written."""
    content = _content(path, shard, checked)
    if content is None:
        return None
    try:
        with h5py.File(io.BytesIO(content), "r") as file:
            return _check_columns(path, file, shard.rows, columns, keep, checked)
    except (OSError, KeyError, RuntimeError) as error:
        checked.problems.append(f"{path} cannot be read: {one_line(error)}")
        return None


def _content(path: Path, shard: Shard, checked: Checked) -> bytes | None:
    """The bytes of a file, if they are those that were written: HDF5 may crash on others."""
    wrong = damage(path, shard)
    content = b"" if wrong else path.read_bytes()
    if not wrong and hashlib.sha256(content).hexdigest() != shard.sha256:
        wrong = "is not as it was written: sha256 differs"
    if wrong:
        checked.problems.append(f"{path} {wrong}")
    return None if wrong else content


def _check_columns(
    path: Path, file: h5py.File, rows: int, columns: Mapping[str, Column], keep: tuple[str, ...], checked: Checked
) -> Arrays | None:
    names = dataset_names(file)
    if names != sorted(columns):
        odd = ", ".join(sorted(set(names) ^ set(columns)))
        checked.problems.append(f"{path}: datasets that only it, or only its manifest, has: {odd}")
        return None
    sound = True
    for name, column in columns.items():
        dataset = file[name]
        if dataset.shape != (rows, *column.shape) or dataset.dtype.str != column.dtype:
            expected = f"{column.dtype} {(rows, *column.shape)}"
            checked.problems.append(f"{path}: {name} is {dataset.dtype.str} {dataset.shape}, the manifest says {expected}")
            sound = False
        elif dataset.dtype.kind in "fc":
            bad = int(np.count_nonzero(~np.isfinite(dataset[()])))
            if bad:
                checked.problems.append(f"{path}: {bad} values of {name} are not finite")
                sound = False
    return {name: file[name][()] for name in keep} if sound else None


def _check_follows(path: Path, later: Manifest, before: Path, earlier: Manifest, checked: Checked) -> bool:
    """Whether a stage was made from the one before it as it is now."""
    differ = [key for key, value in earlier.settings.items() if later.settings.get(key) != value]
    if differ:
        checked.problems.append(f"{path}: {', '.join(differ)} are not the settings of {before}")
    if later.input != earlier.digest and earlier.complete:
        checked.problems.append(f"{path} was not made from {before} as it is now: make it anew with --force")
        return False
    return not differ


def _check_pairs(folder: Path, shapes: Arrays, labels: _Folder, checked: Checked) -> None:
    """Whether each pair is of the shape, run and split that it says."""
    start = 0
    chunk = labels.manifest.settings["label"]["chunk"]
    for task in range(labels.manifest.tasks):
        arrays = labels.kept.get(shard_name(task))
        start = task * chunk
        if arrays is None:
            continue
        path = folder / shard_name(task)
        rows = np.arange(start, min(start + chunk, len(shapes["run"])))
        if not np.array_equal(arrays["shape"], rows):
            checked.problems.append(f"{path}: its rows are not the shapes {start} to {start + len(rows) - 1}")
            continue
        for name in ("run", "split"):
            if not np.array_equal(arrays[name], shapes[name][rows]):
                checked.problems.append(f"{path}: {name} differs from that of the shapes")


def _check_joined(files: LabelSet, labels: _Folder, checked: Checked) -> None:
    path, manifest = files.pairs, labels.manifest
    problems: list[str] = []
    try:
        if not files.manifest.exists():
            raise ValueError("it has not been made from all parts of the labels")
        joined = read_manifest(files.manifest)
        if [shard.file for shard in joined.shards] != [path.name] or joined.input != manifest.digest:
            raise ValueError("it was not made from the labels as they are now")
        if _content(path, joined.shards[0], checked) is None:
            return
        with h5py.File(path, "r") as file:
            names = dataset_names(file)
            for name in sorted(set(names) ^ set(manifest.columns)):
                problems.append(f"{path}: {name} is in it, or in the shards, alone")
            for name in sorted(set(names) & set(manifest.columns)):
                if not _joins(file[name], manifest.columns[name], manifest, files.folder.name):
                    problems.append(f"{path}: {name} does not join all shards in their order")
            sound = not problems and len(labels.kept) == manifest.tasks  # what is damaged is not read, HDF5 may crash on it
            if sound and not np.array_equal(file["shape"][()], np.arange(manifest.rows)):
                problems.append(f"{path}: its rows are not the shapes in their order")
    except (OSError, KeyError, RuntimeError, ValueError) as error:
        problems.append(f"{path}: {one_line(error)}")
    checked.problems += [f"{problem}: run `python -m datagen label`" for problem in problems]
    if not problems:
        checked.found.append(f"{path}: {manifest.rows} pairs, {len(manifest.columns)} datasets")


def _joins(dataset: h5py.Dataset, column: Column, manifest: Manifest, folder: str) -> bool:
    if not dataset.is_virtual or dataset.shape != (manifest.rows, *column.shape) or dataset.dtype.str != column.dtype:
        return False
    ends = np.cumsum([shard.rows for shard in manifest.shards]).tolist()
    name = dataset.name.lstrip("/")
    expected = [(f"{folder}/{s.file}", name, end - s.rows, end) for s, end in zip(manifest.shards, ends, strict=True) if s.rows]
    return sources(dataset) == expected and (dataset.dtype.kind not in "fc" or bool(np.isnan(dataset.fillvalue)))


def _recompute(
    folder: Path, shapes: Arrays, labels: _Folder, random: np.random.Generator, fraction: float, checked: Checked, progress: bool
) -> None:
    """Computes the labels of some shapes again, of those whose shards are sound."""
    from datagen.label import label_shapes
    from datagen.shapes import decode

    label = validated(Label, labels.manifest.settings["label"])
    sound = np.concatenate([a["shape"] for a in labels.kept.values()]) if labels.kept else np.zeros(0, dtype=int)
    sound = sound[sound < len(shapes["run"])]
    if not len(sound):
        return
    rows = np.sort(random.choice(sound, min(len(sound), max(1, round(fraction * labels.manifest.rows))), replace=False))
    before = len(checked.problems)
    for some in tqdm(np.split(rows, range(BATCH, len(rows), BATCH)), desc="labels again", disable=not progress, leave=False):
        again = label_shapes(decode(shapes["coefficients"][some], label.operator_points), label)
        for task in np.unique(some // label.chunk):
            here = some // label.chunk == task
            path = folder / shard_name(int(task))
            with h5py.File(path, "r") as file:
                for name, values in again.items():
                    _compare(path, name, some[here], values[here], file[name][some[here] - task * label.chunk], checked)
    if len(checked.problems) == before:
        checked.found.append(f"{folder}: the labels of {len(rows)} shape(s), computed again, are the same")


def _compare(path: Path, name: str, rows: np.ndarray, again: np.ndarray, stored: np.ndarray, checked: Checked) -> None:
    axes = tuple(range(1, stored.ndim))
    largest = np.abs(stored).max(axis=axes, initial=0.0)
    error = np.abs(again - stored).max(axis=axes, initial=0.0)
    bad = np.flatnonzero(~(error <= TOLERANCE * largest))
    if len(bad):
        k = bad[0]
        more = f" and {len(bad) - 1} more" if len(bad) > 1 else ""
        off = f"{error[k]:.2g} beside values to {largest[k]:.2g}"
        checked.problems.append(f"{path}: {name} of shape {rows[k]}{more} is off by {off} when computed again")
