"""Shards: immutable HDF5 files of arrays with one row for each shape or pair, and one file that joins them.

The bytes of a shard depend on its arrays alone. The joining file holds no data: it refers to the shards beside it, by relative names.
"""

from __future__ import annotations

import hashlib
import io
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

import h5py
import numpy as np

from biem.run.files import atomic_h5, one_line
from datagen.manifest import Column, Manifest, Shard, read_manifest, read_manifests

Arrays = dict[str, np.ndarray]


def shard_name(task: int) -> str:
    return f"{task:06d}.h5"


def write_shard(path: Path, arrays: Mapping[str, np.ndarray]) -> tuple[Shard, dict[str, Column]]:
    """Writes a shard, whole or not at all. Names of arrays may have groups, as in "advection/3". Raises ValueError, OSError."""
    rows = {len(array) for array in arrays.values()}
    if len(rows) != 1:
        raise ValueError(f"{path}: the arrays of a shard need one number of rows, got {sorted(rows)}")
    with atomic_h5(path) as file:
        for name in sorted(arrays):
            file.create_dataset(name, data=arrays[name], track_times=False)
    columns = {name: Column(shape=list(array.shape[1:]), dtype=array.dtype.str) for name, array in sorted(arrays.items())}
    return _entry(path, rows.pop()), columns


def _entry(path: Path, rows: int) -> Shard:
    content = path.read_bytes()
    return Shard(file=path.name, rows=rows, bytes=len(content), sha256=hashlib.sha256(content).hexdigest())


def read_shard(path: Path, shard: Shard) -> Arrays:
    """All arrays of an acknowledged shard. Raises ValueError unless it is, byte for byte, what was acknowledged."""
    try:
        content = path.read_bytes()
    except FileNotFoundError:
        raise ValueError(f"{path} is missing: make it again by the stage that made it") from None
    if hashlib.sha256(content).hexdigest() != shard.sha256:
        raise ValueError(f"{path} is not as it was written (sha256 differs): remove it and make it again by the stage that made it")
    with h5py.File(io.BytesIO(content), "r") as file:
        return {name: file[name][()] for name in dataset_names(file)}


def dataset_names(file: h5py.File) -> list[str]:
    """Paths of all datasets, in order."""
    names: list[str] = []
    file.visititems(lambda name, item: names.append(name) if isinstance(item, h5py.Dataset) else None)
    return sorted(names)


def damage(path: Path, shard: Shard) -> str | None:
    """What is wrong with a shard as far as its size tells; None if nothing is."""
    try:
        size = path.stat().st_size
    except (FileNotFoundError, NotADirectoryError):
        return "is missing"
    return None if size == shard.bytes else f"has {size} bytes, was written with {shard.bytes}"


def join_shards(path: Path, folder: Path, manifest: Manifest) -> Shard:
    """A file of virtual datasets over all shards in a folder below that of `path`, in the order of the tasks.

    Floating values of a shard that is not there would read as NaN, others as zeros: read the file through `open_joined`.
    """
    source = folder.relative_to(path.parent)
    with atomic_h5(path) as file:
        for name, column in manifest.columns.items():
            dtype = np.dtype(column.dtype)
            layout = h5py.VirtualLayout((manifest.rows, *column.shape), dtype)
            layout.dcpl.set_obj_track_times(False)
            start = 0
            for shard in manifest.shards:
                if shard.rows:
                    rows = slice(start, start + shard.rows)
                    layout[rows] = h5py.VirtualSource(str(source / shard.file), name, (shard.rows, *column.shape), dtype)
                start += shard.rows
            file.create_virtual_dataset(name, layout, fillvalue=dtype.type(np.nan) if dtype.kind in "fc" else None)
    return _entry(path, manifest.rows)


def sources(dataset: h5py.Dataset) -> list[tuple[str, str, int, int]]:
    """What a virtual dataset is made of: (file, dataset, first row, row after the last)."""
    parts = [(part, part.vspace.get_select_bounds()) for part in dataset.virtual_sources()]
    return [(part.file_name, part.dset_name, int(first[0]), int(last[0]) + 1) for part, (first, last) in parts]


@contextmanager
def open_joined(path: str | Path) -> Iterator[h5py.File]:
    """The joined file, to read. Raises ValueError where a shard is missing or of another size: it would read as if it were there."""
    path = Path(path)
    try:
        file = h5py.File(path, "r")
    except OSError as error:
        raise ValueError(f"{path} cannot be read: {one_line(error)}; make it with `python -m datagen label`") from None
    with file:
        names = dataset_names(file)
        if not names or not file[names[0]].is_virtual:
            raise ValueError(f"{path} joins no shards: make it with `python -m datagen label`")
        folder = (path.parent / file[names[0]].virtual_sources()[0].file_name).parent
        manifest = read_manifests(folder)
        if manifest is None:
            raise ValueError(f"{folder} has no manifest: restore the shards that {path} joins, or make them with `python -m datagen label`")
        for shard in manifest.shards:
            wrong = damage(folder / shard.file, shard)
            if wrong:
                raise ValueError(f"{folder / shard.file} {wrong}: make it again with `python -m datagen label`")
        shapes = path.parent / "shapes.json"
        if shapes.exists() and read_manifest(shapes).digest != manifest.input:
            raise ValueError(f"{path} is of other shapes than {path.parent / 'shapes.h5'} holds now: `python -m datagen label --force`")
        if not manifest.complete or any(len(file[name]) != manifest.rows for name in names):
            raise ValueError(f"{path} does not join what is in {folder} now: make it again with `python -m datagen label`")
        yield file
