"""The rungs of the ladder on one scene: implicit, split, and VesNet with each kind of maps; how far they part, and what a step takes.

python scripts/ladder.py configs/scenes/vesnet_pair.toml -o out/ladder [--rungs implicit split hybrid mlp ivnet] [--reference-points 64]

Writes a trajectory of each rung (those that are finished are kept), ladder.md, ladder.json and ladder.png: distances of the centroids from
those of the first rung, which runs with --reference-points nodes, and the shapes of all at the end.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from biem.curves.curve import area, centroid
from biem.curves.fourier import resample
from biem.run.simulate import simulate
from biem.run.trajectory import Trajectory, read_trajectory
from biem.scene.config import Scene, load_scene

RUNGS = ("implicit", "split", "hybrid", "mlp", "ivnet")
SHOWN = RUNGS[:4]


def scene_of(path: Path, rung: str, overrides: list[str], points: int | None, weights: Path | None) -> Scene:
    """The scene by one rung."""
    exact = rung in ("implicit", "split")
    chosen = [f'solver.kind="{rung}"'] if exact else ['solver.kind="vesnet"', f'solver.maps="{rung}"']
    if weights and not exact:
        chosen.append(f'solver.weights="{weights.resolve()}"')
    unused = ['solver.maps="hybrid"', 'solver.out_of_distribution="flag"'] if exact else []
    return load_scene(path, [*overrides, *unused, *chosen, *([f"vesicles.points={points}"] if points else [])])


def run(scene: Scene, output: Path) -> Trajectory:
    """The finished trajectory, made now if it is not there."""
    if output.exists():
        found = read_trajectory(output)
        if found.attributes["scene"] == json.dumps(scene.model_dump(mode="json")) and found.t[-1] > 0:
            return found
    simulate(scene, output, force=True, progress=True)
    return read_trajectory(output)


def seconds_a_step(trajectory: Trajectory) -> float:
    """Mean wall time."""
    steps = np.diff(trajectory.step)
    return float((trajectory.diagnostics["wall_seconds"][1:] * steps).sum() / steps.sum())


def draw(trajectories: dict[str, Trajectory], distances: dict[str, np.ndarray], unit: float, path: Path) -> None:
    """Distances over time, and outlines at the end."""
    figure = Figure(figsize=(11, 4.5), layout="constrained")
    FigureCanvasAgg(figure)
    left, right = figure.subplots(1, 2)
    for name, values in distances.items():
        left.semilogy(trajectories[name].t[1:] / unit, np.maximum(values[1:], 1e-6), label=name)
    left.set(xlabel="time in t_gamma" if unit != 1.0 else "time", ylabel=f"distance of centroids from {next(iter(trajectories))}, in R")
    left.grid(alpha=0.3)
    left.legend()
    for index, (name, trajectory) in enumerate(trajectories.items()):
        fine = resample(trajectory.X[-1], 256)
        for m, outline in enumerate(np.concatenate([fine, fine[..., :1]], axis=-1)):
            right.plot(*outline, color=f"C{index - 1}" if index else "black", lw=2.5 if not index else 1.0, label=name if m == 0 else None)
    right.set(aspect="equal", title="membranes at the end")
    right.legend(fontsize="small")
    figure.savefig(path, dpi=130)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", type=Path)
    parser.add_argument("-o", "--output", type=Path, default=Path("out/ladder"))
    parser.add_argument("--rungs", nargs="+", choices=RUNGS, default=list(SHOWN))
    parser.add_argument("--reference-points", type=int, default=64, help="nodes of the first rung")
    parser.add_argument("--weights", type=Path, help="folder of weights; default those that are shipped")
    parser.add_argument("--set", nargs="*", default=[], metavar="KEY=VALUE")
    chosen = parser.parse_args()
    chosen.output.mkdir(parents=True, exist_ok=True)
    trajectories = {}
    for index, rung in enumerate(chosen.rungs):
        scene = scene_of(chosen.scene, rung, chosen.set, chosen.reference_points if index == 0 else None, chosen.weights)
        trajectories[rung] = run(scene, chosen.output / f"{rung}.h5")
    first = trajectories[chosen.rungs[0]]
    R = float(np.sqrt(area(first.X[0]).mean() / np.pi))
    centers = {name: np.stack([centroid(X) for X in t.X]) for name, t in trajectories.items()}
    frames = min(len(t) for t in trajectories.values())
    distances = {
        name: np.linalg.norm(c[:frames] - centers[chosen.rungs[0]][:frames], axis=-1).max(axis=1) / R
        for name, c in centers.items()
        if name != chosen.rungs[0]
    }
    rows = []
    for name, t in trajectories.items():
        far = distances.get(name, np.zeros(1))
        worst, last = float(far.max()), float(far[-1])
        rows.append({"rung": name, "nodes": t.X.shape[-1], "seconds_a_step": seconds_a_step(t), "largest": worst, "last": last})
    lines = ["| rung | nodes | s a step | largest distance, in R | at the end |", "|---|---|---|---|---|"]
    lines += [f"| {r['rung']} | {r['nodes']} | {r['seconds_a_step']:.3g} | {r['largest']:.2e} | {r['last']:.2e} |" for r in rows]
    text = "\n".join(lines)
    (chosen.output / "ladder.md").write_text(text + "\n")
    (chosen.output / "ladder.json").write_text(json.dumps(rows, indent=1))
    draw(trajectories, distances, float(first.attributes["t_gamma"]) or 1.0, chosen.output / "ladder.png")
    print(text)


if __name__ == "__main__":
    main()
