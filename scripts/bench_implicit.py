"""Seconds of one implicit step in shear, vesicles on a loose grid: JSON and a Markdown table. All cases in one run.

python scripts/bench_implicit.py [--json out/bench_implicit.json] [--repeat 5]
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import time
from pathlib import Path

import numpy as np

from biem.backend import counting, threads
from biem.curves import shapes
from biem.curves.curve import area, effective_radius, length
from biem.steppers.corrections import CORRECTIONS, Corrected
from biem.steppers.implicit import ImplicitStepper
from biem.steppers.stepper import State

CASES = ((128, 1), (128, 4), (128, 16), (32, 16), (32, 48))  # N, M
PITCH = (0.48, 0.32)  # of the grid; shapes are 0.43 x 0.14


def bench(points: int, count: int, repeat: int) -> dict[str, float]:
    """Median and best wall seconds of a step after two steps of warm-up."""
    one = shapes.equilibrium(points, 0.65)
    columns = int(np.ceil(count**0.5))
    rng = np.random.default_rng(0)
    places = [(PITCH[0] * (i % columns), PITCH[1] * (i // columns)) for i in range(count)]
    X = np.stack([shapes.place(one, np.array(p), rng.uniform(-0.2, 0.2)) for p in places])
    rate = 5.0 / float(effective_radius(X)[0]) ** 3
    inner = ImplicitStepper(1.0, 1.0, lambda Y, t: np.stack([rate * Y[:, 1], 0.0 * Y[:, 1]], axis=1))
    stepper, state = Corrected(inner, CORRECTIONS, area(X), length(X)), State(0.0, X)
    seconds, iterations = [], 0.0
    for k in range(repeat + 2):
        with counting() as counts:
            begin = time.perf_counter()
            result = stepper.step(state, 0.01 / rate)
            if k >= 2:
                seconds.append(time.perf_counter() - begin)
        state, iterations = result.state, result.diagnostics["gmres_iterations"]
    return {
        "N": points,
        "M": count,
        "median_seconds": float(np.median(seconds)),
        "best_seconds": min(seconds),
        "gmres_iterations": iterations,
        "near_rows": counts["near_rows"],
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=Path, default=Path("out/bench_implicit.json"))
    parser.add_argument("--repeat", type=int, default=7)
    options = parser.parse_args()
    rows = []
    print("| N | M | median s | best s | GMRES iterations | near rows |\n|---|---|---|---|---|---|")
    for points, count in CASES:
        row = bench(points, count, options.repeat)
        rows.append(row)
        print("| {N} | {M} | {median_seconds:.3f} | {best_seconds:.3f} | {gmres_iterations:.0f} | {near_rows} |".format(**row), flush=True)
    machine = {"processor": platform.processor() or platform.machine(), "cores": os.cpu_count(), "threads": threads()}
    options.json.parent.mkdir(parents=True, exist_ok=True)
    options.json.write_text(json.dumps({"machine": machine, "steps": rows}, indent=1) + "\n")


if __name__ == "__main__":
    main()
