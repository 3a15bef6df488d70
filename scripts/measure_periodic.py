"""Accuracy and cost of periodic boxes, as Markdown tables for docs/periodic.md.

python scripts/measure_periodic.py sum | array | drag | copies | side | cost | all
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from bench_step import packing
from measure_reference import table

from biem.curves.curve import arclength_weights, area, inclination
from biem.curves.lattice import Lattice
from biem.curves.packing import assemble, random_packing
from biem.curves.shapes import equilibrium
from biem.observe.instant import instant
from biem.observe.stress import stresslets
from biem.run.simulate import simulate
from biem.scene.build import build
from biem.scene.config import make_scene
from biem.stokes.farfield import pair_sum
from biem.stokes.farfield_direct import direct_sum
from biem.stokes.farfield_periodic import PeriodicSum
from biem.stokes.kress import single_layer_kernel

FRACTION = 0.3  # of the area, in `cost`
CAPILLARY = 5.0


def points_of(X: np.ndarray) -> np.ndarray:
    """Nodes (M N, 2) of curves (M, 2, N)."""
    return X.transpose(0, 2, 1).reshape(-1, 2)


def least(function: Callable[[], Any], repeat: int = 3) -> tuple[float, Any]:
    """Least CPU seconds of `repeat` calls after one that compiles, and the result."""
    result, seconds = function(), []
    for _ in range(repeat):
        begin = time.process_time()
        result = function()
        seconds.append(time.process_time() - begin)
    return min(seconds), result


def random_case(M: int = 20, N: int = 16, seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Targets (200, 2), points X and forces of sum zero (M, 2, N)."""
    rng = np.random.default_rng(seed)
    X, f = rng.uniform(-1, 1, size=(M, 2, N)), rng.normal(size=(M, 2, N))
    return rng.uniform(-1, 1, size=(200, 2)), X, f - f.mean(axis=(0, 2), keepdims=True)


def accuracy() -> None:
    """Relative L2 error of the sum over 320 random points, and largest difference between cut-offs of 0.25, 0.5, 1 and 2 of 1e-12."""
    targets, X, f = random_case()
    rows = []
    for name, lattice in (("2 x 2", Lattice(2, 2)), ("2 x 2, sheared by 0.45", Lattice(2, 2, 0.9)), ("5 x 0.7", Lattice(5, 0.7))):
        velocity = lambda tolerance, scheme, cutoff=None, box=lattice: PeriodicSum(
            targets, X, 1.0, box, None, tolerance, (scheme,), cutoff=cutoff
        ).velocity(f)
        exact = velocity(1e-13, "direct", 0.3)
        error = lambda u, v=exact: f"{np.linalg.norm(u - v) / np.linalg.norm(v):.0e}"
        row = [name]
        for scheme in ("direct", "ewald"):
            row += [error(velocity(tolerance, scheme)) for tolerance in (1e-4, 1e-6, 1e-8, 1e-10)]
        splits = [velocity(1e-12, "direct", cutoff) for cutoff in (0.25, 0.5, 1.0, 2.0)]
        rows.append([*row, f"{max(np.linalg.norm(u - v) for u in splits for v in splits) / np.linalg.norm(exact):.0e}"])
    tolerances = ["1e-6", "1e-8", "1e-10"]
    table(["box", "plain series, 1e-4", *tolerances, "NUFFT, 1e-4", *tolerances, "cut-offs"], rows)


