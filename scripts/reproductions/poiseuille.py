"""One vesicle in Poiseuille flow: shapes, lateral positions and residual velocities in equilibrium, Cn x Ca, by all rungs.

The reference and split start at W/2, and end when y/W changes by less than `studies.steady.CHANGE` over `studies.steady.WINDOW` t_gamma.
The others go on for FROM_REST t_gamma from the reference's last frame, at 32 nodes: where a rung rests elsewhere, it leaves that place.
Networks relax over sums of 1e-5 mu L^3/kappa_b, so that their steps are 2e-5 of order 2 where that is at most LONGEST t_gamma, 1e-5 of
order 1 where it is not.
"""

from __future__ import annotations

from itertools import product
from math import pi, sqrt
from pathlib import Path

import numpy as np
from matplotlib import colormaps
from matplotlib.cm import ScalarMappable
from matplotlib.colors import SymLogNorm
from studies.rungs import Rung, rung
from studies.steady import CHANGE, WINDOW

from biem.curves.conserve import restore_area_length
from biem.curves.curve import area, centroid, length
from biem.curves.fourier import resample
from biem.curves.reparam import redistribute
from biem.run.files import atomic_h5
from biem.run.trajectory import Trajectory
from reproductions.lateral import in_words, lateral_velocities
from reproductions.pictures import color, figure, fill, label, save
from reproductions.study import (
    FINISHED,
    MISSING,
    SCENES,
    Found,
    Results,
    Study,
    Task,
    ended,
    found,
    from_file,
    gather,
    table,
    write_results,
)

NAME = "poiseuille"
REFERENCE, SPLIT, NETWORK = "implicit[vesicles.points=128]", "split[vesicles.points=32]", "vesnet:hybrid"
RUNGS = (REFERENCE, SPLIT, "implicit[vesicles.points=32]", NETWORK)
FROM_START = (REFERENCE, SPLIT)
POINTS = 32  # of those that start at the reference's end
CN, CA = (0.75, 0.6, 0.4, 0.2), (10, 20, 30, 40, 50)
R = sqrt(0.65) / (2.0 * pi)  # of a membrane of length 1 and reduced area 0.65
LEARNED, LONGEST = 1e-5, 0.1  # a step of the networks, mu L^3/kappa_b; a step of order 2, t_gamma, at most
MEASURED = ((0.75, 20), (0.75, 40))  # cases whose lateral velocities are measured
HORIZON, FROM_REST = 1200, 200  # t_gamma: of runs, and of those that start where the reference came to rest
AT_REST = 5.0  # t_gamma at the end over which velocities are taken
START, BAR = 0.5, 0.01  # of y/W
LINEAR = 1e-4  # of the colours of residual velocities: below it they are linear


def scene(name: str, cn: float, ca: float, start: Path | None = None, quick: bool = False) -> Rung:
    """A rung at Cn and Ca, from y/W = START, or the shape in a file. quick: four steps."""
    dt = 0.05 if cn == 0.75 else 0.1
    overrides = [f"vesicles.centers=[[0.0,{START / cn!r}]]", f"flow.capillary={float(ca)}", f"flow.confinement={cn}"]
    if name.startswith("vesnet"):
        t_gamma = 2.0 * R**3 / ca
        order = 2 if LONGEST * t_gamma >= 2.0 * LEARNED else 1
        dt = order * LEARNED / t_gamma
        overrides += ["vesicles.points=32", f"time.dt={order * LEARNED!r}", f"time.order={order}"]
    else:
        overrides += [f'time.dt="{dt} t_gamma"', "time.order=2"]
    horizon = HORIZON if start is None else FROM_REST
    overrides += [f'time.horizon="{horizon} t_gamma"', f"time.save_every={round(1 / dt)}", "output.checkpoint_every=500"]
    if quick:
        overrides += [f'time.horizon="{4 * dt} t_gamma"', "time.save_every=1"]
    made = rung(SCENES / "poiseuille_single.toml", name, overrides)
    return made if start is None else from_file(made, start)


