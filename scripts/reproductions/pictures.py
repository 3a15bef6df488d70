"""Colours, names and panels that the figures of all experiments share."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from biem.curves.fourier import resample

CORNERS = 128
COLORS = {"implicit": "black", "split": "tab:blue", "vesnet:hybrid": "tab:green", "vesnet:mlp": "tab:orange", "vesnet:ivnet": "tab:red"}


def color(name: str) -> str:
    """Of a rung, by its solver."""
    solver = name.partition("[")[0]
    return COLORS.get(solver, COLORS.get(f"vesnet:{solver}", "tab:purple"))


def label(name: str) -> str:
    """A rung's name, short enough for a legend."""
    for long, short in (
        ("vesicles.points=", "N="),
        ("solver.operator_points=", "built at "),
        ("vesnet:", ""),
        ("time.", ""),
        ("solver.", ""),
    ):
        name = name.replace(long, short)
    return name.replace("[", ", ").replace("]", "").replace(",", ", ").replace(",  ", ", ")


def figure(width: float, height: float, rows: int = 1, columns: int = 1, **options: Any) -> tuple[Figure, np.ndarray]:
    """A figure and its panels (rows, columns)."""
    made = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(made)
    return made, made.subplots(rows, columns, squeeze=False, **options)


def outlines(X: np.ndarray) -> np.ndarray:
    """Closed outlines (M, 2, CORNERS + 1) of X (M, 2, N)."""
    fine = resample(X, max(CORNERS, X.shape[-1]))
    return np.concatenate([fine, fine[..., :1]], axis=-1)


def fill(axes: Axes, X: np.ndarray, face: Any, **options: Any) -> None:
    """Vesicles X (M, 2, N)."""
    for outline in outlines(X):
        axes.fill(*outline, facecolor=face, edgecolor="black", **{"linewidth": 0.5, **options})
    axes.set_aspect("equal")


def save(made: Figure, path: Path) -> str:
    """Writes a picture; its name."""
    made.savefig(path, dpi=120)
    return path.name
