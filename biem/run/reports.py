"""What `run` and `plan` have to say: as a dictionary (--json), and as lines for people made of the same dictionary."""

from __future__ import annotations

import json
import math
import time
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from biem.backend import fft_backend, threads
from biem.curves.curve import area, length
from biem.ranks import Ranks
from biem.run.solver import make_stepper, on_device
from biem.run.trajectory import Trajectory
from biem.scene.accuracy import describe
from biem.scene.build import Problem
from biem.scene.plan import memory_estimate, required_parts, trajectory_bytes
from biem.steppers.stepper import State

WALL_SECONDS = 2.5e-10  # to factorise walls, per cube of their nodes, on one core (docs/measurements.md)
LONGEST_MEASUREMENT = 20.0  # s

Report = dict[str, Any]


def as_json(report: Mapping[str, Any]) -> str:
    """The report as JSON; numbers that JSON does not have, such as the gap of a lone vesicle, are null."""
    return json.dumps(_finite(report), indent=2, ensure_ascii=False, allow_nan=False)


def _finite(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {key: _finite(inner) for key, inner in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(inner) for inner in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def run_report(trajectory: Trajectory, path: Path, counts: Counter[str], ranks: Ranks, notices: tuple[str, ...] = ()) -> Report:
    """What a finished run did. Times in the scene's units, wall_seconds of stepping; errors are the largest of a step, before correction.

    used: how often the first of the processes used each part of the solver. Keys are missing where there is no such thing: gaps and
    iterations of one vesicle, numbers of vesicles unlike the training data of maps that are exact.
    """
    d = trajectory.diagnostics
    report: Report = {
        "trajectory": str(path),
        "frames": len(trajectory),
        "steps": int(trajectory.step[-1]),
        "vesicles": trajectory.X.shape[1],
        "points": trajectory.X.shape[3],
        "t": float(trajectory.t[-1]),
        "t_gamma": float(trajectory.attributes["t_gamma"]) or None,
        "wall_seconds": float((d["wall_seconds"][1:] * np.diff(trajectory.step)).sum()),
        "area_error": float(d["area_error"].max()),
        "length_error": float(d["length_error"].max()),
    }
    if report["vesicles"] > 1:
        report |= {"min_gap": float(d["min_gap"].min()), "gmres_iterations": int(d["gmres_iterations"].max())}
    if "out_of_distribution" in d:
        exact = d.get("by_exact_maps", np.zeros(1)).max()
        report |= {"out_of_distribution": int(d["out_of_distribution"].max()), "by_exact_maps": int(exact)}
    return report | {"processes": ranks.size, "used": dict(sorted(counts.items())), "notices": list(notices)}


def run_lines(report: Mapping[str, Any]) -> list[str]:
    """The report of a run in words."""
    lines = [
        f"{report['frames']} frames to t = {report['t']:.6g} in {clock(report['wall_seconds'])} of stepping: {report['trajectory']}",
        f"largest error of a step, before correction: area {report['area_error']:.1e}, length {report['length_error']:.1e}",
    ]
    if "min_gap" in report:
        gmres = report["gmres_iterations"]
        lines.append(f"smallest gap {report['min_gap']:.4g}" + (f"; at most {gmres} GMRES iterations a step" if gmres else ""))
    if "out_of_distribution" in report:
        outside, exact = report["out_of_distribution"], report["by_exact_maps"]
        lines.append(f"outside the training distribution: at most {outside} of {report['vesicles']} vesicles in a step")
        lines[-1] += f"; by exact maps: at most {exact}" if exact else ""
    size = report["processes"]
    used = ", ".join(f"{name} {n}" for name, n in report["used"].items() if n)
    return [*lines, ("used: " if size == 1 else f"used by the first of {size} processes: ") + used]


def plan_report(problem: Problem, measure: bool = True) -> Report:
    """What a scene requires, and why, with memory and file size in bytes and, where a step is measured, wall seconds a step and in all.

    Of adaptive runs, steps and what follows from them hold if all are as long as the first one.
    """
    scene, unit = problem.scene, problem.flow.time_scale
    report: Report = {
        "name": scene.name,
        "vesicles": problem.X.shape[0],
        "points": problem.X.shape[2],
        "solver": scene.solver.kind,
        "adaptive": scene.time.adaptive,
        "steps": problem.steps,
        "dt": problem.dt,
        "horizon": problem.horizon,
        "t_gamma": unit,
        "t_kappa": problem.t_kappa,
        "accuracy": describe(scene.model_dump()),
        "parts": [{"name": part.name, "needed": part.needed, "why": part.why} for part in required_parts(problem)],
        "memory_bytes": memory_estimate(problem),
        "trajectory_bytes": trajectory_bytes(problem),
        "wall_factorization_seconds": 0.0 if problem.walls is None else WALL_SECONDS * len(problem.walls.nodes) ** 3 / threads(),
        "notices": list(problem.notices),
    }
    measured = measure and report["wall_factorization_seconds"] <= LONGEST_MEASUREMENT
    seconds = seconds_a_step(problem) if measured else None
    return report | {"seconds_a_step": seconds, "seconds": None if seconds is None else seconds * problem.steps}


def plan_lines(report: Mapping[str, Any]) -> list[str]:
    """The plan in words."""
    steps = "adaptive steps, their number not known, the first one of" if report["adaptive"] else f"{report['steps']} steps of"
    dt, unit, end = report["dt"], report["t_gamma"], report["horizon"]
    times = f" ({dt / unit:.4g} t_gamma) to {end / unit:.4g} t_gamma" if unit else f" to t = {end:.6g}"
    lines = [f"{report['name']}: {report['vesicles']} vesicle(s) of {report['points']} nodes, {steps} dt = {dt:.6g}{times}"]
    lines += report["accuracy"]
    wide = max(len(part["name"]) for part in report["parts"])
    lines += [f"  {'yes' if part['needed'] else ' - '}  {part['name']:<{wide}}  {part['why']}" for part in report["parts"]]
    lines.append(f"memory of a step: {report['memory_bytes'] / 1e6:.0f} MB; trajectory: {report['trajectory_bytes'] / 1e6:.1f} MB")
    if report["wall_factorization_seconds"] > LONGEST_MEASUREMENT:
        factorization = clock(report["wall_factorization_seconds"])
        lines.append(f"time: the walls take about {factorization} to factorise, once; steps are not measured")
    elif report["seconds"] is not None:
        total = "if all are as long as the first one" if report["adaptive"] else "in all"
        lines.append(f"time: {report['seconds_a_step']:.3g} s a step here, about {clock(report['seconds'])} {total}")
    return lines


def seconds_a_step(problem: Problem) -> float:
    """Wall time of the second of two steps: the first one compiles and plans."""
    stepper = make_stepper(problem, area(problem.X), length(problem.X))
    with fft_backend(problem.X.size):
        state = stepper.step(on_device(State(0.0, problem.X), problem.scene), problem.dt).state
        begin = time.perf_counter()
        stepper.step(state, problem.dt)
        return time.perf_counter() - begin


def clock(seconds: float) -> str:
    """A duration in words."""
    if seconds < 120:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 7200 else f"{seconds / 3600:.1f} h"
