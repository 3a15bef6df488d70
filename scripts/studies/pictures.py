"""Pictures of a comparison: error against cost and over time, paths of the centroids, membranes of all runs at a few times."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import LogFormatter

from biem.curves.curve import centroid
from biem.curves.fourier import resample
from biem.run.trajectory import Trajectory
from studies.compared import COSTS, Compared
from studies.differences import at

COLOURS = (  # on a light and on a dark ground; also told apart by who sees no red or no green, with MARKERS and DASHES for who sees neither
    ("#0072b2", "#56b4e9"),
    ("#d55e00", "#ff8c42"),
    ("#00795a", "#2fd3a6"),
    ("#b0458a", "#f29ad0"),
    ("#8f6b00", "#e9cf3a"),
    ("#5b3fa8", "#b5a2ff"),
    ("#2a93c9", "#a8dbff"),
    ("#6b6b6b", "#bdbdbd"),
)
MARKERS = "oD^vPX<>"
DASHES = ((), (7, 2), (2, 2), (7, 2, 2, 2), (10, 3), (4, 2), (1, 1), (7, 2, 2, 2, 2, 2))  # on and off, in widths of the line
LEAST_ERROR = 1e-8  # shown on a logarithmic axis
SNAPSHOTS = 6
MOST_PATHS = 64  # of vesicles, drawn one by one
CORNERS = 256
PLAIN = LogFormatter(labelOnlyBase=False, minor_thresholds=(2, 0.5))


def style(index: int) -> dict[str, Any]:
    """Of a rung's line."""
    dashes = DASHES[index % len(DASHES)]
    return {"color": COLOURS[index % len(COLOURS)][0], "linestyle": (0, dashes) if dashes else "-"}


def draw_all(compared: Compared, found: Mapping[str, Any], folder: Path) -> None:
    """error_time.png, paths.png and membranes.png."""
    for name, picture in (("error_time", _errors(compared, found)), ("paths", _paths(compared)), ("membranes", _membranes(compared))):
        picture.savefig(folder / f"{name}.png", dpi=130)


def some(count: int, most: int) -> np.ndarray:
    """Indices of at most `most` of `count`, spread evenly."""
    return np.unique(np.linspace(0, count - 1, min(count, most)).round().astype(int))


def _figure(width: float, height: float, rows: int, columns: int) -> tuple[Figure, np.ndarray]:
    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure, figure.subplots(rows, columns, squeeze=False)


def _errors(compared: Compared, found: Mapping[str, Any]) -> Figure:
    """Largest distance of centroids against cost, with the front; the same over time."""
    figure, ((left, right),) = _figure(11, 4.6, 1, 2)
    rows = {row["name"]: row for row in found["rungs"]}
    reference = found["reference"]
    for k, ran in enumerate(compared.rungs):
        row = rows[ran.name]
        if not row["worst"]:
            continue
        filled = {} if row["complete"] else {"markerfacecolor": "none"}
        point = (row["cost"]["cpu"], max(row["worst"]["position"], LEAST_ERROR))
        left.plot(*point, MARKERS[k % len(MARKERS)], color=style(k)["color"], ms=8, label=ran.name, **filled)
        apart = compared.apart[ran.name]
        right.plot(apart.t / compared.scale, np.maximum(apart.values["position"], LEAST_ERROR), **style(k), label=ran.name)
    best = [rows[name] for name in found["front"]["position"]["cpu"]]
    left.step(
        [r["cost"]["cpu"] for r in best], [max(r["worst"]["position"], LEAST_ERROR) for r in best], "0.5", where="post", lw=1, zorder=0
    )
    if compared.floor is not None:
        left.plot(reference["cost"]["cpu"], max(reference["worst"]["position"], LEAST_ERROR), "ks", ms=8, label="the reference's own error")
        t, own = compared.floor.t / compared.scale, np.maximum(compared.floor.values["position"], LEAST_ERROR)
        right.fill_between(t, LEAST_ERROR, own, color="0.85", label="the reference's own error")
    left.set(xscale="log", yscale="log", xlabel=f"{COSTS['cpu']} a {compared.unit}", ylabel="largest distance of a centroid, R")
    right.set(yscale="log", xlabel=f"time, {compared.unit}", ylabel="largest distance of a centroid then, R")
    shown = [values.values["position"][1:] for values in compared.apart.values()]
    least = min((float(values[values > 0].min(initial=1.0)) for values in shown), default=1.0)
    right.set_ylim(bottom=max(LEAST_ERROR, 0.5 * least))
    left.xaxis.set_major_formatter(PLAIN)
    left.xaxis.set_minor_formatter(PLAIN)
    for axes in (left, right):
        axes.grid(alpha=0.3, which="both", lw=0.5)
    left.legend(fontsize=8)
    return figure


