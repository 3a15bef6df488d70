"""Suspensions of the harvest: vesicles in a turning cylinder among rigid obstacles, drawn at random. mu = kappa_b = length = 1.

The circles around the obstacles are GAP apart and from the cylinder, so that vesicles pass between them. The capillary number is
R^3 |omega|, omega the angular velocity of the cylinder, of either sign.
"""

from __future__ import annotations

from collections.abc import Iterator
from math import ceil, hypot, pi, sin, sqrt
from typing import Any

import numpy as np

from biem.backend import to_numpy
from biem.curves.curve import area, length
from biem.errors import NumericalFailure
from biem.run.guard import check_state
from biem.run.solver import make_stepper, on_device
from biem.scene.build import build
from biem.scene.config import Scene, make_scene
from biem.steppers.stepper import State
from datagen.batch import OPERATOR_POINTS
from datagen.config import Dataset, Family
from datagen.flows import radius_of, random_of, stratified

ADAPTIVE_POINTS = 64  # nodes of the membranes where the data set says "adaptive"
GAP = 0.35
SIZES = (0.1, 0.3)  # of obstacles: radius of the circle of equal area
ASPECTS = (0.3, 0.9)  # of ellipses
SIDES = (3, 6)  # of polygons and stars
MOST_TRIES = 1000  # of obstacles drawn in vain
VESICLE_GAP = 0.05  # of the first placement


def draw_scene(config: Dataset, family: int, number: int) -> tuple[Scene, float]:
    """The scene of run `number` of that family, and its capillary number. Raises ValueError where the cylinder has no room."""
    f, rng = config.harvest[family], random_of(config, family, number)
    R = radius_of(config.shapes.reduced_area)
    capillary = stratified(f.capillary, number, f.runs, rng)
    omega = float(rng.choice([-1.0, 1.0])) * capillary / R**3
    points = ADAPTIVE_POINTS if config.simulation.points == "adaptive" else config.simulation.points
    table: dict[str, Any] = {
        "name": f"suspension-{number}",
        "vesicles": {
            "placement": "random",
            "count": f.vesicles,
            "shape": f.initial,
            "reduced_area": config.shapes.reduced_area,
            "points": points,
            "gap": VESICLE_GAP,
            "seed": int(rng.integers(2**31)),
        },
        "walls": {"kind": "circle", "radius": f.radius, "omega": omega, "obstacles": draw_obstacles(f, rng)},
        "time": {"dt": f.dt * min(1.0 / abs(omega), R**3), "horizon": f.horizon / abs(omega)},
        "solver": {"kind": "split", "device": config.simulation.device, "operator_points": OPERATOR_POINTS.get(points)},
    }
    return make_scene(table), capillary


def draw_obstacles(family: Family, rng: np.random.Generator) -> list[dict[str, Any]]:
    """Tables of obstacles in the family's cylinder. Raises ValueError where no places are found."""
    placed: list[dict[str, Any]] = []
    circles: list[tuple[float, float, float]] = []
    for _ in range(MOST_TRIES):
        if len(placed) == family.obstacles:
            return placed
        table, reach = _draw_obstacle(rng)
        x, y = table["center"] = rng.uniform(-family.radius, family.radius, 2).tolist()
        inside = hypot(x, y) + reach + GAP <= family.radius
        if inside and all(hypot(x - a, y - b) >= reach + other + GAP for a, b, other in circles):
            placed.append(table)
            circles.append((x, y, reach))
    raise ValueError(
        f"harvest: {family.obstacles} obstacles {GAP:g} apart were not placed in a cylinder of radius {family.radius:g} in {MOST_TRIES} "
        "tries: take fewer obstacles or a larger radius"
    )


def suspension(scene: Scene, shapes: int) -> Iterator[np.ndarray]:
    """Membranes (M, 2, N) at times evenly spaced to the horizon, fewer where a step fails."""
    problem = build(scene)
    stepper = make_stepper(problem, area(problem.X), length(problem.X))
    steps = ceil(problem.horizon / shapes / problem.dt - 1e-9)
    state = on_device(State(0.0, problem.X), scene)
    for _ in range(shapes):
        try:
            for _ in range(steps):
                with np.errstate(all="ignore"):  # what is not finite is the guard's to name
                    result = stepper.step(state, problem.horizon / shapes / steps)
                check_state(result.state.X, result.state.sigma, result.diagnostics, scene.solver.max_error, problem.region)
                state = result.state
        except (NumericalFailure, np.linalg.LinAlgError):
            return
        yield to_numpy(state.X)


def _draw_obstacle(rng: np.random.Generator) -> tuple[dict[str, Any], float]:
    """A table without a place, and the radius of a circle around the obstacle."""
    shape = str(rng.choice(["circle", "ellipse", "polygon", "star"]))
    size, aspect, sides = rng.uniform(*SIZES), rng.uniform(*ASPECTS), int(rng.integers(SIDES[0], SIDES[1] + 1))
    reach = {
        "circle": 1.0,
        "ellipse": 1.0 / sqrt(aspect),
        "polygon": sqrt(2.0 * pi / (sides * sin(2.0 * pi / sides))),  # of sharp corners
        "star": 1.2,  # of its depth
    }[shape]
    own: dict[str, dict[str, Any]] = {"ellipse": {"aspect": aspect}, "polygon": {"sides": sides}, "star": {"sides": sides}}
    return {"shape": shape, "size": size, "angle": rng.uniform(0.0, 2.0 * pi), **own.get(shape, {})}, size * reach
