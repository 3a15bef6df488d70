"""What accuracy costs on one scene: sweeps of solver, nodes, steps, precision and maps, each run against a reference; the Pareto front.

python scripts/trade.py configs/scenes/shear_pair.toml --horizon "10 t_gamma"
python scripts/trade.py configs/scenes/taylor_green_32.toml --horizon "3 t_gamma" --reference out/reproduce/taylor_green/implicit_128.h5
python scripts/trade.py configs/scenes/shear_pair.toml --solvers "split[time.order=1|2, vesicles.points=32|48, time.dt=0.02 t_gamma]"
python scripts/trade.py --page docs/trade.md                                    # of all scenes in out/trade, and their presets

A rung of --solvers may name several values of a key, with | between them: all combinations are run. Without --solvers the sweeps of SWEEPS.
Writes trade.json, trade.md and trade.png of these rungs into out/trade/SCENE; runs that are there are kept.
The error is the largest distance of a centroid from the reference, in R; where none moves that of the shapes. The cost is CPU
seconds of one thread per t_gamma (per t_kappa in a fluid at rest), without compilation, start and output.
"""

from __future__ import annotations

import argparse
import itertools
import json
import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from studies.differences import differences
from studies.pareto import front
from studies.rungs import Rung, rung, split_list
from studies.runs import Kept, kept_all

from biem.curves.curve import area, centroid
from biem.run.trajectory import Trajectory, read_trajectory
from biem.scene.accuracy import PRESETS
from biem.scene.build import build
from biem.scene.config import Scene

FRAMES = 100  # saved of a run, about
REFERENCE = "reference"
SWEEPS = (  # {u}: t_gamma, or a quarter of t_kappa in a fluid at rest
    "split[vesicles.points=32|48, time.order=1|2, time.dt=0.01 {u}|0.02 {u}|0.05 {u}|0.1 {u}]",
    "split[vesicles.points=32|48|64, time.order=2, time.adaptive=true, time.dt=0.02 {u}, time.tolerance=3e-4|1e-3|3e-3|1e-2]",
    "split[vesicles.points=32, solver.operator_points=32|48|128, time.order=2, time.dt=0.02 {u}]",
    "split[vesicles.points=32, solver.dtype=float32, time.order=2, time.dt=0.02 {u}]",
    "split[vesicles.points=48, time.order=2, time.dt=0.02 {u}, solver.near_tolerance=1e-3|1e-4|1e-8]",
    "split[vesicles.points=48, time.order=2, time.dt=0.02 {u}, solver.far_field=ewald, solver.far_tolerance=1e-2|1e-3|1e-4|1e-6]",
    "implicit[vesicles.points=32|64, time.order=2, time.dt=0.02 {u}|0.05 {u}|0.1 {u}]",
    "vesnet:hybrid|vesnet:mlp|vesnet:ivnet[vesicles.points=32, time.order=1, time.dt=1e-5]",
    "vesnet:hybrid|vesnet:mlp|vesnet:ivnet[vesicles.points=32, time.order=2, time.dt=2e-5]",
    "vesnet:hybrid[vesicles.points=32, time.order=2, time.dt=4e-5]",
    "fast",
    "balanced",
)


INTRODUCTION = """# What accuracy costs

Made by `python scripts/trade.py --page docs/trade.md` from sweeps of `python scripts/trade.py SCENE`. Errors are the largest distance of a
centroid from the reference over the time given, in R, the radius of the circle of a vesicle's area; where none moves that of the shapes.
Costs are CPU seconds of one thread per t_gamma (t_kappa in a fluid at rest), without output. A star marks the Pareto front: nothing
is cheaper and as accurate.

## Presets
"""


def combinations(text: str) -> list[str]:
    """The rungs that a text with | stands for."""
    found = re.fullmatch(r"([^\[]+)(?:\[(.*)\])?", text.strip())
    if found is None:
        raise ValueError(f"{text}: expected a solver and KEY=VALUE,... in brackets, as in split[time.order=1|2]")
    settings = [setting.partition("=") for setting in split_list(found[2] or "")]
    choices = [[f"{key.strip()}={value.strip()}" for value in values.split("|")] for key, _, values in settings]
    solvers = [solver.strip() for solver in found[1].split("|")]
    return [f"{s}[{', '.join(own)}]" if own else s for s, *own in itertools.product(solvers, *choices)]


