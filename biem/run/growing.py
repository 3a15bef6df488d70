"""HDF5 files that grow: what is added lies beside the file, one piece a file, and is merged into it from time to time and at the end.

Every piece that is committed stays readable, whenever the writer is killed: files appear by a rename after a sync, and the merged file
is there before the pieces that it took in are removed.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any, Protocol, TypeVar

import numpy as np

MERGE_AT = 64  # loose pieces, at least; more where the file is longer, so that merging costs a constant factor


class Rows(Protocol):
    """Frames or rows, by their steps (F,)."""

    @property
    def step(self) -> np.ndarray: ...

    def __len__(self) -> int: ...


P = TypeVar("P", bound=Rows)


def read_growing(path: Path, folder: Path, read: Callable[[Path], P], run: Callable[[P], Any]) -> list[P]:
    """What the file holds, and the later pieces of the same run beside it. read: of a file; run: tells runs apart."""
    while True:
        before = _identity(path)
        whole = read(path)
        done = int(whole.step[-1]) if len(whole) else -1
        try:
            loose = [read(piece) for piece in loose_pieces(folder)]
        except FileNotFoundError:  # merged meanwhile
            continue
        if _identity(path) == before:
            return [whole, *(piece for piece in loose if run(piece) == run(whole) and int(piece.step[0]) > done)]


class Growing:
    """Adds pieces to `path`, by way of `folder`. start: what the file begins with, replacing what was there; read: of all that is
    committed; write: of a file."""

    def __init__(self, path: Path, folder: Path, start: P, read: Callable[[Path], P], write: Callable[[Path, P], None]) -> None:
        self.path, self.folder, self._read, self._write = path, folder, read, write
        write(path, start)
        shutil.rmtree(folder, ignore_errors=True)
        self._merged, self._pending = len(start), 0

    def append(self, piece: Any) -> None:
        """Commits a piece, later than those before: it is on the disk when this returns."""
        self.folder.mkdir(exist_ok=True)
        self._write(self.folder / f"{int(piece.step[0]):012d}.h5", piece)
        self._pending += 1
        if self._pending >= max(MERGE_AT, self._merged):
            self._merge()

    def close(self) -> None:
        """Merges what is loose: leaves one plain file."""
        if self._pending:
            self._merge()
        shutil.rmtree(self.folder, ignore_errors=True)

    def _merge(self) -> None:
        everything = self._read(self.path)
        self._write(self.path, everything)
        for piece in loose_pieces(self.folder):
            piece.unlink()
        self._merged, self._pending = len(everything), 0


def loose_pieces(folder: Path) -> list[Path]:
    """Files of the pieces that are not merged yet, in their order."""
    return sorted(folder.glob("[0-9]*.h5"))


def _identity(path: Path) -> tuple[int, int] | None:
    """Changes whenever the file is replaced."""
    try:
        found = path.stat()
    except FileNotFoundError:
        return None
    return found.st_ino, found.st_mtime_ns