def _runs(compared: Compared) -> list[tuple[str, Trajectory, dict[str, Any]]]:
    """What is drawn, the reference first."""
    runs = [("reference", compared.truth, {"color": "0.75", "lw": 4.0, "solid_capstyle": "butt"})]
    for k, ran in enumerate(compared.rungs):
        if ran.trajectory is not None:
            runs.append((ran.name, ran.trajectory, style(k) | {"lw": 1.2}))
    return runs


def _paths(compared: Compared) -> Figure:
    figure, ((axes,),) = _figure(9, 5.5, 1, 1)
    chosen = some(compared.truth.X.shape[1], MOST_PATHS)
    for name, trajectory, line in _runs(compared):
        c = np.stack([centroid(X[chosen]) for X in trajectory.X]) / compared.R  # (F, m, 2)
        for m in range(len(chosen)):
            axes.plot(*c[:, m].T, **line, label=name if m == 0 else None)
    _walls(axes, compared)
    axes.set(xlabel="x / R", ylabel="y / R", title="paths of the centroids" + _of(chosen, compared))
    axes.set_aspect("equal", adjustable="datalim")
    axes.grid(alpha=0.3, lw=0.5)
    axes.legend(fontsize=8)
    return figure


def _of(chosen: np.ndarray, compared: Compared) -> str:
    M = compared.truth.X.shape[1]
    return "" if len(chosen) == M else f" of {len(chosen)} of {M} vesicles"


def _membranes(compared: Compared) -> Figure:
    times = np.linspace(0.0, compared.truth.t[-1], SNAPSHOTS)
    runs = [
        (name, t, resample(at(t.t, t.X, times[times <= t.t[-1] * (1 + 1e-9)]), CORNERS) / compared.R, line)
        for name, t, line in _runs(compared)
    ]
    low = np.min([X.min(axis=(0, 1, 3)) for _, _, X, _ in runs], axis=0)
    high = np.max([X.max(axis=(0, 1, 3)) for _, _, X, _ in runs], axis=0)
    wide = (high - low)[0] > 2.5 * (high - low)[1]
    rows, columns = (SNAPSHOTS // 2, 2) if wide else (2, SNAPSHOTS // 2)
    ratio = float(np.clip((high - low)[1] / (high - low)[0], 0.15, 1.5))
    figure, axes = _figure(12, max(4.0, rows * (12 / columns * ratio + 0.5)), rows, columns)
    for k, (ax, time) in enumerate(zip(axes.flat, times, strict=True)):
        for name, _, X, line in runs:
            if k < len(X):
                for m, outline in enumerate(X[k]):
                    ax.plot(*np.concatenate([outline, outline[:, :1]], axis=1), **line, label=name if m == 0 else None)
        _walls(ax, compared)
        margin = 0.05 * (high - low).max()
        ax.set(aspect="equal", xlim=(low[0] - margin, high[0] + margin), ylim=(low[1] - margin, high[1] + margin))
        ax.set_title(f"{time / compared.scale:.3g} {compared.unit}", fontsize=9)
        ax.tick_params(labelsize=7)
    figure.legend(*axes.flat[0].get_legend_handles_labels(), loc="outside lower center", ncols=3, fontsize=8)
    return figure


def _walls(axes: Axes, compared: Compared) -> None:
    for wall in compared.truth.attributes.get("walls", ()):
        fine = resample(wall, 2 * wall.shape[-1]) / compared.R
        axes.plot(*np.concatenate([fine, fine[:, :1]], axis=1), color="0.4", lw=1)
