"""Accuracy and cost of observables, as Markdown tables for docs/observables.md.

python scripts/measure_rheology.py suspension | steady | dissipation | tension | cost | all
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from biem.backend import timing
from biem.curves.curve import bending_energy
from biem.observe.instant import instant
from biem.observe.observables import Observer
from biem.run.observe import observe
from biem.run.simulate import simulate
from biem.run.trajectory import Trajectory
from biem.scene.build import Problem, build
from biem.scene.config import Scene, load_scene, make_scene

SHEAR = {"kind": "shear", "capillary": 5.0}
FEW = {"placement": "random", "count": 4, "area_fraction": 0.05, "reduced_area": 0.65, "points": 64, "seed": 2}


def table(head: list[str], rows: list[list[str]]) -> None:
    print("| " + " | ".join(head) + " |")
    print("|" + "---|" * len(head))
    for row in rows:
        print("| " + " | ".join(row) + " |", flush=True)
    print()


def scene(vesicles: dict[str, Any], solver: str, dt: float, horizon: float, frames: int, order: int = 2, **more: Any) -> Scene:
    """In shear at Ca = 5; dt and horizon in t_gamma."""
    time = {"dt": f"{dt} t_gamma", "horizon": f"{horizon} t_gamma", "save_every": round(horizon / dt / frames), "order": order}
    return make_scene({"name": "rheology", "vesicles": vesicles, "flow": SHEAR, "time": time, "solver": {"kind": solver}, **more})


def run(settings: Scene) -> tuple[Problem, Trajectory]:
    trajectory = simulate(settings, progress=True).trajectory
    return build(settings, trajectory.X[0]), trajectory


def suspension() -> None:
    """Means over 0.5 to 3 t_gamma of four vesicles, a twentieth of the area, by both solvers and by other resolutions."""
    names = ["effective_viscosity", "intrinsic_viscosity", "normal_stress_difference"]
    cases = {
        "implicit": scene(FEW, "implicit", 0.02, 3, 30),
        "split": scene(FEW, "split", 0.02, 3, 30),
        "split, dt = 0.01": scene(FEW, "split", 0.01, 3, 30),
        "split, order 1": scene(FEW, "split", 0.02, 3, 30, order=1),
        "split, N = 32": scene({**FEW, "points": 32}, "split", 0.02, 3, 30),
    }
    rows, first = [], None
    for name, settings in cases.items():
        problem, trajectory = run(settings)
        found = observe(trajectory, problem, names)
        late = found.t >= 0.5 * (problem.flow.time_scale or 1.0)
        means = [float(found.values[n][late].mean()) for n in names]
        each = found.values["effective_viscosity"][late]
        if first is None:
            first = means, each
        off = [abs(a / b - 1) for a, b in zip(means, first[0], strict=True)]
        worst = float(np.abs(each / first[1] - 1).max())
        rows.append([name, *(f"{m:.5g}" for m in means), *(f"{100 * o:.3f} %" for o in off), f"{100 * worst:.3f} %"])
    head = ["", "mu_eff / mu", "[eta]", "N_1", *(f"{n} off" for n in ("mu_eff", "[eta]", "N_1")), "mu_eff off at most, at any output"]
    table(head, rows)


def steady() -> None:
    """One vesicle that tank-treads; the rigid disc has 2 and -1/2."""
    names = ["intrinsic_viscosity", "normal_stress_difference", "inclination", "tank_treading_frequency", "deformation"]
    rows = []
    for nu in (0.65, 0.8, 0.9, 0.97, 0.99, 0.997):
        for points in (32, 64):
            vesicles = {"shape": "ellipse", "reduced_area": nu, "points": points, "angles": [0.5]}
            problem, trajectory = run(scene(vesicles, "implicit", 0.05, 10, 1))
            rate = problem.flow.rate or 1.0
            v = {n: a.item() for n, a in Observer.of(problem, names).row(trajectory.X[-1], 0.0, 0).values.items()}
            v["normal_stress_difference"] /= rate * problem.scene.physics.mu
            v["tank_treading_frequency"] /= rate
            rows.append([f"{nu}", f"{points}", *(f"{v[n]:.5f}" for n in names)])
    table(["reduced area", "N", "[eta]", "N_1 / (mu rate area fraction)", "inclination", "frequency / rate", "deformation"], rows)


def dissipation() -> None:
    """|power of the membrane / rate of its bending energy + 1|, five random shapes."""
    rows = []
    for flow in ({"kind": "quiescent"}, SHEAR):
        for points in (32, 48, 64, 96, 128):
            off = []
            for seed in range(5):
                vesicles = {"shape": "perturbed", "reduced_area": 0.65, "points": points, "seed": seed}
                problem = build(make_scene({"name": "d", "vesicles": vesicles, "flow": flow, "time": {"dt": 1e-5, "horizon": 1e-5}}))
                at = instant(problem, problem.X)
                e = 1e-5 / np.abs(at.velocity).max()
                rate = (bending_energy(at.X + e * at.velocity) - bending_energy(at.X - e * at.velocity))[0] / (2 * e)
                power = Observer.of(problem, ["power"]).row(problem.X, 0.0, 0).values["power"].item()
                off.append(abs(power / rate + 1))
            rows.append([str(flow["kind"]), str(points), f"{np.median(off):.1e}", f"{max(off):.1e}"])
    table(["flow", "N", "median", "largest"], rows)


def tension() -> None:
    """Intrinsic viscosity with the tension that the solver keeps against the tension found anew, four vesicles."""
    rows = []
    for solver in ("implicit", "split"):
        for order in (1, 2):
            for dt in (0.04, 0.02):
                problem, trajectory = run(scene(FEW, solver, dt, 1.2, 6, order))
                a, b = (observe(trajectory, problem, ["intrinsic_viscosity"], stored_tension=s).values for s in (False, True))
                found, stored = a["intrinsic_viscosity"][1:], b["intrinsic_viscosity"][1:]
                rows.append([solver, str(order), f"{dt}", f"{100 * np.abs(stored / found - 1).max():.2f} %"])
    table(["solver", "order", "dt / t_gamma", "largest difference of [eta]"], rows)


def cost() -> None:
    """CPU share of observables in a run of 2,000 vesicles, observed at every step, files included."""
    path = Path(__file__).parents[1] / "configs/scenes/poiseuille_2000.toml"
    rows = []
    for observed in ([], ["observe.every=1"]):
        settings = load_scene(path, ["time.horizon=0.04 t_gamma", "time.save_every=4", *observed])
        with tempfile.TemporaryDirectory() as folder, timing() as seconds:
            done = simulate(settings, Path(folder) / "out.h5", progress=True)
        steps = int(done.trajectory.step[-1])
        step = sum(t for name, t in seconds.items() if name not in ("observables", "output")) / steps
        share = [seconds.get(name, 0.0) / steps for name in ("observables", "output")]
        rows.append(
            ["at every step" if observed else "no", f"{step:.2f}", *(f"{1e3 * s:.0f}" for s in share), f"{100 * share[0] / step:.1f} %"]
        )
    table(["[observe]", "step, s", "observables a step, ms", "files a step, ms", "observables / step"], rows)


MEASUREMENTS = {"suspension": suspension, "steady": steady, "dissipation": dissipation, "tension": tension, "cost": cost}

if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=[*MEASUREMENTS, "all"])
    asked = parser.parse_args().what
    for name, measure in MEASUREMENTS.items():
        if asked in (name, "all"):
            print(f"## {name}: {measure.__doc__}\n", flush=True)
            measure()
