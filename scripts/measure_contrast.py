"""Vesicles with a viscosity contrast against published values, theory and finer runs, as Markdown tables for docs/contrast.md.

python scripts/measure_contrast.py inclination | transition | jeffery | order | cost | picture | all      (runs are kept in out/contrast)
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

import numpy as np
from measure_reference import table
from scipy.optimize import brentq
from scipy.special import ellipe
from studies.runs import Kept, kept
from studies.turning import angles

from biem.backend import timing
from biem.curves.curve import area, length
from biem.curves.fourier import resample
from biem.run.simulate import simulate
from biem.run.solver import make_stepper
from biem.scene.build import Problem, build
from biem.scene.config import Scene, load_scene, make_scene
from biem.steppers.stepper import State

OUT = Path("out/contrast")
ENDING, TWICE = "studies.turning:in_shear", "studies.turning:twice_in_shear"
# Steady inclination, rad, by contrast: another two-dimensional boundary-integral code, N = 64, semi-axes 1 and 3, adaptive steps of second
# order. github.com/bioflume/ves2d, docs/papers/lowResolution/figs/inclineAngles.tikz, commit 37432285; bending 0.1, shear rate 1: Ca 52.
PUBLISHED = {0.5: 0.4354, 1.0: 0.3677, 1.5: 0.3114, 2.0: 0.2617, 2.5: 0.2147, 3.0: 0.1681, 3.5: 0.1165, 4.0: 0.03853}
PUBLISHED_CRITICAL = 4.075  # the largest contrast there with a steady angle (0.0054 rad)
PUBLISHED_CA = 3**1.5 / 0.1
ASPECT_3 = 0.6630557  # reduced area of an ellipse of semi-axes 1 and 3
TRANSITIONS = ((0.65, 1.0), (0.65, 10.0), (ASPECT_3, PUBLISHED_CA), (0.9, 1.0), (0.9, 10.0))  # reduced area, Ca


def scene(
    contrast: float, reduced_area: float, capillary: float, points: int = 32, tolerance: float = 3e-4, horizon: float = 300.0
) -> Scene:
    """One vesicle in shear, from an ellipse at 0.3 rad, until it rests or has turned over twice."""
    return make_scene(
        {
            "name": "contrast",
            "vesicles": {"shape": "ellipse", "reduced_area": reduced_area, "points": points, "contrast": contrast, "angles": [0.3]},
            "flow": {"kind": "shear", "capillary": capillary},
            "time": {"dt": "0.02 t_gamma", "horizon": f"{horizon} t_gamma", "order": 2, "adaptive": True, "tolerance": tolerance},
            "solver": {"kind": "split"},
        }
    )


def run_of(wanted: Scene, ending: str = ENDING) -> Kept:
    """The kept run of a scene, named by what distinguishes it."""
    v, flow = wanted.vesicles, wanted.flow
    name = f"nu{v.reduced_area:g}_ca{flow.capillary:.3g}_contrast{v.contrast:.5g}_n{v.points}_tol{wanted.time.tolerance:g}"
    found = kept(wanted, OUT / f"{name}.h5", ending=ending)
    if found.record.failure:
        raise RuntimeError(f"{name}: {found.record.failure}")
    return found


def steady_angle(wanted: Scene) -> float | None:
    """The angle at which the vesicle rests, rad, or None if it tumbles. Raises RuntimeError where the horizon does not tell."""
    trajectory = run_of(wanted).trajectory
    angle = angles(trajectory)
    if angle[-1] < angle[0] - np.pi:
        return None
    if float(trajectory.t[-1]) >= build(wanted).horizon:
        raise RuntimeError(f"contrast {wanted.vesicles.contrast}: neither at rest nor turned over within {wanted.time.horizon}")
    return float(angle[-1])


def inclination() -> None:
    """Steady angle of a vesicle of reduced area 0.663 against published ones, at two resolutions; and the shear rate that it was run at."""
    rows = []
    for contrast, published in PUBLISHED.items():
        found = [
            steady_angle(scene(contrast, ASPECT_3, capillary, points, tolerance))
            for capillary, points, tolerance in ((PUBLISHED_CA, 32, 3e-4), (PUBLISHED_CA, 64, 1e-4), (1.0, 32, 3e-4))
        ]
        rows.append([f"{contrast:g}", f"{published:.4f}", *("tumbles" if angle is None else f"{angle:.4f}" for angle in found)])
    table(["contrast", "published", "N = 32, tolerance 3e-4", "N = 64, tolerance 1e-4", "Ca = 1, N = 32"], rows)


def transition() -> None:
    """Contrast from which a vesicle in shear tumbles, by bisection, and what the theory of Keller and Skalak in two dimensions says."""
    rows = []
    for reduced_area, capillary in TRANSITIONS:
        theory = keller_skalak(reduced_area)
        rests = lambda contrast, a=(reduced_area, capillary): steady_angle(scene(contrast, *a)) is not None
        found = _bisected(rests, round(0.95 * theory, 1), round(1.55 * theory, 1))
        published = f"{PUBLISHED_CRITICAL}" if (reduced_area, capillary) == (ASPECT_3, PUBLISHED_CA) else ""
        rows.append([f"{reduced_area:.3g}", f"{capillary:.0f}", found, f"{theory:.2f}", published])
    table(["reduced area", "Ca", "tumbles from", "Keller-Skalak", "published"], rows)


def _bisected(rests: Callable[[float], bool], low: float, high: float, width: float = 0.03) -> str:
    """The contrast between `low`, where a vesicle rests, and `high`, where it tumbles."""
    if not rests(low) or rests(high):
        return f"not between {low} and {high}"
    while high - low > width:
        middle = round(0.5 * (low + high), 5)
        low, high = (middle, high) if rests(middle) else (low, middle)
    return f"{0.5 * (low + high):.2f}"


def keller_skalak(reduced_area: float) -> float:
    """Critical contrast of an ellipse of that reduced area that keeps its shape, its membrane moving as nu (-a/b y, b/a x).

    dtheta/dt = rate/2 (-1 + B cos 2 theta), B = r + 4 a^2 b^2 / (a^4 - b^4) K / (2 (lambda - 1) + K), r = (a^2 - b^2) / (a^2 + b^2),
    K = 2 (a + b)^2 / (a^2 + b^2): the moment of the tractions on an ellipse in a strain. It rests while B > 1. Keller & Skalak, J. Fluid
    Mech. 120 (1982); in two dimensions Rioual, Biben & Misbah, Phys. Rev. E 69 (2004), Messlinger et al., Phys. Rev. E 80 (2009).
    """
    return float(brentq(lambda contrast: _turning(contrast, reduced_area) - 1.0, 1e-3, 1e3))


def _turning(contrast: float, reduced_area: float) -> float:
    """B of `keller_skalak`; the vesicle rests where cos 2 theta = 1/B."""
    b = brentq(lambda b: (np.pi / (2 * ellipe(1 - b * b))) ** 2 * b - reduced_area, 1e-3, 1.0 - 1e-9)  # a = 1
    r, K = (1 - b * b) / (1 + b * b), 2 * (1 + b) ** 2 / (1 + b * b)
    return float(r + 4 * b * b / (1 - b**4) * K / (2 * (contrast - 1) + K))


def jeffery() -> None:
    """Time of half a turn of a stiff vesicle over Jeffery's pi (a/b + b/a) / rate."""
    rows = []
    for reduced_area in (0.65, 0.9):
        row = [f"{reduced_area:g}"]
        for contrast in (1e2, 1e3, 1e4):
            wanted = scene(contrast, reduced_area, 10.0, tolerance=1e-4)
            found = run_of(wanted, TWICE).trajectory
            X = build(wanted).X
            aspect = np.ptp(resample(_along_x(X), 512), axis=-1)[0]
            aspect = float(aspect[0] / aspect[1])
            angle, unit = angles(found), build(wanted).flow.time_scale
            assert unit is not None
            turns = [np.interp(-level, -angle, found.t / unit) for level in angle[0] - np.pi * np.arange(2)]
            row.append(f"{(turns[1] - turns[0]) / (np.pi * (aspect + 1 / aspect)):.4f}")
        rows.append(row)
    table(["reduced area", "contrast 1e2", "1e3", "1e4"], rows)


