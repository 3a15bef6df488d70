"""The table [tracers] of a scene: what goes together in it, and points from its file."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from biem.scene.config import Scene, TracersTable


def check_tracers(scene: Scene) -> None:
    """Raises ValueError with one line for what the table lacks or its file does not hold."""
    table = scene.tracers
    if table is None:
        return
    if (table.file is None) == (table.count is None):
        raise ValueError("tracers: give count (and box), or file, one of them")
    if table.file is not None:
        unused = [name for name in ("box", "corner", "seed", "region") if getattr(table, name) != TracersTable.model_fields[name].default]
        if unused:
            raise ValueError(f"tracers.{unused[0]} goes with count; tracers.file says where they are")
        tracers_from_file(scene.folder / table.file)
    if table.box is not None and min(table.box) <= 0.0:
        raise ValueError(f"tracers.box = {list(table.box)}: both sides must be positive")
    if table.box is None and table.corner is not None:
        raise ValueError("tracers.corner goes with a box")


def tracers_from_file(path: Path) -> np.ndarray:
    """Points (P, 2) of `tracers.file`. Raises ValueError."""
    return points_from_file(path, "tracers.file", " (paths are relative to the scene)")


def points_from_file(path: Path, name: str, where: str = "") -> np.ndarray:
    """Points (P, 2) of a text file of rows of x and y, apart by spaces or commas. name: of what asks for it. Raises ValueError."""
    expected = "expected rows of two finite numbers, x and y"
    try:
        text = path.read_text(encoding="utf-8")
        rows = [line for line in text.splitlines() if line.partition("#")[0].strip()]
        x = np.loadtxt(rows, ndmin=2, delimiter="," if "," in text else None) if rows else np.zeros((0, 2))
    except FileNotFoundError:
        raise ValueError(f"{name} {path} does not exist{where}") from None
    except OSError as error:
        raise ValueError(f"{name} {path} cannot be read: {error}") from None
    except ValueError as error:
        said = " ".join(str(error).partition(";")[0].rstrip(".").split())
        raise ValueError(f"{name} {path}: {said}; {expected}") from None
    if x.shape[1] != 2 or not len(x):
        raise ValueError(f"{name} {path}: {len(x)} rows of {x.shape[1]} columns; {expected}")
    wrong = np.flatnonzero(~np.isfinite(x).all(axis=1))
    if len(wrong):
        raise ValueError(f"{name} {path}: row {wrong[0] + 1} is {' '.join(map(str, x[wrong[0]]))}; {expected}")
    return x
