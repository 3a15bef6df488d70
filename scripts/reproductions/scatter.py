"""How far the number of vesicles left in a Taylor-Green cell is determined: copies of one run whose vesicles begin a little aside.

In a copy every centroid is moved by SIZE R in a direction drawn by chance; all else, the solver and its steps too, is as in the run. Sizes:
1e-2 R, by which `balanced` errs in the first t_gamma (docs/trade.md), a tenth of it, and one far below what any rung reaches.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import h5py
import numpy as np
from studies.rungs import Rung

from biem.curves.curve import effective_radius
from biem.run.files import atomic_h5
from biem.run.trajectory import Trajectory
from biem.scene.build import build
from reproductions.pictures import figure, label, save
from reproductions.study import REJECTED, SCENES, Results, Study, Task, from_file, gather, scene_rung, table, write_results
from reproductions.taylor_green import ADAPTIVE, EARLY, EVERY, PLAIN, centroids, left

NAME = "scatter"
RUNG = "split[vesicles.points=32,time.adaptive=true]"
SIZES, COPIES = (1e-2, 1e-3, 1e-6), 3  # of the centroids' shifts, in R
TIMES = (5.0, 10.0, 15.0, 20.0)  # t_gamma, in the table
SMALL, LARGE = 3.0, 0.3  # multiples of the shift, and R, between which its growth is fitted


def measure(study: Study) -> Results:
    """Runs, results.json, picture."""
    folder = study.folder(NAME)
    sizes, copies, horizon = (SIZES[:1], 1, 0.06) if study.quick else (SIZES, COPIES, EARLY)
    made = scene_rung(SCENES / f"{PLAIN}.toml", RUNG, ADAPTIVE, f"{horizon} t_gamma")
    tasks = {"": _task(made, 0.0, 0, folder)}
    tasks |= {f"{size:g} {copy}": _task(made, size, copy, folder) for size in sizes for copy in range(copies)}
    runs = gather(study, tasks, desc="copies")
    base = runs[""].trajectory
    rows: list[Results] = []
    for name, run in runs.items():
        row: Results = {"size": float(name.split()[0]) if name else 0.0, **run.summary()}
        if run.trajectory is not None:
            row |= dict(zip(("t", "left"), (values.tolist() for values in left(run.trajectory)), strict=True))
            if base is not None and name:
                row["apart"] = _apart(run.trajectory, base)
        rows.append(row)
    pictures = [_picture(rows, folder / "scatter.png")] if all("t" in row for row in rows) else []
    return write_results(study, NAME, {"rung": RUNG, "rows": rows, "pictures": pictures})


def shifted(X: np.ndarray, size: float, copy: int) -> np.ndarray:
    """X (M, 2, N), every curve moved by size R."""
    angle = np.random.default_rng(copy).uniform(0.0, 2.0 * np.pi, len(X))
    return X + size * effective_radius(X).mean() * np.stack([np.cos(angle), np.sin(angle)], axis=1)[:, :, None]


def _task(made: Rung, size: float, copy: int, folder: Path) -> Task:
    path = folder / "starts" / (f"{size:g}_{copy}.h5" if size else "base.h5")
    path.parent.mkdir(exist_ok=True)
    X = shifted(build(made.scene).X, size, copy)
    if not path.exists() or not np.array_equal(h5py.File(path)["X"], X):
        with atomic_h5(path) as file:
            file["X"] = X
    return Task(from_file(made, path), folder / path.name)


def _apart(trajectory: Trajectory, base: Trajectory) -> list[float]:
    """Largest distance of a centroid from the run's, in R, at times EVERY t_gamma apart."""
    unit = float(base.attributes["t_gamma"])
    t = np.arange(0.0, min(trajectory.t[-1], base.t[-1]) / unit + 1e-9, EVERY) * unit
    far = np.linalg.norm(centroids(trajectory, t) - centroids(base, t), axis=2).max(axis=1)
    return (far / float(effective_radius(base.X[0]).mean())).tolist()


def tenfold(t: np.ndarray, apart: np.ndarray) -> float:
    """t_gamma in which distances grow tenfold, fitted while they are well above the shift and well below R; nan where they are never."""
    use = (apart > SMALL * apart[0]) & (apart < LARGE) & (np.maximum.accumulate(apart) < LARGE)
    if use.sum() < 3:
        return float("nan")
    return float(1.0 / np.polyfit(t[use], np.log10(apart[use]), 1)[0])


