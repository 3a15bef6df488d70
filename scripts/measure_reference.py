"""Accuracy of the reference solver, as Markdown tables for docs/measurements.md.

python scripts/measure_reference.py NAME ...

NAME: operators, near, corrections, shear_single, relaxation, shear_pair, low_pass, invariance, order, all.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from biem import ExactMaps, single_layer
from biem.backend import Array
from biem.curves import shapes
from biem.curves.curve import area, bending_energy, centroid, effective_radius, inclination, length, normal
from biem.curves.fourier import coefficients, evaluate, read_back, resample, shift
from biem.curves.reparam import redistribute
from biem.membrane.maps import operator_points
from biem.membrane.operators import VesicleOperators
from biem.steppers.corrections import CORRECTIONS, Corrected
from biem.steppers.implicit import ImplicitStepper
from biem.steppers.order import Extrapolated
from biem.steppers.split import SplitStepper
from biem.steppers.stepper import State, Stepper
from biem.stokes.near_search import find_near
from biem.stokes.quadrature import full_matrix

CLASSES = {"mild": (5, 1.5), "moderate": (7, 1.5), "strong": (8, 0.5)}  # modes of the tangent angle, power of their decay
KNOWN_SHEAR = {1.0: (0.35307, -0.29840), 5.0: (0.35526, -0.29622), 10.0: (0.35700, -0.29418)}  # inclination, frequency / rate


def table(head: list[str], rows: list[list[str]]) -> None:
    print("| " + " | ".join(head) + " |")
    print("|" + "---|" * len(head))
    for row in rows:
        print("| " + " | ".join(row) + " |", flush=True)
    print()


def shape_class(name: str, count: int = 7) -> np.ndarray:
    """Random shapes (count, 2, 512) of reduced area 0.65."""
    modes, power = CLASSES[name]
    return np.stack([shapes.perturbed(512, 0.65, seed=seed, modes=modes, power=power) for seed in range(count)])


def shear_stepper(X: np.ndarray, capillary: float, **options: object) -> tuple[Corrected, float]:
    """Corrected implicit stepper in shear flow and its t_gamma, in natural units."""
    rate = capillary / float(effective_radius(X)[0]) ** 3
    flow = lambda X, t: np.stack([rate * X[:, 1], 0.0 * X[:, 1]], axis=1)
    return Corrected(ImplicitStepper(1.0, 1.0, flow, **options), CORRECTIONS, area(X), length(X)), 1.0 / rate


def shear_pair(points: int) -> tuple[np.ndarray, float]:
    """The two biconcave vesicles of the scene shear_pair, and R."""
    one = shapes.equilibrium(points, 0.65)
    R = float(effective_radius(one[None])[0])
    return np.stack([shapes.place(one, np.array([-2.3 * R, 0.3 * R]), 0.0), shapes.place(one, np.zeros(2), np.pi / 2)]), R


def operators() -> None:
    """Relative L2 error against operators at 512 nodes, low-passed to N, median over 7 shapes, low-passed too."""

    def quantities(maps: ExactMaps, X: np.ndarray) -> dict[str, np.ndarray]:
        alpha = 2 * np.pi * np.arange(X.shape[-1]) / X.shape[-1]
        wave = lambda k: np.broadcast_to(np.stack([np.cos(k * alpha), np.sin(k * alpha)]), X.shape)
        n = operator_points(X.shape[-1], maps.points)
        ops = VesicleOperators(resample(X, n))
        f = resample(np.broadcast_to(np.stack([np.sin(alpha), np.cos(alpha)]), X.shape), n)
        u = (full_matrix(ops.S_blocks) @ f.reshape(len(X), -1, 1)).reshape(len(X), 2, n)
        return {
            "S[(sin, cos)]": resample(u, X.shape[-1]),
            "(1-M) e^{2ia}": maps.advect(X, wave(2)),
            "(1-M) e^{8ia}": maps.advect(X, wave(8)),
            "self-tension": maps.self_tension(X),
            "relaxation, dt 1e-5": maps.relax(X, 1e-5) - X,
        }

    rows: dict[tuple[str, str], list[str]] = {}
    cases = [(32, 32), (32, 64), (32, 128), (64, 64), (128, 128)]
    for name in CLASSES:
        X = shape_class(name)
        exact = quantities(ExactMaps(points=512), X)
        for N, points in cases:
            got = quantities(ExactMaps(points=points), resample(X, N))
            for key, value in got.items():
                want = resample(exact[key], N)
                axes = tuple(range(1, want.ndim))
                error = np.sqrt(((value - want) ** 2).sum(axes) / (want**2).sum(axes))
                rows.setdefault((key, name), []).append(f"{np.median(error):.0e}")
    table(["quantity", "shapes"] + [f"{N} at {n}" for N, n in cases], [[*key, *values] for key, values in rows.items()])


def near() -> None:
    """Largest error over max |S|, 6 moderate shapes, 200 targets a distance and side, against the curve on 4096 nodes."""
    rows = []
    rng = np.random.default_rng(0)
    for N in (32, 128):
        X = shape_class("moderate", 6)[..., :: 512 // N]
        alpha = 2 * np.pi * np.arange(N) / N
        f = np.broadcast_to(np.stack([np.sin(alpha), np.cos(alpha)]), X.shape)
        fine, f_fine = resample(X, 4096), resample(f, 4096)
        for d in (0.1, 0.4, 0.5, 0.99, 1.01, 2.0, 3.0, 5.0):
            worst = dict.fromkeys(("none", "ying_zorin", "upsample"), 0.0)
            for m in range(len(X)):
                a = rng.uniform(0, 2 * np.pi, (1, 200))
                c = coefficients(X[m : m + 1])
                n = evaluate(coefficients(normal(fine[m : m + 1])), a)[0]
                for side in (d, -d):
                    targets = (evaluate(c, a)[0] + side / N * n).T
                    closest = find_near(X[m : m + 1], targets, 1.01 * d)
                    targets = targets[closest.target[np.abs(closest.distance - side / N) < 1e-3 / N]]  # not closer to another part
                    if len(targets) == 0:  # no such point inside
                        continue
                    exact = single_layer(fine[m : m + 1], f_fine[m : m + 1], targets, near_field="none")
                    for scheme in worst:
                        u = single_layer(X[m : m + 1], f[m : m + 1], targets, near_field=scheme, tolerance=1e-8)
                        worst[scheme] = max(worst[scheme], float(np.abs(u - exact).max() / np.abs(exact).max()))
            rows.append([str(N), f"{d:g}", *(f"{e:.0e}" for e in worst.values())])
    table(["N", "d/h", "trapezoid on N", "Ying-Zorin", "adaptive upsampling, tolerance 1e-8"], rows)


def corrections() -> None:
    """Relative change of the area by one redistribution of unevenly spaced nodes, alpha + 0.1 sin(alpha)."""
    rows = []
    for N in (32, 64, 128):
        row = [str(N)]
        for name in CLASSES:
            alpha = 2 * np.pi * np.arange(N) / N
            uneven = (alpha + 0.1 * np.sin(alpha))[None] + np.zeros((7, 1))
            X = evaluate(coefficients(shape_class(name)), uneven)
            row.append(f"{np.median(np.abs(area(redistribute(X)[0]) / area(X) - 1)):.0e}")
        rows.append(row)
    table(["N", *CLASSES], rows)


def shear_single() -> None:
    """Steady inclination and tank-treading frequency over the rate, from an ellipse along x, N = 64."""
    rows = []
    for capillary, known in KNOWN_SHEAR.items():
        found = []
        for step in (0.02, 0.01, 0.005):
            X = shapes.ellipse(64, 0.65)[None]
            stepper, t_gamma = shear_stepper(X, capillary)
            state = State(0.0, X)
            for _ in range(round(40 / step)):
                state = stepper.step(state, step * t_gamma).state
            found.append((float(inclination(state.X)[0]), tank_treading(stepper.inner, state) * t_gamma))
        extrapolated = [(a - 6 * b + 8 * c) / 3 for a, b, c in zip(*found, strict=True)]
        for k, name in enumerate(("inclination", "frequency / rate")):
            values = [f[k] for f in found] + [extrapolated[k]]
            rows.append([f"{capillary:g}", name, *(f"{v:.5f}" for v in values), f"{known[k]:.5f}", f"{abs(values[-1] - known[k]):.0e}"])
    table(["Ca", "", "dt = 0.02", "0.01", "0.005", "dt -> 0", "known", "difference"], rows)


def tank_treading(stepper: Stepper, state: State) -> float:
    """Angular frequency of the membrane, -2 pi v / L with v the mean tangential velocity of the instantaneous motion."""
    dt = 1e-9
    moved = stepper.step(state, dt).state.X
    n = normal(state.X)
    tangent = np.stack([-n[:, 1], n[:, 0]], axis=1)
    velocity = (moved - state.X) / dt
    return float(2 * np.pi * (velocity * tangent).sum(axis=1).mean() / length(state.X)[0])


def relaxation() -> None:
    """Bending energy of three random shapes at rest; the equilibrium is at 42.8572."""
    rows = []
    for N in (64, 128):
        for seed in range(3):
            X = shapes.perturbed(N, 0.65, seed=seed)[None]
            stepper = Corrected(ImplicitStepper(1.0, 1.0), CORRECTIONS, area(X), length(X))
            state, energies = State(0.0, X), [float(bending_energy(X)[0])]
            for dt, steps in ((1e-5, 500), (1e-4, 900)):
                for _ in range(steps):
                    state = stepper.step(state, dt).state
                    energies.append(float(bending_energy(state.X)[0]))
            rise = max(0.0, float(np.diff(energies).max()))
            rows.append([str(N), str(seed), f"{energies[0]:.3f}", f"{energies[500]:.3f}", f"{energies[-1]:.6f}", f"{rise:.1e}"])
    table(["N", "seed", "E at 0", "E at 0.005", "E at 0.095", "largest rise in a step"], rows)


def shear_pair_table() -> None:
    """Separation / R at 20 t_gamma."""
    rows = []
    for N in (32, 48, 64, 128):
        found = []
        for step in (0.02, 0.01, 0.005):
            X, R = shear_pair(N)
            stepper, t_gamma = shear_stepper(X, 5.0)
            state = State(0.0, X)
            for _ in range(round(20 / step)):
                state = stepper.step(state, step * t_gamma).state
            c = centroid(state.X)
            found.append(float(np.hypot(*(c[0] - c[1])) / R))
        extrapolated = (found[0] - 6 * found[1] + 8 * found[2]) / 3
        rows.append([str(N), *(f"{v:.4f}" for v in found), f"{extrapolated:.4f}"])
    table(["N", "dt = 0.02 t_gamma", "0.01", "0.005", "dt -> 0"], rows)


@dataclass(frozen=True)
class ReadAtNodes(ExactMaps):
    """What exact maps would be if velocities and tensions were read at the nodes, with the modes that these cannot hold."""

    def advect(self, X: Array, u: Array) -> Array:
        maps = self._resultants(X)
        return read_back(maps.project(resample(u, maps.X.shape[-1])), X.shape[-1])

    def self_tension(self, X: Array) -> Array:
        return read_back(self._resultants(X).self_tension(), X.shape[-1])

    def flow_tension(self, X: Array, u: Array) -> Array:
        maps = self._resultants(X)
        return read_back(maps.flow_tension(resample(u, maps.X.shape[-1])), X.shape[-1])


def low_pass() -> None:
    """Split solver, shear pair over 20 t_gamma, order 2, dt = 0.05 t_gamma: largest distance of a centroid / R from N = 128, same steps."""

    def path(maps: ExactMaps, N: int) -> np.ndarray:
        X, R = shear_pair(N)
        rate = 5.0 / R**3
        flow = lambda Y, t: np.stack([rate * Y[:, 1], 0.0 * Y[:, 1]], axis=1)
        stepper = Corrected(Extrapolated(SplitStepper(maps, 1.0, 1.0, flow), 2), CORRECTIONS, area(X), length(X))
        state, found = State(0.0, X), []
        for _ in range(400):
            state = stepper.step(state, 0.05 / rate).state
            found.append(centroid(state.X) / R)
        return np.stack(found)

    def places(maps: ExactMaps) -> float:
        """Largest difference of (1-M) e^{2ia} of moderate shapes from that at nodes a third of a spacing further, relative."""
        X = resample(shape_class("moderate"), 32)
        moved = lambda f: shift(f, np.full(f.shape[:-1], 2 * np.pi / 96))
        alpha = 2 * np.pi * np.arange(32) / 32
        u = np.broadcast_to(np.stack([np.cos(2 * alpha), np.sin(2 * alpha)]), X.shape)
        v = moved(maps.advect(X, u))
        return float(np.abs(maps.advect(moved(X), moved(u)) - v).max() / np.abs(v).max())

    expected = path(ExactMaps(), 128)
    rows = []
    for N, points in ((32, 32), (32, 64), (32, 128), (48, 96)):
        ways = [kind(points=points) for kind in (ReadAtNodes, ExactMaps)]
        errors = [np.linalg.norm(path(maps, N) - expected, axis=-1).max() for maps in ways]
        rows.append([f"{N} at {points}", *(f"{e:.4f}" for e in errors), *(f"{places(maps):.0e}" if N == 32 else "" for maps in ways)])
    table(["nodes", "read at the nodes", "low-passed", "places, read", "places, low-passed"], rows)


def order() -> None:
    """Largest difference of the nodes after 0.48 t_gamma of the shear pair, N = 48, between dt and dt/2, and the order."""
    X, _ = shear_pair(48)
    steps, ends = (0.04, 0.02, 0.01, 0.005), []
    for step in steps:
        stepper, t_gamma = shear_stepper(X, 5.0)
        state = State(0.0, X)
        for _ in range(round(0.48 / step)):
            state = stepper.step(state, step * t_gamma).state
        ends.append(state.X)
    differences = [float(np.abs(a - b).max()) for a, b in pairwise(ends)]
    orders = [float(np.log2(a / b)) for a, b in pairwise(differences)]
    table(
        ["dt / t_gamma", "difference to dt/2", "order"],
        [[f"{s:g}", f"{d:.2e}", f"{o:.3f}" if o else ""] for s, d, o in zip(steps, differences, [*orders, 0.0], strict=False)],
    )


def invariance() -> None:
    """Largest node difference after 10 steps of 0.02 t_gamma, against the same run transformed afterwards; N = 64."""
    X, _ = shear_pair(64)
    rate = 5.0 / float(effective_radius(X)[0]) ** 3
    shear = np.array([[0.0, rate], [0.0, 0.0]])

    def run(X: np.ndarray, gradient: np.ndarray, origin: np.ndarray) -> np.ndarray:
        flow = lambda Y, t: np.einsum("ij,mjn->min", gradient, Y - origin[:, None])
        stepper = Corrected(ImplicitStepper(1.0, 1.0, flow), CORRECTIONS, area(X), length(X))
        state = State(0.0, X)
        for _ in range(10):
            state = stepper.step(state, 0.02 / rate).state
        return state.X

    plain = run(X, shear, np.zeros(2))
    c, s = np.cos(0.7), np.sin(0.7)
    Q = np.array([[c, -s], [s, c]])
    F = np.diag([1.0, -1.0])
    flip = lambda Y: np.roll(Y[..., ::-1], 1, axis=-1)
    far = np.array([1000.0, -1000.0])
    rows = [
        ["rotation by 0.7", np.abs(run(Q @ X, Q @ shear @ Q.T, np.zeros(2)) - Q @ plain).max()],
        ["shift by (1000, -1000)", np.abs(run(X + far[:, None], shear, far) - plain - far[:, None]).max()],
        ["first node moved by 5", np.abs(run(np.roll(X, 5, axis=-1), shear, np.zeros(2)) - np.roll(plain, 5, axis=-1)).max()],
        ["reflection", np.abs(run(flip(F @ X), F @ shear @ F, np.zeros(2)) - flip(F @ plain)).max()],
        ["vesicles in another order", np.abs(run(X[::-1], shear, np.zeros(2)) - plain[::-1]).max()],
    ]
    table(["transformation", "difference"], [[name, f"{value:.1e}"] for name, value in rows])


ALL: dict[str, Callable[[], None]] = {
    "operators": operators,
    "near": near,
    "corrections": corrections,
    "shear_single": shear_single,
    "relaxation": relaxation,
    "shear_pair": shear_pair_table,
    "low_pass": low_pass,
    "order": order,
    "invariance": invariance,
}

if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("name", choices=[*ALL, "all"], nargs="+")
    for chosen in parser.parse_args().name:
        for name, measure in ALL.items():
            if chosen in (name, "all"):
                print(f"### {name}\n\n{measure.__doc__}\n")
                measure()
