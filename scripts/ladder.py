"""The rungs of the ladder on one scene: implicit, split, and VesNet with each kind of maps; how far they part, and what a step takes.

python scripts/ladder.py configs/scenes/vesnet_pair.toml -o out/ladder --rungs implicit:vesicles.points=64 split hybrid mlp ivnet
python scripts/ladder.py configs/scenes/vesnet_pair.toml --set flow.capillary=0.5 --rungs split:time.dt=1e-5,time.save_every=20 hybrid

A rung is a solver, with settings of its own after a colon. Writes a trajectory of each (those that are finished are kept), ladder.md,
ladder.json and ladder.png: distances of the centroids from those of the first rung at the times that both have saved, all of it and across
the flow (y alone), in radii R; of two vesicles the error of their separation; and the shapes of all rungs at the end.
"""

from __future__ import annotations

import argparse
import json
import re
from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from biem.curves.curve import area, centroid
from biem.curves.fourier import resample
from biem.errors import NumericalFailure
from biem.run.simulate import simulate
from biem.run.trajectory import Trajectory, read_trajectory
from biem.scene.config import Scene, load_scene

SOLVERS = ("implicit", "split", "hybrid", "mlp", "ivnet")
DEFAULT = ("implicit:vesicles.points=64", "split", "hybrid", "mlp", "ivnet")


def scene_of(path: Path, rung: str, overrides: list[str], weights: Path | None) -> Scene:
    """The scene by one rung. Raises ValueError."""
    solver, _, own = rung.partition(":")
    if solver not in SOLVERS:
        raise ValueError(f"rung {rung}: expected one of {', '.join(SOLVERS)}, with KEY=VALUE,... after a colon")
    exact = solver in ("implicit", "split")
    chosen = [f'solver.kind="{solver}"'] if exact else ['solver.kind="vesnet"', f'solver.maps="{solver}"']
    if weights and not exact:
        chosen.append(f'solver.weights="{weights.resolve()}"')
    unused = ['solver.maps="hybrid"', 'solver.out_of_distribution="flag"'] if exact else []
    return load_scene(path, [*overrides, *unused, *chosen, *filter(None, own.split(","))])


def run(scene: Scene, output: Path) -> Trajectory:
    """The finished trajectory, made now if it is not there; of a run that fails, what there is of it."""
    if output.exists():
        found = read_trajectory(output)
        if found.attributes["scene"] == json.dumps(scene.model_dump(mode="json")) and found.t[-1] > 0:
            return found
    try:
        simulate(scene, output, force=True, progress=True)
    except NumericalFailure as error:
        print(f"{output.stem}: {error}")
    return read_trajectory(output)


def seconds_a_step(trajectory: Trajectory) -> float:
    """Mean wall time."""
    steps = np.diff(trajectory.step)
    return float((trajectory.diagnostics["wall_seconds"][1:] * steps).sum() / steps.sum())


def compared(
    name: str, trajectory: Trajectory, first: Trajectory, R: float, unit: float
) -> tuple[dict[str, object], np.ndarray, np.ndarray]:
    """A row of the table, and times and distances in R from the first rung."""
    common, of_one, of_first = np.intersect1d(np.rint(trajectory.t / (1e-6 * unit)), np.rint(first.t / (1e-6 * unit)), return_indices=True)
    own, reference = (np.stack([centroid(X) for X in t.X[index]]) for t, index in ((trajectory, of_one), (first, of_first)))
    far = np.linalg.norm(own - reference, axis=-1).max(axis=1) / R
    row = {
        "rung": name,
        "nodes": trajectory.X.shape[-1],
        "until": float(trajectory.t[-1] / unit),
        "seconds_a_step": seconds_a_step(trajectory),
        "seconds_a_unit": seconds_a_step(trajectory) * int(trajectory.step[-1]) / float(trajectory.t[-1] / unit),
        "largest": float(far.max()),
        "last": float(far[-1]),
        "across": float(np.abs(own - reference)[..., 1].max() / R),
    }
    if own.shape[1] == 2:
        apart, expected = (np.linalg.norm(c[:, 0] - c[:, 1], axis=-1) for c in (own, reference))
        row["separation"] = float(np.abs(apart / expected - 1.0).max())
    return row, common * 1e-6, far