def array() -> None:
    """A round array of free copies that fade out at its edge, and the flow of that edge: relative difference from the periodic sum."""
    lattice = Lattice(1.2, 0.9, 0.3)
    targets, X, f = random_case(2, 5)
    targets, X = 0.3 * targets, 0.3 * X
    exact = PeriodicSum(targets, X, 1.0, lattice, None, 1e-12).velocity(f)
    r = targets[:, None, :] - points_of(X)
    K = -3 / 16 * (r**2).sum(-1)[..., None, None] * np.eye(2) + r[..., :, None] * r[..., None, :] / 8
    edge = np.einsum("pnij,nj->pi", K, points_of(f)) / lattice.area
    rows = []
    for radius in (2, 4, 8, 16, 32):
        n = np.arange(-3 * radius, 3 * radius + 1)
        images = np.stack(np.meshgrid(n, n), axis=-1).reshape(-1, 2) @ lattice.vectors
        distance = np.hypot(*images.T) / radius
        images, distance = images[distance < 1], distance[distance < 1]
        fade = np.exp(-36.0 * np.clip(2 * distance - 1, 0, 1) ** 8)
        copies = (X + images[:, None, :, None]).reshape(-1, 2, X.shape[2])
        u = direct_sum(targets, copies, (fade[:, None, None, None] * f).reshape(copies.shape), 1.0)
        error = lambda v: f"{np.linalg.norm(v - exact) / np.linalg.norm(exact):.1e}"
        rows.append([str(radius), str(len(images)), error(u - edge), error(u)])
    table(["radius", "copies", "difference", "without the flow of the edge"], rows)


def drag() -> None:
    """Force on a cylinder of a square array over mu U, U its velocity against the mean of the fluid's; series: Sangani & Acrivos (1982)."""
    N, lattice, rows = 48, Lattice(1.0, 1.0), []
    t = 2 * np.pi * np.arange(N) / N
    for c in (0.001, 0.01, 0.05, 0.1, 0.2):
        radius = np.sqrt(c / np.pi)
        X = radius * np.stack([np.cos(t), np.sin(t)])[None]
        K = single_layer_kernel(X, radius * np.stack([-np.sin(t), np.cos(t)])[None])[0]
        S = np.block([[K[0], K[1]], [K[1], K[2]]])
        images = PeriodicSum(points_of(X), X, 1.0, lattice, np.zeros(N, dtype=int), 1e-12)
        S += np.stack([images.velocity(unit.reshape(1, 2, N)).T.ravel() for unit in np.eye(2 * N)], axis=1)
        force = np.linalg.lstsq(S, np.repeat([1.0, 0.0], N), rcond=1e-12)[0][:N].sum()
        series = 4 * np.pi / (-0.5 * np.log(c) - 0.738 + c - 0.887 * c**2 + 2.038 * c**3)
        rows.append([f"{c:g}", f"{force:.4f}", f"{series:.4f}", f"{abs(force / series - 1):.0e}"])
    table(["area fraction c", "force", "series to c^3", "difference"], rows)


def _box_scene(sides: tuple[float, float] | None, dt: float, horizon: float, **tables: Any) -> dict[str, Any]:
    scene: dict[str, Any] = {
        "name": "box",
        "flow": {"kind": "shear", "capillary": CAPILLARY},
        "time": {"dt": f"{dt} t_gamma", "horizon": f"{horizon} t_gamma", "save_every": 100_000},
        "solver": {"kind": "split"},
    }
    return scene | ({} if sides is None else {"domain": {"periodic": sides}}) | tables


def copies() -> None:
    """Six vesicles (N = 32) in a sheared box of 1.1 x 1, 1 t_gamma in 50 steps: largest distance from the same in boxes of two copies."""
    first = build(make_scene(_box_scene((1.1, 1.0), 0.02, 1, vesicles={"placement": "random", "count": 6, "points": 32}))).X
    rows = []
    for solver in ({"kind": "split"}, {"kind": "split", "near_tolerance": 1e-9, "far_tolerance": 1e-9}, {"kind": "implicit"}):
        ends = []
        for times in ((1, 1), (2, 1), (1, 2)):
            X = np.concatenate([first + np.array([m * 1.1, n * 1.0])[:, None] for m in range(times[0]) for n in range(times[1])])
            ends.append(_run_from(X, (1.1 * times[0], 1.0 * times[1]), solver)[:6])
        tolerance = solver.get("far_tolerance", 1e-10 if solver["kind"] == "implicit" else 1e-6)
        off = [f"{np.abs(end - ends[0]).max():.0e}" for end in ends[1:]]
        rows.append([str(solver["kind"]), f"{tolerance:g}", f"{np.abs(ends[0] - first).max():.2f}", *off])
    table(["solver", "tolerance", "moved by", "2.2 x 1", "1.1 x 2"], rows)


