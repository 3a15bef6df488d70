"""Accuracy and cost of walls, as Markdown tables for docs/measurements.md.

python scripts/measure_walls.py exact | leak | order | cost | all
"""

from __future__ import annotations

import argparse
import time

import numpy as np
from measure_reference import table

from biem import single_layer
from biem.curves import shapes, wall_shapes
from biem.curves.fourier import resample
from biem.run.simulate import simulate
from biem.scene.config import make_scene
from biem.stokes.walls import Walls


def turning(X: np.ndarray, omega: float) -> np.ndarray:
    """Velocity (N, 2) at X (2, N) of a body that turns about the origin."""
    return omega * np.stack([-X[1], X[0]], axis=1)


def exact() -> None:
    """Cylinders of radius 1 and 2.5 that turn at 0.7 and -0.4: errors of the velocity, up to 1e-8 from the walls, and of the loads."""
    a, b, inner, outer = 1.0, 2.5, 0.7, -0.4
    rigid, vortex = (outer * b**2 - inner * a**2) / (b**2 - a**2), (inner - outer) * a**2 * b**2 / (b**2 - a**2)
    t = np.linspace(0, 2 * np.pi, 50)[:-1]
    r = np.array([1 + 1e-8, 1 + 1e-3, 1.2, 1.7, 2.3, b - 1e-3, b - 1e-8])[:, None]
    x = np.stack([r * np.cos(t), r * np.sin(t)], axis=-1).reshape(-1, 2)
    u = (rigid + vortex / (x**2).sum(1, keepdims=True)) * np.stack([-x[:, 1], x[:, 0]], axis=1)
    drag = 4 * np.pi / (np.log(b / a) - (b**2 - a**2) / (b**2 + a**2))
    rows = []
    for N in (16, 24, 32, 48, 64):
        curves = (wall_shapes.circle(2 * N, b), wall_shapes.circle(N, a))
        walls = Walls(curves, np.zeros((2, 2)), 1.0, np.concatenate([turning(curves[0], outer), turning(curves[1], inner)]))
        error = np.abs(walls.flow(x.T[None])[0].T - u).max()
        torque = walls.loads(walls.density(walls.driven))[1][0] / (4 * np.pi * vortex) - 1
        moving = np.concatenate([np.zeros((2 * N, 2)), np.tile([1.0, 0.0], (N, 1))])
        force = walls.loads(walls.density(moving))[0][0, 0] / drag - 1
        rows.append([f"{N} / {2 * N}", *(f"{abs(value):.1e}" for value in (error, torque, force))])
    table(["nodes, inner / outer", "Couette flow", "torque", "force on a moving cylinder"], rows)


def leak() -> None:
    """A vesicle with a random force beside a circular wall: velocity on the wall between its nodes, over that of the vesicle alone."""
    radius, gaps = 1.5, (0.2, 0.1, 0.05, 0.02, 0.01)
    X0 = shapes.equilibrium(128, 0.65)
    f = np.random.default_rng(0).normal(size=(2, 4, 2))
    t = 2 * np.pi * np.arange(128) / 128
    force = sum(f[0, k][:, None] * np.cos(k * t) + f[1, k][:, None] * np.sin(k * t) for k in range(4))
    rows = []
    for spacing in (1 / 16, 1 / 32, 1 / 64, 1 / 128):
        curve = wall_shapes.circle(wall_shapes.nodes_for(wall_shapes.circle(64, radius), spacing, 16), radius)
        walls = Walls((curve,), np.zeros((1, 2)), 1.0)
        x = resample(curve, 4 * curve.shape[1])[:, 1::2].T * (1 - 1e-10)
        row = [f"1/{1 / spacing:.0f} ({curve.shape[1]})"]
        for gap in gaps:
            X = X0 + np.array([[0.0], [radius - gap - X0[1].max()]])
            layer = lambda points, X=X: single_layer(X[None], force[None], points, tolerance=1e-12)
            at_nodes = layer(walls.nodes)
            row.append(f"{np.abs(layer(x) + walls.answer(x, at_nodes)).max() / np.abs(at_nodes).max():.0e}")
        rows.append(row)
    table(["spacing of the wall's nodes", *(f"gap {gap:g}" for gap in gaps)], rows)


def order() -> None:
    """One vesicle in a Couette device (radii 0.7 and 1.6, Ca 5), centroid after 1 t_gamma: both solvers, both orders."""
    rows = []
    for kind in ("implicit", "split"):
        for way in (1, 2):
            centers = []
            for dt in (0.04, 0.02, 0.01):
                scene = {
                    "name": "couette",
                    "vesicles": {"centers": [[1.1, 0.0]], "points": 32},
                    "walls": {"kind": "couette", "radius": 1.6, "inner_radius": 0.7, "capillary": 5.0},
                    "time": {"dt": f"{dt} t_gamma", "horizon": "1 t_gamma", "save_every": 1000, "order": way},
                    "solver": {"kind": kind},
                }
                last = simulate(make_scene(scene)).trajectory.X[-1, 0]
                centers.append(last.mean(axis=1))
            rows.append([kind, str(way), *(f"({x:.5f}, {y:.5f})" for x, y in centers)])
    table(["solver", "order", "dt = 0.04 t_gamma", "0.02", "0.01"], rows)


def cost() -> None:
    """The first answer of the walls factorises them; the next ones are one solve and one evaluation."""
    rows = []
    for P, targets in ((512, 512), (1024, 1024), (2048, 1024), (2048, 64_000), (4096, 4096)):
        curve = wall_shapes.circle(P, 2.0)
        x = np.random.default_rng(0).uniform(-1.3, 1.3, size=(targets, 2))
        walls = Walls((curve,), np.zeros((1, 2)), 1.0, turning(curve, 1.0))
        clock = time.perf_counter
        begin = clock()
        u = walls.answer(x, curve.T)  # also compiles
        first = clock() - begin
        begin = clock()
        walls.answer(x, curve.T + u[0])
        rows.append([str(P), str(targets), f"{first:.2f}", f"{1e3 * (clock() - begin):.0f} ms"])
    table(["wall nodes", "targets", "first answer, s", "an answer"], rows)


PARTS = {"exact": exact, "leak": leak, "order": order, "cost": cost}

if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("part", choices=[*PARTS, "all"])
    chosen = parser.parse_args().part
    for name, part in PARTS.items():
        if chosen in (name, "all"):
            print(f"### {name}\n\n{part.__doc__}\n")
            part()
