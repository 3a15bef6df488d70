"""The results of an evaluation as pictures: boxes of errors by mode and map, errors over steps, errors against cost."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from surrogate.evaluation.tables import TITLES, trade

Results = Mapping[str, Any]
COLORS = ("tab:blue", "tab:orange", "tab:green", "0.75", "0.55", "0.35", "tab:purple", "tab:brown", "tab:pink", "tab:olive")
KIND_COLORS = {"ivnet": "tab:blue", "mlp": "tab:orange", "hybrid": "tab:green", "exact 32": "0.8", "exact 48": "0.6", "exact 64": "0.4"}
DASHES: dict[str, Any] = {"4 steps": (0, (5, 1)), "16 steps": (0, (1, 1)), "extrapolated": (0, (3, 1, 1, 1, 1, 1))}
NEEDED = ("p05", "p25", "median", "p75", "p95")


def draw(results: Results, folder: Path) -> list[Path]:
    """Writes the pictures that there are results for."""
    files = []
    for name, maps in results.get("errors", {}).items():
        files.append(_overview(name, maps, results["rungs"], folder))
        for title, found in maps.items():
            if any("modes" in f for f in found.values()):
                files.append(_by_mode(name, title, found, results["rungs"], folder))
    if results.get("velocities"):
        groups = {f"{flow}\n{slot}": found for flow, slots in results["velocities"].items() for slot, found in slots.items()}
        files.append(_groups("Velocities as they occur", groups, results["rungs"], folder / "velocities.png"))
    for dt, found in results.get("relaxation", {}).items():
        files.append(_steps(dt, found, folder))
    if trade(results):
        files.append(_trade(results, folder))
    return files


def _overview(name: str, maps: Results, rungs: Sequence[str], folder: Path) -> Path:
    groups = {title: {rung: f["all"] for rung, f in found.items()} for title, found in maps.items()}
    return _groups(f"All maps, {TITLES[name]}", groups, rungs, folder / f"errors_{name}.png")


def _by_mode(name: str, title: str, found: Results, rungs: Sequence[str], folder: Path) -> Path:
    modes = list(dict.fromkeys(k for f in found.values() for k in f["modes"]))
    groups = {k: {rung: f["modes"][k] for rung, f in found.items() if k in f["modes"]} for k in modes}
    groups["all"] = {rung: f["all"] for rung, f in found.items()}
    return _groups(f"{title} by mode, {TITLES[name]}", groups, rungs, folder / f"errors_{name}_{title}.png")


def _groups(title: str, groups: Mapping[str, Mapping[str, Results]], rungs: Sequence[str], path: Path) -> Path:
    """Boxes (quartiles, 5 % to 95 %; a cross at the mean) of the rungs side by side, for each group."""
    used = [rung for rung in rungs if any(rung in g for g in groups.values())]
    figure, axes = _figure(max(6.0, 0.13 * len(groups) * (len(used) + 2) + 1.5), 4.2)
    width = 1.0 / (len(used) + 1.5)
    for j, rung in enumerate(used):
        boxes, places = [], []
        for i, found in enumerate(groups.values()):
            s = found.get(rung)
            if s and s["median"] and all(s[name] is not None for name in NEEDED):
                p05, p25 = (s[name] or s["median"] / 1e3 for name in ("p05", "p25"))  # zeros have no place on the axis
                mean = s["mean"] or s["p95"]
                boxes.append({"med": s["median"], "q1": p25, "q3": s["p75"], "whislo": p05, "whishi": s["p95"], "mean": mean})
                places.append(i + (j - (len(used) - 1) / 2) * width)
        if boxes:
            axes.bxp(
                boxes,
                positions=places,
                widths=0.85 * width,
                showfliers=False,
                showmeans=True,
                patch_artist=True,
                manage_ticks=False,
                boxprops={"facecolor": _color(rung, j), "linewidth": 0.5},
                medianprops={"color": "black", "linewidth": 1.0},
                meanprops={"marker": "x", "markersize": 3, "markeredgecolor": "black"},
                whiskerprops={"linewidth": 0.6},
                capprops={"linewidth": 0.6},
            )
    axes.set_yscale("log")
    axes.set_xticks(range(len(groups)), list(groups))
    axes.set(ylabel="relative L2 error", title=title)
    axes.grid(alpha=0.3, axis="y")
    handles = [Patch(facecolor=_color(rung, j), label=rung) for j, rung in enumerate(used)]
    figure.legend(handles=handles, loc="outside lower center", fontsize=7, ncols=max(1, len(used)))
    return _saved(figure, path)


def _steps(dt: str, found: Results, folder: Path) -> Path:
    """Median, 5 % to 95 % shaded, largest dashed."""
    figure, axes = _figure(10.0, 5.0)
    for j, (name, values) in enumerate(found.items()):
        if name == "reference":
            axes.plot(_numbers(values["max"]), ":", color="black", label="reference: largest change by its extrapolation")
            continue
        color = _color(name, j)
        variant = name.partition(", ")[2]
        dash = "-" if not variant else DASHES.get(variant, "-.")
        lines = {what: _numbers(values[what]) for what in ("p05", "median", "p95", "max")}
        if not variant:
            axes.fill_between(range(len(lines["p05"])), lines["p05"], lines["p95"], color=color, alpha=0.12, linewidth=0)
        axes.plot(lines["median"], linestyle=dash, color=color, label=f"{name} ({values['diverged']} of {values['vesicles']} diverged)")
        axes.plot(lines["max"], "--", color=color, linewidth=0.6)
    axes.set_yscale("log")
    axes.set(
        xlabel="relaxation steps", ylabel="largest node error / length", title=f"Relaxation steps of dt = {dt}: median, 5-95 %, largest"
    )
    axes.grid(alpha=0.3)
    figure.legend(loc="outside right upper", fontsize=7)
    return _saved(figure, folder / f"relaxation_{dt}.png")


def _trade(results: Results, folder: Path) -> Path:
    """Median errors against cost; exact maps joined by a line."""
    rows = trade(results)
    quantities = list(dict.fromkeys(row[0] for row in rows))
    columns = min(4, len(quantities))
    height = -(-len(quantities) // columns)
    figure = Figure(figsize=(3.2 * columns, 2.9 * height), layout="constrained")
    FigureCanvasAgg(figure)
    panels = figure.subplots(height, columns, squeeze=False).ravel()
    for panel, quantity in zip(panels, quantities, strict=False):
        mine = [(rung, error, costs[rung]) for q, _, rung, error, costs in rows if q == quantity and rung in costs]
        exact = [(cost, error) for rung, error, cost in mine if rung.startswith("exact")]
        if exact:
            panel.loglog(*zip(*exact, strict=True), "-", color="0.6", linewidth=0.8)
        for j, (rung, error, cost) in enumerate(mine):
            panel.loglog([cost], [error], "o", color=_color(rung, j))
            panel.annotate(rung, (cost, error), fontsize=7, xytext=(3, 3), textcoords="offset points")
        panel.set_title(quantity, fontsize=8)
        panel.set_xlabel("microseconds a vesicle", fontsize=7)
        panel.set_ylabel("median error", fontsize=7)
        panel.tick_params(labelsize=6)
        spent, errors = [cost for _, _, cost in mine], [error for _, error, _ in mine]
        if mine:
            panel.set(xlim=(min(spent) / 2, 6 * max(spent)), ylim=(min(errors) / 2, max(3 * max(errors), 20 * min(errors))))
        panel.minorticks_off()
        panel.grid(alpha=0.3)
    for panel in panels[len(quantities) :]:
        panel.set_visible(False)
    return _saved(figure, folder / "cost.png")


def _color(name: str, index: int) -> str:
    return KIND_COLORS.get(name.split(",")[0], COLORS[index % len(COLORS)])


def _numbers(values: Sequence[float | None]) -> list[float]:
    return [float("nan") if v is None or v == 0.0 else v for v in values]


def _figure(width: float, height: float) -> tuple[Figure, Axes]:
    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure, figure.add_subplot()


def _saved(figure: Figure, path: Path) -> Path:
    figure.savefig(path, dpi=130)
    return path