def _along_x(X: np.ndarray) -> np.ndarray:
    c, s = np.cos(-0.3), np.sin(-0.3)
    return np.array([[c, -s], [s, c]]) @ X


PAIR = {"centers": [[-2.3, 0.3], [0.0, 0.0]], "angles": [0.0, 1.5708], "unit": "R"}


def pair(kind: str, contrast: list[float], dt: float, order: int, points: int) -> Scene:
    """A pair in shear of Ca 5, 0.15 R apart at first, for 0.52 t_gamma."""
    return make_scene(
        {
            "name": "pair",
            "vesicles": {**PAIR, "points": points, "contrast": contrast},
            "flow": {"kind": "shear", "capillary": 5.0},
            "time": {"dt": f"{dt} t_gamma", "horizon": "0.52 t_gamma", "order": order, "save_every": 1000},
            "solver": {"kind": kind},
        }
    )


def order() -> None:
    """Largest change of the nodes of a pair after 0.52 t_gamma, in R, when dt is halved, and when N is raised."""
    rows = []
    for contrast in ([1.0, 1.0], [5.0, 5.0], [0.2, 0.2], [10.0, 1.0]):
        for kind in ("implicit", "split"):
            row = [", ".join(f"{c:g}" for c in contrast), kind]
            for way in (1, 2):
                ends = [simulate(pair(kind, contrast, dt, way, 48)).trajectory.X[-1] for dt in (0.02, 0.01, 0.005)]
                row.append(" ".join(f"{np.abs(a - b).max() / _radius(a):.1e}" for a, b in pairwise(ends)))
            ends = [resample(simulate(pair(kind, contrast, 0.02, 1, N)).trajectory.X[-1], 96) for N in (24, 32, 48, 64)]
            row.append(" ".join(f"{np.abs(a - b).max() / _radius(a):.1e}" for a, b in pairwise(ends)))
            rows.append(row)
    table(["contrasts", "solver", "order 1: 0.02-0.01, 0.01-0.005", "order 2", "N: 24-32, 32-48, 48-64"], rows)


