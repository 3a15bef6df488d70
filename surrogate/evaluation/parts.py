"""Results part by part: each is written when it is done, with a digest of what it was made from, and read again where that is the same."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from biem.curves.fourier import resample
from biem.run.files import one_line, write_atomically

Result = dict[str, Any]


@dataclass(frozen=True)
class Parts:
    """Files of results in a folder. version: of the measurements, so that a change of them makes all anew."""

    folder: Path
    version: int

    def get(self, name: str, inputs: Mapping[str, Any]) -> Result | None:
        """The result of a part, if it is there and was made from these inputs."""
        try:
            stored = json.loads(self._path(name).read_text())
        except (FileNotFoundError, json.JSONDecodeError):
            return None
        result: Result | None = stored["result"] if stored.get("digest") == self.digest(inputs) else None
        return result

    def put(self, name: str, inputs: Mapping[str, Any], result: Result) -> Result:
        content = {"digest": self.digest(inputs), "inputs": inputs, "result": result}
        self.folder.mkdir(parents=True, exist_ok=True)
        write_atomically(self._path(name), json.dumps(content, indent=1, allow_nan=False).encode())
        return result

    def of(self, name: str, inputs: Mapping[str, Any], make: Callable[[], Result]) -> Result:
        found = self.get(name, inputs)
        return self.put(name, inputs, make()) if found is None else found

    def arrays(self, name: str, inputs: Mapping[str, Any], make: Callable[[], Sequence[np.ndarray]]) -> list[np.ndarray]:
        """Arrays instead of numbers, in an HDF5 file."""
        path = self._path(name).with_suffix(".h5")
        digest = self.digest(inputs)
        if path.exists():
            with h5py.File(path, "r") as file:
                if file.attrs.get("digest") == digest:
                    return [file[str(i)][()] for i in range(len(file))]
        values = list(make())
        self.folder.mkdir(parents=True, exist_ok=True)
        temporary = path.with_suffix(".tmp")
        with h5py.File(temporary, "w") as file:
            file.attrs["digest"] = digest
            for i, value in enumerate(values):
                file[str(i)] = value
        temporary.replace(path)
        return values

    def digest(self, inputs: Mapping[str, Any]) -> str:
        return hashlib.sha256(json.dumps([self.version, inputs], sort_keys=True).encode()).hexdigest()

    def _path(self, name: str) -> Path:
        return self.folder / f"{name.replace(' ', '-')}.json"


def file_digest(path: Path) -> str:
    """SHA-256. Raises FileNotFoundError."""
    if not path.is_file():
        raise FileNotFoundError(f"{path} does not exist")
    return hashlib.sha256(path.read_bytes()).hexdigest()


def resolved_shapes(path: Path, rows: np.ndarray, points: int) -> np.ndarray:
    """Rows of a file of shapes, as X (n, 2, points) float64 with their fine content.

    The file has Fourier coefficients of x + i y in numpy.fft.fft's order, `coefficients` (n, 2 modes), or nodes `X`. Raises ValueError.
    """
    try:
        with h5py.File(path, "r") as file:
            if "coefficients" not in file:
                return np.asarray(resample(file["X"][()][rows].astype(np.float64), points))
            c = file["coefficients"][()][rows]
    except FileNotFoundError:
        raise FileNotFoundError(f"{path} does not exist: make it by `python -m datagen select`") from None
    except (OSError, KeyError) as error:
        raise ValueError(
            f"{path} is not a file of shapes ({one_line(error)}): expected coefficients, as `python -m datagen select` makes them"
        ) from None
    modes = c.shape[1] // 2
    if points < 2 * modes:
        raise ValueError(f"{path} has {modes} modes: they need {2 * modes} nodes, not {points}")
    spectrum = np.zeros((len(c), points), dtype=np.complex128)
    spectrum[:, :modes] = c[:, :modes]
    spectrum[:, 1 - modes :] = c[:, 1 - modes :]
    z = np.fft.ifft(spectrum) * points
    return np.stack([z.real, z.imag], axis=1)
