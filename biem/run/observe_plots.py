"""Pictures of observables: rheology, shapes, paths, distances, displacements, the distribution across a channel."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from biem.observe.observables import Observations
from biem.observe.quantities import QUANTITIES
from biem.run.files import make_folder
from biem.run.observations import columns

LINE, FILL = "#7a3b00", "#e8a33d"
MOST_LINES = 12  # vesicles or pairs drawn one by one; more as median and quantiles
MOST_NAMES = 6
MOST_PATHS = 300
ACROSS = ("lateral_distribution", "velocity_profile")
LABELS = {
    "effective_viscosity": r"$\mu_{\rm eff} / \mu$",
    "intrinsic_viscosity": r"$[\eta]$",
    "normal_stress_difference": r"$N_1$",
    "tank_treading_frequency": "tank-treading\nfrequency",
    "mean_square_displacement": "mean square\ndisplacement",
}


def draw_observables(rows: Observations, folder: Path) -> list[Path]:
    """The pictures that these rows have, if any, as files in `folder`; returns their paths."""
    has = {q.name for q in rows.quantities}
    groups = {
        "rheology": ["effective_viscosity", "intrinsic_viscosity", "normal_stress_difference"],
        "shapes": ["inclination", "deformation", "bending_energy", "tank_treading_frequency"],
        "distances": ["smallest_gap", "nearest_distance", "pair_distance", "cell_free_layer"],
    }
    if "intrinsic_viscosity" not in has and "effective_viscosity" not in has:
        groups["rheology"] = ["stress", "normal_stress_difference"]
    if "pair_distance" in has and len(rows.pairs) == 1:
        groups["distances"].remove("nearest_distance")  # the same
    make_folder(folder)
    files = []
    if len(rows) > 1:
        for name, names in groups.items():
            drawn = [n for n in names if n in has and np.isfinite(rows.values[n]).any()]
            if drawn:
                files.append(_histories(rows, drawn, folder / f"{name}.png"))
        if "centroid" in has:
            files.append(_paths(rows, folder / "paths.png"))
        if "mean_square_displacement" in has:
            files.append(_displacements(rows, folder / "displacement.png"))
    across = [name for name in ACROSS if name in has]
    if across:
        files.append(_across(rows, across, folder / "across.png"))
    return files


def _figure(width: float, height: float, rows: int = 1, columns: int = 1, **options: Any) -> tuple[Figure, np.ndarray]:
    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure, np.atleast_1d(figure.subplots(rows, columns, **options))


def _times(rows: Observations) -> tuple[np.ndarray, str]:
    """Times in units of the flow where it has a rate."""
    rate = abs(float(rows.about.get("rate", 0.0)))
    return (rows.t * rate, r"$t\,\dot\gamma$") if rate else (rows.t, "$t$")


def _label(name: str) -> str:
    return LABELS.get(name, name.replace("_", " "))


def _histories(rows: Observations, names: list[str], path: Path) -> Path:
    """One below the other, over time."""
    time, unit = _times(rows)
    figure, axes = _figure(7.0, 0.6 + 1.9 * len(names), len(names), 1, sharex=True)
    for ax, name in zip(axes, names, strict=True):
        values, quantity = rows.values[name], QUANTITIES[name]
        if quantity.components:
            for k, column in enumerate(columns(quantity)):
                ax.plot(time, values[..., k], label=column.replace("_", " "))
            ax.legend(frameon=False, fontsize=8)
        elif values.ndim == 1:
            ax.plot(time, values, color=LINE)
        elif values.shape[1] <= MOST_LINES:
            for k, value in enumerate(values.T):
                label = f"vesicle {k}" if quantity.place == "vesicles" else "{}, {}".format(*rows.pairs[k])
                ax.plot(time, _unwound(value) if name == "inclination" else value, linewidth=1.0, label=label)
            if 1 < values.shape[1] <= MOST_NAMES:
                ax.legend(frameon=False, fontsize=8)
        else:
            for share, alpha in ((0.9, 0.15), (0.5, 0.3)):
                low, high = np.quantile(values, [0.5 - share / 2, 0.5 + share / 2], axis=1)
                ax.fill_between(time, low, high, color=FILL, alpha=alpha, linewidth=0, label=f"the middle {share:.0%}")
            ax.plot(time, np.median(values, axis=1), color=LINE, label="median")
            ax.legend(frameon=False, fontsize=8)
        unit_of = "" if quantity.unit == "1" else f"\n[{quantity.unit}]"
        ax.set_ylabel(_label(name) + unit_of, fontsize=9)
        ax.grid(alpha=0.3)
    axes[-1].set_xlabel(unit)
    figure.savefig(path, dpi=130)
    return path


def _unwound(angle: np.ndarray) -> np.ndarray:
    """The angle (F,) with a gap where it jumps from one end of its range to the other."""
    jump = np.abs(np.diff(angle, prepend=angle[0])) > 0.5 * np.pi
    return np.where(jump, np.nan, angle)


def _paths(rows: Observations, path: Path) -> Path:
    c = rows.values["centroid"]
    chosen = np.unique(np.linspace(0, c.shape[1] - 1, MOST_PATHS).round().astype(int))
    figure, axes = _figure(7.0, 4.5)
    line = float(np.clip(8.0 / len(chosen) ** 0.5, 0.4, 1.2))
    for m in chosen:
        axes[0].plot(c[:, m, 0], c[:, m, 1], color=LINE, linewidth=line, alpha=max(0.4, len(chosen) ** -0.5))
    axes[0].plot(*c[0, chosen].T, "o", color="white", markeredgecolor=LINE, markersize=4 if len(chosen) < 50 else 2, label="first frame")
    axes[0].plot(*c[-1, chosen].T, "o", color=LINE, markersize=4 if len(chosen) < 50 else 2, label="last frame")
    axes[0].set_xlabel("x [length]")
    axes[0].set_ylabel("y [length]")
    axes[0].legend(frameon=False, fontsize=8)
    axes[0].grid(alpha=0.3)
    figure.savefig(path, dpi=130)
    return path


def _displacements(rows: Observations, path: Path) -> Path:
    time, unit = _times(rows)
    figure, axes = _figure(6.5, 4.0)
    moved = time > time[0]
    for k, (component, color) in enumerate(zip("xy", (FILL, LINE), strict=True)):
        values = rows.values["mean_square_displacement"][moved, k]
        if (values > 0).any():
            axes[0].loglog(time[moved], np.where(values > 0, values, np.nan), color=color, label=f"along {component}")
    axes[0].set_xlabel(unit)
    axes[0].set_ylabel("mean square displacement [length^2]")
    if axes[0].lines:
        axes[0].legend(frameon=False)
    axes[0].grid(alpha=0.3, which="both")
    figure.savefig(path, dpi=130)
    return path


def _across(rows: Observations, names: list[str], path: Path) -> Path:
    """Over y: the last frame, and the mean over the second half of the frames."""
    figure, axes = _figure(4.2 * len(names) + 0.5, 4.4, 1, len(names), sharey=True)
    late = rows.t >= 0.5 * (rows.t[0] + rows.t[-1])
    for ax, name in zip(axes, names, strict=True):
        values = rows.values[name]
        last = (values[-1], FILL, "last frame")
        shown = [last, (_mean(values[late]), LINE, f"mean of the last {late.sum()} frames")] if late.sum() > 1 else [last]
        for value, color, label in shown:
            ax.stairs(value, rows.edges, orientation="horizontal", color=color, baseline=None, label=label)
        if name == "lateral_distribution":
            ax.set_xlim(left=0.0)
        elif rows.about["flow"] == "poiseuille":
            W = rows.edges[-1]
            y = np.linspace(-W, W, 100)
            ax.plot(float(rows.about["rate"]) * W * (1.0 - (y / W) ** 2), y, ":", color="tab:gray", label="the flow without vesicles")
        ax.set_xlabel(f"{_label(name)} [{QUANTITIES[name].unit}]")
        ax.grid(alpha=0.3)
        ax.legend(frameon=False, fontsize=8)
    axes[0].set_ylabel("y [length]")
    figure.savefig(path, dpi=130)
    return path


def _mean(values: np.ndarray) -> np.ndarray:
    """Mean over the frames (B,), of those that have a value."""
    there = np.isfinite(values)
    with np.errstate(invalid="ignore"):
        return np.where(there, values, 0.0).sum(axis=0) / there.sum(axis=0)