def _radius(X: np.ndarray) -> float:
    return float(np.sqrt(area(X)[0] / np.pi))


def cost() -> None:
    """CPU milliseconds of a step, of order 1, without contrast and with 5, and the share of the double layers."""
    rows = []
    for count in (1, 2, 100, 400):
        for kind in ("implicit", "split"):
            if kind == "implicit" and count > 100:
                continue
            row = [str(count), kind]
            for contrast in (1.0, 5.0):
                vesicles = {"placement": "grid", "count": count, "area_fraction": 0.2, "points": 32, "contrast": contrast}
                flow = {"kind": "shear", "capillary": 5.0}
                problem = build(
                    make_scene(
                        {
                            "name": "cost",
                            "vesicles": vesicles,
                            "flow": flow,
                            "time": {"dt": "0.005 t_gamma", "horizon": "1 t_gamma"},
                            "solver": {"kind": kind},
                        }
                    )
                )
                total, double = _step_seconds(problem)
                row.append(f"{1e3 * total:.3g}")
                if contrast != 1.0:
                    row.append(f"{1e3 * double:.3g}")
            rows.append(row)
    table(["vesicles", "solver", "contrast 1, ms", "contrast 5, ms", "of it double layers"], rows)


def _step_seconds(problem: Problem, steps: int = 4) -> tuple[float, float]:
    """CPU seconds of a step and of its sums of double layers."""
    stepper = make_stepper(problem, area(problem.X), length(problem.X))
    state = State(0.0, problem.X)
    for _ in range(2):
        state = stepper.step(state, problem.dt).state
    begin = time.process_time()
    with timing(clock=time.process_time) as seconds:
        for _ in range(steps):
            state = stepper.step(state, problem.dt).state
    return (time.process_time() - begin) / steps, seconds.get("double layers", 0.0) / steps


def picture() -> None:
    """docs/images/contrast.png: steady angles by contrast, and the angles of the scene tumbling over time."""
    import matplotlib as mpl

    mpl.use("Agg")
    import matplotlib.pyplot as plt

    figure, (left, right) = plt.subplots(1, 2, figsize=(9, 3.6), layout="constrained")
    for capillary in (PUBLISHED_CA, 1.0):
        found = {contrast: steady_angle(scene(contrast, ASPECT_3, capillary)) for contrast in PUBLISHED}
        resting = {contrast: angle for contrast, angle in found.items() if angle is not None}
        left.plot(list(resting), list(resting.values()), "-", label=f"split, N = 32, Ca {capillary:.0f}")
    left.plot(list(PUBLISHED), list(PUBLISHED.values()), "ko", mfc="none", label=f"ves2d, N = 64, Ca {PUBLISHED_CA:.0f}")
    contrasts = np.linspace(0.5, keller_skalak(ASPECT_3), 200)
    theory = [0.5 * np.arccos(min(1.0, 1.0 / _turning(contrast, ASPECT_3))) for contrast in contrasts]
    left.plot(contrasts, theory, "k:", label="Keller-Skalak, an ellipse")
    left.set(xlabel="viscosity inside over outside", ylabel="steady angle, rad", title="reduced area 0.663", ylim=(0, None))
    left.legend(frameon=False, fontsize=8)
    tumbling = load_scene("configs/scenes/tumbling.toml")
    trajectory = kept(tumbling, OUT / "tumbling.h5").trajectory
    unit = build(tumbling).flow.time_scale
    assert unit is not None
    assert isinstance(tumbling.vesicles.contrast, list)
    for vesicle, contrast in enumerate(tumbling.vesicles.contrast):
        right.plot(trajectory.t / unit, angles(trajectory, vesicle) / np.pi, label=f"contrast {contrast:g}")
    right.set(xlabel=r"$t / t_\gamma$", ylabel=r"inclination / $\pi$", title="configs/scenes/tumbling.toml")
    right.legend(frameon=False, fontsize=8)
    figure.savefig("docs/images/contrast.png", dpi=110)
    print("docs/images/contrast.png")


TABLES = {"inclination": inclination, "transition": transition, "jeffery": jeffery, "order": order, "cost": cost, "picture": picture}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=[*TABLES, "all"])
    what = parser.parse_args().what
    for name in TABLES if what == "all" else [what]:
        print(f"\n## {name}\n")
        TABLES[name]()


if __name__ == "__main__":
    main()