def table(rows: list[dict[str, object]], unit: str) -> str:
    """In Markdown."""
    columns = {"rung": "rung", "nodes": "nodes", "until": f"until, {unit}", "seconds_a_step": "s a step", "seconds_a_unit": f"s a {unit}"}
    columns |= {"largest": "largest distance, R", "last": "at the end", "across": "across the flow, R"}
    columns |= {"separation": "separation"} if "separation" in rows[0] else {}
    lines = ["| " + " | ".join(columns.values()) + " |", "|" + "---|" * len(columns)]
    shown = lambda value: f"{value:.2g}" if isinstance(value, float) else str(value)
    return "\n".join([*lines, *("| " + " | ".join(shown(row[key]) for key in columns) + " |" for row in rows)])


def draw(trajectories: dict[str, Trajectory], distances: dict[str, tuple[np.ndarray, np.ndarray]], unit: str, path: Path) -> None:
    """Distances over time, and outlines at the end."""
    figure = Figure(figsize=(11, 4.5), layout="constrained")
    FigureCanvasAgg(figure)
    left, right = figure.subplots(1, 2)
    for name, (t, far) in distances.items():
        left.semilogy(t[1:], np.maximum(far[1:], 1e-6), label=name)
    left.set(xlabel=f"time, {unit}", ylabel=f"distance of centroids from {next(iter(trajectories))}, R")
    left.grid(alpha=0.3)
    left.legend()
    for index, trajectory in enumerate(trajectories.values()):
        fine = resample(trajectory.X[-1], 256)
        for outline in np.concatenate([fine, fine[..., :1]], axis=-1):
            right.plot(*outline, color=f"C{index - 1}" if index else "black", lw=2.5 if not index else 1.0)
    right.set(aspect="equal", title=f"membranes at the end; black: {next(iter(trajectories))}")
    figure.savefig(path, dpi=130)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", type=Path)
    parser.add_argument("-o", "--output", type=Path, default=Path("out/ladder"))
    parser.add_argument("--rungs", nargs="+", default=list(DEFAULT), metavar="SOLVER[:KEY=VALUE,...]")
    parser.add_argument("--weights", type=Path, help="folder of weights; default those that are shipped")
    parser.add_argument("--set", nargs="*", default=[], metavar="KEY=VALUE")
    chosen = parser.parse_args()
    try:
        scenes = {rung: scene_of(chosen.scene, rung, chosen.set, chosen.weights) for rung in chosen.rungs}
    except (ValueError, FileNotFoundError) as error:
        raise SystemExit(f"error: {error}") from None
    chosen.output.mkdir(parents=True, exist_ok=True)
    trajectories = {rung: run(scene, chosen.output / (re.sub(r"[^\w.=-]+", "_", rung) + ".h5")) for rung, scene in scenes.items()}
    first = trajectories[chosen.rungs[0]]
    R, t_gamma = float(np.sqrt(area(first.X[0]).mean() / np.pi)), float(first.attributes["t_gamma"])
    unit, value = ("t_gamma", t_gamma) if t_gamma else ("unit of time", 1.0)
    found = {rung: compared(rung, trajectory, first, R, value) for rung, trajectory in trajectories.items()}
    rows = [row for row, _, _ in found.values()]
    text = table(rows, unit)
    (chosen.output / "ladder.md").write_text(text + "\n")
    (chosen.output / "ladder.json").write_text(json.dumps(rows, indent=1))
    draw(trajectories, {rung: (t, far) for rung, (_, t, far) in list(found.items())[1:]}, unit, chosen.output / "ladder.png")
    print(text)


if __name__ == "__main__":
    main()
