"""2,000 vesicles in Poiseuille flow, Ca = 2, Cn = 0.025, 30 % of the area, by steps of 1e-5 mu L^3/kappa_b in float32."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.collections import PolyCollection
from studies.rungs import rung

from biem.curves.curve import area, length
from biem.run.trajectory import Trajectory
from reproductions.pictures import figure, label, outlines, save
from reproductions.study import MISSING, SCENES, Results, Study, Task, ended, gather, table, write_results

NAME = "dense"
RUNGS = ("split", "vesnet:mlp")
DT, PAPER_STEPS, FEW_STEPS, FRAMES = 1e-5, 4000, 200, 20
ZOOM = (-4.0, 0.0, 8.0, 5.2)  # of the second panel: left, bottom, width, height, in lengths
QUICK = ["vesicles.count=12", "vesicles.box=[2.6, 1.6]", "flow.confinement=0.1"]


def measure(study: Study) -> Results:
    """Runs, results.json, pictures."""
    folder = study.folder(NAME)
    steps = study.steps or (3 if study.quick else FEW_STEPS if study.device == "cpu" else PAPER_STEPS)
    overrides = [f"time.dt={DT!r}", f"time.horizon={steps * DT!r}", f"time.save_every={max(1, steps // FRAMES)}"]
    overrides += ['solver.dtype="float32"', f'solver.device="{study.device}"', *(QUICK if study.quick else [])]
    tasks = {}
    for name in study.rungs(RUNGS):
        made = rung(SCENES / "poiseuille_2000.toml", name, overrides)
        tasks[name] = Task(made, folder / f"{made.file}_{study.device.replace(':', '-')}_{steps}.h5")
    runs = gather(study, tasks, desc="dense suspension")
    rows = {name: run.summary() for name, run in runs.items()}
    pictures = []
    for name, run in runs.items():
        if run.trajectory is None:
            continue
        first, last = run.trajectory.X[0], run.trajectory.X[-1]
        rows[name] |= {
            "vesicles": int(first.shape[0]),
            "area": float(np.abs(area(last) / area(first) - 1.0).max()),
            "length": float(np.abs(length(last) / length(first) - 1.0).max()),
            "step_error": float(max(run.trajectory.diagnostics[k].max() for k in ("area_error", "length_error"))),
        }
        pictures.append(_snapshots(run.trajectory, folder / f"{run.task.rung.file}.png"))
    return write_results(study, NAME, {"device": study.device, "steps": steps, "rows": rows, "pictures": pictures})


def _snapshots(trajectory: Trajectory, path: Path) -> str:
    """All of it at the start and at the end, and a part of the end."""
    made, axes = figure(12.0, 11.0, 3, 1, height_ratios=[1.0, 1.0, 1.7])
    ends = [(0, None), (-1, None), (-1, ZOOM)]
    unit = float(trajectory.attributes["t_gamma"])
    for panel, (k, part) in zip(axes.flat, ends, strict=True):
        X = trajectory.X[k]
        panel.add_collection(
            PolyCollection(list(outlines(X).transpose(0, 2, 1)), facecolor="#c0392b", edgecolor="black", linewidth=0.6 if part else 0.2)
        )
        low, high = X.min(axis=(0, 2)), X.max(axis=(0, 2))
        if part:
            low, high = np.array(part[:2]), np.array(part[:2]) + np.array(part[2:])
        panel.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal")
        panel.set_title(
            rf"step {trajectory.step[k]}, $t = {trajectory.t[k] / unit:.3g}\, t_{{\dot\gamma}}$" + (", a part" if part else ""), fontsize=9
        )
    return save(made, path)


def section(results: Results) -> str:
    """Statement, finding, difference."""
    rows = results["rows"]
    head = [
        "rung",
        "run",
        "vesicles",
        "steps",
        "s a step",
        "smallest gap, lengths",
        "area, length after all",
        "error of a step",
        "outside training",
    ]
    lines = []
    for name, r in rows.items():
        drift = None if r["state"] == MISSING else f"{r['area']:.0e}, {r['length']:.0e}"
        lines.append(
            [
                *(label(name), ended(r), r.get("vesicles"), r.get("steps"), r.get("seconds_a_step"), r.get("smallest_gap")),
                *(drift, r.get("step_error"), r.get("out_of_distribution")),
            ]
        )
    made = [name for name, r in rows.items() if r.get("steps", 0) >= PAPER_STEPS]
    text = f"Of the paper's {PAPER_STEPS} steps {results['steps']} were asked for, on {results['device']}; " + (
        f"{', '.join(map(label, made))} made all of the paper's." if made else "no run made as many as the paper's."
    )
    return "\n\n".join(
        [
            "**The paper**: 2,000 vesicles at Ca = 2, Cn = 0.025, 30 %: snapshots of 4,000 steps of 1e-5, 1.4 s each on a GH200.",
            "**Found** (time in t_gamma; errors relative; outside training: most vesicles in a step):",
            table(head, lines),
            text,
            "**Why they differ**: the initial packing is a random one; the flow is unbounded and not periodic, so that the suspension "
            "disperses at its ends.",
        ]
    )
