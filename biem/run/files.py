"""Files that are whole or not there: written under a temporary name, synced, renamed."""

from __future__ import annotations

import io
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import h5py


@contextmanager
def atomic_h5(path: Path) -> Iterator[h5py.File]:
    """An HDF5 file to write; it takes the name `path` only when the block has ended well. Raises OSError (disk full, no permission)."""
    image = io.BytesIO()  # HDF5 that meets a full disk half way cannot even be closed
    with h5py.File(image, "w") as file:
        yield file
    write_atomically(path, image.getbuffer())


def make_folder(path: Path) -> None:
    """The folder, and those that it lies in, where they are not there yet. Raises OSError with the path in it."""
    try:
        path.absolute().mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OSError(f"folder {path} cannot be made ({error.strerror or one_line(error)}): choose another place") from None


def write_atomically(path: Path, content: bytes | memoryview) -> None:
    """A file of this content: the old one, if there is one, until the new one is whole. Raises OSError (disk full, no permission)."""
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        try:
            temporary.write_bytes(content)
            _sync(temporary)
            os.replace(temporary, path)
            _sync(path.parent)
        finally:
            temporary.unlink(missing_ok=True)
    except OSError as error:
        raise OSError(f"{path} could not be written: {one_line(error)}") from error


def one_line(error: Exception) -> str:
    """The message of an error without its line breaks."""
    return " ".join(str(error).split())


def _sync(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
