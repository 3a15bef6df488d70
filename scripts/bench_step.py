"""Seconds of one time step by stage, of dense suspensions: JSON and a Markdown table. Every case runs in a process of its own.

python scripts/bench_step.py                                                      # the split solver on this machine's cores
python scripts/bench_step.py --solvers implicit split --counts 48 504
python scripts/bench_step.py --devices cuda --dtypes float64 float32 --far-fields auto direct
python scripts/bench_step.py --solvers split vesnet:hybrid vesnet:mlp vesnet:ivnet --dtypes float32 --counts 504
python scripts/bench_step.py --smoke                                              # small cases, seconds

Vesicles of reduced area 0.65 fill 30 % of the area: tiles of one random packing, in Poiseuille flow (Ca = 2, W = 40 R), dt = 0.005 t_gamma.
VesNet takes dt = 1e-5 mu length^3/kappa_b, which its networks are for. Wall seconds are the median of a few steps after two steps of
warm-up; the stages are those of that step, the guard is not in it.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import resource
import subprocess
import sys
import time
from functools import cache
from pathlib import Path

import numpy as np

from biem.backend import counting, fft_backend, threads, timing, to_numpy
from biem.curves import shapes
from biem.curves.curve import area, effective_radius, length
from biem.curves.packing import assemble, random_packing
from biem.run.guard import check_state
from biem.run.simulate import Problem
from biem.run.solver import make_stepper, on_device
from biem.scene.config import make_scene
from biem.scene.flows import make_flow
from biem.steppers.stepper import State

TILE = 504  # vesicles of one packing
FRACTION = 0.3
LEARNED_DT = 1e-5  # mu length^3 / kappa_b: relaxation networks know no other
SOLVERS = ("split", "implicit", "vesnet:exact", "vesnet:hybrid", "vesnet:mlp", "vesnet:ivnet")
STAGES = (
    "near",
    "far",
    "self-tension",
    "flow tension",
    "advection",
    "relaxation",
    "response",
    "redistribution",
    "area and length",
    "guard",
)


def packing(count: int, points: int) -> np.ndarray:
    """X (count, 2, points): copies side by side of one packing of at most TILE vesicles."""
    tile = min(count, TILE)
    coarse = np.repeat(shapes.equilibrium(32, 0.65)[None], tile, axis=0)
    side = float(np.sqrt(tile * area(coarse[:1])[0] / FRACTION))
    centers, angles = random_packing(coarse, (side, side), 0.03, np.random.default_rng(0))
    one = assemble(np.repeat(shapes.equilibrium(points, 0.65)[None], tile, axis=0), centers, angles)
    tiles = -(-count // tile)
    columns = int(np.ceil(np.sqrt(tiles)))
    offsets = [((k % columns) * side, (k // columns) * side) for k in range(tiles)]
    X = np.concatenate([one + np.array(offset)[:, None] for offset in offsets])[:count]
    return X - X.mean(axis=(0, 2))[:, None]


def bench(case: dict) -> dict:
    """One case: median seconds of a step, seconds of its stages, peak memory, and what was counted."""
    X = packing(case["M"], case["N"])
    R = float(effective_radius(X[:1])[0])
    rate = 2.0 / (2.0 * R**3)
    flow = make_flow("poiseuille", rate, 40.0 * R)
    kind, _, maps = case["solver"].partition(":")
    solver = {"kind": kind, "near_tolerance": case["tolerance"], "far_field": case["far_field"]}
    if kind != "implicit":
        solver |= {"device": case["device"], "dtype": case["dtype"], "far_tolerance": case["tolerance"]}
    if kind == "vesnet":
        solver |= {"maps": maps, "weights": case["weights"]}
    if case["operator_points"]:
        solver["operator_points"] = case["operator_points"]
    dt = LEARNED_DT if kind == "vesnet" else 0.005 / rate
    scene = make_scene({"name": "bench", "time": {"dt": dt, "horizon": 1.0}, "flow": {"kind": "poiseuille"}, "solver": solver})
    problem = Problem(scene, X, flow, dt, dt / 1000.0, 1.0, R**3)
    stepper = make_stepper(problem, area(X), length(X))
    state = on_device(State(0.0, X), scene)
    wait = lambda: None
    if case["device"].startswith("cuda"):
        import torch

        wait = torch.cuda.synchronize
    seconds, stages = [], []
    with fft_backend(X.size), counting() as counts:
        for k in range(case["repeat"] + 2):
            counts.clear()
            with timing(wait) as parts:
                begin = time.perf_counter()
                result = stepper.step(state, dt)
                wait()
                step = time.perf_counter() - begin
                check_state(result.state.X, result.state.sigma, result.diagnostics, 1e-2)
                parts["guard"] = time.perf_counter() - begin - step
            state = result.state
            if k >= 2:
                seconds.append(step)
                stages.append(parts)
    median = int(np.argsort(seconds)[len(seconds) // 2])
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024.0
    if case["device"].startswith("cuda"):
        memory = float(torch.cuda.max_memory_allocated())
    assert np.isfinite(to_numpy(state.X)).all()
    return {
        **case,
        "seconds": seconds[median],
        "best": min(seconds),
        "stages": stages[median],
        "memory_bytes": memory,
        "counts": dict(counts),
        "gmres_iterations": result.diagnostics.get("gmres_iterations", 0),
    }


def pair_rate() -> dict[str, float]:
    """Pairs a second of the direct sum on the CUDA device, 64,000 x 64,000 points, by dtype."""
    import torch

    from biem.stokes.farfield_direct import direct_sum

    rates = {}
    for dtype in (torch.float32, torch.float64):
        X, f = (torch.rand((2000, 2, 32), dtype=dtype, device="cuda") for _ in range(2))
        targets = X.permute(0, 2, 1).reshape(-1, 2)
        owner = torch.arange(2000, device="cuda").repeat_interleave(32)
        for _ in range(3):
            torch.cuda.synchronize()
            begin = time.perf_counter()
            direct_sum(targets, X, f, 1.0, owner)
            torch.cuda.synchronize()
            rates[str(dtype).removeprefix("torch.")] = 64000.0**2 / (time.perf_counter() - begin)
    return rates


@cache
def machine() -> dict:
    """What the figures belong to."""
    name = {"processor": platform.processor() or platform.machine(), "cores": len(os.sched_getaffinity(0)), "threads": threads()}
    commit = subprocess.run(["git", "rev-parse", "HEAD"], capture_output=True, text=True, check=False, cwd=Path(__file__).parent)
    return {**name, "python": platform.python_version(), "commit": commit.stdout.strip()}


def row(r: dict) -> str:
    """One line of the table."""
    parts = " | ".join(f"{r['stages'][s]:.3f}" if s in r["stages"] else "" for s in STAGES)
    head = f"{r['solver']} | {r['device']} {r['dtype']} | {r['far_field']} | {r['N']} | {r['M']} | {r['seconds']:.3f} | {r['best']:.3f}"
    return f"| {head} | {parts} | {r['memory_bytes'] / 1e9:.2f} |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--solvers", nargs="+", default=["split"], choices=SOLVERS)
    parser.add_argument("--weights", type=Path, default=None, help="vesnet: a folder of weights; default those that are shipped")
    parser.add_argument("--counts", nargs="+", type=int, default=[48, 200, 504, 1020, 2000, 8000])
    parser.add_argument("--points", nargs="+", type=int, default=[32])
    parser.add_argument("--operator-points", type=int, default=None)
    parser.add_argument("--devices", nargs="+", default=["cpu"])
    parser.add_argument("--dtypes", nargs="+", default=["float64"], choices=["float64", "float32"])
    parser.add_argument("--far-fields", nargs="+", default=["auto"], choices=["auto", "direct", "ewald"])
    parser.add_argument("--tolerance", type=float, default=1e-5, help="of near and far field")
    parser.add_argument("--repeat", type=int, default=5)
    parser.add_argument("--limit", type=float, default=300.0, help="seconds that one case may take")
    parser.add_argument("--json", type=Path, default=Path("out/bench_step.json"))
    parser.add_argument("--smoke", action="store_true", help="small cases only")
    parser.add_argument("--case", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.case:
        print(json.dumps(bench(json.loads(options.case))))
        return
    if options.smoke:
        options.counts, options.repeat = [8, 48], 1
    rows = []
    print("| solver | device | far field | N | M | median s | best s | " + " | ".join(STAGES) + " | peak GB |")
    print("|" + "---|" * (8 + len(STAGES)))
    for solver in options.solvers:
        for device in options.devices if solver != "implicit" else ["cpu"]:
            for dtype in options.dtypes if solver != "implicit" else ["float64"]:
                for far_field in options.far_fields:
                    for N in options.points:
                        for M in options.counts:
                            case = {"solver": solver, "device": device, "dtype": dtype, "far_field": far_field, "N": N, "M": M}
                            case |= {"tolerance": options.tolerance, "operator_points": options.operator_points, "repeat": options.repeat}
                            case["weights"] = str(options.weights.resolve()) if options.weights else None
                            command = [sys.executable, __file__, "--case", json.dumps(case)]
                            try:
                                done = subprocess.run(command, capture_output=True, text=True, timeout=options.limit, check=True)
                            except subprocess.TimeoutExpired:
                                print(f"| {solver} | {device} {dtype} | {far_field} | {N} | {M} | over {options.limit:.0f} s |", flush=True)
                                continue
                            except subprocess.CalledProcessError as error:
                                sys.exit(f"case {case} failed:\n{error.stderr}")
                            rows.append(json.loads(done.stdout.splitlines()[-1]))
                            print(row(rows[-1]), flush=True)
    rates = pair_rate() if any(device.startswith("cuda") for device in options.devices) else {}
    for dtype, rate in rates.items():
        print(f"direct sum on the device, {dtype}: {rate:.2e} pairs a second")
    options.json.parent.mkdir(parents=True, exist_ok=True)
    options.json.write_text(json.dumps({"machine": machine(), "pairs_per_second": rates, "steps": rows}, indent=1) + "\n")


if __name__ == "__main__":
    main()
