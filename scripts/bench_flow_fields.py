"""Fields around 100 vesicles (configs/scenes/poiseuille_100.toml): time on a grid by quantities, errors, jumps at membranes, tracers.

OMP_NUM_THREADS=2 python scripts/bench_flow_fields.py -o docs/bench_flow_fields.json

Seconds are the best and the median wall time, and the least CPU time, of repetitions after one call that compiles. The instant (forces
and tension) is made once for the fields, and is timed on its own. Errors: the largest over the largest value, of 2,000 points of the grid,
against a tolerance of 1e-11. Jumps: at all nodes, 1e-8 lengths on either side, against the force on the fluid, over its largest value; of
the velocity over the largest velocity.
"""

from __future__ import annotations

import argparse
import json
import platform
import time
from collections.abc import Callable, Sequence
from functools import partial
from itertools import count
from pathlib import Path

import numpy as np

from biem.backend import fft_backend, threads
from biem.curves.curve import length, normal
from biem.observe.fields import QUANTITIES, FlowField
from biem.observe.grid import Grid, box_around
from biem.observe.instant import instant
from biem.observe.tracers import Carrier, Tracers
from biem.scene.build import Problem, build
from biem.scene.config import load_scene

CHECKED = 2000  # points, and half as many tracers
DISTANCE = 1e-8  # lengths
KINDS: dict[str, Sequence[str]] = {
    "velocity": ("velocity",),
    "pressure": ("pressure",),
    "pressure and stress": ("pressure", "stress"),
    "all": QUANTITIES,
}


def seconds(function: Callable[[], object], repetitions: int) -> dict[str, float]:
    """Best and median wall time, and the least CPU time of all threads, after a first call."""
    function()
    wall, cpu = [], []
    for _ in range(repetitions):
        begin, began = time.perf_counter(), time.process_time()
        function()
        wall.append(time.perf_counter() - begin)
        cpu.append(time.process_time() - began)
    return {"best": round(min(wall), 3), "median": round(float(np.median(wall)), 3), "cpu": round(min(cpu), 3)}


def largest(error: np.ndarray, of: np.ndarray) -> float:
    return float(f"{np.abs(error).max() / np.abs(of).max():.1e}")


def jumps(flow: FlowField) -> dict[str, float]:
    """What is left of the jumps at the membranes."""
    flat = lambda a: a.transpose(0, 2, 1).reshape(-1, 2)
    x, n, f = flat(flow.at.X), flat(normal(flow.at.X)), flat(flow.at.force)
    step = DISTANCE * float(length(flow.at.X).mean())
    outer, inner = (vars(flow.values(x + side * step * n, QUANTITIES)) for side in (1.0, -1.0))
    jump = {name: outer[name] - inner[name] for name in QUANTITIES}
    return {
        "velocity": largest(jump["velocity"], outer["velocity"]),
        "pressure": largest(jump["pressure"] - (f * n).sum(axis=-1), f),
        "traction": largest(np.einsum("pij,pj->pi", jump["stress"], n) + f, f),
    }


def steps_of_tracers(problem: Problem, x: np.ndarray, flow: FlowField) -> Callable[[], object]:
    """One step after the other of tracers at x (P, 2), the membranes where they are."""
    carrier, tracers, times = Carrier(problem), Tracers(x, flow.inside(x)), count()
    X, dt = flow.at.X, problem.dt
    return lambda: [carrier.carry(tracers, X, k * dt, X, (k + 1) * dt) for k in [next(times)]]


def measure(points: int, side: int, repetitions: int) -> dict[str, object]:
    """All numbers for vesicles of so many nodes and a grid of side x side points."""
    problem = build(load_scene("configs/scenes/poiseuille_100.toml", [f"vesicles.points={points}"]))
    x = Grid.of(box_around(problem.X), (side, side)).points
    some = x[np.random.default_rng(0).choice(len(x), CHECKED, replace=False)]
    with fft_backend(problem.X.size):
        at = instant(problem, problem.X)
        flow = FlowField(problem, at)
        times = {name: seconds(partial(flow.values, x, kind), repetitions) for name, kind in KINDS.items()}
        times["instant"] = seconds(lambda: instant(problem, problem.X), repetitions)
        times["step of tracers"] = seconds(steps_of_tracers(problem, some[: CHECKED // 2], flow), repetitions)
        found, exact = (FlowField(problem, at, tolerance, True).values(some, QUANTITIES) for tolerance in (flow.tolerance, 1e-11))
        errors = {name: largest(getattr(found, name) - getattr(exact, name), getattr(exact, name)) for name in QUANTITIES}
        return {"nodes": points, "grid": [side, side], "seconds": times, "errors": errors, "jumps": jumps(FlowField(problem, at, 1e-8))}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", type=Path, required=True)
    parser.add_argument("--grid", type=int, default=500, help="points along either side")
    parser.add_argument("--nodes", type=int, nargs="+", default=[32, 64], help="of a vesicle")
    parser.add_argument("--repetitions", type=int, default=5)
    options = parser.parse_args()
    cases = [measure(points, options.grid, options.repetitions) for points in options.nodes]
    report = {
        "threads": threads(),
        "machine": platform.machine(),
        "vesicles": 100,
        "tolerance": 1e-6,
        "tracers": CHECKED // 2,
        "cases": cases,
    }
    options.output.write_text(json.dumps(report, indent=2) + "\n")
    print(json.dumps(report, indent=2))


if __name__ == "__main__":
    main()
