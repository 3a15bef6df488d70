"""Training pairs, read and checked: `pairs.h5`, which joins the labels of a data set, and `pairs.json`, which says what they are of."""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from biem.run.files import one_line

SPLITS = ("train", "val", "test")


@dataclass(frozen=True)
class Pairs:
    """What a file of pairs holds. dt, relaxation: of `relax`; digest: SHA-256 of its manifest; split, run (n,)."""

    path: Path
    points: int
    reduced_area: float
    operator_points: int
    dt: float
    relaxation: str
    maps: tuple[str, ...]
    modes: tuple[int, ...]
    digest: str
    split: np.ndarray
    run: np.ndarray

    def check(self, name: str, modes: tuple[int, ...] = ()) -> None:
        """Raises ValueError where the file has no labels of a map, or of one of the modes."""
        if name not in self.maps:
            raise ValueError(f"{self.path} has labels of {', '.join(self.maps)}, not of {name}: label them with `--maps {name}`")
        missing = sorted(set(modes) - set(self.modes))
        if missing:
            raise ValueError(
                f"{self.path} has modes {_ranges(self.modes)} of {name}, not {_ranges(tuple(missing))}: label them with `--modes`"
            )

    def read(self, name: str, rows: np.ndarray, whole: bool = False) -> np.ndarray:
        """Rows (ascending) of a dataset. whole: read it whole, and keep the last one. Raises ValueError for values that are not finite."""
        first, last = int(rows[0]), int(rows[-1]) + 1  # a slice is much faster than scattered rows
        if whole:
            values = _whole(self.path, name)[rows]
        else:
            with h5py.File(self.path, "r") as file:
                values = file[name][first:last][rows - first]
        bad = np.flatnonzero(~np.isfinite(values).all(axis=tuple(range(1, values.ndim))))
        if len(bad):
            raise ValueError(f"{self.path}: {name} of row {rows[bad[0]]} (and {len(bad) - 1} more) is not finite: verify the data set")
        return values


@lru_cache(maxsize=1)
def _whole(path: Path, name: str) -> np.ndarray:
    with h5py.File(path, "r") as file:
        values: np.ndarray = file[name][()]
    return values


def open_pairs(path: str | Path) -> Pairs:
    """Raises FileNotFoundError, ValueError for what is not a whole file of pairs."""
    path = Path(path)
    settings = _settings(path)
    label = settings["label"]
    try:
        with h5py.File(path, "r") as file:
            dataset = file["X_std"]
            for part in dataset.virtual_sources() if dataset.is_virtual else ():
                if not (path.parent / part.file_name).is_file():
                    raise ValueError(f"{path.parent / part.file_name} is missing: make it again with `python -m datagen label`")
            split, run, points = file["split"][()], file["run"][()], dataset.shape[-1]
    except OSError as error:
        raise ValueError(f"{path} cannot be read as HDF5: {one_line(error)}") from None
    except KeyError as error:
        raise ValueError(f"{path} is not a file of pairs ({one_line(error)}): make it with `python -m datagen label`") from None
    if points != label["points"]:
        raise ValueError(f"{path} has shapes of {points} nodes, {path.with_suffix('.json')} says {label['points']}")
    return Pairs(
        path=path,
        points=points,
        reduced_area=settings["shapes"]["reduced_area"],
        operator_points=label["operator_points"],
        dt=label["dt"],
        relaxation=label["relaxation"],
        maps=tuple(label["maps"]),
        modes=tuple(label["modes"]),
        digest=hashlib.sha256(path.with_suffix(".json").read_bytes()).hexdigest(),
        split=split,
        run=run,
    )


def _settings(path: Path) -> dict[str, Any]:
    if not path.exists():
        raise FileNotFoundError(f"{path} does not exist: make it with `python -m datagen label`")
    try:
        settings: dict[str, Any] = json.loads(path.with_suffix(".json").read_text())["settings"]
        _ = settings["label"]["points"], settings["shapes"]["reduced_area"]
    except FileNotFoundError:
        raise ValueError(f"{path.with_suffix('.json')} is missing: it says what the pairs beside it are of") from None
    except (json.JSONDecodeError, KeyError, TypeError) as error:
        raise ValueError(f"{path.with_suffix('.json')} does not say what the pairs are of: {one_line(error)}") from None
    return settings


def _ranges(numbers: tuple[int, ...]) -> str:
    """ "0-3, 7" of 0, 1, 2, 3, 7."""
    parts: list[list[int]] = []
    for number in sorted(numbers):
        if parts and parts[-1][-1] == number - 1:
            parts[-1] = [parts[-1][0], number]
        else:
            parts.append([number, number])
    return ", ".join(str(a) if a == b else f"{a}-{b}" for a, b in parts)