def measure(study: Study) -> Results:
    """Runs, results.json, pictures."""
    folder = study.folder(NAME)
    cases = list(product(CN, CA))[:1] if study.quick else list(product(CN, CA))
    names = study.rungs(RUNGS)
    runs: dict[str, Found] = {}
    starts: dict[tuple[float, int], Path] = {}
    for group, ending in ((FROM_START, "studies.steady:across_the_flow"), ([name for name in names if name not in FROM_START], "")):
        tasks = {}
        for name, (cn, ca) in product(group, cases):
            made = scene(name, cn, ca, starts.get((cn, ca)), study.quick)
            task = Task(made, folder / made.file / f"cn{cn}_ca{ca}.h5")
            if name in FROM_START or (cn, ca) in starts:
                tasks[f"{name} {cn} {ca}"] = task
            else:  # there is nothing yet to start from
                runs[f"{name} {cn} {ca}"] = found(task)
        runs |= gather(study, tasks, ending, "Poiseuille flow")
        for cn, ca in cases:
            reference = runs[f"{REFERENCE} {cn} {ca}"]
            if reference.trajectory is not None and reference.state == FINISHED:
                starts[cn, ca] = start_file(reference.trajectory.X[-1], folder / "starts" / f"cn{cn}_ca{ca}.h5")
    rows = [_row(runs[f"{name} {cn} {ca}"], name, cn, ca) for name, (cn, ca) in product(names, cases)]
    expected = {(row["cn"], row["ca"]): row for row in rows if row["rung"] == REFERENCE}
    for row in rows:
        other = expected[row["cn"], row["ca"]]
        if row["state"] == other["state"] == FINISHED:
            row["off"] = abs(abs(row["y"]) - abs(other["y"]))
    velocities = {
        f"Cn {cn}, Ca {ca}": lateral_velocities(trajectory, at_few_nodes)
        for cn, ca in MEASURED
        if (cn, ca) in starts and (trajectory := runs[f"{REFERENCE} {cn} {ca}"].trajectory) is not None
    }
    pictures = [_lateral(rows, names, folder / "lateral.png")]
    shapes = {
        name: [(cn, ca, runs[f"{name} {cn} {ca}"], row) for row in rows for cn, ca in [(row["cn"], row["ca"])] if row["rung"] == name]
        for name in (REFERENCE, NETWORK)
    }
    pictures.append(_phases(shapes, folder / "phases.png"))
    return write_results(study, NAME, {"rungs": list(names), "rows": rows, "velocities": velocities, "pictures": pictures})


def start_file(X: np.ndarray, path: Path) -> Path:
    """The shape X (1, 2, N) `at_few_nodes` in a file for `vesicles.file`."""
    path.parent.mkdir(exist_ok=True)
    with atomic_h5(path) as file:
        file["X"] = at_few_nodes(X)
    return path


def at_few_nodes(X: np.ndarray) -> np.ndarray:
    """X (1, 2, N) at POINTS nodes, equally spaced, of the same area and length."""
    return restore_area_length(redistribute(resample(X, POINTS))[0], area(X), length(X))[0]


def at_rest(trajectory: Trajectory) -> Results:
    """y/W at the end, its change over the last WINDOW t_gamma, and the vertical velocity over the net one in the last AT_REST."""
    t = trajectory.t / trajectory.attributes["t_gamma"]
    c = np.stack([centroid(X)[0] for X in trajectory.X])
    y = c[:, 1] / trajectory.attributes["flow_width"]
    recent, last = t >= t[-1] - WINDOW, int(np.searchsorted(t, t[-1] - AT_REST * (1 + 1e-9)))
    moved = c[-1] - c[min(last, len(c) - 2)]
    return {"y": float(y[-1]), "change": float(np.ptp(y[recent])), "residual": float(abs(moved[1]) / np.hypot(*moved))}


def approach(trajectory: Trajectory) -> float | None:
    """t_gamma in which y falls by e over the last WINDOW, of a run that comes to the centre line; None for others."""
    t = trajectory.t / trajectory.attributes["t_gamma"]
    y = np.array([centroid(X)[0, 1] for X in trajectory.X]) / trajectory.attributes["flow_width"]
    late = t >= t[-1] - WINDOW
    if np.abs(y[late]).max() > BAR or (y[late] <= 0.0).any() or late.sum() < 3:
        return None
    slope = np.polyfit(t[late], np.log(y[late]), 1)[0]
    return float(-1.0 / slope) if slope < 0.0 else None


def _row(run: Found, name: str, cn: float, ca: float) -> Results:
    row = {"rung": name, "cn": cn, "ca": ca, **run.summary()}
    if run.trajectory is not None and len(run.trajectory) > 1:
        row |= at_rest(run.trajectory)
        row["at_rest"] = row["state"] == FINISHED and row["change"] <= CHANGE
        row["approach"] = approach(run.trajectory) if name == REFERENCE else None
    return row


def _lateral(rows: list[Results], names: tuple[str, ...], path: Path) -> str:
    """y/W against Ca for each Cn; open where a run did not come to rest."""
    made, axes = figure(12.0, 3.4, 1, len(CN), sharey=True)
    marks = dict(zip(names, "os^Dv<>pPX*", strict=False))
    for panel, cn in zip(axes.flat, CN[::-1], strict=True):
        for name in names:
            mine = [row for row in rows if row["cn"] == cn and row["rung"] == name and "y" in row]
            still = [row for row in mine if row["at_rest"]]
            style = {"color": color(name), "marker": marks[name]}
            panel.plot([r["ca"] for r in still], [abs(r["y"]) for r in still], **style, ms=5, lw=0.8, label=label(name))
            moving = [row for row in mine if not row["at_rest"]]
            panel.plot([r["ca"] for r in moving], [abs(r["y"]) for r in moving], **style, ls="", mfc="none", ms=8)
        panel.set(title=f"Cn = {cn}", xlabel="Ca", xticks=CA, xlim=(5, 55))
        panel.grid(alpha=0.3)
    axes[0, 0].set_ylabel("|y| / W at the end (open: not at rest)")
    made.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=len(names), fontsize=8)
    return save(made, path)