def with_frames(found: Rung, every: int | None = None) -> Rung:
    """The rung with a frame every so many steps; default: about FRAMES frames in its run."""
    problem = build(found.scene)
    every = every or max(1, problem.steps // FRAMES)
    scene = found.scene.model_copy(
        update={
            "time": found.scene.time.model_copy(update={"save_every": every}),
            "output": found.scene.output.model_copy(update={"checkpoint_every": 20 * every}),
        }
    )
    return Rung(found.name, scene)


def moves(trajectory: Trajectory) -> bool:
    """Whether any centroid moves by more than a thousandth of R."""
    c = np.stack([centroid(X) for X in trajectory.X])
    return bool(np.abs(c - c[0]).max() > 1e-3 * np.sqrt(area(trajectory.X[0]).mean() / np.pi))


def row(name: str, run: Kept, reference: Trajectory, measure: str, unit: float, horizon: float) -> dict[str, object]:
    """What a run costs and how far it is off; infinite for a run that did not get to the end of the reference."""
    record = run.record
    found: dict[str, object] = {"rung": name, "failure": record.failure, "steps": record.steps, "until": record.until / unit}
    end = min(horizon, float(reference.t[-1]))
    if record.failure and record.until < end * (1 - 1e-9):
        return found | {"error": None, "cost": None}
    largest = differences(run.trajectory, reference).largest(end)
    per = record.steps * unit / record.until
    return found | {
        "error": largest[measure],
        "cost": (record.cpu_a_step - record.seconds.get("output", 0.0)) * per,
        "wall": record.wall_a_step * per,
        "megabytes": record.peak_bytes / 1e6,
        "differences": largest,
        "rejected": float(run.trajectory.diagnostics["rejected"].sum()),
    }


def table(rows: Sequence[dict], unit: str, measure: str) -> str:
    """In Markdown, from the cheapest; runs on the front are marked."""
    done = sorted((r for r in rows if r["error"] is not None), key=lambda r: r["cost"])
    best = {id(done[k]) for k in front([r["cost"] for r in done], [r["error"] for r in done])}
    lines = [f"|  | rung | {measure}, R | CPU s a {unit} | steps | MB |", "|---|---|---|---|---|---|"]
    for r in done:
        lines.append(
            f"| {'*' if id(r) in best else ''} | {r['rung']} | {r['error']:.2g} | {r['cost']:.3g} | {r['steps']} | {r['megabytes']:.0f} |"
        )
    for r in rows:
        if r["error"] is None:
            lines.append(f"|  | {r['rung']} | ended at {r['until']:.3g} {unit}: {r['failure']} |  |  |  |")
    return "\n".join(lines)


def draw(rows: Sequence[dict], unit: str, measure: str, title: str, path: Path) -> None:
    """Error against cost, by solver, with the front."""
    done = [r for r in rows if r["error"] is not None]
    figure = Figure(figsize=(7.5, 5.0), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots()
    for index, solver in enumerate(dict.fromkeys(r["rung"].partition("[")[0] for r in done)):
        own = [r for r in done if r["rung"].partition("[")[0] == solver]
        axes.loglog([r["cost"] for r in own], [r["error"] for r in own], "o^sDvP*X"[index % 8], label=solver, alpha=0.8)
    line = [done[k] for k in front([r["cost"] for r in done], [r["error"] for r in done])]
    axes.step([r["cost"] for r in line], [r["error"] for r in line], where="post", color="0.4", lw=1, label="Pareto front")
    axes.axhline(1e-2, color="0.7", lw=0.8, ls="--")
    axes.set(xlabel=f"CPU seconds a {unit}", ylabel=f"{measure} error, R", title=title)
    axes.grid(alpha=0.3, which="both")
    axes.legend(frameon=False)
    figure.savefig(path, dpi=130)


def arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", type=Path, nargs="?")
    parser.add_argument("-o", "--output", type=Path, default=Path("out/trade"), help="a folder; the scene's results are in one of its name")
    parser.add_argument("--solvers", help="rungs instead of the sweeps, with commas between them")
    parser.add_argument("--reference", default=REFERENCE, help="a rung, or a trajectory (HDF5) of the same scene")
    parser.add_argument("--horizon", help='time.horizon of all runs, as in "10 t_gamma"')
    parser.add_argument("--page", type=Path, help="write this page from the results that are there, and run nothing")
    parser.add_argument("--workers", type=int, default=1, help="runs at a time, each on one thread")
    parser.add_argument("--set", nargs="*", default=[], metavar="KEY=VALUE")
    return parser.parse_args()


def unit_of(scene: Scene) -> tuple[str, float]:
    """The unit of time of the costs."""
    problem = build(scene)
    scale = problem.flow.time_scale
    return ("t_gamma", scale) if scale else ("t_kappa", problem.t_kappa)


def page(folder: Path, path: Path) -> None:
    """The presets on all scenes, and the sweeps of each, in Markdown with pictures beside it."""
    results = [json.loads(file.read_text()) for file in sorted(folder.glob("*/trade.json"))]
    if not results:
        raise SystemExit(f"error: {folder} holds no trade.json: run the sweeps of a scene first")
    lines = [INTRODUCTION, "| scene | preset | error, R | CPU s a unit | cheaper than reference | steps |", "|---|---|---|---|---|---|"]
    for result in results:
        rows = {r["rung"]: r for r in result["rows"]}
        dearest = rows.get("reference", {}).get("cost")
        for name in PRESETS:
            r = rows.get(name)
            if r is not None and r["error"] is not None:
                times = f"{dearest / r['cost']:.0f} x" if dearest else ""
                error = "" if name == result["reference"] else f"{r['error']:.2g}"
                lines.append(f"| {result['scene']} | {name} | {error} | {r['cost']:.3g} | {times} | {r['steps']} |")
    images = path.parent / "images"
    images.mkdir(exist_ok=True)
    for result in results:
        name, unit = result["scene"], result["unit"]
        picture = images / f"trade_{name}.png"
        draw(result["rows"], unit, result["measure"], name, picture)
        lines += ["", f"## {name}", "", f"Reference: `{result['reference']}`, over {result['horizon']:.3g} {unit}.", ""]
        lines += [f"![{name}: error against cost](images/{picture.name})", "", table(result["rows"], unit, result["measure"])]
    path.write_text("\n".join(lines) + "\n")


def main() -> None:
    chosen = arguments()
    if chosen.page is not None:
        page(chosen.output, chosen.page)
        return
    if chosen.scene is None:
        raise SystemExit("error: no scene: give the path of a TOML file, such as configs/scenes/shear_pair.toml, or --page")
    overrides = [*chosen.set, *([f'time.horizon="{chosen.horizon}"'] if chosen.horizon else [])]
    try:
        stored = chosen.reference.endswith(".h5")
        base = rung(chosen.scene, REFERENCE if stored else chosen.reference, overrides)
        unit, value = unit_of(base.scene)
        sweeps = split_list(chosen.solvers) if chosen.solvers else list(SWEEPS)
        names = [name for sweep in sweeps for name in combinations(sweep.format(u="t_gamma" if unit == "t_gamma" else "t_kappa"))]
        rungs = [with_frames(rung(chosen.scene, name, overrides)) for name in dict.fromkeys(names)]
        problem = build(base.scene)
        found = read_trajectory(Path(chosen.reference)) if stored else None
    except (ValueError, FileNotFoundError) as error:
        raise SystemExit(f"error: {error}") from None
    folder = chosen.output / base.scene.name
    tasks = {r.name: (r.scene, folder / "runs" / f"{r.file}.h5") for r in rungs}
    if not stored:
        first = with_frames(base, 1 if base.scene.time.adaptive else None)  # it is interpolated to the others' times
        tasks = {first.name: (first.scene, folder / "runs" / f"{first.file}.h5"), **tasks}
    runs = kept_all(tasks, chosen.workers)
    reference = found or runs[base.name].trajectory
    measure = "position" if moves(reference) else "shape"
    rows = [row(name, run, reference, measure, value, problem.horizon) for name, run in runs.items()]
    text = table(rows, unit, measure)
    folder.mkdir(parents=True, exist_ok=True)
    result = {"scene": base.scene.name, "unit": unit, "measure": measure, "reference": chosen.reference, "rows": rows}
    result["horizon"] = min(problem.horizon, float(reference.t[-1])) / value
    (folder / "trade.json").write_text(json.dumps(result, indent=1, default=float))
    (folder / "trade.md").write_text(text + "\n")
    draw(rows, unit, measure, base.scene.name, folder / "trade.png")
    print(text)


if __name__ == "__main__":
    main()
