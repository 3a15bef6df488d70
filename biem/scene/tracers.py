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
    """Points (P, 2) of a text file of rows of x and y. Raises ValueError."""
    try:
        x = np.loadtxt(path, ndmin=2)
    except FileNotFoundError:
        raise ValueError(f"tracers.file {path} does not exist (paths are relative to the scene)") from None
    except OSError as error:
        raise ValueError(f"tracers.file {path} cannot be read: {error}") from None
    except ValueError as error:
        raise ValueError(f"tracers.file {path}: {' '.join(str(error).split())}; expected two columns, x and y, apart by spaces") from None
    if x.shape[1] != 2 or not len(x) or not np.isfinite(x).all():
        raise ValueError(f"tracers.file {path}: {len(x)} rows of {x.shape[1]} columns; expected rows of two finite numbers, x and y")
    return x
