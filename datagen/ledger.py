"""The ledger of a stage that fills a folder with shards: which are there, which are to be made, and the manifest, as results come."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from pathlib import Path

from datagen.manifest import (
    WHOLE,
    Column,
    Manifest,
    Part,
    Shard,
    check_columns,
    check_same,
    manifest_paths,
    read_manifest,
    read_manifests,
    write_manifest,
)
from datagen.shards import damage, shard_name

SHARD = re.compile(r"\.?(\d{6})\.h5(?:\.\d+\.tmp)?")  # a shard, or what a killed process left of one


class Ledger:
    """Of the first rank. todo: tasks whose shards are to be made; notices: a line for each shard that must be made again.

    Opening it checks that what is in the folder belongs to the same data set, removes what killed runs left of this part, and writes the
    manifest: a folder that cannot be written is known before anything is computed. That of the whole is the only one from then on.
    Raises ValueError, OSError.
    """

    def __init__(self, folder: Path, wanted: Manifest, part: Part = WHOLE, force: bool = False) -> None:
        if force and part != WHOLE:
            raise ValueError("--force starts the whole folder anew, --part makes some of its shards: give one of them")
        self.folder, self.part, self._manifest = folder, part, wanted
        folder.mkdir(parents=True, exist_ok=True)
        if force:
            self._clear()
        found = read_manifests(folder) or wanted
        check_same(folder, found, wanted)
        known = {shard.file: shard for path in manifest_paths(folder) for shard in read_manifest(path).shards}
        good = {shard.file: shard for shard in found.shards if not damage(folder / shard.file, shard)}
        mine = {task: shard_name(task) for task in range(wanted.tasks) if part.has(task)}
        self.todo = [task for task, name in mine.items() if name not in good]
        self.notices = [
            f"{folder / name} {damage(folder / name, known[name]) or 'is in two manifests with different contents'}: made again"
            for name in mine.values()
            if name in known and name not in good
        ]
        for path in folder.iterdir():
            of = SHARD.fullmatch(path.name)
            if (of and part.has(int(of[1])) and path.name not in good) or self._is_leftover(path.name):
                path.unlink(missing_ok=True)
        own = folder / part.manifest
        kept = good.keys() if part == WHOLE else {shard.file for shard in read_manifest(own).shards} if own.exists() else set()
        self._shards = {name: shard for name, shard in good.items() if name in kept}
        self._write(found.columns)
        for path in manifest_paths(folder) if part == WHOLE else ():
            if path != own:  # all that they know is in the one that has just been written
                path.unlink()

    def acknowledge(self, made: Iterable[tuple[Shard, Mapping[str, Column]]]) -> None:
        """Enters shards into the manifest. Raises ValueError for one with other columns, OSError where it cannot be written."""
        columns = self._manifest.columns
        for shard, its_columns in made:
            check_columns(self.folder / shard.file, its_columns, columns)
            columns = columns or dict(its_columns)
            self._shards[shard.file] = shard
        self._write(columns)

    def everything(self) -> Manifest:
        """What is in the folder by now, from all parts."""
        return read_manifests(self.folder) or self._manifest

    def _write(self, columns: Mapping[str, Column]) -> None:
        self._manifest = self._manifest.having(self._shards.values(), columns)
        write_manifest(self.folder / self.part.manifest, self._manifest)

    def _clear(self) -> None:
        """Manifests go first: what is left by a kill in between is no part of anything."""
        for path in manifest_paths(self.folder):
            path.unlink()
        for path in self.folder.iterdir():
            if SHARD.fullmatch(path.name) or self._is_leftover(path.name):
                path.unlink()

    def _is_leftover(self, name: str) -> bool:
        """Whether this is the temporary file of a manifest of this part; of any, if this is the whole."""
        return name.startswith(".manifest." if self.part == WHOLE else f".{self.part.manifest}.") and name.endswith(".tmp")