def _phases(shapes: dict[str, list[tuple[float, float, Found, Results]]], path: Path) -> str:
    """Shape for each (Ca, Cn), coloured by the residual velocity, the reference beside the networks."""
    made, axes = figure(12.0, 5.2, 1, len(shapes), sharex=True, sharey=True)
    norm, colors = SymLogNorm(LINEAR, vmin=0.0, vmax=1e-1), colormaps["viridis"]
    for panel, (name, runs) in zip(axes.flat, shapes.items(), strict=True):
        for cn, ca, run, row in runs:
            if run.trajectory is None or "residual" not in row:
                continue
            X = run.trajectory.X[-1]
            X = (X - centroid(X)[..., None]) * 1.6 + np.array([ca / 10.0, CN[::-1].index(cn) + 1.0])[:, None]
            fill(panel, X, colors(norm(row["residual"])), linestyle="-" if row["at_rest"] else ":")
        panel.set(title=label(name), xlabel="Ca", xticks=range(1, 6), yticks=range(1, 5), xlim=(0.4, 5.6), ylim=(0.4, 4.6))
        panel.set_aspect("equal")
        panel.set_xticklabels([str(ca) for ca in CA])
        panel.set_yticklabels([str(cn) for cn in CN[::-1]])
    axes[0, 0].set_ylabel("Cn")
    made.colorbar(ScalarMappable(norm, colors), ax=axes.ravel().tolist(), label="|vertical velocity| / net velocity at the end", shrink=0.8)
    return save(made, path)


def section(results: Results) -> str:
    """Statement, finding, difference."""
    rows, names = results["rows"], results["rungs"]
    done = {name: [r for r in rows if r["rung"] == name and r["state"] == FINISHED] for name in names}
    others = [name for name in names if name != REFERENCE]
    by_case = {(r["cn"], r["ca"], r["rung"]): r for r in rows}
    cases = list(dict.fromkeys((r["cn"], r["ca"]) for r in rows))

    def cell(r: Results) -> str:
        if r["state"] == MISSING or "y" not in r:
            return ended(r)
        if r["state"] != FINISHED:
            return f"{r['y']:.4f} ({ended(r)})"
        text = f"{r['y']:.4f}" + ("" if r["at_rest"] else f" (moves by {r['change']:.1g})")
        if r["rung"] == REFERENCE or "off" not in r:
            return text
        return f"{text} **({r['off']:.4f})**" if r["off"] > BAR else f"{text} ({r['off']:.4f})"

    lines = [table(["Cn", "Ca", *map(label, names)], [[cn, ca, *(cell(by_case[cn, ca, n]) for n in names)] for cn, ca in cases])]
    lines.append(
        f"y/W at the end, and in brackets how far |y|/W is from the reference's, bold above {BAR}; times in t_gamma. A run is at rest "
        f"when y/W changes by less than {CHANGE:g} in {WINDOW:g} t_gamma."
    )
    summary = []
    for name in others:
        compared = [r for r in done[name] if "off" in r]
        if compared:
            within, worst = sum(r["off"] <= BAR for r in compared), max(compared, key=lambda r: r["off"])
            summary.append([label(name), f"{within} of {len(compared)}", worst["off"], f"Cn {worst['cn']}, Ca {worst['ca']}"])
    if summary:
        lines.append(table(["rung", f"within {BAR} of the reference", "largest difference of y/W", "at"], summary))
    slow = [r["approach"] for r in rows if r.get("approach")]
    if slow:
        lines.append(
            f"Near the centre line the reference's y falls by e in {min(slow):.0f} to {max(slow):.0f} t_gamma, where it does: an error "
            "of the lateral velocity of y over that time is enough to make the centre unstable, and a rung then rests beside it."
        )
    if any(results["velocities"].values()):
        lines.append(in_words(results["velocities"]))
    residual = []
    for name in names:
        values = [r["residual"] for r in done[name] if r["at_rest"]]
        if values:
            residual.append([label(name), len(values), len(cases), float(np.median(values)), float(np.max(values))])
    if residual:
        lines.append("Residual vertical velocity over the net velocity, of the runs that came to rest:")
        lines.append(table(["rung", "at rest", "of", "median", "largest"], residual))
    return "\n\n".join(
        [
            "**The paper**: equilibrium shapes of N = 128 BIEM and of VesNet at N = 32 agree qualitatively, lateral positions differ "
            "in places, more at high Ca and Cn; the vertical velocity in equilibrium should vanish; stable steps are 1e-5 and 5e-6 "
            "(Ca >= 40). VesNet at N = 32 is as accurate as BIEM at N = 32 or better.",
            "**Found**:",
            *lines,
            "**Why they differ**: here exact operators take steps of order 2, networks those of order 1 where 2e-5 is above "
            f"{LONGEST} t_gamma; operators at N = 32 are built at 64 nodes, and networks are trained on the converged flow. "
            f"{' and '.join(map(label, FROM_START))} start at W/2, the others at the reference's last frame, for {FROM_REST} t_gamma. "
            "The paper's VesNet at N = 128 has no counterpart: the shipped networks are for 32 nodes. The flow is "
            "unbounded, W is only the width of the parabola, as in the paper.",
        ]
    )
