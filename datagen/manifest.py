"""Manifests: what a folder of shards holds, from which settings and which input it was made. A shard counts when it is in a manifest.

manifest.json; runs that share a folder as parts of a job array each write manifest.K-of-P.json. All are read as one.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import Field

from biem.cli import read_part
from biem.run.files import write_atomically
from biem.scene.tables import Table, flat, validated

VERSION = 1
MANIFEST = "manifest.json"
PART_MANIFEST = re.compile(r"manifest\.\d+-of-\d+\.json")


class Column(Table):
    """A dataset of the shards: its shape beyond the rows, and its dtype as NumPy writes it, such as "<f4"."""

    shape: list[int]
    dtype: str


class Shard(Table):
    """A file as it was when it was acknowledged. sha256: of all its bytes."""

    file: str
    rows: int
    bytes: int
    sha256: str


class Manifest(Table):
    """settings: what the stage depends on, of it and the stages before; input: digest of what it is made from; tasks: shards when complete.

    columns: of every shard, known with the first one. shards: the acknowledged ones, by their names.
    """

    version: int = VERSION
    stage: str
    settings: dict[str, Any]
    input: str | None
    tasks: int
    columns: dict[str, Column] = Field(default_factory=dict)
    shards: list[Shard] = Field(default_factory=list)

    @property
    def complete(self) -> bool:
        return len(self.shards) == self.tasks

    @property
    def rows(self) -> int:
        return sum(shard.rows for shard in self.shards)

    @property
    def digest(self) -> str:
        """Of the contents of all shards: the input of the next stage."""
        lines = "".join(f"{shard.file} {shard.sha256}\n" for shard in self.shards)
        return hashlib.sha256(lines.encode()).hexdigest()

    def having(self, shards: Iterable[Shard], columns: Mapping[str, Column]) -> Manifest:
        """The same with other shards. Their order, and that of the columns, does not depend on the order in which they came."""
        by_name = sorted(shards, key=lambda shard: shard.file)
        return self.model_copy(update={"shards": by_name, "columns": dict(sorted(columns.items()))})


@dataclass(frozen=True)
class Part:
    """The K-th of P parts, from 1: tasks K - 1, K - 1 + P, ..."""

    k: int
    of: int

    @staticmethod
    def parse(text: str) -> Part:
        """Of "K/P". Raises ValueError."""
        return Part(*read_part(text))

    def has(self, task: int) -> bool:
        return task % self.of == self.k - 1

    @property
    def manifest(self) -> str:
        return MANIFEST if self == WHOLE else f"manifest.{self.k}-of-{self.of}.json"

    def __str__(self) -> str:
        return f"part {self.k} of {self.of}"


WHOLE = Part(1, 1)


def write_manifest(path: Path, manifest: Manifest) -> None:
    """Raises OSError."""
    write_atomically(path, (json.dumps(manifest.model_dump(), indent=1) + "\n").encode())


def read_manifest(path: Path) -> Manifest:
    """Raises ValueError for what is no manifest."""
    try:
        manifest = validated(Manifest, json.loads(path.read_bytes()))
        if len({shard.file for shard in manifest.shards}) < len(manifest.shards):
            raise ValueError("a shard is listed twice")
        return manifest
    except FileNotFoundError:
        raise ValueError(f"{path} does not exist: make it with `python -m datagen`") from None
    except ValueError as error:  # also of json, of text that is no UTF-8
        raise ValueError(f"{path} is no manifest ({error}): restore it, or start the stage anew with --force") from None


def manifest_paths(folder: Path) -> list[Path]:
    """All manifests of a folder of shards."""
    return [path for path in sorted(folder.glob("manifest*.json")) if path.name == MANIFEST or PART_MANIFEST.fullmatch(path.name)]


def read_manifests(folder: Path) -> Manifest | None:
    """All manifests of a folder as one; None if there is none.

    A shard that two of them know with different contents is left out. Raises ValueError where they are not of one data set.
    """
    paths = manifest_paths(folder)
    if not paths:
        return None
    manifests = [read_manifest(path) for path in paths]
    first = manifests[0]
    shards: dict[str, set[Shard]] = {}
    columns = dict(first.columns)
    for path, manifest in zip(paths, manifests, strict=True):
        check_same(path, manifest, first)
        check_columns(path, manifest.columns, columns)
        columns |= manifest.columns
        for shard in manifest.shards:
            shards.setdefault(shard.file, set()).add(shard)
    return first.having((found for same in shards.values() if len(same) == 1 for found in same), columns)


def check_same(path: Path, found: Manifest, wanted: Manifest) -> None:
    """Raises ValueError where a manifest is not what these settings and this input would give."""
    old, new = (
        {key: json.dumps(value) for key, value in flat({**m.settings, "stage": m.stage, "tasks": m.tasks, "version": m.version}).items()}
        for m in (found, wanted)
    )
    differ = [key for key in (old | new) if old.get(key, ABSENT) != new.get(key, ABSENT)]
    what_to_do = f"choose another folder (-o), or start anew with `python -m datagen {wanted.stage} --force`"
    if wanted.stage == "label":
        what_to_do = f"give these labels a name of their own (--name), {what_to_do}"
    if differ:
        what = "; ".join(f"{key} was {_short(old.get(key, ABSENT))}, is {_short(new.get(key, ABSENT))}" for key in differ[:4])
        more = f" and {len(differ) - 4} more" if len(differ) > 4 else ""
        raise ValueError(f"{path} was made with other settings: {what}{more}; {what_to_do}")
    if found.input != wanted.input:
        raise ValueError(f"{path} was made from another input, the stage before it has been made anew since: {what_to_do}")


def check_columns(name: object, columns: Mapping[str, Column], known: Mapping[str, Column]) -> None:
    """Raises ValueError unless the columns are those known, if any are."""
    for key in sorted(columns.keys() | known.keys()) if columns and known else ():
        a, b = columns.get(key), known.get(key)
        if a != b:
            raise ValueError(f"{name}: {key} is {_describe(a)}, in the other shards {_describe(b)}: start the stage anew with --force")


ABSENT = "absent"
LONGEST = 40  # of a value in an error


def _short(text: str) -> str:
    return text if len(text) <= LONGEST else f"{text[: LONGEST - 4]} ..."


def _describe(column: Column | None) -> str:
    return ABSENT if column is None else f"{column.dtype} (n{''.join(f', {n}' for n in column.shape)})"