def _run_from(X: np.ndarray, sides: tuple[float, float], solver: dict[str, Any]) -> np.ndarray:
    with tempfile.TemporaryDirectory() as folder:
        with h5py.File(Path(folder) / "X.h5", "w") as file:
            file["X"] = X
        return simulate(make_scene(_box_scene(sides, 0.02, 1, vesicles={"file": "X.h5"}, solver=solver), folder)).trajectory.X[-1]


def side() -> None:
    """One vesicle in shear, Ca 5, N = 32, order 2, after 12 t_gamma, in square boxes: inclination and intrinsic viscosity."""
    found = []
    for side in (None, 8.0, 4.0, 2.0, 1.0):
        sides = None if side is None else (side, side)
        scene = make_scene(
            _box_scene(
                sides,
                0.04,
                12,
                vesicles={"points": 32, "angles": [0.35]},
                time={"dt": "0.04 t_gamma", "horizon": "12 t_gamma", "order": 2, "save_every": 100_000},
            )
        )
        problem, run = build(scene), simulate(scene).trajectory
        X, t = run.X[-1], float(run.t[-1])
        stress = stresslets(X, instant(problem, X, t).sigma, 1.0)[0, 0, 1]
        assert problem.flow.rate is not None
        found.append((side, float(inclination(X)[0]), stress / (problem.flow.rate * float(area(X)[0])), float(area(X)[0])))
    _, angle, viscosity, one = found[0]
    rows = []
    for side, a, eta, _ in found:
        off = ["", ""] if side is None else [f"{a - angle:+.4f}", f"{eta - viscosity:+.4f}"]
        rows.append(
            ["plane" if side is None else f"{side:g}", "0" if side is None else f"{one / side**2:.4f}", f"{a:.4f}", f"{eta:.4f}", *off]
        )
    table(["side / length", "area fraction", "inclination", "intrinsic viscosity", "inclination off", "viscosity off"], rows)


def cost() -> None:
    """CPU seconds of the far field (setting up + a sum) at 30 % of the area, N = 32, one thread; and images in the near field."""
    rows = []
    for M in (8, 32, 128, 504, 2000):
        side = float(np.sqrt(M * float(area(equilibrium(32, 0.65)[None])[0]) / FRACTION))
        shapes = np.repeat(equilibrium(32, 0.65)[None], M, axis=0)
        if M <= 128:
            X = assemble(shapes, *random_packing(shapes, (side, side), 0.02, np.random.default_rng(0), periodic=True))
        else:
            X = packing(M, 32)
        targets, owner = points_of(X), np.repeat(np.arange(M), 32)
        g = np.random.default_rng(0).standard_normal(X.shape) * arclength_weights(X)[:, None, :]
        boxes = (Lattice(side, side), None)
        cells = [_seconds(targets, X, g, owner, tolerance, box) for tolerance in (1e-4, 1e-6, 1e-10) for box in boxes]
        images = len(Lattice(side, side).with_images(X, 0.1)[1]) - M
        rows.append([str(M), *cells, str(images)])
    table(["vesicles", "1e-4: box, ms", "plane", "1e-6: box", "plane", "1e-10: box", "plane", "images"], rows)


def _seconds(targets: np.ndarray, X: np.ndarray, g: np.ndarray, owner: np.ndarray, tolerance: float, lattice: Lattice | None) -> str:
    built, far = least(lambda: pair_sum(targets, X, 1.0, owner, "auto", tolerance, lattice=lattice))
    return f"{1e3 * built:.1f} + {1e3 * least(lambda: far.velocity(g))[0]:.1f}"


PARTS = {"sum": accuracy, "array": array, "drag": drag, "copies": copies, "side": side, "cost": cost}

if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("part", choices=[*PARTS, "all"])
    chosen = parser.parse_args().part
    for name, part in PARTS.items():
        if chosen in (name, "all"):
            print(f"### {name}\n\n{part.__doc__}\n")
            part()