def _stopped(rows: list[Results]) -> list[str]:
    """That some were rejected, in words."""
    times = [row["until"] for row in rows if row["state"] == REJECTED]
    if not times:
        return []
    return [
        f"{len(times)} of the {len(rows)} copies were rejected, at {_range(times)} t_gamma, and count up to there: without a repulsion two "
        "vesicles are pressed through each other, which 32 nodes do not keep apart."
    ]


def _range(values: list[Any]) -> str:
    return " to ".join(f"{v:g}" for v in dict.fromkeys((min(values), max(values)))) if values else ""


def _picture(rows: list[Results], path: Path) -> str:
    made, axes = figure(10.0, 3.8, 1, 2)
    shades = dict(zip(sorted({row["size"] for row in rows}, reverse=True), ("tab:red", "tab:orange", "tab:blue", "black"), strict=False))
    seen: set[float] = set()
    for row in rows:
        name = None if row["size"] in seen else (f"{row['size']:g} R aside" if row["size"] else "the run")
        seen.add(row["size"])
        style = {"color": shades[row["size"]], "lw": 1.0 if row["size"] else 2.0}
        axes[0, 0].plot(row["t"], row["left"], drawstyle="steps-post", label=name, **style)
        if "apart" in row:
            axes[0, 1].semilogy(np.arange(len(row["apart"])) * EVERY, row["apart"], **style)
    axes[0, 0].set(xlabel=r"$t / t_{\dot\gamma}$", ylabel="vesicles left in the cell")
    axes[0, 0].legend(fontsize=8)
    axes[0, 1].set(xlabel=r"$t / t_{\dot\gamma}$", ylabel="farthest centroid from the run's, R")
    for panel in axes.flat:
        panel.grid(alpha=0.3)
    return save(made, path)


def section(results: Results) -> str:
    """Finding."""
    rows = [row for row in results["rows"] if "t" in row]
    base = next((row for row in rows if not row["size"]), None)
    copies = [row for row in rows if row["size"] and base is not None]
    lines = []
    for size in dict.fromkeys(row["size"] for row in copies):
        mine = [row for row in copies if row["size"] == size]
        off = [max(abs(a - b) for a, b in zip(row["left"], base["left"], strict=False)) for row in mine] if base else []
        until = [next((k * EVERY for k, d in enumerate(row["apart"]) if d > 1.0), None) for row in mine]
        grow = [tenfold(np.arange(len(row["apart"])) * EVERY, np.array(row["apart"])) for row in mine]
        spread = []
        for time in TIMES:
            counts = [row["left"][k] for row in mine if (k := round(time / EVERY)) < len(row["left"])]
            spread.append(_range(counts))
        apart = [u for u in until if u is not None]
        lines.append(
            [
                f"{size:g}",
                len(mine),
                float(np.nanmedian(grow)) if np.isfinite(grow).any() else None,
                _range(apart) or "never",
                *spread,
                " ".join(map(str, off)),
            ]
        )
    head = ["moved by, R", "copies", "tenfold in", "a centroid is R apart from", *(f"left at {t:g}" for t in TIMES)]
    own = [base["left"][k] if base and (k := round(t / EVERY)) < len(base["left"]) else None for t in TIMES]
    return "\n\n".join(
        [
            "**The question**: the fraction left in the cell is what the paper compares solvers by. How far do two runs by one solver part "
            "that differ by as little as two solvers do?",
            f"**Found**, by {label(results['rung'])}, adaptive steps of order 2; the run itself has "
            + (", ".join(f"{n} left at {t:g}" for t, n in zip(TIMES, own, strict=True) if n is not None) or "not come that far")
            + ":",
            table([*head, f"largest differences up to {EARLY:g}"], lines),
            "Times in t_gamma; the last column has a number for each copy. An error grows as a shift does, whatever makes it: a solver "
            "that is to have the reference's count within one vesicle at every time must err by less, from the start, than the shift "
            "for which the copies do. No solver on 32 nodes does, and no reference above does either.",
            *_stopped(copies),
        ]
    )
