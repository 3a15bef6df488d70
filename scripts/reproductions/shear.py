"""Two vesicles in shear at Ca = 5: snapshots, separation over 20 t_gamma, with and without the near-field correction.

All rungs on configs/scenes/vesnet_pair.toml: steps of 2e-5 mu L^3/kappa_b = 0.047 t_gamma of order 2.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from biem.run.plot import separation
from biem.run.trajectory import Trajectory
from reproductions.pictures import color, figure, fill, label, save
from reproductions.study import FINISHED, MISSING, REJECTED, SCENES, Results, Study, Task, ended, gather, scene_rung, table, write_results

NAME = "shear"
NONE = 'solver.near_field="none"'
CORRECTED = (
    "implicit[vesicles.points=128]",
    "implicit[vesicles.points=32]",
    "split[vesicles.points=128]",
    "split[vesicles.points=32]",
    "vesnet:hybrid",
    "vesnet:mlp",
    "vesnet:ivnet",
)
REFERENCE = CORRECTED[0]
PAPER_COLLISION = 0.8  # t_gamma, BIEM at N = 32 without the correction
SHOWN = (0.0, 0.8, 3.0, 5.0, 8.0, 14.0, 20.0)  # t_gamma
MARGIN = 2.0  # of R around the vesicles of a snapshot


def uncorrected(name: str) -> str:
    """The rung without its near-field correction."""
    return f"{name[:-1]},{NONE}]" if name.endswith("]") else f"{name}[{NONE}]"


RUNGS = tuple(given for name in CORRECTED for given in (name, uncorrected(name)))
ROWS = (REFERENCE, uncorrected("implicit[vesicles.points=32]"), "vesnet:hybrid")  # of the snapshots, as in the paper


def measure(study: Study) -> Results:
    """Runs, results.json, pictures."""
    folder = study.folder(NAME)
    tasks = {}
    for name in study.rungs(RUNGS):
        made = scene_rung(SCENES / "vesnet_pair.toml", name, [], "0.2 t_gamma" if study.quick else None)
        tasks[name] = Task(made, folder / f"{made.file}.h5")
    runs = gather(study, tasks, desc="shear pair")
    there = {name: run.trajectory for name, run in runs.items() if run.trajectory is not None}
    rows = {name: run.summary() for name, run in runs.items()}
    for name, trajectory in there.items():
        apart = separation(trajectory)
        rows[name] |= {"t": _times(trajectory).tolist(), "separation": apart.tolist(), "end": float(apart[-1])}
        if REFERENCE in there:
            common = trajectory.t <= there[REFERENCE].t[-1] * (1 + 1e-9)
            expected = np.interp(trajectory.t[common], there[REFERENCE].t, separation(there[REFERENCE]))
            rows[name]["off"] = float(np.abs(apart[common] / expected - 1.0).max())
    pictures = [_separations(rows, folder / "separation.png")] if there else []
    shown = {name: there[name] for name in ROWS if name in there}
    if shown:
        pictures.append(_snapshots(shown, folder / "snapshots.png"))
    return write_results(study, NAME, {"rows": rows, "pictures": pictures})


def _times(trajectory: Trajectory) -> np.ndarray:
    return trajectory.t / float(trajectory.attributes["t_gamma"])


def _separations(rows: dict[str, Results], path: Path) -> str:
    made, axes = figure(11.0, 4.2, 1, 2, sharey=True)
    for panel, off, title in ((axes[0, 0], False, "near field corrected"), (axes[0, 1], True, "not corrected")):
        for name, row in rows.items():
            if "t" not in row or (NONE in name) is not off:
                continue
            few = "N=32" in label(name) or name.startswith("vesnet")
            line = panel.plot(
                row["t"], row["separation"], "-" if few else "--", color=color(name), lw=1.2, label=label(name.replace(f",{NONE}", ""))
            )
            if row["state"] == REJECTED:
                panel.plot(row["t"][-1], row["separation"][-1], "x", color=line[0].get_color(), ms=9)
        panel.set(xlabel=r"$t / t_{\dot\gamma}$", title=f"{title} (cross: rejected)")
        panel.grid(alpha=0.3)
        if panel.get_lines():
            panel.legend(fontsize=7)
    axes[0, 0].set_ylabel("separation of the centroids / R")
    return save(made, path)


def _snapshots(shown: dict[str, Trajectory], path: Path) -> str:
    """One row a run; where it has ended before, its last state once."""
    made, axes = figure(2.0 * len(SHOWN), 2.1 * len(shown), len(shown), len(SHOWN))
    for row, (name, trajectory) in zip(axes, shown.items(), strict=True):
        t, ended_already = _times(trajectory), False
        for panel, time in zip(row, SHOWN, strict=True):
            panel.set(xticks=[], yticks=[])
            if ended_already:
                panel.axis("off")
                continue
            k = int(np.abs(t - time).argmin())
            ended_already = time >= t[-1]
            X = trajectory.X[k]
            fill(panel, X, "#e8a33d")
            middle, half = X.mean(axis=(0, 2)), 0.5 * np.ptp(X, axis=(0, 2)).max() + MARGIN * 0.1283
            panel.set(xlim=middle[0] + np.array([-half, half]), ylim=middle[1] + np.array([-half, half]))
            panel.set_title(f"{t[k]:.2g}" + (" (end)" if ended_already and t[-1] < SHOWN[-1] - 0.1 else ""), fontsize=8)
        row[0].set_ylabel(label(name).replace(", near", ",\nnear"), fontsize=7)
    return save(made, path)


def section(results: Results) -> str:
    """Statement, finding, difference."""
    rows = results["rows"]
    percent = lambda value: None if value is None else f"{100 * value:.2g} %"
    lines = [[label(n), ended(r), r.get("end"), percent(r.get("off")), r.get("smallest_gap")] for n, r in rows.items()]
    head = ["rung", "run", "separation at its end, R", "largest difference from the reference", "smallest gap, lengths"]
    few = {n: rows[n]["off"] for n in CORRECTED if n != REFERENCE and "128" not in n and "off" in rows[n] and rows[n]["state"] == FINISHED}
    ranked = [
        "At N = 32, corrected, from the nearest to the farthest: " + ", ".join(label(n) for n in sorted(few, key=few.__getitem__)) + "."
    ]
    ranked = ranked if len(few) > 1 else []
    stopped = {n: r for n, r in rows.items() if r["state"] == REJECTED}
    found = [f"{label(n)} stops at {r.get('until', 0.0):.3g} t_gamma: {r['failure']}." for n, r in stopped.items()]
    coarse = rows.get(uncorrected("implicit[vesicles.points=32]"), {"state": MISSING})
    if coarse["state"] == REJECTED:
        found.append(
            f"BIEM at N = 32 without the correction is stopped by the guard at {coarse['until']:.3g} t_gamma, in the paper at "
            f"{PAPER_COLLISION}."
        )
    elif coarse["state"] == FINISHED:
        found.append(
            f"BIEM at N = 32 without the correction, which collides at {PAPER_COLLISION} t_gamma in the paper, goes through to the end "
            f"here, "
            f"off by {percent(coarse.get('off'))} in the separation."
        )
    for name in CORRECTED:
        bare = rows.get(uncorrected(name), {})
        if "off" in rows[name] and bare.get("state") == FINISHED:
            found.append(f"Without the correction {label(name)} is off by {percent(bare['off'])}, with it by {percent(rows[name]['off'])}.")
    return "\n\n".join(
        [
            "**The paper**: BIEM at N = 32 without the near-singular correction lets the vesicles collide at 0.8 t_gamma, at N = 128 "
            "it does not; VesNet "
            "collides without it at both; with it none does. At N = 32, corrected, BIEM is nearer to N = 128 than VesNet.",
            "**Found**:",
            table(head, lines),
            " ".join([*ranked, *found]) or "No run but the reference is finished yet.",
            "**Why they differ**: the paper's two ellipses at (-2.3 R, 0.3 R) and (0, 0) would overlap at this reduced area, so that "
            "relaxed biconcave shapes "
            "start here, 0.15 R apart; operators at N = 32 are built at 64 nodes, steps are of order 2. A collision is no event of its "
            "own: the guard rejects "
            "the step after which two membranes cross.",
        ]
    )
